"""From a camera's cloud to what a detector works on: clean, in a gravity-aligned frame, cropped, thinned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from regnet_core.checks import as_transform, is_number, is_whole, shown
from regnet_core.errors import CloudError, InvalidInputError
from regnet_core.geometry import Array, Box
from regnet_core.ops.rows import taken
from regnet_core.pointcloud import Index, place_points, random_sample, voxel_downsample
from regnet_core.report import StepRecorder, StepReport


@dataclass(frozen=True)
class PreprocessingConfig:
    """What to keep of a cloud.

    Raises:
        InvalidInputError: a value makes no sense.
    """

    workspace: Box | None = None
    """Points outside are dropped; in the target frame [m]. None keeps all."""
    voxel_size: float = 0.0
    """Edge length of the voxels of which one point each is kept [m]; 0 keeps all points."""
    max_points: int = 0
    """Most points to keep, drawn at random; 0 keeps all."""
    seed: int = 0
    """Of the random draw: the same cloud gives the same result."""

    def __post_init__(self) -> None:
        if not isinstance(self.workspace, Box | None):
            raise InvalidInputError(f"workspace must be a Box or None, got {self.workspace!r}")
        if not is_number(self.voxel_size) or not 0.0 <= self.voxel_size < np.inf:
            raise InvalidInputError(
                f"voxel_size must be 0 (off) or a positive number of metres, got {shown(self.voxel_size)}"
            )
        for name in ("max_points", "seed"):
            value = getattr(self, name)
            if not is_whole(value) or value < 0:
                raise InvalidInputError(f"{name} must be 0 or a positive whole number, got {value!r}")


@dataclass(frozen=True)
class Preprocessed:
    """The prepared cloud, in the target frame."""

    points: Array
    """(N, 3) finite coordinates [m]."""
    colors: npt.NDArray[np.uint8] | None
    """(N, 3), where the input had colours."""
    steps: tuple[StepReport, ...]
    """What each step kept and rejected."""
    reason: str
    """Why no point is left, as a sentence; empty when some are."""


def preprocess(
    points: npt.ArrayLike,
    colors: npt.NDArray[np.uint8] | None,
    T_target_source: npt.ArrayLike,
    config: PreprocessingConfig | None = None,
) -> Preprocessed:
    """Prepare one cloud.

    Args:
        points: (M, 3) in the camera's frame [m]; NaN and infinite rows are dropped.
        colors: (M, 3) uint8, or None.
        T_target_source: (4, 4), the pose of the camera's frame in the gravity-aligned target frame.
        config: what to keep.

    Raises:
        CloudError: the points are not an (M, 3) array of numbers, or the colours do not have their shape.
        InvalidInputError: the transform is not a finite (4, 4) matrix.
    """
    config = config or PreprocessingConfig()
    matrix = as_transform("T_target_source", T_target_source)
    rng, recorder = np.random.default_rng(config.seed), StepRecorder()
    with recorder.step("valid points") as step:  # and, in the same pass, the next step's work
        placed = place_points(points, matrix, config.workspace)
        step.kept, step.rejected = placed.valid, len(np.asarray(points)) - placed.valid
    if colors is not None and np.shape(colors) != np.shape(points):
        raise CloudError(f"colors must have shape {np.shape(points)}, one row for each point, got {np.shape(colors)}")
    with recorder.step("workspace") as step:
        step.kept, step.rejected = len(placed.points), placed.valid - len(placed.points)
    with recorder.step("down-sampling") as step:
        kept = _thinned(placed.points, config, rng)
        step.kept, step.rejected = len(kept), len(placed.points) - len(kept)
    chosen = None if colors is None else np.asarray(colors)[placed.rows[kept]]
    return Preprocessed(taken(placed.points, kept), chosen, tuple(recorder.steps), _reason(recorder.steps, config))


def _thinned(points: Array, config: PreprocessingConfig, rng: np.random.Generator) -> Index:
    kept = voxel_downsample(points, config.voxel_size) if config.voxel_size > 0.0 else np.arange(len(points))
    return kept[random_sample(len(kept), config.max_points, rng)] if config.max_points > 0 else kept


def _reason(steps: list[StepReport], config: PreprocessingConfig) -> str:
    valid, workspace = steps[0], steps[1]
    if valid.kept + valid.rejected == 0:
        return "the cloud has no points: check that the camera sees something within its range"
    if valid.kept == 0:
        return f"none of the cloud's {valid.rejected} points is a finite position within 1000 m of the sensor"
    if workspace.kept == 0 and config.workspace is not None:
        return (
            f"all {workspace.rejected} valid points lie outside the workspace {config.workspace.lower} to "
            f"{config.workspace.upper} m: check its limits and the transform of the camera"
        )
    return ""
