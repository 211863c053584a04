"""The observed scene, prepared once for every detector: clean cloud, support plane, object surface, hidden surface.

What was seen is there at once. What is inferred from it (which way normals point, hidden sides, unseen ground) is
computed when a method or the collision check asks, as no network looks at it: ``SceneCompletion``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.clusters import beyond, cluster, structure
from regnet_core.completion import Columns, HiddenSurface, SolidModel, columns_of, fill_columns, hidden_surface
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box, Mask, Plane, normalised
from regnet_core.later import Later
from regnet_core.ops.buckets import CornerBuckets
from regnet_core.ops.local_planes import flattened
from regnet_core.ops.rows import Usable, taken
from regnet_core.ops.slabs import layers
from regnet_core.ops.voxel_grid import bounds
from regnet_core.ops.voxels import share_kept
from regnet_core.pointcloud import (
    MAX_COORDINATE,
    Index,
    as_floats,
    colors_as_floats,
    estimate_normals,
    neighbourhood_radius,
    orient_normals,
    usable_rows,
    voxel_downsample,
)
from regnet_core.report import StepRecorder
from regnet_core.support_plane import fit_support_plane
from regnet_core.visibility import UnseenGround, unseen_ground

_THIN = 0.95
"""A cloud is thin already where voxels would keep at least this share of it."""
_GROUND, _SMALL = 12_000, 4.0
"""So many points of the ground are enough to know how far it reaches where all points are above so small an area [m2]:
there are some on every spot of 5 cm."""
_FEWEST_TO_FILL = 10
"""Of fewer points nothing is inferred about hidden sides."""
_MIN_RADIUS, _MAX_RADIUS = 0.008, 0.02
"""Normals are estimated from neighbourhoods of such radii [m]."""


@dataclass(frozen=True)
class SceneConfig:
    """How a cloud is prepared.

    Raises:
        InvalidInputError: a value makes no sense.
    """

    workspace: Box | None = None
    """Points outside are ignored altogether [m]."""
    voxel: float = 0.002
    """Edge length of the voxels that thin the cloud before all else, where more than one in twenty of its points would
    go, or it has too many [m]. Voxels of less than a millimetre thin every cloud."""
    max_points: int = 300_000
    """The voxels are enlarged until no more points than this are left."""
    plane_clearance: float = 0.007
    """Points nearer to the support plane belong to it [m]."""
    outlier_neighbours: int = 5
    """A point with fewer neighbours within the neighbourhood's radius, or in a smaller cluster, is a flying pixel."""
    max_object_height: float = 0.5
    """What is taller and also wide is a wall, a person, furniture: an obstacle, but nothing to grasp [m]."""
    complete_hidden: bool = True
    """Whether the unseen sides of the objects are filled in (completion.py)."""

    def __post_init__(self) -> None:
        for name, low in (("voxel", 1e-5), ("plane_clearance", 0.0), ("max_object_height", 0.01)):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= low):
                raise InvalidInputError(f"{name} must be at least {low:g} m, got {value!r}")
        if self.max_points < 100:
            raise InvalidInputError(f"max_points must be at least 100, got {self.max_points!r}")


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


class _Found(NamedTuple):
    """What was seen of the objects, O points."""

    points: Array
    normals: Array
    """(O, 3), of which the sign is not known yet."""
    source: Index
    height: Array
    """(O,): above ``base`` [m]."""
    base: Plane
    """The support plane, or what stands for it."""
    structure: Array


class SceneCompletion(NamedTuple):
    """What is inferred from what was seen, each part once, when somebody asks: ``completion.hidden()``."""

    hidden: Later[HiddenSurface]
    """The hidden sides of the objects."""
    objects: Later[Surface]
    """``Scene.objects``."""
    ground: Later[UnseenGround | None]
    """``Scene.ground``."""


@dataclass(frozen=True)
class Scene:
    """One cloud, ready for detection."""

    points: npt.NDArray[np.floating]
    """(N, 3): every valid point in the workspace, thinned by voxels where many share one, float32 or float64 as the
    user's array [m]. It may be that array itself, which must not change while the scene is used."""
    rows: Index | None
    """(N,): their rows in the user's array; None: all of it."""
    plane: Plane | None
    """The support plane, if one was found."""
    seen: Array
    """(O, 3): what the camera saw of the objects' surface, the first rows of that [m]."""
    structure: Array
    """(K, 3): points of walls, people, furniture, which are only in the way [m]."""
    completion: SceneCompletion = field(repr=False)
    """What is inferred."""
    given_colors: npt.NDArray[Any] | None = field(repr=False)
    """(M, 3): the user's colours, a row for each row of the user's array, or None."""

    @property
    def source(self) -> Index:
        """(N,): the points' rows in the user's array."""
        return np.arange(len(self.points)) if self.rows is None else self.rows

    @property
    def objects(self) -> Surface:
        """The surface of what stands on the plane (everything when there is no plane)."""
        return self.completion.objects()

    @property
    def ground(self) -> UnseenGround | None:
        """Which part of the plane was not seen; None without a plane."""
        return self.completion.ground()

    @property
    def colors(self) -> npt.NDArray[np.float64] | None:
        """(N, 3) in [0, 1], or None."""
        return None if self.given_colors is None else colors_as_floats(self.given_colors[self.source])

    @property
    def obstacles(self) -> Array:
        """(S + K, 3): everything above the plane that a hand could hit; the objects' points come first [m]."""
        return np.concatenate([self.seen, self.completion.hidden().points, self.structure])

    def wanted(self, focus: Mask | None) -> Mask:
        """(S,): the points of the objects' surface that are in focus, all of them when there is none."""
        return np.ones(len(self.objects.points), bool) if focus is None else focus


def prepare_scene(
    points: npt.ArrayLike,
    colors: npt.NDArray[Any] | None,
    config: SceneConfig,
    rng: np.random.Generator,
    recorder: StepRecorder,
    viewpoint: Array | None = None,
) -> Scene:
    """Clean a user's cloud (M, 3) [m] and find the support plane and the surface of the objects.

    Args:
        points: the cloud in a gravity-aligned frame.
        colors: (M, 3), integers 0..255 or floats 0..1, or None.
        config: how to do it.
        rng: source of randomness.
        recorder: receives the counts and times of the steps, and warnings.
        viewpoint: position (3,) of the camera in the same frame, where it is known: normals then face it.
    """
    given = _locked(as_floats(points))
    with recorder.step("valid points") as step:  # and, in the same pass, the next step's work
        usable = usable_rows(given, config.workspace)
        step.kept, step.rejected = usable.valid, len(given) - usable.valid
    with recorder.step("points in workspace") as step:
        step.kept, step.rejected = usable.number, usable.valid - usable.number
    with recorder.step("points after thinning") as step:
        rows = _thinned(given, usable, config)
        cloud = _locked(np.ascontiguousarray(given) if rows is None else taken(given, rows, given.dtype.type))
        step.kept, step.rejected = len(cloud), usable.number - len(cloud)
    with recorder.step("points on objects") as step:
        plane = fit_support_plane(cloud, rng)
        found = _find_surface(cloud, rows, plane, config, recorder.warnings)
        columns = _columns(found, plane, config, recorder.warnings)
        step.kept, step.rejected = len(found.points), len(cloud) - len(found.points)
    completion = _completion(found, columns, viewpoint, lambda objects: _unseen_ground(cloud, plane, config, objects))
    return Scene(cloud, rows, plane, found.points, found.structure, completion, colors)


def _locked(points: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A view that cannot be written to: the user's array stays as it is, and compiled loops know one type of it."""
    view = points.view()
    view.flags.writeable = False
    return view


def _thinned(points: npt.NDArray[Any], usable: Usable, config: SceneConfig) -> Index | None:
    """The rows that stay; None: all of them."""
    voxel, rows = config.voxel, usable.rows
    if usable.number <= config.max_points and share_kept(points, rows, voxel, MAX_COORDINATE) >= _THIN:
        return rows
    kept = voxel_downsample(points, voxel, rows)
    while len(kept) > config.max_points:
        voxel *= 1.3
        kept = voxel_downsample(points, voxel, rows)
    return kept


def _find_surface(
    cloud: npt.NDArray[np.floating],
    rows: Index | None,
    plane: Plane | None,
    config: SceneConfig,
    warnings: list[str],
) -> _Found:
    base = plane or _lowest_level(cloud)
    clearance = config.plane_clearance if plane is not None else -np.inf
    seen = layers(cloud, np.array(base.normal), base.offset, clearance, _GROUND if _is_small(cloud) else None)
    groups = cluster(seen.points)
    large = np.flatnonzero((groups.size >= config.outlier_neighbours)[groups.label])
    points, above, height = taken(seen.points, large), seen.above[large], seen.height[large]
    in_the_way = structure(points, height, config.max_object_height)
    if plane is not None:
        in_the_way |= beyond(points, seen.ground)
    wall = points[in_the_way]
    if len(wall) > 0:
        points, above, height = points[~in_the_way], above[~in_the_way], height[~in_the_way]
    source = above if rows is None else rows[above]
    in_buckets = CornerBuckets.of(points)
    radius = neighbourhood_radius(in_buckets, low=_MIN_RADIUS, high=2 * _MAX_RADIUS)
    if radius > 1.5 * _MAX_RADIUS and len(points) > 0:
        warnings.append(
            "the cloud is sparse: fewer than 25 points within 3 cm on the objects, so obstacles may be missed; crop it "
            "to the workspace before sampling it down"
        )
    local = estimate_normals(in_buckets, min(radius, _MAX_RADIUS))
    keep = np.flatnonzero(local.neighbours >= config.outlier_neighbours)
    flat = flattened(points, local, keep)
    return _Found(flat, taken(local.normal, keep), source[keep], height[keep], base, wall)


def _columns(found: _Found, plane: Plane | None, config: SceneConfig, warnings: list[str]) -> Columns | None:
    """The columns below the objects, where hidden sides are to be inferred and can be."""
    if plane is None and len(found.points) > 0:
        warnings.append("no support plane was found: objects are taken to stand at the height of the lowest point")
    if not config.complete_hidden or len(found.points) < _FEWEST_TO_FILL:
        return None
    columns = columns_of(found.points, found.base)
    if columns is None and plane is not None:
        warnings.append("the objects are spread too wide for their hidden sides to be inferred; crop the cloud")
    return columns


def _completion(
    found: _Found,
    columns: Columns | None,
    viewpoint: Array | None,
    ground_below: Callable[[Array], UnseenGround | None],
) -> SceneCompletion:
    # No part refers to the whole: scenes go when nobody has them any more, without waiting for the garbage collector.
    solid = Later(lambda: None if columns is None else fill_columns(columns))
    hidden = Later(lambda: _hidden(found, solid()))
    objects = Later(lambda: _surface(found, _outward(found, solid(), viewpoint), hidden()))
    ground = Later(lambda: ground_below(objects().points))
    return SceneCompletion(hidden, objects, ground)


def _unseen_ground(
    cloud: npt.NDArray[np.floating], plane: Plane | None, config: SceneConfig, objects: Array
) -> UnseenGround | None:
    if plane is None or not config.complete_hidden:
        return None
    return unseen_ground(layers(cloud, np.array(plane.normal), plane.offset, config.plane_clearance).ground, objects)


def _hidden(found: _Found, solid: SolidModel | None) -> HiddenSurface:
    return HiddenSurface.empty() if solid is None else hidden_surface(solid, found.base, found.points)


def _outward(found: _Found, solid: SolidModel | None, viewpoint: Array | None) -> Array:
    """Normals (O, 3) turned outwards: to the camera, out of the filled volume, or away from the cluster's middle."""
    points, normals = found.points, found.normals
    if len(points) == 0:
        return normals
    if viewpoint is not None:
        return normalised(orient_normals(normals, viewpoint - points))
    if solid is not None:
        return solid.outward(normals, points, found.height)
    groups = cluster(points)
    return normalised(orient_normals(normals, points - groups.mean(points)[groups.label]))


def _surface(found: _Found, normals: Array, hidden: HiddenSurface) -> Surface:
    """What was seen, with these normals (O, 3), and then the hidden sides."""
    observed = np.zeros(len(found.points) + len(hidden.points), bool)
    observed[: len(found.points)] = True
    return Surface(
        np.concatenate([found.points, hidden.points]),
        np.concatenate([normals, hidden.normals]),
        observed,
        np.concatenate([found.source, np.full(len(hidden.points), -1)]),
    )


def _is_small(cloud: npt.NDArray[np.floating]) -> bool:
    if len(cloud) == 0:
        return True
    low, high = bounds(cloud)
    return float(high[0] - low[0]) * float(high[1] - low[1]) <= _SMALL


def _lowest_level(cloud: npt.NDArray[np.floating]) -> Plane:
    """The level plane under nearly all points, for clouds that show objects and no table."""
    return Plane((0.0, 0.0, 1.0), float(np.quantile(cloud[:, 2], 0.01)) - 0.002 if len(cloud) else 0.0)
