"""The losses against numbers worked out by hand."""

import math

import pytest
import torch

from regnet_core.errors import InvalidInputError
from regnet_core.nn.anchors import GraspCoder, Pose
from regnet_core.nn.losses import (
    LossConfig,
    focal_loss,
    score_loss,
    soft_cross_entropy,
    stage_loss,
)
from regnet_core.nn.matching import IGNORED, NEGATIVE, POSITIVE, StageTarget
from regnet_core.nn.results import StagePrediction

LN2 = math.log(2.0)


def prediction(logit: list, residual: list | None = None, quality: list | None = None) -> StagePrediction:
    shape = torch.tensor(logit).shape
    return StagePrediction(
        torch.tensor(logit, requires_grad=True),
        torch.zeros(*shape, 8).requires_grad_() if residual is None else torch.tensor(residual, requires_grad=True),
        torch.zeros(shape).requires_grad_() if quality is None else torch.tensor(quality, requires_grad=True),
    )


def target(label: list, residual: list | None = None, quality: list | None = None) -> StageTarget:
    shape = torch.tensor(label).shape
    return StageTarget(
        torch.tensor(label),
        torch.zeros(*shape, 8) if residual is None else torch.tensor(residual),
        torch.full(shape, math.nan) if quality is None else torch.tensor(quality),
    )


NAN = math.nan

# Focal loss


@pytest.mark.parametrize(
    ("logit", "positive", "expected"),
    [
        (0.0, True, 0.25 * 0.25 * LN2),  # p = 1/2: alpha (1 - p)^2 ln 2
        (0.0, False, 0.75 * 0.25 * LN2),
        (math.log(3.0), True, 0.25 * (1 / 16) * math.log(4 / 3)),  # p = 3/4
        (math.log(3.0), False, 0.75 * (9 / 16) * math.log(4.0)),
    ],
)
def test_focal_loss_by_hand(logit: float, positive: bool, expected: float) -> None:
    assert focal_loss(torch.tensor(logit), torch.tensor(positive)).item() == pytest.approx(expected, rel=1e-5)


def test_focal_loss_without_focus_is_weighted_cross_entropy() -> None:
    logit = torch.linspace(-3, 3, 7)
    loss = focal_loss(logit, torch.ones(7, dtype=torch.bool), alpha=1.0, gamma=0.0)
    assert torch.allclose(loss, torch.log1p(torch.exp(-logit)), atol=1e-6)


def test_focal_loss_of_sure_outputs_is_finite() -> None:
    logit = torch.tensor([-200.0, 200.0, -200.0, 200.0], requires_grad=True)
    loss = focal_loss(logit, torch.tensor([True, True, False, False])).sum()
    loss.backward()  # type: ignore[no-untyped-call]
    assert loss.item() == pytest.approx(0.25 * 200 + 0.75 * 200)
    assert logit.grad is not None and logit.grad.isfinite().all()


# Score Network


def test_cross_entropy_is_zero_where_the_confidence_is_met() -> None:
    share = torch.tensor([0.0, 0.2, 0.5, 0.9, 1.0])
    logit = torch.logit(share).clamp(-30, 30)
    assert soft_cross_entropy(logit, share).abs().max() < 1e-6


def test_cross_entropy_by_hand() -> None:
    """Output 1/2 and share 1/4: ln 2 less the entropy of 1/4."""
    entropy = 0.25 * math.log(4.0) + 0.75 * math.log(4 / 3)
    assert score_loss(torch.zeros(3), torch.full((3,), 0.25)).item() == pytest.approx(LN2 - entropy, rel=1e-6)
    assert score_loss(torch.zeros(1), torch.zeros(1)).item() == pytest.approx(LN2, rel=1e-6)


def test_squared_error_is_the_papers() -> None:
    logit, confidence = torch.tensor([0.0, math.log(3.0)]), torch.tensor([0.1, 0.25])
    assert score_loss(logit, confidence, LossConfig(score="squared")).item() == pytest.approx((0.4**2 + 0.5**2) / 2)


def test_a_sure_mistake_is_unlearnt_by_cross_entropy_only() -> None:
    def gradient(score: str) -> float:
        logit = torch.tensor([12.0], requires_grad=True)
        score_loss(logit, torch.zeros(1), LossConfig(score=score)).backward()  # type: ignore[arg-type]
        assert logit.grad is not None
        return float(logit.grad)

    assert gradient("cross_entropy") == pytest.approx(1.0, abs=1e-4)
    assert gradient("squared") < 1e-4


# Stages


def test_a_stage_by_hand() -> None:
    """One positive, one negative and one ignored anchor, all logits 0."""
    off = [0.3, -0.05, 0.0, 0.0, 0.2, 0.0, -0.4, 0.02]
    anything = [9.0] * 8
    predicted = prediction([[0.0, 0.0, 0.0]], [[off, anything, anything]], [[0.0, 5.0, 5.0]])
    loss = stage_loss(predicted, target([[POSITIVE, NEGATIVE, IGNORED]], quality=[[1.0, NAN, NAN]]))
    # Smooth L1 with beta 0.1: |x| - 0.05 beyond 0.1, x^2 / 0.2 within.
    centre = (0.25 + 0.0125 + 0.0) / 3
    closing = (0.0 + 0.15 + 0.0) / 3
    theta = (0.35 + 0.002) / 2
    classification = (0.25 * 0.25 * LN2 + 0.75 * 0.25 * LN2) / 2
    assert loss.classification.item() == pytest.approx(classification, rel=1e-5)
    assert loss.centre.item() == pytest.approx(centre, rel=1e-5)
    assert loss.closing.item() == pytest.approx(closing, rel=1e-5)
    assert loss.theta.item() == pytest.approx(theta, rel=1e-5)
    assert loss.quality.item() == pytest.approx(LN2, rel=1e-5)
    total = 0.2 * classification + centre + closing + theta + LN2
    assert loss.total.item() == pytest.approx(total, rel=1e-5)


def test_a_known_quality_is_learnt_whatever_the_label() -> None:
    predicted = prediction([0.0] * 3, quality=[0.0] * 3)
    loss = stage_loss(predicted, target([POSITIVE, NEGATIVE, IGNORED], quality=[NAN, 0.0, 0.5]))
    assert loss.quality.item() == pytest.approx(LN2 / 2, rel=1e-5)  # ln 2 of the one that is 0, nothing of the other
    loss.total.backward()  # type: ignore[no-untyped-call]
    assert predicted.quality.grad is not None and predicted.quality.grad.isfinite().all()


def test_weights() -> None:
    predicted, wanted = prediction([0.0], [[1.0] * 8]), target([POSITIVE], quality=[1.0])
    plain = stage_loss(predicted, wanted)
    weighted = stage_loss(predicted, wanted, LossConfig(lambda_cls=3.0, lambda_u=0.5)).total.item()
    terms = (plain.centre + plain.closing + plain.theta + plain.quality).item()
    assert weighted == pytest.approx(3.0 * plain.classification.item() + 0.5 * terms, rel=1e-6)


def test_ignored_ones_get_no_gradient_and_negatives_only_that_of_the_class() -> None:
    predicted = prediction([0.0, 0.0, 0.0], [[0.5] * 8] * 3, [0.3] * 3)
    stage_loss(predicted, target([POSITIVE, NEGATIVE, IGNORED], quality=[0.5, NAN, NAN])).total.backward()  # type: ignore[no-untyped-call]
    for output, reached in ((predicted.logit, [True, True, False]), (predicted.quality, [True, False, False])):
        assert output.grad is not None
        assert (output.grad != 0).tolist() == reached
    assert predicted.residual.grad is not None
    assert (predicted.residual.grad != 0).any(dim=1).tolist() == [True, False, False]


@pytest.mark.parametrize("label", [[NEGATIVE, IGNORED], [IGNORED, IGNORED], []])
def test_without_positives_the_loss_and_its_gradients_are_finite(label: list[int]) -> None:
    count = len(label)
    predicted = StagePrediction(
        torch.zeros(count, requires_grad=True), torch.ones(count, 8, requires_grad=True),
        torch.ones(count, requires_grad=True),
    )  # fmt: skip
    wanted = StageTarget(torch.tensor(label, dtype=torch.int64), torch.zeros(count, 8), torch.full((count,), NAN))
    loss = stage_loss(predicted, wanted)
    assert [loss.centre.item(), loss.closing.item(), loss.theta.item(), loss.quality.item()] == [0.0] * 4
    if NEGATIVE not in label:
        assert loss.total.item() == 0.0
    loss.total.backward()  # type: ignore[no-untyped-call]
    for output in predicted:
        assert output.grad is not None and output.grad.isfinite().all()
    assert predicted.residual.grad is not None and not predicted.residual.grad.any()


def test_the_loss_does_not_depend_on_how_often_a_batch_is_repeated() -> None:
    once = prediction([0.3, -0.2], [[0.5] * 8] * 2, [0.1, 0.2])
    twice = StagePrediction(*(torch.cat([value, value]) for value in once))
    wanted = target([POSITIVE, NEGATIVE], quality=[0.7, NAN])
    again = StageTarget(*(torch.cat([value, value]) for value in wanted))
    assert stage_loss(twice, again).total.item() == pytest.approx(stage_loss(once, wanted).total.item(), rel=1e-6)


def test_bf16_outputs_are_summed_in_full_precision() -> None:
    predicted = StagePrediction(*(value.bfloat16() for value in prediction([0.0] * 3, [[0.5] * 8] * 3)))
    assert stage_loss(predicted, target([POSITIVE] * 3)).total.dtype == torch.float32


def test_both_forms_of_a_jaw_cost_the_same() -> None:
    """The coder gives both one code, so that a network that predicts one of them loses nothing by the other."""
    rotation = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    centre, point, number = torch.zeros(3), torch.tensor([0.0, 0.0, -0.03]), torch.tensor(0)
    there, back = (
        GraspCoder().encode(point, number, Pose(rotation * torch.tensor([1.0, sign, sign]), centre))
        for sign in (1.0, -1.0)
    )
    predicted = StagePrediction(torch.zeros(1), there[None], torch.zeros(1))
    losses = [
        stage_loss(predicted, StageTarget(torch.tensor([POSITIVE]), code[None], torch.full((1,), 0.5)))
        for code in (there, back)
    ]
    assert losses[0].total.item() == losses[1].total.item()
    assert losses[1].closing.item() == 0.0 and losses[1].theta.item() == 0.0


@pytest.mark.parametrize("wrong", [{"score": "huber"}, {"focal_alpha": 1.5}, {"beta": 0.0}, {"lambda_cls": -1.0}])
def test_impossible_weights_are_refused(wrong: dict) -> None:
    with pytest.raises(InvalidInputError):
        LossConfig(**wrong)
