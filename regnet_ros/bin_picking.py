"""The program `bin_picking`: a simulated robot empties a bin, and all nodes of the loop are started by one command.

camera (executor) -> preprocessor -> detector -> selector -> executor. A node that ends, for whatever reason, is started
again, and the loop goes on. Where launch is installed, launch/bin_picking.launch.py does the same.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from regnet_core.errors import RegnetError
from regnet_core.models import DEFAULT_MODEL
from regnet_core.policy import POLICIES
from regnet_core.robots.names import ROBOT_NAMES
from regnet_ros.inputs import OUTPUT_QOS
from regnet_ros.share import config_file

NODES = ("executor", "preprocessor", "detector", "selector")
CALIBRATIONS = {"baxter": "baxter", "baxter_left": "baxter", "panda": "panda"}
"""The policy file of each robot."""
_RESPAWN_DELAY = 1.0
"""A node is started again so long after it ended [s]."""
_SHORT_LIFE, _SHORT_LIVES = 5.0, 5
"""A node that ends within so many seconds so many times in a row does not work."""
_REFUSED = 2
"""Exit code of a node that does not start with its parameters."""
_PERIOD = 0.2
_PATIENCE = 10.0
"""How long nodes may take to end [s]."""


class LoopError(RegnetError):
    """A node does not work."""


class Member:
    """One node of the loop, as a process that is started again when it ends."""

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        self.name, self._arguments = name, arguments
        self._process: subprocess.Popen[bytes] | None = None
        self._started = self._ended = 0.0
        self._short_lives = 0

    def look_after(self) -> None:
        """Start it, again where it has ended.

        Raises:
            LoopError: it refuses its parameters, or ends again and again.
        """
        now = time.monotonic()
        if self._process is not None and (code := self._process.poll()) is not None:
            self._process, self._ended = None, now
            if code == _REFUSED:
                raise LoopError(f"the {self.name} does not start with these parameters")
            self._short_lives = self._short_lives + 1 if now - self._started < _SHORT_LIFE else 0
            if self._short_lives >= _SHORT_LIVES:
                raise LoopError(f"the {self.name} ended {_SHORT_LIVES} times in a row, the last time with code {code}")
            print(f"the {self.name} ended with code {code} and is started again", flush=True)
        if self._process is None and now - self._ended >= _RESPAWN_DELAY:
            self._process = subprocess.Popen([sys.executable, "-m", f"regnet_ros.{self.name}", *self._arguments])
            self._started = now

    def end(self) -> None:
        """Ask it to end, as Ctrl-C would."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def wait(self, deadline: float) -> None:
        """Until it has ended, at the latest at the deadline."""
        if self._process is None:
            return
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Progress(Node):
    """Listens to how many objects are left, and says so when it changes."""

    def __init__(self, namespace: str) -> None:
        super().__init__("bin_picking", namespace=namespace)
        self.left: int | None = None
        """Objects in the bin to pick from; None while that is not known."""
        self._told: tuple[str, ...] = ()
        self._executor_name = f"{self.get_namespace().rstrip('/')}/executor"
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, OUTPUT_QOS)

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name != self._executor_name or "to pick" not in values:
                continue
            self.left = int(values["to pick"])
            news = tuple(values[key] for key in ("to pick", "placed", "beside the bins"))
            if news != self._told:
                self._told = news
                print(f"{news[0]} to pick, {news[1]} placed, {news[2]} beside the bins", flush=True)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options; ends the process with code 2 where they make no sense."""
    parser = argparse.ArgumentParser(
        prog="bin_picking",
        description="A simulated robot empties a bin: all nodes of the loop, started again if killed.",
    )
    parser.add_argument("--robot", choices=ROBOT_NAMES, default=ROBOT_NAMES[0], help="default: %(default)s")
    parser.add_argument("--objects", type=int, default=5, help="in the bin (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the objects (default: %(default)s)")
    parser.add_argument("--model", default=DEFAULT_MODEL, help="what detects grasps (default: %(default)s)")
    parser.add_argument("--gripper-width", type=float, default=0.08, help="[m] (default: %(default)s)")
    parser.add_argument("--policy", choices=tuple(POLICIES), default="analytic", help="default: %(default)s")
    parser.add_argument("--policy-file", help="constants of the analytic policy (default: those of the robot)")
    parser.add_argument(
        "--speed", type=float, default=1.0, help="simulated seconds in a second; 0: as many as possible"
    )
    parser.add_argument("--namespace", default="", help="of nodes and topics")
    parser.add_argument("--params-file", type=Path, help="instead of config/bin_picking.yaml")
    parser.add_argument(
        "--state-file", type=Path, help="where the objects' places are kept (.npz) (default: for this run)"
    )
    parser.add_argument("--until-empty", action="store_true", help="end once the bin is empty")
    return parser.parse_args(arguments)


def node_arguments(name: str, options: argparse.Namespace, state_file: Path) -> list[str]:
    """The command line of one node."""
    width = {"gripper_width": options.gripper_width}
    values: dict[str, dict[str, Any]] = {
        "executor": {
            **width, "robot": options.robot, "objects": options.objects, "seed": options.seed,
            "speed": options.speed, "state_file": str(state_file),
        },
        "detector": {**width, "model": options.model},
        "selector": {
            "policy": options.policy, "policy_file": options.policy_file or CALIBRATIONS[options.robot],
        },
    }  # fmt: skip
    words = ["--ros-args", "--params-file", str(options.params_file or default_params_file())]
    if options.namespace:
        words += ["-r", f"__ns:=/{options.namespace.strip('/')}"]
    for key, value in values.get(name, {}).items():
        words += ["-p", f"{key}:={value}"]
    return words


def default_params_file() -> Path:
    """config/bin_picking.yaml where it is installed."""
    return config_file("bin_picking.yaml")


def run_loop(options: argparse.Namespace) -> int:
    """Run all nodes until Ctrl-C, or until the bin is empty where that is wanted; the exit code.

    Raises:
        LoopError: a node does not work.
    """
    # rclpy's own handlers shut the context down and call these; Python's would raise KeyboardInterrupt in the middle.
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: stops.append(received))
    with ExitStack() as stack:
        state = options.state_file or Path(stack.enter_context(tempfile.TemporaryDirectory())) / "cell.npz"
        rclpy.init(args=[])
        stack.callback(rclpy.try_shutdown)
        progress = Progress(options.namespace)
        members = [Member(name, node_arguments(name, options, state)) for name in NODES]
        stack.enter_context(_ended_together(members))
        with contextlib.suppress(ExternalShutdownException, RCLError):
            while rclpy.ok() and not stops:
                for member in members:
                    member.look_after()
                rclpy.spin_once(progress, timeout_sec=_PERIOD)
                if options.until_empty and progress.left == 0:
                    return 0
    return 0 if not options.until_empty else 1


@contextlib.contextmanager
def _ended_together(members: Sequence[Member]) -> Iterator[None]:
    try:
        yield
    finally:
        for member in members:
            member.end()
        deadline = time.monotonic() + _PATIENCE
        for member in members:
            member.wait(deadline)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the loop; the exit code of the process: 0, or 1 where a node does not work or the bin was not emptied."""
    options = parse(arguments)
    # The simulated robot is this machine's own.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    try:
        return run_loop(options)
    except LoopError as error:
        print(f"bin_picking: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
