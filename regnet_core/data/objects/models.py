"""The procedural object library: families of shapes, drawn from a seed.

A family is a builder and the range of each of its parameters, so a model is fully described by a family's name and a
few numbers, and different parts of a data set can be kept apart by their ranges.
"""

import colorsys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np
import trimesh
from numpy.typing import NDArray

from regnet_core.data.objects import shapes
from regnet_core.data.objects.convex import convex_decomposition
from regnet_core.data.objects.meshing import Solid
from regnet_core.errors import InvalidInputError


@dataclass(frozen=True)
class Family:
    """A kind of shape: `build(**params)` with every parameter drawn uniformly from its range.

    Attributes:
        build: builder of the solid, from `shapes`.
        ranges: (low, high) of each parameter; lengths in metres. The first two set the size.
        convex: the mesh is its own convex hull.
        held_out: kept for tests of what a network has never seen; drawn only when asked for by name.
    """

    build: Callable[..., Solid]
    ranges: Mapping[str, tuple[float, float]]
    convex: bool = False
    held_out: bool = False


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "box": Family(shapes.box, {"x": (0.01, 0.05), "y": (0.05, 0.11), "z": (0.11, 0.22)}, convex=True),
        "block": Family(shapes.block, {"width": (0.02, 0.11), "depth": (0.7, 1.0), "height": (0.7, 1.0)}, convex=True),
        "cylinder": Family(shapes.cylinder, {"radius": (0.008, 0.055), "height": (0.035, 0.22)}, convex=True),
        "disc": Family(shapes.cylinder, {"radius": (0.02, 0.1), "height": (0.008, 0.025)}, convex=True),
        "cone": Family(shapes.cone, {"radius": (0.02, 0.055), "height": (0.03, 0.16), "top": (0.2, 0.8)}, convex=True),
        "can": Family(
            shapes.can, {"radius": (0.02, 0.05), "height": (0.05, 0.15), "chamfer": (0.003, 0.006)}, convex=True
        ),
        "ramp": Family(
            shapes.ramp, {"x": (0.03, 0.11), "z": (0.02, 0.09), "y": (0.02, 0.15), "ridge": (0.2, 0.8)}, convex=True
        ),
        "superquadric": Family(
            shapes.superquadric,
            {"x": (0.012, 0.05), "y": (0.012, 0.05), "z": (0.05, 0.09), "e1": (0.3, 1.2), "e2": (0.3, 1.2)},
            convex=True,
        ),
        "blob": Family(
            shapes.blob,
            {
                "radius": (0.015, 0.045),
                "stretch": (1.0, 1.8),
                "bump": (0.04, 0.11),
                "a": (-1.0, 1.0),
                "b": (-1.0, 1.0),
                "c": (-1.0, 1.0),
                "d": (-1.0, 1.0),
            },
        ),
        "bottle": Family(
            shapes.bottle,
            {"radius": (0.015, 0.05), "height": (0.1, 0.25), "neck": (0.3, 0.5), "shoulder": (0.45, 0.75)},
        ),
        "lid": Family(
            shapes.lid,
            {"radius": (0.03, 0.1), "thickness": (0.006, 0.016), "knob": (0.15, 0.3), "knob_height": (0.012, 0.03)},
        ),
        "pipe": Family(shapes.pipe, {"radius": (0.012, 0.055), "height": (0.02, 0.18), "bore": (0.5, 0.8)}),
        "cup": Family(
            shapes.cup,
            {
                "radius": (0.025, 0.055),
                "height": (0.05, 0.13),
                "taper": (0.7, 1.0),
                "wall": (0.003, 0.005),
                "handle": (0.0035, 0.006),
            },
        ),
        "bowl": Family(shapes.bowl, {"radius": (0.045, 0.085), "depth": (0.45, 0.75), "wall": (0.004, 0.008)}),
        "plate": Family(
            shapes.plate, {"radius": (0.05, 0.12), "height": (0.015, 0.03), "foot": (0.6, 0.8), "wall": (0.003, 0.006)}
        ),
        "pan": Family(
            shapes.pan,
            {
                "radius": (0.04, 0.075),
                "height": (0.02, 0.045),
                "wall": (0.003, 0.005),
                "handle": (0.8, 1.3),
                "grip": (0.005, 0.009),
            },
        ),
        "goblet": Family(
            shapes.goblet,
            {"radius": (0.025, 0.045), "height": (0.1, 0.2), "stem": (0.35, 0.55), "wall": (0.0025, 0.0045)},
        ),
        "ring": Family(shapes.ring, {"radius": (0.02, 0.07), "tube": (0.006, 0.016)}),
        "hammer": Family(
            shapes.hammer,
            {"length": (0.14, 0.25), "handle": (0.008, 0.02), "head": (0.06, 0.12), "head_radius": (0.012, 0.025)},
        ),
        "screwdriver": Family(
            shapes.screwdriver,
            {"length": (0.12, 0.25), "handle": (0.009, 0.022), "handle_share": (0.35, 0.5), "shaft": (0.003, 0.006)},
        ),
        "spatula": Family(
            shapes.spatula,
            {"length": (0.16, 0.25), "width": (0.04, 0.1), "thickness": (0.005, 0.012), "grip": (0.005, 0.012)},
        ),
        "scissors": Family(
            shapes.scissors,
            {"length": (0.12, 0.24), "ring": (0.12, 0.17), "thickness": (0.006, 0.014), "opening": (0.1, 0.7)},
        ),
        "banana": Family(shapes.banana, {"length": (0.1, 0.22), "radius": (0.012, 0.028), "bend": (0.6, 1.8)}),
        "u_tube": Family(shapes.u_tube, {"radius": (0.007, 0.018), "span": (0.05, 0.11), "leg": (0.02, 0.12)}),
        "s_tube": Family(shapes.s_tube, {"radius": (0.007, 0.02), "length": (0.12, 0.26), "bend": (0.8, 2.2)}),
        "l_profile": Family(
            shapes.l_profile,
            {"long_leg": (0.08, 0.18), "short_leg": (0.03, 0.08), "thickness": (0.01, 0.025), "width": (0.02, 0.1)},
        ),
        "t_profile": Family(
            shapes.t_profile,
            {"bar": (0.06, 0.18), "stem": (0.04, 0.12), "thickness": (0.01, 0.03), "width": (0.02, 0.1)},
        ),
        "composite": Family(
            shapes.composite,
            {
                "x": (0.05, 0.11),
                "y": (0.03, 0.08),
                "z": (0.02, 0.06),
                "post": (0.01, 0.025),
                "rise": (0.02, 0.08),
                "bar": (0.0, 0.06),
                "turn": (-0.6, 0.6),
            },
        ),
        "drilled": Family(
            shapes.drilled, {"x": (0.03, 0.11), "y": (0.03, 0.11), "z": (0.02, 0.1), "hole": (0.3, 0.65)}
        ),
        "nut": Family(shapes.nut, {"radius": (0.02, 0.06), "height": (0.012, 0.08), "hole": (0.35, 0.65)}),
        "slotted": Family(
            shapes.slotted, {"radius": (0.015, 0.055), "height": (0.03, 0.14), "slot": (0.2, 0.5), "depth": (0.3, 0.7)}
        ),
        "channel": Family(
            shapes.channel, {"x": (0.03, 0.11), "z": (0.025, 0.09), "y": (0.03, 0.16), "wall": (0.006, 0.012)}
        ),
        "tray": Family(shapes.tray, {"x": (0.05, 0.16), "y": (0.05, 0.16), "z": (0.02, 0.06), "wall": (0.005, 0.01)}),
        "dumbbell": Family(
            shapes.dumbbell,
            {"radius": (0.018, 0.05), "length": (0.1, 0.22), "waist": (0.3, 0.6), "end": (0.18, 0.3)},
            held_out=True,
        ),
        "jack": Family(
            shapes.jack,
            {"x": (0.05, 0.16), "y": (0.05, 0.16), "z": (0.05, 0.16), "thickness": (0.012, 0.035)},
            held_out=True,
        ),
        "spray_bottle": Family(
            shapes.spray_bottle,
            {"radius": (0.025, 0.045), "height": (0.15, 0.24), "head": (1.6, 2.2), "trigger": (-0.4, 0.4)},
            held_out=True,
        ),
        "star": Family(
            shapes.star, {"radius": (0.03, 0.08), "height": (0.012, 0.06), "inner": (0.4, 0.65)}, held_out=True
        ),
    }
)
"""Every family by name, from 1 cm thin to 25 cm long, for grippers that open 6 to 12 cm.

Names that could be swapped without a change of the shape have ranges that are equal and lead, or that do not meet, so
that no shape has two descriptions.
"""

DENSITY_RANGE = (250.0, 1200.0)
"""[kg/m^3], from hollow plastic to a little above water."""
FRICTION_RANGE = (0.4, 0.9)
"""Sliding friction coefficient against the table, wood on paper to rubber."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A rigid object.

    Attributes:
        name: unique within a scene.
        family: a key of FAMILIES, or another word for a mesh of another origin.
        params: the builder's arguments.
        mesh: watertight, in metres, with the centre of mass at the origin.
        colour: (red, green, blue) in 0..255.
        density: [kg/m^3].
        friction: sliding friction coefficient.
        parts: convex meshes that together fill the object, where they are known already.
    """

    name: str
    family: str
    params: Mapping[str, float]
    mesh: trimesh.Trimesh
    colour: tuple[int, int, int]
    density: float
    friction: float
    parts: tuple[trimesh.Trimesh, ...] | None = None

    @property
    def mass(self) -> float:
        """[kg]"""
        return float(self.mesh.volume) * self.density

    @property
    def inertia(self) -> NDArray[np.float64]:
        """(3, 3) about the centre of mass [kg m^2]."""
        return np.asarray(self.mesh.moment_inertia, dtype=np.float64) * (self.density / float(self.mesh.density))

    @cached_property
    def convex_parts(self) -> tuple[trimesh.Trimesh, ...]:
        """Convex meshes that together fill the object, for physics; computed once."""
        if self.parts is not None:
            return self.parts
        family = FAMILIES.get(self.family)
        if family is not None and family.convex:
            return (self.mesh.convex_hull,)
        return convex_decomposition(self.mesh)


def build_solid(family: str, params: Mapping[str, float]) -> Solid:
    """The solid of a family at given parameters, centre of mass at the origin.

    Raises:
        InvalidInputError: the family does not exist, or the parameters are not exactly its own.
    """
    return _build(known_family(family), family, params)


def build_mesh(family: str, params: Mapping[str, float]) -> trimesh.Trimesh:
    """The mesh of `build_solid`."""
    return build_solid(family, params).mesh


def known_family(name: str, families: Mapping[str, Family] = FAMILIES) -> Family:
    """The family of that name.

    Raises:
        InvalidInputError: the family does not exist.
    """
    if name not in families:
        raise InvalidInputError(f"no object family {name!r}; there are {', '.join(families)}")
    return families[name]


def sample_object(
    rng: np.random.Generator,
    family: str | None = None,
    name: str | None = None,
    families: Mapping[str, Family] = FAMILIES,
) -> ObjectModel:
    """Draws an object.

    Args:
        rng: source of every random number.
        family: a key of `families`; drawn uniformly from those that are not held out when None.
        name: the model's name; the family's when None.
        families: the ranges to draw from.

    Raises:
        InvalidInputError: the family does not exist.
    """
    if family is None:
        family = str(rng.choice([key for key, value in families.items() if not value.held_out]))
    chosen = known_family(family, families)
    params = {key: float(rng.uniform(low, high)) for key, (low, high) in chosen.ranges.items()}
    solid = _build(chosen, family, params)
    return ObjectModel(
        name=name or family,
        family=family,
        params=params,
        mesh=solid.mesh,
        colour=sample_colour(rng),
        density=float(rng.uniform(*DENSITY_RANGE)),
        friction=float(rng.uniform(*FRICTION_RANGE)),
        parts=solid.parts,
    )


def _build(family: Family, name: str, params: Mapping[str, float]) -> Solid:
    if set(params) != set(family.ranges):
        raise InvalidInputError(f"a {name} takes the parameters {sorted(family.ranges)}, got {sorted(params)}")
    solid = family.build(**params)
    return solid.moved(*-solid.mesh.center_mass)


def sample_colour(rng: np.random.Generator) -> tuple[int, int, int]:
    """A clear colour of any hue."""
    red, green, blue = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.5, 0.95), rng.uniform(0.55, 1.0))
    return round(255 * red), round(255 * green), round(255 * blue)
