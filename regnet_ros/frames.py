"""Where a cloud's frame is in the target frame: from a parameter, or from tf2 where it is installed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Header

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, pose_matrix
from regnet_ros.conversions import transform_matrix

_ADVICE = (
    "publish that transform (`ros2 run tf2_ros static_transform_publisher` for a fixed camera), or set the parameter "
    "sensor_pose: [x, y, z, roll, pitch, yaw] of the cloud's frame in the target frame"
)
_ADVICE_WITHOUT_TF = (
    "tf2 is not installed here: set the parameter sensor_pose: [x, y, z, roll, pitch, yaw] of the cloud's frame in the "
    "target frame, in metres and radians, or set target_frame to the cloud's frame if its z axis points up"
)


class FrameError(InvalidInputError):
    """It is not known where a frame is."""


class SensorFrames:
    """Poses of sensor frames in the target frame."""

    def __init__(self, node: Node, buffer: Any = None) -> None:
        """Listen to transforms; ``buffer`` replaces the tf2 buffer that is made where tf2 is installed."""
        self._buffer: Any = buffer
        self._listener: Any = None
        if buffer is None:
            self._buffer, self._listener = _listen(node)

    @property
    def knows_tf(self) -> bool:
        """Whether tf2 is there."""
        return self._buffer is not None

    def close(self) -> None:
        """Stop listening."""
        if self._listener is not None:
            self._listener.unregister()

    def pose(self, header: Header, target_frame: str, sensor_pose: Sequence[float], patience: float) -> Array:
        """T_target_cloud (4, 4) of a cloud.

        The cloud's own frame needs no transform; otherwise ``sensor_pose`` counts where it is given, then tf2.

        Args:
            header: the cloud's stamp and frame.
            target_frame: the gravity-aligned frame.
            sensor_pose: x, y, z [m], roll, pitch, yaw [rad] of the cloud's frame in the target frame, or nothing.
            patience: how long to wait for a transform [s].

        Raises:
            FrameError: the pose is not known; the text says what to set or publish.
        """
        frame = header.frame_id.lstrip("/")
        if frame == target_frame.lstrip("/"):
            return np.eye(4)
        if len(sensor_pose) > 0:
            return _pose(tuple(sensor_pose))
        if not frame:
            raise FrameError(
                "the cloud has no frame_id, so it is not known where the camera is: set the frame in the camera's "
                f"driver, or set the parameter sensor_pose to the camera's pose in '{target_frame}'"
            )
        if self._buffer is None:
            raise FrameError(f"the cloud is in frame '{frame}', not in '{target_frame}', and {_ADVICE_WITHOUT_TF}")
        try:
            stamped = self._buffer.lookup_transform(
                target_frame, frame, Time.from_msg(header.stamp), timeout=Duration(seconds=patience)
            )
        except Exception as error:  # tf2's exceptions have no common base that is importable without it
            raise FrameError(f"no transform from '{frame}' to '{target_frame}' ({error}): {_ADVICE}") from error
        return transform_matrix(stamped.transform)


@lru_cache(maxsize=1)
def _pose(pose: tuple[float, ...]) -> Array:
    """That of every cloud of a camera that does not move."""
    matrix = pose_matrix(pose[:3], pose[3:])
    matrix.flags.writeable = False
    return matrix


def _listen(node: Node) -> tuple[Any, Any]:
    """A tf2 buffer with its listener; nothing where tf2 is not installed, as in an installation from wheels."""
    try:
        from tf2_ros import Buffer, TransformListener
    except ImportError:
        return None, None
    buffer = Buffer()
    return buffer, TransformListener(buffer, node, spin_thread=False)
