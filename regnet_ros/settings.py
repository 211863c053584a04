"""The parameters of each node, with defaults, ranges and descriptions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

from regnet_core.errors import InvalidInputError
from regnet_core.filters import GraspFilters
from regnet_core.geometry import Box
from regnet_core.gripper import Gripper
from regnet_core.models import DEFAULT_MODEL, available_models
from regnet_core.policies import SUFFIX as POLICY_SUFFIX
from regnet_core.policies import load_policy, policy_names
from regnet_core.policy import POLICIES, AnalyticPolicy, Policy, SelectionLimits, make_policy
from regnet_core.preprocessing import PreprocessingConfig
from regnet_core.robots.names import ROBOT_NAMES
from regnet_core.weights import SUFFIX
from regnet_ros.inputs import reliabilities
from regnet_ros.parameters import NodeParameters, parameter

FAR = 1000.0
"""A limit at this distance [m] limits nothing: farther points are dropped in any case."""

_SPAN = (-FAR, FAR)
_LOWEST, _HIGHEST = (-FAR,) * 3, (FAR,) * 3


def _policies() -> Sequence[str]:
    return tuple(POLICIES)


def _policy_files() -> Sequence[str]:
    return ("", *policy_names())


def _robots() -> Sequence[str]:
    return ROBOT_NAMES


def _box(name: str, lower: tuple[float, ...], upper: tuple[float, ...]) -> Box | None:
    """The box of two parameters, None where they limit nothing."""
    if lower == _LOWEST and upper == _HIGHEST:
        return None
    for axis, low, high in zip("xyz", lower, upper, strict=True):
        if not low < high:
            raise InvalidInputError(
                f"{name}_min must be less than {name}_max, got {low:g} and {high:g} m in {axis}; to move both limits "
                "past each other set them at once (atomically), or the farther one first"
            )
    return Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2]))


def _direction(name: str, vector: tuple[float, ...]) -> tuple[float, float, float]:
    if math.hypot(*vector) < 1e-6:
        raise InvalidInputError(f"{name} must be a direction, not all zero; [0.0, 0.0, -1.0] is straight down")
    return vector[0], vector[1], vector[2]


@dataclass(frozen=True)
class SensorParameters(NodeParameters):
    """What nodes that take clouds have."""

    input_reliability: str = parameter(
        "auto",
        "Reliability of the subscription to clouds. auto: reliable, and best effort once a best-effort publisher shows "
        "up; large clouds get lost on best effort with the default transports.",
        choices=reliabilities,
        read_only=True,
    )
    max_rate: float = parameter(
        0.0,
        "Most clouds worked on in a second, always the newest [Hz]; 0: as many as come and as the machine can.",
        limits=(0.0, 1000.0),
    )

    @property
    def least_period(self) -> float:
        """Least time between the starts of two works [s]."""
        return 1.0 / self.max_rate if self.max_rate > 0.0 else 0.0


@dataclass(frozen=True)
class PreprocessorParameters(SensorParameters):
    """Parameters of the preprocessor."""

    target_frame: str = parameter("world", "The gravity-aligned frame, z up, that clouds are transformed to.")
    sensor_pose: tuple[float, ...] = parameter(
        (),
        "Pose of the cloud's frame in target_frame: x, y, z [m], roll, pitch, yaw [rad]. Empty: taken from tf2.",
        limits=_SPAN,
        lengths=(0, 6),
    )
    transform_patience: float = parameter(0.2, "How long to wait for a transform of tf2 [s].", limits=(0.0, 10.0))
    crop_min: tuple[float, ...] = parameter(
        _LOWEST,
        "Lower corner of the workspace, in target_frame [m]; points outside are dropped.",
        limits=_SPAN,
        lengths=(3,),
    )
    crop_max: tuple[float, ...] = parameter(
        _HIGHEST, "Upper corner of the workspace, in target_frame [m].", limits=_SPAN, lengths=(3,)
    )
    keep_pace: bool = parameter(
        True,
        "Whether a cloud, the newest, is prepared only when a detector is about to have time for it: with a camera "
        "faster than the detector that leaves it the time that other clouds would take. Without a detector, or where "
        "this is false, as many as come.",
    )
    voxel_size: float = parameter(
        0.0,
        "Edge length of the voxels that keep one point each [m]; 0 keeps all points. The detector thins what needs it.",
        limits=(0.0, 0.5),
    )
    max_points: int = parameter(0, "Most points to publish, drawn at random; 0 publishes all.", limits=(0, 10_000_000))
    seed: int = parameter(0, "Seed of the random draw and of the plane's fit.", limits=(0, 2**31 - 1))

    def check(self) -> None:
        """Refuse crop limits that leave nothing, and a target frame without a name."""
        if not self.target_frame.strip("/ "):
            raise InvalidInputError("target_frame must be the name of a gravity-aligned frame, it is empty")
        _ = self.config

    @property
    def config(self) -> PreprocessingConfig:
        """The parameters as regnet_core takes them."""
        workspace = _box("crop", self.crop_min, self.crop_max)
        return PreprocessingConfig(workspace, self.voxel_size, self.max_points, self.seed)


@dataclass(frozen=True)
class DetectorParameters(SensorParameters):
    """Parameters of the detector."""

    gripper_width: float = parameter(0.08, "W: largest opening of the jaw [m].", limits=Gripper.LIMITS["width"])
    gripper_depth: float = parameter(0.06, "D: length of the fingers [m].", limits=Gripper.LIMITS["depth"])
    gripper_height: float = parameter(
        0.010,
        "H: extent of fingers and palm across closing and approach direction [m].",
        limits=Gripper.LIMITS["height"],
    )
    gripper_thickness: float = parameter(
        0.010, "T: thickness of a finger along the closing direction [m].", limits=Gripper.LIMITS["thickness"]
    )
    gripper_palm_depth: float = parameter(
        0.06, "How far the hand reaches behind the palm's face [m].", limits=Gripper.LIMITS["palm_depth"]
    )
    model: str = parameter(
        DEFAULT_MODEL,
        "What proposes grasps. A change loads and tries the new model while the old one goes on working.",
        choices=available_models,
        suffix=SUFFIX,
    )
    device: str = parameter(
        "auto", "Where the model runs: auto (a GPU where torch can use one, else the CPU), cpu, cuda or cuda:N."
    )
    threads: int = parameter(
        0,
        "Threads that detections use on the CPU; 0: one for each core that the process may use.",
        limits=(0, 1024),
        read_only=True,
    )
    at_a_time: int = parameter(
        1,
        "Clouds worked on at a time, at most. With more than 1, each is so in a process of its own of some 800 MB, and "
        "the threads are shared out among these: there are more arrays in a second, and each comes later.",
        limits=(1, 16),
        read_only=True,
    )
    seed: int = parameter(
        0, "Seed of every random choice; the same cloud gives the same grasps.", limits=(0, 2**31 - 1)
    )
    target_frame: str = parameter(
        "", "The frame that clouds must be in; empty: any frame with a name, which must be gravity-aligned, z up."
    )
    approach_axis: tuple[float, ...] = parameter(
        (0.0, 0.0, -1.0),
        "Axis of the cone of accepted approach directions, in the cloud's frame.",
        limits=_SPAN,
        lengths=(3,),
    )
    approach_max_angle: float = parameter(
        math.pi, "Half-angle of that cone [rad]; pi accepts every approach.", limits=(0.01, math.pi)
    )
    workspace_min: tuple[float, ...] = parameter(
        _LOWEST,
        "Lower corner of the box that fingertips must lie in, in the cloud's frame [m].",
        limits=_SPAN,
        lengths=(3,),
    )
    workspace_max: tuple[float, ...] = parameter(
        _HIGHEST, "Upper corner of the box that fingertips must lie in [m].", limits=_SPAN, lengths=(3,)
    )
    target_min: tuple[float, ...] = parameter(
        _LOWEST,
        "Lower corner of the region of interest, in the cloud's frame [m]: only what lies in it is grasped.",
        limits=_SPAN,
        lengths=(3,),
    )
    target_max: tuple[float, ...] = parameter(
        _HIGHEST, "Upper corner of the region of interest [m].", limits=_SPAN, lengths=(3,)
    )
    min_quality: float = parameter(0.0, "Least quality s_q of a grasp.", limits=(0.0, 1.0))
    max_grasps: int = parameter(200, "Most grasps to publish, the best ones.", limits=(1, 100_000))
    max_markers: int = parameter(50, "Most grippers to draw, the best ones.", limits=(0, 1000))
    viewpoint: tuple[float, ...] = parameter(
        (), "Position of the camera in the cloud's frame [m]; empty: not known.", limits=_SPAN, lengths=(0, 3)
    )
    redetect_on_change: bool = parameter(
        False, "Whether a change of these parameters is applied to the last cloud at once, not only to the next one."
    )
    warm_up: bool = parameter(
        True,
        "Whether to detect once in a made-up cloud before the node becomes active and before another model takes over.",
        read_only=True,
    )

    def check(self) -> None:
        """Refuse boxes that hold nothing and a direction without a length."""
        _ = self.gripper, self.filters

    @property
    def gripper(self) -> Gripper:
        """The gripper's parameters as regnet_core takes them."""
        return Gripper(
            self.gripper_width, self.gripper_depth, self.gripper_height, self.gripper_thickness, self.gripper_palm_depth
        )

    @property
    def filters(self) -> GraspFilters:
        """The limits on grasps as regnet_core takes them."""
        return GraspFilters(
            approach_axis=_direction("approach_axis", self.approach_axis),
            approach_max_angle=self.approach_max_angle,
            workspace=_box("workspace", self.workspace_min, self.workspace_max),
            min_quality=self.min_quality,
            target=_box("target", self.target_min, self.target_max),
        )

    def same_result(self, other: DetectorParameters) -> bool:
        """Whether a detection with ``other`` gives the same."""
        aside = (
            "autostart",
            "stale_after",
            "redetect_on_change",
            "warm_up",
            "input_reliability",
            "max_rate",
            "threads",
            "at_a_time",
        )
        return all(
            getattr(self, f.name) == getattr(other, f.name) for f in fields(DetectorParameters) if f.name not in aside
        )


@dataclass(frozen=True)
class SelectorParameters(NodeParameters):
    """Parameters of the selector."""

    policy: str = parameter("heuristic", "How grasps are scored.", choices=_policies)
    quality_gain: float = parameter(0.8783, "Constant of the analytic policy.", limits=_SPAN)
    quality_offset: float = parameter(-0.0587, "Constant of the analytic policy.", limits=_SPAN)
    slope: float = parameter(10.1244, "Constant of the analytic policy.", limits=_SPAN)
    midpoint: float = parameter(0.6103, "Constant of the analytic policy.", limits=_SPAN)
    policy_file: str = parameter(
        "",
        "Constants of the analytic policy for a robot, as regnet calibrate writes them; empty: the parameters'.",
        choices=_policy_files,
        suffix=POLICY_SUFFIX,
    )
    approach_axis: tuple[float, ...] = parameter(
        (0.0, 0.0, -1.0), "Axis of the cone of approach directions that the robot can take.", limits=_SPAN, lengths=(3,)
    )
    approach_max_angle: float = parameter(
        math.pi, "Half-angle of that cone [rad]; pi accepts every approach.", limits=(0.01, math.pi)
    )
    reach_centre: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), "Where the arm is mounted, in the frame of the grasps [m].", limits=_SPAN, lengths=(3,)
    )
    reach_min: float = parameter(0.0, "Least distance of a grasp from reach_centre [m].", limits=(0.0, FAR))
    reach_max: float = parameter(FAR, "Greatest distance of a grasp from reach_centre [m].", limits=(0.0, FAR))
    pre_grasp_distance: float = parameter(
        0.10, "How far before the grasp the straight approach begins [m].", limits=(0.0, 1.0)
    )
    lift_height: float = parameter(0.10, "How far straight up the grasp is lifted [m].", limits=(0.0, 2.0))
    execute: bool = parameter(False, "Whether selected grasps are sent to the action execute_grasp.")
    max_attempts: int = parameter(
        3, "How many grasps of one array are sent to execution until one succeeds.", limits=(1, 100)
    )

    def check(self) -> None:
        """Refuse a reach that contains nothing and a direction without a length."""
        if not self.reach_min < self.reach_max:
            raise InvalidInputError(
                f"reach_min must be less than reach_max, got {self.reach_min:g} and {self.reach_max:g} m"
            )
        _ = self.limits, self.make_policy(AnalyticPolicy.name)

    @property
    def limits(self) -> SelectionLimits:
        """What the robot can do, as regnet_core takes it."""
        x, y, z = self.reach_centre
        return SelectionLimits(
            approach_axis=_direction("approach_axis", self.approach_axis),
            approach_max_angle=self.approach_max_angle,
            reach_centre=(x, y, z),
            reach_min=self.reach_min,
            reach_max=self.reach_max if self.reach_max < FAR else math.inf,
        )

    def make_policy(self, name: str) -> Policy:
        """The policy of that name with the constants of the policy file or of the parameters.

        Raises:
            InvalidInputError: there is no such policy, or the policy file cannot be used.
        """
        return self._analytic if name == AnalyticPolicy.name else make_policy(name)

    @cached_property
    def _analytic(self) -> AnalyticPolicy:
        """Read once: a file that changes is read again when any parameter is set."""
        if self.policy_file:
            return load_policy(self.policy_file).policy
        return AnalyticPolicy(self.quality_gain, self.quality_offset, self.slope, self.midpoint)


@dataclass(frozen=True)
class ExecutorParameters(NodeParameters):
    """Parameters of the executor."""

    stale_after: float = parameter(
        60.0, "After how long without an image of its camera the diagnostics report STALE [s].", limits=(0.1, 3600.0)
    )
    robot: str = parameter("baxter", "The robot of the simulated cell.", choices=_robots, read_only=True)
    gripper_width: float = parameter(
        0.08, "W: largest opening of the jaw [m].", limits=Gripper.LIMITS["width"], read_only=True
    )
    gripper_depth: float = parameter(
        0.06, "D: length of the fingers [m].", limits=Gripper.LIMITS["depth"], read_only=True
    )
    gripper_height: float = parameter(
        0.010,
        "H: extent of fingers and palm across closing and approach direction [m].",
        limits=Gripper.LIMITS["height"],
        read_only=True,
    )
    gripper_thickness: float = parameter(
        0.010,
        "T: thickness of a finger along the closing direction [m].",
        limits=Gripper.LIMITS["thickness"],
        read_only=True,
    )
    gripper_palm_depth: float = parameter(
        0.06,
        "How far the hand reaches behind the palm's face [m].",
        limits=Gripper.LIMITS["palm_depth"],
        read_only=True,
    )
    objects: int = parameter(5, "How many objects the bin is filled with.", limits=(0, 20), read_only=True)
    seed: int = parameter(0, "Seed of the objects and of the camera's noise.", limits=(0, 2**31 - 1), read_only=True)
    world_frame: str = parameter("world", "The frame of the cell, z up, that grasps must be in.", read_only=True)
    camera_frame: str = parameter("camera_depth_optical_frame", "The frame of the camera's clouds.", read_only=True)
    camera_rate: float = parameter(
        1.0, "How often the camera takes an image while the robot waits [Hz].", limits=(0.05, 30.0)
    )
    speed: float = parameter(
        1.0,
        "Simulated seconds in a second while the robot moves; 0: as many as the machine can.",
        limits=(0.0, 1000.0),
    )
    state_file: str = parameter(
        "",
        "Where the objects' places are kept (.npz) for a node that is started again; empty: nowhere.",
        read_only=True,
    )

    def check(self) -> None:
        """Refuse a gripper that cannot be, frames without names and a state file of another kind."""
        _ = self.gripper
        for name in ("world_frame", "camera_frame"):
            if not getattr(self, name).strip("/ "):
                raise InvalidInputError(f"{name} must be the name of a frame, it is empty")
        if self.state_file and not self.state_file.endswith(".npz"):
            raise InvalidInputError(f"state_file must end in .npz, got '{self.state_file}'")

    @property
    def gripper(self) -> Gripper:
        """The gripper's parameters as regnet_core takes them."""
        return Gripper(
            self.gripper_width, self.gripper_depth, self.gripper_height, self.gripper_thickness, self.gripper_palm_depth
        )
