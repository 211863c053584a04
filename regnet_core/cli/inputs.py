"""The clouds that a command works on, from files and bags, in the frame in which grasps are wanted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.errors import CloudError, InvalidInputError
from regnet_core.geometry import Array, Box, pose_matrix, transform_points
from regnet_core.io.bags import BagCloud, cloud_topics, is_bag, read_bag_clouds
from regnet_core.io.files import check_cloud_file, read_cloud_file
from regnet_core.io.pointcloud2 import Colors


@dataclass(frozen=True)
class InputOptions:
    """Which clouds to take and how to bring them into a frame with z up."""

    topic: str | None = None
    message: int | None = None
    """Which cloud of a bag; the first when not given."""
    all_messages: bool = False
    sensor_pose: tuple[float, ...] | None = None
    """Position [m] and roll, pitch, yaw [rad] of the cloud's frame."""
    viewpoint: tuple[float, float, float] | None = None
    crop: Box | None = None


@dataclass(frozen=True)
class CloudInput:
    """One cloud, ready for detection."""

    file: Path
    points: npt.NDArray[np.floating[Any]]
    """(N, 3) with z up [m]."""
    colors: Colors | None
    frame: str | None
    """Name of the frame of points and grasps, where it has one."""
    viewpoint: tuple[float, float, float] | None = None
    """Where the camera was, in that frame [m]."""
    topic: str | None = None
    message: int | None = None
    stamp_ns: int | None = None
    warning: str = ""
    """What is doubtful about the cloud."""

    @property
    def name(self) -> str:
        """File, and message of a bag."""
        return self.file.name if self.message is None else f"{self.file.name} message {self.message}"

    @property
    def label(self) -> str:
        """File, and topic and message of a bag."""
        return self.file.name if self.topic is None else f"{self.file.name} {self.topic} message {self.message}"


def check_inputs(files: Sequence[Path], options: InputOptions) -> int:
    """Check that the options suit the files, and count the clouds that ``read_inputs`` will give.

    Raises:
        InvalidInputError: they do not, a file is missing or of an unknown kind, or a bag cannot be read.
    """
    if options.all_messages and options.message is not None:
        raise InvalidInputError("--message picks one cloud and --all takes every one: give only one of them")
    for_bags = {"--topic": options.topic, "--message": options.message, "--all": options.all_messages or None}
    given = [name for name, value in for_bags.items() if value is not None]
    if given and not any(is_bag(file) for file in files):
        raise InvalidInputError(f"{given[0]} is for bags, and none of the inputs is a folder or an .mcap file")
    return sum(_count(file, options) for file in files)


def _count(file: Path, options: InputOptions) -> int:
    if is_bag(file):
        return len(_chosen_messages(file, options)[1])
    check_cloud_file(file)
    return 1


def read_inputs(files: Sequence[Path], options: InputOptions) -> Iterator[CloudInput]:
    """The chosen clouds of all files and bags, in their order.

    Raises:
        CloudError: a file or bag cannot be read or has no such cloud.
    """
    for file in files:
        if is_bag(file):
            topic, numbers = _chosen_messages(file, options)
            for number, cloud in enumerate(read_bag_clouds(file, topic)):
                if number in numbers:
                    yield _prepared(_of_bag(file, number, cloud, options), options)
                if number + 1 >= numbers.stop:
                    break
        else:
            cloud_file = read_cloud_file(file)
            pose, viewpoint = _given_pose(options)
            points = cloud_file.points if pose is None else transform_points(pose, cloud_file.points)
            yield _prepared(CloudInput(file, points, cloud_file.colors, None, viewpoint), options)


def _chosen_messages(bag: Path, options: InputOptions) -> tuple[str, range]:
    """The topic, and the numbers of its messages that are wanted."""
    topics = {name: count for name, count in cloud_topics(bag).items() if count}
    listed = ", ".join(f"{name} ({count})" for name, count in topics.items()) or "none"
    if options.topic is not None and options.topic not in topics:
        raise CloudError(f"the bag '{bag}' has no clouds on '{options.topic}'; its topics of clouds are: {listed}")
    if not topics:
        raise CloudError(f"the bag '{bag}' has no point clouds")
    if options.topic is None and len(topics) > 1:
        raise CloudError(f"the bag '{bag}' has clouds on several topics, choose one with --topic: {listed}")
    topic = options.topic or next(iter(topics))
    count = topics[topic]
    if options.all_messages:
        return topic, range(count)
    number = options.message or 0
    if number >= count:
        raise CloudError(f"the bag '{bag}' has {count} clouds on '{topic}', numbered from 0; got --message {number}")
    return topic, range(number, number + 1)


def _of_bag(file: Path, number: int, cloud: BagCloud, options: InputOptions) -> CloudInput:
    pose, viewpoint = _given_pose(options)
    frame: str | None = None
    in_camera_frame = cloud.frame_id.endswith("optical_frame")
    warning = ""
    if pose is None:
        pose, frame = cloud.T_root_cloud, cloud.root_frame
        if pose is not None and in_camera_frame:
            viewpoint = viewpoint or _position(pose)
        elif pose is None and in_camera_frame:
            warning = (
                f"the cloud is in the frame '{cloud.frame_id}' and the bag has no transform of it: z is taken as up, "
                "which it is not in a camera's frame; give --sensor-pose"
            )
    points = cloud.points if pose is None else transform_points(pose, cloud.points)
    return CloudInput(file, points, cloud.colors, frame, viewpoint, cloud.topic, number, cloud.stamp_ns, warning)


def _given_pose(options: InputOptions) -> tuple[Array | None, tuple[float, float, float] | None]:
    """The pose of the cloud's frame and the camera's position, as far as the options give them."""
    if options.sensor_pose is None:
        return None, options.viewpoint
    if not np.isfinite(options.sensor_pose).all():
        raise InvalidInputError(f"--sensor-pose must be six finite numbers, got {options.sensor_pose}")
    pose = pose_matrix(options.sensor_pose[:3], options.sensor_pose[3:])
    return pose, options.viewpoint or _position(pose)


def _position(pose: Array) -> tuple[float, float, float]:
    x, y, z = pose[:3, 3].tolist()
    return x, y, z


def _prepared(cloud: CloudInput, options: InputOptions) -> CloudInput:
    if options.crop is None:
        return cloud
    inside = options.crop.contains(cloud.points)
    return replace(cloud, points=cloud.points[inside], colors=None if cloud.colors is None else cloud.colors[inside])
