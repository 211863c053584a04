"""Known constants are recovered from synthetic counts, and what determines no curve is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from regnet_core.errors import InvalidInputError
from regnet_core.robots.fits import FitError, Samples, fit_grasp, fit_reach

PAPER = {"gain": 0.8783, "offset": -0.0587, "slope": 10.1244, "midpoint": 0.6103}


@pytest.mark.parametrize(("slope", "midpoint"), [(10.1244, 0.6103), (4.0, 0.3), (25.0, 0.8)])
def test_constants_of_the_reach_curve_are_recovered_within_2_percent(slope: float, midpoint: float) -> None:
    rng = np.random.default_rng(1)
    score = 0.5 + np.arcsin(rng.uniform(-1.0, 1.0, 200_000)) / np.pi  # approaches over the sphere, as they are drawn
    reached = rng.uniform(size=len(score)) < expit(slope * (score - midpoint))
    fit = fit_reach(Samples.of(score, reached))
    assert fit.slope == pytest.approx(slope, rel=0.02)
    assert fit.midpoint == pytest.approx(midpoint, rel=0.02)


@pytest.mark.parametrize(("gain", "offset"), [(0.8783, -0.0587), (0.5, 0.3), (1.2, -0.1)])
def test_constants_of_the_grasp_line_are_recovered_within_2_percent(gain: float, offset: float) -> None:
    """Also where the line leaves [0, 1], as the paper's does below s_q = 0.067 and 1.2 s_q - 0.1 above 0.917."""
    rng = np.random.default_rng(2)
    quality = np.linspace(0.0, 1.0, 201)
    trials = np.full(len(quality), 20_000)
    held = rng.binomial(trials, np.clip(gain * quality + offset, 0.0, 1.0))
    fit = fit_grasp(Samples.of(quality, held, trials))
    assert fit.gain == pytest.approx(gain, rel=0.02)
    assert fit.offset == pytest.approx(offset, rel=0.02)


def test_standard_errors_are_those_of_repeated_experiments() -> None:
    rng = np.random.default_rng(3)
    lines, curves = [], []
    for _ in range(120):
        score = rng.uniform(0.1, 1.0, 800)
        lines.append(fit_grasp(Samples.of(score, rng.uniform(size=800) < 0.6 * score + 0.2)))
        curves.append(fit_reach(Samples.of(score, rng.uniform(size=800) < expit(8.0 * (score - 0.6)))))
    for fits, value, error in (
        (lines, "gain", "gain_error"),
        (lines, "offset", "offset_error"),
        (curves, "slope", "slope_error"),
        (curves, "midpoint", "midpoint_error"),
    ):
        spread = np.std([getattr(fit, value) for fit in fits], ddof=1)
        assert np.mean([getattr(fit, error) for fit in fits]) == pytest.approx(spread, rel=0.25)


def test_counts_of_equal_scores_may_be_put_together() -> None:
    rng = np.random.default_rng(4)
    score = rng.choice([0.2, 0.4, 0.5, 0.7, 0.9], 3000)
    success = (rng.uniform(size=3000) < 0.7 * score + 0.1).astype(float)
    values = np.unique(score)
    together = Samples.of(
        values, [success[score == v].sum() for v in values], [float((score == v).sum()) for v in values]
    )
    apart = Samples.of(score, success)
    assert np.array(fit_grasp(together)) == pytest.approx(np.array(fit_grasp(apart)), rel=1e-4)
    assert np.array(fit_reach(together)) == pytest.approx(np.array(fit_reach(apart)), rel=1e-4)


def test_a_lucky_grasp_of_low_quality_does_not_tilt_the_line() -> None:
    quality = np.concatenate([np.linspace(0.1, 1.0, 1000)])
    held = np.random.default_rng(5).uniform(size=1000) < np.clip(1.1 * quality - 0.1, 0.0, 1.0)
    without = fit_grasp(Samples.of(quality, held))
    lucky = fit_grasp(Samples.of(np.append(quality, 0.02), np.append(held, True)))
    assert lucky.gain == pytest.approx(without.gain, abs=0.1)


def test_probabilities_are_those_of_the_curves() -> None:
    fit = fit_reach(Samples.of([0.2, 0.6, 0.6, 0.9], [0, 5, 5, 10], [10, 10, 10, 10]))
    assert fit.probability([fit.midpoint])[0] == pytest.approx(0.5)
    assert fit.probability([fit.midpoint + 1.0 / fit.slope])[0] == pytest.approx(1.0 / (1.0 + np.exp(-1.0)))
    line = fit_grasp(Samples.of([0.2, 0.8], [200, 800], [1000, 1000]))
    assert line.probability([0.5, 2.0, -1.0]) == pytest.approx([0.5, 1.0, 0.0], abs=1e-3)


@pytest.mark.parametrize("fit", [fit_reach, fit_grasp])
@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (Samples.of([0.1, 0.5, 0.9], [1, 1, 1]), "3 of 3 samples"),
        (Samples.of([0.1, 0.5, 0.9], [0, 0, 0]), "0 of 3 samples"),
        (Samples.of([0.5, 0.5], [1, 0]), "one score"),
    ],
)
def test_samples_that_determine_no_curve_are_refused(fit: object, samples: Samples, message: str) -> None:
    with pytest.raises(FitError, match=message):
        fit(samples)  # type: ignore[operator]


def test_a_step_is_no_curve() -> None:
    score = np.linspace(0.0, 1.0, 100)
    with pytest.raises(FitError):
        fit_reach(Samples.of(score, score > 0.5))


@pytest.mark.parametrize(
    ("score", "successes", "trials"),
    [([0.1, np.nan], [0, 1], 1), ([0.1, 0.2], [0, 2], 1), ([0.1, 0.2], [0, -1], 1), ([0.1], [0, 1], 1)],
)
def test_samples_that_cannot_be_are_refused(score: list[float], successes: list[float], trials: float) -> None:
    with pytest.raises(InvalidInputError):
        Samples.of(score, successes, trials)
