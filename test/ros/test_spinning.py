"""How the callbacks of nodes are run, with nodes in the test's own process."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from action_msgs.msg import GoalStatus
from live import DEADLINE, reserved_domain, wait_for
from rclpy.action import CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.node import Node
from regnet_msgs.action import ExecuteGrasp

from regnet_ros.spinning import NodeExecutor, QuickCallbackGroup, ThreadSafeActionClient, ThreadSafeActionServer


@pytest.fixture
def node() -> Iterator[Node]:
    context = Context()
    with reserved_domain() as domain:
        rclpy.init(args=[], context=context, domain_id=domain)
        created = rclpy.create_node("spun", context=context)
        yield created
        created.destroy_node()
        rclpy.shutdown(context=context)


def executor_of(node: Node) -> NodeExecutor:
    executor = NodeExecutor(2, context=node.context)
    executor.add_node(node)
    return executor


def spun_until(executor: NodeExecutor, condition: Any) -> None:
    def turn() -> bool:
        executor.spin_once(0.05)
        return bool(condition())

    wait_for(turn, "what the callbacks do")


def test_a_quick_callback_runs_in_the_thread_that_spins_and_others_do_not(node: Node) -> None:
    threads: dict[str, threading.Thread] = {}
    node.create_timer(0.01, lambda: threads.setdefault("quick", threading.current_thread()), QuickCallbackGroup())
    node.create_timer(0.01, lambda: threads.setdefault("other", threading.current_thread()), ReentrantCallbackGroup())
    executor = executor_of(node)
    spun_until(executor, lambda: len(threads) == 2)
    assert threads["quick"] is threading.current_thread() is not threads["other"]
    executor.settle(10.0)
    executor.shutdown()


def test_a_callback_is_handed_to_a_thread_once(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[float] = []
    node.create_timer(0.02, lambda: begun.append(time.monotonic()), ReentrantCallbackGroup())
    executor, handed = executor_of(node), []
    submit = executor._pool.submit

    def slowly(work: Any) -> Any:
        """A thread that takes its time to begin."""
        handed.append(work)
        return submit(lambda: (time.sleep(0.01), work()))

    monkeypatch.setattr(executor._pool, "submit", slowly)
    spun_until(executor, lambda: len(begun) >= 5)
    executor.settle(10.0)
    assert len(handed) == len(begun)
    executor.shutdown()


def test_a_long_callback_does_not_keep_quick_ones_out(node: Node) -> None:
    gate, quick = threading.Event(), []
    node.create_timer(0.01, lambda: gate.wait(20), ReentrantCallbackGroup())
    node.create_timer(0.01, lambda: quick.append(1), QuickCallbackGroup())
    executor = executor_of(node)
    spun_until(executor, lambda: len(quick) >= 5)  # both threads are busy long before
    assert not gate.is_set() and executor._running
    gate.set()
    executor.settle(10.0)
    executor.shutdown()


@pytest.mark.parametrize("group", [QuickCallbackGroup, ReentrantCallbackGroup])
def test_what_a_callback_raises_comes_out_of_the_spinning(node: Node, group: type) -> None:
    def fail() -> None:
        raise OSError("the disk is full")

    node.create_timer(0.01, fail, group())
    executor = executor_of(node)
    with pytest.raises(OSError, match="full"):
        spun_until(executor, lambda: False)
    executor.settle(10.0)
    executor.shutdown()


class SlowHandle:
    """That of an action's client, whose requests return to the client only when their responses have been taken."""

    def __init__(self, handle: Any) -> None:
        self._handle = handle
        self._taken = {kind: threading.Event() for kind in ("goal", "cancel", "result")}

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._handle, name)
        verb, _, kind = name.partition("_")
        taken = self._taken.get(kind.partition("_")[0])
        if taken is None:
            return method

        def send(request: Any) -> Any:
            number = method(request)
            assert taken.wait(DEADLINE)
            time.sleep(0.2)  # for whoever took it to look up whose it is
            return number

        def take(kind: Any) -> Any:
            response = method(kind)
            taken.set()
            return response

        return {"send": send, "take": take}[verb]


def test_responses_that_come_before_their_requests_were_noted_are_not_lost(node: Node) -> None:
    def wait_for_cancel(goal: Any) -> Any:
        wait_for(lambda: goal.is_cancel_requested, "the request to cancel")
        goal.canceled()
        return ExecuteGrasp.Result(message="as asked")

    group = ReentrantCallbackGroup()
    server = ThreadSafeActionServer(
        node,
        ExecuteGrasp,
        "act",
        wait_for_cancel,
        callback_group=group,
        cancel_callback=lambda _: CancelResponse.ACCEPT,
    )
    client = ThreadSafeActionClient(node, ExecuteGrasp, "act", callback_group=group)
    client._client_handle = SlowHandle(client._client_handle)
    executor, ended = executor_of(node), threading.Event()

    def spin() -> None:
        while not ended.is_set():
            executor.spin_once(0.05)

    spinning = threading.Thread(target=spin)
    spinning.start()

    def answer(future: Any) -> Any:
        wait_for(future.done, "a response", 10.0)
        return future.result()

    try:
        wait_for(client.server_is_ready, "the action server")
        goal = answer(client.send_goal_async(ExecuteGrasp.Goal()))
        assert goal.accepted
        assert len(answer(goal.cancel_goal_async()).goals_canceling) == 1
        result = answer(goal.get_result_async())
        assert (result.status, result.result.message) == (GoalStatus.STATUS_CANCELED, "as asked")
    finally:
        ended.set()
        spinning.join(DEADLINE)
        executor.settle(10.0)
        client.destroy()
        server.destroy()
        executor.shutdown()
