"""Drops objects one after another on a table in MuJoCo until they rest."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from regnet_core.data.objects import ObjectModel, sample_object
from regnet_core.data.scenes import Scene, default_table
from regnet_core.errors import RegnetError
from regnet_core.geometry import Box
from regnet_core.sim.world import world_spec


class SceneError(RegnetError):
    """No scene came to rest in the allowed number of attempts."""


@dataclass(frozen=True)
class DropConfig:
    """How a scene is dropped.

    Attributes:
        spread: radius of the disc over the table's centre above which objects are released [m].
        clearance: gap between a released object and what is below it [m].
        interval: time between two releases [s].
        settle_time: longest wait for rest after the last release [s].
        rest_speed: every object is slower than this at rest [m/s, rad/s x 0.1 m].
        margin: an object's centre of mass stays this far inside the table's edge [m].
        timestep: of the physics [s].
        redrops: how often one object that leaves the table is released again.
        attempts: how often the whole scene is tried.
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
    named = [
        ObjectModel(f"{i:02d}_{m.family}", m.family, m.params, m.mesh, m.colour, m.density, m.friction)
        for i, m in enumerate(models)
    ]
    return drop(named, rng, table=table, config=config)


def drop(
    objects: Sequence[ObjectModel],
    rng: np.random.Generator,
    *,
    table: Box | None = None,
    config: DropConfig | None = None,
) -> Scene:
    """Drops the objects in their order, each at a random place and orientation.

    Raises:
        SceneError: no attempt came to rest on the table.
    """
    table = table or default_table()
    config = config or DropConfig()
    if not objects:
        return Scene((), np.zeros((0, 4, 4)), table)
    physics = _Physics(objects, table, config)
    for _ in range(config.attempts):
        if physics.attempt(rng):
            return Scene(tuple(objects), physics.poses(), table)
    raise SceneError(
        f"{len(objects)} objects did not come to rest on the table in {config.attempts} attempts; "
        "use fewer objects, a wider spread or a longer settle time"
    )


class _Physics:
    """The MuJoCo model of all objects; those not yet released are held far from the table."""

    def __init__(self, objects: Sequence[ObjectModel], table: Box, config: DropConfig) -> None:
        self.objects = objects
        self.table = table
        self.config = config
        self.model = world_spec(objects, table, (), config.timestep).compile()
        self.data = mujoco.MjData(self.model)

    def attempt(self, rng: np.random.Generator) -> bool:
        """Drops everything once; False when something left the table or never came to rest."""
        mujoco.mj_resetData(self.model, self.data)
        for k in range(len(self.objects)):
            self._park(k)
        released = 0
        for k in range(len(self.objects)):
            if not self._release_until_it_stays(k, rng):
                return False
            released = k + 1
        return self._settle(released)

    def poses(self) -> NDArray[np.float64]:
        """(K, 4, 4) T_world_object."""
        poses = np.tile(np.eye(4), (len(self.objects), 1, 1))
        q = self.data.qpos.reshape(-1, 7)
        poses[:, :3, 3] = q[:, :3]
        poses[:, :3, :3] = Rotation.from_quat(q[:, 3:], scalar_first=True).as_matrix()
        return poses

    def _release_until_it_stays(self, k: int, rng: np.random.Generator) -> bool:
        for _ in range(self.config.redrops):
            self._place_above(k, rng)
            self._step(self.config.interval, released=k + 1)
            if not self._on_table(k):
                continue
            return bool(all(self._on_table(i) for i in range(k)))
        return False

    def _place_above(self, k: int, rng: np.random.Generator) -> None:
        """Puts object k at rest above the table and above every released object that is under it."""
        rotation = Rotation.random(rng=rng)
        corners = rotation.apply(self.objects[k].mesh.vertices)
        radius = self.config.spread * np.sqrt(rng.uniform())
        angle = rng.uniform(0.0, 2.0 * np.pi)
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        reach = np.linalg.norm(corners[:, :2], axis=1).max()
        top = float(self.table.upper[2])
        for i in range(k):
            centre = self.data.qpos[7 * i : 7 * i + 3]
            extent = np.linalg.norm(self.objects[i].mesh.vertices, axis=1).max()
            if np.hypot(centre[0] - x, centre[1] - y) < reach + extent:
                top = max(top, self._highest(i))
        z = top + self.config.clearance - corners[:, 2].min()
        self.data.qpos[7 * k : 7 * k + 3] = x, y, z
        self.data.qpos[7 * k + 3 : 7 * k + 7] = rotation.as_quat(scalar_first=True)
        self.data.qvel[6 * k : 6 * k + 6] = 0.0

    def _highest(self, k: int) -> float:
        q = self.data.qpos[7 * k : 7 * k + 7]
        up = Rotation.from_quat(q[3:], scalar_first=True).as_matrix()[2]
        return float(q[2] + (self.objects[k].mesh.vertices @ up).max())

    def _park(self, k: int) -> None:
        self.data.qpos[7 * k : 7 * k + 7] = 100.0 + k, 0.0, 100.0, 1.0, 0.0, 0.0, 0.0
        self.data.qvel[6 * k : 6 * k + 6] = 0.0

    def _step(self, seconds: float, released: int) -> None:
        for _ in range(round(seconds / self.config.timestep)):
            for k in range(released, len(self.objects)):
                self._park(k)
            mujoco.mj_step(self.model, self.data)

    def _settle(self, released: int) -> bool:
        """Waits for rest; True when all objects rest on the table."""
        waited = 0.0
        while waited < self.config.settle_time:
            self._step(0.25, released)
            waited += 0.25
            velocity = self.data.qvel.reshape(-1, 6)
            linear = np.linalg.norm(velocity[:, :3], axis=1)
            angular = np.linalg.norm(velocity[:, 3:], axis=1)
            if np.all(linear < self.config.rest_speed) and np.all(0.1 * angular < self.config.rest_speed):
                return all(self._on_table(k) for k in range(released))
        return False

    def _on_table(self, k: int) -> bool:
        position = self.data.qpos[7 * k : 7 * k + 3]
        lower, upper = np.array(self.table.lower), np.array(self.table.upper)
        inside = np.all(position[:2] > lower[:2] + self.config.margin) and np.all(
            position[:2] < upper[:2] - self.config.margin
        )
        return bool(inside and upper[2] - 0.005 < position[2] < upper[2] + 1.0)
