"""Running the callbacks of nodes: the quick ones at once, the others in threads."""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.context import Context
from rclpy.executors import Executor, ShutdownException, TimeoutException
from rclpy.node import Node

_PATIENCE = 0.05
"""Longest time to wait for a thread to begin with a callback [s]: every one of them may be busy."""


class QuickCallbackGroup(MutuallyExclusiveCallbackGroup):
    """Callbacks that leave their work to others: they are called by the thread that spins."""


class _Destroyable:
    """Of an action's client or server, which may be destroyed while another thread spins its node.

    An executor that had already listed it asks it to join its wait. rclpy's own say then that a pointer is invalid,
    which nobody can tell from a defect (https://github.com/ros2/rclpy/issues/1284); subscriptions, services and events
    raise what these raise.
    """

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Join what an executor waits for (rclpy's method).

        Raises:
            InvalidHandle: it has been destroyed.
        """
        with self:  # type: ignore[attr-defined]
            super().add_to_wait_set(wait_set)  # type: ignore[misc]


class ThreadSafeActionClient(_Destroyable, ActionClient):
    """rclpy's client of an action, for requests from other threads than the one that spins.

    rclpy's own sends a request before it notes that it did so. A response that another thread takes between the two is
    thrown away as "unexpected", and the future never ends (https://github.com/ros2/rclpy/issues/1123). Here what was
    taken is looked at only when no request is on its way from the one step to the other.
    """

    def __init__(self, node: Node, action: type, name: str, *, callback_group: CallbackGroup | None = None) -> None:
        """Args:
        node: the node that the client belongs to.
        action: type of the action.
        name: of the action.
        callback_group: of the client; None for the node's own.
        """
        self._noting = threading.Lock()
        super().__init__(node, action, name, callback_group=callback_group)

    def send_goal_async(self, *args: Any, **kwargs: Any) -> Any:
        """The future handle of a goal (rclpy's method)."""
        with self._noting:
            return super().send_goal_async(*args, **kwargs)

    def _cancel_goal_async(self, goal_handle: Any) -> Any:
        with self._noting:
            return super()._cancel_goal_async(goal_handle)

    def _get_result_async(self, goal_handle: Any) -> Any:
        with self._noting:
            return super()._get_result_async(goal_handle)

    def take_data(self) -> Any:
        """What has come for the client (rclpy's method)."""
        taken = super().take_data()
        with self._noting:
            return taken


class ThreadSafeActionServer(_Destroyable, ActionServer):
    """rclpy's server of an action."""


class NodeExecutor(Executor):
    """Quick callbacks run in the thread that spins, the others in a pool.

    rclpy's own executor with threads hands out a callback again and again until a thread has begun with it, which takes
    a core some milliseconds for every message as only one thread at a time can run Python.
    """

    def __init__(self, threads: int, *, context: Context | None = None) -> None:
        """Args:
        threads: so many callbacks that are not quick can run at a time.
        context: that of the nodes.
        """
        super().__init__(context=context)
        self._pool = ThreadPoolExecutor(threads)
        self._running: dict[Future[None], Any] = {}
        """What was handed over, and the nodes that it belongs to."""
        self.at_work: Any = None
        """The node whose callback was called last, or raised what ``spin_once`` raises."""

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for a callback and call it (rclpy's method).

        Raises:
            Exception: what a quick callback raised, or one that ended in a thread meanwhile.
        """
        try:
            ready: tuple[Any, Any, Any] = self.wait_for_ready_callbacks(timeout_sec)
        except (ShutdownException, TimeoutException):
            return
        task, entity, self.at_work = ready
        if entity is not None and isinstance(entity.callback_group, QuickCallbackGroup):
            task()
            task.result()
        else:
            self._hand_over(task, self.at_work)
        for future in [future for future in self._running if future.done()]:
            self.at_work = self._running.pop(future)
            future.result()

    def spin_once_until_future_complete(self, future: Any, timeout_sec: Any = None) -> None:
        """Wait for a callback or for the future (rclpy's method)."""
        future.add_done_callback(lambda _: self.wake())
        self.spin_once(timeout_sec)

    def settle(self, patience: float) -> None:
        """Let callbacks that were handed to a thread end, at most for so long [s]: a shutdown would break them."""
        for future in wait(self._running, patience).done:
            future.exception()
        self._running.clear()

    def _hand_over(self, task: Any, node: Any) -> None:
        begun = threading.Event()

        def run() -> None:
            begun.set()
            task()
            task.result()

        self._running[self._pool.submit(run)] = node
        begun.wait(_PATIENCE)
