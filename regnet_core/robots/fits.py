"""The two curves of the analytic policy, fitted to counts of successes by maximum likelihood.

P(reach) = 1 / (1 + exp(-slope (s_v - midpoint)))
P(grasp | reach) = gain s_q + offset, cut off at 0 and 1
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.special import expit, log_expit

from regnet_core.errors import InvalidInputError, RegnetError
from regnet_core.geometry import Array

LAPSE = 1e-3
"""Where the line is at or beyond 0 or 1, a success or a failure still has this probability."""


class FitError(RegnetError):
    """The samples do not determine the curve; the message says why."""


class Samples(NamedTuple):
    """Trials at values of a score: one row each, or many rows of one value put together."""

    score: Array
    """(N,) s_v or s_q."""
    successes: Array
    """(N,)"""
    trials: Array
    """(N,) at least the successes."""

    @classmethod
    def of(cls, score: npt.ArrayLike, success: npt.ArrayLike, trials: npt.ArrayLike = 1.0) -> Samples:
        """Rows as arrays.

        Raises:
            InvalidInputError: shapes differ, a number is not finite, or successes are not in [0, trials].
        """
        score, success = np.asarray(score, float), np.asarray(success, float)
        trials = np.broadcast_to(np.asarray(trials, float), score.shape)
        if score.ndim != 1 or success.shape != score.shape:
            raise InvalidInputError(f"scores and successes are (N,) and (N,), got {score.shape} and {success.shape}")
        if not all(np.isfinite(values).all() for values in (score, success, trials)):
            raise InvalidInputError("scores, successes and trials must be finite")
        if ((success < 0.0) | (success > trials)).any():
            raise InvalidInputError("successes must be in [0, trials]")
        return cls(score, success, trials)


class ReachFit(NamedTuple):
    """P(reach) over the vertical score."""

    slope: float
    midpoint: float
    slope_error: float
    """Standard error."""
    midpoint_error: float

    def probability(self, vertical_score: npt.ArrayLike) -> Array:
        """(N,) of vertical scores (N,)."""
        return expit(self.slope * (np.asarray(vertical_score, float) - self.midpoint))


class GraspFit(NamedTuple):
    """P(grasp | reach) over the quality."""

    gain: float
    offset: float
    gain_error: float
    """Standard error."""
    offset_error: float

    def probability(self, quality: npt.ArrayLike) -> Array:
        """(N,) of qualities (N,)."""
        return np.clip(self.gain * np.asarray(quality, float) + self.offset, 0.0, 1.0)


def fit_reach(samples: Samples) -> ReachFit:
    """Slope and midpoint with the greatest likelihood, and standard errors from its curvature there.

    Raises:
        FitError: all poses were reached, or none, or a single value of s_v separates those that were from the others.
    """
    _check_mixed(samples, "reached")
    yes = samples.score[samples.successes > 0.0]
    no = samples.score[samples.successes < samples.trials]
    if yes.min() > no.max() or yes.max() < no.min():
        raise FitError("a single vertical score separates what was reached from what was not: take more samples")

    def loss(line: Array) -> tuple[float, Array]:
        a, b = line
        z = a * samples.score + b
        failures = samples.trials - samples.successes
        value = -np.sum(samples.successes * log_expit(z) + failures * log_expit(-z))
        residual = samples.trials * expit(z) - samples.successes
        return float(value), np.array([np.sum(residual * samples.score), np.sum(residual)])

    a, b = _minimum(loss, np.array([1.0, -float(np.mean(samples.score))]), jac=True)
    p = expit(a * samples.score + b)
    weight = samples.trials * p * (1.0 - p)
    covariance = _inverse(_moments(samples.score, weight), "P(reach)")
    gradient = np.array([b / a**2, -1.0 / a])  # of the midpoint -b / a
    return ReachFit(
        float(a),
        float(-b / a),
        float(np.sqrt(covariance[0, 0])),
        float(np.sqrt(gradient @ covariance @ gradient)),
    )


def fit_grasp(samples: Samples) -> GraspFit:
    """Gain and offset with the greatest likelihood, and standard errors from the information of the line.

    Where the line leaves [0, 1] it is cut off LAPSE inside, so that one lucky grasp of low quality does not tilt it.

    Raises:
        FitError: all grasps held or none, or all have one quality.
    """
    _check_mixed(samples, "held")

    def loss(line: Array) -> float:
        p = np.clip(line[0] * samples.score + line[1], LAPSE, 1.0 - LAPSE)
        failures = samples.trials - samples.successes
        return float(-np.sum(samples.successes * np.log(p) + failures * np.log1p(-p)))

    gain, offset = _minimum(loss, _least_squares(samples), jac=False)
    p = gain * samples.score + offset
    inside = (p > LAPSE) & (p < 1.0 - LAPSE)
    p = np.clip(p, LAPSE, 1.0 - LAPSE)
    information = _moments(samples.score, np.where(inside, samples.trials / (p * (1.0 - p)), 0.0))
    covariance = _inverse(information, "P(grasp | reach)")
    return GraspFit(float(gain), float(offset), float(np.sqrt(covariance[0, 0])), float(np.sqrt(covariance[1, 1])))


def _check_mixed(samples: Samples, what: str) -> None:
    successes, trials = float(samples.successes.sum()), float(samples.trials.sum())
    if trials == 0.0 or successes in (0.0, trials):
        raise FitError(f"{successes:g} of {trials:g} samples were {what}: a curve needs some that were and some not")
    if np.ptp(samples.score[samples.trials > 0.0]) < 1e-9:
        raise FitError("all samples have one score: a curve needs several")


def _minimum(loss: Callable[[Array], object], start: Array, jac: bool) -> Array:
    method, options = ("BFGS", {"gtol": 1e-7}) if jac else ("Nelder-Mead", {"xatol": 1e-9, "fatol": 1e-9})
    found = minimize(loss, start, jac=jac, method=method, options=options)
    if not np.isfinite(found.x).all():
        raise FitError(f"the fit did not come to an end: {found.message}")
    return np.asarray(found.x, float)


def _least_squares(samples: Samples) -> Array:
    """Gain and offset of the line through the shares of successes."""
    weighted = np.stack([samples.score, np.ones_like(samples.score)], axis=1) * samples.trials[:, None]
    return np.linalg.solve(_moments(samples.score, samples.trials), weighted.T @ _share(samples))


def _share(samples: Samples) -> Array:
    return np.divide(
        samples.successes, samples.trials, out=np.zeros_like(samples.successes), where=samples.trials > 0.0
    )


def _moments(score: Array, weight: Array) -> Array:
    """(2, 2) information about the two parameters of a line."""
    cross = float(np.sum(weight * score))
    return np.array([[float(np.sum(weight * score**2)), cross], [cross, float(np.sum(weight))]])


def _inverse(information: Array, curve: str) -> Array:
    try:
        return np.linalg.inv(information)
    except np.linalg.LinAlgError:
        raise FitError(f"the samples do not determine {curve}: take more of them") from None
