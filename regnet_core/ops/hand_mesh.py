"""An open hand against a triangle mesh: exact collision, and the two contacts when the jaw closes.

Everything is computed in the grasp frame, where palm and fingers are axis-aligned boxes. A triangle meets a box by the
separating-axis test (Akenine-Moller, "Fast 3D triangle-box overlap testing", 2001); what lies between the fingers is
each triangle clipped to the closing region, so that the contacts are exact and do not depend on a spacing of rays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array, Mask
from regnet_core.gripper import Gripper
from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.triangle_tree import DEEPEST, TriangleTree

CONTACT_DEPTH = 0.0005
"""Surface this close behind the first touched point belongs to the same contact [m]."""


class HandMesh(NamedTuple):
    """What M open hands meet on one mesh."""

    collides: Mask
    """(M,): the palm or a finger, grown by the clearance, meets the surface."""
    high: Array
    """(M,): largest y of the surface between the fingers [m], where the finger at +Y touches; -inf if it is empty."""
    low: Array
    """(M,): smallest y, where the finger at -Y touches; +inf if it is empty."""
    cos_high: Array
    """(M,): cosine between the finger's inward motion and the reversed outward normal at ``high``, in [0, 1]."""
    cos_low: Array
    """(M,): the same at ``low``."""
    normal_high: Array
    """(M, 3): mean outward normal at ``high``, in the frame of the mesh; zero where there is none."""
    normal_low: Array
    """(M, 3): the same at ``low``."""
    on_axis: Array
    """(M,): x at which the approach axis first meets the surface, 0 <= x <= depth [m]; +inf where it does not."""
    nearest: Array
    """(M,): smallest x of the surface between the fingers [m]; +inf where it is empty."""

    def take(self, chosen: Mask) -> HandMesh:
        """The hands for which the mask (M,) is true."""
        return HandMesh(
            self.collides[chosen],
            self.high[chosen],
            self.low[chosen],
            self.cos_high[chosen],
            self.cos_low[chosen],
            self.normal_high[chosen],
            self.normal_low[chosen],
            self.on_axis[chosen],
            self.nearest[chosen],
        )


def hand_on_mesh(
    tree: TriangleTree,
    rotation: Array,
    translation: Array,
    opening: Array,
    gripper: Gripper,
    clearance: float = 0.0,
    *,
    bodies: bool = True,
) -> HandMesh:
    """Meet M hands with a mesh.

    The surface is what counts: a hand wholly inside the solid, whose boundary it does not touch, is not noticed.

    Args:
        tree: of the mesh.
        rotation: (M, 3, 3) grasp frames in the frame of the mesh, columns X, Y, Z.
        translation: (M, 3) their origins c [m].
        opening: (M,) distance between the finger pads [m].
        gripper: the hand.
        clearance: palm and fingers are grown by this on every side [m].
        bodies: whether palm and fingers are there at all; without them nothing collides and every contact is given.
    """
    m = len(rotation)
    collides = np.zeros(m, np.bool_)
    spans = np.empty((m, 4))
    normals = np.zeros((m, 2, 3))
    size = np.array(
        [gripper.depth, gripper.height / 2, gripper.thickness, gripper.palm_depth, gripper.width / 2, clearance]
    )

    for_each_range(
        _meet, m, 10_000,
        np.ascontiguousarray(rotation), np.ascontiguousarray(translation), np.ascontiguousarray(opening), size,
        tree.corners, tree.normals, tree.lower, tree.upper, tree.right, tree.first, tree.leaf_count, bodies,
        collides, spans, normals,
    )  # fmt: skip
    closing = rotation[:, :, 1]
    return HandMesh(
        collides=collides,
        high=spans[:, 0],
        low=spans[:, 1],
        cos_high=np.clip(np.einsum("mi,mi->m", normals[:, 0], closing), 0.0, 1.0),
        cos_low=np.clip(-np.einsum("mi,mi->m", normals[:, 1], closing), 0.0, 1.0),
        normal_high=normals[:, 0],
        normal_low=normals[:, 1],
        on_axis=spans[:, 2],
        nearest=spans[:, 3],
    )


def box_mesh_faces() -> npt.NDArray[np.int64]:
    """(12, 3) faces of a box whose corners come in the order of ``Box.corners``, counter-clockwise from outside."""
    return np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip


@compiled
def _meet(  # type: ignore[no-untyped-def]
    begin, end, rotation, translation, opening, size, corners, normals, node_lower, node_upper, right, first, count,
    bodies, collides, spans, contact_normals,
):  # fmt: skip
    depth, half_z, thickness, palm_depth, half_w, grow = size
    stack = np.empty(DEEPEST, np.int64)
    triangle = np.empty((3, 3))
    polygon, spare = np.empty((12, 3)), np.empty((12, 3))
    # The triangles of a hand that reach between its fingers, for the second look at its contacts.
    kept = np.empty(len(corners), np.int64)
    hand_low, hand_high = np.empty(3), np.empty(3)
    low, high = np.empty(3), np.empty(3)
    close_low, close_high = np.empty(3), np.empty(3)
    for m in range(begin, end):
        pose, c = rotation[m], translation[m]
        inner = opening[m] / 2
        outer = max(half_w, inner) + thickness + grow
        hand_low[0], hand_high[0] = -palm_depth - grow, depth + grow
        hand_low[1], hand_high[1] = -outer, outer
        hand_low[2], hand_high[2] = -half_z - grow, half_z + grow
        close_low[0], close_high[0] = 0.0, depth
        close_low[1], close_high[1] = -inner, inner
        close_low[2], close_high[2] = -half_z, half_z
        if not bodies:
            hand_low[:], hand_high[:] = close_low, close_high
        hit = False
        y_high, y_low, x_axis, x_near = -np.inf, np.inf, np.inf, np.inf
        between = 0
        stack[0] = 0
        top = 1
        while top > 0 and not hit:
            top -= 1
            node = stack[top]
            if not _near(node_lower, node_upper, node, pose, c, hand_low, hand_high):
                continue
            if count[node] == 0:
                stack[top], stack[top + 1] = right[node], node + 1
                top += 2
                continue
            for t in range(first[node], first[node] + count[node]):
                _into_frame(corners, t, pose, c, triangle)
                if _apart(triangle, hand_low, hand_high):
                    continue
                if bodies:
                    low[2], high[2] = hand_low[2], hand_high[2]
                    low[0], high[0] = hand_low[0], grow
                    low[1], high[1] = -half_w - thickness - grow, half_w + thickness + grow
                    hit = _overlaps(triangle, low, high)
                    low[0], high[0] = -grow, hand_high[0]
                    if not hit:
                        low[1], high[1] = inner - grow, inner + thickness + grow
                        hit = _overlaps(triangle, low, high)
                    if not hit:
                        low[1], high[1] = -inner - thickness - grow, -inner + grow
                        hit = _overlaps(triangle, low, high)
                if hit:
                    break
                if _apart(triangle, close_low, close_high):
                    continue
                corner_count = _clip(triangle, close_low, close_high, polygon, spare)
                if corner_count == 0:
                    continue
                kept[between] = t
                between += 1
                for i in range(corner_count):
                    y_high, y_low = max(y_high, polygon[i, 1]), min(y_low, polygon[i, 1])
                    x_near = min(x_near, polygon[i, 0])
                x_axis = min(x_axis, _axis_crossing(triangle, depth))
        collides[m] = hit
        spans[m, 0], spans[m, 1], spans[m, 2], spans[m, 3] = y_high, y_low, x_axis, x_near
        if hit or between == 0:
            continue
        low[0], high[0], low[2], high[2] = 0.0, depth, -half_z, half_z
        for side in range(2):
            touched = y_high if side == 0 else y_low
            low[1], high[1] = touched - CONTACT_DEPTH, touched + CONTACT_DEPTH
            sign = 1.0 - 2.0 * side
            nx, ny, nz = _mean_normal(
                corners, normals, kept, between, pose, c, low, high, sign, triangle, polygon, spare
            )
            contact_normals[m, side, 0], contact_normals[m, side, 1], contact_normals[m, side, 2] = nx, ny, nz


@compiled
def _mean_normal(corners, normals, kept, count, pose, c, low, high, sign, triangle, polygon, spare):  # type: ignore[no-untyped-def]
    """Unit mean normal of what lies in the box and faces the finger at sign * Y, as its pad sees it; or zero."""
    nx, ny, nz = 0.0, 0.0, 0.0
    for k in range(count):
        t = kept[k]
        towards = normals[t, 0] * pose[0, 1] + normals[t, 1] * pose[1, 1] + normals[t, 2] * pose[2, 1]
        towards *= sign
        if towards <= 0.0:
            continue
        _into_frame(corners, t, pose, c, triangle)
        if _apart(triangle, low, high):
            continue
        corner_count = _clip(triangle, low, high, polygon, spare)
        if corner_count < 3:
            continue
        # Weighted by the area that the pad sees. The tiny floor lets an edge or a corner count for itself.
        weight = _seen_area(polygon, corner_count) + 1e-12 * towards
        nx, ny, nz = nx + weight * normals[t, 0], ny + weight * normals[t, 1], nz + weight * normals[t, 2]
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if length > 0.0:
        nx, ny, nz = nx / length, ny / length, nz / length
    return nx, ny, nz


@inlined
def _near(lower, upper, node, pose, c, hand_low, hand_high):  # type: ignore[no-untyped-def]
    """Whether a node's box may touch the hand's box; tested along the hand's three axes."""
    near = True
    for a in range(3):
        centre, reach = 0.0, 0.0
        for i in range(3):
            centre += pose[i, a] * ((lower[node, i] + upper[node, i]) / 2 - c[i])
            reach += abs(pose[i, a]) * (upper[node, i] - lower[node, i]) / 2
        if centre - reach > hand_high[a] or centre + reach < hand_low[a]:
            near = False
            break
    return near


@inlined
def _into_frame(corners, t, pose, c, triangle):  # type: ignore[no-untyped-def]
    for i in range(3):
        x, y, z = corners[t, i, 0] - c[0], corners[t, i, 1] - c[1], corners[t, i, 2] - c[2]
        for a in range(3):
            triangle[i, a] = pose[0, a] * x + pose[1, a] * y + pose[2, a] * z


@inlined
def _apart(triangle, low, high):  # type: ignore[no-untyped-def]
    """Whether the triangle's own axis-aligned box misses the box."""
    apart = False
    for a in range(3):
        least = min(triangle[0, a], triangle[1, a], triangle[2, a])
        most = max(triangle[0, a], triangle[1, a], triangle[2, a])
        if least > high[a] or most < low[a]:
            apart = True
            break
    return apart


@compiled
def _overlaps(triangle, low, high):  # type: ignore[no-untyped-def]
    """Separating-axis test of a triangle and an axis-aligned box; touching counts as overlapping."""
    if _apart(triangle, low, high):
        return False
    hx, hy, hz = (high[0] - low[0]) / 2, (high[1] - low[1]) / 2, (high[2] - low[2]) / 2
    cx, cy, cz = (high[0] + low[0]) / 2, (high[1] + low[1]) / 2, (high[2] + low[2]) / 2
    ax, ay, az = triangle[0, 0] - cx, triangle[0, 1] - cy, triangle[0, 2] - cz
    bx, by, bz = triangle[1, 0] - cx, triangle[1, 1] - cy, triangle[1, 2] - cz
    dx, dy, dz = triangle[2, 0] - cx, triangle[2, 1] - cy, triangle[2, 2] - cz
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = dx - ax, dy - ay, dz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    if abs(nx * ax + ny * ay + nz * az) > hx * abs(nx) + hy * abs(ny) + hz * abs(nz):
        return False
    for edge in range(3):
        if edge == 0:
            ex, ey, ez = ux, uy, uz
        elif edge == 1:
            ex, ey, ez = dx - bx, dy - by, dz - bz
        else:
            ex, ey, ez = -vx, -vy, -vz
        for axis in range(3):
            if axis == 0:
                kx, ky, kz = 0.0, -ez, ey
            elif axis == 1:
                kx, ky, kz = ez, 0.0, -ex
            else:
                kx, ky, kz = -ey, ex, 0.0
            p, q, r = kx * ax + ky * ay + kz * az, kx * bx + ky * by + kz * bz, kx * dx + ky * dy + kz * dz
            reach = hx * abs(kx) + hy * abs(ky) + hz * abs(kz)
            if min(p, q, r) > reach or max(p, q, r) < -reach:
                return False
    return True


@compiled
def _clip(triangle, low, high, polygon, spare):  # type: ignore[no-untyped-def]
    """Sutherland-Hodgman: the part of the triangle inside the box as a polygon; returns its number of corners."""
    for i in range(3):
        for a in range(3):
            polygon[i, a] = triangle[i, a]
    corners = 3
    for axis in (2, 0, 1):
        least = min(triangle[0, axis], triangle[1, axis], triangle[2, axis])
        most = max(triangle[0, axis], triangle[1, axis], triangle[2, axis])
        for side in range(2):
            if (side == 0 and least >= low[axis]) or (side == 1 and most <= high[axis]):
                continue
            limit = low[axis] if side == 0 else high[axis]
            sign = 1.0 if side == 0 else -1.0
            made = 0
            for i in range(corners):
                j = i + 1 if i + 1 < corners else 0
                here, there = sign * (polygon[i, axis] - limit), sign * (polygon[j, axis] - limit)
                if here >= 0.0:
                    for a in range(3):
                        spare[made, a] = polygon[i, a]
                    made += 1
                if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
                    share = here / (here - there)
                    for a in range(3):
                        spare[made, a] = polygon[i, a] + share * (polygon[j, a] - polygon[i, a])
                    spare[made, axis] = limit
                    made += 1
            corners = made
            if corners == 0:
                return 0
            for i in range(corners):
                for a in range(3):
                    polygon[i, a] = spare[i, a]
    return corners


@inlined
def _seen_area(polygon, corners):  # type: ignore[no-untyped-def]
    """Area of the polygon as seen along y."""
    doubled = 0.0
    for i in range(corners):
        j = i + 1 if i + 1 < corners else 0
        doubled += polygon[i, 0] * polygon[j, 2] - polygon[j, 0] * polygon[i, 2]
    return abs(doubled) / 2


@inlined
def _axis_crossing(triangle, depth):  # type: ignore[no-untyped-def]
    """x where the axis y = z = 0 crosses the triangle, when 0 <= x <= depth; infinity otherwise."""
    ay, az, by, bz = triangle[0, 1], triangle[0, 2], triangle[1, 1], triangle[1, 2]
    cy, cz = triangle[2, 1], triangle[2, 2]
    u, v, w = by * cz - bz * cy, cy * az - cz * ay, ay * bz - az * by
    total = u + v + w
    x = np.inf
    if total != 0.0 and ((u >= 0.0 and v >= 0.0 and w >= 0.0) or (u <= 0.0 and v <= 0.0 and w <= 0.0)):
        x = (u * triangle[0, 0] + v * triangle[1, 0] + w * triangle[2, 0]) / total
        if x < 0.0 or x > depth:
            x = np.inf
    return x
