"""How wide the thing between the fingers really is, whatever the jaw's opening."""

from typing import NamedTuple

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

REACH = 0.4
"""Lines start this far from the grasp's middle plane, outside of any object that touches the closing region [m]."""
SLIGHT = 0.001
"""An overlap with the closing region shorter than this is a graze [m]."""


class Enclosed(NamedTuple):
    """What is between the fingers of M grasps."""

    width: NDArray[np.float64]
    """(M,) extent along the closing direction, the part beyond the pads included [m]; NaN where there is nothing."""
    object_index: NDArray[np.int64]
    """(M,) index of its mesh; -1 where there is nothing."""


def enclosed_solids(
    caster: o3d.t.geometry.RaycastingScene,
    face_normals: NDArray[np.float64],
    first_face: NDArray[np.int64],
    origins: NDArray[np.float64],
    closing: NDArray[np.float64],
    opening: NDArray[np.float64],
) -> Enclosed:
    """The solid that fills most of each closing region, and its extent along the closing direction.

    Args:
        caster: meshes with geometry ids 0 .. K-1.
        face_normals: (F, 3) outward normals of all faces, mesh after mesh.
        first_face: (K,) row of each mesh's first face.
        origins: (M, R, 3) points of the closing region's middle plane, y = 0 [m].
        closing: (M, 3) closing directions.
        opening: (M,) distance between the finger pads [m].
    """
    m, r = origins.shape[:2]
    lines = np.concatenate([origins, np.broadcast_to(closing[:, None], origins.shape)], axis=-1).reshape(-1, 6)
    line, owner, start, end = _inside_intervals(caster, face_normals, first_face, lines)
    grasp = line // r
    half = 0.5 * opening[grasp]
    overlap = np.minimum(end, half) - np.maximum(start, -half)
    keep = overlap > SLIGHT
    grasp, owner, start, end, overlap = grasp[keep], owner[keep], start[keep], end[keep], overlap[keep]
    solids = len(first_face)
    filled = np.bincount(grasp * solids + owner, weights=overlap, minlength=m * solids).reshape(m, solids)
    most = filled.argmax(axis=1)
    mine = owner == most[grasp]
    lowest, highest = np.full(m, np.inf), np.full(m, -np.inf)
    np.minimum.at(lowest, grasp[mine], start[mine])
    np.maximum.at(highest, grasp[mine], end[mine])
    found = np.isfinite(lowest)
    width = np.where(found, np.where(found, highest, 0.0) - np.where(found, lowest, 0.0), np.nan)
    return Enclosed(width, np.where(found, most, -1))


def _inside_intervals(
    caster: o3d.t.geometry.RaycastingScene,
    face_normals: NDArray[np.float64],
    first_face: NDArray[np.int64],
    lines: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Where lines (L, 6), each a point and a unit direction, run inside a solid.

    Returns:
        For each of the I intervals: index of the line, index of the mesh, start and end along the line [m].
    """
    rays = lines.copy()
    rays[:, :3] -= REACH * rays[:, 3:]
    hits = caster.list_intersections(o3d.core.Tensor(rays.astype(np.float32)))
    line, owner = hits["ray_ids"].numpy().astype(np.int64), hits["geometry_ids"].numpy().astype(np.int64)
    y = hits["t_hit"].numpy().astype(np.float64) - REACH
    normals = face_normals[first_face[owner] + hits["primitive_ids"].numpy().astype(np.int64)]
    entering = np.einsum("ni,ni->n", normals, rays[line, 3:]) < 0.0
    order = np.lexsort((y, owner, line))
    line, owner, y, entering = line[order], owner[order], y[order], entering[order]
    # An interval runs from a hit that enters to the next one if that leaves; a hit on an edge may be reported twice.
    pair = np.flatnonzero((line[1:] == line[:-1]) & (owner[1:] == owner[:-1]) & entering[:-1] & ~entering[1:])
    return line[pair], owner[pair], y[pair], y[pair + 1]
