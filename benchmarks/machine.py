"""The machine that is measured on, and how busy others keep it meanwhile."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

_UNITS = ("avx2", "avx512f", "avx512_bf16", "avx512_vnni", "amx_bf16", "amx_int8")
"""Features of processors that matter here, as Linux names them."""
_PACKAGES = ("numpy", "scipy", "numba", "torch")
_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Machine:
    """What results depend on besides the code; nothing that tells whose machine it is."""

    processor: str
    units: tuple[str, ...]
    """Those of the vector and matrix units that matter."""
    cores: int
    """That this process may use."""
    cache: int
    """Last-level cache [bytes]; 0 where Linux does not say."""
    memory: int
    """[bytes]"""
    python: str
    packages: dict[str, str]
    ros: str
    """The DDS implementation in use; empty without ROS."""
    commit: str
    """Of the code, with a + where it was changed since; empty outside of git."""


def describe_machine() -> Machine:
    """This one."""
    cpu = _read(Path("/proc/cpuinfo")).splitlines()
    fields = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in cpu)}
    flags = set(fields.get("flags", "").split())
    return Machine(
        processor=fields.get("model name", platform.processor() or platform.machine()),
        units=tuple(unit for unit in _UNITS if unit in flags),
        cores=len(os.sched_getaffinity(0)),
        cache=last_level_cache(),
        memory=os.sysconf("SC_PHYS_PAGES") * _PAGE,
        python=platform.python_version(),
        packages={name: found for name in _PACKAGES if (found := _version(name))},
        ros=os.environ.get("RMW_IMPLEMENTATION", "default") if find_spec("rclpy") else "",
        commit=_commit(),
    )


def last_level_cache() -> int:
    """Size of the largest cache of the first core [bytes]; 0 where Linux does not say."""
    sizes = [0]
    for file in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"):
        text = _read(file).strip()
        if text[:-1].isdigit() and text[-1:] in ("K", "M"):
            sizes.append(int(text[:-1]) * (1 << 10 if text[-1] == "K" else 1 << 20))
    return max(sizes)


class LoadMeter:
    """How many cores other processes keep busy between two looks."""

    def __init__(self, own: Iterable[int]) -> None:
        """``own``: the processes that measure or are measured, of those that run now."""
        self._own = {os.getpid(), *own}
        self._start = time.monotonic(), _busy_seconds(), self._own_seconds()

    def others(self) -> float:
        """The average number of busy cores since the meter was made, without our own processes."""
        elapsed = time.monotonic() - self._start[0]
        busy = _busy_seconds() - self._start[1] - (self._own_seconds() - self._start[2])
        return max(0.0, busy / elapsed) if elapsed > 0.0 else 0.0

    def _own_seconds(self) -> float:
        return sum(cpu_seconds(process) for process in self._own)


def cpu_seconds(process: int) -> float:
    """Time that all threads of a process have computed [s]; 0 for one that is gone."""
    fields = _read(Path(f"/proc/{process}/stat")).rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS if fields else 0.0


def with_children(process: int) -> list[int]:
    """A process and those that it started, and so on; empty where it is gone."""
    found, left = [], [process]
    while left:
        one = left.pop()
        tasks = list(Path(f"/proc/{one}/task").glob("*/children"))
        found += [one] if tasks else []
        left += [int(word) for task in tasks for word in _read(task).split()]
    return found


def resident_bytes(process: int | None = None) -> int:
    """Memory of a process (this one when not given) that is in use now [bytes]; 0 for one that is gone."""
    fields = _read(Path(f"/proc/{process or 'self'}/statm")).split()
    return int(fields[1]) * _PAGE if fields else 0


def peak_bytes(process: int | None = None) -> int:
    """The most memory that a process (this one when not given) ever used [bytes]; 0 for one that is gone."""
    for line in _read(Path(f"/proc/{process or 'self'}/status")).splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return 0


def _busy_seconds() -> float:
    """Time that all cores together have computed since the machine started, for whomever [s]."""
    numbers = [int(word) for word in _read(Path("/proc/stat")).partition("\n")[0].split()[1:9]]
    user, nice, system, _, _, interrupts, soft, stolen = numbers
    return (user + nice + system + interrupts + soft + stolen) / _TICKS


def _commit() -> str:
    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    try:
        commit = git("rev-parse", "--short=12", "HEAD")
        return commit + ("+" if commit and git("status", "--porcelain", "--untracked-files=no") else "")
    except FileNotFoundError:
        return ""


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return ""
