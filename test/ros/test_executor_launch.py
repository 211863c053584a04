"""The bin-picking cell's launch and parameter files, the selector's policy files, and the loop's command line.

As in test_launch_files.py, launch itself is replaced by stand-ins that record what they are asked for.
"""

from __future__ import annotations

import importlib.util
import sys
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from live import REPOSITORY, System
from rclpy.time import Time
from regnet_msgs.msg import SelectedGrasp
from test_launch_files import Recorded

from regnet_core.errors import InvalidInputError
from regnet_core.policies import PolicyFile, load_policy, save_policy
from regnet_core.policy import AnalyticPolicy, HeuristicPolicy
from regnet_ros import bin_picking
from regnet_ros.goals import seen_before
from regnet_ros.parameters import ParameterError, checked_value
from regnet_ros.settings import DetectorParameters, ExecutorParameters, PreprocessorParameters, SelectorParameters

TABLES: dict[str, type] = {
    "executor": ExecutorParameters,
    "preprocessor": PreprocessorParameters,
    "detector": DetectorParameters,
    "selector": SelectorParameters,
}
FILE = REPOSITORY / "config" / "bin_picking.yaml"


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    names = {
        "launch": ("LaunchContext", "LaunchDescription"),
        "launch.actions": ("DeclareLaunchArgument", "OpaqueFunction"),
        "launch.substitutions": ("LaunchConfiguration", "PathJoinSubstitution"),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
        "launch_ros.substitutions": ("FindPackageShare",),
    }
    for module, classes in names.items():
        stand_in = ModuleType(module)
        for name in classes:
            setattr(stand_in, name, Recorded)
        monkeypatch.setitem(sys.modules, module, stand_in)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    spec = importlib.util.spec_from_file_location("bin_picking_launch", REPOSITORY / "launch" / "bin_picking.launch.py")
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def started(launch_file: ModuleType, **given: str) -> dict[str, Any]:
    """What each node is started with, by name, with all other arguments at their defaults."""
    [entities] = launch_file.generate_launch_description().positional
    declared = {e.positional[0]: e.named["default_value"] for e in entities if e.positional}
    assert set(given) <= set(declared)
    context = declared | {"params_file": "bin_picking.yaml"} | given
    return {node.named["name"]: node.named for node in launch_file.start_nodes(context)}


def test_one_command_starts_four_nodes_that_come_back(launch_file: ModuleType, tmp_path: Path) -> None:
    nodes = started(launch_file)
    assert tuple(nodes) == tuple(TABLES) == bin_picking.NODES
    for name, node in nodes.items():
        assert node["executable"] == name and node["package"] == "regnet_ros"
        assert node["respawn"] is True and node["respawn_delay"] > 0.0
        assert node["parameters"][0] == "bin_picking.yaml"
    assert [len(node["parameters"]) for node in nodes.values()] == [2, 1, 1, 1]
    state = Path(nodes["executor"]["parameters"][1]["state_file"])
    assert state.suffix == ".npz" and state.parent.parent == tmp_path  # kept over restarts, not over launches


def test_arguments_reach_the_nodes_as_valid_parameters(launch_file: ModuleType) -> None:
    given = {"robot": "panda", "objects": "3", "seed": "7", "speed": "0", "gripper_width": "0.1", "model": "antipodal"}
    found: dict[str, dict[str, Any]] = {}
    for name, node in started(launch_file, **given).items():
        for values in node["parameters"][1:]:
            found[name] = {key: checked_value(TABLES[name], key, value) for key, value in values.items()}
    assert found["executor"].pop("state_file")
    assert found["executor"] == {"robot": "panda", "objects": 3, "seed": 7, "speed": 0.0, "gripper_width": 0.1}
    assert found["detector"] == {"gripper_width": 0.1, "model": "antipodal"}
    assert found["selector"] == {"policy_file": "panda"}  # the calibration of the robot that was chosen
    left = started(launch_file, robot="baxter_left")["selector"]["parameters"][1]
    assert left == {"policy_file": bin_picking.CALIBRATIONS["baxter_left"]}


def test_the_parameter_file_fits_the_tables_and_the_gripper_is_one() -> None:
    sections = {key.rpartition("/")[2]: value for key, value in yaml.safe_load(FILE.read_text()).items()}
    assert set(sections) == set(TABLES)
    tables = {}
    for name, section in sections.items():
        values = {key: checked_value(TABLES[name], key, value) for key, value in section["ros__parameters"].items()}
        tables[name] = TABLES[name](**values)
        tables[name].check()
    assert tables["executor"].gripper == tables["detector"].gripper
    assert tables["executor"].world_frame == tables["preprocessor"].target_frame
    assert tables["selector"].execute


def test_the_command_line_of_the_loop(tmp_path: Path) -> None:
    options = bin_picking.parse(["--robot", "panda", "--namespace", "cell", "--gripper-width", "0.1", "--objects", "2"])
    for name, table in TABLES.items():
        words = bin_picking.node_arguments(name, options, tmp_path / "cell.npz")
        assert words[0] == "--ros-args" and words[2].endswith("config/bin_picking.yaml") and "__ns:=/cell" in words
        values = dict(word.split(":=") for before, word in pairwise(words) if before == "-p")
        for key, text in values.items():
            checked_value(table, key, yaml.safe_load(text))
        assert values.get("gripper_width", "0.1") == "0.1"
    assert "policy_file:=panda" in words  # those of the selector, the last one


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"world_frame": " "}, "world_frame must be the name of a frame"),
        ({"camera_frame": "/"}, "camera_frame must be the name of a frame"),
        ({"state_file": "cell.txt"}, "state_file must end in .npz"),
    ],
)
def test_executor_parameters_that_make_no_sense(values: dict[str, str], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        ExecutorParameters(**values).check()  # type: ignore[arg-type]


def test_the_selector_takes_the_constants_of_a_policy_file(tmp_path: Path) -> None:
    assert SelectorParameters().make_policy("analytic") == AnalyticPolicy()
    assert SelectorParameters(slope=3.0).make_policy("analytic") == AnalyticPolicy(slope=3.0)
    shipped = SelectorParameters(policy_file="baxter", slope=3.0)
    assert shipped.make_policy("analytic") == load_policy("baxter").policy
    assert shipped.make_policy("heuristic") == HeuristicPolicy()
    own = PolicyFile(AnalyticPolicy(0.5, 0.1, 7.0, 0.4))
    save_policy(tmp_path / "own.yaml", own)
    assert SelectorParameters(policy_file=str(tmp_path / "own.yaml")).make_policy("analytic") == own.policy


def test_a_policy_file_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"one of '', 'baxter', 'panda', 'paper', or the path of a \.yaml file"):
        checked_value(SelectorParameters, "policy_file", "robby")
    with pytest.raises(InvalidInputError, match="there is no policy file"):
        SelectorParameters(policy_file=str(tmp_path / "none.yaml")).check()


def test_the_running_selector_loads_and_refuses_policy_files(system: System, tmp_path: Path) -> None:
    system.start_node("selector", policy="analytic", policy_file="panda")
    assert system.peer.get_parameter("selector", "policy_file") == "panda"
    refused = system.peer.set_parameter("selector", "policy_file", str(tmp_path / "none.yaml"))
    assert not refused.successful and "there is no policy file" in refused.reason
    save_policy(tmp_path / "own.yaml", PolicyFile(AnalyticPolicy()))
    assert system.peer.set_parameter("selector", "policy_file", str(tmp_path / "own.yaml")).successful


def test_what_was_seen_before_a_moment() -> None:
    moment = Time(seconds=10, nanoseconds=5)
    grasp = SelectedGrasp()
    assert not seen_before(grasp, moment)  # without a stamp nobody knows
    grasp.header.stamp.sec = 10
    assert seen_before(grasp, moment)
    grasp.header.stamp.nanosec = 5
    assert not seen_before(grasp, moment)
