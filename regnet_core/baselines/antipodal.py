"""Antipodal sampling: grasps from surface geometry alone; the sampling baseline of the REGNet V2 paper.

Surface points are drawn as seeds. Around a seed, approach directions are sampled about the inward normal and
straight down, closing directions in the local frame of the surface, and insertion depths. The surface's profile along
the closing direction (ops/jaw_profile.py) then says what the jaw would close on, where the fingers have room, and how
well the two contacts oppose each other: s_q = cos(alpha_i) cos(alpha_j).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from regnet_core.geometry import Array, Mask, Plane, normalised
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.ops.jaw_profile import JawProfile, jaw_profile
from regnet_core.ops.voxel_grid import build_grid
from regnet_core.pointcloud import Index, random_sample
from regnet_core.proposer import Proposals
from regnet_core.scene import Scene, Surface
from regnet_core.visibility import UnseenGround

_DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class AntipodalConfig:
    """How densely and how widely candidates are sampled."""

    seeds: int = 3000
    """Surface points from which grasps are sampled, for each of the two ways of choosing a closing direction."""
    rolls: int = 4
    """Closing directions about the approach of a surface seed."""
    tilts: int = 4
    """Approach directions about the closing direction of a contact seed."""
    normal_cone: float = 0.4
    """Standard deviation of the angle between approach and inward normal [rad]."""
    down_cone: float = 0.45
    """Standard deviation of the angle between approach and straight down [rad]."""
    min_cosine: float = 0.7
    """Both contacts' cosines must reach it; below, the fingers would slip (friction coefficient about 1)."""
    finger_room: float = 0.025
    """Fingers stay at most this far off the object before they close [m]."""
    ample_room: float = 0.010
    """Fingers at least this far off the object will not touch it on the way in [m]."""
    tight_trust: float = 0.4
    """Quality is multiplied by this where there is no room at all between finger and object."""
    hidden_bulge: float = 0.008
    """How much farther than inferred a surface may reach into space that the camera could not see [m]."""
    unseen_trust: float = 0.5
    """Quality is multiplied by this where a finger goes down entirely in space that the camera could not see."""
    table_clearance: float = 0.004
    """Fingertips stay this far above the support plane [m]."""
    min_quality: float = 0.3
    """Candidates expected to be worse are not proposed: where the fingers' side was not seen, most of them collide."""


class Candidates(NamedTuple):
    """C hands at a seed point: what is not yet known is where along Y the object is."""

    rotation: Array
    """(C, 3, 3)."""
    translation: Array
    """(C, 3): palm-side end of the axis y = 0 [m]."""


class AntipodalSampler:
    """The ``antipodal`` model."""

    name = "antipodal"

    def __init__(self, config: AntipodalConfig | None = None) -> None:
        self.config = config or AntipodalConfig()

    def propose(self, scene: Scene, gripper: Gripper, focus: Mask | None, rng: np.random.Generator) -> Proposals:
        """Sample candidates on the focused surface and keep those that close on two opposing contacts."""
        surface = scene.objects
        seeds = np.flatnonzero(scene.wanted(focus))
        if len(seeds) == 0:
            return Proposals(Grasps.empty(), 0)
        rotations, points = zip(
            self._from_normals(surface, seeds, rng), self._from_contacts(surface, seeds, rng), strict=True
        )
        candidates = _insert(np.concatenate(rotations), np.concatenate(points), gripper, scene.plane, rng, self.config)
        grid = build_grid(surface.points, 0.012)
        profile = jaw_profile(
            candidates.rotation,
            candidates.translation,
            gripper,
            grid,
            np.ascontiguousarray(surface.normals[grid.order]),
            surface.observed[grid.order],
        )
        return Proposals(self._grasps(candidates, profile, gripper, scene.ground), len(candidates.rotation))

    def _from_normals(self, surface: Surface, seeds: Index, rng: np.random.Generator) -> tuple[Array, Array]:
        """Approach about the inward normal or straight down; closing directions all around it."""
        cfg = self.config
        seeds = seeds[random_sample(len(seeds), cfg.seeds, rng)]
        inward = -surface.normals[seeds]
        from_normal = rng.random((len(seeds), 1)) < 0.5
        axis = np.where(from_normal, inward, _DOWN)
        spread = np.where(from_normal, cfg.normal_cone, cfg.down_cone)
        approach = _tilted(axis, spread, rng)
        turn = (np.arange(cfg.rolls) + rng.random((len(seeds), 1))) * np.pi / cfg.rolls
        first = _perpendicular(approach)
        second = np.cross(approach, first)
        closing = np.cos(turn)[..., None] * first[:, None] + np.sin(turn)[..., None] * second[:, None]
        approach = np.repeat(approach, cfg.rolls, axis=0)
        return _frames(approach, closing.reshape(-1, 3)), np.repeat(surface.points[seeds], cfg.rolls, axis=0)

    def _from_contacts(self, surface: Surface, seeds: Index, rng: np.random.Generator) -> tuple[Array, Array]:
        """The seed is a contact: close along its normal, approach from any side that is not from below."""
        cfg = self.config
        sideways = seeds[np.abs(surface.normals[seeds, 2]) < 0.8]
        sideways = sideways[random_sample(len(sideways), cfg.seeds, rng)]
        closing = np.repeat(_tilted(surface.normals[sideways], 0.1, rng), cfg.tilts, axis=0)
        down = _DOWN - closing * (closing @ _DOWN)[:, None]
        down = normalised(down)
        angle = np.clip(rng.normal(0.0, cfg.down_cone, len(closing)), -1.5, 1.5)
        approach = np.cos(angle)[:, None] * down + np.sin(angle)[:, None] * np.cross(closing, down)
        return _frames(approach, closing), np.repeat(surface.points[sideways], cfg.tilts, axis=0)

    def _grasps(
        self, candidates: Candidates, profile: JawProfile, gripper: Gripper, ground: UnseenGround | None
    ) -> Grasps:
        """The candidates that close on two opposing contacts, centred on what they close on."""
        cfg = self.config
        good = profile.found & (profile.cos_low > cfg.min_cosine) & (profile.cos_high > cfg.min_cosine)
        rotation, translation = candidates.rotation[good], candidates.translation[good]
        span = Span(profile.low[good], profile.high[good], profile.room[good])
        unseen = np.zeros((len(rotation), 2))
        if ground is not None:
            first = span.place(gripper, cfg.finger_room)
            at = translation + first.middle[:, None] * rotation[:, :, 1]
            unseen = ground.finger_shares(rotation, at, first.width, gripper)
            span = span.grown(cfg.hidden_bulge * unseen)
        jaw = span.place(gripper, cfg.finger_room)
        antipodal = (profile.cos_low * profile.cos_high)[good]
        expected = antipodal * self._certainty(jaw.side, unseen)
        keep = (jaw.side > 0) & (expected >= cfg.min_quality)
        translation = translation + jaw.middle[:, None] * rotation[:, :, 1]
        evidence = profile.evidence[good]
        return Grasps.from_poses(rotation[keep], translation[keep], jaw.width[keep], expected[keep], evidence[keep])

    def _certainty(self, side: Array, unseen: Array) -> Array:
        """(M,) in (0, 1]: how sure the sampler is that the fingers fit where it puts them."""
        cfg = self.config
        roomy = np.minimum(1.0, cfg.tight_trust + (1.0 - cfg.tight_trust) * side / cfg.ample_room)
        return roomy * (1.0 - (1.0 - cfg.unseen_trust) * unseen.max(axis=1))


class Jaw(NamedTuple):
    """Where M jaws go along their closing axis."""

    middle: Array
    """(M,): y of the point between the fingers [m]."""
    width: Array
    """(M,): opening [m]."""
    side: Array
    """(M,): distance of each finger from the object before closing [m]; not positive where the object does not fit."""


class Span(NamedTuple):
    """What M jaws close on, along their closing axis."""

    low: Array
    """(M,): y of its -Y end [m]."""
    high: Array
    """(M,): y of its +Y end [m]."""
    room: Array
    """(M,): free length beyond its more obstructed end [m]."""

    def place(self, gripper: Gripper, finger_room: float) -> Jaw:
        """Fingers in the middle of the free space on both sides, within W and at most ``finger_room`` [m] off."""
        extent = self.high - self.low
        side = np.minimum(0.5 * (gripper.width - extent), 0.5 * (self.room - gripper.thickness))
        side = np.minimum(side, finger_room)
        width = np.clip(extent + 2 * side, 1e-3, gripper.width)
        return Jaw(0.5 * (self.low + self.high), width, side)

    def grown(self, bulge: Array) -> Span:
        """The same with ends that reach farther out by ``bulge`` (M, 2), at +Y and at -Y [m]."""
        return Span(self.low - bulge[:, 1], self.high + bulge[:, 0], self.room - bulge.max(axis=1))


def _insert(
    rotation: Array,
    points: Array,
    gripper: Gripper,
    plane: Plane | None,
    rng: np.random.Generator,
    cfg: AntipodalConfig,
) -> Candidates:
    """Move each hand in so far that the fingertips are a sampled depth beyond the seed, but not into the table."""
    approach = rotation[:, :, 0]
    deepest = np.full(len(points), gripper.depth - 0.003)
    if plane is not None:
        normal = np.asarray(plane.normal)
        half_extent = np.abs(rotation[:, :, 2] @ normal) * gripper.height / 2
        half_extent += np.abs(rotation[:, :, 1] @ normal) * (gripper.width / 2 + gripper.thickness)
        room = plane.height(points) - cfg.table_clearance - half_extent
        sink = -approach @ normal
        deepest = np.where(sink > 0.05, np.minimum(deepest, room / np.maximum(sink, 0.05)), deepest)
    usable = deepest > 0.005
    depth = deepest * rng.uniform(0.4, 1.0, len(points))
    translation = points - (gripper.depth - depth)[:, None] * approach
    return Candidates(np.ascontiguousarray(rotation[usable]), translation[usable])


def _tilted(axis: Array, spread: Array | float, rng: np.random.Generator) -> Array:
    """Unit vectors (N, 3) about the axes (N, 3), off them by a normally distributed angle [rad]."""
    side = _perpendicular(axis)
    turn = rng.uniform(0.0, 2 * np.pi, (len(axis), 1))
    side = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
    angle = np.clip(np.reshape(rng.normal(0.0, 1.0, (len(axis), 1)) * spread, (-1, 1)), -1.4, 1.4)
    return np.cos(angle) * axis + np.sin(angle) * side


def _perpendicular(axis: Array) -> Array:
    """Some unit vector (N, 3) perpendicular to each axis (N, 3)."""
    least = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    return normalised(np.cross(axis, least))


def _frames(approach: Array, closing: Array) -> Array:
    """Rotations (N, 3, 3) from perpendicular unit vectors X and Y."""
    return np.stack([approach, closing, np.cross(approach, closing)], axis=-1)
