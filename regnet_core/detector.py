"""GraspDetector: a point cloud and a gripper in, ranked collision-free grasps and a report out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from regnet_core.baselines.antipodal import AntipodalSampler
from regnet_core.collision import CollisionConfig, SceneCollision
from regnet_core.errors import CloudError, ModelError
from regnet_core.filters import GraspFilters
from regnet_core.geometry import Box, Mask, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.pointcloud import validate_colors
from regnet_core.proposer import Proposer
from regnet_core.report import DetectionReport, StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene

_MODELS: dict[str, Callable[[], Proposer]] = {AntipodalSampler.name: AntipodalSampler}

_MIN_POINTS = 20
"""Fewer points than this on objects are no surface that could be grasped."""


def available_models() -> tuple[str, ...]:
    """The names that ``GraspDetector(model=...)`` takes."""
    return tuple(_MODELS)


@dataclass(frozen=True)
class DetectorConfig:
    """Everything about a detector that is not the method itself."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    collision: CollisionConfig = field(default_factory=CollisionConfig)
    max_grasps: int = 1000
    """At most so many grasps are returned, the best ones."""


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
        model: one of ``available_models()``.
        device: "auto" or "cpu".
        seed: seed of every random choice; each call of ``detect`` starts from it.
        config: preparation of the cloud, collision, number of grasps.

    Raises:
        ModelError: there is no such model or device.
    """

    def __init__(
        self, model: str = "antipodal", device: str = "auto", seed: int = 0, config: DetectorConfig | None = None
    ) -> None:
        if model not in _MODELS:
            raise ModelError(f"no model '{model}'; there are {', '.join(_MODELS)}")
        if device not in ("auto", "cpu"):
            raise ModelError(f"model '{model}' runs on the device 'cpu' (or 'auto'), not on '{device}'")
        self.model = model
        self.device = "cpu"
        self.seed = int(seed)
        self.config = config or DetectorConfig()
        self._proposer = _MODELS[model]()

    def detect(
        self,
        points: npt.ArrayLike,
        gripper: Gripper | None = None,
        colors: npt.ArrayLike | None = None,
        *,
        filters: GraspFilters | None = None,
        viewpoint: npt.ArrayLike | None = None,
    ) -> Detection:
        """Find grasps.

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
        """
        hand, limits = gripper or Gripper(), filters or GraspFilters()
        rng = np.random.default_rng(self.seed)
        recorder = StepRecorder()
        rgb = validate_colors(colors, len(np.asarray(points))) if colors is not None else None
        if viewpoint is not None and np.shape(viewpoint) != (3,):
            raise CloudError(f"viewpoint must be the camera's position x, y, z, got shape {np.shape(viewpoint)}")
        scene = prepare_scene(points, rgb, self.config.scene, rng, recorder, viewpoint)
        grasps = Grasps.empty()
        if scene.objects.observed.sum() >= _MIN_POINTS:
            focus = _focus(scene, limits.target, len(np.asarray(points)))
            grasps = self._propose_and_check(scene, hand, limits, focus, rng, recorder)
        report = recorder.finish(self.model, self.device, "")
        if len(grasps) == 0:
            report = recorder.finish(self.model, self.device, _reason(report, scene, hand))
        return Detection(grasps, report, hand, scene.plane)

    def _propose_and_check(
        self,
        scene: Scene,
        gripper: Gripper,
        filters: GraspFilters,
        focus: Mask,
        rng: np.random.Generator,
        recorder: StepRecorder,
    ) -> Grasps:
        with recorder.step("proposals") as step:
            grasps, considered = self._proposer.propose(scene, gripper, focus, rng)
            step.kept, step.rejected = len(grasps), considered - len(grasps)
        collision = SceneCollision(scene.objects.points, scene.plane, self.config.collision)
        checks: list[tuple[str, Callable[[Grasps], Mask]]] = [
            ("quality", filters.quality_ok),
            ("approach cone", filters.approach_ok),
            ("workspace", lambda g: filters.workspace_ok(g, gripper)),
            ("collision with table", lambda g: ~collision.with_table(g, gripper)),
            ("collision with cloud", lambda g: ~collision.with_points(g, gripper)),
            ("target region", lambda g: _on_target(g, gripper, collision, filters.target, focus)),
        ]
        for name, accepts in checks:
            with recorder.step(name) as step:
                ok = accepts(grasps)
                step.kept, step.rejected = int(ok.sum()), int((~ok).sum())
                grasps = grasps[ok]
        with recorder.step("ranking") as step:
            ranked = grasps.ranked()[: self.config.max_grasps]
            step.kept, step.rejected = len(ranked), len(grasps) - len(ranked)
        return ranked


def _focus(scene: Scene, target: Box | Mask | None, count: int) -> Mask:
    """(S,): the points of the objects' surface that belong to the target region."""
    surface = scene.objects
    if target is None:
        return np.ones(len(surface.points), bool)
    if isinstance(target, Box):
        return target.contains(surface.points)
    mask = np.asarray(target)
    if mask.shape != (count,) or mask.dtype != np.bool_:
        raise CloudError(
            f"a target mask must be a boolean array ({count},), one for each point, got {mask.dtype} {mask.shape}"
        )
    return np.where(surface.source >= 0, mask[surface.source], False)


def _on_target(
    grasps: Grasps, gripper: Gripper, collision: SceneCollision, target: Box | Mask | None, focus: Mask
) -> Mask:
    """(M,): more than half of the points between the fingers, hidden ones left out for a mask, are on target."""
    if target is None:
        return np.ones(len(grasps), bool)
    counts = collision.occupancy(grasps, gripper, marked=focus)
    return counts.marked * 2 > counts.closing


def _reason(report: DetectionReport, scene: Scene, gripper: Gripper) -> str:
    """One sentence about the step that left nothing."""
    steps = {step.name: step for step in report.steps}
    received = steps["valid points"].kept + steps["valid points"].rejected
    if received == 0:
        return "the cloud is empty"
    if steps["valid points"].kept == 0:
        return f"none of the {received} points is valid: all are NaN, infinite or more than 1000 m away"
    if steps["points in workspace"].kept == 0:
        return f"none of the {steps['valid points'].kept} valid points lies in the workspace"
    if "proposals" not in steps:
        found = steps["points on objects"].kept
        where = "above the support plane" if scene.plane is not None else "in the cloud, and no support plane in it"
        if found == 0:
            return f"there is no surface {where}: isolated points do not count"
        return f"there are only {found} points on surfaces {where}; at least {_MIN_POINTS} are needed"
    proposals = steps["proposals"]
    if proposals.kept == 0:
        return (
            f"none of {proposals.rejected} candidates closes on two opposing surfaces within the gripper's "
            f"width of {gripper.width:g} m"
        )
    last = next(step for step in report.steps[report.steps.index(proposals) :] if step.kept == 0)
    refused = ", ".join(
        f"{s.name} {s.rejected}" for s in report.steps[report.steps.index(proposals) + 1 :] if s.rejected
    )
    return f"all {proposals.kept} proposed grasps were rejected, the last ones by: {last.name} ({refused})"
