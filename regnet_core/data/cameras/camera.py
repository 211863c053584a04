"""Depth cameras: intrinsics and poses.

Frames are ROS's: the optical frame has x to the right of the image, y down and z forward; the world has z up.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box


class Window(NamedTuple):
    """A rectangle of whole pixels."""

    left: int
    """First column."""
    top: int
    """First row."""
    width: int
    """Columns; 0 when the window is empty."""
    height: int
    """Rows; 0 when the window is empty."""

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns, to index an image."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion.

    Attributes:
        width, height: image size [pixel].
        fx, fy: focal lengths [pixel].
        cx, cy: principal point; the centre of the first pixel is (0, 0).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def matrix(self) -> NDArray[np.float64]:
        """K, (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pixels(self) -> NDArray[np.float64]:
        """(height, width, 2) column and row of each pixel's centre."""
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([columns, rows], axis=-1).astype(np.float64)

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 3) directions in the optical frame with z = 1, through pixels (..., 2)."""
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def cropped(self, window: Window) -> "Intrinsics":
        """The camera whose whole image is the window of this one's."""
        return Intrinsics(window.width, window.height, self.fx, self.fy, self.cx - window.left, self.cy - window.top)


KINECT_V2 = Intrinsics(512, 424, 365.5, 365.5, 255.5, 211.5)
"""Microsoft Kinect v2 depth camera, nominal (70 x 60 degrees)."""
KINECT_V1 = Intrinsics(640, 480, 580.0, 580.0, 319.5, 239.5)
"""Microsoft Kinect v1 depth camera, nominal (58 x 45 degrees)."""
REALSENSE_D435 = Intrinsics(640, 480, 385.0, 385.0, 319.5, 239.5)
"""Intel RealSense D435 depth stream at 640 x 480, nominal."""


_NEAREST = 0.01
"""A point must be this far in front of the camera to have a place in its image [m]."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera at a place.

    Attributes:
        intrinsics: of the depth image.
        T_world_camera: (4, 4) pose of the optical frame in the world [m].
    """

    intrinsics: Intrinsics
    T_world_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        T = np.asarray(self.T_world_camera, dtype=np.float64)
        if T.shape != (4, 4) or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6):
            raise InvalidInputError(f"T_world_camera is a (4, 4) rigid transform, got {T.tolist()}")
        object.__setattr__(self, "T_world_camera", T)

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) optical centre in the world [m]."""
        return self.T_world_camera[:3, 3]

    @property
    def forward(self) -> NDArray[np.float64]:
        """(3,) unit viewing direction in the world."""
        return self.T_world_camera[:3, 2]

    def window(self, box: Box, margin: int = 0) -> Window:
        """The smallest window of the image that shows a box in the world, `margin` pixels wider on each side.

        The whole image when a part of the box is beside or behind the camera.
        """
        intrinsics = self.intrinsics
        corners = (box.corners() - self.position) @ self.T_world_camera[:3, :3]  # (8, 3) in the optical frame
        if corners[:, 2].min() < _NEAREST:
            return Window(0, 0, intrinsics.width, intrinsics.height)
        pixels = corners @ intrinsics.matrix.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        size = np.array([intrinsics.width, intrinsics.height])
        first = np.clip(np.floor(pixels.min(axis=0)).astype(int) - margin, 0, size)
        end = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + margin + 1, first, size)
        return Window(*(int(value) for value in (*first, *(end - first))))


def from_euler(euler: ArrayLike, position: ArrayLike) -> NDArray[np.float64]:
    """T_world_camera (4, 4) from the angles of a graphics camera, which looks along its own -z with y up.

    Args:
        euler: (3,) rotations about the fixed world axes x, then y, then z [rad].
        position: (3,) in the world [m].
    """
    T = np.eye(4)
    graphics = Rotation.from_euler("xyz", np.asarray(euler, dtype=np.float64)).as_matrix()
    T[:3, :3] = graphics @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = position
    return T


def look_at(position: ArrayLike, target: ArrayLike) -> NDArray[np.float64]:
    """T_world_camera (4, 4) of a camera held level at `position`, with `target` in the middle of its image [m].

    Raises:
        InvalidInputError: the target is straight above or below, so that "level" has no meaning.
    """
    eye, aim = np.asarray(position, dtype=np.float64), np.asarray(target, dtype=np.float64)
    forward = aim - eye
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:
        raise InvalidInputError(f"a level camera cannot look straight up or down, from {eye} to {aim}")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T


PAPER_POSES: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((0.0, 0.6454, 0.0), (0.8, 0.0, 1.7)),
    # Printed as -0.2221, which only sees the table when read in units of pi.
    ((0.0, -0.2221 * np.pi, 0.0), (-0.8, 0.0, 1.6)),
    ((0.0, 0.6444, 1.5708), (0.0, 0.75, 1.7)),
    ((0.0, 0.7500, -1.5708), (0.0, -0.75, 1.6)),
)
"""Euler angles [rad] and positions [m] of the four cameras in REGNet V2's data section. Read as a graphics camera's
(`from_euler`), all four look at the middle of a table 0.75 m high, from its four sides."""


def paper_cameras(intrinsics: Intrinsics = KINECT_V2) -> tuple[Camera, ...]:
    """The paper's four cameras."""
    return tuple(Camera(intrinsics, from_euler(euler, position)) for euler, position in PAPER_POSES)
