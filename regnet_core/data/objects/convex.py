"""Convex parts of a shape, for physics: exact by construction where the construction is known, CoACD elsewhere.

CoACD (Wei et al. 2022) takes seconds for a cup. A solid of revolution falls into slabs, a shell into wedges and a bent
tube into short pieces in milliseconds, and flat sides of the parts stay close to the hollow surfaces they stand for
(TOLERANCE), so that what is free of the mesh is free in physics.
"""

from collections.abc import Iterator

import coacd
import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

CONCAVITY = 0.04
"""CoACD's threshold: the concavity that may remain, relative to the mesh's size."""
SMALLEST_PART = 1e-10
"""Parts below this volume [m^3] are slivers that the physics engine refuses."""
TOLERANCE = 5e-4
"""How far a part's flat side may lie from a hollow surface that it stands for [m]."""
MOST_WEDGES = 18
"""A shell is cut into no more wedges than this, as every one costs time in physics."""


def convex_decomposition(
    mesh: trimesh.Trimesh, concavity: float = CONCAVITY, seed: int = 0
) -> tuple[trimesh.Trimesh, ...]:
    """Splits a watertight mesh into convex parts by CoACD; the same mesh and seed give the same parts."""
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)),
        threshold=concavity,
        preprocess_mode="off",
        mcts_iterations=60,
        mcts_nodes=10,
        resolution=1000,
        seed=seed,
    )
    hulls = (trimesh.Trimesh(vertices, faces).convex_hull for vertices, faces in parts)
    return tuple(hull for hull in hulls if hull.volume > SMALLEST_PART)


def hull(points: ArrayLike) -> trimesh.Trimesh:
    """The convex hull of points (N, 3) that do not lie in one plane."""
    return trimesh.convex.convex_hull(np.asarray(points, dtype=np.float64))


def clip(part: trimesh.Trimesh, normal: ArrayLike, offset: float) -> trimesh.Trimesh:
    """The half of a convex part in which normal . p >= offset; some of the part must lie there."""
    vertices = np.asarray(part.vertices)
    height = vertices @ np.asarray(normal, dtype=np.float64) - offset  # (V,)
    a, b = part.edges_unique.T
    crossing = height[a] * height[b] < 0.0
    a, b = a[crossing], b[crossing]
    share = (height[a] / (height[a] - height[b]))[:, None]
    return hull(np.concatenate([vertices[height >= 0.0], vertices[a] + share * (vertices[b] - vertices[a])]))


def slabs(profile: ArrayLike, sections: int) -> tuple[trimesh.Trimesh, ...]:
    """Convex parts of a solid of revolution without a cavity.

    Args:
        profile: (P, 2) radius and height [m], rising from the axis to the axis.
        sections: number of sides.
    """
    points = np.asarray(profile, dtype=np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, sections, endpoint=False)
    runs = (points[i : j + 1] for i, j in _convex_runs(points))
    return tuple(hull(_revolved(run, angle, np.ones(sections))) for run in runs if np.ptp(run[:, 1]) > 1e-9)


def _convex_runs(points: NDArray[np.float64]) -> Iterator[tuple[int, int]]:
    """First and last point of the longest stretches of a profile that bulge outwards, one after another."""
    start = 0
    while start < len(points) - 1:
        end = start + 1
        while end + 1 < len(points) and _hollow(points[start : end + 2]) < 0.4 * TOLERANCE:
            end += 1
        yield start, end
        start = end


def _hollow(run: NDArray[np.float64]) -> float:
    """How far the farthest point of a rising profile lies inside the line between two others [m]."""
    a, k, b = (run[index] for index in np.array([(i, j, m) for i, j, m in _triples(len(run))]).T)
    ahead, aside = b - a, k - a
    cross = ahead[:, 0] * aside[:, 1] - ahead[:, 1] * aside[:, 0]
    return float(np.max(cross / np.linalg.norm(ahead, axis=1)))


def _triples(count: int) -> Iterator[tuple[int, int, int]]:
    return ((i, j, k) for k in range(2, count) for j in range(1, k) for i in range(j))


def wedges(
    outer: ArrayLike, inner: ArrayLike, sections: int, inner_sections: int | None = None
) -> tuple[trimesh.Trimesh, ...]:
    """Convex parts of a band of a shell of revolution.

    Each is a sector of the band. Its inner side is a chord, put so that half of the sagitta lies on either side of
    the true surface.

    Args:
        outer: (P, 2) radius and height of the outer side, bulging outwards [m].
        inner: (Q, 2) of the inner side, a straight line [m].
        sections: number of sides of the shell's outer surface.
        inner_sections: of its inner surface; `sections` when None.
    """
    outside, inside = np.asarray(outer, dtype=np.float64), np.asarray(inner, dtype=np.float64)
    widest = float(inside[:, 0].max())
    count = int(np.clip(np.ceil(np.pi / np.arccos(1.0 - 2.0 * min(TOLERANCE / widest, 0.4))), 8, MOST_WEDGES))
    shifted = inside * (2.0 / (1.0 + np.cos(np.pi / count)), 1.0)
    corners = np.linspace(0.0, 2.0 * np.pi, sections, endpoint=False)
    parts = []
    for start, end in zip(*_bounds(count), strict=True):
        between = corners[(corners > start + 1e-9) & (corners < end - 1e-9)]
        angle = np.concatenate([[start], between, [end]])
        ends = np.array([start, end])
        parts.append(
            hull(
                np.concatenate(
                    [
                        _revolved(outside, angle, _polygon(angle, sections)),
                        _revolved(shifted, ends, _polygon(ends, inner_sections or sections)),
                    ]
                )
            )
        )
    return tuple(parts)


def _bounds(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where each of `count` equal sectors of the full turn starts and ends [rad]."""
    bounds = np.linspace(0.0, 2.0 * np.pi, count + 1)
    return bounds[:-1], bounds[1:]


def _polygon(angle: NDArray[np.float64], sections: int) -> NDArray[np.float64]:
    """Radius at an angle of the regular polygon of circumradius 1 that has a corner at angle 0."""
    half = np.pi / sections
    return np.cos(half) / np.cos(np.mod(angle, 2.0 * half) - half)


def _revolved(
    profile: NDArray[np.float64], angle: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(P A, 3) the points of a profile (P, 2), and their feet on the axis where the profile ends there."""
    around = np.stack([scale * np.cos(angle), scale * np.sin(angle)], axis=1)  # (A, 2)
    xy = profile[:, None, :1] * around[None]  # (P, A, 2)
    z = np.broadcast_to(profile[:, None, 1:], (*xy.shape[:2], 1))
    return np.concatenate([xy, z], axis=2).reshape(-1, 3)


def tube_pieces(path: NDArray[np.float64], rings: NDArray[np.float64]) -> tuple[trimesh.Trimesh, ...]:
    """Convex parts of a tube: stretches of it that are straight to within TOLERANCE.

    Args:
        path: (P, 3) centres of the cross-sections [m].
        rings: (P, S, 3) corners of the cross-sections [m].
    """
    parts, start = [], 0
    while start < len(path) - 1:
        end = start + 1
        while end + 1 < len(path) and _dent(path, rings, start, end + 1) < TOLERANCE:
            end += 1
        parts.append(hull(rings[start : end + 1].reshape(-1, 3)))
        start = end
    return tuple(parts)


def _dent(path: NDArray[np.float64], rings: NDArray[np.float64], start: int, end: int) -> float:
    """How far a tube's surface lies at most inside the lines between two of its cross-sections [m]."""
    share = np.linspace(0.0, 1.0, end - start + 1)[1:-1, None, None]
    chord = rings[start] + share * (rings[end] - rings[start])
    true = rings[start + 1 : end]
    outwards = true - path[start + 1 : end, None]
    outwards /= np.linalg.norm(outwards, axis=2, keepdims=True)
    return float(np.max(np.sum((chord - true) * outwards, axis=2)))


def sectors_around_hole(part: trimesh.Trimesh, radius: float, count: int = 12) -> tuple[trimesh.Trimesh, ...]:
    """Convex parts of a convex part that has a round hole along z through it.

    Args:
        part: convex, with the z axis inside.
        radius: of the hole [m].
        count: number of sectors.
    """
    apothem = 0.5 * radius * (1.0 + np.cos(np.pi / count))
    parts = []
    for start, end in zip(*_bounds(count), strict=True):
        middle = 0.5 * (start + end)
        piece = clip(part, (np.cos(middle), np.sin(middle), 0.0), apothem)
        piece = clip(piece, (-np.sin(start), np.cos(start), 0.0), 0.0)
        parts.append(clip(piece, (np.sin(end), -np.cos(end), 0.0), 0.0))
    return tuple(parts)
