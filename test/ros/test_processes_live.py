"""The nodes as processes: signals, exit codes, refused starts, start as `ros2 run` does it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from ament_index_python.packages import get_package_prefix
from clouds import box_on_table, cloud
from lifecycle_msgs.msg import Transition
from live import System, wait_for
from regnet_msgs.msg import GraspArray
from sensor_msgs.msg import PointCloud2

NODES = ("preprocessor", "detector", "selector")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("node", NODES)
def test_a_signal_ends_a_node_cleanly(system: System, node: str, number: int) -> None:
    process = system.start(node)
    process.wait_for_output("active, waiting")
    process.signal(number)
    assert process.wait(10.0) == 0, process.output
    assert "Traceback" not in process.output
    assert "exception" not in process.output.lower()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_a_signal_in_the_middle_of_a_detection(system: System, number: int) -> None:
    process = system.start_node("detector")
    big = np.concatenate([box_on_table(spacing=0.002) + np.array([0, 0, 1e-4 * i]) for i in range(20)])
    publisher = system.peer.publisher(PointCloud2, "cloud")
    results = system.peer.listen(GraspArray, "grasps")
    for stamp in range(1, 4):
        publisher.publish(cloud(big, stamp=stamp))
    results.wait()  # the next detection is under way
    process.signal(number)
    assert process.wait(10.0) == 0, process.output
    assert "Traceback" not in process.output
    assert "exception" not in process.output.lower()


def test_two_signals_in_a_row(system: System) -> None:
    process = system.start("selector")
    process.wait_for_output("active, waiting")
    process.signal(signal.SIGINT)
    process.signal(signal.SIGINT)
    assert process.wait(10.0) == 0, process.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_again_and_again_until_the_end(system: System, number: int) -> None:
    process = system.start("selector")
    process.wait_for_output("active, waiting")
    deadline = time.monotonic() + 10.0
    while process.alive and time.monotonic() < deadline:
        process.signal(number)
        time.sleep(0.002)
    assert process.wait(1.0) == 0, process.output


@pytest.mark.parametrize(
    ("node", "argument", "message"),
    [
        ("detector", "gripper_width:=0.5", "gripper_width must be in [0.03, 0.16]; got 0.5"),
        ("detector", "gripper_width:=0", "gripper_width must be in [0.03, 0.16]; got 0"),
        ("detector", "gripper_width:=wide", "gripper_width must be a number, in [0.03, 0.16]; got the text 'wide'"),
        (
            "detector",
            "model:=nonsense",
            "'antipodal', 'random', or the path of a .safetensors file; got the text 'nonsense'",
        ),
        ("preprocessor", "sensor_pose:=[0.0, 1.0]", "sensor_pose must be an empty list or 6 numbers"),
        ("preprocessor", "sensor_pose:=[0, 1.0, 0, 0, 0, 0]", "write every number with a decimal point"),
        ("preprocessor", "target_frame:=''", "target_frame must be the name of a gravity-aligned frame"),
        ("selector", "policy:=best", "policy must be one of 'heuristic', 'analytic'"),
        ("selector", "reach_min:=2000.0", "reach_min must be in [0, 1000]; got 2000"),
    ],
)
def test_a_node_does_not_start_with_a_value_that_cannot_be(
    system: System, node: str, argument: str, message: str
) -> None:
    process = system.start(node, "--ros-args", "-p", argument)
    assert process.wait() == 2, process.output
    assert message in process.output
    assert "Traceback" not in process.output


def test_an_unknown_parameter_is_pointed_out(system: System) -> None:
    process = system.start("detector", "--ros-args", "-p", "griper_width:=0.06")
    process.wait_for_output("active, waiting")
    assert "there is no parameter 'griper_width'" in process.output
    assert "did you mean 'gripper_width'" in process.output
    process.signal(signal.SIGINT)
    assert process.wait() == 0, process.output


def test_a_device_that_is_not_there_keeps_the_node_unconfigured_until_it_is_changed(system: System) -> None:
    process = system.start("detector", "--ros-args", "-p", "device:=toaster")
    status = system.peer.wait_for_status("detector", lambda s: "cannot configure" in s.message)
    assert "does not run on 'toaster' here" in status.message
    assert system.peer.state("detector") == "unconfigured"
    assert system.peer.set_parameter("detector", "device", "cpu").successful
    assert system.peer.change_state("detector", Transition.TRANSITION_CONFIGURE)
    assert system.peer.change_state("detector", Transition.TRANSITION_ACTIVATE)
    assert system.peer.state("detector") == "active"
    process.signal(signal.SIGTERM)
    assert process.wait() == 0, process.output


@pytest.mark.parametrize("node", NODES)
def test_the_executable_that_ros2_run_looks_for(system: System, tmp_path: Path, node: str) -> None:
    """`ros2 run` starts lib/<package>/<executable> under the prefix that the ament index names."""
    executable = Path(get_package_prefix("regnet_ros")) / "lib" / "regnet_ros" / node
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            [str(executable), "--ros-args", "-r", f"__node:=other_{node}"],
            cwd=tmp_path,
            env={**os.environ, "ROS_DOMAIN_ID": str(system.domain)},
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        wait_for(lambda: "active, waiting" in (tmp_path / "log").read_text(), "the node to become active")
        assert f"other_{node}" in (tmp_path / "log").read_text()
        process.send_signal(signal.SIGINT)
        assert process.wait(10.0) == 0
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_the_nodes_ask_openmp_not_to_spin() -> None:
    script = (
        "import os; os.environ.pop('OMP_WAIT_POLICY', None); import regnet_ros; print(os.environ['OMP_WAIT_POLICY'])"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "PASSIVE"


def test_nodes_do_not_load_torch_before_they_need_it() -> None:
    nodes = "regnet_ros.detector, regnet_ros.preprocessor, regnet_ros.selector"
    script = f"import sys, {nodes}; print('torch' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "False"


def test_the_names_go_when_the_nodes_end(system: System) -> None:
    process = system.start("selector")
    wait_for(lambda: "selector" in system.peer.node.get_node_names(), "the name to come")
    process.signal(signal.SIGTERM)
    process.wait()
    assert wait_for(lambda: "selector" not in system.peer.node.get_node_names(), "the name to go")


@pytest.mark.parametrize("node", NODES)
def test_arguments_that_would_be_ignored_are_refused(system: System, node: str) -> None:
    process = system.start(node, "-p", "gripper_width:=0.06")
    assert process.wait(10.0) == 2
    assert "unknown argument -p gripper_width:=0.06; a node takes ROS arguments only: --ros-args" in process.output
    helped = system.start(node, "--help")
    assert helped.wait(10.0) == 0
    assert "--ros-args" in helped.output
