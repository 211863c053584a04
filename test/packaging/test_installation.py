"""What ROS tools look for is where they look for it, after set-up (pip) and after colcon."""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory

ROOT = Path(__file__).resolve().parents[2]
PREFIX = Path(sys.prefix)
EXECUTABLES = ("bin_picking", "detector", "executor", "pipeline", "preprocessor", "replay", "selector")
# An interpreter's answer to the launcher: which one it is and what it was told.
STUB = '#!/bin/sh\necho "{name}: $*"\n'


@pytest.fixture
def index(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ament index of this environment alone."""
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(PREFIX))


def write_stub(path: Path, name: str) -> None:
    path.parent.mkdir(parents=True)
    path.write_text(STUB.format(name=name))
    path.chmod(0o755)


def launch(executable: Path, folder: Path, *arguments: str) -> str:
    """Run an executable with a PATH whose first python3 is a stub in folder."""
    write_stub(folder / "python3", "on PATH")
    environment = os.environ | {"PATH": f"{folder}:{os.environ['PATH']}"}
    return subprocess.run([executable, *arguments], check=True, capture_output=True, text=True, env=environment).stdout


@pytest.mark.usefixtures("index")
@pytest.mark.parametrize("package", ["regnet_msgs", "regnet_ros"])
def test_ament_index_finds_the_package(package: str) -> None:
    assert Path(get_package_prefix(package)) == PREFIX
    assert (Path(get_package_share_directory(package)) / "package.xml").is_file()


@pytest.mark.parametrize("name", EXECUTABLES)
def test_executable_is_where_ros2_run_looks_and_starts_an_existing_module(name: str) -> None:
    path = PREFIX / "lib" / "regnet_ros" / name
    assert path.is_file() and os.access(path, os.X_OK)
    assert path.read_text() == (ROOT / "tools" / "executables" / name).read_text()
    specification = importlib.util.find_spec(f"regnet_ros.{name}")
    assert specification is not None and specification.origin is not None
    assert "\ndef main(" in Path(specification.origin).read_text()


def test_there_are_no_other_executables() -> None:
    assert sorted(path.name for path in (PREFIX / "lib" / "regnet_ros").iterdir()) == sorted(EXECUTABLES)


@pytest.mark.usefixtures("index")
@pytest.mark.parametrize("folder", ["config", "launch", "rviz"])
def test_shared_files_are_installed(folder: str) -> None:
    share = Path(get_package_share_directory("regnet_ros"))
    wanted = {path.relative_to(ROOT) for path in (ROOT / folder).rglob("*") if "__pycache__" not in path.parts}
    assert wanted
    for path in wanted:
        assert (ROOT / path).is_dir() or (share / path).read_bytes() == (ROOT / path).read_bytes()


def test_launcher_takes_the_python_of_its_prefix(tmp_path: Path) -> None:
    executable = tmp_path / "prefix" / "lib" / "regnet_ros" / "detector"
    write_stub(tmp_path / "prefix" / "bin" / "python3", "in prefix")
    executable.parent.mkdir(parents=True)
    shutil.copy(ROOT / "tools" / "executables" / "detector", executable)
    answer = launch(executable, tmp_path / "path", "--ros-args", "-r", "__ns:=/left arm")
    assert answer == "in prefix: -P -m regnet_ros.detector --ros-args -r __ns:=/left arm\n"


def test_launcher_takes_the_python_on_path_in_a_prefix_without_one(tmp_path: Path) -> None:
    executable = tmp_path / "install" / "lib" / "regnet_ros" / "selector"
    executable.parent.mkdir(parents=True)
    shutil.copy(ROOT / "tools" / "executables" / "selector", executable)
    assert launch(executable, tmp_path / "path") == "on PATH: -P -m regnet_ros.selector\n"


def test_command_is_on_the_path_of_the_environment() -> None:
    answer = subprocess.run([PREFIX / "bin" / "regnet", "--help"], check=True, capture_output=True, text=True)
    assert "detect" in answer.stdout


class TestColcon:
    """`colcon build` builds both packages; installed as copies and as links, regnet_ros has its executables."""

    @staticmethod
    def build(folder: Path, *options: str) -> Mapping[str, Path]:
        environment = os.environ | {"AMENT_PREFIX_PATH": str(PREFIX), "CMAKE_PREFIX_PATH": str(PREFIX)}
        bases = ("--build-base", folder / "build", "--install-base", folder / "install", "--base-paths", ROOT)
        command = [
            PREFIX / "bin" / "colcon",
            "--log-base",
            folder / "log",
            "build",
            *bases,
            ROOT / "msg_defs",
            *options,
        ]
        result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stdout + result.stderr
        return {path.name: path for path in (folder / "install").iterdir() if path.is_dir()}

    def check(self, prefix: Path, folder: Path) -> None:
        assert sorted(path.name for path in (prefix / "lib" / "regnet_ros").iterdir()) == sorted(EXECUTABLES)
        answer = launch(prefix / "lib" / "regnet_ros" / "replay", folder / "path", "bags/one_object")
        assert answer == "on PATH: -P -m regnet_ros.replay bags/one_object\n"
        assert os.access(prefix / "bin" / "regnet", os.X_OK)
        assert (prefix / "share" / "ament_index" / "resource_index" / "packages" / "regnet_ros").exists()
        assert {path.name for path in (prefix / "share" / "regnet_ros").iterdir()} >= {
            "config",
            "launch",
            "package.xml",
        }

    def test_copies(self, tmp_path: Path) -> None:
        installed = self.build(tmp_path)
        self.check(installed["regnet_ros"], tmp_path)
        package = next(installed["regnet_msgs"].glob("lib/python3*/site-packages/regnet_msgs/msg/__init__.py"))
        assert "GraspArray" in package.read_text()
        assert list(installed["regnet_ros"].glob("lib/python3*/site-packages/regnet_core/py.typed"))
        (weights,) = installed["regnet_ros"].glob("lib/python3*/site-packages/regnet_core/weights")
        published = [path for path in (ROOT / "regnet_core" / "weights").iterdir() if path.suffix != ".py"]
        assert {".md", ".safetensors"} <= {path.suffix for path in published}
        for path in published:
            assert path.is_dir() or (weights / path.name).read_bytes() == path.read_bytes()

    def test_links(self, tmp_path: Path) -> None:
        # colcon wants the packages that are depended on in the same place, built or, as here, pretended.
        pretended = tmp_path / "install" / "regnet_msgs" / "share" / "regnet_msgs" / "package.sh"
        pretended.parent.mkdir(parents=True)
        pretended.touch()
        installed = self.build(tmp_path, "--symlink-install", "--packages-select", "regnet_ros")
        self.check(installed["regnet_ros"], tmp_path)
        assert (installed["regnet_ros"] / "share" / "regnet_ros" / "package.xml").samefile(ROOT / "package.xml")
