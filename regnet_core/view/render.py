"""One scene as a picture: the cloud with soft shading, grippers coloured by rank, the selected one with its arrow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from regnet_core.geometry import Array, normalised
from regnet_core.ops.buckets import CornerBuckets
from regnet_core.pointcloud import estimate_normals, orient_normals
from regnet_core.view.camera import Camera, clearest_azimuth, framing_camera
from regnet_core.view.meshes import Mesh, approach_arrow, fork_mesh, gripper_mesh, joined
from regnet_core.view.palette import SELECTED, height_colors, rank_colors
from regnet_core.view.raster import Image, Layer, draw_mesh, draw_points, lit, occlusion_shade
from regnet_core.view.scene import ViewScene, spread_out, thinned
from regnet_core.view.shadows import shadow_of

_TOUCHING = 0.002
"""A hand that is this little behind the cloud still counts as in front of it [m]."""
_REACH = 0.2
"""How far from the fingertips an object still belongs to the picture [m]."""
_LEAST_EXTENT = np.array([0.24, 0.24, 0.0])
"""A single small object is shown with so much of its surroundings [m]."""
_BELOW_PLANE = 0.03
"""Points farther below the support plane are not drawn [m]."""
_BACKGROUND_TOP, _BACKGROUND_BOTTOM = np.array([0.985, 0.988, 0.995]), np.array([0.90, 0.915, 0.94])


@dataclass(frozen=True)
class RenderStyle:
    """How a scene is drawn."""

    shown: int = 16
    """At most so many grasps."""
    elevation: float = math.radians(40)
    """Of the camera above the horizon [rad]."""
    azimuth: float | None = None
    """Direction from the scene to the camera about z [rad]; None takes the side on which the cloud has fewest holes."""
    margin: float = 0.11
    """How much is shown around the objects [m]."""
    max_points: int = 120_000
    supersampling: int = 2
    """Each pixel is the mean of so many times so many."""


@dataclass(frozen=True)
class View:
    """A scene, cut to what is drawn, and the camera that looks at it."""

    scene: ViewScene
    """Only the points that are drawn."""
    ranks: npt.NDArray[np.int64]
    """The grasps that are drawn, best first, without the selected one."""
    camera: Camera


@dataclass(frozen=True)
class _Subject:
    """What a picture of a scene is about."""

    scene: ViewScene
    ranks: npt.NDArray[np.int64]
    objects: Array
    """(K, 3): the objects near the drawn grasps, or all of them when there is no grasp [m]."""
    hands: Array
    """(V, 3): corners of the drawn grippers [m]."""


def prepare_views(
    scenes: Sequence[ViewScene], size: tuple[int, int], style: RenderStyle, same_camera: bool = True
) -> list[View]:
    """Choose the grasps to draw, cut the clouds to the surroundings of the objects, and place the cameras.

    Args:
        scenes: what is drawn.
        size: width and height of each picture [pixels].
        style: how it is drawn.
        same_camera: one place and one cut for all, so that the pictures can be compared.
    """
    subjects = [_subject_of(scene, style) for scene in scenes]
    telling = [subject for subject in subjects if len(subject.scene.grasps)] or subjects
    return [_view(subject, telling if same_camera else [subject], size, style) for subject in subjects]


def _subject_of(scene: ViewScene, style: RenderStyle) -> _Subject:
    scene = scene.without_invalid()
    ranks = spread_out(scene.grasps, scene.gripper, style.shown)
    drawn = ranks if scene.selected is None else np.append(ranks, scene.selected)
    tips = scene.grasps[drawn].fingertips(scene.gripper)
    objects = scene.object_points()
    if len(tips):
        close = ((objects > tips.min(axis=0) - _REACH) & (objects < tips.max(axis=0) + _REACH)).all(axis=1)
        objects = np.concatenate([objects[close], tips])
    if len(objects) == 0:
        objects = np.zeros((1, 3))
    low, high = np.percentile(objects, [0.5, 99.5], axis=0)
    objects = np.clip(objects[thinned(len(objects), 5_000)], low, high)
    ranks = ranks[ranks != scene.selected]
    return _Subject(scene, ranks, objects, joined([*_forks(scene, ranks), _selected_mesh(scene)]).vertices)


def _view(subject: _Subject, framed: Sequence[_Subject], size: tuple[int, int], style: RenderStyle) -> View:
    """The cut of ``subject`` and a camera that frames all of ``framed``."""
    objects = np.concatenate([other.objects for other in framed])
    low, high = objects.min(axis=0), objects.max(axis=0)
    centre = (low + high) / 2
    wider = np.maximum(_LEAST_EXTENT - (high - low), 0.0) / 2
    low, high = low - wider, high + wider
    frame = np.concatenate([objects, centre - wider, centre + wider, *(other.hands for other in framed)], axis=None)
    azimuth, leading = style.azimuth, framed[0].scene
    if azimuth is None:
        azimuth = clearest_azimuth(leading.points, centre, style.elevation, leading.viewpoint)
    scene = subject.scene
    p, margin = scene.points, np.array([style.margin, style.margin, np.inf])
    near = ((p > low - margin) & (p < high + style.margin)).all(axis=1)
    if scene.plane is not None:
        near &= scene.plane.height(p) > -_BELOW_PLANE
    rows = np.flatnonzero(near)
    cut = scene.with_points(rows[thinned(len(rows), style.max_points)])
    return View(cut, subject.ranks, framing_camera(frame.reshape(-1, 3), size, style.elevation, azimuth))


def render_view(view: View, style: RenderStyle) -> npt.NDArray[np.uint8]:
    """The picture (H, W, 3) of a view."""
    fine, scene = view.camera.scaled(style.supersampling), view.scene
    light = _light(view.camera)
    cloud = _draw_cloud(view, fine, light)
    others, chosen = Layer.empty(fine.size), Layer.empty(fine.size)
    for mesh, color in zip(_forks(scene, view.ranks), rank_colors(len(view.ranks)), strict=True):
        draw_mesh(others, fine, mesh, color, light)
    draw_mesh(chosen, fine, _selected_mesh(scene), SELECTED, light)
    image = _background(fine.size)
    _paint(image, cloud)
    _paint(image, others, in_front_of=cloud, hidden=0.15)
    _paint(image, chosen, in_front_of=cloud, hidden=0.30)
    return _shrunk(image, style.supersampling)


def _paint(image: Image, layer: Layer, in_front_of: Layer | None = None, hidden: float = 0.0) -> None:
    """Put a layer into the image, darkened behind edges; the parts behind another layer show only faintly."""
    rows, columns = (np.flatnonzero(np.isfinite(layer.depth).any(axis=axis)) for axis in (1, 0))
    if len(rows) == 0:
        return
    window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    depth = layer.depth[window]
    shade = occlusion_shade(depth, 2, 9.0) * occlusion_shade(depth, 7, 2.2)
    hit = np.isfinite(depth)
    alpha = np.ones(int(hit.sum()), np.float32)
    if in_front_of is not None:
        alpha[depth[hit] > in_front_of.depth[window][hit] + _TOUCHING] = hidden
    part = image[window]
    part[hit] += alpha[:, None] * (layer.color[window][hit] * shade[hit, None] - part[hit])


def _draw_cloud(view: View, camera: Camera, light: Array) -> Layer:
    scene = view.scene
    points = np.ascontiguousarray(scene.points, dtype=np.float64)
    if len(points) == 0:
        return Layer.empty(camera.size)
    colors = height_colors(points, scene.plane) if scene.colors is None else np.float32(scene.colors) / 255.0
    normals = orient_normals(estimate_normals(CornerBuckets.of(points), 0.010).normal, camera.position - points)
    brightness = lit(normals, light) / float(lit(np.array([[0.0, 0.0, 1.0]]), light)[0])
    dark = shadow_of(joined([*_forks(scene, view.ranks), _selected_mesh(scene)]), points, light)
    shaded = colors * (brightness * (1.0 - 0.28 * dark))[:, None].astype(np.float32)
    return draw_points(camera, points, normals, shaded, _radius(points))


def _radius(points: Array) -> Array:
    """(N,): so large that the discs of neighbours overlap [m]."""
    if len(points) < 8:
        return np.full(len(points), 0.004)
    third = cKDTree(points).query(points, k=[4], workers=-1)[0][:, 0]
    return np.clip(0.95 * third, 0.0008, 2.0 * float(np.median(third)))


def _forks(scene: ViewScene, ranks: npt.NDArray[np.int64]) -> list[Mesh]:
    chosen = scene.grasps[ranks]
    return [
        fork_mesh(scene.gripper, float(width)).transformed(pose)
        for width, pose in zip(chosen.width, chosen.poses, strict=True)
    ]


def _selected_mesh(scene: ViewScene) -> Mesh:
    """The solid hand at the selected grasp with the arrow of its approach; nothing when none is selected."""
    if scene.selected is None:
        return joined([])
    grasp = scene.grasps[scene.selected]
    hand = joined([gripper_mesh(scene.gripper, float(grasp.width[0])), approach_arrow(scene.gripper)])
    return hand.transformed(grasp.poses[0])


def _light(camera: Camera) -> Array:
    """High up, over the left shoulder of the camera."""
    right, forward = camera.rotation[0], camera.rotation[2]
    return normalised(np.array([0.0, 0.0, 1.6]) - 0.7 * right - 0.5 * forward * np.array([1.0, 1.0, 0.0]))


def _background(size: tuple[int, int]) -> Image:
    width, height = size
    ramp = np.linspace(0.0, 1.0, height)[:, None]
    column = (_BACKGROUND_TOP * (1 - ramp) + _BACKGROUND_BOTTOM * ramp).astype(np.float32)
    return np.repeat(column[:, None], width, axis=1)


def _shrunk(image: Image, factor: int) -> npt.NDArray[np.uint8]:
    height, width = image.shape[0] // factor, image.shape[1] // factor
    mean = image.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))
    return np.rint(np.clip(mean, 0.0, 1.0) * 255.0).astype(np.uint8)
