"""The base of the nodes, with a made-up node in the test's own process: no exception in it ends it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from live import Peer, reserved_domain, values_of, wait_for
from rclpy.context import Context
from std_msgs.msg import String
from std_srvs.srv import Trigger

from regnet_core.errors import InvalidInputError
from regnet_ros.node import GraspNode
from regnet_ros.parameters import NodeParameters, parameter
from regnet_ros.process import spin


@dataclass(frozen=True)
class Settings(NodeParameters):
    """Parameters of the made-up node."""

    refuses: str = parameter("bad", "The text that is refused.")


class MadeUp(GraspNode[Settings]):
    """`texts` -> `echoes`; each text says what happens."""

    table = Settings

    def __init__(self, **kwargs: Any) -> None:
        self.gate = threading.Event()
        self.gate.set()
        self.configurations = 0
        super().__init__("made_up", awaits="texts", **kwargs)

    def configure(self) -> None:
        self.configurations += 1
        self._echoes = self.add_publisher(String, "echoes")
        self.add_input(String, "texts", self.settings.refuses if self.settings.refuses == "x" else "auto")
        self.add_service(Trigger, "break", self._break)
        if self.configurations == 2:
            raise OSError("the disk is full")
        if self.configurations == 3:
            raise InvalidInputError("that cannot be had")

    def work(self, item: String) -> None:
        self.gate.wait(20)
        if item.data == self.settings.refuses:
            raise InvalidInputError("that text is refused")
        self._echoes.publish(String(data=str(1 / (len(item.data) - 1)) if item.data != "a b" else item.data))
        self.done({}, reason="")

    def _break(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        raise KeyError("no such thing")


class Running:
    """The node, spun in a thread as the processes do it, and a peer."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self.node = MadeUp(context=self._context)
        self._thread = threading.Thread(target=spin, args=([self.node],))
        self._thread.start()
        self.peer = Peer(domain)
        self.echoes = self.peer.listen(String, "echoes")
        self.peer.wait_for_state("made_up", "active")

    def send(self, text: str) -> None:
        self.echoes.clear()
        self.peer.diagnostics.clear()
        self.peer.publisher(String, "texts").publish(String(data=text))

    def wait_for_error(self, text: str) -> None:
        status = self.peer.wait_for_status("made_up", lambda s: text in s.message)
        assert status.level == DiagnosticStatus.ERROR

    def close(self) -> None:
        self.node.gate.set()
        rclpy.shutdown(context=self._context)
        self._thread.join(20)
        self.peer.close()


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    with reserved_domain() as domain:
        created = Running(domain)
        yield created
        created.close()


def test_an_unexpected_exception_is_reported_and_the_next_input_is_worked_on(running: Running) -> None:
    running.send("1")  # divides by zero
    running.wait_for_error("unexpected ZeroDivisionError while working on an input: division by zero. The node goes on")
    running.send("a b")
    assert running.echoes.wait().data == "a b"
    status = running.peer.wait_for_status("made_up", lambda s: s.level == DiagnosticStatus.OK)
    assert status.message == "working"


def test_a_refused_input_is_reported_in_its_own_words(running: Running) -> None:
    running.send("bad")
    running.wait_for_error("that text is refused")
    assert running.peer.set_parameter("made_up", "refuses", "worse").successful
    running.send("bad")
    assert running.echoes.wait().data == "0.5"


def test_an_item_that_nobody_was_woken_for_does_not_keep_later_work_out(running: Running) -> None:
    running.echoes.clear()
    running.node.workers._mailbox.put(String(data="a b"))
    running.node.repeat(String(data="c"))
    assert running.echoes.wait().data == "a b"


def test_what_was_left_over_at_a_deactivation_is_not_worked_on_after_the_next_activation(running: Running) -> None:
    assert running.peer.change_state("made_up", Transition.TRANSITION_DEACTIVATE)
    running.node.workers._mailbox.put(String(data="a b"))  # as a callback does that had looked at the state before
    assert running.peer.change_state("made_up", Transition.TRANSITION_ACTIVATE)
    running.echoes.clear()
    running.node.repeat(String(data="xyz"))
    assert running.echoes.wait().data == "0.5"


def test_a_service_that_breaks_still_answers(running: Running) -> None:
    running.peer.diagnostics.clear()
    response = running.peer.call(Trigger, "break", Trigger.Request())
    assert not response.success
    running.wait_for_error("unexpected KeyError while answering")


def test_parameters_and_states_answer_while_work_is_stuck(running: Running) -> None:
    running.node.gate.clear()
    running.send("stuck")
    assert running.peer.set_parameter("made_up", "stale_after", 7.0).successful
    assert running.peer.get_parameter("made_up", "stale_after") == 7.0
    assert running.peer.state("made_up") == "active"
    for number in range(5):
        running.send(f"waiting {number}")
    running.peer.wait_for_status("made_up", lambda s: values_of(s)["dropped for a newer one"] == "4")
    assert running.echoes.all() == []
    running.node.gate.set()
    last = str(1 / (len("waiting 4") - 1))
    assert running.echoes.wait(lambda m: m.data == last).data == last
    assert len(running.echoes.all()) == 2  # the stuck one and the newest


def test_while_a_transition_is_under_way_another_is_refused(running: Running) -> None:
    assert running.node._transition_lock.acquire()
    assert not running.peer.change_state("made_up", Transition.TRANSITION_DEACTIVATE)
    running.node._transition_lock.release()
    assert running.peer.state("made_up") == "active"


def test_a_configuration_that_fails_leaves_the_node_unconfigured_and_can_be_tried_again(running: Running) -> None:
    peer = running.peer
    assert peer.change_state("made_up", Transition.TRANSITION_DEACTIVATE)
    assert peer.change_state("made_up", Transition.TRANSITION_CLEANUP)
    for message in ("unexpected OSError while configuring: the disk is full", "cannot configure: that cannot be had"):
        peer.diagnostics.clear()
        assert not peer.change_state("made_up", Transition.TRANSITION_CONFIGURE)
        running.wait_for_error(message)
        assert peer.state("made_up") == "unconfigured"
        wait_for(lambda: peer.node.count_publishers("/echoes") == 0, "the topics to go")
    assert peer.change_state("made_up", Transition.TRANSITION_CONFIGURE)
    assert peer.change_state("made_up", Transition.TRANSITION_ACTIVATE)
    running.send("a b")
    assert running.echoes.wait().data == "a b"
