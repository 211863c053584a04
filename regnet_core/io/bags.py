"""Point clouds from MCAP bags of ROS 2, decoded by the schema that the bag carries; no ROS needed."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.reader import McapReader
from mcap_ros2.decoder import DecoderFactory

from regnet_core.errors import CloudError
from regnet_core.geometry import Array
from regnet_core.io.mcap_files import bag_files, is_mcap, open_mcap
from regnet_core.io.pointcloud2 import Colors, decode_cloud
from regnet_core.io.transforms import FrameTree

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
_TF_TYPE = "tf2_msgs/msg/TFMessage"
_STATIC_TOPIC, _DYNAMIC_TOPIC = "/tf_static", "/tf"


class BagCloud(NamedTuple):
    """One PointCloud2 message."""

    topic: str
    stamp_ns: int
    """The header's stamp [ns]."""
    frame_id: str
    points: npt.NDArray[np.floating[Any]]
    """(N, 3) in ``frame_id`` [m], row by row, NaN where the camera saw nothing."""
    colors: Colors | None
    """(N, 3) red, green, blue in 0..255."""
    T_root_cloud: Array | None
    """(4, 4): the pose of ``frame_id`` in ``root_frame``; None when the bag has no transform of this frame."""
    root_frame: str
    """The root of the bag's transforms; ``frame_id`` when there are none of it."""


class _Message(NamedTuple):
    topic: str
    type_name: str
    content: Any
    """The fields of the message as attributes."""


def is_bag(path: str | Path) -> bool:
    """Whether the path is meant as a bag: a folder, or a file that ends in .mcap."""
    return Path(path).is_dir() or is_mcap(Path(path))


def cloud_topics(path: str | Path) -> dict[str, int]:
    """The PointCloud2 topics of a bag, by name, and how many messages each has.

    Raises:
        CloudError: the path is no readable bag.
    """
    counts: dict[str, int] = {}
    for file in bag_files(Path(path)):
        with open_mcap(file) as reader:
            for topic, count in _count(reader).items():
                counts[topic] = counts.get(topic, 0) + count
    return dict(sorted(counts.items()))


def read_bag_clouds(path: str | Path, topic: str | None = None) -> Iterator[BagCloud]:
    """The PointCloud2 messages of an MCAP file or of a bag folder, in the order in which they were recorded.

    ``/tf_static`` is read first, ``/tf`` as it comes (the newest transform before the cloud counts), so that each cloud
    says where its frame is in the root of the frames.

    Args:
        path: an .mcap file, or a folder of them (rosbag2's layout: metadata.yaml gives their order).
        topic: only this topic; all PointCloud2 topics otherwise.

    Raises:
        CloudError: the path is no readable bag, it has no cloud on the topic, or a message cannot be decoded.
    """
    counts = cloud_topics(path)
    wanted = [name for name, count in counts.items() if count and topic in (None, name)]
    if not wanted:
        raise CloudError(_nothing_found(Path(path), topic, counts))
    return _read_clouds(bag_files(Path(path)), wanted)


def _read_clouds(files: list[Path], topics: list[str]) -> Iterator[BagCloud]:
    tree = FrameTree()
    for file in files:
        with open_mcap(file) as reader:
            for message in _messages(reader, [_STATIC_TOPIC]):
                _add_transforms(message, tree)
    for file in files:
        with open_mcap(file) as reader:
            for message in _messages(reader, [*topics, _DYNAMIC_TOPIC]):
                if message.type_name == _TF_TYPE:
                    _add_transforms(message, tree)
                elif message.type_name == CLOUD_TYPE:
                    yield _decode(message, tree)


def _decode(message: _Message, tree: FrameTree) -> BagCloud:
    content = message.content
    try:
        points, colors = decode_cloud(
            content.fields,
            content.width,
            content.height,
            content.point_step,
            content.row_step,
            content.is_bigendian,
            content.data,
        )
    except CloudError as error:
        raise CloudError(f"a message on {message.topic}: {error}") from error
    frame, stamp = content.header.frame_id, content.header.stamp
    pose = tree.to_root(frame)
    return BagCloud(
        topic=message.topic,
        stamp_ns=stamp.sec * 10**9 + stamp.nanosec,
        frame_id=frame,
        points=points.copy(),  # the user may change them
        colors=colors,
        T_root_cloud=pose.T_root_frame if pose else None,
        root_frame=pose.root if pose else frame,
    )


def _add_transforms(message: _Message, tree: FrameTree) -> None:
    for stamped in message.content.transforms:
        move, turn = stamped.transform.translation, stamped.transform.rotation
        tree.add(
            stamped.header.frame_id,
            stamped.child_frame_id,
            (move.x, move.y, move.z),
            (turn.x, turn.y, turn.z, turn.w),
        )


def _count(reader: McapReader) -> dict[str, int]:
    """Messages on each PointCloud2 topic: from the file's index where it has one, by reading it through otherwise."""
    summary = reader.get_summary()
    counts: dict[str, int] = {}
    if summary is not None and summary.statistics is not None and summary.channels:
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            if schema is not None and schema.name == CLOUD_TYPE:
                number = summary.statistics.channel_message_counts.get(channel.id, 0)
                counts[channel.topic] = counts.get(channel.topic, 0) + number
        return counts
    for schema, channel, _ in reader.iter_messages():
        if schema is not None and schema.name == CLOUD_TYPE:
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
    return counts


def _messages(reader: McapReader, topics: Collection[str]) -> Iterator[_Message]:
    factory = DecoderFactory()
    for schema, channel, message in reader.iter_messages(topics):
        if schema is None or schema.name not in (CLOUD_TYPE, _TF_TYPE):
            continue
        decode = factory.decoder_for(channel.message_encoding, schema)
        if decode is None:
            raise CloudError(
                f"{channel.topic} has '{channel.message_encoding}' messages and a '{schema.encoding}' schema; only ROS "
                "2 bags with 'cdr' messages and 'ros2msg' schemas can be read"
            )
        yield _Message(channel.topic, schema.name, decode(message.data))


def _nothing_found(path: Path, topic: str | None, counts: dict[str, int]) -> str:
    if not counts:
        return f"the bag '{path}' has no topic of type {CLOUD_TYPE}"
    listed = ", ".join(f"{name} ({count})" for name, count in counts.items())
    if topic is None:
        return f"the bag '{path}' has no point cloud; its topics are: {listed}"
    return f"the bag '{path}' has no point cloud on '{topic}'; its topics are: {listed}"
