"""Builders of household-like solids. Each takes lengths in metres and returns a watertight mesh with its convex parts.

The solid's own frame is the one that is natural to build in; `objects.py` moves it to the centre of mass.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.transformations import rotation_matrix, translation_matrix

from regnet_core.data.objects import meshing
from regnet_core.data.objects.convex import clip, hull, sectors_around_hole, slabs, wedges
from regnet_core.data.objects.meshing import (
    SECTIONS,
    Solid,
    convex,
    difference,
    globe,
    prism,
    revolve,
    revolved_mesh,
    sweep,
    union,
)

# Plain solids


def box(x: float, y: float, z: float) -> Solid:
    """A rectangular block."""
    return meshing.block(x, y, z)


def block(width: float, depth: float, height: float) -> Solid:
    """A block near a cube; `depth` is a fraction of the width, `height` of the depth."""
    return meshing.block(width, depth * width, height * depth * width)


def cylinder(radius: float, height: float) -> Solid:
    """A plain cylinder along z."""
    return revolve([(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)])


def cone(radius: float, height: float, top: float) -> Solid:
    """A truncated cone; `top` is its upper radius's share of the lower one's."""
    return revolve([(0.0, 0.0), (radius, 0.0), (top * radius, height), (0.0, height)])


def can(radius: float, height: float, chamfer: float) -> Solid:
    """A drinks can: a cylinder with chamfered ends."""
    inner = radius - chamfer
    return revolve(
        [(0.0, 0.0), (inner, 0.0), (radius, chamfer), (radius, height - chamfer), (inner, height), (0.0, height)]
    )


def ramp(x: float, z: float, y: float, ridge: float) -> Solid:
    """A triangular prism of length y; its ridge, at height z, stands over the fraction `ridge` of its base x."""
    return prism([(0.0, 0.0), (x, 0.0), (ridge * x, z)], y)


def superquadric(x: float, y: float, z: float, e1: float, e2: float) -> Solid:
    """|p/size|^(2/e) = 1 with half sizes x, y, z; exponents 1 give an ellipsoid, small ones a rounded box."""
    mesh = globe()
    d = np.abs(mesh.vertices)
    equator = (d[:, 0] ** (2.0 / e2) + d[:, 1] ** (2.0 / e2)) ** (e2 / e1)
    reach = (equator + d[:, 2] ** (2.0 / e1)) ** (-0.5 * e1)
    mesh.vertices = mesh.vertices * reach[:, None] * (x, y, z)
    return convex(mesh)


def blob(radius: float, stretch: float, bump: float, a: float, b: float, c: float, d: float) -> Solid:
    """A smooth stone-like lump: a sphere with four low-frequency bumps of weights a, b, c, d in [-1, 1]."""
    mesh = globe()
    x, y, z = mesh.vertices.T
    waves = a * (x * y) * 2.0 + b * (y * z) * 2.0 + c * (x * x - z * z) + d * 2.6 * x * y * z
    mesh.vertices = mesh.vertices * (radius * (1.0 + bump * waves))[:, None] * (stretch, 1.0, 1.0)
    # Its hollows are shallow: half a millimetre below the hull at bumps of a tenth.
    return convex(mesh)


# Solids of revolution and vessels


def bottle(radius: float, height: float, neck: float, shoulder: float) -> Solid:
    """A bottle with its cap on; `neck` is a fraction of the radius, `shoulder` of the height."""
    neck_radius = neck * radius
    start, end = shoulder * height, (shoulder + 0.6 * (1.0 - shoulder)) * height
    blend = np.linspace(0.0, 1.0, 7)
    smooth = blend * blend * (3.0 - 2.0 * blend)
    curve = np.stack([radius + (neck_radius - radius) * smooth, start + (end - start) * blend], axis=1)
    cap = [(1.15 * neck_radius, end + 0.1 * (height - end)), (1.15 * neck_radius, height), (0.0, height)]
    neck_top = (neck_radius, end + 0.1 * (height - end) - 1e-4)
    return revolve([(0.0, 0.0), (0.9 * radius, 0.0), (radius, 0.1 * radius), *curve.tolist(), neck_top, *cap])


def lid(radius: float, thickness: float, knob: float, knob_height: float) -> Solid:
    """A round lid with a knob; `knob` is a fraction of the radius."""
    top, grip = thickness + knob_height, knob * radius
    knob_profile = [(0.7 * grip, thickness), (grip, thickness + 0.6 * knob_height), (grip, top), (0.0, top)]
    return revolve([(0.0, 0.0), (radius, 0.0), (radius, 0.5 * thickness), (0.9 * radius, thickness), *knob_profile])


def dumbbell(radius: float, length: float, waist: float, end: float) -> Solid:
    """A dumbbell; `waist` is the bar's share of the radius, `end` each weight's share of the length."""
    bar, weight, slope = waist * radius, end * length, 0.2 * radius
    first = [(0.8 * radius, 0.0), (radius, slope), (radius, weight - slope), (0.8 * radius, weight), (bar, weight)]
    second = [(r, length - z) for r, z in reversed(first)]
    return _lying(revolve([(0.0, 0.0), *first, *second, (0.0, length)]))


def pipe(radius: float, height: float, bore: float) -> Solid:
    """A piece of pipe along z; `bore` is the hole's share of the radius."""
    outer, inner = cylinder(radius, height), cylinder(bore * radius, height + 0.02).moved(z=-0.01)
    return Solid(difference(outer.mesh, inner.mesh), _annulus_parts(radius, bore * radius, height))


def cup(radius: float, height: float, taper: float, wall: float, handle: float) -> Solid:
    """A cup with a handle; `taper` is the bottom's share of the rim's radius, `handle` the handle's bar radius."""
    bottom = taper * radius
    # An arc on the outside of the wall; its ends are buried in the wall and cut off by the inside.
    reach = 0.3 * height
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    path = np.stack([0.8 * reach * np.cos(angle), reach * np.sin(angle), np.zeros_like(angle)], axis=1)
    path = np.concatenate([path[:1] - [0.02, 0.0, 0.0], path, path[-1:] - [0.02, 0.0, 0.0]])
    bar = sweep(path, np.full(len(path), handle), sections=12)
    bar = bar.turned(0.5 * np.pi, [1.0, 0.0, 0.0]).moved(0.5 * (bottom + radius), 0.0, 0.5 * height)
    return _Vessel(bottom, radius, height, wall, wall).solid(bar)


def plate(radius: float, height: float, foot: float, wall: float) -> Solid:
    """A plate: a flat round bottom and a slanted rim; `foot` is the bottom's share of the radius."""
    across = wall * float(np.hypot(1.0, (1.0 - foot) * radius / height))
    return _Vessel(foot * radius, radius, height, wall, across).solid()


def pan(radius: float, height: float, wall: float, handle: float, grip: float) -> Solid:
    """A pan; `handle` is the length of its straight handle in radii, `grip` the handle's radius."""
    bar = _lying(cylinder(grip, (0.5 + handle) * radius)).moved((0.75 + 0.5 * handle) * radius, z=height - 1.2 * grip)
    return _Vessel(0.85 * radius, radius, height, wall, wall).solid(bar)


def goblet(radius: float, height: float, stem: float, wall: float) -> Solid:
    """A drinking glass on a stem; `stem` is the stem's share of the height."""
    foot, bar, top = 0.1 * height, 0.18 * radius, stem * height
    base = [(0.0, 0.0), (0.85 * radius, 0.0), (0.85 * radius, 0.3 * foot), (bar, foot)]
    stand = revolve([*base, (bar, top + 0.5 * wall), (0.0, top + 0.5 * wall)])
    return union([stand, _Vessel(0.6 * radius, radius, height - top, wall, wall).solid().moved(z=top)])


def bowl(radius: float, depth: float, wall: float) -> Solid:
    """A bowl: an elliptic shell with a flat foot; `depth` is a fraction of the rim's radius."""
    height = depth * radius
    angle = np.linspace(np.radians(25.0), 0.5 * np.pi, 10)
    outside = np.stack([radius * np.sin(angle), height * (1.0 - np.cos(angle) / np.cos(angle[0]))], axis=1)
    inside = np.stack([(radius - wall) * np.sin(angle), wall + (height - wall) * outside[:, 1] / height], axis=1)
    mesh = revolved_mesh([(0.0, 0.0), *outside.tolist(), *inside[::-1].tolist(), (0.0, wall)])
    foot = slabs([(0.0, 0.0), outside[0], inside[0], (0.0, wall)], SECTIONS)
    # Three straight bands stand for the inside; they start a little within the wall, as they bulge out of it between.
    deeper = 2.0 / (1.0 + np.cos(0.5 * (angle[3] - angle[0])))
    inside[:-1] = (0.0, height) + (inside[:-1] - (0.0, height)) * deeper
    inside[-1, 0] *= 0.5 * (1.0 + deeper)
    bands = [wedges(outside[i : i + 4], inside[[i, i + 3]], SECTIONS) for i in (0, 3, 6)]
    return Solid(mesh, foot + sum(bands, ()))


def ring(radius: float, tube: float) -> Solid:
    """A torus; `radius` is that of the tube's centre line."""
    mesh = trimesh.creation.torus(radius, tube, major_sections=48, minor_sections=16)
    return Solid(mesh, _ring_parts(radius, tube))


# Tools


def hammer(length: float, handle: float, head: float, head_radius: float) -> Solid:
    """A hammer: a round handle along x (radius `handle`) and a head of length `head` across its end."""
    shaft = revolve([(0.0, 0.0), (handle, 0.0), (0.8 * handle, length), (0.0, length)], sections=24)
    face = revolve([(0.0, 0.0), (head_radius, 0.0), (head_radius, 0.45 * head), (0.0, 0.45 * head)], sections=24)
    peen = meshing.block(1.3 * head_radius, 1.3 * head_radius, 0.6 * head).moved(z=0.7 * head)
    top = union([face, peen]).moved(z=-0.5 * head)
    top = top.turned(0.5 * np.pi, [1.0, 0.0, 0.0]).moved(z=length - 0.6 * head_radius)
    return _lying(union([shaft, top]))


def screwdriver(length: float, handle: float, handle_share: float, shaft: float) -> Solid:
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


def spatula(length: float, width: float, thickness: float, grip: float) -> Solid:
    """A spatula along x: a flat blade over a third of its length, and a round handle of radius `grip`."""
    blade = meshing.block(0.35 * length, width, thickness).moved(0.175 * length, 0.0, 0.5 * thickness)
    stick = _lying(cylinder(grip, 0.7 * length)).moved(0.65 * length, 0.0, 0.5 * thickness)
    return union([blade, stick])


def scissors(length: float, ring: float, thickness: float, opening: float) -> Solid:
    """Scissors: two flat blades that cross, each with a finger ring, open by an angle [rad].

    `ring` is the outer radius of a finger ring, as a share of the length.
    """
    half = _scissor_half(length, ring * length, thickness)
    other = half.turned(np.pi, [1.0, 0.0, 0.0]).moved(z=1.7 * thickness)
    axis = [0.0, 0.0, 1.0]
    return union([half.turned(0.5 * opening, axis), other.turned(-0.5 * opening, axis)])


def spray_bottle(radius: float, height: float, head: float, trigger: float) -> Solid:
    """A bottle with a spray head of length `head` across its top and a trigger in front, both in radii."""
    neck, top = 0.35 * radius, 0.78 * height
    body = [(0.0, 0.0), (radius, 0.0), (radius, 0.5 * height), (neck, 0.65 * height), (neck, top), (0.0, top)]
    nozzle = meshing.block(head * radius, 0.8 * radius, 0.14 * height).moved(0.25 * head * radius, z=0.83 * height)
    lever = meshing.block(0.22 * radius, 0.4 * radius, 0.22 * height).turned(trigger, [0.0, 1.0, 0.0])
    return union([revolve(body), nozzle, lever.moved(0.5 * head * radius, 0.0, 0.72 * height)])


# Bars and tubes


def banana(length: float, radius: float, bend: float) -> Solid:
    """A bent tube with tapered ends; `bend` is the whole turn of its axis [rad]."""
    s = np.linspace(-0.5, 0.5, 17)
    turn = length / bend
    path = np.stack([turn * np.sin(bend * s), turn * (np.cos(bend * s) - 1.0), np.zeros_like(s)], axis=1)
    return sweep(path, radius * (0.3 + 0.7 * np.sqrt(1.0 - (1.9 * s) ** 2)))


def u_tube(radius: float, span: float, leg: float) -> Solid:
    """A tube bent to a U: two legs whose axes are `span` apart, joined by a half circle."""
    arc = 0.5 * np.pi * span
    return _bent_tube(radius, [(leg, 0.0), (arc, np.pi), (leg, 0.0)])


def s_tube(radius: float, length: float, bend: float) -> Solid:
    """A tube bent to an S: two arcs, each of half the length and a turn of `bend` [rad], to opposite sides."""
    return _bent_tube(radius, [(0.5 * length, bend), (0.5 * length, -bend)])


def l_profile(long_leg: float, short_leg: float, thickness: float, width: float) -> Solid:
    """An angle bracket: two plates of one thickness that share an edge."""
    first = meshing.block(long_leg, width, thickness).moved(0.5 * long_leg, 0.0, 0.5 * thickness)
    return union([first, meshing.block(thickness, width, short_leg).moved(0.5 * thickness, 0.0, 0.5 * short_leg)])


def t_profile(bar: float, stem: float, thickness: float, width: float) -> Solid:
    """A T: a plate with a second one standing on its middle."""
    first = meshing.block(bar, width, thickness)
    return union([first, meshing.block(thickness, width, stem).moved(z=0.5 * stem)])


def jack(x: float, y: float, z: float, thickness: float) -> Solid:
    """Three square bars across each other at their middles, of lengths x, y and z."""
    bars = ((x, thickness, thickness), (thickness, y, thickness), (thickness, thickness, z))
    return union([meshing.block(*extents) for extents in bars])


def star(radius: float, height: float, inner: float) -> Solid:
    """A prism over a five-pointed star; `inner` is the share of the radius at which its points begin."""
    angle = np.arange(10) * np.pi / 5.0
    reach = radius * np.where(np.arange(10) % 2 == 0, 1.0, inner)
    corners = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    middle = prism(corners[1::2], height)
    return union([middle, *(prism([(0.0, 0.0), *corners[[k - 1, k, k + 1]]], height) for k in range(0, 10, 2))])


# Unions and cuts


def composite(x: float, y: float, z: float, post: float, rise: float, bar: float, turn: float) -> Solid:
    """A block x y z, a post of radius `post` that rises over one end, and a bar across the other, turned by `turn`.

    The bar is as long as y plus `bar`, and two fifths as wide and high as z.
    """
    base = meshing.block(x, y, z)
    column = cylinder(post, 0.5 * z + rise).moved(x=0.22 * x)
    beam = meshing.block(0.4 * z, y + bar, 0.4 * z).turned(turn, [0.0, 0.0, 1.0]).moved(x=-0.22 * x, z=0.45 * z)
    return union([base, column, beam])


def drilled(x: float, y: float, z: float, hole: float) -> Solid:
    """A block with a round hole along z; `hole` is the hole's share of the shorter of x and y."""
    return _drill(meshing.block(x, y, z), 0.5 * hole * min(x, y), z)


def nut(radius: float, height: float, hole: float) -> Solid:
    """A hexagonal nut; `radius` reaches its corners, `hole` is the hole's share of it."""
    hexagon = revolve([(0.0, -0.5 * height), (radius, -0.5 * height), (radius, 0.5 * height), (0.0, 0.5 * height)], 6)
    return _drill(hexagon, hole * radius, height)


def channel(x: float, z: float, y: float, wall: float) -> Solid:
    """A block x y z with a notch along y, so that a floor and two walls of thickness `wall` remain."""
    side = meshing.block(wall, y, z).moved(z=0.5 * z)
    floor = meshing.block(x, y, wall).moved(z=0.5 * wall)
    return union([floor, side.moved(x=0.5 * (x - wall)), side.moved(x=-0.5 * (x - wall))])


def tray(x: float, y: float, z: float, wall: float) -> Solid:
    """A block x y z with a pocket, so that a floor and four walls of thickness `wall` remain."""
    end = meshing.block(x, wall, z).moved(z=0.5 * z)
    return union([channel(x, z, y, wall), end.moved(y=0.5 * (y - wall)), end.moved(y=-0.5 * (y - wall))])


def slotted(radius: float, height: float, slot: float, depth: float) -> Solid:
    """A cylinder with a slot across its top; `slot` is a fraction of the diameter, `depth` of the height."""
    half, floor = slot * radius, (1.0 - depth) * height
    whole = cylinder(radius, height)
    cut = meshing.block(2.0 * half, 3.0 * radius, 2.0 * depth * height).moved(z=height)
    (part,) = whole.parts
    upper = clip(part, (0.0, 0.0, 1.0), floor)
    cheeks = (clip(upper, (1.0, 0.0, 0.0), half), clip(upper, (-1.0, 0.0, 0.0), half))
    return Solid(difference(whole.mesh, cut.mesh), (clip(part, (0.0, 0.0, -1.0), -floor), *cheeks))


# Shared pieces


@dataclass(frozen=True)
class _Vessel:
    """An open conical vessel, standing on z = 0.

    Attributes:
        bottom: outer radius below [m].
        radius: outer radius of the rim [m].
        height: [m].
        floor: thickness of the floor [m].
        wall: thickness of the wall, measured horizontally [m].
    """

    bottom: float
    radius: float
    height: float
    floor: float
    wall: float

    @property
    def slope(self) -> float:
        return (self.radius - self.bottom) / self.height

    @property
    def floor_radius(self) -> float:
        """Radius of the floor, on the inside."""
        return self.bottom - self.wall + self.slope * self.floor

    def body(self) -> trimesh.Trimesh:
        """The vessel as a full body."""
        return revolved_mesh([(0.0, 0.0), (self.bottom, 0.0), (self.radius, self.height), (0.0, self.height)])

    def cavity(self) -> trimesh.Trimesh:
        """What is cut out of the body, and a little above it."""
        opening, above = self.radius - self.wall, self.height + self.wall
        side = [(self.floor_radius, self.floor), (opening, self.height), (opening, above)]
        return revolved_mesh([(0.0, self.floor), *side, (0.0, above)])

    def parts(self) -> tuple[trimesh.Trimesh, ...]:
        """Its floor, and its wall in wedges."""
        edge = (self.floor_radius + self.wall, self.floor)
        outer = [edge, (self.radius, self.height)]
        inner = [(self.floor_radius, self.floor), (self.radius - self.wall, self.height)]
        return slabs([(0.0, 0.0), (self.bottom, 0.0), edge, (0.0, self.floor)], SECTIONS) + wedges(
            outer, inner, SECTIONS
        )

    def outside(self, parts: Sequence[trimesh.Trimesh]) -> tuple[trimesh.Trimesh, ...]:
        """What of a handle's parts lies beyond the middle of the wall, towards +x."""
        normal, offset = np.array([1.0, 0.0, -self.slope]), self.bottom - 0.5 * self.wall
        reaching = [part for part in parts if np.max(part.vertices @ normal) > offset + 1e-3]
        return tuple(clip(part, normal, offset) for part in reaching)

    def solid(self, handle: Solid | None = None) -> Solid:
        """The vessel, with a handle whose end inside the cavity is cut off."""
        if handle is None:
            return Solid(difference(self.body(), self.cavity()), self.parts())
        whole = trimesh.boolean.union([self.body(), handle.mesh], engine="manifold")
        return Solid(difference(whole, self.cavity()), self.parts() + self.outside(handle.parts))


def _annulus_parts(outer: float, inner: float, height: float, sections: int = SECTIONS) -> tuple[trimesh.Trimesh, ...]:
    """Convex parts of a flat ring from z = 0 to `height`."""
    return wedges([(outer, 0.0), (outer, height)], [(inner, 0.0), (inner, height)], sections)


def _ring_parts(radius: float, tube: float) -> tuple[trimesh.Trimesh, ...]:
    """Convex parts of a torus: 16 pieces, 24 of a large one, cut at its sections."""
    around = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    count = 16 if radius < 0.04 else 24
    profile = np.stack([radius + tube * np.cos(around), tube * np.sin(around)], axis=1)
    parts = []
    for k in range(count):
        angle = 2.0 * np.pi * (k + np.linspace(0.0, 1.0, 48 // count + 1)) / count
        flat = profile[:, None, :1] * np.stack([np.cos(angle), np.sin(angle)], axis=1)[None]
        height = np.broadcast_to(profile[:, None, 1:], (*flat.shape[:2], 1))
        parts.append(hull(np.concatenate([flat, height], axis=2).reshape(-1, 3)))
    return tuple(parts)


def _drill(solid: Solid, radius: float, height: float) -> Solid:
    """A convex solid centred at the origin with a round hole along z."""
    hole = cylinder(radius, height + 0.02).moved(z=-0.5 * height - 0.01)
    (part,) = solid.parts
    return Solid(difference(solid.mesh, hole.mesh), sectors_around_hole(part, radius))


def _scissor_half(length: float, ring: float, thickness: float) -> Solid:
    """One half of a pair of scissors in z from 0 to `thickness`: its blade points to +x, its ring lies at -x, -y."""
    wide = 0.05 * length
    blade = prism([(-wide, -wide), (0.6 * length, -0.3 * wide), (0.6 * length, 0.0), (-wide, wide)], thickness)
    centre = np.array([-0.4 * length + ring, -1.15 * ring])
    bar = 0.35 * ring
    hole = cylinder(ring - bar, thickness + 0.02).moved(z=-0.01)
    loop = Solid(
        difference(cylinder(ring, thickness).mesh, hole.mesh), _annulus_parts(ring, ring - bar, thickness)
    ).moved(*centre)
    near = centre + (ring - 0.5 * bar) * -centre / np.linalg.norm(centre)
    across = 0.7 * wide * np.array([centre[1], -centre[0]]) / np.linalg.norm(centre)
    shank = prism([near - 0.7 * across, near + 0.7 * across, across, -across], thickness)
    return union([blade, shank, loop])


def _bent_tube(radius: float, pieces: Sequence[tuple[float, float]], steps: int = 36) -> Solid:
    """A tube along pieces of (length [m], turn [rad]), each with a constant curvature."""
    lengths, turns = np.array(pieces).T
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    heading_at = np.concatenate([[0.0], np.cumsum(turns)])
    along = np.linspace(0.0, ends[-1], steps + 1)
    heading = np.interp(0.5 * (along[1:] + along[:-1]), ends, heading_at)
    step = ends[-1] / steps
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(step * _direction(heading), axis=0)])
    return sweep(np.insert(points, 2, 0.0, axis=1), np.full(steps + 1, radius))


def _direction(heading: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.cos(heading), np.sin(heading)], axis=1)


def _lying(solid: Solid) -> Solid:
    """A solid built along z, turned to lie along x with its middle over the origin."""
    half = 0.5 * (solid.mesh.bounds[0][2] + solid.mesh.bounds[1][2])
    return solid.placed(rotation_matrix(0.5 * np.pi, [0.0, 1.0, 0.0]) @ translation_matrix([0.0, 0.0, -half]))
