"""Triangle meshes of the things that are drawn besides the cloud: grippers and the arrow of the approach."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array, Box, transform_points
from regnet_core.gripper import Gripper

_BOX_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip
"""Triangles over ``Box.corners``, which count x slowest and z fastest; seen from outside they turn anticlockwise."""

PRE_GRASP_DISTANCE = 0.10
"""How far behind the grasp the approach starts [m]."""


class Mesh(NamedTuple):
    """Triangles, anticlockwise seen from outside."""

    vertices: Array
    """(V, 3) [m]."""
    faces: npt.NDArray[np.int64]
    """(F, 3): rows of ``vertices``."""

    def transformed(self, transform: npt.ArrayLike) -> Mesh:
        """The mesh moved by ``transform`` (4, 4)."""
        return Mesh(transform_points(transform, self.vertices), self.faces)


def gripper_mesh(gripper: Gripper, opening: float | None = None) -> Mesh:
    """Palm and fingers in the grasp frame, open by ``opening`` [m] (the gripper's width unless given)."""
    return joined([_box_mesh(box) for box in gripper.bodies(opening)])


def fork_mesh(gripper: Gripper, opening: float | None = None, wire: float = 0.004) -> Mesh:
    """A slim stand-in for the gripper: a handle, a crossbar and two prongs, square rods of edge ``wire`` [m].

    It shows pose and opening and hides little of what is behind it.
    """
    half, r = (gripper.width if opening is None else opening) / 2, wire / 2
    rods = [
        Box((-0.7 * gripper.palm_depth, -r, -r), (-2 * r, r, r)),
        Box((-2 * r, -half - 2 * r, -r), (0.0, half + 2 * r, r)),
        Box((0.0, half, -r), (gripper.depth, half + 2 * r, r)),
        Box((0.0, -half - 2 * r, -r), (gripper.depth, -half, r)),
    ]
    return joined([_box_mesh(rod) for rod in rods])


def approach_arrow(gripper: Gripper, length: float = PRE_GRASP_DISTANCE, sides: int = 20) -> Mesh:
    """An arrow along +X in the grasp frame that ends at the back of the hand, of the given length [m]."""
    tip, head, radius = -gripper.palm_depth - 0.004, 0.35 * length, 0.0045
    rings = [
        (tip - length, 0.0),
        (tip - length, radius),
        (tip - head, radius),
        (tip - head, 2.6 * radius),
        (tip, 0.0),
    ]
    return _turned(rings, sides)


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    if not meshes:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


def _box_mesh(box: Box) -> Mesh:
    return Mesh(box.corners(), _BOX_FACES)


def _turned(rings: list[tuple[float, float]], sides: int) -> Mesh:
    """The surface that rings (x, radius) sweep about the x axis."""
    angle = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    circle = np.stack([np.zeros(sides), np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.array([x, 0.0, 0.0]) + radius * circle for x, radius in rings])
    i = np.arange(sides)
    j = (i + 1) % sides
    faces = []
    for k in range(len(rings) - 1):
        a, b = k * sides, (k + 1) * sides
        faces += [np.stack([a + i, b + j, a + j], axis=1), np.stack([a + i, b + i, b + j], axis=1)]
    return Mesh(vertices, np.concatenate(faces))
