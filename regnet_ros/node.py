"""The base of the nodes: lifecycle with autostart, parameters, diagnostics, work on the newest input."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Generic, ParamSpec

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from regnet_core.errors import RegnetError
from regnet_core.report import StepReport
from regnet_ros.health import Health
from regnet_ros.inputs import OUTPUT_QOS, SensorInput
from regnet_ros.parameters import ParameterStore, Table
from regnet_ros.spinning import QuickCallbackGroup
from regnet_ros.workers import Places, Workers

_DIAGNOSTICS_PERIOD = 1.0
_LAST_WORK = 2.0
"""How long to wait for work that is under way when the node is destroyed [s]."""
_REPEAT_LOG_AFTER = 5.0
"""A message that stays the same is logged once in so many seconds."""

P = ParamSpec("P")
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


def publish_if_heard(publisher: Any, make: Callable[[], Any]) -> None:
    """Make a message and publish it, where somebody listens; not for topics that late subscribers get the last of."""
    if publisher.get_subscription_count() > 0:
        publisher.publish(make())


class GraspNode(LifecycleNodeMixin, Node, Generic[Table]):
    """A lifecycle node that works on the newest of its inputs and survives whatever comes in.

    A subclass names its ``table`` of parameters and implements ``configure`` (create publishers, subscriptions and
    services by the ``add_...`` methods) and ``work`` (one input). Callbacks run in several threads: inputs, services,
    parameters and lifecycle each have a callback group, so that parameters answer while a detection runs. The work has
    threads of its own (workers.py).
    """

    table: ClassVar[type]
    """The parameters: a frozen dataclass derived from ``NodeParameters``."""

    def __init__(self, name: str, *, awaits: str, beside: Sequence[type] = (), **kwargs: Any) -> None:
        """Declare the parameters, then start up by itself unless ``autostart`` is false.

        Args:
            name: name of the node unless remapped.
            awaits: what the node needs to have something to do, for the diagnostics.
            beside: tables of other nodes of the process: command lines set parameters for all of them.
            kwargs: of ``rclpy.node.Node``.

        Raises:
            ParameterError: a parameter that was given is not accepted.
        """
        Node.__init__(self, name, **kwargs)
        self._store: ParameterStore[Table] | None = None
        self._store = ParameterStore(self, self.table, beside)
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        self._transition_lock = threading.Lock()
        self._active = False
        self._undo: list[Callable[[], object]] = []
        self._inputs: list[SensorInput] = []
        self._last_log = ("", 0.0)
        self.health = Health(awaits=awaits)
        count = self.at_a_time()
        self.busy = Places(count)
        """Taken while regnet_core computes: so much work and so many services at a time."""
        self.workers: Workers[Any] = Workers(f"{name} worker", count, self._work, self._pause)
        self.input_group = QuickCallbackGroup()
        self.service_group = MutuallyExclusiveCallbackGroup()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", OUTPUT_QOS)
        # Steady time: with use_sim_time and no clock, timers on the node's clock would never fire.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watch = self.create_timer(
            _DIAGNOSTICS_PERIOD, self._guarded(self._look_after), MutuallyExclusiveCallbackGroup(), self._steady
        )
        self._service_change_state.callback = self._one_at_a_time(self._service_change_state.callback)
        for service in self.services:
            service.callback = self._guarded_service(self._refusing_nonsense(service.callback))
        if self.settings.autostart:
            self._starter = self.create_timer(
                0.0, self._guarded(self._start), MutuallyExclusiveCallbackGroup(), self._steady
            )

    # -- for subclasses ------------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create what the node needs; called on the configure transition."""
        raise NotImplementedError

    def at_a_time(self) -> int:
        """How many inputs are worked on at a time, at most; each then has a thread of its own."""
        return 1

    def work(self, item: Any) -> None:
        """Work on one input, the newest."""
        raise NotImplementedError

    def check_settings(self, proposed: Table) -> None:
        """Refuse settings for reasons that the table cannot know, by raising InvalidInputError."""

    def settings_changed(self, old: Table) -> None:
        """React to a change of parameters that is already in force."""

    def pause(self) -> float:
        """For how long the next work should wait [s], apart from ``least_period``; asked until it is 0 or less."""
        return 0.0

    def deactivated(self) -> None:
        """Stop what is under way; called on the deactivate and shutdown transitions."""

    @property
    def settings(self) -> Table:
        """The parameters now in force, as one immutable object."""
        assert self._store is not None
        return self._store.current

    @property
    def active(self) -> bool:
        """Whether the node is in the lifecycle state active."""
        return self._active

    @property
    def state_label(self) -> str:
        """The lifecycle state."""
        return str(self._state_machine.current_state[1])

    def add_publisher(self, kind: type, topic: str, qos: QoSProfile = OUTPUT_QOS) -> Any:
        """A publisher that is silent unless the node is active, until cleanup."""
        publisher = self.create_lifecycle_publisher(kind, topic, qos)
        self._undo.append(lambda: self.destroy_lifecycle_publisher(publisher))
        return publisher

    def add_input(self, kind: type, topic: str, reliability: str, *, serialized: bool = False) -> SensorInput:
        """A subscription whose newest message is worked on, as bytes where ``serialized``, until cleanup."""
        subscription = SensorInput(
            self, kind, topic, self._guarded(self.receive), self.input_group, reliability, serialized
        )
        self._inputs.append(subscription)
        self._undo.append(lambda: self._inputs.remove(subscription))
        self._undo.append(subscription.destroy)
        return subscription

    def add_service(self, kind: type, name: str, callback: Callable[[Any, Any], Any]) -> None:
        """A service, until cleanup."""
        service = self.create_service(kind, name, self._guarded_service(callback), callback_group=self.service_group)
        self._undo.append(lambda: self.destroy_service(service))

    def at_cleanup(self, action: Callable[[], object]) -> None:
        """Call ``action`` on the cleanup transition."""
        self._undo.append(action)

    def repeat(self, item: Any) -> None:
        """Work on an item again, unless a newer one waits."""
        if self._active:
            self.workers.put_if_idle(item)

    def fail(self, message: str) -> None:
        """Report something that could not be worked on: in the log and in the diagnostics, at once."""
        self.health.failed(message)
        self._log(message)
        self.publish_diagnostics()

    def done(
        self,
        stages: Mapping[str, float],
        steps: Iterable[StepReport] = (),
        counts: Mapping[str, int] | None = None,
        reason: str = "",
    ) -> None:
        """Report an input that was worked on (see ``Health.succeeded``); a new reason is published at once."""
        if self.health.succeeded(stages, steps, counts, reason):
            self.publish_diagnostics()

    def crash(self, error: Exception, doing: str) -> None:
        """Report an exception that nobody expected; the node goes on."""
        if not self.context.ok():
            return  # shutting down: handles vanish under running callbacks
        self._log("".join(traceback.format_exception(error)))
        self.fail(
            f"unexpected {type(error).__name__} {doing}: {error}. The node goes on with the next input; this is a "
            "defect of the node: please report it with the input that caused it"
        )

    def publish_diagnostics(self) -> None:
        """Publish the state of the node's health."""
        if not self.context.ok():
            return
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        name = self.get_fully_qualified_name()
        message.status = [self.health.status(name, self.state_label, self.settings.stale_after)]
        try:
            self._diagnostics.publish(message)
        except (RCLError, InvalidHandle):
            if self.context.ok():  # otherwise the node is shutting down, and there is nobody to tell
                raise

    def destroy_node(self) -> None:
        """End the work and release everything (rclpy's method)."""
        self._active = False
        self.workers.end(_LAST_WORK)
        super().destroy_node()

    def wait_until_idle(self, timeout: float) -> bool:
        """Wait for work and services to end, at most ``timeout`` [s] each; whether they did."""
        return self.workers.wait_until_idle(timeout) and self.busy.wait_until_free(timeout)

    def _look_after(self) -> None:
        """What is done once a second."""
        for subscription in list(self._inputs):
            subscription.refresh()
        self.publish_diagnostics()

    # -- input and work ------------------------------------------------------------------------------------------

    def receive(self, message: Any) -> None:
        """Have an input worked on, unless a newer one comes before its turn or the node is not active."""
        if not self._active:
            return
        self.health.received()
        if self.workers.put(message):
            self.health.dropped()

    def _work(self, item: Any) -> None:
        try:
            self.work(item)
        except RegnetError as error:
            self.fail(str(error))
        except Exception as error:
            self.crash(error, "while working on an input")

    def _pause(self, last_start: float) -> float:
        """How long to wait, as the parameters and ``pause`` ask, before work on the next input begins [s]."""
        if not (self._active and self.context.ok()):
            return math.inf
        try:
            return max(last_start + self.settings.least_period - time.monotonic(), self.pause())
        except Exception as error:  # the context may have been shut down meanwhile
            self.crash(error, "while waiting for its turn")
            return math.inf

    # -- parameters ----------------------------------------------------------------------------------------------

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """Set parameters one by one (rclpy's method, with our checks)."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all the parameters or none (rclpy's method, with our checks and their messages)."""
        if self._store is None:
            return super().set_parameters_atomically(parameter_list)
        try:
            vetted, proposed = self._store.vet(parameter_list)
            self.check_settings(proposed)
        except RegnetError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically(vetted)
        if result.successful:
            old = self._store.current
            self._store.adopt(proposed)
            self.settings_changed(old)
        return result

    # -- lifecycle -----------------------------------------------------------------------------------------------

    def _start(self) -> None:
        self._starter.cancel()
        with self._transition_lock:
            if self.state_label == "unconfigured" and self.trigger_configure() == _SUCCESS:
                self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create what the node needs (rclpy's hook)."""
        try:
            self.configure()
        except Exception as error:
            self._tear_down()
            if isinstance(error, RegnetError):
                self.fail(f"cannot configure: {error}")
            else:
                self.crash(error, "while configuring")
            return _FAILURE
        self.health.recovered()
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work (rclpy's hook)."""
        result = super().on_activate(state)
        self.workers.begin()
        self._active = result == _SUCCESS
        self.get_logger().info(f"active, waiting for {self.health.awaits()}")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working (rclpy's hook)."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release what ``configure`` created (rclpy's hook)."""
        self._tear_down()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good (rclpy's hook)."""
        self._stop()
        self._tear_down()
        return super().on_shutdown(state)

    def _stop(self) -> None:
        self._active = False
        self.workers.forget()
        self.deactivated()

    def _tear_down(self) -> None:
        def release() -> None:
            while self._undo:
                self._undo.pop()()

        self.workers.stop_for(release)  # not under the feet of the work on the last input

    # -- callbacks that do not let an exception out ----------------------------------------------------------------

    def _guarded(self, callback: Callable[P, None]) -> Callable[P, None]:
        def call(*arguments: P.args, **named: P.kwargs) -> None:
            try:
                callback(*arguments, **named)
            except Exception as error:
                self.crash(error, f"in {getattr(callback, '__name__', 'a callback').strip('_')}")

        return call

    def _guarded_service(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        def call(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                self.crash(error, f"while answering a {type(request).__name__}")
                return response

        return call

    def _refusing_nonsense(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Answer requests to set parameters of no known type; rclpy raises an error and leaves the client waiting."""

        def call(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except (TypeError, ValueError) as error:
                refusal = SetParametersResult(successful=False, reason=f"not a parameter's value: {error}")
                if isinstance(request, SetParameters.Request):
                    response.results = [refusal] * len(request.parameters)
                elif isinstance(request, SetParametersAtomically.Request):
                    response.result = refusal
                else:
                    raise
                return response

        return call

    def _one_at_a_time(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        def call(request: Any, response: Any) -> Any:
            if not self._transition_lock.acquire(blocking=False):
                self.get_logger().warning("a transition was refused because another one is under way; try again")
                response.success = False
                return response
            try:
                return callback(request, response)
            except RCLError:
                wanted = request.transition.label or request.transition.id
                self.get_logger().warning(f"transition {wanted} is not possible in the state {self.state_label}")
                response.success = False
                return response
            finally:
                self._transition_lock.release()

        return call

    def _log(self, message: str) -> None:
        now = time.monotonic()
        if message != self._last_log[0] or now - self._last_log[1] > _REPEAT_LOG_AFTER:
            self._last_log = (message, now)
            self.get_logger().error(message)
