"""Checks of the numbers that users give; each error names the value, what it is and what would be right."""

from __future__ import annotations

import math
from numbers import Integral, Real

import numpy as np
import numpy.typing as npt

from regnet_core.errors import InvalidInputError


def is_number(value: object) -> bool:
    """Whether the value is a real number of Python or numpy; truth values, NaN, texts and arrays are none."""
    return not isinstance(value, bool) and isinstance(value, Real) and value == value


def is_whole(value: object) -> bool:
    """Whether the value is a whole number of Python or numpy."""
    return not isinstance(value, bool) and isinstance(value, Integral)


def check_range(name: str, value: float, low: float, high: float = math.inf, unit: str = "") -> None:
    """Check that low <= value <= high; a high of infinity allows every finite value.

    Raises:
        InvalidInputError: it is not, or it is no number.
    """
    if not is_number(value) or not low <= value <= high or value == math.inf:
        wanted = f"in [{low:g}, {high:g}]" if math.isfinite(high) else f"a finite number of at least {low:g}"
        raise InvalidInputError(f"{name} must be {wanted}{unit and ' '}{unit}, got {shown(value)}")


def shown(value: object) -> str:
    """A value as an error message shows it."""
    if isinstance(value, float | np.floating):
        return f"{value:g}"
    return str(value) if is_number(value) else repr(value)


def as_vector(name: str, value: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Three finite numbers as an array (3,).

    Raises:
        InvalidInputError: they are something else.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # nested sequences of different lengths
        array = np.zeros(0)
    if array.shape != (3,) or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise InvalidInputError(f"{name} must be 3 finite numbers, got {value!r}")
    return array.astype(np.float64)


def as_transform(name: str, value: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """A finite homogeneous transform as an array (4, 4).

    Raises:
        InvalidInputError: it is something else.
    """
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{name} must be a (4, 4) matrix of numbers: {error}") from error
    if matrix.shape != (4, 4):
        raise InvalidInputError(f"{name} must be a (4, 4) matrix, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InvalidInputError(f"{name} must hold finite numbers, got {matrix.tolist()}")
    return matrix
