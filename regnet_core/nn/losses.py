"""Losses of the three stages, eqs. (2), (3) and (4) of REGNet V2. They add numbers up; geometry is in the coders.

(2) Score Network: the point grasp confidence. The paper takes the squared error. Nine of ten points are on the table
    and have confidence 0; through a sigmoid, the squared error's gradient vanishes where the output is wrong and sure.
    The default is the cross entropy with the confidence as a soft label, less its least possible value: as the
    squared error it is 0 when the confidence is met and least at the mean when it is uncertain, but it lets no
    point go unlearnt.
(3) Grasp Region Network, over the anchors of all regions, and
(4) Refine Network, over the proposals: lambda_cls times the focal loss of being positive, plus lambda_u times the sum
    of the terms u: place, closing direction, theta, and quality. Ignored ones do not count as a class, only positive
    ones have residuals to learn, and those whose quality is known have that to learn. The residuals' terms are smooth
    L1 with a narrow quadratic part: where the labels leave several modes, its least value is at one of them, while the
    squared error takes their mean. Quality is a soft label like the confidence.
Every term is a mean over what counts in it, so that none of them depends on how many points, regions or positives a
batch happens to have. A term without anything to count is 0 with a gradient of 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.nn.anchors import CENTRE, CLOSING, THETA
from regnet_core.nn.matching import IGNORED, POSITIVE, StageTarget
from regnet_core.nn.results import StagePrediction


@dataclass(frozen=True)
class LossConfig:
    """Weights and shapes of the losses.

    Raises:
        InvalidInputError: a number is out of range, or there is no such score loss.
    """

    score: Literal["cross_entropy", "squared"] = "cross_entropy"
    """Of the Score Network; "squared" is the paper's."""
    focal_alpha: float = 0.25
    """Weight of positives in the focal loss; negatives have 1 less that."""
    focal_gamma: float = 2.0
    """Exponent that takes weight from what is classified well already."""
    lambda_cls: float = 0.2
    """Weight of the classification."""
    lambda_u: float = 1.0
    """Weight of each regressed term."""
    beta: float = 0.1
    """Half-width of the quadratic part of the smooth L1, in units of the residuals; 1 is the paper's."""

    def __post_init__(self) -> None:
        if self.score not in ("cross_entropy", "squared"):
            raise InvalidInputError(f"score must be 'cross_entropy' or 'squared', got {self.score!r}")
        check_range("focal_alpha", self.focal_alpha, 0.0, 1.0)
        check_range("beta", self.beta, 1e-6)
        for name in ("focal_gamma", "lambda_cls", "lambda_u"):
            check_range(name, getattr(self, name), 0.0)


class StageLoss(NamedTuple):
    """The loss of a stage and its terms before weighting, each a number ()."""

    total: Tensor
    classification: Tensor
    centre: Tensor
    closing: Tensor
    theta: Tensor
    quality: Tensor


def score_loss(logit: Tensor, confidence: Tensor, config: LossConfig | None = None) -> Tensor:
    """Loss () of the Score Network, eq. (2): logits (...,) of points against their confidence (...,) in [0, 1]."""
    cfg = config or LossConfig()
    if cfg.score == "squared":
        return _mean((logit.float().sigmoid() - confidence.float()).square())
    return _mean(soft_cross_entropy(logit, confidence))


def stage_loss(predicted: StagePrediction, target: StageTarget, config: LossConfig | None = None) -> StageLoss:
    """Loss of the Grasp Region Network, eq. (3), or of the Refine Network, eq. (4)."""
    cfg = config or LossConfig()
    counts, positive, known = target.label != IGNORED, target.label == POSITIVE, ~target.quality.isnan()
    classification = _mean(focal_loss(predicted.logit[counts], positive[counts], cfg.focal_alpha, cfg.focal_gamma))
    off = functional.smooth_l1_loss(
        predicted.residual[positive].float(), target.residual[positive].float(), reduction="none", beta=cfg.beta
    )
    centre, closing, theta = (_mean(off[:, part]) for part in (CENTRE, CLOSING, THETA))
    quality = _mean(soft_cross_entropy(predicted.quality[known], target.quality[known]))
    total = cfg.lambda_cls * classification + cfg.lambda_u * (centre + closing + theta + quality)
    return StageLoss(total, classification, centre, closing, theta, quality)


def focal_loss(logit: Tensor, positive: Tensor, alpha: float = 0.25, gamma: float = 2.0) -> Tensor:
    """Focal loss (Lin et al. 2017) of logits (...,) against truth values (...,) -> (...,)."""
    logit, truth = logit.float(), positive.float()
    missed = torch.sigmoid(torch.where(positive, -logit, logit))
    weight = alpha * truth + (1.0 - alpha) * (1.0 - truth)
    return weight * missed**gamma * functional.binary_cross_entropy_with_logits(logit, truth, reduction="none")


def soft_cross_entropy(logit: Tensor, share: Tensor) -> Tensor:
    """Cross entropy of logits (...,) against soft labels (...,) in [0, 1], less their entropy: 0 at best -> (...,)."""
    logit, share = logit.float(), share.float()
    entropy = torch.special.entr(share) + torch.special.entr(1.0 - share)
    return functional.binary_cross_entropy_with_logits(logit, share, reduction="none") - entropy


def _mean(values: Tensor) -> Tensor:
    """The mean (); 0 of no values, still connected to what they were computed from."""
    return values.sum() / max(values.numel(), 1)
