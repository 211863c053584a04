"""The kinds of scenes in a data set: a heap, one object, things standing side by side, a bin to pick from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.bins import BinConfig, sample_bin
from regnet_core.data.scenes.dropping import DropConfig, drop
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.data.scenes.settling import SceneError
from regnet_core.data.scenes.standing import PackConfig, pack
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box

SCENE_KINDS = ("pile", "single", "packed", "bin")
_COUNTS = {"pile": (5, 20), "single": (1, 1), "packed": (4, 10), "bin": (5, 15)}
"""Least and largest number of objects."""


@dataclass(frozen=True)
class KindConfig:
    """How scenes of every kind are made.

    Attributes:
        drop: how objects fall in a pile and into a bin. Shorter intervals than for the recordings in bags/: an object
            has landed, if not come to rest, when the next one follows.
        pack: how objects are put side by side.
        bin: sizes of bins.
        standing: share of single objects that stand instead of being dropped.
    """

    drop: DropConfig = DropConfig(interval=0.3, penetration=0.001, looks=2)
    pack: PackConfig = PackConfig()
    bin: BinConfig = BinConfig()
    standing: float = 0.5


def object_count(kind: str, rng: np.random.Generator) -> int:
    """Draws the number of objects: 1 single, 5 to 20 in a pile, 4 to 10 packed, 5 to 15 in a bin.

    Raises:
        InvalidInputError: there is no such kind.
    """
    _check(kind)
    low, high = _COUNTS[kind]
    return int(rng.integers(low, high + 1))


def compose_scene(
    kind: str,
    models: Sequence[ObjectModel],
    rng: np.random.Generator,
    *,
    table: Box | None = None,
    config: KindConfig = KindConfig(),
) -> Scene:
    """Brings the models to rest in a scene of a kind.

    Every centre of mass is over the table (in the bin), everything rests, and no contact is deeper than 1 mm: an
    attempt that fails in this is drawn again.

    Args:
        kind: one of SCENE_KINDS.
        models: at least one, with unique names.
        rng: source of every random number; the same state gives the same scene.
        table: the table top; `default_table()` when None.
        config: of the kinds.

    Raises:
        InvalidInputError: there is no such kind, no model, more than one in a "single" scene, or a name occurs twice.
        SceneError: no attempt came to rest; the message names the kind and the number of objects.
    """
    _check(kind)
    names = [model.name for model in models]
    if not names or len(set(names)) != len(names):
        raise InvalidInputError(f"a scene needs models with unique names, got {names}")
    if kind == "single" and len(models) != 1:
        raise InvalidInputError(f"a scene of kind 'single' takes 1 model, got {len(models)}")
    table = table or default_table()
    try:
        if kind == "packed" or (kind == "single" and rng.uniform() < config.standing):
            return pack(models, rng, table=table, config=config.pack)
        into = sample_bin(rng, table, config.bin) if kind == "bin" else None
        return drop(models, rng, table=table, config=config.drop, into=into)
    except SceneError as error:
        raise SceneError(f"scene of kind {kind!r} with {len(models)} objects: {error}") from error


def _check(kind: str) -> None:
    if kind not in SCENE_KINDS:
        raise InvalidInputError(f"no scene kind {kind!r}; there are {', '.join(SCENE_KINDS)}")
