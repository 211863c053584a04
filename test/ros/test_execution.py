"""The client of the action that executes grasps, without a process of its own."""

from __future__ import annotations

import pytest
import rclpy
from live import reserved_domain
from rclpy._rclpy_pybind11 import InvalidHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from regnet_ros.execution import Execution


def test_an_executor_that_meets_a_destroyed_client_is_told_that_its_handle_is_invalid() -> None:
    """Nodes pass over that one exception; any other they report as a defect."""
    context = Context()
    with reserved_domain() as domain:
        rclpy.init(args=[], context=context, domain_id=domain)
        node = rclpy.create_node("destroys_its_client", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        execution = Execution(
            node, ReentrantCallbackGroup(), lambda: True, lambda *_: None, lambda _: None, lambda _: None
        )
        execution.destroy()
        node.add_waitable(execution._client)  # as if the executor had listed it before
        with pytest.raises(InvalidHandle):
            executor.spin_once(timeout_sec=1.0)
        node.remove_waitable(execution._client)
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
