"""Tries grasps in a simulated scene, one after another."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt

from regnet_core.checks import check_range, is_whole, shown
from regnet_core.data.scenes.scene import Scene
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.sim.config import SimConfig
from regnet_core.sim.outcome import Attempt
from regnet_core.sim.physics import HandInScene
from regnet_core.sim.transfer import Transfer, TransferConfig, TransferRecord
from regnet_core.sim.trial import Trial

_REST_SPEED = 0.003
"""Slower than this, objects are at rest, as in `data.scenes.dropping` [m/s, rad/s x 0.1 m]."""
_REST_TIME = 0.1
"""... for as long as this [s]."""
_FALLEN = 0.3
"""An object whose centre is this far below the table's top has fallen off [m]."""


class GraspSimulator:
    """A scene in which one gripper tries grasps.

    Example:
        >>> simulator = GraspSimulator(scene, Gripper(width=0.08))
        >>> simulator.attempt(grasps[0]).success

    An episode of bin picking goes on from one attempt to the next:
        >>> attempt = simulator.attempt(grasps[0], reset=False)
        >>> if attempt.success:
        ...     simulator.remove(attempt.lifted[0])
        >>> simulator.settle()
    """

    def __init__(self, scene: Scene, gripper: Gripper, config: SimConfig | None = None) -> None:
        """Builds the physics; takes some hundredths of a second.

        Args:
            scene: objects at rest; their poses, without any velocity, are the state of each fresh attempt.
            gripper: the hand that tries the grasps.
            config: constants of the physics, the motion and the judgement.
        """
        self.scene = scene
        self.gripper = gripper
        self.config = config or SimConfig()
        self._physics = HandInScene(scene, gripper, self.config)
        self._removed: set[int] = set()

    def poses(self) -> Array:
        """(K, 4, 4) T_world_object now; those of removed objects are far away."""
        return self._physics.object_poses()

    @property
    def remaining(self) -> tuple[int, ...]:
        """Indices of the objects that have not been removed."""
        return tuple(k for k in range(len(self.scene.objects)) if k not in self._removed)

    def reset(self) -> None:
        """Puts the scene back to its given poses, with all its objects."""
        self._removed.clear()
        self._physics.reset()

    def restart(self, poses: npt.ArrayLike, removed: Collection[int] = ()) -> None:
        """Puts all objects at rest at these poses; what follows depends on them alone, not on what was before.

        Args:
            poses: (K, 4, 4) T_world_object; those of removed objects do not matter.
            removed: indices of the objects that are taken out of the scene.

        Raises:
            InvalidInputError: the poses have another shape or are not finite, or there is no such object.
        """
        count, given = len(self.scene.objects), np.asarray(poses, dtype=np.float64)
        if given.shape != (count, 4, 4) or not np.isfinite(given).all():
            raise InvalidInputError(f"poses of {count} objects are finite numbers ({count}, 4, 4), got {given.shape}")
        for index in removed:
            self._check_object("removed", index, range(count))
        self._removed = {int(index) for index in removed}
        self._physics.restart(given, self._removed)

    def remove(self, index: int) -> None:
        """Takes an object out of the scene until the next reset, as when it is put down elsewhere.

        Raises:
            InvalidInputError: there is no such object, or it has been removed before.
        """
        self._check_object("index", index, self.remaining)
        self._removed.add(int(index))
        self._physics.remove(int(index))

    def settle(self, longest: float = 5.0) -> bool:
        """Takes the hand away, drops what it holds, and waits until all objects are at rest.

        Objects that fall off the table are removed.

        Args:
            longest: time after which it gives up [s].

        Returns:
            Whether they came to rest.

        Raises:
            InvalidInputError: the time is not a number of at least 0.
        """
        check_range("longest", longest, 0.0, math.inf, "s")
        self._physics.park_hand()
        still = 0.0
        for _ in range(round(longest / self.config.timestep)):
            self._physics.step_without_hand()
            at_rest = bool((self._physics.object_speeds() < _REST_SPEED).all())
            still = still + self.config.timestep if at_rest else 0.0
            if still >= _REST_TIME:
                return True
            self._remove_fallen()
        return False

    def _remove_fallen(self) -> None:
        heights = self._physics.object_heights()
        for k in np.flatnonzero(heights < self.scene.table_height - _FALLEN):
            self.remove(int(k))

    def attempt(
        self, grasp: Grasps, target: int | None = None, *, reset: bool = True, record_every: float | None = None
    ) -> Attempt:
        """Tries one grasp: the hand comes straight along the approach, closes, lifts, shakes gently and holds still.

        Args:
            grasp: a batch of one grasp in the world frame; its `width` is the opening before closing.
            target: index of the object that should be held; any object counts when None.
            reset: start from the scene's given state; otherwise go on from the current one, best after `settle`. What
                the hand holds falls when the hand is moved to the new pre-grasp.
            record_every: keep the state at these intervals for pictures [s]; nothing is kept when None.

        Raises:
            InvalidInputError: not exactly one grasp, or one that is no pose or too wide for the gripper, or no such
                target.
        """
        self._check_grasp(grasp)
        if target is not None:
            self._check_object("target", target, range(len(self.scene.objects)) if reset else self.remaining)
        if record_every is not None:
            check_range("record_every", record_every, self.config.timestep, math.inf, "s")
        if reset:
            self.reset()
        return Trial(self._physics, self.config, grasp, target, record_every).run()

    def transfer(
        self,
        grasp: Grasps,
        place: tuple[float, float],
        config: TransferConfig | None = None,
        *,
        record_every: float | None = None,
    ) -> TransferRecord:
        """Picks and places, from the current state: approach, close, lift, carry, lower, release.

        A touch before closing is told; only one against a great force ends the approach. The hand is still where it
        ended: `settle` takes it away and lets everything come to rest.

        Args:
            grasp: a batch of one grasp in the world frame; its `width` is the opening before closing.
            place: x and y in the world, where the point between the fingertips is brought to before release [m].
            config: heights, speeds and forces.
            record_every: keep the state at these intervals for pictures [s]; nothing is kept when None.

        Raises:
            InvalidInputError: not exactly one grasp, or one that is no pose or too wide for the gripper, or no such
                place.
        """
        self._check_grasp(grasp)
        target = np.asarray(place, dtype=np.float64)
        if target.shape != (2,) or not np.isfinite(target).all():
            raise InvalidInputError(f"place must be 2 finite numbers, x and y, got {place!r}")
        if record_every is not None:
            check_range("record_every", record_every, self.config.timestep, math.inf, "s")
        way = target - grasp.fingertips(self.gripper)[0, :2]
        return Transfer(self._physics, self.config, config or TransferConfig(), grasp, way, record_every).run()

    def _check_grasp(self, grasp: Grasps) -> None:
        if not isinstance(grasp, Grasps) or len(grasp) != 1:
            given = f"{len(grasp)} grasps" if isinstance(grasp, Grasps) else type(grasp).__name__
            raise InvalidInputError(f"an attempt needs Grasps with exactly one grasp, such as grasps[0], got {given}")
        R, c = grasp.rotation[0], grasp.translation[0]
        if not np.isfinite(c).all():
            raise InvalidInputError(f"the grasp's translation must be finite, got {c.tolist()}")
        if not (np.isfinite(R).all() and np.allclose(R.T @ R, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0.0):
            raise InvalidInputError(f"the grasp's rotation must be a rotation matrix, got {R.tolist()}")
        self.gripper.bodies(float(grasp.width[0]))  # refuses an opening that the gripper does not have

    def _check_object(self, name: str, index: int, there: Sequence[int]) -> None:
        if not is_whole(index) or index not in there:
            raise InvalidInputError(
                f"{name} must be the index of an object in the scene, {list(there)}, got {shown(index)}"
            )
