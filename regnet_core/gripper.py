"""The parallel-jaw gripper: its dimensions and its solid bodies in the grasp frame.

Grasp frame: origin at the grasp centre c, X = approach, Y = closing direction, Z = X x Y. c lies on the palm's face,
the fingertips at c + depth * X.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from regnet_core.checks import is_number, shown
from regnet_core.errors import GripperError
from regnet_core.geometry import Box


class GripperBodies(NamedTuple):
    """The three solid boxes of the hand, in the grasp frame [m]."""

    palm: Box
    left_finger: Box
    """At +Y."""
    right_finger: Box
    """At -Y."""


@dataclass(frozen=True)
class Gripper:
    """A parallel-jaw gripper. The defaults are those of the REGNet code (D = 0.06, H = T = 0.01 m).

    Raises:
        GripperError: a dimension is not a number inside ``LIMITS``.
    """

    width: float = 0.08
    """W: the largest opening between the finger pads [m]."""
    depth: float = 0.06
    """D: length of the fingers from the palm's face to the tips, along the approach [m]."""
    height: float = 0.010
    """H: extent of fingers and palm along Z [m]."""
    thickness: float = 0.010
    """T: thickness of one finger along the closing direction [m]."""
    palm_depth: float = 0.06
    """How far the hand's body reaches behind the palm's face [m]."""

    LIMITS: ClassVar[dict[str, tuple[float, float]]] = {
        "width": (0.03, 0.16),
        "depth": (0.01, 0.20),
        "height": (0.002, 0.10),
        "thickness": (0.001, 0.05),
        "palm_depth": (0.01, 0.50),
    }

    def __post_init__(self) -> None:
        for name, (low, high) in self.LIMITS.items():
            value = getattr(self, name)
            if not is_number(value) or abs(value) == math.inf:
                raise GripperError(f"gripper {name} must be a number of metres in [{low}, {high}], got {value!r}")
            if not low <= value <= high:
                raise GripperError(f"gripper {name} must be in [{low}, {high}] m, got {shown(value)}")
            object.__setattr__(self, name, float(value))

    def replace(self, **dimensions: float) -> Gripper:
        """The same gripper with some dimensions changed."""
        return dataclasses.replace(self, **dimensions)

    def closing_region(self, opening: float | None = None) -> Box:
        """The space between the fingers: 0 < x < D, |y| < opening / 2, |z| < H / 2 (opening: W unless given)."""
        half = self._half_opening(opening)
        return Box((0.0, -half, -self.height / 2), (self.depth, half, self.height / 2))

    def bodies(self, opening: float | None = None) -> GripperBodies:
        """Palm and fingers when the jaw is open by ``opening`` (W unless given).

        The palm is as wide as the fully opened hand whatever the opening.
        """
        half, t, h = self._half_opening(opening), self.thickness, self.height / 2
        palm_half = self.width / 2 + t
        return GripperBodies(
            palm=Box((-self.palm_depth, -palm_half, -h), (0.0, palm_half, h)),
            left_finger=Box((0.0, half, -h), (self.depth, half + t, h)),
            right_finger=Box((0.0, -half - t, -h), (self.depth, -half, h)),
        )

    def _half_opening(self, opening: float | None) -> float:
        if opening is None:
            return self.width / 2
        if not is_number(opening) or not 0.0 < opening <= self.width + 1e-9:
            raise GripperError(f"opening must be in (0, {self.width:g}] m for this gripper, got {shown(opening)}")
        return opening / 2
