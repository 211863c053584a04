"""The node `preprocessor`: from a camera's cloud to the one that the detector works on."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Duration
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from regnet_core.geometry import Plane
from regnet_core.preprocessing import PreprocessingConfig, preprocess
from regnet_core.report import StepRecorder, StepReport
from regnet_core.support_plane import fit_support_plane
from regnet_ros.conversions import cloud_to_message
from regnet_ros.frames import SensorFrames
from regnet_ros.inputs import LATCHED_QOS, NEXT_CLOUD, OUTPUT_QOS
from regnet_ros.node import GraspNode, publish_if_heard
from regnet_ros.pace import Pace
from regnet_ros.process import run
from regnet_ros.received_cloud import CloudReader
from regnet_ros.settings import PreprocessorParameters
from regnet_ros.visuals import plane_marker
from regnet_ros.warm_up import made_up_cloud

ZERO_STAMP = (
    "the cloud's stamp is zero: its results cannot be matched with transforms or other data; set it in the driver"
)

Taker = Callable[["PreparedCloud"], None]


class PreparedCloud(NamedTuple):
    """What the preprocessor makes of a cloud."""

    header: Header
    """Its frame is gravity-aligned, z up."""
    points: npt.NDArray[np.float32]
    """(N, 3), finite [m]."""
    colors: npt.NDArray[np.uint8] | None
    """(N, 3)."""


_UNHEARD_PLANE = 1.0
"""Where nobody listens, the plane that who comes later is to get is renewed so often [s]."""


class Preprocessor(GraspNode[PreprocessorParameters]):
    """`points` -> valid points in `target_frame`, cropped and thinned -> `cloud`, and the plane -> `support_plane`."""

    table = PreprocessorParameters

    def __init__(self, **kwargs: Any) -> None:
        self._taker: Taker | None = None
        self._pace, self._reader = Pace(), CloudReader()
        super().__init__("preprocessor", awaits="clouds on the topic 'points'", **kwargs)

    def hand_to(self, taker: Taker | None) -> None:
        """Give clouds to a node of this process as they are, without a message; None: to nobody any more."""
        self._taker = taker

    def configure(self) -> None:
        """Have all code ready, then create the topics."""
        with self.busy:
            _warm_up()
        self._last_plane = -math.inf
        self._asking = self.resolve_topic_name(NEXT_CLOUD)
        requests = self.create_subscription(
            Duration, NEXT_CLOUD, self._on_request, OUTPUT_QOS, callback_group=self.input_group
        )
        self.at_cleanup(lambda: self.destroy_subscription(requests))
        self._frames = SensorFrames(self)
        self.at_cleanup(self._frames.close)
        self._cloud = self.add_publisher(PointCloud2, "cloud")
        self._plane = self.add_publisher(Marker, "support_plane", LATCHED_QOS)
        source = self.add_input(PointCloud2, "points", self.settings.input_reliability, serialized=True)
        self.health.awaits = lambda: f"clouds on {source.description}"

    def pause(self) -> float:
        """Let the next cloud, the newest by then, be ready when a detector asks for it."""
        if not self.settings.keep_pace or (self._taker is None and self.count_publishers(self._asking) == 0):
            return 0.0
        return self._pace.pause(time.monotonic())

    def want(self, seconds: float) -> None:
        """Have a cloud ready in so many seconds."""
        self._pace.wanted(time.monotonic() + seconds)

    def _on_request(self, message: Duration) -> None:
        self.want(message.sec + 1e-9 * message.nanosec)

    def work(self, item: bytes) -> None:
        """Prepare one cloud, which is serialized."""
        self._pace.begun(time.monotonic())
        try:
            self._prepare(item, self.settings)
        except Exception:
            self._pace.failed()  # nobody will ask again
            raise

    def _prepare(self, item: bytes, settings: PreprocessorParameters) -> None:
        start = time.perf_counter()
        received = self._reader.read(item)
        given, decoded = received.header, received.decode()
        T_target_cloud = self._frames.pose(
            given, settings.target_frame, settings.sensor_pose, settings.transform_patience
        )
        converted = time.perf_counter()
        with self.busy:
            result = preprocess(decoded.points, decoded.colors, T_target_cloud, settings.config)
        prepared = time.perf_counter()
        header = Header(stamp=given.stamp, frame_id=settings.target_frame)
        cloud = PreparedCloud(header, result.points, result.colors)
        taker = self._taker  # the detector may be cleaned up meanwhile
        if taker is None:
            self._cloud.publish(cloud_to_message(*cloud))
        else:
            taker(cloud)
            publish_if_heard(self._cloud, lambda: cloud_to_message(*cloud))
        self._pace.sent(time.monotonic())
        published = time.perf_counter()
        stages = {
            "convert": converted - start,
            "prepare": prepared - converted,
            "publish": published - prepared,
            "total": published - start,
        }
        steps = list(result.steps)
        # Nobody waits for the plane: the detector is at work already.
        if self._plane.get_subscription_count() > 0 or published - self._last_plane >= _UNHEARD_PLANE:
            self._last_plane = published
            with self.busy:
                plane, step = _support_plane(result.points, settings.config.seed)
            self._plane.publish(plane_marker(header, plane, result.points))
            stages["support plane"] = time.perf_counter() - published
            steps.append(step)
        unstamped = given.stamp.sec == 0 and given.stamp.nanosec == 0
        self.done(
            stages,
            steps,
            {"points": len(result.points)},
            result.reason or (ZERO_STAMP if unstamped else ""),
        )


def _warm_up() -> None:
    """Prepare a cloud in either usual layout, as all that is compiled or loaded for one of them takes time at first."""
    points = made_up_cloud()
    for colors in (None, np.zeros(points.shape, np.uint8)):
        cloud = CloudReader().read(serialize_message(cloud_to_message(Header(), points, colors))).decode()
        result = preprocess(cloud.points, cloud.colors, np.eye(4), PreprocessingConfig(max_points=len(points) // 2))
    _support_plane(result.points, 0)


def _support_plane(points: npt.NDArray[np.float32], seed: int) -> tuple[Plane | None, StepReport]:
    recorder = StepRecorder()
    with recorder.step("support plane") as step:
        plane = fit_support_plane(points, np.random.default_rng(seed))
        step.kept = int(plane is not None)
    return plane, recorder.steps[0]


def main(args: list[str] | None = None) -> int:
    """Run the node; the exit code of the process."""
    return run(lambda: [Preprocessor()], args)


if __name__ == "__main__":
    sys.exit(main())
