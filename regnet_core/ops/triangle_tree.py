"""A bounding-volume tree over a mesh's triangles, for visiting those near any small region quickly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled

LEAF = 4
"""Most triangles in a leaf."""
DEEPEST = 64
"""Levels that a traversal's stack has room for; splitting at the median never comes near it."""


class TriangleTree(NamedTuple):
    """F triangles in the order of their leaves, and N nodes; node 0 is the root, a left child follows its parent."""

    corners: Array
    """(F, 3, 3): corner after corner [m]."""
    normals: Array
    """(F, 3): unit outward normals; zero for a triangle without an area."""
    lower: Array
    """(N, 3): lower corner of each node's box [m]."""
    upper: Array
    """(N, 3): upper corner [m]."""
    right: npt.NDArray[np.int64]
    """(N,): the right child of an inner node."""
    first: npt.NDArray[np.int64]
    """(N,): a leaf's first triangle."""
    leaf_count: npt.NDArray[np.int64]
    """(N,): how many triangles a leaf has; 0 in an inner node."""


def build_tree(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> TriangleTree:
    """The tree of a mesh with vertices (V, 3) [m] and at least one face (F, 3), whose corners run counter-clockwise."""
    corners = np.asarray(vertices, np.float64)[np.asarray(faces, np.int64)]
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    order, nodes_lower, nodes_upper, right, first, count = _build(lower, upper)
    corners = np.ascontiguousarray(corners[order])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(length > 0.0, length, 1.0)
    return TriangleTree(corners, normals, nodes_lower, nodes_upper, right, first, count)


@compiled
def _build(lower, upper):  # type: ignore[no-untyped-def]
    total = len(lower)
    middle = (lower + upper) / 2
    order = np.arange(total)
    most = 2 * total
    node_lower, node_upper = np.empty((most, 3)), np.empty((most, 3))
    right, first, count = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros(most, np.int64)
    # (begin, end, the parent that this is the right child of, or -1)
    stack = np.empty((DEEPEST, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, total, -1
    depth, nodes = 1, 0
    while depth > 0:
        depth -= 1
        begin, end, parent = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        node = nodes
        nodes += 1
        if parent >= 0:
            right[parent] = node
        centre_low, centre_high = np.full(3, np.inf), np.full(3, -np.inf)
        for a in range(3):
            node_lower[node, a], node_upper[node, a] = np.inf, -np.inf
        for i in range(begin, end):
            t = order[i]
            for a in range(3):
                node_lower[node, a] = min(node_lower[node, a], lower[t, a])
                node_upper[node, a] = max(node_upper[node, a], upper[t, a])
                centre_low[a] = min(centre_low[a], middle[t, a])
                centre_high[a] = max(centre_high[a], middle[t, a])
        if end - begin <= LEAF:
            first[node], count[node] = begin, end - begin
            continue
        axis = np.argmax(centre_high - centre_low)
        piece = order[begin:end].copy()
        order[begin:end] = piece[np.argsort(middle[piece, axis], kind="mergesort")]
        half = (begin + end) // 2
        stack[depth, 0], stack[depth, 1], stack[depth, 2] = half, end, node
        stack[depth + 1, 0], stack[depth + 1, 1], stack[depth + 1, 2] = begin, half, -1
        depth += 2
    return order, node_lower[:nodes], node_upper[:nodes], right[:nodes], first[:nodes], count[:nodes]
