"""The executor as a process: what it accepts, refuses, tells and cancels, in a cell whose bin is empty."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from live import DEADLINE, NodeProcess, System, TimeExpiredError, ros_arguments, values_of, wait_for
from regnet_msgs.action import ExecuteGrasp
from regnet_msgs.msg import Grasp, GraspArray, SelectedGrasp
from sensor_msgs.msg import JointState, PointCloud2

from regnet_core.approach import lift_poses, pre_grasp_poses
from regnet_core.geometry import transform_points
from regnet_core.gripper import Gripper
from regnet_core.robots.layout import CellLayout
from regnet_ros.conversions import cloud_from_message, gripper_to_message, pose_to_message
from regnet_ros.spinning import ThreadSafeActionClient

LAYOUT = CellLayout()
_PATIENCE = 5.0
"""So long after an array was published its execution has begun, or never will [s]."""


class Robot:
    """The running executor and a client of its action."""

    selector: NodeProcess
    """Started by the first test that needs it."""

    def __init__(self, system: System) -> None:
        self.peer = system.peer
        self.process = system.start_node("executor", robot="panda", objects=0, speed=0.0, camera_rate=5.0)
        self.clouds = self.peer.listen(PointCloud2, "points")
        self.joints = self.peer.listen(JointState, "joint_states")
        self._client = ThreadSafeActionClient(self.peer.node, ExecuteGrasp, "execute_grasp")
        wait_for(self._client.server_is_ready, "the action server")
        self.peer.introduce("executor")

    def send(self, grasp: SelectedGrasp, feedback: Any = None) -> Any:
        """The answer to a goal."""
        return _result(self._client.send_goal_async(ExecuteGrasp.Goal(grasp=grasp), feedback_callback=feedback))

    def result(self, goal: Any) -> Any:
        assert goal.accepted
        return _result(goal.get_result_async())

    def now(self) -> Any:
        return self.peer.node.get_clock().now().to_msg()

    def grasp(self, x: float = 0.0, y: float = 0.0, height: float = 0.03) -> SelectedGrasp:
        """From above, at a place relative to the middle of the bin's floor."""
        T = np.eye(4)
        T[:3, :3] = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        tips = [LAYOUT.pick[0] + x, LAYOUT.pick[1] + y, LAYOUT.pick_bin.inside.lower[2] + height]
        T[:3, 3] = np.array(tips) - Gripper().depth * T[:3, 0]
        message = SelectedGrasp(opening=0.06, gripper=gripper_to_message(Gripper()), rank=3)
        message.header.frame_id = "world"
        message.header.stamp = self.now()
        message.grasp = pose_to_message(T)
        message.pre_grasp = pose_to_message(pre_grasp_poses(T[None], 0.1)[0])
        message.lift = pose_to_message(lift_poses(T[None], 0.1)[0])
        return message


def _result(future: Any) -> Any:
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    if not done.wait(DEADLINE):
        raise TimeExpiredError("the executor did not answer")
    return future.result()


@pytest.fixture(scope="module")
def robot(system: System) -> Iterator[Robot]:
    yield Robot(system)


def test_the_camera_sees_the_empty_bin(robot: Robot) -> None:
    cloud = robot.clouds.wait()
    assert cloud.header.frame_id == "camera_depth_optical_frame"
    decoded = cloud_from_message(cloud)
    world = transform_points(LAYOUT.camera.T_world_camera, decoded.points)
    assert len(world) > 5000 and decoded.colors is not None
    assert LAYOUT.view.contains(world).mean() > 0.999
    status = robot.peer.wait_for_status("executor", lambda s: "is empty" in s.message)
    assert status.level == DiagnosticStatus.WARN
    values = values_of(status)
    assert (values["to pick"], values["placed"], values["robot"]) == ("0", "0", "Franka Emika Panda")
    joints = robot.joints.wait()
    assert list(joints.name) == [f"joint{i}" for i in range(1, 8)]
    assert list(joints.position) == pytest.approx([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], abs=0.01)


def test_a_grasp_of_nothing_is_missed_and_its_phases_are_told(robot: Robot) -> None:
    first = robot.result(robot.send(robot.grasp(0.05, 0.05)))  # by its end, the feedback's topic is found as well
    assert first.result.outcome == "missed"
    # Nothing was moved, so that the next rank of the same array is welcome.
    told: list[tuple[str, float]] = []
    goal = robot.send(robot.grasp(), lambda message: told.append((message.feedback.phase, message.feedback.progress)))
    answer = robot.result(goal)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert (answer.result.success, answer.result.outcome) == (False, "missed")
    assert "holds nothing" in answer.result.message
    wait_for(lambda: "close" in [phase for phase, _ in told], "the feedback, which may come after the result")
    phases = list(dict.fromkeys(phase for phase, _ in told))
    assert phases == ["pre_grasp", "approach", "close"]
    assert [progress for _, progress in told] == sorted(progress for _, progress in told)


def array_of(*chosen: SelectedGrasp) -> GraspArray:
    """An array with these grasps, the first one the best."""
    array = GraspArray(header=chosen[0].header, gripper=chosen[0].gripper)
    for rank, one in enumerate(chosen):
        grasp = Grasp(pose=one.grasp, width=one.opening, quality=0.9 - 0.1 * rank, vertical_score=1.0)
        array.grasps.append(grasp)
    return array


def test_a_grasp_from_before_the_objects_were_moved_is_out_of_date(robot: Robot) -> None:
    old = robot.grasp()
    old.header.stamp.sec = 1
    answer = robot.result(robot.send(old))
    assert (answer.status, answer.result.outcome) == (GoalStatus.STATUS_ABORTED, "outdated")


def publish_until(publisher: Any, array: GraspArray, process: NodeProcess, text: str) -> None:
    """Publish an array, and again where the selector could do nothing with it.

    It may not have found the robot yet, or wait for one that has gone.
    """

    def said() -> bool:
        publisher.publish(array)
        try:
            return bool(wait_for(lambda: text in process.output, text, _PATIENCE))
        except TimeExpiredError:
            return False

    wait_for(said, f"'{text}' in the output of {process.program}")


def _wrong(robot: Robot, case: str) -> SelectedGrasp:
    grasp = robot.grasp()
    if case == "far":
        return robot.grasp(x=2.0)
    if case == "wall":
        return robot.grasp(y=0.115)
    if case == "frame":
        grasp.header.frame_id = "camera"
    if case == "gripper":
        grasp.gripper.width = 0.1
    if case == "opening":
        grasp.opening = 0.2
    if case == "nan":
        grasp.grasp.position.x = float("nan")
    if case == "quaternion":
        grasp.lift.orientation.w = 9.0
    return grasp


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("far", "unreachable: the arm does not reach the grasp"),
        ("wall", "unreachable: at the grasp, hand touches the table or an obstacle"),
        ("frame", "in the frame 'camera', the cell's is 'world'"),
        ("gripper", "for a gripper with width 0.1 m, the robot's is 0.08 m"),
        ("opening", "the opening must be in (0, 0.08] m, got 0.2"),
        ("nan", "the pose grasp holds a number that is NaN"),
        ("quaternion", "the orientation of lift must be a quaternion"),
    ],
)
def test_what_cannot_be_executed_is_refused_and_the_log_says_why(robot: Robot, case: str, reason: str) -> None:
    assert not robot.send(_wrong(robot, case)).accepted
    robot.process.wait_for_output(reason)


def test_the_selector_turns_to_the_next_rank_where_the_arm_does_not_reach(robot: Robot, system: System) -> None:
    robot.selector = system.start_node("selector", execute=True, max_attempts=3)
    publisher = robot.peer.publisher(GraspArray, "grasps")
    chosen = [robot.grasp(x=2.0), robot.grasp(y=0.115), robot.grasp(x=0.04), robot.grasp(x=-0.04)]

    publish_until(publisher, array_of(*chosen), robot.process, "grasp 2: missed: the jaw closed to 0.000 m")
    assert "grasp 0 is refused: unreachable: the arm does not reach the grasp" in robot.process.output
    assert "grasp 1 is refused: unreachable: at the grasp, hand touches" in robot.process.output
    assert "grasp 3" not in robot.process.output.split("grasp 2: missed")[0].split("grasp 0 is refused")[-1]
    assert robot.peer.set_parameter("selector", "execute", False).successful


def test_of_an_array_that_is_out_of_date_one_grasp_is_tried_and_no_more(robot: Robot) -> None:
    assert robot.peer.set_parameter("selector", "execute", True).successful
    old = [robot.grasp(0.04), robot.grasp(-0.04)]
    for grasp in old:
        grasp.header.stamp.sec = 1
    failed = robot.selector.output.count("was not executed")
    robot.peer.publisher(GraspArray, "grasps").publish(array_of(*old))
    robot.selector.wait_for_output("waiting for new grasps: the objects were moved since it was found")
    assert robot.selector.output.count("was not executed") == failed  # nor does that count as a failure
    assert robot.peer.set_parameter("selector", "execute", False).successful


def test_a_second_goal_is_refused_and_a_cancelled_one_ends_at_home(robot: Robot) -> None:
    assert robot.peer.set_parameter("executor", "speed", 0.5).successful  # slow enough to be interrupted
    approaching = threading.Event()
    goal = robot.send(robot.grasp(), lambda message: approaching.set())
    assert goal.accepted and approaching.wait(DEADLINE)
    assert not robot.send(robot.grasp()).accepted
    robot.process.wait_for_output("the robot is busy")
    _result(goal.cancel_goal_async())
    answer = robot.result(goal)
    assert (answer.status, answer.result.outcome) == (GoalStatus.STATUS_CANCELED, "cancelled")
    assert robot.peer.set_parameter("executor", "speed", 0.0).successful
    robot.joints.clear()
    at_home = robot.joints.wait()
    assert list(at_home.position) == pytest.approx([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], abs=0.02)
    assert robot.result(robot.send(robot.grasp())).result.outcome == "missed"


def _shortest_span(messages: list[Any], count: int) -> float:
    """Between the stamps of the first and the last of so many in a row [s]."""
    stamps = [message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec for message in messages]
    return min((b - a for a, b in zip(stamps, stamps[count - 1 :], strict=False)), default=np.inf)


def test_the_rate_of_the_camera_is_changed_while_it_runs(robot: Robot) -> None:
    assert robot.peer.set_parameter("executor", "camera_rate", 20.0).successful
    robot.clouds.clear()
    wait_for(lambda: _shortest_span(robot.clouds.all(), 5) < 0.4, "five clouds in less time than at the old rate")
    refused = robot.peer.set_parameter("executor", "robot", "baxter")
    assert not refused.successful and "robot is fixed once the node runs" in refused.reason
    assert robot.peer.set_parameter("executor", "camera_rate", 1.0).successful


def test_deactivated_it_refuses_and_active_again_it_works(robot: Robot) -> None:
    assert robot.peer.change_state("executor", Transition.TRANSITION_DEACTIVATE)
    assert not robot.send(robot.grasp()).accepted
    robot.process.wait_for_output("the executor is inactive; it works once it is activated")
    assert robot.peer.change_state("executor", Transition.TRANSITION_ACTIVATE)
    assert robot.result(robot.send(robot.grasp())).result.outcome == "missed"
    assert robot.process.alive


def test_a_robot_that_was_started_again_is_given_the_next_grasp(robot: Robot, system: System) -> None:
    """Killed in the middle of an execution, it has no answer for the selector, which must not wait for one for ever."""
    assert robot.peer.set_parameter("executor", "speed", 0.2).successful
    assert robot.peer.set_parameter("selector", "execute", True).successful
    publisher = robot.peer.publisher(GraspArray, "grasps")
    publisher.publish(array_of(robot.grasp(0.04)))
    wait_for(lambda: robot.joints.all() and abs(robot.joints.all()[-1].position[1] + 0.785) > 0.03, "the arm to move")
    robot.process.kill()
    another = system.start("executor", "--ros-args", *ros_arguments({}, {"robot": "panda", "objects": 0, "speed": 0.0}))
    another.wait_for_output("active, waiting for its camera")

    publish_until(publisher, array_of(robot.grasp(0.04)), another, "grasp 0: missed")
