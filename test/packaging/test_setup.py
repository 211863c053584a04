"""The set-up scripts: what is done again after which change, after an interruption, and what is said when one fails."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
STEPS = ["environment", "packages", "messages", "project", "check"]


@pytest.fixture
def setup_env(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """tools/setup_env.py at work on a small copy of the repository, whose .venv is this environment's interpreter."""
    for name in ("constraints.txt", "package.xml", "pyproject.toml", "setup.cfg", "setup.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    for name in ("msg_defs", "resource", "tools"):
        shutil.copytree(ROOT / name, tmp_path / name)
    for name in ("config", "launch", "rviz"):
        (tmp_path / name).mkdir()
    specification = importlib.util.spec_from_file_location("setup_env", tmp_path / "tools" / "setup_env.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    assert tmp_path == module.ROOT
    module.PYTHON.parent.mkdir(parents=True)
    module.PYTHON.symlink_to(sys.executable)
    monkeypatch.setattr(module, "missing_libraries", str)
    return module


def finish(module: ModuleType) -> None:
    """Leave what a complete set-up leaves."""
    module.write_stamps(module.expected_stamps())


def steps_left(module: ModuleType) -> list[str]:
    valid = module.valid_stamps(module.expected_stamps())
    return [name for name, _, _ in module.STEPS if name not in valid]


def record_steps(module: ModuleType, monkeypatch: pytest.MonkeyPatch, failing: str = "") -> list[str]:
    """Replace the steps by ones that only note that they ran; the failing one is interrupted."""
    done: list[str] = []

    def step(name: str) -> None:
        if name == failing:
            raise KeyboardInterrupt
        done.append(name)

    monkeypatch.setattr(
        module, "STEPS", tuple((name, what, lambda name=name: step(name)) for name, what, _ in module.STEPS)
    )
    return done


def run_script(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = ["sh", str(ROOT / "tools" / "setup.sh"), *arguments]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)


def test_nothing_is_left_after_a_complete_set_up(setup_env: ModuleType) -> None:
    finish(setup_env)
    assert steps_left(setup_env) == []


@pytest.mark.parametrize(
    ("changed", "again"),
    [
        ("constraints.txt", STEPS[1:]),
        ("setup.py", STEPS[1:]),
        ("msg_defs/msg/Grasp.msg", STEPS[2:]),
        ("msg_defs/msg/New.msg", STEPS[2:]),
        ("launch/new.launch.py", STEPS[3:]),
        ("package.xml", STEPS[3:]),
        ("README.md", []),
    ],
)
def test_a_change_repeats_the_steps_that_depend_on_it(setup_env: ModuleType, changed: str, again: list[str]) -> None:
    finish(setup_env)
    with (setup_env.ROOT / changed).open("a") as file:
        file.write("\n")
    assert steps_left(setup_env) == again


def test_an_executable_bit_counts_as_a_change(setup_env: ModuleType) -> None:
    finish(setup_env)
    (setup_env.ROOT / "tools" / "executables" / "preprocessor").chmod(0o644)
    assert steps_left(setup_env) == STEPS[3:]


def test_an_interruption_while_packages_change_begins_anew(setup_env: ModuleType) -> None:
    finish(setup_env)
    setup_env.UNFINISHED.touch()
    assert steps_left(setup_env) == STEPS


def test_a_folder_that_was_moved_begins_anew(setup_env: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    finish(setup_env)
    moved = setup_env.ROOT / "elsewhere"
    shutil.copytree(setup_env.VENV, moved, symlinks=True)
    monkeypatch.setattr(setup_env, "VENV", moved)
    assert steps_left(setup_env) == STEPS


@pytest.mark.parametrize("content", ["", "{", "[]", '{"environment": 1}'])
def test_broken_stamps_are_no_stamps(setup_env: ModuleType, content: str) -> None:
    finish(setup_env)
    setup_env.STAMPS.write_text(content)
    assert steps_left(setup_env) == STEPS


def test_an_interrupted_set_up_goes_on_at_its_step(
    setup_env: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["setup_env.py"])
    steps = setup_env.STEPS
    done = record_steps(setup_env, monkeypatch, failing="messages")
    assert setup_env.main() == 130
    assert done == ["environment", "packages"]
    monkeypatch.setattr(setup_env, "STEPS", steps)
    done = record_steps(setup_env, monkeypatch)
    assert setup_env.main() == 0
    assert done == ["messages", "project", "check"]
    assert setup_env.main() == 0
    assert done == ["messages", "project", "check"]
    assert "nothing to do" in capsys.readouterr().err


def test_rebuilding_messages_is_done_on_demand(setup_env: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    finish(setup_env)
    done = record_steps(setup_env, monkeypatch)
    setup_env.set_up(rebuild_messages=True, complete=False)
    assert done == ["messages"]


def test_missing_system_libraries_stop_only_a_complete_set_up(
    setup_env: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    finish(setup_env)
    monkeypatch.setattr(setup_env, "missing_libraries", lambda: "libGL.so.1 is missing")
    setup_env.set_up(rebuild_messages=False, complete=False)
    assert "libGL.so.1 is missing" in capsys.readouterr().err
    with pytest.raises(setup_env.SetupError, match=r"libGL\.so\.1 is missing"):
        setup_env.set_up(rebuild_messages=False, complete=True)


def test_missing_tools_are_named_with_their_packages(setup_env: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("CC", "CXX", "MAKE"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("PATH", "/nonexistent")
    assert setup_env.missing_tools().endswith("apt-get install gcc g++ make")
    with pytest.raises(setup_env.SetupError, match=r"a C\+\+ compiler"):
        setup_env.set_up(rebuild_messages=False, complete=False)


def test_a_failing_command_shows_its_output_and_the_log(setup_env: ModuleType) -> None:
    setup_env.NOTES.mkdir()
    with pytest.raises(setup_env.SetupError, match=r"reason of it[\s\S]*log\.txt"):
        setup_env.run("sh", "-c", "echo reason of it; exit 3")
    assert "reason of it" in setup_env.LOG.read_text()


@pytest.mark.parametrize(("output", "begins_anew"), [("", False), ("Installing collected packages: x\n", True)])
def test_a_failing_pip_begins_anew_only_if_it_had_changed_something(
    setup_env: ModuleType, monkeypatch: pytest.MonkeyPatch, output: str, begins_anew: bool
) -> None:
    def fail(*command: str, seen: object) -> str:
        for line in output.splitlines():
            seen(line)
        raise setup_env.SetupError("NewConnectionError: Temporary failure in name resolution")

    setup_env.NOTES.mkdir()
    monkeypatch.setattr(setup_env, "run", fail)
    with pytest.raises(setup_env.SetupError, match="reached no package index"):
        setup_env.install_packages()
    assert setup_env.UNFINISHED.exists() == begins_anew


def test_cmake_files_of_the_wheels_are_mended(setup_env: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    path = setup_env.VENV / "share" / "some_msgs" / "cmake" / "export.cmake"
    path.parent.mkdir(parents=True)
    path.write_text(
        'set(A "/opt/python/cp312-cp312/include/python3.12")\n'
        'set(B "/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include;/usr/include")\n'
    )
    monkeypatch.setattr(setup_env, "run", lambda *command: "/here/include\n/here/numpy\n")
    setup_env.mend_cmake_files()
    assert path.read_text() == 'set(A "/here/include")\nset(B "/here/numpy;/usr/include")\n'
    path.write_text("/opt/python/unknown")
    with pytest.raises(setup_env.SetupError, match="names folders of another machine"):
        setup_env.mend_cmake_files()


def test_other_environments_do_not_leak_in(setup_env: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PYTHONPATH", "LD_LIBRARY_PATH", "COLCON_PREFIX_PATH", "PIP_TARGET", "ROS_DISTRO", "CMAKE_GENERATOR"):
        monkeypatch.setenv(name, "/opt/ros/jazzy")
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    environment = setup_env.clean_environment()
    assert not [name for name, value in environment.items() if value == "/opt/ros/jazzy"]
    assert environment["AMENT_PREFIX_PATH"] == str(setup_env.VENV)


def test_this_python_can_carry_the_environment() -> None:
    script = ROOT / "tools" / "probe_python.py"
    answer = subprocess.run([sys.executable, "-I", script], capture_output=True, text=True, check=True)
    assert answer.stdout.startswith("ok 3.")


def test_script_says_when_it_finds_no_python() -> None:
    answer = run_script(PYTHON="/bin/false")
    assert answer.returncode == 1
    assert "not /bin/false: it does not run" in answer.stderr
    assert "apt-get install python3 python3-venv python3-dev" in answer.stderr


def test_script_says_which_python_it_takes() -> None:
    answer = run_script("--find-python", PYTHON=sys.executable)
    assert answer.returncode == 0
    assert f"Python {sys.version_info.major}.{sys.version_info.minor}." in answer.stderr


def test_script_refuses_machines_without_wheels(tmp_path: Path) -> None:
    uname = tmp_path / "uname"
    uname.write_text("#!/bin/sh\ncase $1 in -s) echo Linux;; *) echo aarch64;; esac\n")
    uname.chmod(0o755)
    answer = run_script(PATH=f"{tmp_path}:{os.environ['PATH']}")
    assert answer.returncode == 1
    assert "x86-64 Linux only, and this is Linux aarch64" in answer.stderr
