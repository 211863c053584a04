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

from regnet_core.data import shapes
from regnet_core.data.convex import convex_decomposition
from regnet_core.errors import InvalidInputError


@dataclass(frozen=True)
class Family:
    """A kind of shape: `build(**params)` with every parameter drawn uniformly from its range.

    Attributes:
        build: builder of the mesh, from `shapes`.
        ranges: (low, high) of each parameter; lengths in metres.
        convex: the mesh is its own convex hull, so that no decomposition is needed.
    """

    build: Callable[..., trimesh.Trimesh]
    ranges: Mapping[str, tuple[float, float]]
    convex: bool = False


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "box": Family(shapes.box, {"x": (0.02, 0.065), "y": (0.03, 0.12), "z": (0.03, 0.18)}, convex=True),
        "cylinder": Family(shapes.cylinder, {"radius": (0.011, 0.033), "height": (0.04, 0.18)}, convex=True),
        "can": Family(
            shapes.can, {"radius": (0.025, 0.034), "height": (0.06, 0.14), "chamfer": (0.003, 0.006)}, convex=True
        ),
        "bottle": Family(
            shapes.bottle,
            {"radius": (0.02, 0.034), "height": (0.12, 0.24), "neck": (0.3, 0.5), "shoulder": (0.5, 0.75)},
        ),
        "cup": Family(
            shapes.cup,
            {
                "radius": (0.03, 0.045),
                "height": (0.07, 0.11),
                "taper": (0.75, 1.0),
                "wall": (0.003, 0.005),
                "handle": (0.004, 0.006),
            },
        ),
        "bowl": Family(shapes.bowl, {"radius": (0.045, 0.075), "depth": (0.45, 0.75), "wall": (0.004, 0.007)}),
        "hammer": Family(
            shapes.hammer,
            {"length": (0.16, 0.25), "handle": (0.01, 0.015), "head": (0.07, 0.11), "head_radius": (0.012, 0.018)},
        ),
        "screwdriver": Family(
            shapes.screwdriver,
            {"length": (0.14, 0.24), "handle": (0.011, 0.017), "handle_share": (0.4, 0.5), "shaft": (0.003, 0.005)},
        ),
        "banana": Family(shapes.banana, {"length": (0.13, 0.2), "radius": (0.014, 0.021), "bend": (0.8, 1.6)}),
        "ring": Family(shapes.ring, {"radius": (0.025, 0.06), "tube": (0.007, 0.014)}),
        "l_profile": Family(
            shapes.l_profile,
            {"long_leg": (0.06, 0.14), "short_leg": (0.04, 0.09), "thickness": (0.012, 0.03), "width": (0.02, 0.05)},
        ),
        "t_profile": Family(
            shapes.t_profile,
            {"bar": (0.06, 0.14), "stem": (0.04, 0.1), "thickness": (0.012, 0.03), "width": (0.02, 0.05)},
        ),
        "superquadric": Family(
            shapes.superquadric,
            {"x": (0.018, 0.033), "y": (0.02, 0.05), "z": (0.025, 0.06), "e1": (0.3, 1.2), "e2": (0.3, 1.2)},
            convex=True,
        ),
        "blob": Family(
            shapes.blob,
            {
                "radius": (0.022, 0.031),
                "stretch": (1.0, 1.8),
                "bump": (0.05, 0.16),
                "a": (-1.0, 1.0),
                "b": (-1.0, 1.0),
                "c": (-1.0, 1.0),
                "d": (-1.0, 1.0),
            },
        ),
    }
)
"""Every family by name."""

DENSITY_RANGE = (250.0, 1200.0)
"""[kg/m^3], from hollow plastic to a little above water."""
FRICTION_RANGE = (0.4, 0.9)
"""Sliding friction coefficient against the table, wood on paper to rubber."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A rigid object.

    Attributes:
        name: unique within a scene.
        family: a key of FAMILIES.
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


def build_mesh(family: str, params: Mapping[str, float]) -> trimesh.Trimesh:
    """The mesh of a family at given parameters, centre of mass at the origin.

    Raises:
        InvalidInputError: the family does not exist, or the parameters are not exactly its own.
    """
    if family not in FAMILIES:
        raise InvalidInputError(f"no object family {family!r}; there are {', '.join(FAMILIES)}")
    expected = FAMILIES[family].ranges
    if set(params) != set(expected):
        raise InvalidInputError(f"a {family} takes the parameters {sorted(expected)}, got {sorted(params)}")
    mesh = FAMILIES[family].build(**params)
    mesh.apply_translation(-mesh.center_mass)
    return mesh


def sample_object(rng: np.random.Generator, family: str | None = None, name: str | None = None) -> ObjectModel:
    """Draws an object.

    Args:
        rng: source of every random number.
        family: a key of FAMILIES; drawn uniformly when None.
        name: the model's name; the family's when None.

    Raises:
        InvalidInputError: the family does not exist.
    """
    if family is None:
        family = str(rng.choice(list(FAMILIES)))
    elif family not in FAMILIES:
        raise InvalidInputError(f"no object family {family!r}; there are {', '.join(FAMILIES)}")
    params = {key: float(rng.uniform(low, high)) for key, (low, high) in FAMILIES[family].ranges.items()}
    return ObjectModel(
        name=name or family,
        family=family,
        params=params,
        mesh=build_mesh(family, params),
        colour=_sample_colour(rng),
        density=float(rng.uniform(*DENSITY_RANGE)),
        friction=float(rng.uniform(*FRICTION_RANGE)),
    )


def _sample_colour(rng: np.random.Generator) -> tuple[int, int, int]:
    """A clear colour of any hue."""
    red, green, blue = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.5, 0.95), rng.uniform(0.55, 1.0))
    return round(255 * red), round(255 * green), round(255 * blue)
