"""From a camera's cloud to what a detector works on: clean, in a gravity-aligned frame, cropped, thinned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from regnet_core.checks import as_transform, is_number, is_whole, shown
from regnet_core.errors import CloudError, InvalidInputError
from regnet_core.geometry import Box
from regnet_core.ops.rows import taken
from regnet_core.pointcloud import as_points, place_points, random_sample, voxel_downsample
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
    """Most points to keep, drawn at random, without voxels evenly along the rows of the cloud; 0 keeps all."""
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

    points: npt.NDArray[np.float32]
    """(N, 3) coordinates [m], as messages hold them; finite, as far as a float32 can hold them."""
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
    thin, most, recorder = config.voxel_size > 0.0, config.max_points or None, StepRecorder()
    with recorder.step("valid points") as step:  # and, at once, the work of the next steps, but for voxels
        given = as_points(points)
        placed = place_points(
            given, matrix, config.workspace, None if thin else most, config.seed, np.float32, colors is not None
        )
        step.kept, step.rejected = placed.valid, len(given) - placed.valid
    if colors is not None and np.shape(colors) != np.shape(points):
        raise CloudError(f"colors must have shape {np.shape(points)}, one row for each point, got {np.shape(colors)}")
    with recorder.step("workspace") as step:
        step.kept, step.rejected = placed.inside, placed.valid - placed.inside
    with recorder.step("down-sampling") as step:
        left, rows = placed.points, placed.rows
        if thin:
            kept = voxel_downsample(left, config.voxel_size)
            if most is not None:
                kept = kept[random_sample(len(kept), most, np.random.default_rng(config.seed))]
            left, rows = taken(left, kept, np.float32), None if rows is None else rows[kept]
        step.kept, step.rejected = len(left), placed.inside - len(left)
    chosen = None if colors is None or rows is None else np.asarray(colors)[rows]
    return Preprocessed(left, chosen, tuple(recorder.steps), _reason(recorder.steps, config))


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
