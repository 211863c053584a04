"""The interfaces of regnet_msgs: the fields that others rely on, and a comment with unit or frame for each of them."""

import re
from pathlib import Path

import pytest
from regnet_msgs.action import ExecuteGrasp
from regnet_msgs.msg import Grasp, GraspArray, Gripper, SelectedGrasp, StepReport
from regnet_msgs.srv import DetectGrasps, SelectGrasp

FOLDER = Path(__file__).resolve().parents[2] / "msg_defs"
FILES = sorted([*FOLDER.glob("msg/*.msg"), *FOLDER.glob("srv/*.srv"), *FOLDER.glob("action/*.action")])
UNIT = re.compile(r"\[[^\]]*(\bm\b|\bs\b|-|count|index|flag|text)[^\]]*\]")

FIELDS = {
    Gripper: {
        "width": "double",
        "depth": "double",
        "height": "double",
        "thickness": "double",
        "palm_depth": "double",
    },
    Grasp: {
        "pose": "geometry_msgs/Pose",
        "width": "double",
        "quality": "double",
        "vertical_score": "double",
        "confidence": "double",
    },
    StepReport: {"name": "string", "kept": "uint32", "rejected": "uint32", "seconds": "double"},
    GraspArray: {
        "header": "std_msgs/Header",
        "gripper": "regnet_msgs/Gripper",
        "grasps": "sequence<regnet_msgs/Grasp>",
        "steps": "sequence<regnet_msgs/StepReport>",
        "model": "string",
        "device": "string",
        "reason": "string",
        "warnings": "sequence<string>",
        "total_seconds": "double",
    },
    SelectedGrasp: {
        "header": "std_msgs/Header",
        "pre_grasp": "geometry_msgs/Pose",
        "grasp": "geometry_msgs/Pose",
        "lift": "geometry_msgs/Pose",
        "opening": "double",
        "policy": "string",
        "score": "double",
        "rank": "uint32",
        "selected": "regnet_msgs/Grasp",
        "gripper": "regnet_msgs/Gripper",
    },
    DetectGrasps.Request: {
        "cloud": "sensor_msgs/PointCloud2",
        "use_gripper": "boolean",
        "gripper": "regnet_msgs/Gripper",
    },
    DetectGrasps.Response: {"success": "boolean", "message": "string", "grasps": "regnet_msgs/GraspArray"},
    SelectGrasp.Request: {
        "grasps": "regnet_msgs/GraspArray",
        "policy": "string",
        "rejected_ranks": "sequence<uint32>",
    },
    SelectGrasp.Response: {"success": "boolean", "message": "string", "selected": "regnet_msgs/SelectedGrasp"},
    ExecuteGrasp.Goal: {"grasp": "regnet_msgs/SelectedGrasp"},
    ExecuteGrasp.Result: {"success": "boolean", "outcome": "string", "message": "string"},
    ExecuteGrasp.Feedback: {"phase": "string", "progress": "float"},
}


def commented_fields(path: Path) -> list[tuple[str, str]]:
    """The fields of an interface file, each with the comment lines right above it, joined."""
    fields, comment = [], []
    for line in path.read_text().splitlines():
        if line.startswith("#"):
            comment.append(line.lstrip("# "))
            continue
        if line and line != "---":
            fields.append((line, " ".join(comment)))
        comment = []
    return fields


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_field_has_a_comment_with_unit_or_frame(path: Path) -> None:
    fields = commented_fields(path)
    assert fields
    for field, comment in fields:
        assert UNIT.match(comment), f"{path.name}: the comment above {field!r} must begin with a unit such as [m]"
        assert len(comment.split("]", 1)[1].split()) >= 3, f"{path.name}: the comment above {field!r} says nothing"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_poses_and_boxes_name_their_frame(path: Path) -> None:
    for field, comment in commented_fields(path):
        kind = field.split()[0]
        if kind.endswith(("Pose", "Header", "PointCloud2", "Grasp", "Grasp[]", "GraspArray", "Gripper")):
            assert "frame" in comment, f"{path.name}: the comment above {field!r} names no frame"


def test_grasp_frame_is_stated_where_grasps_are_defined() -> None:
    for name in ("Gripper", "Grasp", "SelectedGrasp"):
        text = " ".join((FOLDER / "msg" / f"{name}.msg").read_text().replace("#", " ").split())
        for words in ("X = approach", "Z = X x Y", "c + depth * X"):
            assert words in text, f"{name}.msg lacks {words!r}"


@pytest.mark.parametrize("interface", FIELDS, ids=lambda interface: interface.__name__)
def test_built_interface_has_the_agreed_fields(interface: type) -> None:
    assert interface.get_fields_and_field_types() == FIELDS[interface]


def test_every_interface_file_is_built() -> None:
    listed = re.findall(r'"((?:msg|srv|action)/\w+\.\w+)"', (FOLDER / "CMakeLists.txt").read_text())
    assert sorted(listed) == sorted(str(path.relative_to(FOLDER)) for path in FILES)
