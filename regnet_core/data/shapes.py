"""Builders of household-like solids. Each takes lengths in metres and returns a watertight mesh.

The mesh's own frame is the one that is natural to build in; `objects.py` moves it to the centre of mass.
"""

import numpy as np
import trimesh
from trimesh.transformations import rotation_matrix, translation_matrix

from regnet_core.data.meshing import difference, globe, revolve, sweep, union


def box(x: float, y: float, z: float) -> trimesh.Trimesh:
    """A rectangular block."""
    return trimesh.creation.box(extents=(x, y, z))


def cylinder(radius: float, height: float) -> trimesh.Trimesh:
    """A plain cylinder along z."""
    return revolve([(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)])


def can(radius: float, height: float, chamfer: float) -> trimesh.Trimesh:
    """A drinks can: a cylinder with chamfered ends."""
    inner = radius - chamfer
    return revolve(
        [(0.0, 0.0), (inner, 0.0), (radius, chamfer), (radius, height - chamfer), (inner, height), (0.0, height)]
    )


def bottle(radius: float, height: float, neck: float, shoulder: float) -> trimesh.Trimesh:
    """A bottle with its cap on; `neck` is a fraction of the radius, `shoulder` of the height."""
    neck_radius = neck * radius
    start, end = shoulder * height, (shoulder + 0.6 * (1.0 - shoulder)) * height
    blend = np.linspace(0.0, 1.0, 7)
    smooth = blend * blend * (3.0 - 2.0 * blend)
    curve = np.stack([radius + (neck_radius - radius) * smooth, start + (end - start) * blend], axis=1)
    cap = [(1.15 * neck_radius, end + 0.1 * (height - end)), (1.15 * neck_radius, height), (0.0, height)]
    neck_top = (neck_radius, end + 0.1 * (height - end) - 1e-4)
    return revolve([(0.0, 0.0), (0.9 * radius, 0.0), (radius, 0.1 * radius), *curve.tolist(), neck_top, *cap])


def cup(radius: float, height: float, taper: float, wall: float, handle: float) -> trimesh.Trimesh:
    """A cup with a handle; `taper` is the bottom's share of the rim's radius, `handle` the handle's bar radius."""
    bottom = taper * radius
    outer = revolve([(0.0, 0.0), (bottom, 0.0), (radius, height), (0.0, height)])
    slope = (radius - bottom) / height
    floor_radius = bottom - wall + slope * wall
    opening = [(radius - wall, height), (radius - wall, height + wall), (0.0, height + wall)]
    inner = revolve([(0.0, wall), (floor_radius, wall), *opening])
    # An arc on the outside of the wall; its ends are buried in the wall and cut off by the inside.
    reach = 0.3 * height
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    path = np.stack([0.8 * reach * np.cos(angle), reach * np.sin(angle), np.zeros_like(angle)], axis=1)
    path = np.concatenate([path[:1] - [0.02, 0.0, 0.0], path, path[-1:] - [0.02, 0.0, 0.0]])
    bar = sweep(path, np.full(len(path), handle), sections=12)
    bar.apply_transform(rotation_matrix(0.5 * np.pi, [1.0, 0.0, 0.0]))
    bar.apply_translation([0.5 * (bottom + radius), 0.0, 0.5 * height])
    return difference(union([outer, bar]), inner)


def bowl(radius: float, depth: float, wall: float) -> trimesh.Trimesh:
    """A bowl: an elliptic shell with a flat foot; `depth` is a fraction of the rim's radius."""
    height = depth * radius
    angle = np.linspace(np.radians(25.0), 0.5 * np.pi, 10)
    outside = np.stack([radius * np.sin(angle), height * (1.0 - np.cos(angle) / np.cos(angle[0]))], axis=1)
    inside = np.stack([(radius - wall) * np.sin(angle), wall + (height - wall) * outside[:, 1] / height], axis=1)
    return revolve([(0.0, 0.0), *outside.tolist(), *inside[::-1].tolist(), (0.0, wall)])


def hammer(length: float, handle: float, head: float, head_radius: float) -> trimesh.Trimesh:
    """A hammer: a round handle along x (radius `handle`) and a head of length `head` across its end."""
    shaft = revolve([(0.0, 0.0), (handle, 0.0), (0.8 * handle, length), (0.0, length)], sections=24)
    face = revolve([(0.0, 0.0), (head_radius, 0.0), (head_radius, 0.45 * head), (0.0, 0.45 * head)], sections=24)
    peen = trimesh.creation.box(extents=(1.3 * head_radius, 1.3 * head_radius, 0.6 * head))
    peen.apply_translation([0.0, 0.0, 0.7 * head])
    block = union([face, peen])
    block.apply_translation([0.0, 0.0, -0.5 * head])
    block.apply_transform(rotation_matrix(0.5 * np.pi, [1.0, 0.0, 0.0]))
    block.apply_translation([0.0, 0.0, length - 0.6 * head_radius])
    return _lying(union([shaft, block]))


def screwdriver(length: float, handle: float, handle_share: float, shaft: float) -> trimesh.Trimesh:
    """A screwdriver along x: a bulged handle over `handle_share` of the length, then a thin shaft."""
    grip = handle_share * length
    # A domed butt: with a flat one it could come to rest standing on end.
    dome = np.linspace(0.0, 0.5 * np.pi, 5)[1:-1]
    butt = np.stack([0.8 * handle * np.sin(dome), 0.8 * handle * (1.0 - np.cos(dome))], axis=1)
    s = np.linspace(0.0, 1.0, 9)
    bulge = handle * (0.8 + 0.2 * np.sin(np.pi * np.minimum(1.6 * s, 1.0)) - 0.15 * s)
    curve = np.stack([bulge, 0.8 * handle + (grip - 0.8 * handle) * s], axis=1)
    tip = [(shaft, grip + 1e-4), (shaft, length - 2.0 * shaft), (0.5 * shaft, length), (0.0, length)]
    return _lying(revolve([(0.0, 0.0), *butt.tolist(), *curve.tolist(), *tip], sections=24))


def banana(length: float, radius: float, bend: float) -> trimesh.Trimesh:
    """A bent tube with tapered ends; `bend` is the whole turn of its axis [rad]."""
    s = np.linspace(-0.5, 0.5, 17)
    turn = length / bend
    path = np.stack([turn * np.sin(bend * s), turn * (np.cos(bend * s) - 1.0), np.zeros_like(s)], axis=1)
    return sweep(path, radius * (0.3 + 0.7 * np.sqrt(1.0 - (1.9 * s) ** 2)))


def ring(radius: float, tube: float) -> trimesh.Trimesh:
    """A torus; `radius` is that of the tube's centre line."""
    return trimesh.creation.torus(radius, tube, major_sections=48, minor_sections=16)


def l_profile(long_leg: float, short_leg: float, thickness: float, width: float) -> trimesh.Trimesh:
    """An angle bracket: two plates of one thickness that share an edge."""
    first = trimesh.creation.box(extents=(long_leg, width, thickness))
    first.apply_translation([0.5 * long_leg, 0.0, 0.5 * thickness])
    second = trimesh.creation.box(extents=(thickness, width, short_leg))
    second.apply_translation([0.5 * thickness, 0.0, 0.5 * short_leg])
    return union([first, second])


def t_profile(bar: float, stem: float, thickness: float, width: float) -> trimesh.Trimesh:
    """A T: a plate with a second one standing on its middle."""
    first = trimesh.creation.box(extents=(bar, width, thickness))
    second = trimesh.creation.box(extents=(thickness, width, stem))
    second.apply_translation([0.0, 0.0, 0.5 * stem])
    return union([first, second])


def superquadric(x: float, y: float, z: float, e1: float, e2: float) -> trimesh.Trimesh:
    """|p/size|^(2/e) = 1 with half sizes x, y, z; exponents 1 give an ellipsoid, small ones a rounded box."""
    mesh = globe()
    d = np.abs(mesh.vertices)
    equator = (d[:, 0] ** (2.0 / e2) + d[:, 1] ** (2.0 / e2)) ** (e2 / e1)
    reach = (equator + d[:, 2] ** (2.0 / e1)) ** (-0.5 * e1)
    mesh.vertices = mesh.vertices * reach[:, None] * (x, y, z)
    return mesh


def blob(radius: float, stretch: float, bump: float, a: float, b: float, c: float, d: float) -> trimesh.Trimesh:
    """A smooth stone-like lump: a sphere with four low-frequency bumps of weights a, b, c, d in [-1, 1]."""
    mesh = globe()
    x, y, z = mesh.vertices.T
    waves = a * (x * y) * 2.0 + b * (y * z) * 2.0 + c * (x * x - z * z) + d * 2.6 * x * y * z
    mesh.vertices = mesh.vertices * (radius * (1.0 + bump * waves))[:, None] * (stretch, 1.0, 1.0)
    return mesh


def _lying(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh turned from z to x, as a tool lies."""
    half = 0.5 * (mesh.bounds[0][2] + mesh.bounds[1][2])
    mesh.apply_transform(rotation_matrix(0.5 * np.pi, [0.0, 1.0, 0.0]) @ translation_matrix([0.0, 0.0, -half]))
    return mesh
