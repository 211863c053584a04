"""constraints.txt pins everything that set-up installs."""

import importlib.metadata
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LINE = re.compile(r"(?P<name>[a-z0-9-]+)==(?P<version>[\w.+!]+)(; python_version == \"(?P<python>3\.\d+)\")?")
LINES = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
HERE = f"{sys.version_info.major}.{sys.version_info.minor}"


def pins() -> dict[str, str]:
    """name: version, as far as they hold for this Python."""
    matches = (LINE.fullmatch(line) for line in LINES)
    return {match["name"]: match["version"] for match in matches if match and match["python"] in (None, HERE)}


def test_every_line_is_a_pin_and_none_names_an_address() -> None:
    wrong = [line for line in LINES if not LINE.fullmatch(line)]
    assert not wrong, f"not of the form name==version, with or without a Python version: {wrong}"
    assert "://" not in (ROOT / "constraints.txt").read_text()


def test_no_package_is_pinned_twice_for_one_python() -> None:
    names = [match["name"] for line in LINES if (match := LINE.fullmatch(line)) and match["python"] in (None, HERE)]
    assert len(names) == len(set(names))


def test_everything_that_the_extras_require_is_installed_as_pinned() -> None:
    pinned = pins()
    assert len(pinned) > 100
    waiting, seen = ["regnet-ros"], set()
    while waiting:
        name = waiting.pop()
        seen.add(name)
        for line in importlib.metadata.requires(name) or []:
            required = re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", line)[0]).lower()
            optional = "extra ==" in line and name != "regnet-ros"
            elsewhere = re.search(r"sys_platform == .win32|platform_system == .Windows|sys_platform == .darwin", line)
            if required in seen or optional or elsewhere or not installed(required):
                continue
            assert pinned.get(required) == importlib.metadata.version(required), f"{required}, required by {name}"
            waiting.append(required)
    assert {"numpy", "ros-rclpy", "open3d-cpu", "setuptools"} <= seen


def installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
