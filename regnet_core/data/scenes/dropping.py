"""Drops objects one after another on a table, or into a bin on it, until they rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from regnet_core.data.objects.models import ObjectModel, sample_object
from regnet_core.data.scenes.bins import Bin
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.data.scenes.settling import RestConfig, SceneError, Settling
from regnet_core.geometry import Array, Box

__all__ = ["DropConfig", "SceneError", "drop", "make_scene"]


@dataclass(frozen=True)
class DropConfig:
    """How a scene is dropped.

    Attributes:
        spread: radius of the disc over the table's centre above which objects are released [m]; a bin is filled over
            its whole width instead.
        clearance: gap between a released object and what is below it [m].
        interval: time between two releases [s].
        settle_time: longest wait for rest after the last release [s].
        rest_speed: every object is slower than this at rest [m/s, rad/s x 0.1 m].
        margin: an object's centre of mass stays this far inside the table's edge [m].
        timestep: of the physics [s].
        redrops: how often one object that leaves the table is released again.
        attempts: how often the whole scene is tried.
        penetration: a scene in which a contact is deeper than this is tried again [m].
        looks: how many times in a row objects must be found at rest.
    """

    spread: float = 0.16
    clearance: float = 0.02
    interval: float = 0.5
    settle_time: float = 6.0
    rest_speed: float = 0.003
    margin: float = 0.12
    timestep: float = 0.002
    redrops: int = 5
    attempts: int = 10
    penetration: float = np.inf
    looks: int = 1


def make_scene(
    count: int,
    rng: np.random.Generator,
    *,
    families: Sequence[str] | None = None,
    table: Box | None = None,
    config: DropConfig | None = None,
) -> Scene:
    """Draws `count` objects and drops them.

    Args:
        count: number of objects, 0 for an empty table.
        rng: source of every random number; the same state gives the same scene.
        families: one family per object; drawn when None.
        table: the table top; `default_table()` when None.

    Raises:
        SceneError: no attempt came to rest on the table.
    """
    chosen = [None] * count if families is None else list(families)
    models = [sample_object(rng, family) for family in chosen]
    named = [replace(model, name=f"{i:02d}_{model.family}") for i, model in enumerate(models)]
    return drop(named, rng, table=table, config=config)


def drop(
    objects: Sequence[ObjectModel],
    rng: np.random.Generator,
    *,
    table: Box | None = None,
    config: DropConfig | None = None,
    into: Bin | None = None,
) -> Scene:
    """Drops the objects in their order, each at a random place and orientation.

    Args:
        objects: K models.
        rng: source of every random number; the same state gives the same scene.
        table: the table top; `default_table()` when None.
        config: heights, times and attempts.
        into: a bin on the table, in which every centre of mass must come to rest; its boxes become the scene's
            fixtures.

    Raises:
        SceneError: no attempt came to rest on the table, or in the bin.
    """
    table = table or default_table()
    config = config or DropConfig()
    fixtures = () if into is None else into.boxes
    if not objects:
        return Scene((), np.zeros((0, 4, 4)), table, fixtures)
    target = _Table(table, config) if into is None else _InsideBin(into)
    rest = RestConfig(config.settle_time, config.rest_speed, config.timestep, config.looks)
    physics = Settling(objects, table, fixtures, rest)
    for _ in range(config.attempts):
        if _attempt(physics, target, config, rng):
            return Scene(tuple(objects), physics.poses(), table, fixtures)
    raise SceneError(
        f"{len(objects)} objects did not come to rest {target.name} in {config.attempts} attempts; "
        "use fewer objects, a wider spread or a longer settle time"
    )


class _Table:
    """Where objects are released above a table, and where they may end."""

    name = "on the table"

    def __init__(self, table: Box, config: DropConfig) -> None:
        self._lower, self._upper = np.array(table.lower), np.array(table.upper)
        self._spread = config.spread
        self._margin = config.margin

    def release(self, corners: Array, rng: np.random.Generator) -> tuple[float, float, float]:
        """x and y of an object whose vertices, (V, 3) about its centre, are `corners`; height of what is below [m]."""
        radius = self._spread * np.sqrt(rng.uniform())
        angle = rng.uniform(0.0, 2.0 * np.pi)
        x, y = 0.5 * (self._lower + self._upper)[:2]
        return x + radius * np.cos(angle), y + radius * np.sin(angle), float(self._upper[2])

    def holds(self, centre: Array) -> bool:
        """Whether a centre of mass (3,) is where it may be."""
        inside = np.all(centre[:2] > self._lower[:2] + self._margin)
        inside &= np.all(centre[:2] < self._upper[:2] - self._margin)
        return bool(inside and self._upper[2] - 0.005 < centre[2] < self._upper[2] + 1.0)


class _InsideBin:
    """Where objects are released above a bin, and where they may end."""

    name = "in the bin"

    def __init__(self, into: Bin) -> None:
        self._lower, self._upper = np.array(into.inside.lower), np.array(into.inside.upper)

    def release(self, corners: Array, rng: np.random.Generator) -> tuple[float, float, float]:
        """As a table's; what is too large to fit between the walls is released above their rim."""
        low = self._lower[:2] - corners[:, :2].min(axis=0)
        high = self._upper[:2] - corners[:, :2].max(axis=0)
        middle = 0.5 * (low + high)
        x, y = rng.uniform(np.minimum(low, middle), np.maximum(high, middle))
        fits = bool(np.all(low < high))
        return float(x), float(y), float(self._lower[2] if fits else self._upper[2])

    def holds(self, centre: Array) -> bool:
        """Whether a centre of mass (3,) is between the walls; a heap may rise above their rim."""
        between = np.all(centre[:2] > self._lower[:2]) and np.all(centre[:2] < self._upper[:2])
        return bool(between and self._lower[2] - 0.005 < centre[2] < self._upper[2] + 0.1)


def _attempt(physics: Settling, target: _Table | _InsideBin, config: DropConfig, rng: np.random.Generator) -> bool:
    """Drops everything once; False when something left the target, never came to rest or is stuck in something."""
    physics.reset()
    for k in range(len(physics.objects)):
        if not _release_until_it_stays(physics, k, target, config, rng):
            return False
    if not physics.settle():
        return False
    stays = all(target.holds(physics.position(k)) for k in range(len(physics.objects)))
    return stays and (np.isinf(config.penetration) or physics.penetration() <= config.penetration)


def _release_until_it_stays(
    physics: Settling, k: int, target: _Table | _InsideBin, config: DropConfig, rng: np.random.Generator
) -> bool:
    for _ in range(config.redrops):
        _place_above(physics, k, target, config.clearance, rng)
        physics.step(config.interval)
        if target.holds(physics.position(k)):
            return all(target.holds(physics.position(i)) for i in range(k))
    return False


def _place_above(
    physics: Settling, k: int, target: _Table | _InsideBin, clearance: float, rng: np.random.Generator
) -> None:
    """Puts object k at rest above the ground and above every released object that is under it."""
    rotation = Rotation.random(rng=rng)
    corners = rotation.apply(physics.objects[k].mesh.vertices)
    x, y, top = target.release(corners, rng)
    reach = np.linalg.norm(corners[:, :2], axis=1).max()
    for i in range(k):
        centre = physics.position(i)
        extent = np.linalg.norm(physics.objects[i].mesh.vertices, axis=1).max()
        if np.hypot(centre[0] - x, centre[1] - y) < reach + extent:
            top = max(top, physics.highest(i))
    physics.place(k, rotation, (x, y, top + clearance - corners[:, 2].min()))
