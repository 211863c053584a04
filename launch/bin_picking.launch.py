"""A simulated robot empties a bin: `ros2 launch regnet_ros bin_picking.launch.py`.

Starts the executor, which simulates robot, bin and camera, and preprocessor, detector and selector. Nodes that end are
started again, and the loop goes on. Every argument may be left out: the value of the parameter file holds then.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

PACKAGE = "regnet_ros"
NODES = ("executor", "preprocessor", "detector", "selector")
RESPAWN_DELAY = 1.0
"""A node is started again so long after it ended [s]."""

# Launch argument -> (nodes whose parameter of the same name it sets, type, description).
PARAMETERS: dict[str, tuple[tuple[str, ...], type, str]] = {
    "robot": (("executor",), str, "the robot: baxter, baxter_left or panda"),
    "objects": (("executor",), int, "how many objects the bin is filled with"),
    "seed": (("executor",), int, "of the objects and of the camera's noise"),
    "speed": (("executor",), float, "simulated seconds in a second; 0: as many as the machine can"),
    "gripper_width": (("executor", "detector"), float, "largest opening of the jaw [m], 0.03 to 0.16"),
    "model": (("detector",), str, "what proposes grasps: a name such as regnetv2-s, or a .safetensors file"),
    "device": (("detector",), str, "where the model runs: auto, cpu, cuda or cuda:N"),
    "policy": (("selector",), str, "how grasps are scored: heuristic or analytic"),
    "policy_file": (("selector",), str, "constants of the analytic policy: baxter, panda, paper or a .yaml file"),
}


def generate_launch_description() -> LaunchDescription:
    """The arguments and the four nodes."""
    default_file = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "bin_picking.yaml"])
    arguments = [
        DeclareLaunchArgument("namespace", default_value="", description="namespace of nodes and topics"),
        DeclareLaunchArgument("params_file", default_value=default_file, description="parameters of the nodes"),
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

    # Kept for as long as this launch: an executor that is started again finds the objects where they were.
    state_file = str(Path(tempfile.mkdtemp(prefix="regnet_bin_picking_")) / "cell.npz")

    texts = {name: value(name) for name in PARAMETERS}
    if texts["robot"] and not texts["policy_file"]:
        texts["policy_file"] = texts["robot"].removesuffix("_left")  # both arms are alike

    def parameters(node: str) -> list[Any]:
        given = overrides(node, texts)
        if node == "executor":
            given["state_file"] = state_file
        return [value("params_file"), given] if given else [value("params_file")]

    return [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=value("namespace"),
            parameters=parameters(name),
            arguments=["--ros-args", "--log-level", value("log_level")],
            output="screen",
            respawn=True,
            respawn_delay=RESPAWN_DELAY,
        )
        for name in NODES
    ]


def overrides(node: str, texts: dict[str, str]) -> dict[str, Any]:
    """The parameters of one node that were given on the command line, in the types that they have."""
    return {
        name: kind(texts[name]) for name, (nodes, kind, _) in PARAMETERS.items() if node in nodes and texts[name] != ""
    }
