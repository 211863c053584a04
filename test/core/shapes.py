"""Noisy single views of simple convex objects on a table, computed without any renderer."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

TABLE = 0.75
CAMERA = np.array([0.8, 0.0, 1.7])
Inside = Callable[[np.ndarray], np.ndarray]


class Solid(NamedTuple):
    """Points and outward normals of a whole surface, and a test for points inside."""

    points: np.ndarray
    normals: np.ndarray
    inside: Inside


def box(x: float, y: float, z: float, density: float = 6e4, seed: int = 0) -> Solid:
    """A box standing on the table at the origin [m]; ``density`` in points per square metre."""
    rng = np.random.default_rng(seed)
    half = np.array([x, y, z]) / 2
    centre = np.array([0.0, 0.0, TABLE + z / 2])
    points, normals = [], []
    for axis in range(3):
        u, v = (a for a in range(3) if a != axis)
        count = int(4 * half[u] * half[v] * density)
        for sign in (-1.0, 1.0):
            face = rng.uniform(-half, half, (count, 3))
            face[:, axis] = sign * half[axis]
            points.append(face)
            normals.append(np.tile(sign * np.eye(3)[axis], (count, 1)))
    return Solid(
        centre + np.concatenate(points),
        np.concatenate(normals),
        lambda p: (np.abs(p - centre) < half - 1e-4).all(axis=-1),
    )


def cylinder(radius: float, height: float, density: float = 6e4, seed: int = 0) -> Solid:
    """An upright cylinder on the table at the origin [m]."""
    rng = np.random.default_rng(seed)
    n = int(2 * np.pi * radius * height * density)
    angle = rng.uniform(0, 2 * np.pi, n)
    out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    wall = radius * out + np.array([0, 0, TABLE]) + rng.uniform(0, height, (n, 1)) * np.array([0, 0, 1])
    m = int(np.pi * radius**2 * density)
    angle, r = rng.uniform(0, 2 * np.pi, m), radius * np.sqrt(rng.random(m))
    lid = np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(m, TABLE + height)])
    return Solid(
        np.concatenate([wall, lid]),
        np.concatenate([out, np.tile([0.0, 0.0, 1.0], (m, 1))]),
        lambda p: (
            (np.hypot(p[..., 0], p[..., 1]) < radius - 1e-4) & (np.abs(p[..., 2] - TABLE - height / 2) < height / 2)
        ),
    )


def sphere(radius: float, density: float = 6e4, seed: int = 0) -> Solid:
    """A ball on the table at the origin [m]."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(int(4 * np.pi * radius**2 * density), 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    centre = np.array([0.0, 0.0, TABLE + radius])
    return Solid(centre + radius * out, out, lambda p: np.linalg.norm(p - centre, axis=-1) < radius - 1e-4)


def single_view(
    solid: Solid | None, *, camera: np.ndarray = CAMERA, noise: float = 0.001, side: float = 0.6, seed: int = 0
) -> np.ndarray:
    """What a camera sees of a convex solid and of the table around it: points (N, 3) with Gaussian noise [m]."""
    rng = np.random.default_rng(seed)
    table = np.column_stack([rng.uniform(-side / 2, side / 2, (15000, 2)), np.full(15000, TABLE)])
    if solid is None:
        return table + rng.normal(0, noise, table.shape)
    along = np.linspace(0, 0.5, 200)[:, None, None]
    shadowed = solid.inside(table + along * (camera - table)).any(axis=0)
    facing = np.sum(solid.normals * (camera - solid.points), axis=1) > 0.05
    points = np.concatenate([table[~shadowed], solid.points[facing]])
    return points + rng.normal(0, noise, points.shape)
