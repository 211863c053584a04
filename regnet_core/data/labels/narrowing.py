"""Labels for a width that nothing was labelled for, from those of the next wider gripper."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnet_core.data.labels.scene_labels import GraspLabels
from regnet_core.geometry import Array, Mask

FINGER_ROOM = 0.002
"""Room that a narrowed jaw leaves between a finger and the object [m]."""


def fitting(labels: GraspLabels, width: float) -> Mask:
    """(M,) which grasps the same hand can do with its jaw open by ``width`` [m] only.

    A narrowed finger comes to stand where the closing region was, between the old finger and the contact, and nothing
    but the object at its contact is met there: a grasp whose contacts fit between the fingers stays as good as it was.
    Grasps that only a narrower jaw has room for are missing.
    """
    return np.asarray(np.abs(labels.contacts).max(axis=1, initial=0.0) <= width / 2 - FINGER_ROOM)


def kept_share(labels: GraspLabels, kept: Mask, objects: int) -> Array:
    """(objects,) which share of each object's grasps is kept; 0 where it has none."""
    all_of = np.bincount(labels.object_index, minlength=objects)
    return np.bincount(labels.object_index[kept], minlength=objects) / np.maximum(all_of, 1)


def confidence_between(
    confidence: npt.NDArray[np.float32], narrower: npt.NDArray[np.float32], share: float
) -> npt.NDArray[np.float32]:
    """Point confidence (N,) at the given share of the way from one labelled width to the next narrower one."""
    return np.asarray((1.0 - share) * confidence + share * narrower, np.float32)
