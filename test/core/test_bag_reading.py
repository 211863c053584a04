"""Point clouds and transforms from bags that rosbags and mcap wrote."""

from pathlib import Path

import mcap.reader
import mcap.writer
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from regnet_core import CloudError
from regnet_core.geometry import transform_points
from regnet_core.io.bags import cloud_topics, is_bag, read_bag_clouds
from regnet_core.io.pointcloud2 import encode_cloud
from regnet_core.io.transforms import FrameTree

POINTS = np.array([[0.1, -0.2, 0.75], [np.nan, 0.0, 0.8], [1.5, 2.5, -3.5], [0.25, 0.5, 1.0]], np.float32)
COLORS = np.array([[255, 0, 1]], np.uint8)


# Frames


def test_transforms_chain_up_to_the_root():
    tree = FrameTree()
    half = np.sqrt(0.5)
    tree.add("map", "base", (1.0, 2.0, 0.0), (0.0, 0.0, half, half))  # base's x is map's y
    tree.add("/base", "camera", (0.5, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))  # camera looks down
    root, pose = tree.to_root("camera")
    assert root == "map"
    np.testing.assert_allclose(transform_points(pose, [[0.0, 0.0, 1.0]]), [[1.0, 2.5, 0.0]], atol=1e-12)
    assert tree.to_root("map").root == "map"
    assert tree.to_root("nowhere") is None


def test_a_circle_of_frames_and_a_transform_that_is_no_pose_are_refused():
    tree = FrameTree()
    tree.add("a", "b", (0, 0, 0), (0, 0, 0, 1))
    tree.add("b", "a", (0, 0, 0), (0, 0, 0, 1))
    with pytest.raises(CloudError, match="circle"):
        tree.to_root("a")
    with pytest.raises(CloudError, match="not a pose"):
        tree.add("a", "c", (0, 0, 0), (0, 0, 0, 0))


# Bags

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types


def header(frame: str, seconds: int) -> object:
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](seconds, 5), frame)


def cloud_message(frame: str, seconds: int, points: np.ndarray, cut: int = 0) -> object:
    fields, step, data = encode_cloud(points, np.tile(COLORS, (len(points), 1)))
    field = TYPES["sensor_msgs/msg/PointField"]
    return TYPES["sensor_msgs/msg/PointCloud2"](
        header(frame, seconds),
        1,
        len(points),
        [field(f.name, f.offset, f.datatype, f.count) for f in fields],
        False,
        step,
        step * len(points),
        np.frombuffer(data, np.uint8)[: len(data) - cut],
        True,
    )


def tf_message(parent: str, child: str, xyz: tuple[float, ...]) -> object:
    transform = TYPES["geometry_msgs/msg/Transform"](
        TYPES["geometry_msgs/msg/Vector3"](*xyz), TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    )
    stamped = TYPES["geometry_msgs/msg/TransformStamped"](header(parent, 0), child, transform)
    return TYPES["tf2_msgs/msg/TFMessage"]([stamped])


def write_bag(path: Path, messages: list[tuple[str, object]]) -> Path:
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for number, (topic, message) in enumerate(messages):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=STORE)
            writer.write(connections[topic], number * 1000, STORE.serialize_cdr(message, name))
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    messages = [
        ("/tf", tf_message("map", "base", (0.0, 0.0, 1.0))),
        ("/a", cloud_message("camera", 10, POINTS)),
        ("/tf", tf_message("map", "base", (5.0, 0.0, 1.0))),
        ("/b", cloud_message("elsewhere", 11, POINTS[:2])),
        ("/a", cloud_message("/camera", 12, POINTS[2:])),
        ("/tf_static", tf_message("base", "camera", (0.0, 0.5, 0.0))),
    ]
    return write_bag(tmp_path_factory.mktemp("bags") / "bag", messages)


def test_clouds_of_a_bag_come_in_order_with_stamp_frame_and_pose_in_the_root(bag):
    assert is_bag(bag)
    assert cloud_topics(bag) == {"/a": 2, "/b": 1}
    first, second, third = read_bag_clouds(bag)
    assert [c.topic for c in (first, second, third)] == ["/a", "/b", "/a"]
    assert (first.stamp_ns, first.frame_id, first.root_frame) == (10_000_000_005, "camera", "map")
    np.testing.assert_array_equal(first.points, POINTS)
    np.testing.assert_array_equal(first.colors, np.tile(COLORS, (4, 1)))
    np.testing.assert_allclose(first.T_root_cloud[:3, 3], (0.0, 0.5, 1.0))
    assert (second.T_root_cloud, second.root_frame) == (None, "elsewhere")
    np.testing.assert_allclose(third.T_root_cloud[:3, 3], (5.0, 0.5, 1.0))


def test_one_topic_and_a_single_file_of_the_bag_can_be_read(bag):
    file = next(bag.glob("*.mcap"))
    assert is_bag(file)
    assert [c.topic for c in read_bag_clouds(file, "/b")] == ["/b"]


def test_a_bag_that_cannot_be_used_says_why(bag, tmp_path):
    with pytest.raises(CloudError, match=r"no point cloud on '/c'; its topics are: /a \(2\), /b \(1\)"):
        read_bag_clouds(bag, "/c")
    with pytest.raises(CloudError, match="there is no bag"):
        read_bag_clouds(tmp_path / "missing")
    with pytest.raises(CloudError, match=r"holds no .mcap file \(it holds nothing\)"):
        read_bag_clouds(tmp_path)
    (tmp_path / "data.db3").write_bytes(b"")
    with pytest.raises(CloudError, match=r"it holds .db3.*ros2 bag convert"):
        read_bag_clouds(tmp_path)
    only_tf = write_bag(tmp_path / "tf", [("/tf", tf_message("a", "b", (0.0, 0.0, 0.0)))])
    with pytest.raises(CloudError, match="no topic of type sensor_msgs/msg/PointCloud2"):
        read_bag_clouds(only_tf)


def test_damaged_bags_are_refused_by_name(bag, tmp_path):
    whole = next(bag.glob("*.mcap")).read_bytes()
    for name, content in {"cut": whole[: len(whole) // 2], "empty": b"", "text": b"not a bag at all" * 9}.items():
        file = tmp_path / f"{name}.mcap"
        file.write_bytes(content)
        with pytest.raises(CloudError, match=f"{name}.mcap' cannot be read as an MCAP file"):
            list(read_bag_clouds(file))
    broken = write_bag(tmp_path / "broken", [("/a", cloud_message("map", 1, POINTS, cut=3))])
    with pytest.raises(CloudError, match="a message on /a: data is truncated"):
        list(read_bag_clouds(broken))
    (broken / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [gone.mcap]}")
    with pytest.raises(CloudError, match="lacks gone"):
        read_bag_clouds(broken)


def test_a_metadata_file_that_is_none_is_named_in_one_line(bag, tmp_path):
    for content, message in {
        "a: [1, 2\nb: 3\n": r"metadata.yaml' is not valid YAML: .* in line 2$",
        "other: 1\n": "has no list rosbag2_bagfile_information, relative_file_paths",
        "": "has no list",
        "rosbag2_bagfile_information: {relative_file_paths: a.mcap}": "has no list",
        "a: \0": "is not a text file",
    }.items():
        (tmp_path / "metadata.yaml").write_text(content)
        with pytest.raises(CloudError, match=message) as caught:
            cloud_topics(tmp_path)
        assert "\n" not in str(caught.value) and "Mark" not in str(caught.value)


def test_the_case_of_the_suffix_does_not_matter(bag, tmp_path):
    content = next(bag.glob("*.mcap")).read_bytes()
    (tmp_path / "CLOUDS.MCAP").write_bytes(content)
    assert is_bag(tmp_path / "CLOUDS.MCAP")
    assert cloud_topics(tmp_path / "CLOUDS.MCAP") == cloud_topics(tmp_path) == cloud_topics(bag)


def rewritten(bag: Path, target: Path, encoding: str = "ros2msg", **settings: object) -> Path:
    """The bag's messages in a new file, with other schema encodings or other settings of the writer."""
    with next(bag.glob("*.mcap")).open("rb") as source, target.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **settings)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in mcap.reader.make_reader(source).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


def test_a_bag_without_any_index_is_read_through(bag, tmp_path):
    bare = {"use_chunking": False, "use_statistics": False, "use_summary_offsets": False, "repeat_channels": False}
    file = rewritten(bag, tmp_path / "bare.mcap", index_types=mcap.writer.IndexType.NONE, **bare)
    assert cloud_topics(file) == {"/a": 2, "/b": 1}
    poses = [cloud.T_root_cloud for cloud in read_bag_clouds(file, "/a")]
    np.testing.assert_allclose([pose[:3, 3] for pose in poses], [(0.0, 0.5, 1.0), (5.0, 0.5, 1.0)])


def test_a_schema_that_cannot_be_decoded_is_named(bag, tmp_path):
    with pytest.raises(CloudError, match=r"foreign.mcap: /tf_static has 'cdr' messages and a 'ros2idl' schema"):
        list(read_bag_clouds(rewritten(bag, tmp_path / "foreign.mcap", encoding="ros2idl")))
