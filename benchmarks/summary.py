"""Order statistics of repeated measurements, and the straight line that tells growth from noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from regnet_core.errors import InvalidInputError


@dataclass(frozen=True)
class Summary:
    """Measurements of one thing, in the unit of the measurements."""

    count: int
    median: float
    lower: float
    """First quartile."""
    upper: float
    """Third quartile."""
    least: float
    most: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Summary:
        """Summarise at least one measurement; quartiles are interpolated.

        Raises:
            InvalidInputError: there is none, or one is not finite.
        """
        array = np.asarray(values, dtype=np.float64)
        if array.ndim != 1 or len(array) == 0 or not np.isfinite(array).all():
            raise InvalidInputError(f"a summary needs at least one finite number, got {list(values)!r}")
        lower, median, upper = (float(value) for value in np.quantile(array, [0.25, 0.5, 0.75]))
        return cls(len(array), median, lower, upper, float(array.min()), float(array.max()))

    def scaled(self, factor: float) -> Summary:
        """The same in another unit, for a factor above 0."""
        rest = (self.median, self.lower, self.upper, self.least, self.most)
        return Summary(self.count, *(factor * value for value in rest))


@dataclass(frozen=True)
class Line:
    """A straight line through points, by least squares."""

    slope: float
    error: float
    """Standard error of the slope; measurements that depend on each other make it too small."""
    intercept: float


def fit_line(x: Sequence[float], y: Sequence[float]) -> Line:
    """The line y = intercept + slope x.

    Raises:
        InvalidInputError: there are fewer than three points, or all have one x.
    """
    at, values = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if at.shape != values.shape or len(at) < 3 or np.ptp(at) == 0.0:
        raise InvalidInputError(f"a line needs three points at different places, got {len(at)} and {len(values)}")
    centred = at - at.mean()
    squares = float(centred @ centred)
    slope = float(centred @ values) / squares
    intercept = float(values.mean() - slope * at.mean())
    residuals = values - intercept - slope * at
    error = float(np.sqrt(residuals @ residuals / (len(at) - 2) / squares))
    return Line(slope, error, intercept)
