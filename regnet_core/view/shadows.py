"""Shadows that grippers and objects cast on the cloud, by a depth picture taken from the light."""

from __future__ import annotations

import numpy as np

from regnet_core.geometry import Array, normalised
from regnet_core.view.camera import Camera
from regnet_core.view.meshes import Mesh
from regnet_core.view.raster import Layer, draw_mesh

_SIZE = 700
"""Width and height of the light's picture [pixels]."""
_FAR = 30.0
"""The light stands so many times the scene's radius away: its rays are nearly parallel."""


def shadow_of(mesh: Mesh, points: Array, light: Array, clearance: float = 0.012) -> Array:
    """How much of the light from direction ``light`` (3,) the mesh keeps from points (N, 3) -> (N,) in 0..1."""
    if len(mesh.faces) == 0 or len(points) == 0:
        return np.zeros(len(points))
    camera = _light_camera(np.concatenate([points, mesh.vertices]), light)
    layer = Layer.empty(camera.size)
    draw_mesh(layer, camera, mesh, np.zeros(3, np.float32), light)
    pixel, depth = camera.project(points)
    column, row = (np.clip(pixel[:, i].astype(int), 1, _SIZE - 2) for i in (0, 1))
    dark = np.zeros(len(points))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            dark += layer.depth[row + dy, column + dx] < depth - clearance
    return dark / 9.0


def _light_camera(points: Array, light: Array) -> Camera:
    low, high = points.min(axis=0), points.max(axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    forward = -normalised(light)
    right = normalised(np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [1.0, 0.0, 0.0]))
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(rotation, centre - _FAR * radius * forward, 0.48 * _SIZE * _FAR, (_SIZE, _SIZE))
