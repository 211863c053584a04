"""An episode: look, plan, pick, place, judge; again and again, until all is gone or the attempts are used up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from regnet_core.checks import is_whole
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array
from regnet_core.picking.observation import DepthCamera
from regnet_core.picking.planner import GraspPlanner, Plan
from regnet_core.picking.robot import PickAttempt, PickRobot
from regnet_core.picking.snapshot import Snapshot
from regnet_core.picking.workcell import Workcell

EMPTY, USED_UP, GIVEN_UP, NO_GRASP = "nothing left", "attempts used up", "failures in a row", "no grasp found"
"""Why an episode ended."""


@dataclass(frozen=True)
class StopRule:
    """When an episode ends although there is something left and a grasp of it is found.

    Attributes:
        spare: after so many attempts more than there were objects; None: never.
        failures: after so many failures in a row; None: never.

    Raises:
        InvalidInputError: a number is not a whole one that makes sense, or both are None.
    """

    spare: int | None = None
    failures: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("spare", 0), ("failures", 1)):
            value = getattr(self, name)
            if value is not None and (not is_whole(value) or value < least):
                raise InvalidInputError(f"{name} must be None or a whole number of at least {least}, got {value!r}")
        if self.spare is None and self.failures is None:
            raise InvalidInputError("an episode without spare attempts or a number of failures may never end")

    def reason(self, objects: int, successes: Sequence[bool]) -> str | None:
        """Why it is over after these attempts on so many objects; None: it is not."""
        if self.spare is not None and len(successes) >= objects + self.spare:
            return USED_UP
        if self.failures is not None and len(successes) >= self.failures and not any(successes[-self.failures :]):
            return GIVEN_UP
        return None


@dataclass(frozen=True, eq=False)
class Step:
    """One attempt of an episode."""

    before: Snapshot
    """Where the objects were."""
    plan: Plan
    """The grasp that was tried."""
    attempt: PickAttempt
    """What came of it."""


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """All attempts of an episode."""

    objects: int
    """N, at the beginning."""
    steps: tuple[Step, ...]
    end: str
    """Why it ended: EMPTY, USED_UP, GIVEN_UP or NO_GRASP."""
    reason: str
    """Why no grasp was found, in a sentence; empty where it ended otherwise."""
    after: Snapshot
    """Where the objects are at the end."""


class Episode:
    """Picks until it is over."""

    def __init__(
        self,
        robot: PickRobot,
        cell: Workcell,
        camera: DepthCamera,
        planner: GraspPlanner,
        looks: int,
        rule: StopRule,
    ) -> None:
        """Args:
        robot: tries grasps.
        cell: says what is still to be picked.
        camera: looks at the scene before each attempt.
        planner: chooses a grasp.
        looks: clouds in a row that must give no grasp before there is none.
        rule: when the episode ends at the latest.
        """
        self._robot = robot
        self._cell = cell
        self._camera = camera
        self._planner = planner
        self._looks = looks
        self._rule = rule

    def run(self, rng: np.random.Generator) -> EpisodeResult:
        """The whole episode; the generator makes the camera's noise."""
        count = len(self._robot.scene.objects)
        state, steps = Snapshot.of(self._robot.scene.poses), list[Step]()
        while True:
            poses = state.poses()
            end = self._over(count, poses, steps)
            plan = None if end else self._look(poses, rng)
            if plan is None or len(plan.grasp) == 0:
                reason = "" if plan is None else plan.reason
                return EpisodeResult(count, tuple(steps), end or NO_GRASP, reason, state)
            attempt = self._robot.try_grasp(state, plan.grasp)
            self._planner.learn(plan.grasp, attempt.verdict.success)
            steps.append(Step(state, plan, attempt))
            state = attempt.after

    def _over(self, count: int, poses: Array, steps: Sequence[Step]) -> str | None:
        if not self._cell.to_pick(poses).any():
            return EMPTY
        return self._rule.reason(count, [step.attempt.verdict.success for step in steps])

    def _look(self, poses: Array, rng: np.random.Generator) -> Plan:
        """The plan from the first cloud that gives a grasp, or from the last cloud."""
        for _ in range(self._looks - 1):
            plan = self._planner.plan(self._camera.look(self._robot.scene, poses, rng))
            if len(plan.grasp):
                return plan
        return self._planner.plan(self._camera.look(self._robot.scene, poses, rng))
