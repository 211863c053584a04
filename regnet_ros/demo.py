"""The whole pipeline on a recording: `make demo` or `python -m regnet_ros.demo`.

Starts preprocessor, detector and selector as processes, replays a depth-camera bag to them for each gripper width,
which is set by the detector's parameter service, and shows what arrives: tables, a picture and a page.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from regnet_msgs.msg import GraspArray, SelectedGrasp
from rich.console import Console
from sensor_msgs.msg import PointCloud2

from regnet_core.cli.inputs import CloudInput
from regnet_core.cli.pictures import as_scene, write_views
from regnet_core.cli.results import Result
from regnet_core.cli.tables import make_console, print_result
from regnet_core.detector import Detection
from regnet_core.errors import RegnetError
from regnet_core.pointcloud import validate_points
from regnet_core.policy import Selection, make_policy
from regnet_core.support_plane import fit_support_plane
from regnet_ros.conversions import cloud_from_message, grasps_from_messages, gripper_from_message, report_from_message
from regnet_ros.inputs import LATCHED_QOS, OUTPUT_QOS

NAMESPACE = "/regnet_demo"
NODES = ("preprocessor", "detector", "selector")
TOPIC = "/camera/depth/points"
_START_WITHIN = 120.0
"""The first start compiles the kernels [s]."""
_ANSWER_WITHIN = 60.0


class DemoError(RegnetError):
    """A node did not start or did not answer."""


@dataclass(frozen=True)
class Answer:
    """What came back for one cloud."""

    cloud: PointCloud2
    grasps: GraspArray
    selected: SelectedGrasp


class Listener(Node):
    """Sets the detector's parameters and collects what the nodes publish, by the stamp of the cloud."""

    def __init__(self) -> None:
        super().__init__("demo", namespace=NAMESPACE)
        self._clouds: dict[tuple[int, int], PointCloud2] = {}
        self._grasps: list[GraspArray] = []
        self._selected: list[SelectedGrasp] = []
        self.create_subscription(PointCloud2, "cloud", self._on_cloud, OUTPUT_QOS)
        self.create_subscription(GraspArray, "grasps", self._grasps.append, OUTPUT_QOS)
        self.create_subscription(SelectedGrasp, "selected_grasp", self._selected.append, LATCHED_QOS)
        self._setter = self.create_client(SetParameters, "detector/set_parameters")
        self._states = {name: self.create_client(GetState, f"{name}/get_state") for name in NODES}

    def wait_until_active(self, processes: dict[str, subprocess.Popen[bytes]]) -> None:
        """Wait for all nodes to be active.

        Raises:
            DemoError: one of them ended, or it takes too long.
        """
        for name, client in self._states.items():
            is_active = functools.partial(self._is_active, name, client, processes[name])
            self._wait_for(is_active, f"the {name} to start", _START_WITHIN)

    def set_width(self, width: float) -> None:
        """Set the detector's gripper width [m].

        Raises:
            DemoError: the detector refuses it.
        """
        change = Parameter("gripper_width", Parameter.Type.DOUBLE, width).to_parameter_msg()
        future = self._setter.call_async(SetParameters.Request(parameters=[change]))
        self._wait_for(future.done, "the parameter service", _ANSWER_WITHIN)
        result = future.result().results[0]
        if not result.successful:
            raise DemoError(result.reason)

    def wait_for_answer(self, width: float) -> Answer:
        """The first cloud whose grasps for this width and whose selection have both come in.

        Raises:
            DemoError: it takes too long.
        """
        self._wait_for(lambda: self._answer(width) is not None, "grasps and a selection", _ANSWER_WITHIN)
        answer = self._answer(width)
        assert answer is not None
        return answer

    def _answer(self, width: float) -> Answer | None:
        selections = {_key(s): s for s in self._selected if abs(s.gripper.width - width) < 1e-9}
        for grasps in self._grasps:
            key = _key(grasps)
            if abs(grasps.gripper.width - width) < 1e-9 and key in selections and key in self._clouds:
                return Answer(self._clouds[key], grasps, selections[key])
        return None

    def _on_cloud(self, cloud: PointCloud2) -> None:
        self._clouds[_key(cloud)] = cloud

    def _is_active(self, name: str, client: Client, process: subprocess.Popen[bytes]) -> bool:
        if process.poll() is not None:
            raise DemoError(f"the {name} ended with exit code {process.returncode}")
        if not client.service_is_ready():
            return False
        future = client.call_async(GetState.Request())
        rclpy.spin_until_future_complete(self, future, timeout_sec=2.0)
        return future.done() and future.result().current_state.label == "active"

    def _wait_for(self, condition: Callable[[], bool], what: str, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise DemoError(f"waited {seconds:.0f} s for {what}")
            rclpy.spin_once(self, timeout_sec=0.1)


def run_pipeline(bag: Path, widths: Sequence[float]) -> list[Answer]:
    """Start the nodes, replay the bag once for each width and return one answer for each.

    Raises:
        DemoError: a node does not start or answer.
    """
    with ExitStack() as stack:
        processes = {name: stack.enter_context(process(f"regnet_ros.{name}", *ros_arguments(name))) for name in NODES}
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        listener = Listener()
        listener.wait_until_active(processes)
        answers = []
        for width in widths:
            listener.set_width(width)
            renamed = f"{TOPIC}:={NAMESPACE}/points"
            with process(
                "regnet_ros.replay", str(bag), "--remap", renamed, "--topics", TOPIC, "--wait-for-subscribers"
            ):
                answers.append(listener.wait_for_answer(width))
        return answers


def ros_arguments(name: str) -> list[str]:
    """The command line of one node in the demo's namespace."""
    target = {"preprocessor": ["-p", "target_frame:=world"]}.get(name, [])
    return ["--ros-args", "-r", f"__ns:={NAMESPACE}", "--log-level", "warn", *target]


@contextlib.contextmanager
def process(module: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a module as a process, and end it as Ctrl-C would."""
    child = subprocess.Popen([sys.executable, "-m", module, *arguments], stdout=subprocess.DEVNULL)
    try:
        yield child
    finally:
        if child.poll() is None:
            child.send_signal(signal.SIGINT)
        try:
            child.wait(timeout=10)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def as_result(bag: Path, answer: Answer) -> Result:
    """What the nodes found, in the terms of the command line tool."""
    decoded = cloud_from_message(answer.cloud)
    points = validate_points(decoded.points)
    colors = None if decoded.colors is None else decoded.colors[points.rows]
    stamp = answer.cloud.header.stamp
    source = CloudInput(
        file=bag,
        points=points.points,
        colors=colors,
        frame=answer.cloud.header.frame_id,
        stamp_ns=stamp.sec * 10**9 + stamp.nanosec,
    )
    plane = fit_support_plane(points.points, np.random.default_rng(0))
    grasps, chosen = grasps_from_messages(answer.grasps.grasps), answer.selected
    detection = Detection(grasps, report_from_message(answer.grasps), gripper_from_message(chosen.gripper), plane)
    scores = make_policy(chosen.policy).score(grasps.quality, grasps.vertical_score)
    return Result(source, detection, chosen.policy, scores, Selection(chosen.rank, chosen.score, chosen.policy))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; the exit code of the process: 0, or 1 when a node does not answer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bag", type=Path, default=Path("bags/clutter_10"), help="default: %(default)s")
    parser.add_argument("--width", type=float, nargs="+", default=[0.08, 0.05], help="gripper widths [m]")
    parser.add_argument("--out", type=Path, default=Path("out/demo.html"), help="page and picture (.html and .png)")
    options = parser.parse_args(arguments)
    # The demo talks to its own processes only.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    console = make_console()
    try:
        with console.status("running preprocessor, detector and selector on a replayed bag ..."):
            answers = run_pipeline(options.bag, options.width)
    except DemoError as error:
        print(f"the demo failed: {error}", file=sys.stderr)
        return 1
    show(console, options.bag, answers, options.out)
    return 0


def show(console: Console, bag: Path, answers: Sequence[Answer], out: Path) -> None:
    """Print the tables; write the page and the picture."""
    results = [as_result(bag, answer) for answer in answers]
    for result in results:
        print_result(console, result, top=8)
    out.parent.mkdir(parents=True, exist_ok=True)
    for path in write_views(out, [as_scene(result) for result in results]):
        console.print(f"wrote {path}")


def _key(message: PointCloud2 | GraspArray | SelectedGrasp) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


if __name__ == "__main__":
    sys.exit(main())
