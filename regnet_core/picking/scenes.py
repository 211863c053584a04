"""Scenes to pick from: what objects there are, in a bin, in a pile or side by side on a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.dropping import DropConfig, drop
from regnet_core.data.scenes.scene import Scene
from regnet_core.data.scenes.settling import SceneError
from regnet_core.data.scenes.standing import pack
from regnet_core.errors import InvalidInputError
from regnet_core.picking.episode import StopRule
from regnet_core.picking.objects import ANY, EASY, HARD, UPRIGHT, ObjectSet, draw_objects
from regnet_core.picking.workcell import Workcell, bin_workcell, table_workcell

BIN, PILE, PACKED = "bin", "pile", "packed"
SCENE_WORDS: Mapping[str, tuple[str, tuple[str, ...]]] = MappingProxyType(
    {
        "easy": (BIN, (EASY,)),
        "hard": (BIN, (HARD,)),
        "mixed": (BIN, (EASY, HARD)),
        "pile": (PILE, (ANY,)),
        "packed": (PACKED, (UPRIGHT,)),
    }
)
"""What a scene's name begins with: its kind, and the classes of objects that it has in equal numbers."""
MOST_OBJECTS = 30
BIN_SCENES = ("easy-10", "hard-10", "mixed-20")
"""Those of the paper."""
VGN_SCENES = ("pile-5", "pile-10", "packed-5", "packed-10")
"""Those of VGN."""
_DROP = DropConfig(interval=0.4, penetration=0.001, looks=2)
_PILE = replace(_DROP, spread=0.1)
"""A pile is dropped onto a disc of 20 cm, as VGN drops over the middle third of its 30 cm workspace."""
_REDRAWS = 5
_RULES = MappingProxyType({BIN: StopRule(spare=5), PILE: StopRule(failures=2), PACKED: StopRule(failures=2)})
"""N + 5 attempts for N objects, as the paper has it; two failures in a row, as VGN."""


@dataclass(frozen=True)
class PickScene:
    """What is to be picked.

    Attributes:
        name: what the command and the tables call it.
        kind: BIN, PILE or PACKED.
        objects: how many of which class.
    """

    name: str
    kind: str
    objects: ObjectSet

    @property
    def workcell(self) -> Workcell:
        """Where it is picked."""
        return bin_workcell() if self.kind == BIN else table_workcell()

    @property
    def rule(self) -> StopRule:
        """When an episode ends at the latest."""
        return _RULES[self.kind]


def pick_scene(name: str) -> PickScene:
    """The scene of that name, which is a word of SCENE_WORDS and the number of objects, such as mixed-20.

    Raises:
        InvalidInputError: there is no such scene.
    """
    word, _, digits = name.partition("-")
    count = int(digits) if digits.isdecimal() else 0
    if word not in SCENE_WORDS or not 1 <= count <= MOST_OBJECTS or name != f"{word}-{count}":
        raise InvalidInputError(
            f"a scene is one of {', '.join(SCENE_WORDS)} with a number of objects from 1 to {MOST_OBJECTS}, such as "
            f"mixed-20; got {name!r}"
        )
    kind, classes = SCENE_WORDS[word]
    # What does not divide goes to the first class.
    shares = [len(range(i, count, len(classes))) for i in range(len(classes))]
    counts = tuple((one, share) for one, share in zip(classes, shares, strict=True) if share)
    return PickScene(name, kind, ObjectSet(name, counts))


@lru_cache(8)
def make_scene(name: str, seed: int, episode: int) -> Scene:
    """The scene that an episode starts with, at rest, the place bin among its fixtures.

    It does not depend on who picks it.

    Args:
        name: as `pick_scene` takes it.
        seed: of the study.
        episode: its number.

    Raises:
        InvalidInputError: there is no such scene.
        SceneError: the objects do not come to rest.
    """
    wanted = pick_scene(name)
    objects = draw_objects(wanted.objects, seed, episode)
    for redraw in range(_REDRAWS):
        rng = np.random.default_rng([seed, episode, redraw])
        order = [objects[i] for i in rng.permutation(len(objects))]
        try:
            scene = _at_rest(wanted, order, rng)
        except SceneError:
            continue
        return replace(scene, fixtures=wanted.workcell.obstacles)
    raise SceneError(f"'{name}' of seed {seed}, episode {episode}, does not come to rest; choose another seed")


def _at_rest(wanted: PickScene, objects: Sequence[ObjectModel], rng: np.random.Generator) -> Scene:
    cell = wanted.workcell
    if wanted.kind == BIN:
        scene = drop(objects, rng, table=cell.table, config=_DROP, into=cell.pick_bin)
    elif wanted.kind == PILE:
        scene = drop(objects, rng, table=cell.table, config=_PILE)
    else:
        scene = pack(objects, rng, table=cell.table)
    if not cell.to_pick(scene.poses).all():
        raise SceneError("an object lies outside of the place that is picked from")
    return scene
