"""The selector as a process: policies, limits, the service, falling to the next grasp when the robot refuses."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from grasp_arrays import ODD_ARRAYS, QUALITY, TILT, OddArray, array
from lifecycle_msgs.msg import Transition
from live import NodeProcess, Peer, System, TimeExpiredError, values_of, wait_for
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from regnet_msgs.action import ExecuteGrasp
from regnet_msgs.msg import GraspArray, SelectedGrasp
from regnet_msgs.srv import SelectGrasp
from visualization_msgs.msg import Marker, MarkerArray

from regnet_ros.execution import Candidates, Execution
from regnet_ros.grasp_list import GraspList
from regnet_ros.settings import SelectorParameters

CHANGED = ("policy", "midpoint", "reach_min", "reach_max", "approach_max_angle", "max_attempts", "execute")


class Selector:
    """The running node with its topics."""

    def __init__(self, system: System) -> None:
        self.peer: Peer = system.peer
        self.process: NodeProcess = system.start_node("selector")
        self.selected = self.peer.listen(SelectedGrasp, "selected_grasp", latched=True)
        self.poses = self.peer.listen(PoseStamped, "selected_pose")
        self.markers = self.peer.listen(MarkerArray, "selected_marker")
        self._stamp = 0

    def send(self, message: GraspArray | None = None) -> GraspArray:
        message = message or array()
        self._stamp += 1
        message.header.stamp.sec = self._stamp
        for inbox in (self.selected, self.poses, self.markers, self.peer.diagnostics):
            inbox.clear()
        self.peer.publisher(GraspArray, "grasps").publish(message)
        return message

    def selection(self) -> SelectedGrasp:
        sent = self.send()
        return self.selected.wait(lambda message: message.header == sent.header, what="selection")

    def change(self, **values: Any) -> None:
        result = self.peer.set_parameters("selector", values)
        assert result.successful, result.reason

    def wait_for_message(self, pattern: str) -> DiagnosticStatus:
        return self.peer.wait_for_status("selector", lambda status: re.search(pattern, status.message) is not None)


@pytest.fixture(scope="module")
def selector(system: System) -> Selector:
    return Selector(system)


@pytest.fixture(autouse=True)
def _defaults_after_each_test(selector: Selector) -> Iterator[None]:
    yield
    selector.change(**{name: getattr(SelectorParameters(), name) for name in CHANGED})


class Executor:
    """A robot that does as it is told: for each rank "reject", "fail", "lift" or "wait"; the rest it lifts."""

    def __init__(self, peer: Peer) -> None:
        self.plan: dict[int, str] = {}
        self.goals: list[int] = []
        self.cancelled = threading.Event()
        self._server = ActionServer(
            peer.node,
            ExecuteGrasp,
            "execute_grasp",
            execute_callback=self._execute,
            goal_callback=self._accept,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def set_plan(self, plan: dict[int, str]) -> None:
        self.plan = plan
        self.goals.clear()
        self.cancelled.clear()

    def destroy(self) -> None:
        self._server.destroy()

    def _accept(self, goal: ExecuteGrasp.Goal) -> GoalResponse:
        self.goals.append(goal.grasp.rank)
        return GoalResponse.REJECT if self.plan.get(goal.grasp.rank) == "reject" else GoalResponse.ACCEPT

    async def _execute(self, handle: Any) -> ExecuteGrasp.Result:
        plan = self.plan.get(handle.request.grasp.rank, "lift")
        if plan == "wait":
            await self._until_cancelled(handle)
            handle.canceled()
            self.cancelled.set()
            return ExecuteGrasp.Result(outcome="cancelled")
        if plan == "fail":
            handle.abort()
            return ExecuteGrasp.Result(outcome="missed", message="the jaw closed on nothing")
        handle.succeed()
        return ExecuteGrasp.Result(success=True, outcome="lifted", message="the object is in the hand")

    async def _until_cancelled(self, handle: Any) -> None:
        while not handle.is_cancel_requested:
            await _Tick()


class _Tick:
    """Gives the peer's executor a turn."""

    def __await__(self) -> Iterator[None]:
        yield


def test_the_best_by_the_policy_with_its_poses(selector: Selector) -> None:
    selected = selector.selection()
    assert (selected.rank, selected.policy) == (1, "heuristic")
    assert selected.score == pytest.approx(QUALITY[1] + 1.0)  # it points straight down
    source = array().grasps[1]
    assert selected.grasp == selected.selected.pose == source.pose
    assert selected.pre_grasp.position.z == pytest.approx(source.pose.position.z + 0.1)
    assert selected.lift.position.z == pytest.approx(source.pose.position.z + 0.1)
    assert selected.opening == source.width == 0.06
    assert selected.gripper == array().gripper
    pose = selector.poses.wait()
    assert (pose.header, pose.pose) == (selected.header, selected.grasp)
    markers = selector.markers.wait().markers
    assert markers[0].action == Marker.DELETEALL
    assert [m.type for m in markers[1:]] == [Marker.CUBE] * 3 + [Marker.LINE_STRIP]


def test_the_pre_grasp_lies_behind_the_grasp_along_its_own_approach(selector: Selector) -> None:
    response = selector.peer.call(
        SelectGrasp, "select_grasp", SelectGrasp.Request(grasps=array(), rejected_ranks=[1, 2, 3])
    )
    tilt, grasp, before = math.radians(TILT[0]), response.selected.grasp.position, response.selected.pre_grasp.position
    assert response.selected.rank == 0
    assert before.z - grasp.z == pytest.approx(0.1 * math.cos(tilt))
    assert abs(before.x - grasp.x) == pytest.approx(0.1 * math.sin(tilt))
    assert response.selected.lift.position.z - grasp.z == pytest.approx(0.1)


def test_who_subscribes_late_still_gets_the_selection(selector: Selector) -> None:
    selected = selector.selection()
    late = selector.peer.listen(SelectedGrasp, "selected_grasp", latched=True)
    assert late.wait() == selected


def test_the_analytic_policy_with_the_papers_constants(selector: Selector) -> None:
    selector.change(policy="analytic")
    selected = selector.selection()
    assert (selected.rank, selected.policy) == (1, "analytic")
    assert selected.score == pytest.approx((0.8783 * 0.8 - 0.0587) / (1 + math.exp(-10.1244 * (1.0 - 0.6103))))
    selector.change(midpoint=-10.0)  # now every direction can be reached, and quality alone decides
    assert selector.selection().rank == 0


def test_limits(selector: Selector) -> None:
    selector.change(reach_max=0.87)  # grasp 0 is 0.854 m away, the others are farther
    assert selector.selection().rank == 0
    selector.change(reach_max=1000.0, approach_max_angle=math.radians(15), reach_min=0.93)
    assert selector.selection().rank == 2
    selector.change(reach_min=5.0)
    selector.send()
    status = selector.wait_for_message(
        r"none of the 4 grasps can be selected: all lie outside .* 15 degrees .* 5 to 1000 m"
    )
    assert status.level == DiagnosticStatus.WARN
    assert [m.action for m in selector.markers.wait().markers] == [Marker.DELETEALL]
    assert selector.selected.all() == []


def test_the_service_falls_to_the_next_rank(selector: Selector) -> None:
    selector.selection()
    rejected: list[int] = []
    for expected in (1, 2, 0, 3):
        response = selector.peer.call(SelectGrasp, "select_grasp", SelectGrasp.Request(rejected_ranks=rejected))
        assert (response.success, response.selected.rank) == (True, expected)
        rejected.append(expected)
    response = selector.peer.call(SelectGrasp, "select_grasp", SelectGrasp.Request(rejected_ranks=rejected))
    assert not response.success
    assert response.message == "all 4 grasps are rejected"


def test_the_service_with_an_array_and_a_policy_of_its_own(selector: Selector) -> None:
    request = SelectGrasp.Request(grasps=array(stamp=77), policy="analytic", rejected_ranks=[1, 2000])
    response = selector.peer.call(SelectGrasp, "select_grasp", request)
    assert (response.selected.header.stamp.sec, response.selected.policy, response.selected.rank) == (77, "analytic", 2)
    response = selector.peer.call(SelectGrasp, "select_grasp", SelectGrasp.Request(policy="best"))
    assert not response.success
    assert "no policy 'best'; there are heuristic, analytic" in response.message


@pytest.mark.parametrize("odd", ODD_ARRAYS, ids=lambda odd: odd.name)
def test_an_odd_array_gets_a_clear_answer_and_the_node_lives(selector: Selector, odd: OddArray) -> None:
    message = array()
    odd.change(message)
    selector.send(message)
    status = selector.wait_for_message(odd.message)
    assert status.level in (DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
    assert selector.selected.all() == []
    assert selector.peer.get_parameter("selector", "policy") == "heuristic"
    assert selector.selection().rank == 1


def test_without_an_executor_there_is_a_clear_message(selector: Selector) -> None:
    selector.change(execute=True)
    selector.send()
    assert selector.wait_for_message("no action server /execute_grasp").level == DiagnosticStatus.ERROR
    selector.change(execute=False)


@pytest.fixture(scope="module")
def executor(selector: Selector) -> Iterator[Executor]:
    robot = Executor(selector.peer)
    yield robot
    robot.destroy()


@pytest.fixture
def executing(selector: Selector, executor: Executor) -> Iterator[Executor]:
    """The selector sends its selections to the robot."""
    name = "/execute_grasp/_action/send_goal"
    wait_for(lambda: selector.peer.node.count_clients(name) > 0, "the selector to find the robot")
    selector.change(execute=True)
    yield executor
    selector.change(execute=False)


def send_until_goals(selector: Selector, executor: Executor, count: int) -> list[int]:
    """Send one array, again if the selector had not found the robot yet; the ranks that the robot was asked for."""
    selector.send()
    wait_for(lambda: len(executor.goals) >= count or _unheard(selector), "goals")
    if len(executor.goals) < count:
        return send_until_goals(selector, executor, count)
    return list(executor.goals)


def _unheard(selector: Selector) -> bool:
    texts = [status.message for message in selector.peer.diagnostics.all() for status in message.status]
    return any("no action server" in text for text in texts)


def test_a_selected_grasp_is_executed(selector: Selector, executing: Executor) -> None:
    executing.set_plan({})
    assert send_until_goals(selector, executing, 1) == [1]
    assert selector.wait_for_message("working").level == DiagnosticStatus.OK


def test_a_rejected_grasp_is_followed_by_the_next(selector: Selector, executing: Executor) -> None:
    executing.set_plan({1: "reject"})
    assert send_until_goals(selector, executing, 2) == [1, 2]
    assert selector.selected.wait(lambda message: message.rank == 2).header.frame_id == "world"


def test_a_failed_grasp_is_followed_by_the_next_until_attempts_run_out(selector: Selector, executing: Executor) -> None:
    executing.set_plan({1: "reject", 2: "fail", 0: "fail"})
    assert send_until_goals(selector, executing, 3) == [1, 2, 0]
    status = selector.wait_for_message(r"gave up after 3 grasp\(s\).*the jaw closed on nothing")
    assert status.level == DiagnosticStatus.ERROR
    executing.set_plan({1: "reject", 2: "fail"})  # the next array gets attempts of its own
    assert send_until_goals(selector, executing, 3) == [1, 2, 0]


def test_when_no_grasp_is_left(selector: Selector, executing: Executor) -> None:
    executing.set_plan(dict.fromkeys(range(4), "fail"))
    selector.change(max_attempts=10)
    assert send_until_goals(selector, executing, 4) == [1, 2, 0, 3]
    assert selector.wait_for_message("no grasp is left after 4").level == DiagnosticStatus.ERROR


def test_switching_off_cancels_and_nothing_new_starts_before(selector: Selector, executing: Executor) -> None:
    executing.set_plan({1: "wait"})
    send_until_goals(selector, executing, 1)
    selector.send()
    assert selector.wait_for_message("a grasp is being executed").level == DiagnosticStatus.WARN
    assert executing.goals == [1]
    selector.change(execute=False)
    assert executing.cancelled.wait(20)


@pytest.mark.parametrize("permitted", [True, False])
def test_an_execution_that_was_stopped_before_it_began_never_begins(
    selector: Selector, executor: Executor, permitted: bool
) -> None:
    """The selection had been made when the parameter was changed."""
    executor.set_plan({7: "wait"})
    said: list[str] = []
    execution = Execution(
        selector.peer.node, ReentrantCallbackGroup(), lambda: permitted, lambda *_: None, said.append, said.append
    )
    wait_for(execution._client.server_is_ready, "the action server")
    execution.start(Candidates(message := GraspList.of_message(array()), message.grasps()), SelectedGrasp(rank=7), 3)
    assert execution.under_way == permitted
    if permitted:
        wait_for(lambda: execution._goal is not None, "the goal's answer")
        execution.stop()
        assert executor.cancelled.wait(20)
    execution.destroy()
    assert executor.goals == ([7] if permitted else [])
    assert not said


def test_deactivation_cancels_and_silences(selector: Selector, executing: Executor) -> None:
    executing.set_plan({1: "wait"})
    send_until_goals(selector, executing, 1)
    assert selector.peer.change_state("selector", Transition.TRANSITION_DEACTIVATE)
    assert executing.cancelled.wait(20)
    selector.send()
    with pytest.raises(TimeExpiredError):
        selector.selected.wait(timeout=0.5)
    response = selector.peer.call(SelectGrasp, "select_grasp", SelectGrasp.Request(grasps=array()))
    assert not response.success and "inactive" in response.message
    assert selector.peer.change_state("selector", Transition.TRANSITION_ACTIVATE)
    executing.set_plan({})
    assert selector.selection().rank == 1


def test_the_numbers_in_the_diagnostics(selector: Selector) -> None:
    selector.selection()
    values = values_of(selector.peer.wait_for_status("selector"))
    assert values["state"] == "active"
    assert int(values["received"]) > 20
    assert float(values["latency total [ms]"]) < 1000.0
