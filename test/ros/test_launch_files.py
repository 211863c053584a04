"""Launch file, RViz configuration and Foxglove layout name only what exists.

launch and launch_ros cannot be installed beside the ROS wheels, so the launch file is run with small stand-ins that
record what it asks for; where the real ones are installed they are used for nothing here either.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from live import REPOSITORY

from regnet_ros.parameters import checked_value
from regnet_ros.settings import DetectorParameters, PreprocessorParameters, SelectorParameters

TABLES = {"preprocessor": PreprocessorParameters, "detector": DetectorParameters, "selector": SelectorParameters}
TOPICS = {"/cloud", "/support_plane", "/grasps", "/grasp_poses", "/grasp_markers"}
TOPICS |= {"/selected_grasp", "/selected_pose", "/selected_marker", "/diagnostics"}


class Recorded:
    """Stands for any class of launch: keeps what it was made with."""

    def __init__(self, *positional: Any, **named: Any) -> None:
        self.positional, self.named = positional, named

    def perform(self, context: dict[str, str]) -> str:
        return context[self.positional[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
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
    path = REPOSITORY / "launch" / "regnet.launch.py"
    spec = importlib.util.spec_from_file_location("regnet_launch", path)
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def arguments(launch_file: ModuleType, **given: str) -> dict[str, str]:
    """The launch context: every declared argument with its default, unless given."""
    [entities] = launch_file.generate_launch_description().positional
    declared = {e.positional[0]: e.named["default_value"] for e in entities if e.positional}
    declared["params_file"] = "regnet.yaml"
    assert set(given) <= set(declared)
    return declared | given


def test_three_nodes_are_started_from_the_parameter_file(launch_file: ModuleType) -> None:
    nodes = launch_file.start_nodes(arguments(launch_file, points="/camera/points", apart="true"))
    assert [node.named["executable"] for node in nodes] == ["preprocessor", "detector", "selector"]
    assert [node.named["name"] for node in nodes] == [node.named["executable"] for node in nodes]
    assert nodes[0].named["remappings"] == [("points", "/camera/points")]


def test_without_being_asked_two_of_them_share_a_process(launch_file: ModuleType) -> None:
    nodes = launch_file.start_nodes(arguments(launch_file, points="/camera/points"))
    assert [node.named["executable"] for node in nodes] == ["pipeline", "selector"]
    assert [node.named["name"] for node in nodes] == [None, "selector"]
    assert {node.named["package"] for node in nodes} == {"regnet_ros"}
    assert all(node.named["parameters"] == ["regnet.yaml"] for node in nodes)
    assert nodes[0].named["remappings"] == [("points", "/camera/points")]
    for node in nodes:
        assert importlib.util.find_spec(f"regnet_ros.{node.named['executable']}") is not None


@pytest.mark.parametrize("apart", ["true", "false"])
def test_arguments_reach_the_nodes_as_valid_parameters(launch_file: ModuleType, apart: str) -> None:
    given = {
        "target_frame": "base_link",
        "sensor_pose": "[0.4, 0, 1.2, -2.2, 0, 1.57]",
        "gripper_width": "0.06",
        "model": "/run/weights.safetensors",
        "device": "cpu",
        "policy": "analytic",
        "execute": "true",
        "autostart": "false",
        "use_sim_time": "True",
    }
    found: dict[str, dict[str, Any]] = {}
    for node in launch_file.start_nodes(arguments(launch_file, apart=apart, **given)):
        file, *given_files = node.named["parameters"]
        assert file == "regnet.yaml"
        for given_file in given_files:
            [(name, content)] = yaml.safe_load(Path(given_file).read_text()).items()
            name, parameters = name.removeprefix("/**/"), content["ros__parameters"]
            assert parameters.pop("use_sim_time") is True
            found[name] = {key: checked_value(TABLES[name], key, value) for key, value in parameters.items()}
            Path(given_file).unlink()
    pose = (0.4, 0.0, 1.2, -2.2, 0.0, 1.57)
    assert found["preprocessor"] == {"sensor_pose": pose, "target_frame": "base_link", "autostart": False}
    model = {"model": "/run/weights.safetensors", "device": "cpu"}
    assert found["detector"] == {"gripper_width": 0.06, "autostart": False, **model}
    assert found["selector"] == {"policy": "analytic", "execute": True, "autostart": False}


def test_rviz_shows_topics_that_the_nodes_publish() -> None:
    content = yaml.safe_load((REPOSITORY / "rviz" / "regnet.rviz").read_text())
    displays = content["Visualization Manager"]["Displays"]
    shown = {display["Topic"]["Value"] for display in displays if "Topic" in display}
    assert {"/cloud", "/grasp_markers", "/selected_marker", "/support_plane"} <= shown <= TOPICS
    assert content["Visualization Manager"]["Global Options"]["Fixed Frame"] == PreprocessorParameters().target_frame


def test_foxglove_shows_topics_that_the_nodes_publish() -> None:
    content = json.loads((REPOSITORY / "rviz" / "foxglove_layout.json").read_text())
    panels = content["configById"]
    scene = next(value for name, value in panels.items() if name.startswith("3D!"))
    assert {"/cloud", "/grasp_markers", "/selected_marker", "/support_plane"} <= set(scene["topics"]) <= TOPICS

    def placed(layout: Any) -> set[str]:
        return {layout} if isinstance(layout, str) else placed(layout["first"]) | placed(layout["second"])

    assert placed(content["layout"]) == set(panels)
