"""Drawing without a GPU: clouds as blended discs, meshes as triangles, into pictures with a depth for each pixel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.view.camera import Camera
from regnet_core.view.meshes import Mesh
from regnet_core.view.palette import Rgb

Image = npt.NDArray[np.float32]
_NEAR = 0.02
"""Nothing nearer to the camera is drawn [m]."""
_LARGEST_DISC = 24.0
"""Radius of a point close to the camera [pixels]."""


@dataclass
class Layer:
    """A picture of one kind of thing."""

    color: Rgb
    """(H, W, 3)."""
    depth: Image
    """(H, W): distance along the camera's axis [m], infinite where there is nothing."""

    @classmethod
    def empty(cls, size: tuple[int, int]) -> Layer:
        """A layer of this width and height with nothing in it."""
        width, height = size
        return cls(np.zeros((height, width, 3), np.float32), np.full((height, width), np.inf, np.float32))


def draw_points(
    camera: Camera, points: Array, normals: Array, colors: Rgb, radius: Array, blend_depth: float = 0.010
) -> Layer:
    """The cloud as small tilted discs (surfels) that blend where their depths differ by less than ``blend_depth``.

    Args:
        camera: the view.
        points: (N, 3) [m].
        normals: (N, 3) of the discs, of any sign.
        colors: (N, 3).
        radius: (N,) of the discs [m].
        blend_depth: [m].
    """
    layer = Layer.empty(camera.size)
    discs = _Discs.seen_by(camera, points, normals, radius)
    if len(discs.row) == 0:
        return layer
    fragments = list(discs.fragments(camera.size))
    nearest = layer.depth.reshape(-1)
    for at, _, depth, _ in fragments:
        np.minimum.at(nearest, at, depth)
    channels = np.ascontiguousarray(colors[discs.row].T)
    total = np.zeros((5, len(nearest)), np.float32)
    for at, source, depth, weight in fragments:
        front = np.flatnonzero(depth < nearest[at] + blend_depth)
        at, source, weight = at[front], source[front], weight[front]
        np.add.at(total[4], at, weight)
        np.add.at(total[3], at, weight * depth[front])
        for sums, channel in zip(total, channels, strict=False):
            np.add.at(sums, at, weight * channel[source])
    hit = np.flatnonzero(total[4] > 0)
    layer.color.reshape(-1, 3)[hit] = (total[:3, hit] / total[4, hit]).T
    nearest[hit] = total[3, hit] / total[4, hit]
    return layer


class _Fragments(NamedTuple):
    """What some discs contribute to the picture, F pairs of a pixel and a disc."""

    at: npt.NDArray[np.int64]
    """(F,): rows of the flattened picture."""
    source: npt.NDArray[np.int64]
    """(F,): the disc."""
    depth: Image
    """(F,) [m]."""
    weight: Image
    """(F,): 1 in the middle of the disc, little at its rim."""


class _Discs(NamedTuple):
    """The discs in a picture, the largest first."""

    row: npt.NDArray[np.int64]
    """(D,): rows of the cloud."""
    pixel: Image
    """(D, 2): their centres."""
    depth: Image
    """(D,) [m]."""
    slope: Image
    """(D, 2): change of depth to the right and down [m/m]."""
    reach: Image
    """(D,): radius [pixels]."""
    scale: Image
    """(D,): size of a pixel at the disc's depth [m]."""

    @classmethod
    def seen_by(cls, camera: Camera, points: Array, normals: Array, radius: Array) -> _Discs:
        pixel, depth = camera.project(points)
        scale = np.maximum(depth, _NEAR) / camera.focal
        reach = np.clip(radius / scale, 0.8, _LARGEST_DISC)
        margin = np.array(camera.size) + _LARGEST_DISC
        index = np.flatnonzero((depth > _NEAR) & (pixel > -_LARGEST_DISC).all(axis=1) & (pixel < margin).all(axis=1))
        index = index[np.argsort(-reach[index], kind="stable")]
        normal = normals[index] @ camera.rotation.T
        steep = np.where(np.abs(normal[:, 2]) < 0.2, np.copysign(0.2, normal[:, 2]), normal[:, 2])
        slope = -normal[:, :2] / steep[:, None]
        arrays = (pixel[index], depth[index], slope, reach[index], scale[index])
        return cls(index, *(array.astype(np.float32) for array in arrays))

    def fragments(self, size: tuple[int, int]) -> Iterator[_Fragments]:
        """The discs' pixels, one batch for each offset from the centre within the largest disc."""
        width, height = size
        floor = np.floor(self.pixel)
        corner, centre = floor.astype(np.int64), self.pixel - floor - np.float32(0.5)  # float32: ufunc.at is fast then
        centre = centre.astype(np.float32, copy=False)
        largest = int(np.ceil(self.reach[0]))
        for dy in range(-largest, largest + 1):
            for dx in range(-largest, largest + 1):
                least = np.hypot(max(abs(dx) - 0.5, 0.0), max(abs(dy) - 0.5, 0.0))
                count = int(np.searchsorted(-self.reach, -least, side="right"))
                if count == 0:
                    continue
                x, y = corner[:count, 0] + dx, corner[:count, 1] + dy
                right, down = dx - centre[:count, 0], dy - centre[:count, 1]
                rise = right * self.slope[:count, 0] + down * self.slope[:count, 1]
                share = (right**2 + down**2 + rise**2) / self.reach[:count] ** 2
                covers = (share <= 1.0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
                source = np.flatnonzero(covers)
                depth: Image = (self.depth[source] + rise[source] * self.scale[source]).astype(np.float32)
                weight = np.exp(np.float32(-2.5) * share[source])
                yield _Fragments(y[source] * width + x[source], source, depth, weight)


def draw_mesh(layer: Layer, camera: Camera, mesh: Mesh, color: Rgb, light: Array) -> None:
    """Add a mesh of one colour (3,), lit from the direction ``light`` (3,), to the layer; back sides are left out."""
    pixel, depth = camera.project(mesh.vertices)
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    facing = np.sum(normal * (camera.position - corners[:, 0]), axis=1) > 0
    visible = facing & (depth[mesh.faces] > _NEAR).all(axis=1)
    shade = lit(normal, light)
    for face in np.flatnonzero(visible):
        index = mesh.faces[face]
        _draw_triangle(layer, pixel[index], depth[index], color * shade[face])


def lit(normals: Array, light: Array) -> Array:
    """How bright surfaces with normals (N, 3) are under a lamp in direction ``light`` (3,) and a bright sky -> (N,)."""
    return 0.58 + 0.32 * np.clip(normals @ light, 0.0, 1.0) + 0.12 * normals[:, 2]


def _draw_triangle(layer: Layer, pixel: Array, depth: Array, color: Rgb) -> None:
    height, width = layer.depth.shape
    low = np.maximum(np.floor(pixel.min(axis=0) - 0.5).astype(int), 0)
    high = np.minimum(np.ceil(pixel.max(axis=0) + 0.5).astype(int), [width, height])
    if (low >= high).any():
        return
    (ax, ay), (bx, by), (cx, cy) = pixel
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if abs(area) < 1e-9:
        return
    x = np.arange(low[0], high[0]) + 0.5
    y = (np.arange(low[1], high[1]) + 0.5)[:, None]
    b = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
    c = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
    inside = (b >= 0) & (c >= 0) & (b + c <= 1)
    inverse = (1 - b - c) / depth[0] + b / depth[1] + c / depth[2]
    z = np.where(inside, 1.0 / np.where(inside, inverse, 1.0), np.inf).astype(np.float32)
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    nearer = z < layer.depth[window]
    layer.depth[window][nearer] = z[nearer]
    layer.color[window][nearer] = color


def occlusion_shade(depth: Image, reach: int, strength: float) -> Image:
    """Eye-dome lighting (Boucheny 2009): pixels that lie behind their neighbours get darker -> factors (H, W) in 0..1.

    Args:
        depth: (H, W), infinite where there is nothing.
        reach: distance of the eight neighbours [pixels].
        strength: how dark.
    """
    finite = np.isfinite(depth)
    log = np.where(finite, np.log2(np.where(finite, depth, 1.0)), 1e3).astype(np.float32)
    padded = np.pad(log, reach, mode="edge")
    rows, columns = depth.shape
    response = np.zeros_like(log)
    for dy in (-reach, 0, reach):
        for dx in (-reach, 0, reach):
            if dx or dy:
                other = padded[reach + dy : reach + dy + rows, reach + dx : reach + dx + columns]
                response += np.clip(log - other, 0.0, 0.05)
    return np.where(finite, np.exp(-strength * response), 1.0).astype(np.float32)
