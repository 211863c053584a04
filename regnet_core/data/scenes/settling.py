"""Objects that are put into the world one after another, in MuJoCo, until they rest."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from regnet_core.data.objects.models import ObjectModel
from regnet_core.errors import RegnetError
from regnet_core.geometry import Array, Box
from regnet_core.sim.world import world_spec

_CHECK = 0.25
"""Time between two looks at whether everything rests [s]."""


class SceneError(RegnetError):
    """No scene came to rest in the allowed number of attempts."""


@dataclass(frozen=True)
class RestConfig:
    """When objects rest.

    Attributes:
        settle_time: longest wait for rest [s].
        rest_speed: every object is slower than this at rest [m/s, rad/s x 0.1 m].
        timestep: of the physics [s].
        looks: how many times in a row, 0.25 s apart, they must be found at rest; more than one tells rest from the
            turning point of something that rocks.
    """

    settle_time: float = 6.0
    rest_speed: float = 0.003
    timestep: float = 0.002
    looks: int = 1


class Settling:
    """The MuJoCo model of K objects. The first few are in the world; the others are held far from it, untouched.

    Attributes:
        objects: K models.
        released: how many objects are in the world.
    """

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        table: Box,
        fixtures: Sequence[Box] = (),
        config: RestConfig = RestConfig(),
    ) -> None:
        """Args: the models, the table top, other static boxes, and when objects rest."""
        self.objects = objects
        self.released = 0
        self._config = config
        self._model = world_spec(objects, table, fixtures, config.timestep).compile()
        self._data = mujoco.MjData(self._model)
        self._parked = np.zeros((len(objects), 7))
        self._parked[:, :4] = [100.0, 0.0, 100.0, 1.0]
        self._parked[:, 0] += np.arange(len(objects))
        self.reset()

    def reset(self) -> None:
        """Takes every object out of the world."""
        mujoco.mj_resetData(self._model, self._data)
        self.released = 0
        self._park()

    def place(self, k: int, rotation: Rotation, position: Sequence[float]) -> None:
        """Puts object k at rest at a pose; k is the next one, or one that is in the world already."""
        self.released = max(self.released, k + 1)
        self._data.qpos[7 * k : 7 * k + 3] = position
        self._data.qpos[7 * k + 3 : 7 * k + 7] = rotation.as_quat(scalar_first=True)
        self._data.qvel[6 * k : 6 * k + 6] = 0.0

    def step(self, seconds: float) -> None:
        """Lets time pass."""
        for _ in range(round(seconds / self._config.timestep)):
            self._park()
            mujoco.mj_step(self._model, self._data)

    def settle(self) -> bool:
        """Waits for rest; False when it does not come in time."""
        waited, found = 0.0, 0
        while waited < self._config.settle_time:
            self.step(_CHECK)
            waited += _CHECK
            found = found + 1 if self._at_rest() else 0
            if found == self._config.looks:
                return True
        return False

    def position(self, k: int) -> Array:
        """(3,) centre of mass of object k [m]."""
        return np.array(self._data.qpos[7 * k : 7 * k + 3])

    def poses(self) -> Array:
        """(K, 4, 4) T_world_object."""
        poses = np.tile(np.eye(4), (len(self.objects), 1, 1))
        q = self._data.qpos.reshape(-1, 7)
        poses[:, :3, 3] = q[:, :3]
        poses[:, :3, :3] = Rotation.from_quat(q[:, 3:], scalar_first=True).as_matrix()
        return poses

    def highest(self, k: int) -> float:
        """Height of the topmost point of object k [m]."""
        q = self._data.qpos[7 * k : 7 * k + 7]
        up = Rotation.from_quat(q[3:], scalar_first=True).as_matrix()[2]
        return float(q[2] + (self.objects[k].mesh.vertices @ up).max())

    def penetration(self) -> float:
        """How far the deepest contact penetrates [m]; 0 without contacts."""
        mujoco.mj_forward(self._model, self._data)
        distances: NDArray[np.float64] = self._data.contact.dist
        return max(0.0, -float(distances.min())) if distances.size else 0.0

    def _at_rest(self) -> bool:
        velocity = self._data.qvel.reshape(-1, 6)
        linear = np.linalg.norm(velocity[:, :3], axis=1)
        angular = np.linalg.norm(velocity[:, 3:], axis=1)
        speed = self._config.rest_speed
        return bool(np.all(linear < speed) and np.all(0.1 * angular < speed))

    def _park(self) -> None:
        k = self.released
        self._data.qpos[7 * k :] = self._parked[k:].ravel()
        self._data.qvel[6 * k :] = 0.0
