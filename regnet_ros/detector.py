"""The node `detector`: from a cloud in a gravity-aligned frame to ranked grasps."""

from __future__ import annotations

import sys
import time
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseArray
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from regnet_msgs.msg import GraspArray
from regnet_msgs.srv import DetectGrasps
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from regnet_core.detector import Detection, DetectorConfig, GraspDetector
from regnet_core.errors import CloudError, InvalidInputError, ModelError
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.report import DetectionReport
from regnet_ros.conversions import (
    cloud_from_message,
    grasp_array,
    gripper_from_message,
    pose_array,
)
from regnet_ros.detection_process import DetectionProcesses, ProcessEndedError, RemoteDetector
from regnet_ros.inputs import NEXT_CLOUD
from regnet_ros.node import GraspNode, publish_if_heard
from regnet_ros.pace import Lead, Usual
from regnet_ros.preprocessor import PreparedCloud, Preprocessor
from regnet_ros.process import run
from regnet_ros.received_cloud import CloudReader, ReceivedCloud
from regnet_ros.serialized_grasps import serialized_grasp_array
from regnet_ros.settings import DetectorParameters
from regnet_ros.threads import usable_cores, use_threads
from regnet_ros.visuals import grasp_markers
from regnet_ros.warm_up import made_up_clouds

_EARLY = 0.75
"""Where a detection takes less than this share of the usual time, another cloud is asked for at its end."""


class _Again(NamedTuple):
    """The last cloud, to be worked on with changed parameters."""

    cloud: ReceivedCloud | PreparedCloud


class Detector(GraspNode[DetectorParameters]):
    """`cloud` -> `grasps`, `grasp_poses`, `grasp_markers`; service `detect_grasps`."""

    table = DetectorParameters

    def __init__(self, source: Preprocessor | None = None, **kwargs: Any) -> None:
        """Args:
        source: a node of this process whose clouds are worked on instead of those of the topic `cloud`.
        kwargs: of ``rclpy.node.Node``.
        """
        self._source = source
        self._processes: DetectionProcesses | None = None
        self._detectors: dict[tuple[object, ...], GraspDetector | RemoteDetector] = {}
        self._warm: set[tuple[str, str]] = set()
        self._in_use = ("", "")
        self._last_cloud: ReceivedCloud | PreparedCloud | None = None
        self._usual, self._lead = Usual(), Lead()
        self._reader = CloudReader()
        super().__init__("detector", awaits="clouds on the topic 'cloud'", **kwargs)
        threads, count = self.settings.threads or usable_cores(), self.settings.at_a_time
        if count == 1:
            use_threads(self.settings.threads)
        else:
            self._processes = DetectionProcesses(count, threads)
            use_threads(max(threads - count, 1))

    def destroy_node(self) -> None:
        """End the work and release everything (rclpy's method)."""
        try:
            super().destroy_node()
        finally:
            if self._processes is not None:
                self._processes.end()

    def at_a_time(self) -> int:
        """As many as the parameters say."""
        return self.settings.at_a_time

    def configure(self) -> None:
        """Make the detector ready to run, then create the topics and the service."""
        settings = self.settings
        detector = self._detector_for(settings)
        with self.busy:
            self._warm_up(detector, settings)
            serialized_grasp_array(Header(), Grasps.empty(), settings.gripper, DetectionReport((), "", ""))
        self._announce(detector)
        self._grasps = self.add_publisher(GraspArray, "grasps")
        self._poses = self.add_publisher(PoseArray, "grasp_poses")
        self._markers = self.add_publisher(MarkerArray, "grasp_markers")
        self.add_service(DetectGrasps, "detect_grasps", self._on_detect)
        self._listen(settings)
        self.at_cleanup(self._forget)

    def _listen(self, settings: DetectorParameters) -> None:
        source = self._source
        if source is not None:
            source.hand_to(self.receive)
            self.at_cleanup(lambda: source.hand_to(None))
            self.health.awaits = lambda: f"clouds of {source.get_fully_qualified_name()}"
            return
        self._requests = self.add_publisher(Duration, NEXT_CLOUD)
        topic = self.add_input(PointCloud2, "cloud", settings.input_reliability, serialized=True)
        self.health.awaits = lambda: f"clouds on {topic.description}"

    def check_settings(self, proposed: DetectorParameters) -> None:
        """Refuse a model or device that cannot be had; make another one ready while the present one works on."""
        detector = self._detector_for(proposed)
        if self.state_label in ("inactive", "active"):
            self._warm_up(detector, proposed)

    def settings_changed(self, old: DetectorParameters) -> None:
        """Say which model is in use now, and detect again in the last cloud, where that is wanted."""
        detector = self._detector_for(self.settings)
        if self._in_use not in (("", ""), (detector.model, detector.device)):
            self._announce(detector)
        if self.settings.redetect_on_change and self._last_cloud is not None and not self.settings.same_result(old):
            self.repeat(_Again(self._last_cloud))

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work, and ask for a cloud (rclpy's hook)."""
        result = super().on_activate(state)
        self._ask(0.0)
        return result

    def work(self, item: bytes | PreparedCloud | _Again) -> None:
        """Find grasps in one cloud, serialized or not; whatever it is like, one GraspArray is published.

        Raises:
            CloudError: the bytes are no cloud.
        """
        start, expected = time.perf_counter(), self._usual.seconds
        again = isinstance(item, _Again)
        if isinstance(item, bytes):
            cloud: ReceivedCloud | PreparedCloud = self._read(item)
        else:
            cloud = item.cloud if isinstance(item, _Again) else item
        self._last_cloud = cloud
        if expected is not None:
            if not again:
                self._lead.add(self.workers.late(expected), expected)
            self._ask(self.workers.free_at(expected) - time.monotonic() - self._lead.seconds)
        try:
            self._answer(cloud, self.settings, start)
        finally:
            seconds = time.perf_counter() - start
            self._usual.add(seconds)
            if expected is None or seconds < _EARLY * expected:
                self._ask(0.0, seconds)

    def _read(self, data: bytes) -> ReceivedCloud:
        try:
            return self._reader.read(data)
        except CloudError:
            self._ask(0.0)
            raise

    def _ask(self, seconds: float, since_start: float = 0.0) -> None:
        """Ask for another cloud in so many seconds, or when the parameters allow the next work."""
        left = max(seconds, self.settings.least_period - since_start, 0.0)
        if self._source is not None:
            self._source.want(left)
        else:
            self._requests.publish(Duration(sec=int(left), nanosec=int(1e9 * (left % 1.0))))

    def _answer(self, cloud: ReceivedCloud | PreparedCloud, settings: DetectorParameters, start: float) -> None:
        try:
            detection, seconds = self._detect(cloud, settings, settings.gripper)
        except (InvalidInputError, ProcessEndedError) as error:
            self.workers.await_turn()
            self._publish(cloud.header, self._nothing(settings.gripper, str(error)), settings.max_markers)
            raise
        self.workers.await_turn()
        found = time.perf_counter()
        self._publish(cloud.header, detection, settings.max_markers)
        end = time.perf_counter()
        report = detection.report
        self.done(
            {"convert": seconds, "detect": report.total_seconds, "publish": end - found, "total": end - start},
            report.steps,
            {"grasps": len(detection.grasps)},
            "; ".join(filter(None, [report.reason, *report.warnings])),
        )

    def _detect(
        self, cloud: PointCloud2 | ReceivedCloud | PreparedCloud, settings: DetectorParameters, gripper: Gripper
    ) -> tuple[Detection, float]:
        """The detection, and the seconds that decoding the message took."""
        _check_frame(cloud.header, settings.target_frame)
        start = time.perf_counter()
        if isinstance(cloud, PreparedCloud):
            points, colors = cloud.points, cloud.colors
        else:
            view, colors = cloud.decode() if isinstance(cloud, ReceivedCloud) else cloud_from_message(cloud)
            points = np.array(view)  # in the layout that all is compiled for
        seconds = time.perf_counter() - start
        viewpoint = np.array(settings.viewpoint) if settings.viewpoint else None
        with self.busy:
            detection = self._detector_for(settings).detect(
                points, gripper, colors, filters=settings.filters, viewpoint=viewpoint
            )
        return detection, seconds

    def _publish(self, header: Header, detection: Detection, max_markers: int) -> None:
        self._grasps.publish(serialized_grasp_array(header, detection.grasps, detection.gripper, detection.report))
        publish_if_heard(self._poses, lambda: pose_array(header, detection.grasps))
        publish_if_heard(self._markers, lambda: grasp_markers(header, detection.grasps, detection.gripper, max_markers))

    def _on_detect(self, request: DetectGrasps.Request, response: DetectGrasps.Response) -> DetectGrasps.Response:
        settings = self.settings
        if not self.active:
            response.message = f"the detector is {self.state_label}; it answers once it is activated"
            return response
        try:
            gripper = gripper_from_message(request.gripper) if request.use_gripper else settings.gripper
            detection, _ = self._detect(request.cloud, settings, gripper)
        except (InvalidInputError, ProcessEndedError) as error:
            response.message = str(error)
            return response
        response.success = True
        response.grasps = grasp_array(request.cloud.header, detection.grasps, detection.gripper, detection.report)
        return response

    def _detector_for(self, settings: DetectorParameters) -> GraspDetector | RemoteDetector:
        key = _key(settings)
        detector = self._detectors.get(key)
        if detector is None:
            config = DetectorConfig(max_grasps=settings.max_grasps)
            make = GraspDetector if self._processes is None else self._processes.detector
            detector = make(settings.model, settings.device, settings.seed, config)
            # While another one is made ready, work still asks for the present one.
            present = {k: d for k, d in self._detectors.items() if k == _key(self.settings)}
            self._detectors = {**present, key: detector}
        return detector

    def _warm_up(self, detector: GraspDetector | RemoteDetector, settings: DetectorParameters) -> None:
        """Detect once in each process, unless the model already did so.

        Raises:
            ModelError: the model cannot run on its device.
        """
        wanted = (detector.model, detector.device)
        if wanted in self._warm or not settings.warm_up:
            return
        start = time.perf_counter()
        try:
            for points in made_up_clouds():
                given, colors = points.astype(np.float32), np.full(points.shape, 128, np.uint8)
                if isinstance(detector, RemoteDetector):
                    detector.warm_up(given, settings.gripper, colors)
                else:
                    detector.detect(given, settings.gripper, colors)
        except RuntimeError as error:
            raise ModelError(f"model '{detector.model}' does not run on '{detector.device}': {error}") from error
        self._warm.add(wanted)
        self.get_logger().info(f"warm-up of {detector.model} took {time.perf_counter() - start:.1f} s")

    def _announce(self, detector: GraspDetector | RemoteDetector) -> None:
        self._in_use = detector.model, detector.device
        self.health.facts = {"model": detector.model, "device": detector.device}
        self.get_logger().info(f"model {detector.model} on {detector.device}")

    def _nothing(self, gripper: Gripper, reason: str) -> Detection:
        return Detection(Grasps.empty(), DetectionReport((), *self._in_use, reason), gripper, None)

    def _forget(self) -> None:
        self._last_cloud = None


def _key(settings: DetectorParameters) -> tuple[object, ...]:
    """What a detector is made of."""
    return settings.model, settings.device, settings.seed, settings.max_grasps


def _check_frame(header: Header, target_frame: str) -> None:
    frame = header.frame_id.lstrip("/")
    if not frame:
        raise CloudError("the cloud has no frame_id: name the gravity-aligned frame (z up) that its points are in")
    if target_frame and frame != target_frame.lstrip("/"):
        raise CloudError(
            f"the cloud is in frame '{frame}', but the parameter target_frame asks for '{target_frame}': let the "
            "preprocessor transform it, or change target_frame"
        )


def main(args: list[str] | None = None) -> int:
    """Run the node; the exit code of the process."""
    return run(lambda: [Detector()], args)


if __name__ == "__main__":
    sys.exit(main())
