"""GraspDetector: a point cloud and a gripper in, ranked collision-free grasps and a report out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from regnet_core.collision import CollisionConfig, SceneCollision, hits_table
from regnet_core.errors import CloudError, GripperError, InvalidInputError
from regnet_core.explain import explain
from regnet_core.filters import GraspFilters
from regnet_core.geometry import Box, Mask, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.later import Later
from regnet_core.models import DEFAULT_MODEL, load_model
from regnet_core.ops.parallel import sharing_cores
from regnet_core.pointcloud import as_points, validate_colors, validate_viewpoint
from regnet_core.report import DetectionReport, StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene

_MIN_POINTS = 20
"""Fewer points than this on objects are no surface that could be grasped."""


@dataclass(frozen=True)
class DetectorConfig:
    """Everything about a detector that is not the method itself."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    collision: CollisionConfig = field(default_factory=CollisionConfig)
    max_grasps: int = 1000
    """At most so many grasps are returned, the best ones."""

    def __post_init__(self) -> None:
        if self.max_grasps < 1:
            raise InvalidInputError(f"max_grasps must be at least 1, got {self.max_grasps!r}")


@dataclass(frozen=True)
class Detection:
    """The result of one detection."""

    grasps: Grasps
    """Best first, in the frame of the cloud."""
    report: DetectionReport
    gripper: Gripper
    plane: Plane | None
    """The support plane that was found, if any."""


class GraspDetector:
    """Finds grasps in point clouds. The same input, seed and device give the same output.

    Args:
        model: one of ``available_models()``, or the path of the weights (.safetensors) of a network of one's own.
        device: "auto" (a GPU where torch can use one and the model can, else the CPU), "cpu", "cuda" or "cuda:N".
        seed: seed of every random choice; each call of ``detect`` starts from it.
        config: preparation of the cloud, collision, number of grasps.

    Raises:
        ModelError: there is no such model or device, or its weights cannot be used.
        InvalidInputError: the seed is not a whole number, 0 or more.
    """

    def __init__(
        self,
        model: str | Path = DEFAULT_MODEL,
        device: str = "auto",
        seed: int = 0,
        config: DetectorConfig | None = None,
    ) -> None:
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise InvalidInputError(f"seed must be a whole number, 0 or more, got {seed!r}")
        self.model = str(model)
        self.seed = int(seed)
        self.config = config or DetectorConfig()
        self._proposer, self.device = load_model(self.model, device)

    def detect(
        self,
        points: npt.ArrayLike,
        gripper: Gripper | None = None,
        colors: npt.ArrayLike | None = None,
        *,
        filters: GraspFilters | None = None,
        viewpoint: npt.ArrayLike | None = None,
    ) -> Detection:
        """Find grasps. Several threads may do so at a time: each then keeps to its share of the cores.

        Args:
            points: (N, 3) in metres, in a gravity-aligned frame (z up). NaN and infinite points are dropped.
            gripper: the hand; ``Gripper()`` when not given.
            colors: (N, 3), uint8 or floats in [0, 1]; used by models with colour.
            filters: limits on the grasps that are returned.
            viewpoint: the camera's position (3,) in the cloud's frame, where it is known.

        Returns:
            Ranked grasps that neither hit the observed scene nor the support plane, and a report. A cloud without
            usable points gives no grasps and the reason.

        Raises:
            CloudError: an array has the wrong shape or type.
            GripperError: the gripper is something else.
        """
        hand, limits = gripper or Gripper(), filters or GraspFilters()
        if not isinstance(hand, Gripper):
            raise GripperError(f"gripper must be a Gripper, such as Gripper(width=0.08), got {hand!r}")
        cloud = as_points(points)
        rgb = validate_colors(colors, len(cloud))
        camera = validate_viewpoint(viewpoint)
        _check_target(limits.target, len(cloud))
        rng = np.random.default_rng(self.seed)
        recorder = StepRecorder()
        with sharing_cores():
            scene = prepare_scene(cloud, rgb, self.config.scene, rng, recorder, camera)
            grasps = Grasps.empty()
            if len(scene.seen) >= _MIN_POINTS:
                grasps = self._propose_and_check(scene, hand, limits, rng, recorder)
        report = recorder.finish(self.model, self.device)
        if len(grasps) == 0:
            why = explain(report.steps, scene, hand, _MIN_POINTS, limits.target is not None)
            report = recorder.finish(self.model, self.device, why)
        return Detection(grasps, report, hand, scene.plane)

    def _propose_and_check(
        self,
        scene: Scene,
        gripper: Gripper,
        filters: GraspFilters,
        rng: np.random.Generator,
        recorder: StepRecorder,
    ) -> Grasps:
        focus = _focus(scene, filters.target)
        with recorder.step("proposals") as step:
            grasps, considered = self._proposer.propose(scene, gripper, focus, rng)
            step.kept, step.rejected = len(grasps), considered - len(grasps)
        collision = Later(lambda: SceneCollision(scene.obstacles, scene.plane, self.config.collision))
        checks: list[tuple[str, Callable[[Grasps], Mask]]] = [
            ("quality", filters.quality_ok),
            ("approach cone", filters.approach_ok),
            ("workspace", lambda g: filters.workspace_ok(g, gripper)),
            ("collision with table", lambda g: ~hits_table(g, gripper, scene.plane, self.config.collision)),
            ("collision with cloud", lambda g: ~collision().with_points(g, gripper)),
            ("target region", lambda g: _on_target(g, gripper, collision(), scene, focus)),
        ]
        for name, accepts in checks:
            with recorder.step(name) as step:
                ok = accepts(grasps)
                step.kept, step.rejected = int(ok.sum()), int((~ok).sum())
                grasps = grasps if ok.all() else grasps[ok]
        with recorder.step("ranking") as step:
            ranked = grasps.ranked()[: self.config.max_grasps]
            step.kept, step.rejected = len(ranked), len(grasps) - len(ranked)
        return ranked


def _check_target(target: Box | Mask | None, count: int) -> None:
    if target is None or isinstance(target, Box):
        return
    mask = np.asarray(target)
    if mask.shape != (count,) or mask.dtype != np.bool_:
        raise CloudError(
            f"a target mask must be a boolean array ({count},), one for each point, got {mask.dtype} {mask.shape}"
        )


def _focus(scene: Scene, target: Box | Mask | None) -> Mask | None:
    """(S,): the points of the objects' surface that belong to the target region, if there is one."""
    if target is None:
        return None
    surface = scene.objects
    if isinstance(target, Box):
        return target.contains(surface.points)
    seen = surface.observed
    marked = np.asarray(target)[surface.source[seen]]
    focus = np.empty(len(surface.points), bool)
    focus[seen] = marked
    # A hidden surface belongs to the object whose visible part is nearest.
    focus[~seen] = marked[cKDTree(surface.points[seen]).query(surface.points[~seen], workers=-1)[1]]
    return focus


def _on_target(
    grasps: Grasps,
    gripper: Gripper,
    collision: SceneCollision,
    scene: Scene,
    focus: Mask | None,
) -> Mask:
    """(M,): more than half of the points between the fingers are on target."""
    if focus is None:
        return np.ones(len(grasps), bool)
    counts = collision.occupancy(grasps, gripper, marked=np.concatenate([focus, np.zeros(len(scene.structure), bool)]))
    return counts.marked * 2 > counts.closing
