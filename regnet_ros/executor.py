"""The node `executor`: a simulated robot that executes grasps, and the depth camera that looks at its bin."""

from __future__ import annotations

import sys
import threading
import time
from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import TransformStamped
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from regnet_msgs.action import ExecuteGrasp
from regnet_msgs.msg import SelectedGrasp
from sensor_msgs.msg import JointState, PointCloud2
from std_msgs.msg import Header

from regnet_core.errors import InvalidInputError
from regnet_core.robots.goal import GraspGoal
from regnet_ros.conversions import cloud_to_message, pose_to_message
from regnet_ros.execution import ACTION, OUTDATED
from regnet_ros.goals import goal_from_message, seen_before
from regnet_ros.inputs import LATCHED_QOS
from regnet_ros.node import GraspNode
from regnet_ros.process import run
from regnet_ros.settings import ExecutorParameters
from regnet_ros.spinning import ThreadSafeActionServer

if TYPE_CHECKING:
    from regnet_core.robots.cell import PickResult, WorkCell
    from regnet_core.robots.picking import Phase

_NAP = 0.02
"""Longest sleep while the simulation waits for the clock on the wall [s]; a signal is noticed so soon."""


_TELL_PERIOD = 0.05
"""Feedback and joint states are published so often within a phase, at most [s]."""


class _Look:
    """Time for an image."""


class Executor(GraspNode[ExecutorParameters]):
    """Action `execute_grasp`; the camera's `points`, and `joint_states`."""

    table = ExecutorParameters

    def __init__(self, **kwargs: Any) -> None:
        self._cell: WorkCell | None = None
        self._claim = threading.Lock()
        """Held from the acceptance of a goal to its result."""
        self._accepted: GraspGoal | None = None
        """What was accepted last; None where it was out of date."""
        self._picks = 0
        self._counts: dict[str, int] = {}
        super().__init__("executor", awaits="its camera", **kwargs)

    def configure(self) -> None:
        """Make the cell, then the topics and the action."""
        settings = self.settings
        self._cell = cell = self._make_cell(settings)
        self._changed = self.get_clock().now()
        self._points = self.add_publisher(PointCloud2, "points")
        self._joints = self.add_publisher(JointState, "joint_states")
        self._announce_camera(cell)
        server = ThreadSafeActionServer(
            self, ExecuteGrasp, ACTION,
            execute_callback=self._execute, goal_callback=self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT, callback_group=ReentrantCallbackGroup(),
        )  # fmt: skip
        self.at_cleanup(server.destroy)
        self._shutter = self.create_timer(
            1.0 / settings.camera_rate, self._guarded(self._trigger), MutuallyExclusiveCallbackGroup(), self._steady
        )
        self.at_cleanup(lambda: self.destroy_timer(self._shutter))
        self.at_cleanup(self._release)
        self.health.facts = {"robot": cell.robot.title}

    def settings_changed(self, old: ExecutorParameters) -> None:
        """Take images at the new rate."""
        if self.settings.camera_rate != old.camera_rate and self._cell is not None:
            self._shutter.timer_period_ns = round(1e9 / self.settings.camera_rate)

    def work(self, item: _Look) -> None:
        """Take an image, unless the robot moves."""
        if not self._claim.locked():
            self._look()

    def _release(self) -> None:
        """Let the execution that is under way come to its end."""
        with self._claim:
            self._cell = None

    # -- camera --------------------------------------------------------------------------------------------------

    def _trigger(self) -> None:
        self.repeat(_Look())

    def _look(self) -> None:
        assert self._cell is not None
        start = time.perf_counter()
        self.health.received()
        with self.busy:
            # The stamp is that of the image: what changes from now on is not in it.
            header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.settings.camera_frame)
            points, colours = self._cell.capture()
            left, placed = len(self._cell.to_pick), len(self._cell.placed)
        self._points.publish(cloud_to_message(header, points, colours))
        self._publish_joints(header.stamp)
        lost = len(self._cell.scene.objects) - left - placed
        counts = {"to pick": left, "placed": placed, "beside the bins": lost, "picks": self._picks}
        reason = "" if left else "the bin to pick from is empty"
        self.done({"capture": time.perf_counter() - start}, counts=counts, reason=reason)
        if counts != self._counts:
            self._counts = counts
            self.publish_diagnostics()

    def _publish_joints(self, stamp: TimeMessage) -> None:
        assert self._cell is not None
        message = JointState(name=list(self._cell.robot.joints), position=self._cell.physics.q().tolist())
        message.header.stamp = stamp
        self._joints.publish(message)

    def _announce_camera(self, cell: WorkCell) -> None:
        """The camera's place on /tf_static, where the message's package is installed."""
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        pose = pose_to_message(cell.layout.camera.T_world_camera)
        stamped = TransformStamped(child_frame_id=self.settings.camera_frame)
        stamped.header.frame_id = self.settings.world_frame
        stamped.header.stamp = self.get_clock().now().to_msg()
        p = pose.position
        stamped.transform.translation.x, stamped.transform.translation.y, stamped.transform.translation.z = (
            p.x,
            p.y,
            p.z,
        )
        stamped.transform.rotation = pose.orientation
        publisher = self.create_publisher(TFMessage, "/tf_static", LATCHED_QOS)
        publisher.publish(TFMessage(transforms=[stamped]))
        self.at_cleanup(lambda: self.destroy_publisher(publisher))

    # -- action --------------------------------------------------------------------------------------------------

    def _on_goal(self, request: ExecuteGrasp.Goal) -> GoalResponse:
        """Accept what the robot can do now; the log says why something is refused."""
        selected = request.grasp
        if not self._claim.acquire(blocking=False):
            self.get_logger().info(f"grasp {selected.rank} is refused: the robot is busy")
            return GoalResponse.REJECT
        try:
            self._accepted = self._vetted(selected)
        except InvalidInputError as error:
            self.get_logger().info(f"grasp {selected.rank} is refused: {error}")
        except Exception as error:
            self.crash(error, "while looking at a goal")
        else:
            return GoalResponse.ACCEPT
        self._claim.release()
        return GoalResponse.REJECT

    def _vetted(self, selected: SelectedGrasp) -> GraspGoal | None:
        """The goal, if the robot can execute it; None where it is out of date, which only a result can tell.

        Raises:
            InvalidInputError: it cannot, and why.
        """
        if not self.active:
            raise InvalidInputError(f"the executor is {self.state_label}; it works once it is activated")
        assert self._cell is not None
        if seen_before(selected, self._changed):
            return None
        goal = goal_from_message(selected, self.settings.world_frame, self.settings.gripper)
        with self.busy:
            obstacle = self._cell.check(goal)
        if obstacle:
            raise InvalidInputError(f"unreachable: {obstacle}")
        return goal

    def _execute(self, handle: ServerGoalHandle) -> ExecuteGrasp.Result:
        """Carry out the goal that was accepted."""
        try:
            if self._accepted is None:
                handle.abort()
                return ExecuteGrasp.Result(outcome=OUTDATED, message="the objects were moved since it was found")
            result = self._pick(handle, self._accepted)
        except Exception as error:
            self.crash(error, "while executing a grasp")
            handle.abort()
            return ExecuteGrasp.Result(outcome="failed", message=str(error))
        finally:
            self._claim.release()
            self._trigger()
        if result.success:
            handle.succeed()
        elif handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        self.get_logger().info(f"grasp {handle.request.grasp.rank}: {result.outcome.value}: {result.message}")
        return ExecuteGrasp.Result(success=result.success, outcome=result.outcome.value, message=result.message)

    def _pick(self, handle: ServerGoalHandle, goal: GraspGoal) -> PickResult:
        cell = self._cell
        assert cell is not None
        pace = _Pace(cell.physics.time)
        told: tuple[Phase | None, float] = (None, 0.0)

        def watch(phase: Phase, progress: float) -> bool:
            nonlocal told
            now = time.monotonic()
            # However fast the simulation is, each phase is told once, and nobody is flooded.
            if phase is not told[0] or now - told[1] > _TELL_PERIOD:
                told = phase, now
                handle.publish_feedback(ExecuteGrasp.Feedback(phase=phase.value, progress=progress))
                self._publish_joints(self.get_clock().now().to_msg())
            going_on = self.active and self.context.ok() and not handle.is_cancel_requested
            return going_on and pace.wait(cell.physics.time, self.settings.speed, lambda: self.context.ok())

        with self.busy:
            result = cell.pick(goal, watch)
            self._picks += 1
            if result.disturbed:
                self._changed = self.get_clock().now()
                self._keep_state()
        return result

    def _keep_state(self) -> None:
        if self.settings.state_file and self._cell is not None:
            from regnet_core.robots.cell_state import save_state

            save_state(self._cell, self.settings.state_file)

    def _make_cell(self, settings: ExecutorParameters) -> WorkCell:
        """The cell, with its objects where the state file has them.

        Raises:
            InvalidInputError: something is not installed, or the state file is that of another cell.
        """
        try:
            from regnet_core.robots.cell import CellConfig, WorkCell
            from regnet_core.robots.cell_state import restore_state
        except ImportError as error:
            raise InvalidInputError(
                f"the executor simulates a robot and needs the package {error.name}: pip install 'regnet_ros[robots]'"
            ) from error
        config = CellConfig(settings.robot, settings.gripper, settings.objects, settings.seed)
        cell = WorkCell(config)
        if settings.state_file and restore_state(cell, settings.state_file):
            self.get_logger().info(f"the objects are where '{settings.state_file}' has them")
        return cell


class _Pace:
    """Keeps the simulation from running faster than the wall clock allows."""

    def __init__(self, simulated: float) -> None:
        """Args: the simulated time at the start [s]."""
        self._simulated, self._wall = simulated, time.monotonic()

    def wait(self, simulated: float, speed: float, running: Any) -> bool:
        """Wait until the wall clock has caught up; false when ``running()`` became false meanwhile.

        Args:
            simulated: the simulated time now [s].
            speed: simulated seconds in a second; 0: no wait.
            running: asked again and again.
        """
        if speed > 0.0:
            self._wall += (simulated - self._simulated) / speed
            while (left := self._wall - time.monotonic()) > 0.0 and running():
                time.sleep(min(left, _NAP))
            # Where the machine is too slow, it does not run to catch up.
            self._wall = max(self._wall, time.monotonic())
        self._simulated = simulated
        return bool(running())


def main(args: list[str] | None = None) -> int:
    """Run the node; the exit code of the process."""
    return run(lambda: [Executor()], args)


if __name__ == "__main__":
    sys.exit(main())
