"""Keeps the states of an attempt for pictures."""

from __future__ import annotations

import numpy as np

from regnet_core.geometry import Array
from regnet_core.sim.outcome import Recording
from regnet_core.sim.physics import HandInScene


class Recorder:
    """Looks at the physics after each step and keeps its state at regular intervals."""

    def __init__(self, physics: HandInScene, interval: float) -> None:
        """Starts with nothing kept.

        Args:
            physics: what is recorded.
            interval: time between two recorded states, rounded to whole steps [s].
        """
        self._physics = physics
        self._stride = max(1, round(interval / physics.timestep))
        self._steps = 0
        self._times: list[float] = []
        self._objects: list[Array] = []
        self._hands: list[Array] = []
        self._openings: list[float] = []

    def after_step(self) -> None:
        """To be called after each step; the first one is always kept."""
        if self._steps % self._stride == 0:
            self._times.append((self._steps + 1) * self._physics.timestep)
            self._objects.append(self._physics.object_poses())
            self._hands.append(self._physics.hand_pose())
            self._openings.append(self._physics.opening())
        self._steps += 1

    def recording(self) -> Recording:
        """What was kept so far."""
        return Recording(
            np.array(self._times),
            np.array(self._objects).reshape(-1, self._physics.count, 4, 4),
            np.array(self._hands).reshape(-1, 4, 4),
            np.array(self._openings),
        )
