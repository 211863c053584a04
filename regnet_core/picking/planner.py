"""From a cloud to the grasp to try: a detector, what is known of the cell, and a policy. The same for all methods."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from regnet_core.checks import check_range, is_whole
from regnet_core.collision import CollisionConfig, SceneCollision
from regnet_core.detector import GraspDetector
from regnet_core.errors import InvalidInputError
from regnet_core.filters import GraspFilters
from regnet_core.geometry import Array, Box, Mask
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.picking.clearance import meets_boxes
from regnet_core.picking.observation import Observation
from regnet_core.picking.workcell import Workcell
from regnet_core.policy import Policy, select

_WAY_STEP = 0.02
"""Distance between two places on the way in at which the hand is compared with the cloud [m]."""
_ALONG = 6
"""Places along a finger, from its tip on, at which it is asked whether the camera sees there."""
_NOISE = CollisionConfig(margin=0.0, max_points=5)
"""On the way in, a few points in the hand are flying pixels: the cloud is as the camera gives it."""


@dataclass(frozen=True)
class PlanConfig:
    """What an integrator sets, for all methods alike.

    Attributes:
        max_tilt: largest angle between an approach and straight down [rad].
        min_quality: grasps of less quality are no grasps, be it that the method expects no better or that they are
            doubted.
        margin: hands keep at least so far from the points of the cloud, but for the fingers' inner faces [m].
        inset: only what is at least this far from the walls and the floor of the bin is grasped [m].
        known_bin: whether grasps are left out whose hand would meet the bin, known from its drawing, on its way in, or
            would have a wall between its fingers.
        bin_margin: the bin is taken to be so much thicker then [m].
        check_way: whether grasps are left out whose hand would meet points of the cloud on its way in.
        unseen_trust: the quality of a grasp is multiplied by this where a finger stands wholly in space that the camera
            could not see, and by less the less of it does; 1 switches it off.
        avoid: how near to the fingertips of a grasp that failed a grasp is doubted [m]; 0 switches it off. A success
            there changes the scene, so that failures before it count no more.
        retry_trust: the quality of a doubted grasp is multiplied by this for each of those failures.
        looks: how many clouds in a row, each with its own noise, must give no grasp before there is none.

    Raises:
        InvalidInputError: a value is out of range.
    """

    max_tilt: float = math.radians(60.0)
    min_quality: float = 0.4
    margin: float = 0.002
    inset: float = 0.005
    known_bin: bool = True
    bin_margin: float = 0.002
    check_way: bool = True
    unseen_trust: float = 0.5
    avoid: float = 0.03
    retry_trust: float = 0.7
    looks: int = 3

    def __post_init__(self) -> None:
        check_range("max_tilt", self.max_tilt, 0.01, math.pi, "rad")
        for name in ("min_quality", "unseen_trust", "retry_trust"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        for name in ("margin", "inset", "bin_margin", "avoid"):
            check_range(name, getattr(self, name), 0.0, 0.1, "m")
        if not is_whole(self.looks) or self.looks < 1:
            raise InvalidInputError(f"looks must be a whole number of at least 1, got {self.looks!r}")


@dataclass(frozen=True)
class Plan:
    """The grasp to try, or why there is none."""

    grasp: Grasps
    """One grasp in the world frame; an empty batch: none was found."""
    score: float
    """The policy's score of it; NaN without one."""
    found: int
    """Grasps that the policy could choose from."""
    seconds: float
    """Time of the detection."""
    reason: str
    """Why there is none, in a sentence; empty when there is one."""


class GraspPlanner:
    """Plans one grasp after another in one work cell."""

    def __init__(
        self,
        detector: GraspDetector,
        policy: Policy,
        gripper: Gripper,
        cell: Workcell,
        config: PlanConfig,
        way: float,
    ) -> None:
        """Args:
        detector: the method.
        policy: chooses among its grasps.
        gripper: the hand.
        cell: what is known of the work cell.
        config: the integrator's settings.
        way: length of the straight way to a grasp [m].
        """
        self._detector = detector
        self._policy = policy
        self._gripper = gripper
        self._config = config
        self._way = way
        self._boxes = cell.obstacles if config.known_bin else ()
        self._filters = GraspFilters(approach_max_angle=config.max_tilt, target=_target(cell, config.inset))
        self._failed: list[Array] = []

    def learn(self, grasp: Grasps, success: bool) -> None:
        """What came of a grasp."""
        place = grasp.fingertips(self._gripper)[0]
        if success:
            self._failed = [other for other in self._failed if np.linalg.norm(other - place) >= self._config.avoid]
        else:
            self._failed.append(place)

    def plan(self, observation: Observation) -> Plan:
        """The grasp of the highest score."""
        detection = self._detector.detect(
            observation.points, self._gripper, filters=self._filters, viewpoint=observation.viewpoint
        )
        grasps, seconds = detection.grasps, detection.report.total_seconds
        if len(grasps) == 0:
            return Plan(Grasps.empty(), math.nan, 0, seconds, detection.report.reason)
        free = grasps[self._free(grasps, observation)]
        if len(free) == 0:
            reason = f"on their way in, the hands of all {len(grasps)} grasps would meet the bin or the observed cloud"
            return Plan(Grasps.empty(), math.nan, 0, seconds, reason)
        doubted = self._doubted(free, observation)
        good = np.flatnonzero(doubted.quality >= self._config.min_quality)
        chosen = select(doubted[good], self._policy)
        if chosen is None:
            best, least = doubted.quality.max(), self._config.min_quality
            reason = f"the best of {len(free)} grasps has a quality of {best:.2f}, doubts included, less than {least:g}"
            return Plan(Grasps.empty(), math.nan, 0, seconds, reason)
        return Plan(free[good[chosen.rank]], chosen.score, len(good), seconds, "")

    def _free(self, grasps: Grasps, observation: Observation) -> Mask:
        """(M,): the hand meets nothing on its way."""
        free = ~meets_boxes(grasps, self._gripper, self._boxes, self._way, self._config.bin_margin)
        if not self._config.check_way:
            return free
        cloud = SceneCollision(observation.points, None, _NOISE)
        for back in np.arange(_WAY_STEP, self._way + 1e-9, _WAY_STEP):
            free &= ~cloud.with_points(_moved_back(grasps, float(back)), self._gripper)
        return free

    def _doubted(self, grasps: Grasps, observation: Observation) -> Grasps:
        """The same grasps, their quality lowered by what the integrator knows and the method does not."""
        unseen = hidden_share(grasps, self._gripper, observation)
        trust = 1.0 - (1.0 - self._config.unseen_trust) * unseen
        tips = grasps.fingertips(self._gripper)
        for place in self._failed:
            trust *= np.where(np.linalg.norm(tips - place, axis=1) < self._config.avoid, self._config.retry_trust, 1.0)
        return replace(grasps, quality=grasps.quality * trust)


def hidden_share(grasps: Grasps, gripper: Gripper, observation: Observation) -> Array:
    """(M,) how much of the finger that is less seen stands in space that the camera could not see, in [0, 1]."""
    x = gripper.depth * np.linspace(0.25, 1.0, _ALONG)
    across = gripper.thickness * np.array([0.0, 0.5, 1.0])
    shares = []
    for side in (1.0, -1.0):
        y = side * (0.5 * grasps.width[:, None] + across)  # (M, 3)
        local = np.zeros((len(grasps), _ALONG, len(across), 3))
        local[..., 0], local[..., 1] = x[:, None], y[:, None]
        points = np.einsum("mij,mabj->mabi", grasps.rotation, local) + grasps.translation[:, None, None]
        shares.append(observation.hidden(points.reshape(-1, 3)).reshape(points.shape[:-1]).mean(axis=(1, 2)))
    return np.maximum(*shares)


def _moved_back(grasps: Grasps, distance: float) -> Grasps:
    """The hands, so far before their grasps [m]."""
    return replace(grasps, translation=grasps.translation - distance * grasps.approach)


def _target(cell: Workcell, inset: float) -> Box:
    """Where things may be grasped: the source, away from the walls and the floor of a bin [m]."""
    lower, upper = np.array(cell.source.lower), np.array(cell.source.upper)
    if cell.pick_bin is None:
        return cell.source
    lower[2] = cell.pick_bin.inside.lower[2]
    return Box(tuple(lower + inset), tuple(upper - [inset, inset, 0.0]))
