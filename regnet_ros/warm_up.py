"""Made-up clouds to work on once, so that code is compiled and loaded before the first real one.

They are small, and loops that are worth a second core only for larger clouds are compiled when such a cloud comes.
"""

from __future__ import annotations

import numpy as np

from regnet_core.geometry import Array

_SPACING = 0.0025
"""Gives as many points as networks take: what is prepared for this number need not be for the first real cloud."""


def made_up_cloud() -> Array:
    """A table-top of 0.4 m with a box of 0.04 x 0.06 x 0.08 m on it, seen from all sides: points (N, 3) [m]."""
    table = _sheet(0.4, 0.4)
    top = _moved(_sheet(0.04, 0.06), z=0.08)
    along_x = _sheet(0.04, 0.08)[:, [0, 2, 1]]
    along_y = _sheet(0.06, 0.08)[:, [2, 0, 1]]
    sides = [_moved(along_x, y=y, z=0.04) for y in (-0.03, 0.03)] + [
        _moved(along_y, x=x, z=0.04) for x in (-0.02, 0.02)
    ]
    return np.concatenate([table, top, *sides])


def made_up_clouds() -> tuple[Array, Array]:
    """That cloud, and the same with many points twice, which are thinned, and one that is not valid."""
    points = made_up_cloud()
    return points, np.concatenate([points, points[::5], np.full((1, 3), np.nan)])


def _moved(points: Array, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
    return points + np.array([x, y, z])


def _sheet(length: float, width: float) -> Array:
    """A grid of points in the plane z = 0, centred on the origin."""
    x, y = (np.arange(-size / 2, size / 2 + 1e-9, _SPACING) for size in (length, width))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.column_stack([grid, np.zeros(len(grid))])
