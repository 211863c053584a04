"""Grasps of a single object, in its own frame: sampled once, reused in every scene that the object is in.

Points are drawn on the surface. From each, the approach is the inward normal, a direction in a cone about it, and one
in a cone about straight down as the object may come to lie, with several rolls and one insertion depth each. A hand is
then moved along its closing direction until the object is in the
middle of the jaw, and, for a share of them, rolled so that the fingers close along the line of the contacts' normals.
What collides with the object or does not touch it with both pads is dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Mask, normalised
from regnet_core.gripper import Gripper
from regnet_core.ops.hand_mesh import HandMesh, hand_on_mesh
from regnet_core.ops.triangle_tree import TriangleTree, build_tree

Floats = npt.NDArray[np.floating[Any]]
APPROACHES = 3
"""Ways to choose an approach at a surface point."""


@dataclass(frozen=True)
class CandidateConfig:
    """How grasps of an object are sampled; the same samples serve every gripper width.

    Raises:
        InvalidInputError: a number is out of range.
    """

    points: int = 2000
    """Points on the surface."""
    rolls: int = 3
    """Closing directions about an approach, evenly spaced from a random start."""
    normal_cone: float = 0.45
    """Standard deviation of the angle between the second approach and the inward normal [rad]."""
    down_cone: float = 0.35
    """Standard deviation of the angle between the third approach and straight down [rad]."""
    shallowest: float = 0.010
    """Least depth of the fingertips beyond the point where the approach axis enters the object [m]."""
    rolled: float = 0.5
    """Share of the hands that are rolled to close along the contacts' normals."""
    off_centre: float = 0.2
    """Share of the hands that are not moved all the way to the middle of the contacts."""
    clearance: float = 0.002
    """Palm and fingers stay at least this far from every surface [m]."""

    def __post_init__(self) -> None:
        for name in ("points", "rolls"):
            check_range(name, getattr(self, name), 1, 65535)
        for name in ("rolled", "off_centre"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        for name in ("normal_cone", "down_cone", "shallowest", "clearance"):
            check_range(name, getattr(self, name), 0.0)

    @property
    def per_point(self) -> int:
        """Hands tried at each surface point."""
        return APPROACHES * self.rolls


@dataclass(frozen=True)
class Candidates:
    """M grasps of one object with the jaw open at W, collision-free with the object and touching it with both pads."""

    point: npt.NDArray[np.integer[Any]]
    """(M,): the sampled surface point that a grasp came from; grasps of one point are alike."""
    rotation: Floats
    """(M, 3, 3): grasp frames in the object's frame."""
    translation: Floats
    """(M, 3): grasp centres c in the object's frame [m]."""
    high: Floats
    """(M,): y in the grasp frame of the contact of the finger at +Y [m]."""
    low: Floats
    """(M,): that of the finger at -Y [m]."""
    score: Floats
    """(M,): s_q = cos(alpha_i) cos(alpha_j)."""
    entry: Floats
    """(M,): x at which the approach axis enters the object, or, where it misses it, at which the object begins [m]."""

    def __len__(self) -> int:
        return len(self.point)

    def take(self, chosen: npt.NDArray[np.generic]) -> Candidates:
        """Those with these numbers, or for which a mask (M,) is true."""
        return Candidates(*(getattr(self, f.name)[chosen] for f in fields(self)))


def object_candidates(
    mesh: trimesh.Trimesh, grippers: Sequence[Gripper], rng: np.random.Generator, config: CandidateConfig | None = None
) -> tuple[Candidates, ...]:
    """Sample grasps of a watertight mesh for each gripper.

    Args:
        mesh: in metres.
        grippers: hands that differ in their width only.
        rng: source of every random number; the same state gives the same grasps.
        config: how densely and how widely.

    Raises:
        InvalidInputError: the mesh is not watertight.
    """
    if not mesh.is_watertight:
        raise InvalidInputError("grasps are sampled on watertight meshes only; this one has holes")
    config = config or CandidateConfig()
    tree = build_tree(mesh.vertices, mesh.faces)
    hands = _sample(mesh, grippers[0].depth, rng, config)
    return tuple(_fit(hands, tree, gripper, config) for gripper in grippers)


@dataclass(frozen=True)
class _Hands:
    """C hands at surface points, before the object is looked at."""

    point: npt.NDArray[np.int64]
    rotation: Array
    translation: Array
    slack: Array
    """(C,): share of the way to the middle of the contacts that a hand is not moved."""
    rolled: npt.NDArray[np.bool_]

    def take(self, chosen: Mask) -> _Hands:
        """Those for which the mask (C,) is true."""
        return _Hands(*(getattr(self, f.name)[chosen] for f in fields(self)))


def _sample(mesh: trimesh.Trimesh, depth: float, rng: np.random.Generator, config: CandidateConfig) -> _Hands:
    points, normals = surface_points(mesh, config.points, rng)
    n, r = config.points, config.rolls
    around_normal = _tilted(-normals, config.normal_cone, rng)
    around_down = _tilted(resting_directions(mesh, n, rng), config.down_cone, rng)
    approach = np.stack([-normals, around_normal, around_down], axis=1)  # (n, APPROACHES, 3)
    turn = (np.arange(r) + rng.random((n, APPROACHES, 1))) * np.pi / r
    first = _perpendicular(approach)[:, :, None]
    second = np.cross(approach[:, :, None], first)
    closing = (np.cos(turn)[..., None] * first + np.sin(turn)[..., None] * second).reshape(-1, 3)
    approach = np.repeat(approach.reshape(-1, 3), r, axis=0)
    beyond = rng.uniform(config.shallowest, max(depth - config.clearance, config.shallowest), len(closing))
    translation = np.repeat(points, config.per_point, axis=0) - (depth - beyond)[:, None] * approach
    slack = np.where(rng.random(len(closing)) < config.off_centre, rng.random(len(closing)), 0.0)
    rolled = rng.random(len(closing)) < config.rolled
    return _Hands(np.repeat(np.arange(n), config.per_point), _frames(approach, closing), translation, slack, rolled)


def _fit(hands: _Hands, tree: TriangleTree, gripper: Gripper, config: CandidateConfig) -> Candidates:
    """Move and roll the hands to what is between their fingers, and keep those that hold it without a collision."""
    room = gripper.width - 2.0 * config.clearance
    met = _meet(hands, tree, gripper, blind=True)
    hands, met = _choose(hands, met, np.isfinite(met.high) & (hands.rolled | (met.high - met.low < room)))
    hands = _shifted(replace(hands, rotation=_roll(hands, met)), met, 1.0 - hands.slack)
    # Once more: rolling has changed what is between the fingers, and an off-centre object may now be so as a whole.
    met = _meet(hands, tree, gripper, blind=True)
    hands, met = _choose(hands, met, np.isfinite(met.high) & (met.high - met.low < room))
    hands = _shifted(hands, met, (hands.slack == 0.0).astype(float))
    met = _meet(hands, tree, gripper, clearance=config.clearance)
    good = ~met.collides & (met.cos_high > 0.0) & (met.cos_low > 0.0) & np.isfinite(met.high)
    good &= gripper.depth - met.nearest >= 0.5 * config.shallowest
    chosen = np.flatnonzero(good)
    return Candidates(
        hands.point[chosen],
        hands.rotation[chosen],
        hands.translation[chosen],
        met.high[chosen],
        met.low[chosen],
        (met.cos_high * met.cos_low)[chosen],
        np.where(np.isfinite(met.on_axis), met.on_axis, met.nearest)[chosen],
    )


def _meet(
    hands: _Hands, tree: TriangleTree, gripper: Gripper, *, blind: bool = False, clearance: float = 0.0
) -> HandMesh:
    """What the hands meet; ``blind``: only between the fingers, as if they and the palm were not there."""
    opening = np.full(len(hands.point), gripper.width)
    return hand_on_mesh(tree, hands.rotation, hands.translation, opening, gripper, clearance, bodies=not blind)


def _choose(hands: _Hands, met: HandMesh, chosen: Mask) -> tuple[_Hands, HandMesh]:
    return hands.take(chosen), met.take(chosen)


def _shifted(hands: _Hands, met: HandMesh, share: Array) -> _Hands:
    """The hands moved along Y by a share (M,) of the way to the middle of the contacts."""
    middle = share * 0.5 * (met.high + met.low)
    return replace(hands, translation=hands.translation + middle[:, None] * hands.rotation[:, :, 1])


def _roll(hands: _Hands, met: HandMesh) -> Array:
    """The rotations, of those to be rolled turned about X until Y is along the difference of the contacts' normals."""
    approach, closing = hands.rotation[:, :, 0], hands.rotation[:, :, 1]
    wanted = met.normal_high - met.normal_low
    wanted = wanted - approach * np.einsum("mi,mi->m", wanted, approach)[:, None]
    length = np.linalg.norm(wanted, axis=1, keepdims=True)
    turned = np.where(length > 0.5, wanted / np.maximum(length, 1e-9), closing)
    return _frames(approach, np.where(hands.rolled[:, None], turned, closing))


def surface_points(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (count, 3) [m] drawn uniformly on a mesh, with their outward normals (count, 3)."""
    corners = np.asarray(mesh.triangles, np.float64)
    cumulative = np.cumsum(np.asarray(mesh.area_faces, np.float64))
    face = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    face = np.minimum(face, len(corners) - 1)
    u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    points = (1.0 - u) * corners[face, 0] + u * (1.0 - v) * corners[face, 1] + u * v * corners[face, 2]
    return points, np.asarray(mesh.face_normals, np.float64)[face]


def resting_directions(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> Array:
    """Straight down, (count, 3) unit vectors in the object's frame, as the object may come to lie.

    A face of the convex hull is drawn by the solid angle under which the centre of mass, the origin, sees it: an object
    that is turned at random and set down mostly comes to rest on its large faces near the centre.
    """
    hull = mesh.convex_hull
    corners = np.asarray(hull.triangles, np.float64) - np.asarray(mesh.center_mass)
    angles = np.cumsum(_solid_angles(corners))
    face = np.minimum(np.searchsorted(angles, rng.random(count) * angles[-1], side="right"), len(corners) - 1)
    return np.asarray(hull.face_normals, np.float64)[face]


def _solid_angles(corners: Array) -> Array:
    """(F,) solid angles of triangles (F, 3, 3) seen from the origin [sr] (Van Oosterom and Strackee, 1983)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("fi,fi->f", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("fi,fi->f", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return np.abs(2.0 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb))


def _tilted(axis: Array, spread: float, rng: np.random.Generator) -> Array:
    """Unit vectors (N, 3) about the axes (N, 3), off them by a normally distributed angle [rad]."""
    side = _perpendicular(axis)
    turn = rng.uniform(0.0, 2.0 * np.pi, (len(axis), 1))
    side = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
    angle = np.clip(rng.normal(0.0, spread, (len(axis), 1)), -1.4, 1.4)
    return np.cos(angle) * axis + np.sin(angle) * side


def _perpendicular(axis: Array) -> Array:
    """Some unit vector (..., 3) perpendicular to each axis (..., 3)."""
    least = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    return normalised(np.cross(axis, least))


def _frames(approach: Array, closing: Array) -> Array:
    """Rotations (N, 3, 3) from perpendicular unit vectors X and Y."""
    return np.stack([approach, closing, np.cross(approach, closing)], axis=-1)
