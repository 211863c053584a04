"""Matching: which labelled grasp each anchor of a region, and each proposal, should learn; and which learn to say no.

The labels are a dense random sample of grasps of every quality, from all sides, at random depths: within 2 cm of a
point there are dozens. The nearest one (the paper's choice) changes from one point to the next and tells little about
what can be seen; a network that regresses such targets learns their mean, which is no grasp. What is learnt is
therefore the most *preferred* grasp of the neighbourhood (``LabelledGrasps.preference``): neighbouring points agree on
it, and the preferences, each for what grasps have in common where they are good, narrow the targets down to one mode.
The distance between a point and the grasp's entry point is one more preference, so that among equals the nearest wins.
Measured on six scenes at W = 0.08 m, for positive points less than 4 mm apart, nearest and preferred: the same grasp
for 47 and 83 %; on average, reference points 7.7 and 2.3 mm apart, closing directions 12 and 3 degrees, approaches 11
and 3; mean s_q of the targets 0.69 and 0.92. The preferred depth does most of it.

Two good grasps of a place may still close in different directions, as on a box. Telling them apart is the anchors'
task: an anchor is positive when a grasp that closes within alpha1 of it is nearly as good as the best of the
neighbourhood, and learns that one. In the paper a region has one grasp, and anchors far from it are negative though
they may be as good. Without the comparison with the best, 97 % of all anchors would be positive, and the class would
say nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.nn.anchors import RESIDUALS, GraspCoder, Pose, RefineCoder

if TYPE_CHECKING:  # data sets need more than a network does
    from regnet_core.data.dataset import GraspBatch

POSITIVE, NEGATIVE, IGNORED = 1, 0, -1
"""Labels of anchors and proposals."""
NO_GRASP = -1
"""The number of a grasp where there is none."""
_PAIRS = 1 << 21
"""Points times grasps looked at together: each table of them has 8 MB."""


@dataclass(frozen=True)
class MatchConfig:
    """Angles [rad] and distances [m] of positives and negatives, and what makes a grasp preferred, in units of s_q.

    Raises:
        InvalidInputError: a number is out of range, or an outer limit is inside the inner one.
    """

    radius: float = 0.02
    """A region may learn the grasps whose entry points are so near to its point: the region's radius."""
    alpha1: float = math.pi / 3
    """Anchors within alpha1 of the closing direction of a grasp that is preferred by at most margin1 less than the best
    are positive. The ablation with the single anchor (1, 0, 0) needs alpha1 = alpha2 = pi / 2."""
    alpha2: float = 5 * math.pi / 12
    """Anchors farther than alpha2 from all grasps within margin2 of the best are negative; the others are ignored."""
    margin1: float = 0.05
    """In units of s_q; 0 is the paper's: the best grasp alone counts."""
    margin2: float = 0.1
    d1: float = 0.015
    """Proposals within d1 (centres), beta1 (closing directions) and gamma1 (approaches) of a grasp are positive."""
    d2: float = 0.020
    """Proposals farther than d2, beta2 or gamma2 from every grasp are negative; those in between are ignored."""
    beta1: float = math.pi / 4
    beta2: float = math.pi / 3
    gamma1: float = math.pi / 4
    gamma2: float = math.pi / 3
    distance_weight: float = 0.15
    """Preference lost by a grasp at ``radius`` from the point."""
    change_weight: float = 0.3
    """Preference lost by a grasp at d1, beta1 or gamma1 from the proposal: refining goes no farther than needed."""
    vertical_weight: float = 0.2
    """Preference of straight down over straight up."""
    centred_weight: float = 0.3
    """Preference of contacts in the very middle of the jaw over contacts at a finger."""
    depth_weight: float = 0.2
    """Preference lost by a grasp for each ``preferred_entry`` that its entry is away from it."""
    preferred_entry: float = 0.03
    """Distance between palm and entry point that is preferred: the surface halfway down the fingers."""

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name.endswith("weight")):
            check_range(name, getattr(self, name), 0.0)
        for name in ("radius", "d1", "d2", "preferred_entry"):
            check_range(name, getattr(self, name), 1e-4, 1.0, "m")
        for name in ("alpha1", "alpha2", "beta1", "beta2", "gamma1", "gamma2"):
            check_range(name, getattr(self, name), 1e-3, math.pi, "rad")
        for name in ("margin1", "margin2"):
            check_range(name, getattr(self, name), 0.0)
        for kind in ("alpha", "margin", "d", "beta", "gamma"):
            inner, outer = f"{kind}1", f"{kind}2"
            if getattr(self, inner) > getattr(self, outer):
                raise InvalidInputError(
                    f"{inner} must be at most {outer} = {getattr(self, outer):g}, got {getattr(self, inner):g}"
                )

    @classmethod
    def paper(cls) -> MatchConfig:
        """The paper's choice: every region learns the nearest grasp, whatever its score."""
        # A weight by which no score makes up for a hundredth of a millimetre.
        return cls(
            margin1=0.0, margin2=0.0, distance_weight=1000.0, vertical_weight=0.0, centred_weight=0.0, depth_weight=0.0
        )


class LabelledGrasps(NamedTuple):
    """All M labelled grasps of a batch of scenes."""

    pose: Pose
    """(M, 3, 3) and (M, 3) [m]."""
    score: Tensor
    """(M,): s_q."""
    entry_point: Tensor
    """(M, 3): where the approach axes enter the objects [m]."""
    preference: Tensor
    """(M,): the greater, the rather this grasp is the one to learn."""
    object_index: Tensor
    """(M,): the object grasped."""
    scene: Tensor
    """(M,): the sample of the batch."""

    @classmethod
    def of(cls, batch: GraspBatch, config: MatchConfig) -> LabelledGrasps:
        """The grasps of a batch with their preference: score, and how vertical, centred and deep they are."""
        pose = Pose(batch.rotation, batch.translation)
        vertical = 0.5 + torch.asin((-pose.approach[:, 2]).clamp(-1.0, 1.0)) / math.pi
        centred = 1.0 - batch.contacts.sum(-1).abs() / batch.width[batch.grasp_batch]
        entry = ((batch.entry_point - pose.translation) * pose.approach).sum(-1)
        off = (entry - config.preferred_entry).abs() / config.preferred_entry
        preference = (
            batch.score
            + config.vertical_weight * vertical
            + config.centred_weight * centred
            - config.depth_weight * off
        )
        return cls(pose, batch.score, batch.entry_point, preference, batch.grasp_object, batch.grasp_batch)

    def take(self, chosen: Tensor) -> LabelledGrasps:
        """Those with these numbers (K,)."""
        pose = Pose(self.pose.rotation[chosen], self.pose.translation[chosen])
        return LabelledGrasps(pose, *(value[chosen] for value in self[1:]))


class Match(NamedTuple):
    """What anchors (P, A) or proposals (Q,) should learn."""

    label: Tensor
    """int64: POSITIVE, NEGATIVE or IGNORED."""
    grasp: Tensor
    """int64: the number of the labelled grasp of the batch; NO_GRASP where not positive."""


class StageTarget(NamedTuple):
    """What the losses of a stage compare its output with, (P, A) or (Q,)."""

    label: Tensor
    """int64: POSITIVE, NEGATIVE or IGNORED."""
    residual: Tensor
    """(..., 8): of the matched grasps; 0 where not positive."""
    quality: Tensor
    """(...,): s_q to learn; that of the matched grasps, NaN where not positive. Whoever knows better, as by judging the
    decoded proposals on the scene's meshes, may put that here, for negatives as well: losses learn what is not NaN."""


class Matcher:
    """Matches regions and proposals with labelled grasps of the same scene, all of a scene's at once."""

    def __init__(self, config: MatchConfig | None = None) -> None:
        self.config = config or MatchConfig()

    def match_regions(
        self,
        points: Tensor,
        scene: Tensor,
        anchors: Tensor,
        grasps: LabelledGrasps,
        point_object: Tensor | None = None,
    ) -> Match:
        """Match the anchors (A, 3) of P regions.

        Args:
            points: (P, 3) the regions' points [m].
            scene: (P,) int64, their samples in the batch.
            anchors: (A, 3) unit closing directions.
            grasps: all labelled grasps of the batch.
            point_object: (P,) int64, the objects of the points where known: a point on an object learns that object's
                grasps only, so that in clutter the network need not guess which one is meant. A point with a negative
                number (table, fixture) learns any object's.
        """
        match = _nothing(len(points), len(anchors), device=points.device)
        for rows, candidates, numbers in _by_scene(scene, grasps):
            on = None if point_object is None else point_object[rows]
            with torch.no_grad(), _full_precision(points):
                label, best = self._regions(points[rows], anchors, candidates, on)
            match.label[rows] = label
            match.grasp[rows] = torch.where(label == POSITIVE, numbers[best], NO_GRASP)
        return match

    def match_proposals(self, proposals: Pose, scene: Tensor, grasps: LabelledGrasps) -> Match:
        """Match Q proposals, (Q, 3, 3) and (Q, 3), of the batch's samples (Q,).

        A proposal is positive when some grasp is within d1, beta1 and gamma1 of it, and then learns the most preferred
        of those, nearness included. It is negative when no grasp is within d2, beta2 and gamma2 of it.
        """
        match = _nothing(len(scene), device=scene.device)
        for rows, candidates, numbers in _by_scene(scene, grasps):
            some = Pose(proposals.rotation[rows], proposals.translation[rows])
            with torch.no_grad(), _full_precision(some.translation):
                label, best = self._proposals(some, candidates)
            match.label[rows] = label
            match.grasp[rows] = torch.where(label == POSITIVE, numbers[best], NO_GRASP)
        return match

    def _regions(
        self, points: Tensor, anchors: Tensor, grasps: LabelledGrasps, point_object: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Labels (P, A) and numbers (P, A) of grasps in one scene."""
        cfg = self.config
        distance = _distances(points, grasps.entry_point)
        near = distance <= cfg.radius
        if point_object is not None:
            near &= (point_object[:, None] == grasps.object_index) | (point_object < 0)[:, None]
        utility = (grasps.preference - cfg.distance_weight * distance / cfg.radius).masked_fill(~near, -math.inf)
        cosine = (anchors @ grasps.pose.closing.T).abs()  # (A, M)
        best = utility.max(dim=1, keepdim=True).values
        # One anchor at a time: a table of points, anchors and grasps together would be A times as large.
        value, number = zip(*(_best(utility, row >= math.cos(cfg.alpha1)) for row in cosine), strict=True)
        wider, _ = zip(*(_best(utility, row >= math.cos(cfg.alpha2)) for row in cosine), strict=True)
        inner = torch.stack(value, 1) >= best - cfg.margin1
        outer = torch.stack(wider, 1) >= best - cfg.margin2
        found = best.isfinite()
        return _labels(found & inner, found & outer), torch.stack(number, 1)

    def _proposals(self, proposals: Pose, grasps: LabelledGrasps) -> tuple[Tensor, Tensor]:
        """Labels (Q,) and numbers (Q,) of grasps in one scene."""
        cfg = self.config
        distance = _distances(proposals.translation, grasps.pose.translation)
        closing = (proposals.closing @ grasps.pose.closing.T).abs()
        approach = proposals.approach @ grasps.pose.approach.T
        inner = torch.maximum(distance / cfg.d1, torch.maximum(_turn(closing, cfg.beta1), _turn(approach, cfg.gamma1)))
        outer = torch.maximum(distance / cfg.d2, torch.maximum(_turn(closing, cfg.beta2), _turn(approach, cfg.gamma2)))
        utility = (grasps.preference - cfg.change_weight * inner).masked_fill(inner > 1.0, -math.inf)
        value, best = utility.max(dim=1)
        return _labels(value.isfinite(), (outer <= 1.0).any(dim=1)), best


def region_targets(coder: GraspCoder, points: Tensor, match: Match, grasps: LabelledGrasps) -> StageTarget:
    """What the anchors (P, A) of regions at points (P, 3) [m] learn."""
    rows, anchor = (match.label == POSITIVE).nonzero(as_tuple=True)
    own = grasps.take(match.grasp[rows, anchor])
    return _target(match, own, coder.encode(points[rows], anchor, own.pose))


def proposal_targets(coder: RefineCoder, proposals: Pose, match: Match, grasps: LabelledGrasps) -> StageTarget:
    """What refined proposals (Q,) learn."""
    (rows,) = (match.label == POSITIVE).nonzero(as_tuple=True)
    own = grasps.take(match.grasp[rows])
    base = Pose(proposals.rotation[rows], proposals.translation[rows])
    return _target(match, own, coder.encode(base, own.pose))


def _target(match: Match, own: LabelledGrasps, code: Tensor) -> StageTarget:
    positive = match.label == POSITIVE
    residual = code.new_zeros((*match.label.shape, RESIDUALS))
    quality = code.new_full(match.label.shape, math.nan)
    residual[positive], quality[positive] = code, own.score.to(code.dtype)
    return StageTarget(match.label, residual, quality)


def _nothing(*shape: int, device: torch.device) -> Match:
    return Match(
        torch.full(shape, NEGATIVE, dtype=torch.int64, device=device),
        torch.full(shape, NO_GRASP, dtype=torch.int64, device=device),
    )


def _by_scene(scene: Tensor, grasps: LabelledGrasps) -> list[tuple[Tensor, LabelledGrasps, Tensor]]:
    """Rows that belong together: rows of ``scene`` (P,), the grasps of their scene, and those grasps' numbers."""
    parts = []
    for one in scene.unique().tolist():
        numbers = (grasps.scene == one).nonzero().squeeze(1)
        if len(numbers) == 0:
            continue
        own = grasps.take(numbers)
        rows = (scene == one).nonzero().squeeze(1)
        parts += [(some, own, numbers) for some in rows.split(max(1, _PAIRS // len(numbers)))]
    return parts


def _full_precision(like: Tensor) -> torch.autocast:
    """No autocast: matrix products of coordinates and directions are geometry here."""
    return torch.autocast(like.device.type, enabled=False)


def _labels(inner: Tensor, outer: Tensor) -> Tensor:
    label = torch.where(outer, IGNORED, NEGATIVE)
    return torch.where(inner, POSITIVE, label)


def _distances(a: Tensor, b: Tensor) -> Tensor:
    """(P, M) between points (P, 3) and (M, 3) [m]; exact, where the product form would be off by millimetres."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def _best(utility: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Greatest utility (P,) among the chosen (M,) grasps of (P, M), -inf without any, and the grasps' numbers (P,)."""
    value, number = utility.masked_fill(~chosen, -math.inf).max(dim=1)
    return value, number


def _turn(cosine: Tensor, limit: float) -> Tensor:
    """A measure of an angle with the given cosine: 0 for none, 1 at the limit [rad]."""
    return (1.0 - cosine) / (1.0 - math.cos(limit))
