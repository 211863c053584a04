"""Markers for RViz and Foxglove: grippers coloured by rank, the selected grasp, the support plane."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import Point, Vector3
from regnet_msgs.msg import SelectedGrasp
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from regnet_core.geometry import Array, Box, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.ops.voxel_grid import bounds
from regnet_ros.conversions import grasps_from_messages, gripper_from_message, pose_to_message, poses_to_messages

_LINE_WIDTH = 0.002
_PLANE_THICKNESS = 0.001
_SELECTED = ColorRGBA(r=0.15, g=0.45, b=1.0, a=0.85)
_PATH = ColorRGBA(r=1.0, g=0.8, b=0.1, a=1.0)
_PLANE = ColorRGBA(r=0.5, g=0.6, b=0.7, a=0.35)


def rank_colour(rank: int, count: int) -> ColorRGBA:
    """Green for the best of ``count``, over yellow to red for the last."""
    share = rank / max(count - 1, 1)
    return ColorRGBA(r=min(1.0, 2.0 * share), g=min(1.0, 2.0 - 2.0 * share), b=0.1, a=0.9)


def gripper_lines(gripper: Gripper, opening: float) -> Array:
    """The outline of a hand in the grasp frame as line segments (S, 2, 3): stem, palm, two fingers."""
    bodies = gripper.bodies(opening)
    left, right = (_middle(finger)[1] for finger in (bodies.left_finger, bodies.right_finger))
    return np.array(
        [
            [[-gripper.palm_depth, 0.0, 0.0], [0.0, 0.0, 0.0]],
            [[0.0, right, 0.0], [0.0, left, 0.0]],
            [[0.0, left, 0.0], [gripper.depth, left, 0.0]],
            [[0.0, right, 0.0], [gripper.depth, right, 0.0]],
        ]
    )


def grasp_markers(header: Header, grasps: Grasps, gripper: Gripper, most: int) -> MarkerArray:
    """One outline for each of the best ``most`` grasps, coloured by rank; whatever was drawn before goes first."""
    shown = grasps[:most]
    markers = [_clear(header)]
    for rank, pose in enumerate(poses_to_messages(shown.poses)):
        marker = _marker(header, "grasps", rank, Marker.LINE_LIST, rank_colour(rank, len(shown)))
        marker.pose = pose
        marker.scale.x = _LINE_WIDTH
        opening = float(shown.width[rank])
        marker.points = [_point(p) for p in gripper_lines(gripper, opening).reshape(-1, 3)]
        markers.append(marker)
    return MarkerArray(markers=markers)


def no_markers(header: Header) -> MarkerArray:
    """Take away whatever was drawn before."""
    return MarkerArray(markers=[_clear(header)])


def selection_markers(selected: SelectedGrasp) -> MarkerArray:
    """The selected hand as solid boxes, and its way from pre-grasp over grasp to lift as a line."""
    gripper = gripper_from_message(selected.gripper)
    pose = grasps_from_messages([selected.selected]).poses[0]
    markers = [_clear(selected.header)]
    for number, body in enumerate(gripper.bodies(selected.opening)):
        marker = _marker(selected.header, "selected_grasp", number, Marker.CUBE, _SELECTED)
        place = np.eye(4)
        place[:3, 3] = _middle(body)
        marker.pose = pose_to_message(pose @ place)
        marker.scale = _vector(np.subtract(body.upper, body.lower))
        markers.append(marker)
    way = _marker(selected.header, "selected_way", 0, Marker.LINE_STRIP, _PATH)
    way.scale.x = _LINE_WIDTH
    way.points = [selected.pre_grasp.position, selected.grasp.position, selected.lift.position]
    return MarkerArray(markers=[*markers, way])


def plane_marker(header: Header, plane: Plane | None, points: npt.NDArray[np.floating]) -> Marker:
    """The support plane as a thin plate under the points (N, 3); a deletion when there is none."""
    marker = _marker(header, "support_plane", 0, Marker.CUBE, _PLANE)
    if plane is None or len(points) == 0:
        marker.action = Marker.DELETE
        return marker
    normal = np.asarray(plane.normal)
    lower, upper = (corner.astype(np.float64) for corner in bounds(points))
    middle = (lower + upper) / 2
    x = np.cross([0.0, 1.0, 0.0], normal)
    x /= np.linalg.norm(x)
    place = np.eye(4)
    place[:3, :3] = np.column_stack([x, np.cross(normal, x), normal])
    place[:3, 3] = middle - plane.height(middle) * normal
    marker.pose = pose_to_message(place)
    marker.scale = _vector([upper[0] - lower[0], upper[1] - lower[1], _PLANE_THICKNESS])
    return marker


def _clear(header: Header) -> Marker:
    return Marker(header=header, action=Marker.DELETEALL)


def _marker(header: Header, namespace: str, number: int, kind: int, colour: ColorRGBA) -> Marker:
    marker = Marker(header=header, ns=namespace, id=number, type=kind, action=Marker.ADD, color=colour)
    marker.pose.orientation.w = 1.0
    return marker


def _middle(box: Box) -> Array:
    return (np.asarray(box.lower) + np.asarray(box.upper)) / 2


def _point(p: Array) -> Point:
    return Point(x=float(p[0]), y=float(p[1]), z=float(p[2]))


def _vector(v: Array | list[float]) -> Vector3:
    return Vector3(x=max(float(v[0]), 1e-4), y=max(float(v[1]), 1e-4), z=max(float(v[2]), 1e-4))
