"""Sending selected grasps to the robot by the action `execute_grasp`; when one does not work, the next."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from action_msgs.msg import GoalStatus
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from regnet_msgs.action import ExecuteGrasp
from regnet_msgs.msg import SelectedGrasp

from regnet_core.grasps import Grasps
from regnet_ros.grasp_list import GraspList
from regnet_ros.spinning import ThreadSafeActionClient

ACTION = "execute_grasp"
OUTDATED = "outdated"
"""Outcome of a grasp that was found before the objects were last moved: none of its array is worth a try."""
_PATIENCE = 10.0
"""An executor that has neither accepted nor rejected a goal after so long has lost it [s]."""
_ASK_EVERY = 2.0
"""How often an executor is asked whether it still knows the goal that it works on, at most [s]."""


class Candidates(NamedTuple):
    """The grasps to select from."""

    message: GraspList
    grasps: Grasps
    """Those of the message, in the same order."""


class Execution:
    """One execution at a time, over as many grasps of one array as are allowed."""

    def __init__(
        self,
        node: Node,
        group: CallbackGroup,
        permitted: Callable[[], bool],
        choose: Callable[[Candidates, frozenset[int]], SelectedGrasp | None],
        settled: Callable[[str], None],
        given_up: Callable[[str], None],
    ) -> None:
        """Make the client of the action.

        Args:
            node: the node that the client belongs to.
            group: callback group of the client.
            permitted: whether the robot may be moved now; whoever makes it false calls ``stop`` afterwards.
            choose: selects (and announces) a grasp, the ranks in the set left out; None when none is left.
            settled: called with a sentence when a grasp was executed.
            given_up: called with a sentence when no grasp of an array could be executed.
        """
        self._logger = node.get_logger()
        self._name = node.resolve_service_name(ACTION)
        self._client = ThreadSafeActionClient(node, ExecuteGrasp, ACTION, callback_group=group)
        self._permitted, self._choose, self._settled, self._given_up = permitted, choose, settled, given_up
        self._lock = threading.RLock()
        self._run = 0
        """Number of the execution under way; answers that belong to an earlier one are ignored."""
        self._candidates: Candidates | None = None
        self._failed: list[int] = []
        self._allowed = 0
        self._goal: Any = None
        self._sent = self._asked = 0.0

    @property
    def under_way(self) -> bool:
        """Whether a grasp is being executed. An executor that has gone, or was started again, ends its execution."""
        with self._lock:
            if self._candidates is not None:
                self._look_after()
            return self._candidates is not None

    def _look_after(self) -> None:
        """End an execution that nobody works on any more.

        A killed executor is not missed for a while, and another one may have taken its place by then: it answers, when
        asked, that it does not know the goal.
        """
        now = time.monotonic()
        if not self._client.server_is_ready():
            self._give_up(f"the action server {self._name} went away during the execution")
        elif self._goal is None and now - self._sent > _PATIENCE:
            self._give_up(f"the action server {self._name} did not answer within {_PATIENCE:g} s")
        elif self._goal is not None and now - self._asked > _ASK_EVERY:
            self._asked, goal = now, self._goal
            goal.get_result_async().add_done_callback(lambda done: self._told(goal, done.result()))

    def _told(self, goal: Any, answer: Any) -> None:
        with self._lock:
            if goal is self._goal and answer.status == GoalStatus.STATUS_UNKNOWN:
                self._give_up(f"the action server {self._name} was started again during the execution")

    def start(self, candidates: Candidates, first: SelectedGrasp, attempts: int) -> None:
        """Send ``first``; when it is rejected or fails, the next choice, over at most ``attempts`` grasps.

        Nothing is sent where that is not permitted any more: ``stop`` was called, or will be, by another thread.
        """
        with self._lock:
            if not self._permitted():
                return
            self._run += 1
            self._candidates, self._failed, self._allowed = candidates, [], attempts
            if not self._client.server_is_ready():
                self._give_up(
                    f"'execute' is true, but there is no action server {self._name}: start the robot's executor"
                )
                return
            self._send(first)

    def stop(self) -> None:
        """Cancel the execution that is under way, if any."""
        with self._lock:
            self._run += 1
            goal, self._goal, self._candidates = self._goal, None, None
        if goal is not None:
            goal.cancel_goal_async()

    def destroy(self) -> None:
        """Release the client."""
        self.stop()
        self._client.destroy()

    def _send(self, selected: SelectedGrasp) -> None:
        run, rank = self._run, int(selected.rank)
        self._goal, self._sent = None, time.monotonic()
        future = self._client.send_goal_async(ExecuteGrasp.Goal(grasp=selected))
        future.add_done_callback(lambda done: self._answered(run, rank, done.result()))

    def _answered(self, run: int, rank: int, goal: Any) -> None:
        with self._lock:
            if run != self._run:
                if goal is not None and goal.accepted:  # stopped before the answer came
                    goal.cancel_goal_async()
                return
            if goal is None or not goal.accepted:
                self._next(rank, "rejected by the executor")
                return
            self._goal, self._asked = goal, time.monotonic()
        goal.get_result_async().add_done_callback(lambda done: self._finished(run, rank, done.result()))

    def _finished(self, run: int, rank: int, answer: Any) -> None:
        with self._lock:
            if run != self._run:
                return
            if answer.status == GoalStatus.STATUS_UNKNOWN:
                self._give_up(f"the action server {self._name} was started again during the execution")
                return
            self._goal = None
            result = answer.result
            if answer.status == GoalStatus.STATUS_SUCCEEDED and result.success:
                self._candidates = None
                self._settled(f"grasp {rank} was executed: {result.message or result.outcome or 'success'}")
            elif result.outcome == OUTDATED:
                self._candidates = None
                self._settled(f"waiting for new grasps: {result.message}")
            else:
                self._next(rank, result.message or result.outcome or "the executor gave no reason")

    def _next(self, rank: int, why: str) -> None:
        assert self._candidates is not None
        self._failed.append(rank)
        tried = len(self._failed)
        self._logger.warning(f"grasp {rank} was not executed ({why}); attempt {tried} of {self._allowed}")
        if tried >= self._allowed:
            self._give_up(f"gave up after {tried} grasp(s) of this array (max_attempts), the last one: {why}")
            return
        following = self._choose(self._candidates, frozenset(self._failed))
        if following is None:
            self._give_up(f"no grasp is left after {tried} that were not executed, the last one: {why}")
            return
        self._send(following)

    def _give_up(self, why: str) -> None:
        self._run += 1
        self._candidates = self._goal = None
        self._given_up(why)
