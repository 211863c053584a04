"""The process in which GraspArrays arrive; it also asks the nodes how they are, and hears their diagnostics."""

from __future__ import annotations

import threading
import time
from statistics import median
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import GetState
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from regnet_msgs.msg import GraspArray

from benchmarks.errors import BenchmarkError
from benchmarks.ros.stamps import number_of

_DEPTH = 100


class Arrival(NamedTuple):
    """One GraspArray."""

    number: int
    """Of the cloud, where our publisher sent it."""
    time_ns: int
    """By the machine's monotonic clock."""
    message: GraspArray


class ReceiverTask:
    """Listens to one set of nodes."""

    def __init__(self, namespace: str, nodes: list[str]) -> None:
        rclpy.init(args=[])
        self._namespace = namespace
        self._node = rclpy.create_node("benchmark_receiver", namespace=namespace, start_parameter_services=False)
        self._news = threading.Condition()
        self._arrivals: list[Arrival] = []
        self._count = 0
        self._status: list[dict[str, Any]] = []
        self._node.create_subscription(GraspArray, "grasps", self._on_grasps, QoSProfile(depth=_DEPTH), raw=True)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, QoSProfile(depth=_DEPTH))
        self._states = {name: self._node.create_client(GetState, f"{name}/get_state") for name in nodes}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        threading.Thread(target=self._spin, daemon=True).start()

    def facts(self) -> dict[str, Any]:
        """Nothing that the parent does not know."""
        return {}

    def active(self) -> dict[str, Any]:
        """Which of the nodes are active, and whether the detector's results would arrive."""
        active = [name for name in self._states if self._state(name) == "active"]
        return {"nodes": active, "connected": self._node.count_publishers(f"{self._namespace}/grasps") > 0}

    def measure(self, number: int, patience: float) -> dict[str, Any]:
        """When the result of a cloud arrived [ns], and what it says.

        Raises:
            BenchmarkError: it does not arrive within ``patience`` [s].
        """
        deadline = time.monotonic() + patience
        with self._news:
            while True:
                for arrival in self._arrivals:
                    if arrival.number == number:
                        self._arrivals.clear()
                        return _described(arrival)
                left = deadline - time.monotonic()
                if left <= 0.0:
                    raise BenchmarkError(f"no GraspArray came for cloud {number} within {patience:g} s")
                self._news.wait(left)

    def watch(self, seconds: float) -> dict[str, Any]:
        """How many GraspArrays arrive in so many seconds, the time from the first to the last of them [s], and the
        median of what they say that their detections took [s]."""
        with self._news:
            self._arrivals.clear()
        end = time.monotonic() + seconds
        with self._news:
            while (left := end - time.monotonic()) > 0.0:
                self._news.wait(left)
            times = [arrival.time_ns for arrival in self._arrivals]
            detections = [arrival.message.total_seconds for arrival in self._arrivals]
            total = self._count
        span = (times[-1] - times[0]) / 1e9 if times else 0.0
        return {"count": len(times), "span": span, "total": total, "detection": median(detections or [0.0])}

    def diagnostics(self) -> dict[str, Any]:
        """What the nodes have said since this was last asked."""
        with self._news:
            status, self._status = self._status, []
        return {"status": status}

    def _on_grasps(self, data: bytes) -> None:
        now = time.monotonic_ns()
        message = deserialize_message(data, GraspArray)
        with self._news:
            self._count += 1
            self._arrivals.append(Arrival(number_of(message.header.stamp.sec), now, message))
            self._news.notify_all()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        with self._news:
            for status in message.status:
                values = {pair.key: pair.value for pair in status.values}
                self._status.append({"node": status.name.rpartition("/")[2], "time": now, "values": values})

    def _state(self, name: str) -> str:
        client, done = self._states[name], threading.Event()
        if not client.service_is_ready():
            return ""
        future = client.call_async(GetState.Request())
        future.add_done_callback(lambda _: done.set())
        return str(future.result().current_state.label) if done.wait(2.0) else ""

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return


def _described(arrival: Arrival) -> dict[str, Any]:
    message = arrival.message
    return {
        "arrived": arrival.time_ns,
        "total": message.total_seconds,
        "steps": {step.name: step.seconds for step in message.steps},
        "grasps": len(message.grasps),
        "reason": message.reason,
    }
