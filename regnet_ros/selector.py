"""The node `selector`: from ranked grasps to the one to execute."""

from __future__ import annotations

import math
import sys
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from regnet_msgs.msg import GraspArray, SelectedGrasp
from regnet_msgs.srv import SelectGrasp
from visualization_msgs.msg import MarkerArray

from regnet_core.errors import InvalidInputError
from regnet_core.policy import Policy, select
from regnet_ros.conversions import GraspMessageError, gripper_from_message, pose_stamped
from regnet_ros.execution import Candidates, Execution
from regnet_ros.grasp_list import GraspList, selected_grasp
from regnet_ros.inputs import LATCHED_QOS
from regnet_ros.node import GraspNode
from regnet_ros.process import run
from regnet_ros.settings import SelectorParameters
from regnet_ros.visuals import no_markers, selection_markers


class Selector(GraspNode[SelectorParameters]):
    """`grasps` -> `selected_grasp`, `selected_pose`, `selected_marker`; service `select_grasp`."""

    table = SelectorParameters

    def __init__(self, **kwargs: Any) -> None:
        self._last: Candidates | None = None
        self._execution: Execution | None = None
        super().__init__("selector", awaits="grasps on the topic 'grasps'", **kwargs)

    def configure(self) -> None:
        """Create the topics, the service and the client of the action."""
        self._selected = self.add_publisher(SelectedGrasp, "selected_grasp", LATCHED_QOS)
        self._pose = self.add_publisher(PoseStamped, "selected_pose")
        self._marker = self.add_publisher(MarkerArray, "selected_marker")
        self.add_service(SelectGrasp, "select_grasp", self._on_select)
        self._execution = Execution(
            self, self.service_group, self._may_execute, self._choose_again, self._executed, self.fail
        )
        self.at_cleanup(self._release)
        source = self.add_input(GraspArray, "grasps", "reliable", serialized=True)
        self.health.awaits = lambda: f"grasps on {source.description}"

    def settings_changed(self, old: SelectorParameters) -> None:
        """Stop the robot when execution is switched off."""
        if old.execute and not self.settings.execute:
            self.deactivated()

    def deactivated(self) -> None:
        """Cancel an execution that is under way."""
        if self._execution is not None:
            self._execution.stop()

    def work(self, item: bytes) -> None:
        """Select from one array, which is serialized."""
        settings, start = self.settings, time.perf_counter()
        self._last = candidates = _candidates(GraspList.of_serialized(item))
        converted = time.perf_counter()
        assert self._execution is not None
        counts = {"grasps": len(candidates.grasps)}
        if settings.execute and self._execution.under_way:
            stages = {"convert": converted - start, "total": converted - start}
            self.done(stages, counts=counts, reason="a grasp is being executed; the selection stays as it is")
            return
        selected = self._select(candidates, settings.make_policy(settings.policy), frozenset())
        if selected is not None:
            self._announce(selected)
            if settings.execute:
                self._execution.start(candidates, selected, settings.max_attempts)
        else:
            self._marker.publish(no_markers(candidates.message.header))
        end = time.perf_counter()
        reason = "" if selected is not None else self._why_none(candidates, frozenset())
        self.done(
            {"convert": converted - start, "select": end - converted, "total": end - start},
            counts=counts,
            reason=reason,
        )

    def _select(self, candidates: Candidates, policy: Policy, excluded: frozenset[int]) -> SelectedGrasp | None:
        settings = self.settings
        selection = select(candidates.grasps, policy, settings.limits, excluded)
        if selection is None:
            return None
        return selected_grasp(
            candidates.message, candidates.grasps, selection, settings.pre_grasp_distance, settings.lift_height
        )

    def _announce(self, selected: SelectedGrasp) -> None:
        markers = selection_markers(selected)
        self._selected.publish(selected)
        self._pose.publish(pose_stamped(selected))
        self._marker.publish(markers)

    def _choose_again(self, candidates: Candidates, excluded: frozenset[int]) -> SelectedGrasp | None:
        selected = self._select(candidates, self.settings.make_policy(self.settings.policy), excluded)
        if selected is not None:
            self._announce(selected)
        return selected

    def _may_execute(self) -> bool:
        return self.active and self.settings.execute

    def _executed(self, message: str) -> None:
        self.get_logger().info(message)
        self.health.recovered()

    def _on_select(self, request: SelectGrasp.Request, response: SelectGrasp.Response) -> SelectGrasp.Response:
        excluded = frozenset(int(rank) for rank in request.rejected_ranks)
        try:
            candidates = _candidates(GraspList.of_message(request.grasps)) if request.grasps.grasps else self._last
            policy = self.settings.make_policy(request.policy or self.settings.policy)
            if not self.active:
                response.message = f"the selector is {self.state_label}; it answers once it is activated"
                return response
            if candidates is None:
                response.message = (
                    "the request holds no grasps, and no GraspArray was received on the topic 'grasps' yet"
                )
                return response
            selected = self._select(candidates, policy, excluded)
        except InvalidInputError as error:
            response.message = str(error)
            return response
        response.success = selected is not None
        if selected is None:
            response.message = self._why_none(candidates, excluded)
        else:
            response.selected = selected
        return response

    def _why_none(self, candidates: Candidates, excluded: frozenset[int]) -> str:
        count, settings = len(candidates.grasps), self.settings
        if count == 0:
            return f"there is no grasp to select: {candidates.message.reason or 'the detector gave no reason'}"
        rejected = sum(rank < count for rank in excluded)
        if rejected == count:
            return f"all {count} grasps are rejected"
        others = f"{rejected} are rejected, the other {count - rejected}" if rejected else "all"
        return (
            f"none of the {count} grasps can be selected: {others} lie outside the limits (approach within "
            f"{math.degrees(settings.approach_max_angle):.0f} degrees of {list(settings.approach_axis)}, "
            f"{settings.reach_min:g} to {settings.reach_max:g} m from {list(settings.reach_centre)})"
        )

    def _release(self) -> None:
        self._last = None
        if self._execution is not None:
            self._execution.destroy()
            self._execution = None


def _candidates(message: GraspList) -> Candidates:
    """The grasps of an array.

    Raises:
        InvalidInputError: it has no frame, or its gripper or a grasp is not valid.
    """
    grasps = message.grasps()
    if len(grasps) > 0:
        if not message.header.frame_id:
            raise GraspMessageError("the array has no frame_id: name the gravity-aligned frame that its poses are in")
        width = gripper_from_message(message.gripper).width
        wide = (grasps.width <= 0.0) | (grasps.width > width + 1e-9)
        if wide.any():
            rank = int(wide.argmax())
            raise GraspMessageError(
                f"the opening of grasp {rank} must be in (0, {width:g}] m, as the gripper opens no wider; "
                f"got {grasps.width[rank]:g}"
            )
    return Candidates(message, grasps)


def main(args: list[str] | None = None) -> int:
    """Run the node; the exit code of the process."""
    return run(lambda: [Selector()], args)


if __name__ == "__main__":
    sys.exit(main())
