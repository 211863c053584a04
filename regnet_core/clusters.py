"""Groups of points that belong together when seen from above, and what among them is too large to be grasped."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from regnet_core.geometry import Array, Mask
from regnet_core.ops.cell_map import CellMap
from regnet_core.ops.cells import cells_below
from regnet_core.ops.outline import convex_outline, corner_candidates, outside

Index = npt.NDArray[np.int64]

_MAIN = 0.1
"""Patches of the ground with fewer points than this share of the largest one's are not what things stand on."""
_STRIDE = np.int64(1) << 31
"""Combines two cell indices into one key; points within 1000 m have far smaller indices."""


class Clusters(NamedTuple):
    """Points (N, 3) grouped by connected cells of a horizontal grid."""

    label: npt.NDArray[np.signedinteger]
    """(N,): number of each point's cluster, from 0."""
    size: npt.NDArray[np.int64]
    """(K,): number of points of each cluster."""

    def mean(self, values: Array) -> Array:
        """The mean of values (N, D) over each cluster -> (K, D)."""
        sums = [np.bincount(self.label, weights=column, minlength=len(self.size)) for column in values.T]
        return np.stack(sums, axis=1) / self.size[:, None]

    def extent(self, points: Array) -> Array:
        """(K,): the longer side of each cluster's horizontal bounding box [m]."""
        sides = []
        for values in points[:, :2].T:
            low, high = np.full(len(self.size), np.inf), np.full(len(self.size), -np.inf)
            np.minimum.at(low, self.label, values)
            np.maximum.at(high, self.label, values)
            sides.append(high - low)
        return np.maximum(*sides)


def cluster(points: npt.NDArray[Any], cell: float = 0.02) -> Clusters:
    """Group points (N, >= 2) whose horizontal cells of edge length ``cell`` [m] touch, at a side or a corner.

    Clusters are numbered by their first cell, the one of least x and, among those, of least y.
    """
    if len(points) == 0:
        return Clusters(np.zeros(0, np.int64), np.zeros(0, np.int64))
    cells = CellMap.of(points, cell)
    if cells is None:
        label = _by_keys(cells_below(points, cell))
        return Clusters(label, np.bincount(label))
    group, size = cells.groups()
    return Clusters(cells.of_points(group), size)


def _by_keys(index: Index) -> Index:
    """The same for cells on too large a map."""
    keys, inverse = np.unique(index[:, 0] * _STRIDE + index[:, 1], return_inverse=True)
    rows, columns = [], []
    for step in (np.int64(1), _STRIDE - 1, _STRIDE, _STRIDE + 1):
        found = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        touching = np.flatnonzero(keys[found] == keys + step)
        rows.append(touching)
        columns.append(found[touching])
    row, column = np.concatenate(rows), np.concatenate(columns)
    graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), shape=(len(keys), len(keys)))
    return connected_components(graph, directed=False)[1].astype(np.int64)[inverse.reshape(-1)]


def structure(
    points: Array, height: Array, max_height: float, max_width: float = 0.3, cell: float = 0.04, gap: float = 0.1
) -> Mask:
    """(N,): which points belong to walls, people, furniture: to what is both taller and wider than any object.

    Args:
        points: (N, 3) [m].
        height: (N,) above the support plane [m].
        max_height: what stays lower is no structure [m].
        max_width: nor is a tall thing no wider than this [m].
        cell: edge length of the horizontal cells [m].
        gap: points of a cell that are this far below the next higher one are under it, not of it [m].
    """
    result = np.zeros(len(points), bool)
    tall = np.flatnonzero(height > max_height)
    if len(tall) == 0:
        return result
    groups = cluster(points[tall], cell)
    wide = tall[(groups.extent(points[tall]) > max_width)[groups.label]]
    if len(wide) == 0:
        return result
    index = cells_below(points, cell)
    keys = index[:, 0] * _STRIDE + index[:, 1]
    inside = np.flatnonzero(np.isin(keys, np.unique(keys[wide])))
    downwards = inside[np.lexsort((-height[inside], keys[inside]))]
    new_cell = np.diff(keys[downwards], prepend=np.int64(-1) << 62) != 0
    drop = np.diff(-height[downwards], prepend=0.0) > gap
    # Runs of points without a gap, from the top of each cell; only the first run of a cell is structure.
    run = np.cumsum(new_cell | drop)
    first_run = run[np.flatnonzero(new_cell)][np.cumsum(new_cell) - 1]
    result[downwards[run == first_run]] = True
    return result


def _main_corners(ground: npt.NDArray[Any], cell: float) -> Index:
    """Rows of points (P, >= 2) among which all corners of the hull of the main patches are."""
    cells = CellMap.of(ground, cell)
    if cells is None:
        patches = cluster(ground, cell)
        return np.flatnonzero((patches.size >= _MAIN * patches.size.max())[patches.label])
    group, size = cells.groups()
    wanted = np.append(size >= _MAIN * size.max(), False)[group]
    return corner_candidates(ground, cells, wanted)


def beyond(points: Array, ground: npt.NDArray[Any], margin: float = 0.1, max_width: float = 0.5) -> Mask:
    """(N,): which points belong to wide things that stand beside the support plane rather than on it.

    Args:
        points: (N, 3) [m].
        ground: (P, >= 2), what was seen of the support plane [m].
        margin: how far past the outline of the ground an object may reach [m].
        max_width: what is beside it and no wider than this may still be an object [m].
    """
    result = np.zeros(len(points), bool)
    if len(points) == 0 or len(ground) < 4:
        return result
    outline = convex_outline(ground, _main_corners(ground, cell=0.05))
    beside = np.flatnonzero(outside(points, outline, margin))
    if len(beside) == 0:
        return result
    groups = cluster(points[beside], cell=0.04)
    result[beside[(groups.extent(points[beside]) > max_width)[groups.label]]] = True
    return result
