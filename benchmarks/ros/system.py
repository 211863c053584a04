"""The nodes as the launch file starts them, in a ROS domain where nothing else talks."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType

from scipy.spatial.transform import Rotation

from benchmarks.errors import BenchmarkError
from benchmarks.machine import ROOT, cpu_seconds, peak_bytes, resident_bytes, with_children
from benchmarks.nodes_config import CONFIG
from benchmarks.workers import Worker
from regnet_core.geometry import Array

NODES = ("preprocessor", "detector", "selector")
PROGRAMS = ("pipeline", "selector")
"""Which the nodes run in."""
NAMESPACE = "/regnet_benchmark"
_DOMAIN = 101
"""The last one whose ports no operating system gives to others."""
_START_WITHIN = 600.0
"""The first start after a change compiles the kernels, which takes long on a busy machine [s]."""
_STOP_WITHIN = 10.0
_NAP = 0.05
_LAST_WORDS = 4000


def check_ros() -> None:
    """Refuse where there is no ROS.

    Raises:
        BenchmarkError: rclpy or the messages are not installed.
    """
    missing = [name for name in ("rclpy", "regnet_msgs") if find_spec(name) is None]
    if missing:
        raise BenchmarkError(
            f"the part 'ros' needs {' and '.join(missing)}: run `make setup`, or source a ROS installation in which "
            "regnet_msgs is built"
        )


@contextlib.contextmanager
def ros_environment() -> Iterator[dict[str, str]]:
    """Variables for all processes of one measurement; one at a time on a machine.

    Raises:
        BenchmarkError: another benchmark is running.
    """
    with open(Path(tempfile.gettempdir()) / "regnet_benchmark.lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise BenchmarkError("another benchmark is running on this machine: wait for it to end") from error
        yield {
            "ROS_DOMAIN_ID": str(_DOMAIN),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "AMENT_PREFIX_PATH": os.environ.get("AMENT_PREFIX_PATH", sys.prefix),
            "PYTHONUNBUFFERED": "1",
        }


class NodeProcess:
    """One program of regnet_ros."""

    def __init__(self, program: str, arguments: Sequence[str], environment: dict[str, str]) -> None:
        self.program = program
        # As for users: nothing says how many threads there are but the parameters.
        surroundings = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"regnet_ros.{program}", *arguments],
            cwd=ROOT,
            env={**surroundings, **environment},
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    @property
    def pids(self) -> list[int]:
        """Its number and those of the processes that it started."""
        return with_children(self.pid)

    def cpu_seconds(self) -> float:
        """Time that all of these have computed [s]."""
        return sum(cpu_seconds(number) for number in self.pids)

    def resident_bytes(self) -> int:
        """Memory of all of these that is in use now [bytes]."""
        return sum(resident_bytes(number) for number in self.pids)

    def peak_bytes(self) -> int:
        """The sum of the most that each of these ever used [bytes]."""
        return sum(peak_bytes(number) for number in self.pids)

    def check_alive(self) -> None:
        """Refuse to go on without it.

        Raises:
            BenchmarkError: the process ended.
        """
        if self._process.poll() is not None:
            raise BenchmarkError(f"{self.program} ended with exit code {self._process.returncode}:\n{self.output()}")

    def output(self) -> str:
        """The last of what it printed."""
        self._log.seek(0)
        return self._log.read()[-_LAST_WORDS:].decode(errors="replace").strip()

    def close(self) -> None:
        """End it as Ctrl-C would."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_STOP_WITHIN)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._log.close()

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class NodeSystem:
    """Preprocessor, detector and selector with config/regnet.yaml, and the process that listens to them.

    One parameter differs from the file: the preprocessor knows the camera's pose without tf2.
    """

    def __init__(
        self,
        stack: contextlib.ExitStack,
        environment: dict[str, str],
        model: str,
        threads: int,
        width: float,
        T_world_camera: Array,
        at_a_time: int = 1,
    ) -> None:
        """Start everything and wait until all nodes are active.

        Args:
            stack: ends the processes.
            environment: of ``ros_environment``.
            model: as the detector's parameter takes it.
            threads: the detector's parameter.
            width: of the gripper [m].
            T_world_camera: the camera's pose (4, 4).
            at_a_time: the detector's parameter.

        Raises:
            BenchmarkError: a node does not start.
        """
        self._environment = environment
        pose = _pose(T_world_camera)
        values = [f"sensor_pose:={pose}", f"model:={model}", f"threads:={threads}", f"gripper_width:={width}"]
        values.append(f"at_a_time:={at_a_time}")
        own = {"pipeline": [word for value in values for word in ("-p", value)]}
        self.nodes = {
            name: stack.enter_context(self._node(name, ["--params-file", str(CONFIG), *own.get(name, [])]))
            for name in PROGRAMS
        }
        settings = {"namespace": NAMESPACE, "nodes": list(NODES)}
        self.receiver = stack.enter_context(Worker("receiver", 1, settings, environment))
        self.wait_until(self._ready, "the nodes to be active")
        self.receiver.ask("diagnostics")

    @property
    def pids(self) -> list[int]:
        """The numbers of all processes of it."""
        return [self.receiver.pid, *(number for node in self.nodes.values() for number in node.pids)]

    def wait_until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for something, as long as all nodes are alive.

        Raises:
            BenchmarkError: it takes too long, or a node ended.
        """
        deadline = time.monotonic() + _START_WITHIN
        while not condition():
            for node in self.nodes.values():
                node.check_alive()
            if time.monotonic() > deadline:
                said = "\n".join(f"{node.program}: {node.output() or 'nothing'}" for node in self.nodes.values())
                found = self.receiver.ask("active")
                raise BenchmarkError(
                    f"waited {_START_WITHIN:.0f} s for {what}; active are {', '.join(found['nodes']) or 'none'}, the "
                    f"detector was {'' if found['connected'] else 'not '}found, and the nodes said:\n{said}"
                )
            time.sleep(_NAP)

    def replay(self, bag: Path, topic: str, rate: float) -> NodeProcess:
        """Play a bag's clouds to the preprocessor for ever, at so many times the recorded speed."""
        options = ["--loop", "--rate", f"{rate:g}", "--topics", topic, "--remap", f"{topic}:={NAMESPACE}/points"]
        return NodeProcess("replay", [str(bag.resolve()), *options, "--wait-for-subscribers"], self._environment)

    def _node(self, name: str, arguments: list[str]) -> NodeProcess:
        ros = ["--ros-args", "-r", f"__ns:={NAMESPACE}", "--log-level", "warn", *arguments]
        return NodeProcess(name, ros, self._environment)

    def _ready(self) -> bool:
        found = self.receiver.ask("active")
        return set(found["nodes"]) == set(NODES) and bool(found["connected"])


def _pose(matrix: Array) -> str:
    """A transform (4, 4) as the parameter sensor_pose: x, y, z [m], roll, pitch, yaw [rad]."""
    numbers = [*matrix[:3, 3], *Rotation.from_matrix(matrix[:3, :3]).as_euler("xyz")]
    return "[" + ", ".join(f"{float(number):.9f}" for number in numbers) + "]"
