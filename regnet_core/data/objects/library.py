"""The object library of a data set: what train, val and test are made of, kept apart by the families' parameters.

The rule. Let u1 and u2 be the first two parameters of a family, which set its size, each scaled to 0..1 over its range.
The fractional part of u1 + u2 decides: the split `train` owns [0, 0.5], `val` [0.65, 0.73] and `test` [0.77, 0.85], as
an interval of a circle on which 1 is 0 again. So

    |u1 - v1| + |u2 - v2| >= 0.15

between every object (u1, u2) that can be in val or test and every object (v1, v2) of its family that can be in train,
and 0.04 between val and test, whatever the seeds and counts are; yet in every split each parameter alone covers its
whole range, so that all splits hold objects for all widths of the gripper. Families that are held out occur only in
test, with all their parameters.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from regnet_core.data.objects.models import (
    DENSITY_RANGE,
    FAMILIES,
    FRICTION_RANGE,
    ObjectModel,
    build_solid,
    known_family,
    sample_colour,
)
from regnet_core.errors import InvalidInputError

SPLITS = ("train", "val", "test")
BANDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"train": (0.0, 0.5), "val": (0.65, 0.73), "test": (0.77, 0.85)}
)
"""What each split owns of the fractional part of u1 + u2."""
TRAIN_GAP = 0.15
"""|u1 - v1| + |u2 - v2| between any object of train and any of val or test of the same family is at least this."""
DEFAULT_COUNTS: Mapping[str, int] = MappingProxyType({"train": 200, "val": 50, "test": 50})
"""Default number of objects of each split."""
HEAVIEST = 1.5
"""[kg]; a larger object is less dense, as if it were hollow."""


@dataclass(frozen=True)
class ObjectSpec:
    """All that it takes to build an object.

    Attributes:
        name: unique in its split and across splits, such as `train_0007_bottle`.
        family: a key of FAMILIES.
        params: (name, value) of each of the builder's arguments.
        colour: (red, green, blue) in 0..255.
        density: highest density [kg/m^3]; `build_object` lowers it to keep to HEAVIEST.
        friction: sliding friction coefficient.
    """

    name: str
    family: str
    params: tuple[tuple[str, float], ...]
    colour: tuple[int, int, int]
    density: float
    friction: float

    def to_json(self) -> str:
        """The object as one line of JSON, its params as an object."""
        return json.dumps({**asdict(self), "params": dict(self.params)})

    @classmethod
    def from_json(cls, text: str) -> "ObjectSpec":
        """Reads what `to_json` wrote.

        Raises:
            InvalidInputError: the text is not such a line.
        """
        try:
            entries: dict[str, Any] = json.loads(text)
            red, green, blue = (int(channel) for channel in entries.pop("colour"))
            params = tuple((str(key), float(value)) for key, value in entries.pop("params").items())
            return cls(**entries, params=params, colour=(red, green, blue))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(
                f"an object is a line that ObjectSpec.to_json wrote, got {text[:80]!r}: {error}"
            ) from error


def library_specs(split: str, count: int | None = None, seed: int = 0) -> tuple[ObjectSpec, ...]:
    """The objects of a split.

    The families take turns in an order that is shuffled each round, so their numbers differ by one at most. A longer
    library starts with the shorter one of the same seed.

    Args:
        split: one of SPLITS.
        count: number of objects; the split's entry of DEFAULT_COUNTS when None.
        seed: of everything that is drawn.

    Raises:
        InvalidInputError: the split does not exist, or the count is negative.
    """
    if split not in SPLITS:
        raise InvalidInputError(f"no split {split!r} of the object library; there are {', '.join(SPLITS)}")
    count = DEFAULT_COUNTS[split] if count is None else count
    if count < 0:
        raise InvalidInputError(f"the number of objects of a library is 0 or more, got {count}")
    names = split_families(split)
    return tuple(_draw(split, i, _turn(split, i // len(names), seed)[i % len(names)], seed) for i in range(count))


def split_families(split: str) -> tuple[str, ...]:
    """The families of a split: all for test, and those that are not held out for train and val."""
    return tuple(name for name, family in FAMILIES.items() if split == "test" or not family.held_out)


def build_object(spec: ObjectSpec) -> ObjectModel:
    """The object's mesh and convex parts.

    Raises:
        InvalidInputError: the family does not exist, or the parameters are not its own.
    """
    params = dict(spec.params)
    solid = build_solid(spec.family, params)
    density = min(spec.density, HEAVIEST / float(solid.mesh.volume))
    return ObjectModel(
        spec.name, spec.family, params, solid.mesh, spec.colour, density, spec.friction, parts=solid.parts
    )


def normalised(family: str, params: Mapping[str, float]) -> dict[str, float]:
    """The parameters scaled to 0..1 over the family's ranges.

    Raises:
        InvalidInputError: the family does not exist.
    """
    ranges = known_family(family).ranges
    return {key: (value - ranges[key][0]) / (ranges[key][1] - ranges[key][0]) for key, value in params.items()}


def _turn(split: str, turn: int, seed: int) -> tuple[str, ...]:
    """The order of the families in a round."""
    names = split_families(split)
    return tuple(names[k] for k in _rng(seed, split, 0, turn).permutation(len(names)))


def _draw(split: str, index: int, family: str, seed: int) -> ObjectSpec:
    rng = _rng(seed, split, 1, index)
    ranges = FAMILIES[family].ranges
    shares = _shares(rng, len(ranges), None if FAMILIES[family].held_out else BANDS[split])
    params = tuple(
        (key, low + (high - low) * float(share))
        for (key, (low, high)), share in zip(ranges.items(), shares, strict=True)
    )
    return ObjectSpec(
        name=f"{split}_{index:04d}_{family}",
        family=family,
        params=params,
        colour=sample_colour(rng),
        density=float(rng.uniform(*DENSITY_RANGE)),
        friction=float(rng.uniform(*FRICTION_RANGE)),
    )


def _shares(rng: np.random.Generator, count: int, band: tuple[float, float] | None) -> np.ndarray:
    """(count,) normalised parameters, drawn uniformly from those that the band allows; from all when it is None."""
    while True:
        shares = rng.uniform(size=count)
        if band is None or band[0] <= np.mod(shares[0] + shares[1], 1.0) <= band[1]:
            return shares


def _rng(seed: int, split: str, purpose: int, index: int) -> np.random.Generator:
    """A source of its own for every round (purpose 0) and object (purpose 1)."""
    return np.random.default_rng([seed, SPLITS.index(split), purpose, index])
