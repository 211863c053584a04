"""Objects that stand close to each other on a table, as on a shelf."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from regnet_core.checks import check_range
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.data.scenes.settling import RestConfig, SceneError, Settling
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box, normalised

_DIRECTIONS = np.stack([np.cos(a := np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)), np.sin(a)], axis=1)
"""Directions (72, 2) along which footprints are compared; in between, a gap is at most 0.1 % wider than it seems."""
_TILTS = np.radians([2.0, 5.0])
"""What stands firmly is lifted when it is tilted by these [rad] in any direction ..."""
_LIFT = 1e-4
"""... by at least this [m]; what is round below, such as a stone, is not."""


@dataclass(frozen=True)
class PackConfig:
    """How objects are packed.

    Attributes:
        gap: least and largest distance between a footprint and the nearest one before it [m].
        tilt: an object that stands may lean by this much at rest, at most [rad].
        margin: an object's centre of mass stays this far inside the table's edge [m].
        settle_time: longest wait for rest [s].
        rest_speed: every object is slower than this at rest [m/s, rad/s x 0.1 m].
        timestep: of the physics [s].
        attempts: how often the whole scene is tried.
        penetration: a scene in which a contact is deeper than this is tried again [m].
        looks: how many times in a row objects must be found at rest.

    Raises:
        InvalidInputError: the range of gaps is empty or negative.
    """

    gap: tuple[float, float] = (0.01, 0.04)
    tilt: float = np.radians(5.0)
    margin: float = 0.12
    settle_time: float = 6.0
    rest_speed: float = 0.003
    timestep: float = 0.002
    attempts: int = 10
    penetration: float = 0.001
    looks: int = 2

    def __post_init__(self) -> None:
        check_range("PackConfig.gap", self.gap[0], 0.0)
        if self.gap[0] > self.gap[1]:
            raise InvalidInputError(f"PackConfig.gap is (least, largest), got {self.gap}")


def pack(
    objects: Sequence[ObjectModel],
    rng: np.random.Generator,
    *,
    table: Box | None = None,
    config: PackConfig = PackConfig(),
) -> Scene:
    """Puts the objects next to each other around the middle of the table, each turned about the vertical at random.

    What can stand with its own +z up does so; what would roll or fall over (a stone, an ellipsoid) lies with its
    shortest axis up.

    Raises:
        SceneError: in no attempt did everything come to rest, still standing, on the table.
    """
    table = table or default_table()
    if not objects:
        return Scene((), np.zeros((0, 4, 4)), table)
    rest = RestConfig(config.settle_time, config.rest_speed, config.timestep, config.looks)
    physics = Settling(objects, table, (), rest)
    for _ in range(config.attempts):
        if _attempt(physics, table, config, rng):
            return Scene(tuple(objects), physics.poses(), table)
    raise SceneError(
        f"{len(objects)} objects did not come to rest side by side in {config.attempts} attempts; "
        "use fewer objects or ones that stand more firmly"
    )


def stands(mesh: trimesh.Trimesh) -> bool:
    """Whether the mesh, its centre of mass at the origin, stands firmly with its +z up."""
    x, y = (np.outer(np.sin(_TILTS), axis).ravel() for axis in _DIRECTIONS[::3].T)
    down = -np.stack([x, y, np.sqrt(1.0 - x * x - y * y)], axis=1)  # (T, 3) in the mesh's frame
    height = -float(mesh.vertices[:, 2].min())  # of the centre of mass above the lowest point
    return bool((mesh.vertices @ down.T).max(axis=0).min() > height + _LIFT)


def _attempt(physics: Settling, table: Box, config: PackConfig, rng: np.random.Generator) -> bool:
    physics.reset()
    upright = np.array([stands(model.mesh) for model in physics.objects])
    rotations = [
        Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi)) * (Rotation.identity() if up else _shortest_up(model))
        for model, up in zip(physics.objects, upright, strict=True)
    ]
    corners = [turn.apply(model.mesh.vertices) for model, turn in zip(physics.objects, rotations, strict=True)]
    places = _side_by_side([_support(points) for points in corners], config.gap, rng)
    lower, upper = np.array(table.lower), np.array(table.upper)
    places += 0.5 * (lower + upper)[:2]
    for k, turn in enumerate(rotations):
        # A tenth of a millimetre above the table, so that nothing starts inside it.
        physics.place(k, turn, (*places[k], upper[2] + 1e-4 - corners[k][:, 2].min()))
    if not physics.settle():
        return False
    poses = physics.poses()
    inside = (poses[:, :2, 3] > lower[:2] + config.margin) & (poses[:, :2, 3] < upper[:2] - config.margin)
    leaning = poses[upright, 2, 2] < np.cos(config.tilt)
    on_top = bool(np.all(inside) and np.all(poses[:, 2, 3] > upper[2]))
    return on_top and not np.any(leaning) and physics.penetration() <= config.penetration


def _shortest_up(model: ObjectModel) -> Rotation:
    """Turns the shortest of the mesh's axes up."""
    shortest = int(np.argmin(np.ptp(model.mesh.vertices, axis=0)))
    return Rotation.from_euler(*(("y", -0.5 * np.pi), ("x", 0.5 * np.pi), ("z", 0.0))[shortest])


def _support(corners: Array) -> Array:
    """(72,) how far the vertices (V, 3) reach in each of the directions [m]."""
    reach: Array = (corners[:, :2] @ _DIRECTIONS.T).max(axis=0)
    return reach


def _side_by_side(supports: list[Array], gap: tuple[float, float], rng: np.random.Generator) -> Array:
    """(K, 2) places about the origin, such that footprints come as close as their gaps to one before them [m]."""
    places = np.zeros((len(supports), 2))
    for k in range(1, len(supports)):
        angle, wanted = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*gap)
        start = np.array([np.cos(angle), np.sin(angle)])
        places[k] = _slide_in(start, supports[k], places[:k], supports[:k], wanted)
    return places - 0.5 * (places.min(axis=0) + places.max(axis=0))


def _slide_in(start: Array, support: Array, places: Array, supports: list[Array], gap: float) -> Array:
    """(2,) where a footprint ends that moves from `start` towards the middle of the others until the gap is left."""
    opposite = np.roll(support, len(support) // 2)  # how far it reaches against each direction
    reach = np.stack(supports) + opposite
    position, target = start, places.mean(axis=0)
    inwards = normalised(target - start)
    while True:
        apart = ((position - places) @ _DIRECTIONS.T - reach).max(axis=1).min()
        if apart <= gap + 1e-5:
            return position
        position = position + (apart - gap) * inwards
