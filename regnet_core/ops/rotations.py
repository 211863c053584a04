"""Rotations as quaternions, for hundreds at a time in a process that has compiled code anyway."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnet_core.ops.compiled import compiled


def quaternions(rotation: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """What ``geometry.quaternion_from_matrix`` gives for rotations (M, 3, 3), which they must be, but sooner.

    From the largest of four squares, so that nothing is divided by a small number (Shepperd, "Quaternion from rotation
    matrix", 1978).
    """
    made = np.empty((len(rotation), 4))
    _quaternions(rotation, made)
    return made


@compiled
def _quaternions(rotation, made):  # type: ignore[no-untyped-def]
    for m in range(len(rotation)):
        r = rotation[m]
        trace = r[0, 0] + r[1, 1] + r[2, 2]
        if trace >= r[0, 0] and trace >= r[1, 1] and trace >= r[2, 2]:
            x, y, z, w = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1.0 + trace
        elif r[0, 0] >= r[1, 1] and r[0, 0] >= r[2, 2]:
            x, y, z, w = 1.0 + 2.0 * r[0, 0] - trace, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]
        elif r[1, 1] >= r[2, 2]:
            x, y, z, w = r[0, 1] + r[1, 0], 1.0 + 2.0 * r[1, 1] - trace, r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]
        else:
            x, y, z, w = r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1.0 + 2.0 * r[2, 2] - trace, r[1, 0] - r[0, 1]
        length = np.sqrt(x * x + y * y + z * z + w * w)
        length = -length if w < 0.0 else length
        made[m, 0], made[m, 1], made[m, 2], made[m, 3] = x / length, y / length, z / length, w / length
