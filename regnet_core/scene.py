"""The observed scene, prepared once for every detector: clean cloud, support plane, object surface, hidden surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from regnet_core.completion import SolidModel, fill_columns, hidden_surface
from regnet_core.geometry import Array, Box, Mask, Plane, normalised
from regnet_core.pointcloud import (
    Index,
    crop,
    estimate_normals,
    fit_support_plane,
    neighbourhood_radius,
    orient_normals,
    validate_points,
    voxel_downsample,
)
from regnet_core.report import StepRecorder
from regnet_core.visibility import UnseenGround, unseen_ground


@dataclass(frozen=True)
class SceneConfig:
    """How a cloud is prepared."""

    workspace: Box | None = None
    """Points outside are ignored altogether [m]."""
    voxel: float = 0.002
    """Edge length of the voxels that thin the cloud before all else; it bounds the cost of very dense clouds [m]."""
    plane_clearance: float = 0.007
    """Points nearer to the support plane belong to it [m]."""
    outlier_neighbours: int = 5
    """A point with fewer neighbours within the neighbourhood's radius is a flying pixel."""
    max_object_height: float = 0.5
    """Points higher above the support plane are not filled downwards [m]."""
    complete_hidden: bool = True
    """Whether the unseen sides of the objects are filled in (completion.py)."""


@dataclass(frozen=True)
class Surface:
    """Points with outward normals."""

    points: Array
    """(S, 3) [m]."""
    normals: Array
    """(S, 3) of length 1."""
    observed: Mask
    """(S,): seen by the camera rather than inferred."""
    source: Index
    """(S,): row of the point in the user's array; -1 for inferred ones."""


@dataclass(frozen=True)
class Scene:
    """One cloud, ready for detection."""

    points: Array
    """(N, 3): every valid point in the workspace, thinned by voxels [m]."""
    source: Index
    """(N,): their rows in the user's array."""
    colors: npt.NDArray[np.float64] | None
    """(N, 3) in [0, 1], or None."""
    plane: Plane | None
    """The support plane, if one was found."""
    objects: Surface
    """The surface of what stands on the plane (everything when there is no plane)."""
    ground: UnseenGround | None
    """Which part of the plane was not seen; None without a plane."""


def prepare_scene(
    points: npt.ArrayLike,
    colors: npt.NDArray[np.float64] | None,
    config: SceneConfig,
    rng: np.random.Generator,
    recorder: StepRecorder,
    viewpoint: npt.ArrayLike | None = None,
) -> Scene:
    """Clean a user's cloud (M, 3) [m] and find the support plane and the surface of the objects.

    Args:
        points: the cloud in a gravity-aligned frame.
        colors: (M, 3) in [0, 1], or None.
        config: how to do it.
        rng: source of randomness.
        recorder: receives the counts and times of the steps.
        viewpoint: position (3,) of the camera in the same frame, where it is known: normals then face it.
    """
    with recorder.step("valid points") as step:
        valid, source = validate_points(points)
        step.kept, step.rejected = len(valid), len(np.asarray(points)) - len(valid)
    with recorder.step("points in workspace") as step:
        inside = np.arange(len(valid)) if config.workspace is None else crop(valid, config.workspace)
        step.kept, step.rejected = len(inside), len(valid) - len(inside)
    with recorder.step("points after thinning") as step:
        thinned = inside[voxel_downsample(valid[inside], config.voxel)]
        step.kept, step.rejected = len(thinned), len(inside) - len(thinned)
    cloud, source = valid[thinned], source[thinned]
    with recorder.step("points on objects") as step:
        plane = fit_support_plane(cloud, rng)
        objects = _object_surface(cloud, source, plane, config, rng, viewpoint)
        step.kept = int(objects.observed.sum())
        step.rejected = len(cloud) - step.kept
        ground = None
        if plane is not None and config.complete_hidden:
            on_plane = np.abs(plane.height(cloud)) <= config.plane_clearance
            ground = unseen_ground(cloud[on_plane], objects.points)
    return Scene(cloud, source, None if colors is None else colors[source], plane, objects, ground)


def _object_surface(
    cloud: Array,
    source: Index,
    plane: Plane | None,
    config: SceneConfig,
    rng: np.random.Generator,
    viewpoint: npt.ArrayLike | None,
) -> Surface:
    height = np.ones(len(cloud)) if plane is None else plane.height(cloud)
    on_object = np.flatnonzero(height > config.plane_clearance)
    points, source, height = cloud[on_object], source[on_object], height[on_object]
    radius = neighbourhood_radius(points, rng)
    local = estimate_normals(points, radius)
    keep = local.neighbours >= config.outlier_neighbours
    points, source, height, normals = points[keep], source[keep], height[keep], local.normal[keep]
    # Sensor noise is taken out along the normal: onto the plane of the neighbours.
    points = points - normals * np.sum((points - local.mean[keep]) * normals, axis=1, keepdims=True)

    model: SolidModel | None = None
    if plane is not None and config.complete_hidden:
        columns = height < config.max_object_height
        model = fill_columns(points[columns], plane)
    if viewpoint is not None:
        normals = orient_normals(normals, np.asarray(viewpoint, float) - points)
    elif model is not None:
        normals = orient_normals(normals, model.outward(points, height))
    else:
        normals = orient_normals(normals, np.array([0.0, 0.0, 1.0]))
    observed = np.ones(len(points), bool)
    if model is not None and plane is not None:
        hidden = hidden_surface(model, plane, points)
        points = np.concatenate([points, hidden.points])
        normals = np.concatenate([normals, hidden.normals])
        observed = np.concatenate([observed, np.zeros(len(hidden.points), bool)])
        source = np.concatenate([source, np.full(len(hidden.points), -1)])
    return Surface(points, normalised(normals) if len(normals) else normals, observed, source)
