"""Which grasp to execute: the heuristic and the analytic policy of REGNet V2 (section "Grasp selection policy")."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, fields
from typing import ClassVar, Protocol

import numpy as np

from regnet_core.checks import as_vector, is_number, shown
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box, Mask, check_cone, within_cone
from regnet_core.grasps import Grasps


class Policy(Protocol):
    """Scores grasps; the one with the highest score is executed."""

    name: ClassVar[str]

    def score(self, quality: Array, vertical_score: Array) -> Array:
        """Scores (M,) of grasps with quality s_q (M,) and vertical score s_v (M,)."""
        ...


@dataclass(frozen=True)
class HeuristicPolicy:
    """s_q + s_v."""

    name: ClassVar[str] = "heuristic"

    def score(self, quality: Array, vertical_score: Array) -> Array:
        """Scores (M,), in [0, 2]."""
        return quality + vertical_score


@dataclass(frozen=True)
class AnalyticPolicy:
    """P(success) = P(grasp | reach) P(reach) = (gain s_q + offset) / (1 + exp(-slope (s_v - midpoint))).

    The defaults are the paper's fit for a Baxter.
    """

    name: ClassVar[str] = "analytic"
    quality_gain: float = 0.8783
    quality_offset: float = -0.0587
    slope: float = 10.1244
    midpoint: float = 0.6103

    def __post_init__(self) -> None:
        for field, value in vars(self).items():
            if not is_number(value) or abs(value) == math.inf:
                raise InvalidInputError(f"analytic policy: {field} must be a finite number, got {value!r}")

    def score(self, quality: Array, vertical_score: Array) -> Array:
        """Scores (M,): the expected probability of success."""
        with np.errstate(over="ignore"):  # a steep slope makes the term infinite, and the score 0, as it should
            reach = 1.0 / (1.0 + np.exp(-self.slope * (vertical_score - self.midpoint)))
        return (self.quality_gain * quality + self.quality_offset) * reach


POLICIES: dict[str, type[HeuristicPolicy] | type[AnalyticPolicy]] = {
    HeuristicPolicy.name: HeuristicPolicy,
    AnalyticPolicy.name: AnalyticPolicy,
}


def make_policy(name: str, **constants: float) -> Policy:
    """The policy of that name; ``constants`` are the fields of its class.

    Raises:
        InvalidInputError: there is no such policy or constant.
    """
    if name not in POLICIES:
        raise InvalidInputError(f"no policy '{name}'; there are {', '.join(POLICIES)}")
    known = [f.name for f in fields(POLICIES[name])]
    if not constants.keys() <= set(known):
        raise InvalidInputError(
            f"policy '{name}' takes the constants {', '.join(known) or 'none'}; got {', '.join(constants)}"
        )
    return POLICIES[name](**constants)


@dataclass(frozen=True)
class SelectionLimits:
    """What the robot can do; the defaults accept everything.

    Raises:
        InvalidInputError: a limit makes no sense.
    """

    approach_axis: tuple[float, float, float] = (0.0, 0.0, -1.0)
    approach_max_angle: float = math.pi
    """Half-angle of the cone of approach directions about ``approach_axis`` [rad]."""
    reach_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the arm is mounted, in the frame of the grasps [m]."""
    reach_min: float = 0.0
    reach_max: float = math.inf
    """How near to and far from ``reach_centre`` the grasp centre may be [m]."""
    workspace: Box | None = None

    def __post_init__(self) -> None:
        ordered = is_number(self.reach_min) and is_number(self.reach_max) and 0.0 <= self.reach_min < self.reach_max
        if not ordered:
            raise InvalidInputError(
                f"reach needs 0 <= min < max, got {shown(self.reach_min)} and {shown(self.reach_max)} m"
            )
        as_vector("reach_centre", self.reach_centre)
        check_cone(self.approach_axis, self.approach_max_angle)
        if not isinstance(self.workspace, Box | None):
            raise InvalidInputError(f"workspace must be a Box or None, got {self.workspace!r}")

    def accepts(self, grasps: Grasps) -> Mask:
        """(M,): the grasps within all limits."""
        distance = np.linalg.norm(grasps.translation - np.asarray(self.reach_centre), axis=1)
        ok = within_cone(grasps.approach, self.approach_axis, self.approach_max_angle)
        ok &= (distance >= self.reach_min) & (distance <= self.reach_max)
        return ok if self.workspace is None else ok & self.workspace.contains(grasps.translation)


@dataclass(frozen=True)
class Selection:
    """The grasp to execute next."""

    rank: int
    """Its index in the batch it was selected from."""
    score: float
    """The policy's score of it."""
    policy: str


def select(
    grasps: Grasps, policy: Policy, limits: SelectionLimits | None = None, excluded: Collection[int] = ()
) -> Selection | None:
    """The grasp with the highest score within the limits, ``excluded`` ranks left out; None if there is none."""
    allowed = (limits or SelectionLimits()).accepts(grasps)
    allowed[[rank for rank in excluded if 0 <= rank < len(grasps)]] = False
    if not allowed.any():
        return None
    scores = np.where(allowed, policy.score(grasps.quality, grasps.vertical_score), -np.inf)
    best = int(np.argmax(scores))
    return Selection(best, float(scores[best]), policy.name)
