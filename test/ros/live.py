"""Real node processes, and a peer in the test's own process that talks to them over DDS."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import ParameterValue, SetParametersResult
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters, SetParametersAtomically
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

REPOSITORY = Path(__file__).resolve().parents[2]
DEADLINE = 30.0
"""No single thing that the tests wait for takes so long [s], even on a busy machine with nothing compiled yet."""
_DOMAINS = range(1, 100)
_TAIL = 4000
"""So many characters of a process's output are shown where a test fails."""


class TimeExpiredError(AssertionError):
    """What a test waited for did not happen."""


def wait_for(condition: Callable[[], Any], what: str, timeout: float = DEADLINE) -> Any:
    """The first true value of the condition."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(0.01)
    raise TimeExpiredError(f"{what}: not within {timeout:g} s")


@contextlib.contextmanager
def reserved_domain() -> Iterator[int]:
    """A ROS domain that no other test on this machine uses at the same time."""
    for offset in range(len(_DOMAINS)):
        number = _DOMAINS[(os.getpid() + offset) % len(_DOMAINS)]
        with open(Path(tempfile.gettempdir()) / f"regnet_test_domain_{number}.lock", "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield number
            return
    raise RuntimeError("every ROS domain for tests is in use")


class Inbox:
    """The messages of one subscription, in the order of their arrival."""

    def __init__(self) -> None:
        self._messages: list[Any] = []
        self._news = threading.Condition()

    def put(self, message: Any) -> None:
        with self._news:
            self._messages.append(message)
            self._news.notify_all()

    def clear(self) -> None:
        with self._news:
            self._messages.clear()

    def all(self) -> list[Any]:
        with self._news:
            return list(self._messages)

    def wait(
        self, accept: Callable[[Any], Any] = lambda _: True, timeout: float = DEADLINE, what: str = "message"
    ) -> Any:
        """The first message, of those received since the last ``clear``, that is accepted."""
        deadline = time.monotonic() + timeout
        seen = 0
        with self._news:
            while True:
                for message in self._messages[seen:]:
                    if accept(message):
                        return message
                seen = len(self._messages)
                left = deadline - time.monotonic()
                if left <= 0:
                    last = [str(getattr(message, "header", message))[:300] for message in self._messages[-1:]]
                    raise TimeExpiredError(f"no {what} within {timeout:g} s; {seen} others came, the last one: {last}")
                self._news.wait(left)


class NodeProcess:
    """One program of regnet_ros as a process, in a process group of its own."""

    def __init__(self, program: str, arguments: list[str], domain: int, log: Path) -> None:
        self.program, self._log = program, log
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
        with log.open("w") as stream:
            self._process = subprocess.Popen(
                [sys.executable, "-m", f"regnet_ros.{program}", *arguments],
                cwd=REPOSITORY,
                env=environment,
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """The system's number of the process."""
        return self._process.pid

    @property
    def output(self) -> str:
        return self._log.read_text()

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def wait_for_output(self, text: str) -> None:
        wait_for(lambda: text in self.output, f"'{text}' in the output of {self.program}")

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self, timeout: float = DEADLINE) -> int:
        """The exit code."""
        try:
            return self._process.wait(timeout)
        except subprocess.TimeoutExpired as error:
            raise TimeExpiredError(f"{self.program} did not end within {timeout:g} s:\n{self.output}") from error

    def kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


class Peer:
    """A ROS node of the test's own."""

    def __init__(self, domain: int) -> None:
        self._context, self._closed = Context(), False
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self.node = rclpy.create_node("test_peer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        self._clients: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        self.diagnostics = self.listen(DiagnosticArray, "/diagnostics")

    def _spin(self) -> None:
        """Run the callbacks; a test may destroy an entity while the executor looks at it."""
        while self._context.ok() and not self._closed:
            try:
                self._executor.spin_once()
            except (ShutdownException, ExternalShutdownException):
                return
            except (InvalidHandle, RCLError) as error:
                print(f"the peer goes on after: {error}", file=sys.stderr)

    def close(self) -> None:
        self._closed = True
        self._executor.shutdown()
        self._thread.join(DEADLINE)
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def listen(self, kind: type, topic: str, latched: bool = False) -> Inbox:
        inbox = Inbox()
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        self.node.create_subscription(kind, topic, inbox.put, QoSProfile(depth=50, durability=durability))
        return inbox

    def publisher(self, kind: type, topic: str, *, reliable: bool = True, subscribers: int = 1) -> Any:
        """A publisher that has found its subscribers."""
        key = f"{topic} {reliable}"
        if key not in self._publishers:
            reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
            self._publishers[key] = self.node.create_publisher(
                kind, topic, QoSProfile(depth=20, reliability=reliability)
            )
        publisher = self._publishers[key]
        wait_for(lambda: publisher.get_subscription_count() >= subscribers, f"a subscriber of {topic}")
        return publisher

    def forget_publisher(self, topic: str, *, reliable: bool) -> None:
        self.node.destroy_publisher(self._publishers.pop(f"{topic} {reliable}"))

    def reliability(self, topic: str) -> set[ReliabilityPolicy]:
        """What the subscriptions of a topic ask for."""
        return {info.qos_profile.reliability for info in self.node.get_subscriptions_info_by_topic(topic)}

    def call(self, kind: type, name: str, request: Any, timeout: float = DEADLINE) -> Any:
        """The response of a service of one of our nodes."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
            wait_for(self._clients[name].service_is_ready, f"the service {name}", timeout)
            self.introduce(wait_for(lambda: self._server_of(name), f"the node that offers {name}", timeout))
        response = _response(self._clients[name], request, timeout)
        if response is None:
            raise TimeExpiredError(f"the service {name} did not answer within {timeout:g} s")
        return response

    def introduce(self, node: str) -> None:
        """Wait until a node knows all clients and subscriptions that were made here before.

        It learns about them a moment later than this process about the node, and what it answers in between is lost.
        As it learns about them in order, it knows them all when an answer arrives at one that is newer.
        """
        client = self.node.create_client(GetState, f"/{node.strip('/')}/get_state")
        try:
            wait_for(lambda: client.service_is_ready() and _response(client, GetState.Request(), 1.0), f"node {node}")
        finally:
            self.node.destroy_client(client)

    def _server_of(self, service: str) -> str | None:
        """The node that offers a service, as far as it is known yet."""
        wanted = self.node.resolve_service_name(service)
        for name, namespace in self.node.get_node_names_and_namespaces():
            with contextlib.suppress(NodeNameNonExistentError):  # it has just gone
                offered = self.node.get_service_names_and_types_by_node(name, namespace)
                if name != self.node.get_name() and any(wanted == offer for offer, _ in offered):
                    return f"{namespace}/{name}"
        return None

    def get_parameter(self, node: str, name: str) -> Any:
        response = self.call(GetParameters, f"/{node}/get_parameters", GetParameters.Request(names=[name]))
        return parameter_value_to_python(response.values[0])

    def describe_parameter(self, node: str, name: str) -> Any:
        request = DescribeParameters.Request(names=[name])
        return self.call(DescribeParameters, f"/{node}/describe_parameters", request).descriptors[0]

    def set_parameter(self, node: str, name: str, value: Any) -> SetParametersResult:
        request = SetParameters.Request(parameters=[_parameter(name, value)])
        return self.call(SetParameters, f"/{node}/set_parameters", request).results[0]

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> SetParametersResult:
        """All at once or none."""
        request = SetParametersAtomically.Request(parameters=[_parameter(n, v) for n, v in values.items()])
        return self.call(SetParametersAtomically, f"/{node}/set_parameters_atomically", request).result

    def state(self, node: str) -> str:
        """The lifecycle state, asked for until there is an answer: a node that was just started may lose the first."""
        name = f"/{node}/get_state"
        client = self._clients.get(name) or self.node.create_client(GetState, name)
        self._clients[name] = client
        answer = wait_for(lambda: client.service_is_ready() and _response(client, GetState.Request(), 1.0), name)
        return str(answer.current_state.label)

    def change_state(self, node: str, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.call(ChangeState, f"/{node}/change_state", request).success)

    def wait_for_state(self, node: str, label: str) -> None:
        wait_for(lambda: self.state(node) == label, f"{node} in the state {label}")

    def wait_for_status(
        self, node: str, accept: Callable[[DiagnosticStatus], bool] = lambda _: True, timeout: float = DEADLINE
    ) -> DiagnosticStatus:
        """The first status of a node, since the diagnostics were cleared, that is accepted."""

        def matching(array: DiagnosticArray) -> bool:
            return any(status.name == f"/{node}" and accept(status) for status in array.status)

        array = self.diagnostics.wait(matching, timeout, f"such status of {node}")
        return next(status for status in array.status if status.name == f"/{node}" and accept(status))


class System:
    """The processes of one test module and the peer that talks to them."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.domain, self._folder = domain, folder
        self._processes: list[NodeProcess] = []
        self.peer = Peer(domain)

    def start(self, program: str, *arguments: str) -> NodeProcess:
        log = self._folder / f"{len(self._processes)}_{program}.log"
        process = NodeProcess(program, list(arguments), self.domain, log)
        self._processes.append(process)
        return process

    def start_node(self, program: str, *, remap: Mapping[str, str] | None = None, **parameters: Any) -> NodeProcess:
        """Start a node and wait until it is active."""
        process = self.start(program, "--ros-args", *ros_arguments(remap or {}, parameters))
        try:
            self.peer.wait_for_state(program, "active")
            self.peer.introduce(program)  # clients that were made for one that has gone
        except TimeExpiredError as error:
            raise TimeExpiredError(f"{error}\n{process.output}") from error
        return process

    def outputs(self) -> dict[str, str]:
        """The end of what each process wrote until now, by its number and program."""
        return {f"{i} {p.program}": p.output[-_TAIL:] for i, p in enumerate(self._processes)}

    def close(self) -> None:
        for process in self._processes:
            process.kill()
        self.peer.close()


def ros_arguments(remap: Mapping[str, str], parameters: Mapping[str, Any]) -> list[str]:
    """The command-line form of renamings and parameter values."""
    words = [word for old, new in remap.items() for word in ("-r", f"{old}:={new}")]
    for name, value in parameters.items():
        text = (
            str(value).lower() if isinstance(value, bool) else str(list(value) if isinstance(value, tuple) else value)
        )
        words += ["-p", f"{name}:={text}"]
    return words


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """The key-value pairs of a status."""
    return {pair.key: pair.value for pair in status.values}


def _response(client: Any, request: Any, timeout: float) -> Any:
    """What a service answers; None where it does not within the time [s]."""
    done = threading.Event()
    future = client.call_async(request)
    future.add_done_callback(lambda _: done.set())
    return future.result() if done.wait(timeout) else None


def _parameter(name: str, value: Any) -> Any:
    if isinstance(value, ParameterValue):
        from rcl_interfaces.msg import Parameter as ParameterMessage

        return ParameterMessage(name=name, value=value)
    return Parameter(name, value=value).to_parameter_msg()
