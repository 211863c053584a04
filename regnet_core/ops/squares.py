"""The largest and the smallest value of the squares around the cells of a map: dilation, erosion and closing.

As ``scipy.ndimage`` has them for maps of truth values and of heights, where what lies outside the map does not count;
a few times faster on maps of the size of a table's.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from regnet_core.ops.compiled import compiled

Number = TypeVar("Number", bound=np.generic)


def dilated(values: npt.NDArray[Number], reach: int) -> npt.NDArray[Number]:
    """(nx, ny): the largest of the finite values (nx, ny) within ``reach`` cells along both axes."""
    return _along(_along(values, reach, 0, np.maximum), reach, 1, np.maximum)


def eroded(values: npt.NDArray[Number], reach: int) -> npt.NDArray[Number]:
    """(nx, ny): the smallest of the finite values (nx, ny) within ``reach`` cells along both axes."""
    return _along(_along(values, reach, 0, np.minimum), reach, 1, np.minimum)


def closed(values: npt.NDArray[Number], reach: int) -> npt.NDArray[Number]:
    """(nx, ny): dilated, then eroded: gaps of up to twice the reach are filled."""
    return eroded(dilated(values, reach), reach)


def _along(values: npt.NDArray[Number], reach: int, axis: int, best: np.ufunc) -> npt.NDArray[Number]:
    plain: npt.NDArray[Any] = values.view(np.uint8) if values.dtype == np.bool_ else values
    found = plain.copy(order="C")
    _best_along(np.ascontiguousarray(plain), reach, axis, best is np.maximum, found)
    return found.view(values.dtype)


@compiled
def _best_along(values, reach, axis, largest, found):  # type: ignore[no-untyped-def]
    rows, columns = values.shape
    for i in range(rows):
        for step in range(-reach, reach + 1):
            if axis == 0:
                if i + step < 0 or i + step >= rows:
                    continue
                row, other = found[i], values[i + step]
            else:
                row = found[i, max(0, -step) : max(0, min(columns, columns - step))]
                other = values[i, max(0, step) : max(0, min(columns, columns + step))]
            if largest:
                for j in range(len(row)):
                    one, two = row[j], other[j]
                    row[j] = one if one > two else two
            else:
                for j in range(len(row)):
                    one, two = row[j], other[j]
                    row[j] = one if one < two else two
