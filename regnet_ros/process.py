"""Running nodes as a process: signals, exit codes, threads."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import remove_ros_args

from regnet_core.errors import InvalidInputError
from regnet_core.memory import keep_freed_memory
from regnet_ros.node import GraspNode
from regnet_ros.spinning import NodeExecutor
from regnet_ros.transport import make_room_for_clouds

_THREADS = 8
"""Of a node: one for each callback group; idle ones cost nothing."""
Node = GraspNode[Any]
_PATIENCE = 3.0
"""How long a running computation may go on after a signal [s]; launch kills after 5 s."""


def run(make_nodes: Callable[[], Sequence[Node]], args: Sequence[str] | None = None) -> int:
    """Run nodes until SIGINT, SIGTERM or a shutdown of the context; the exit code: 0, or 2 where it cannot start."""
    keep_freed_memory()
    make_room_for_clouds()
    unknown = _own_arguments(args)
    if unknown:
        return _explain_arguments(unknown)
    # rclpy's own handlers shut the context down and call these. Python's would raise KeyboardInterrupt wherever it
    # strikes; a signal that comes before rclpy is ready is remembered.
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: stops.append(received))
    try:
        rclpy.init(args=None if args is None else list(args))
    except RCLError as error:
        return _refuse(
            f"{error}\nIn a list parameter write every number with a decimal point: [0.0, 1.0], not [0, 1.0]"
        )
    try:
        nodes = make_nodes()
    except (InvalidInputError, ParameterException) as error:
        rclpy.try_shutdown()
        return _refuse(str(error))
    if not stops:
        spin(nodes)
    deadline = time.monotonic() + _PATIENCE
    finished = all([node.wait_until_idle(max(deadline - time.monotonic(), 0.0) / 2) for node in nodes])
    for node in reversed(nodes):
        with contextlib.suppress(RCLError, InvalidHandle):
            node.destroy_node()
    rclpy.try_shutdown()
    for number in (signal.SIGINT, signal.SIGTERM):  # a second one, while Python winds up, would look like a crash
        signal.signal(number, signal.SIG_IGN)
    if not finished:  # a computation hangs on to its thread, and Python would wait for it
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def spin(nodes: Sequence[Node]) -> None:
    """Run the callbacks of nodes until their context shuts down; no exception gets out."""
    context = nodes[0].context
    executor = NodeExecutor(_THREADS * len(nodes), context=context)
    for node in nodes:
        executor.add_node(node)
    while context.ok():
        try:
            executor.spin_once()
        except ExternalShutdownException:
            break
        except InvalidHandle:  # an entity was destroyed by a cleanup while the executor looked at it
            continue
        except Exception as error:
            (executor.at_work or nodes[0]).crash(error, "in the executor")
    executor.settle(_PATIENCE / 3)
    with contextlib.suppress(RCLError, InvalidHandle):
        executor.shutdown(timeout_sec=0.0)


def _own_arguments(args: Sequence[str] | None) -> list[str]:
    """What stands on the command line outside of ``--ros-args``."""
    try:
        return remove_ros_args(sys.argv)[1:] if args is None else remove_ros_args(list(args))
    except RCLError:  # malformed ROS arguments: rclpy.init says so
        return []


def _explain_arguments(unknown: Sequence[str]) -> int:
    usage = (
        "a node takes ROS arguments only: --ros-args -p PARAMETER:=VALUE -r TOPIC:=TOPIC --params-file FILE; README.md "
        "lists the parameters"
    )
    if set(unknown) <= {"-h", "--help"}:
        print(usage)
        return 0
    return _refuse(f"unknown argument {' '.join(unknown)}; {usage}")


def _refuse(message: str) -> int:
    print(f"cannot start: {message}", file=sys.stderr)
    return 2
