"""A tree of frames, as ROS publishes it on ``/tf`` and ``/tf_static``, and the way from a frame up to its root."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from regnet_core.errors import CloudError
from regnet_core.geometry import Array, matrix_from_quaternion


class RootPose(NamedTuple):
    """Where a frame is in its root, the frame above it that has no parent."""

    root: str
    T_root_frame: Array
    """(4, 4) [m]."""


class FrameTree:
    """Parent and pose of each frame; a later transform of the same child replaces the earlier one."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, parent: str, child: str, translation: Sequence[float], quaternion: Sequence[float]) -> None:
        """Record the pose of ``child`` in ``parent``: translation (3,) [m], quaternion (4,) in the order x, y, z, w.

        Raises:
            CloudError: the pose is not finite or the quaternion is zero.
        """
        xyz, xyzw = np.asarray(translation, float), np.asarray(quaternion, float)
        if not (np.isfinite(xyz).all() and np.isfinite(xyzw).all() and np.linalg.norm(xyzw) > 1e-6):
            raise CloudError(
                f"the transform from '{parent}' to '{child}' is not a pose: translation {xyz.tolist()}, "
                f"quaternion {xyzw.tolist()}"
            )
        pose = np.eye(4)
        pose[:3, :3] = matrix_from_quaternion(xyzw[None])[0]
        pose[:3, 3] = xyz
        self._parents[_plain(child)] = (_plain(parent), pose)

    def to_root(self, frame: str) -> RootPose | None:
        """The pose of ``frame`` in its root; None when no transform names the frame.

        Raises:
            CloudError: the transforms go round in a circle.
        """
        name = _plain(frame)
        if name not in self._parents:
            known_as_parent = any(parent == name for parent, _ in self._parents.values())
            return RootPose(name, np.eye(4)) if known_as_parent else None
        pose, visited = np.eye(4), [name]
        while name in self._parents:
            name, step = self._parents[name]
            pose = step @ pose
            if name in visited:
                raise CloudError(f"the bag's transforms go round in a circle: {' -> '.join([*visited, name])}")
            visited.append(name)
        return RootPose(name, pose)


def _plain(frame: str) -> str:
    """tf2 treats '/camera' and 'camera' as one frame."""
    return frame.removeprefix("/")
