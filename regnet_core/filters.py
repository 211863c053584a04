"""What the user accepts: approach cone, workspace, quality and target region. The whole scene stays for collision."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box, Mask, check_cone, within_cone
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper


@dataclass(frozen=True, eq=False)  # a target mask has no single truth value, and no hash
class GraspFilters:
    """Limits on the grasps that are returned; the defaults accept everything.

    Raises:
        InvalidInputError: a limit makes no sense.
    """

    approach_axis: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Axis of the cone of accepted approach directions, in the cloud's frame; straight down by default."""
    approach_max_angle: float = math.pi
    """Half-angle of that cone [rad]; pi accepts every approach."""
    workspace: Box | None = None
    """Where the point between the fingertips must lie, in the cloud's frame [m]."""
    min_quality: float = 0.0
    """The least quality s_q in [0, 1]."""
    target: Box | Mask | None = None
    """The region of interest: a box in the cloud's frame [m], or a mask (N,) over the points given to ``detect``.

    A grasp is on target when more than half of the points between its fingers are.
    """

    def __post_init__(self) -> None:
        check_cone(self.approach_axis, self.approach_max_angle)
        check_range("min_quality", self.min_quality, 0.0, 1.0)
        if not isinstance(self.workspace, Box | None):
            raise InvalidInputError(f"workspace must be a Box or None, got {self.workspace!r}")

    def approach_ok(self, grasps: Grasps) -> Mask:
        """(M,): the approach lies in the cone."""
        return within_cone(grasps.approach, self.approach_axis, self.approach_max_angle)

    def workspace_ok(self, grasps: Grasps, gripper: Gripper) -> Mask:
        """(M,): the point between the fingertips lies in the workspace."""
        if self.workspace is None:
            return np.ones(len(grasps), dtype=bool)
        return self.workspace.contains(grasps.fingertips(gripper))

    def quality_ok(self, grasps: Grasps) -> Mask:
        """(M,): the quality is high enough."""
        return grasps.quality >= self.min_quality
