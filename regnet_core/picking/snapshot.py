"""Where all objects are at one moment, in numbers that a file holds exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from regnet_core.geometry import Array

_DIGITS = 9
"""Of positions [m] and quaternions: finer than anything that matters, and the same after a way through a file."""
Row = tuple[float, ...] | None


@dataclass(frozen=True)
class Snapshot:
    """The objects of a scene at rest.

    Attributes:
        rows: for each object x, y, z [m] and the quaternion w, x, y, z; None for one that was taken away.
    """

    rows: tuple[Row, ...]

    @classmethod
    def of(cls, poses: Array, removed: Sequence[int] | set[int] = ()) -> Snapshot:
        """Of poses (K, 4, 4), rounded."""
        if not len(poses):
            return cls(())
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True, scalar_first=True)
        numbers = np.round(np.hstack([poses[:, :3, 3], quaternions]), _DIGITS)
        return cls(tuple(None if k in removed else tuple(row) for k, row in enumerate(numbers.tolist())))

    @property
    def removed(self) -> tuple[int, ...]:
        """The objects that were taken away."""
        return tuple(k for k, row in enumerate(self.rows) if row is None)

    @property
    def remaining(self) -> tuple[int, ...]:
        """The other objects."""
        return tuple(k for k, row in enumerate(self.rows) if row is not None)

    def poses(self) -> Array:
        """(K, 4, 4) T_world_object; far away for objects that were taken away."""
        poses = np.tile(np.eye(4), (len(self.rows), 1, 1))
        poses[:, :3, 3] = [0.0, 0.0, -100.0]
        for k, row in enumerate(self.rows):
            if row is not None:
                poses[k, :3, 3] = row[:3]
                poses[k, :3, :3] = Rotation.from_quat(row[3:], scalar_first=True).as_matrix()
        return poses
