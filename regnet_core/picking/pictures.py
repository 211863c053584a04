"""Pictures of moments of an attempt: the true objects, the bins, the table and the hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from regnet_core.data.cameras.rendering import FIXTURE_COLOUR
from regnet_core.data.scenes.scene import TABLE_COLOUR, Scene
from regnet_core.geometry import Array, Box
from regnet_core.gripper import Gripper
from regnet_core.view.camera import Camera, framing_camera
from regnet_core.view.meshes import Mesh, gripper_mesh, joined
from regnet_core.view.palette import SELECTED, Rgb
from regnet_core.view.raster import Layer, draw_mesh, occlusion_shade

_ELEVATION = math.radians(52.0)
_AZIMUTH = math.radians(-62.0)
"""From where pictures are taken: over a corner of the pick bin, with the place bin behind it."""
_TILE = 0.1
"""The table is drawn in tiles: what is behind the camera is left out tile by tile [m]."""
_BACKGROUND = np.array([0.955, 0.963, 0.975], np.float32)
_LIGHT = np.array([0.25, -0.45, 0.86])


class Stage:
    """A scene whose objects and hand move, ready to be drawn."""

    def __init__(self, scene: Scene, gripper: Gripper) -> None:
        """Args: the objects, in any poses, with all that is fixed, and the hand."""
        self._gripper = gripper
        self._objects = [
            Mesh(np.asarray(model.mesh.vertices, np.float64), np.asarray(model.mesh.faces, np.int64))
            for model in scene.objects
        ]
        self._colours = [_rgb(model.colour) for model in scene.objects]
        self._fixtures = joined([_box(box) for box in scene.fixtures])
        self._table = _tiles(scene.table)

    def draw(
        self,
        poses: Array,
        hand: Array | None,
        opening: float,
        frame: Sequence[Box],
        size: tuple[int, int],
        supersampling: int = 2,
    ) -> npt.NDArray[np.uint8]:
        """One picture (H, W, 3).

        Args:
            poses: (K, 4, 4) T_world_object.
            hand: (4, 4) T_world_hand; None when it is away.
            opening: distance between the finger pads [m].
            frame: boxes that fill the picture, in the world [m].
            size: its width and height [pixels].
            supersampling: each pixel is the mean of so many times so many.
        """
        corners = np.concatenate([box.corners() for box in frame])
        camera = framing_camera(corners, size, _ELEVATION, _AZIMUTH).scaled(supersampling)
        layer = Layer.empty(camera.size)
        draw_mesh(layer, camera, self._table, _rgb(TABLE_COLOUR), _LIGHT)
        draw_mesh(layer, camera, self._fixtures, _rgb(FIXTURE_COLOUR), _LIGHT)
        for mesh, colour, pose in zip(self._objects, self._colours, poses, strict=True):
            draw_mesh(layer, camera, mesh.transformed(pose), colour, _LIGHT)
        if hand is not None:
            jaw = gripper_mesh(self._gripper, min(max(opening, 1e-4), self._gripper.width))
            draw_mesh(layer, camera, jaw.transformed(hand), SELECTED, _LIGHT)
        return _finished(layer, camera, supersampling)


def _finished(layer: Layer, camera: Camera, supersampling: int) -> npt.NDArray[np.uint8]:
    """The picture with darker edges, over the background."""
    shade = occlusion_shade(layer.depth, 2, 8.0) * occlusion_shade(layer.depth, 8, 2.0)
    seen = np.isfinite(layer.depth)[..., None]
    image = np.where(seen, layer.color * shade[..., None], _BACKGROUND)
    width, height = (side // supersampling for side in camera.size)
    mean = image.reshape(height, supersampling, width, supersampling, 3).mean(axis=(1, 3))
    return np.rint(np.clip(mean, 0.0, 1.0) * 255.0).astype(np.uint8)


def _tiles(table: Box) -> Mesh:
    """The top of a table as tiles."""
    (x0, y0, _), (x1, y1, top) = table.lower, table.upper
    columns, rows = (max(1, round((end - start) / _TILE)) for start, end in ((x0, x1), (y0, y1)))
    x, y = np.meshgrid(np.linspace(x0, x1, columns + 1), np.linspace(y0, y1, rows + 1), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, top)], axis=1)
    first = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    right, up = first + rows + 1, first + 1
    faces = np.concatenate([np.stack([first, right, right + 1], 1), np.stack([first, right + 1, up], 1)])
    return Mesh(vertices, faces.astype(np.int64))


def _box(box: Box) -> Mesh:
    """A box as a mesh."""
    x, y, z = (np.array([low, high]) for low, high in zip(box.lower, box.upper, strict=True))
    corners = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return Mesh(corners, _FACES)


_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip
"""Triangles over a box's corners, of which x counts slowest; anticlockwise seen from outside."""


def _rgb(colour: tuple[int, int, int]) -> Rgb:
    return np.array(colour, np.float32) / 255.0
