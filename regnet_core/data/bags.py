"""Writes rosbag2 folders (metadata.yaml and one .mcap, zstd) of depth-camera clouds without needing ROS.

The message definitions are embedded, so that rosbag2, Foxglove, `mcap` and `rosbags` all read them.
"""

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from regnet_core.data.cameras.camera import Intrinsics

ROSBAG2_VERSION: Literal[9] = 9
"""Of metadata.yaml: the one that ROS 2 Jazzy writes."""
POINTS_TOPIC = "/camera/depth/points"
INFO_TOPIC = "/camera/depth/camera_info"
STATIC_TOPIC = "/tf_static"
_FLOAT32 = 7  # sensor_msgs/msg/PointField.FLOAT32
_STORE = get_typestore(Stores.ROS2_JAZZY)


def pack_rgb(colours: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(N, 3) red, green, blue as PCL's packed float32: the bits are 0x00RRGGBB."""
    wide = colours.astype(np.uint32)
    return ((wide[:, 0] << 16) | (wide[:, 1] << 8) | wide[:, 2]).astype(np.uint32).view(np.float32)


class CloudBagWriter:
    """A bag under construction; use it as a context manager.

    Every method takes the stamp of its message in nanoseconds, which is also the time it was recorded at.
    """

    def __init__(self, path: Path | str) -> None:
        """Args: the folder to create; it must not exist (WriterError otherwise)."""
        self._writer = Writer(path, version=ROSBAG2_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def write_cloud(
        self,
        stamp: int,
        frame_id: str,
        points: NDArray[np.floating[Any]],
        colours: NDArray[np.uint8] | None = None,
    ) -> None:
        """Writes a PointCloud2.

        Args:
            stamp: [ns].
            frame_id: frame of the points.
            points: (N, 3) for an unorganised or (H, W, 3) for an organised cloud [m]; stored as float32.
            colours: (..., 3) in the shape of the points; the cloud has no rgb field when None.
        """
        height, width = points.shape[:-1] if points.ndim == 3 else (1, len(points))
        columns = [points.reshape(-1, 3).astype(np.float32)]
        names = ["x", "y", "z"]
        if colours is not None:
            columns.append(pack_rgb(colours.reshape(-1, 3))[:, None])
            names.append("rgb")
        data = np.concatenate(columns, axis=1)
        types = _STORE.types
        field = types["sensor_msgs/msg/PointField"]
        step = 4 * len(names)
        message = types["sensor_msgs/msg/PointCloud2"](
            header=_header(stamp, frame_id),
            height=height,
            width=width,
            fields=[field(name=name, offset=4 * i, datatype=_FLOAT32, count=1) for i, name in enumerate(names)],
            is_bigendian=False,
            point_step=step,
            row_step=step * width,
            data=data.reshape(-1).view(np.uint8),
            is_dense=bool(np.isfinite(columns[0]).all()),
        )
        self._write(POINTS_TOPIC, message, stamp, _qos(depth=5))

    def write_camera_info(self, stamp: int, frame_id: str, intrinsics: Intrinsics) -> None:
        """Writes the intrinsics of the camera whose optical frame is `frame_id`, without distortion."""
        types = _STORE.types
        k = intrinsics.matrix
        message = types["sensor_msgs/msg/CameraInfo"](
            header=_header(stamp, frame_id),
            height=intrinsics.height,
            width=intrinsics.width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=k.reshape(-1),
            r=np.eye(3).reshape(-1),
            p=np.concatenate([k, np.zeros((3, 1))], axis=1).reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
        )
        self._write(INFO_TOPIC, message, stamp, _qos(depth=5))

    def write_static_transforms(self, stamp: int, transforms: Sequence[tuple[str, str, NDArray[np.float64]]]) -> None:
        """Writes (parent frame, child frame, T_parent_child (4, 4)) as one message with latched QoS."""
        types = _STORE.types
        message = types["tf2_msgs/msg/TFMessage"](
            transforms=[
                types["geometry_msgs/msg/TransformStamped"](
                    header=_header(stamp, parent), child_frame_id=child, transform=_transform(T)
                )
                for parent, child, T in transforms
            ]
        )
        self._write(STATIC_TOPIC, message, stamp, _qos(depth=1, latched=True))

    def _write(self, topic: str, message: Any, stamp: int, qos: Qos) -> None:
        name = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, name, typestore=_STORE, offered_qos_profiles=[qos]
            )
        self._writer.write(self._connections[topic], stamp, _STORE.serialize_cdr(message, name))


def _header(stamp: int, frame_id: str) -> Any:
    types = _STORE.types
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def _transform(T: NDArray[np.float64]) -> Any:
    types = _STORE.types
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    px, py, pz = T[:3, 3].tolist()
    return types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](x=px, y=py, z=pz),
        rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )


def _qos(depth: int, latched: bool = False) -> Qos:
    unlimited = QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE, as rosbag2 records it
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=unlimited,
        lifespan=unlimited,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=unlimited,
        avoid_ros_namespace_conventions=False,
    )
