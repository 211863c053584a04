"""The largest and the smallest value of the squares around the cells of a map: dilation, erosion and closing.

As ``scipy.ndimage`` has them for maps of truth values and of heights, where what lies outside the map does not count;
a few times faster on maps of the size of a table's.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Number = TypeVar("Number", bound=np.generic)


def dilated(values: npt.NDArray[Number], reach: int) -> npt.NDArray[Number]:
    """(nx, ny): the largest value of (nx, ny) within ``reach`` cells along both axes."""
    return _along(_along(values, reach, 0, np.maximum), reach, 1, np.maximum)


def eroded(values: npt.NDArray[Number], reach: int) -> npt.NDArray[Number]:
    """(nx, ny): the smallest value of (nx, ny) within ``reach`` cells along both axes."""
    return _along(_along(values, reach, 0, np.minimum), reach, 1, np.minimum)


def closed(values: npt.NDArray[Number], reach: int) -> npt.NDArray[Number]:
    """(nx, ny): dilated, then eroded: gaps of up to twice the reach are filled."""
    return eroded(dilated(values, reach), reach)


def _along(values: npt.NDArray[Number], reach: int, axis: int, best: np.ufunc) -> npt.NDArray[Number]:
    found = values if axis == 0 else values.T
    known = 0
    while known < reach:  # what is known of three cells says it of all between them, at the border too
        step = min(known + 1, reach - known)
        given, found = found, found.copy()
        if step < len(given):
            best(found[step:], given[:-step], out=found[step:])
            best(found[:-step], given[step:], out=found[:-step])
        known += step
    return found if axis == 0 else found.T
