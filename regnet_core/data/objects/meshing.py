"""Solids, which know their mesh and its convex parts, and the operations that build them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from trimesh.transformations import rotation_matrix, translation_matrix

from regnet_core.data.objects.convex import hull, slabs, tube_pieces

SECTIONS = 40
"""Sides of a revolved shape: a face normal is at most 4.5 degrees off the smooth surface's."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape.

    Attributes:
        mesh: watertight [m].
        parts: convex meshes that together fill it, for physics.
    """

    mesh: trimesh.Trimesh
    parts: tuple[trimesh.Trimesh, ...]

    def placed(self, T: ArrayLike) -> "Solid":
        """The solid moved by a rigid transform (4, 4)."""
        mesh, *parts = (item.copy().apply_transform(T) for item in (self.mesh, *self.parts))
        return Solid(mesh, tuple(parts))

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """The solid moved along the axes [m]."""
        return self.placed(translation_matrix([x, y, z]))

    def turned(self, angle: float, axis: Sequence[float]) -> "Solid":
        """The solid turned about an axis through the origin [rad]."""
        return self.placed(rotation_matrix(angle, axis))


def convex(mesh: trimesh.Trimesh) -> Solid:
    """A solid whose only part is its convex hull."""
    return Solid(mesh, (mesh.convex_hull,))


def block(x: float, y: float, z: float) -> Solid:
    """A rectangular block centred at the origin."""
    return convex(trimesh.creation.box(extents=(x, y, z)))


def prism(outline: ArrayLike, height: float) -> Solid:
    """A prism over a convex outline (P, 2), from z = 0 to `height`."""
    corners = np.asarray(outline, dtype=np.float64)
    return convex(hull(np.concatenate([np.insert(corners, 2, z, axis=1) for z in (0.0, height)])))


def revolved_mesh(profile: ArrayLike, sections: int = SECTIONS) -> trimesh.Trimesh:
    """Revolves a profile about z.

    Args:
        profile: (P, 2) radius and height [m], from the bottom of the axis outwards and back to the axis; the first and
            the last radius must be 0 so that the solid is closed.
        sections: number of sides.
    """
    points = np.asarray(profile, dtype=np.float64)
    if points[0, 0] != 0.0 or points[-1, 0] != 0.0:
        raise ValueError(f"a profile starts and ends on the axis (radius 0), got {points[0, 0]} and {points[-1, 0]}")
    return trimesh.creation.revolve(points, sections=sections)


def revolve(profile: ArrayLike, sections: int = SECTIONS) -> Solid:
    """Revolves a profile that never falls, as in `revolved_mesh`, to a solid without a cavity."""
    return Solid(revolved_mesh(profile, sections), slabs(profile, sections))


def sweep(path: NDArray[np.float64], radii: NDArray[np.float64], sections: int = 20) -> Solid:
    """A tube of changing radius along a path in the x-y plane, closed by flat caps.

    Args:
        path: (P, 3) points with z = 0 [m].
        radii: (P,) radius of the tube at each point [m], all positive.
        sections: corners of the cross-section.
    """
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    sideways = np.cross([0.0, 0.0, 1.0], tangents)  # (P, 3)
    angle = np.linspace(0.0, 2.0 * np.pi, sections, endpoint=False)
    ring = np.cos(angle)[None, :, None] * sideways[:, None, :] + np.sin(angle)[None, :, None] * np.array(
        [0.0, 0.0, 1.0]
    )
    rings = path[:, None, :] + radii[:, None, None] * ring  # (P, sections, 3)
    vertices = np.concatenate([rings.reshape(-1, 3), path[:1], path[-1:]])
    mesh = _closed(trimesh.Trimesh(vertices, _tube_faces(len(path), sections), process=False))
    return Solid(mesh, tube_pieces(path, rings))


def _tube_faces(rings: int, sections: int) -> NDArray[np.int64]:
    """Triangles (F, 3) of a grid of rings, with a fan at each end; the two fan centres are the last two vertices."""
    start = np.arange(rings - 1)[:, None] * sections
    here = np.arange(sections)[None, :]
    after = (here + 1) % sections
    a, b = start + here, start + after
    c, d = a + sections, b + sections
    sides = np.stack([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    last = (rings - 1) * sections
    first_centre, last_centre = rings * sections, rings * sections + 1
    here, after = here[0], after[0]
    fans = [
        np.stack([np.full(sections, first_centre), after, here], -1),
        np.stack([np.full(sections, last_centre), last + here, last + after], -1),
    ]
    return np.concatenate([sides, *fans])


def globe(sections: int = 3) -> trimesh.Trimesh:
    """A unit sphere of nearly equal triangles, to be deformed by moving its vertices."""
    return trimesh.creation.icosphere(subdivisions=sections)


def union(solids: Sequence[Solid]) -> Solid:
    """The boolean union of solids (manifold3d)."""
    mesh = trimesh.boolean.union([solid.mesh for solid in solids], engine="manifold")
    return Solid(mesh, tuple(part for solid in solids for part in solid.parts))


def difference(solid: trimesh.Trimesh, cut: trimesh.Trimesh) -> trimesh.Trimesh:
    """`solid` without `cut` (manifold3d)."""
    return trimesh.boolean.difference([solid, cut], engine="manifold")


def _closed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with its faces pointing outwards."""
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh
