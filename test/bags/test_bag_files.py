"""The recordings in bags/: readable by other tools, true to their scenes, and reproducible."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from regnet_core.data.scenes.scene import Scene
from regnet_core.geometry import matrix_from_quaternion, pose_matrix, transform_points

ROOT = Path(__file__).resolve().parents[2]
BAGS = ROOT / "bags"
IN_WORLD = {"one_object": 1, "clutter_10": 10, "clutter_20": 20, "empty_table": 0}
"""Number of objects of the bags with four coloured clouds in the world frame."""
TILTED = "tilted_depth_only"
ALL = (*IN_WORLD, TILTED)
STORE = get_typestore(Stores.ROS2_JAZZY)


def _messages(name: str, topic: str) -> Iterator[Any]:
    with Reader(BAGS / name) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, _, raw in reader.messages(connections):
            yield STORE.deserialize_cdr(raw, connection.msgtype)


def _points(cloud: Any) -> np.ndarray:
    """(N, 3), NaN included."""
    return cloud.data.view(np.float32).reshape(-1, cloud.point_step // 4)[:, :3]


def _description(name: str) -> dict[str, Any]:
    return json.loads((BAGS / name / "scene.json").read_text())


def _distances(scene: Scene, points: np.ndarray) -> np.ndarray:
    """(N,) from points in the world to the nearest true surface of the objects and the table [m]."""
    caster = o3d.t.geometry.RaycastingScene()
    for mesh in [*scene.world_meshes(), scene.table_mesh()]:
        caster.add_triangles(
            o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
        )
    return caster.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def _matrix(transform: Any) -> np.ndarray:
    t, q = transform.translation, transform.rotation
    T = np.eye(4)
    T[:3, :3] = matrix_from_quaternion([[q.x, q.y, q.z, q.w]])[0]
    T[:3, 3] = t.x, t.y, t.z
    return T


def test_all_bags_together_are_small() -> None:
    assert sum(file.stat().st_size for file in BAGS.rglob("*") if file.is_file()) < 12e6


@pytest.mark.parametrize("name", ALL)
def test_metadata_is_rosbag2s(name: str) -> None:
    information = yaml.safe_load((BAGS / name / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["storage_identifier"] == "mcap"
    assert information["relative_file_paths"] == [f"{name}.mcap"]
    topics = {
        entry["topic_metadata"]["name"]: (entry["topic_metadata"], entry["message_count"])
        for entry in information["topics_with_message_count"]
    }
    assert set(topics) == {"/camera/depth/points", "/camera/depth/camera_info", "/tf_static"}
    assert topics["/camera/depth/points"][1] == (1 if name == TILTED else 4)
    assert information["message_count"] == sum(count for _, count in topics.values())
    latched = topics["/tf_static"][0]["offered_qos_profiles"][0]
    assert latched["durability"] == "transient_local" and latched["reliability"] == "reliable"
    assert topics["/camera/depth/points"][0]["type"] == "sensor_msgs/msg/PointCloud2"


@pytest.mark.parametrize("name", ALL)
def test_the_mcap_file_is_compressed_and_carries_its_definitions(name: str) -> None:
    with (BAGS / name / f"{name}.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None and {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        schemas = {schema.name: schema for schema in summary.schemas.values()}
        assert schemas["sensor_msgs/msg/PointCloud2"].encoding == "ros2msg"
        assert b"PointField[] fields" in schemas["sensor_msgs/msg/PointCloud2"].data
        decoded = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}
    cloud = decoded["/camera/depth/points"]
    assert len(cloud.data) == cloud.row_step * cloud.height == cloud.point_step * cloud.width * cloud.height
    assert [field.name for field in cloud.fields][:3] == ["x", "y", "z"]


@pytest.mark.parametrize("name", IN_WORLD)
def test_clouds_in_the_world(name: str) -> None:
    clouds = list(_messages(name, "/camera/depth/points"))
    stamps = [cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec for cloud in clouds]
    assert stamps == _description(name)["stamps_ns"] and np.all(np.diff(stamps) == 500_000_000) and stamps[0] > 0
    for cloud in clouds:
        assert cloud.header.frame_id == "world" and cloud.height == 1 and cloud.is_dense and not cloud.is_bigendian
        assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
            ("x", 0, 7),
            ("y", 4, 7),
            ("z", 8, 7),
            ("rgb", 12, 7),
        ]
        points = _points(cloud)
        assert 40_000 < len(points) < 80_000 and np.isfinite(points).all()
        assert np.median(points[:, 2]) == pytest.approx(0.75, abs=0.002)


@pytest.mark.parametrize("name", [name for name, objects in IN_WORLD.items() if objects])
def test_points_lie_on_the_true_surfaces_and_show_every_object(name: str) -> None:
    scene = Scene.load(BAGS / name / "scene.glb")
    assert len(scene.objects) == IN_WORLD[name]
    assert [model.name for model in scene.objects] == _description(name)["objects"]
    points = np.concatenate([_points(cloud) for cloud in _messages(name, "/camera/depth/points")])
    distances = _distances(scene, points)
    assert np.median(distances) < 0.0015
    assert np.mean(distances < 0.01) > 0.99
    for model, mesh in zip(scene.objects, scene.world_meshes(), strict=True):
        lower, upper = mesh.bounds
        near = np.all((points > lower - 0.002) & (points < upper + 0.002), axis=1) & (points[:, 2] > 0.757)
        assert near.sum() > 50, model.name


def test_the_colours_of_the_table_and_of_the_object() -> None:
    cloud = next(_messages("one_object", "/camera/depth/points"))
    columns = cloud.data.view(np.float32).reshape(-1, 4)
    packed = columns[:, 3].copy().view(np.uint32)
    assert np.all(packed >> 24 == 0)
    colours = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1).astype(int)
    scene = Scene.load(BAGS / "one_object" / "scene.glb")
    on_object = columns[:, 2] > 0.765
    expected = np.array(scene.objects[0].colour)
    seen = np.median(colours[on_object], axis=0)
    assert on_object.sum() > 100
    assert np.linalg.norm(seen / np.linalg.norm(seen) - expected / np.linalg.norm(expected)) < 0.05
    table = np.median(colours[~on_object], axis=0)
    assert table[0] > table[1] > table[2] > 80


def test_the_empty_table_is_empty() -> None:
    assert Scene.load(BAGS / "empty_table" / "scene.glb").objects == ()
    for cloud in _messages("empty_table", "/camera/depth/points"):
        assert np.abs(_points(cloud)[:, 2] - 0.75).max() < 0.03


def test_the_tilted_cloud_is_organised_and_has_holes() -> None:
    (cloud,) = _messages(TILTED, "/camera/depth/points")
    assert (cloud.height, cloud.width, cloud.is_dense) == (424, 512, False)
    assert [field.name for field in cloud.fields] == ["x", "y", "z"]
    assert cloud.header.frame_id == "camera_depth_optical_frame" == _description(TILTED)["sensor_pose"]["frame"]
    points = _points(cloud).reshape(424, 512, 3)
    holes = np.isnan(points).any(axis=2)
    assert 0.01 < holes.mean() < 0.5 and np.isnan(points[holes]).all()
    (info,) = _messages(TILTED, "/camera/depth/camera_info")
    z = points[..., 2]
    columns, rows = np.meshgrid(np.arange(512), np.arange(424))
    np.testing.assert_allclose(points[~holes][:, 0], ((columns - info.k[2]) / info.k[0] * z)[~holes], atol=1e-5)
    np.testing.assert_allclose(points[~holes][:, 1], ((rows - info.k[5]) / info.k[4] * z)[~holes], atol=1e-5)


def test_the_tilted_cloud_is_placed_by_its_transforms() -> None:
    (message,) = _messages(TILTED, "/tf_static")
    chain = [(t.header.frame_id, t.child_frame_id) for t in message.transforms]
    assert chain == [("world", "camera_link"), ("camera_link", "camera_depth_optical_frame")]
    T = _matrix(message.transforms[0].transform) @ _matrix(message.transforms[1].transform)
    description = _description(TILTED)
    np.testing.assert_allclose(T, description["T_world_camera"][0], atol=1e-8)
    pose = description["sensor_pose"]
    np.testing.assert_allclose(T, pose_matrix(pose["xyz"], pose["rpy"]), atol=1e-8)
    (cloud,) = _messages(TILTED, "/camera/depth/points")
    points = _points(cloud)
    world = transform_points(T, points[np.isfinite(points).all(axis=1)])
    above_floor = world[(world[:, 2] > 0.7) & np.all(np.abs(world[:, :2]) < 0.4, axis=1)]
    assert np.median(_distances(Scene.load(BAGS / TILTED / "scene.glb"), above_floor)) < 0.0015
    # The camera_link frame looks along x with y to the left and z up, as REP-103 has it.
    link = _matrix(message.transforms[0].transform)
    np.testing.assert_allclose(link[:3, 0], T[:3, 2], atol=1e-8)
    assert link[2, 2] > 0.5


@pytest.mark.parametrize("name", IN_WORLD)
def test_each_cloud_comes_from_the_camera_in_the_transforms(name: str) -> None:
    (message,) = _messages(name, "/tf_static")
    frames = [info.header.frame_id for info in _messages(name, "/camera/depth/camera_info")]
    assert [t.child_frame_id for t in message.transforms] == frames and len(set(frames)) == 4
    for transform, T, cloud in zip(
        message.transforms,
        _description(name)["T_world_camera"],
        _messages(name, "/camera/depth/points"),
        strict=True,
    ):
        np.testing.assert_allclose(_matrix(transform.transform), T, atol=1e-8)
        seen = transform_points(np.linalg.inv(np.array(T)), _points(cloud))
        columns, rows = 365.5 * seen[:, 0] / seen[:, 2] + 255.5, 365.5 * seen[:, 1] / seen[:, 2] + 211.5
        # Every point is the ray of one pixel: back in the image it falls on whole columns and rows.
        assert np.abs(columns - np.round(columns)).max() < 0.1 and np.abs(rows - np.round(rows)).max() < 0.1
        pixels = np.round(columns) + 512 * np.round(rows)
        assert len(np.unique(pixels)) == len(pixels)


def test_the_script_makes_the_same_points_again(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "tools" / "make_bags.py"), "--out", str(tmp_path), "--only", "empty_table"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    subprocess.run(command, check=True, env=environment, capture_output=True, timeout=120)
    with Reader(tmp_path / "empty_table") as reader:
        again = [raw for connection, _, raw in reader.messages() if connection.topic == "/camera/depth/points"]
    for raw, committed in zip(again, _messages("empty_table", "/camera/depth/points"), strict=True):
        points, kept = _points(STORE.deserialize_cdr(raw, "sensor_msgs/msg/PointCloud2")), _points(committed)
        # Another processor's ray caster may round a few pixels of millions to the other side of an edge.
        assert abs(len(points) - len(kept)) < 50
        if len(points) == len(kept):
            assert np.mean(np.abs(points - kept) < 1e-5) > 0.99
    made, committed_json = (json.loads((d / "empty_table" / "scene.json").read_text()) for d in (tmp_path, BAGS))
    assert made == committed_json
