"""Starts preprocessor, detector and selector: `ros2 launch regnet_ros regnet.launch.py points:=/camera/depth/points`.

The first two share a process unless `apart` is true. Every argument but `points` may be left out: the value of the
parameter file holds then.
"""

from __future__ import annotations

import tempfile
from typing import Any

import yaml
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

PACKAGE = "regnet_ros"
NODES = ("preprocessor", "detector", "selector")
TOGETHER = {"pipeline": ("preprocessor", "detector"), "selector": ("selector",)}
APART = {name: (name,) for name in NODES}
# Program -> the nodes in it.

# Launch argument -> (nodes whose parameter of the same name it sets, type, description).
PARAMETERS: dict[str, tuple[tuple[str, ...], type, str]] = {
    "target_frame": (("preprocessor",), str, "gravity-aligned frame (z up) that clouds are transformed to"),
    "sensor_pose": (
        ("preprocessor",),
        list,
        "[x, y, z, roll, pitch, yaw] of the cloud's frame in target_frame, without tf2",
    ),
    "gripper_width": (("detector",), float, "largest opening of the jaw [m], 0.03 to 0.16"),
    "model": (
        ("detector",),
        str,
        "what proposes grasps: a name such as regnetv2-s or antipodal, or the path of a .safetensors file",
    ),
    "device": (("detector",), str, "where the model runs: auto, cpu, cuda or cuda:N"),
    "policy": (("selector",), str, "how grasps are scored: heuristic or analytic"),
    "policy_file": (("selector",), str, "constants of the analytic policy: baxter, panda, paper or a .yaml file"),
    "execute": (("selector",), bool, "whether selected grasps are sent to the action execute_grasp"),
    "use_sim_time": (NODES, bool, "whether time comes from /clock"),
    "autostart": (NODES, bool, "false: the nodes wait for lifecycle transitions"),
}


def generate_launch_description() -> LaunchDescription:
    """The arguments and the three nodes."""
    default_file = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "regnet.yaml"])
    arguments = [
        DeclareLaunchArgument("points", default_value="points", description="topic of the camera's PointCloud2"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of nodes and topics"),
        DeclareLaunchArgument("params_file", default_value=default_file, description="parameters of the nodes"),
        DeclareLaunchArgument(
            "apart", default_value="false", description="true: a process for each node; slower, easier to look into"
        ),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal"),
    ]
    for name, (_, _, description) in PARAMETERS.items():
        arguments.append(
            DeclareLaunchArgument(name, default_value="", description=f"{description}; empty: as in params_file")
        )
    return LaunchDescription([*arguments, OpaqueFunction(function=start_nodes)])


def start_nodes(context: LaunchContext) -> list[Node]:
    """The nodes, with the parameters of the arguments that were given over those of the file."""

    def value(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    def parameters(nodes: tuple[str, ...]) -> list[str]:
        texts = {name: value(name) for name in PARAMETERS}
        return [value("params_file"), *(file_of(node, given) for node in nodes if (given := overrides(node, texts)))]

    programs = APART if yaml.safe_load(value("apart")) else TOGETHER
    return [
        Node(
            package=PACKAGE,
            executable=program,
            # A name would be that of all nodes of the process.
            name=program if len(nodes) == 1 else None,
            namespace=value("namespace"),
            parameters=parameters(nodes),
            remappings=[("points", value("points"))] if "preprocessor" in nodes else [],
            arguments=["--ros-args", "--log-level", value("log_level")],
            output="screen",
        )
        for program, nodes in programs.items()
    ]


def file_of(node: str, values: dict[str, Any]) -> str:
    """A parameter file for one node alone: values that launch is given as they are would be those of all nodes of the
    process."""
    with tempfile.NamedTemporaryFile("w", prefix=f"{node}_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump({f"/**/{node}": {"ros__parameters": values}}, file)
    return file.name


def overrides(node: str, texts: dict[str, str]) -> dict[str, Any]:
    """The parameters of one node that were given on the command line, in the types that they have."""
    chosen: dict[str, Any] = {}
    for name, (nodes, kind, _) in PARAMETERS.items():
        if node not in nodes or texts[name] == "":
            continue
        if kind is str:
            chosen[name] = texts[name]
        elif kind is bool:
            chosen[name] = bool(yaml.safe_load(texts[name]))
        elif kind is float:
            chosen[name] = float(texts[name])
        else:
            chosen[name] = [float(number) for number in yaml.safe_load(texts[name])]
    return chosen
