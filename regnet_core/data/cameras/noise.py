"""The noise of a depth camera: one model for time of flight, structured light and stereo.

`sensors.py` holds the numbers of three devices; the defaults here are the first of them, a Kinect v2. The steps:

1. Lateral noise moves each ray inside its pixel's neighbourhood (`lateral_offsets`, before the ray is cast), so that
   edges fray and slanted surfaces become rougher, as they do on a device.
2. Axial noise with the standard deviation of `AxialNoise`, which grows with the square of the depth and with the slant
   of the surface.
3. Depth edges: a share of their pixels has no return, a share floats between the foreground and the background (flying
   pixels), a share takes the foreground's depth (the fattened outlines of stereo).
4. Shadows: what the second eye (the projector of structured light, the other camera of stereo) cannot see is lost.
5. Pixels are lost at grazing angles of incidence, at random, and outside the range.
6. The depth is reported in steps: constant ones, or constant ones of the disparity, which grow with z^2.

A device that compares patches of the image (structured light, stereo) is wrong in the same way over a patch, so its
noise is correlated over a few pixels.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr

from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError


@dataclass(frozen=True)
class AxialNoise:
    """Standard deviation of the depth z [m] at the angle of incidence theta [rad], in millimetres:

        constant + linear z + quadratic z^2 + slant z^slant_power theta^2 / (pi/2 - theta)^2

    The defaults are a Kinect v2's: Fankhauser, Bloesch, Rodriguez, Kaestner, Hutter, Siegwart, "Kinect v2 for mobile
    robot navigation: evaluation and modeling", ICAR 2015.
    """

    constant: float = 1.5
    linear: float = -0.5
    quadratic: float = 0.3
    slant: float = 0.1
    slant_power: float = 1.5


@dataclass(frozen=True)
class DepthNoise:
    """Strength of each effect; the defaults are a Kinect v2's.

    Its axial noise is Fankhauser's; every other default is plausible for such a device, not measured.

    Attributes:
        axial: factor on the standard deviation of `axial_model`; 0 switches axial noise off.
        axial_model: the standard deviation of the depth.
        lateral: standard deviation of the ray's place in the image [pixel].
        correlation: radius over which axial noise, lateral noise and losses at edges are alike: the standard deviation
            of the Gaussian that smooths them [pixel]; 0 for independent pixels.
        quantum: step of the reported depth [m]; 0 for none.
        disparity: focal length times baseline, so that the disparity is this over z [pixel m]; 0 for a camera that
            does not triangulate. The second eye is on the right, so that shadows are on the left of things.
        disparity_step: step of the reported disparity [pixel]; 0 for none.
        near, far: range of reported depths [m].
        grazing: no return beyond this angle of incidence [rad].
        edge_step: a depth discontinuity larger than this is an edge [m].
            Lateral noise makes far, very slanted surfaces (a floor near the horizon) as ragged, so they thin out too.
        edge_width: an edge reaches this many pixels beyond those next to the discontinuity.
        edge_loss: share of edge pixels without a return.
        edge_flying: share of edge pixels that float between foreground and background.
        edge_bleeding: share of edge pixels that take the foreground's depth.
        dropout: share of all pixels without a return.

    Raises:
        InvalidInputError: a number is out of range.
    """

    axial: float = 1.0
    lateral: float = 0.35
    quantum: float = 0.001
    near: float = 0.5
    far: float = 4.5
    grazing: float = np.radians(80.0)
    edge_step: float = 0.015
    edge_loss: float = 0.35
    edge_flying: float = 0.08
    dropout: float = 0.001
    axial_model: AxialNoise = AxialNoise()
    correlation: float = 0.0
    disparity: float = 0.0
    disparity_step: float = 0.0
    edge_width: int = 0
    edge_bleeding: float = 0.0

    def __post_init__(self) -> None:
        for name in ("axial", "lateral", "correlation", "quantum", "disparity", "disparity_step", "near", "edge_width"):
            check_range(f"DepthNoise.{name}", getattr(self, name), 0.0)
        for name in ("edge_loss", "edge_flying", "edge_bleeding", "dropout"):
            check_range(f"DepthNoise.{name}", getattr(self, name), 0.0, 1.0)
        if self.near >= self.far:
            raise InvalidInputError(f"near must be less than far, got {self.near:g} and {self.far:g} m")
        if self._edge_share > 1.0 + 1e-9:
            raise InvalidInputError(
                f"edge_loss + edge_flying + edge_bleeding are shares of the same pixels, at most 1 together, "
                f"got {self._edge_share:g}"
            )
        if self.disparity_step > 0.0 and self.disparity == 0.0:
            raise InvalidInputError(
                f"disparity_step {self.disparity_step:g} needs disparity, the focal length times the baseline; got 0"
            )

    @property
    def reach(self) -> int:
        """Pixels beyond a window of the image that can matter inside it."""
        return int(np.ceil(3.0 * self.lateral)) + self.edge_width + 2

    @property
    def _edge_share(self) -> float:
        return self.edge_loss + self.edge_flying + self.edge_bleeding

    def scaled(self, factor: float) -> "DepthNoise":
        """The same device `factor` times as noisy: 0 without noise, 1 as it is, 2 twice as bad.

        Scales the axial and lateral noise, the steps, and the shares of lost, flying and bleeding pixels (as far as
        they stay shares). Range, grazing angle, shadows and the width of edges follow from how the device works: they
        stay.

        Raises:
            InvalidInputError: the factor is negative.
        """
        check_range("the factor of the noise", factor, 0.0)
        edge = min(factor, 1.0 / self._edge_share) if self._edge_share > 0.0 else 0.0
        return replace(
            self,
            axial=factor * self.axial,
            lateral=factor * self.lateral,
            quantum=factor * self.quantum,
            disparity_step=factor * self.disparity_step,
            edge_loss=edge * self.edge_loss,
            edge_flying=edge * self.edge_flying,
            edge_bleeding=edge * self.edge_bleeding,
            dropout=min(1.0, factor * self.dropout),
        )


def axial_sigma(
    depth: NDArray[np.float64], incidence: NDArray[np.float64], model: AxialNoise = AxialNoise()
) -> NDArray[np.float64]:
    """The model's standard deviation of the depth [m], for depths [m] and angles of incidence [rad] of one shape."""
    theta = np.minimum(incidence, np.radians(88.0))
    slant = (theta / (0.5 * np.pi - theta)) ** 2
    flat = model.constant + model.linear * depth + model.quadratic * depth**2
    return 1e-3 * (flat + model.slant * depth**model.slant_power * slant)


def depth_edges(depth: NDArray[np.float64], step: float) -> NDArray[np.bool_]:
    """Pixels (H, W) next to a depth discontinuity of more than `step` [m].

    The inverse depth of a plane is linear in the image, however slanted the plane is, so its second difference tells a
    step from a slope. NaN counts as infinitely far.
    """
    z = np.where(np.isfinite(depth), depth, np.inf)
    inverse = 1.0 / z
    jump = np.zeros(depth.shape)
    jump[1:-1] = np.abs(inverse[2:] + inverse[:-2] - 2.0 * inverse[1:-1])
    jump[:, 1:-1] = np.maximum(jump[:, 1:-1], np.abs(inverse[:, 2:] + inverse[:, :-2] - 2.0 * inverse[:, 1:-1]))
    return np.isfinite(depth) & (jump * np.where(np.isfinite(depth), depth, 0.0) ** 2 > step)


def shadows(depth: NDArray[np.float64], disparity: float) -> NDArray[np.bool_]:
    """Pixels (H, W) whose surface the second eye, on the right, cannot see for something nearer to the right of it.

    A pixel in column u is in column u - disparity / z of the second eye's image. What is visible to both keeps its
    order along the row; a pixel that falls behind one to its right is hidden.

    Args:
        depth: true depth [m], NaN where the ray hits nothing.
        disparity: focal length times baseline [pixel m].
    """
    column = np.arange(depth.shape[1], dtype=np.float64)
    other = column - np.where(np.isfinite(depth), disparity / depth, 0.0)
    leftmost = np.full(depth.shape, np.inf)
    leftmost[:, :-1] = np.minimum.accumulate(other[:, :0:-1], axis=1)[:, ::-1]
    # Half a pixel: rays that lateral noise moved are out of order without hiding anything.
    return other > leftmost + 0.5


def lateral_offsets(shape: tuple[int, int], noise: DepthNoise, rng: np.random.Generator) -> NDArray[np.float64]:
    """(H, W, 2) by how much each ray misses its pixel's centre, column and row [pixel]."""
    return noise.lateral * _normal((*shape, 2), noise.correlation, rng)


def add_depth_noise(
    depth: NDArray[np.float64], incidence: NDArray[np.float64], noise: DepthNoise, rng: np.random.Generator
) -> NDArray[np.float64]:
    """The depth image (H, W) [m] that a camera would report; NaN where there is no return.

    Args:
        depth: true depth [m], NaN where the ray hits nothing.
        incidence: angle between the ray and the surface's normal [rad].
        noise: strengths.
        rng: source of every random number.
    """
    return noisy_depth(depth, incidence, noise, rng).depth


class NoisyDepth(NamedTuple):
    """A depth image with noise."""

    depth: NDArray[np.float64]
    """(H, W) [m]; NaN where there is no return."""
    bled: NDArray[np.int64]
    """(B,) flat indices of the pixels that show the depth of a nearer surface beside them."""
    source: NDArray[np.int64]
    """(B,) flat indices of pixels of that surface."""


def noisy_depth(
    depth: NDArray[np.float64], incidence: NDArray[np.float64], noise: DepthNoise, rng: np.random.Generator
) -> NoisyDepth:
    """As `add_depth_noise`, and where foreground bled into the background."""
    edge = _widened(depth_edges(depth, noise.edge_step), noise.edge_width)
    chance = _uniform(depth.shape, noise.correlation, rng)
    sigma = axial_sigma(depth, incidence, noise.axial_model)
    result = depth + noise.axial * sigma * _normal(depth.shape, noise.correlation, rng)
    front, behind = _neighbourhood(depth, noise.edge_width)
    flying = edge & (chance > 1.0 - noise.edge_flying)
    result[flying] = (front + rng.uniform(size=depth.shape) * (behind - front))[flying]
    bleeding = edge & (chance >= noise.edge_loss) & (chance < noise.edge_loss + noise.edge_bleeding)
    result[bleeding] += (front - depth)[bleeding]
    lost = (edge & (chance < noise.edge_loss)) | (incidence > noise.grazing)
    lost |= rng.uniform(size=depth.shape) < noise.dropout
    if noise.disparity > 0.0:
        lost |= shadows(depth, noise.disparity)
    result = quantised(result, noise)
    with np.errstate(invalid="ignore"):
        lost |= ~((result >= noise.near) & (result <= noise.far))
    result[lost] = np.nan
    bled = np.flatnonzero(bleeding & ~lost)
    return NoisyDepth(result, bled, _nearest_pixels(depth, bled, noise.edge_width))


def _nearest_pixels(depth: NDArray[np.float64], pixels: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """For pixels (B,) the pixel of the least depth within the reach that `_neighbourhood` has; flat indices."""
    offsets = np.arange(-width - 1, width + 2) if width > 0 else np.zeros(1, np.int64)
    if len(pixels) == 0:
        return pixels
    rows, columns = np.divmod(pixels, depth.shape[1])
    rows = np.clip(rows[:, None, None] + offsets[:, None], 0, depth.shape[0] - 1)
    columns = np.clip(columns[:, None, None] + offsets, 0, depth.shape[1] - 1)
    near = (rows * depth.shape[1] + columns).reshape(len(pixels), -1)
    z = np.where(np.isfinite(depth), depth, np.inf).ravel()[near]
    return near[np.arange(len(pixels)), z.argmin(axis=1)]


def quantised(depth: NDArray[np.float64], noise: DepthNoise) -> NDArray[np.float64]:
    """Depths [m] rounded to the steps that the camera reports, first those of the disparity."""
    if noise.disparity_step > 0.0:
        steps = np.round(noise.disparity / (noise.disparity_step * depth))
        with np.errstate(divide="ignore"):
            depth = noise.disparity / (noise.disparity_step * steps)
    if noise.quantum > 0.0:
        depth = noise.quantum * np.round(depth / noise.quantum)
    return depth


def _normal(shape: tuple[int, ...], correlation: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Standard normal numbers of shape (H, W, ...), smoothed over the image; still of variance 1."""
    if correlation == 0.0:
        return rng.standard_normal(shape)
    white = rng.standard_normal(shape, dtype=np.float32)  # half the time of float64
    reach = int(np.ceil(3.0 * correlation))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / correlation) ** 2)
    kernel /= np.linalg.norm(kernel)
    rows = ndimage.correlate1d(white, kernel, axis=0, mode="wrap")
    return np.asarray(ndimage.correlate1d(rows, kernel, axis=1, mode="wrap"))


def _uniform(shape: tuple[int, ...], correlation: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Numbers uniform in [0, 1), of shape (H, W), as correlated as those of `_normal`."""
    if correlation == 0.0:
        return rng.uniform(size=shape)
    return np.asarray(ndtr(_normal(shape, correlation, rng)))


def _widened(mask: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """The mask (H, W) and every pixel up to `width` rows and columns from it."""
    return mask if width == 0 else np.asarray(ndimage.maximum_filter(mask, size=2 * width + 1, mode="nearest"))


def _neighbourhood(depth: NDArray[np.float64], width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depths between which the pixels (H, W) of an edge fly: the pixel's own and the farthest of its four neighbours'
    for a thin edge, the nearest and the farthest within reach for a wide one."""
    if width == 0:
        return depth, _farthest_neighbour(depth)
    size = 2 * width + 3
    nearest = ndimage.minimum_filter(np.where(np.isfinite(depth), depth, np.inf), size=size, mode="nearest")
    farthest = ndimage.maximum_filter(np.where(np.isfinite(depth), depth, -np.inf), size=size, mode="nearest")
    return np.where(np.isfinite(nearest), nearest, depth), np.where(np.isfinite(farthest), farthest, depth)


def _farthest_neighbour(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest finite depth among each pixel and its four neighbours."""
    z = np.pad(np.where(np.isfinite(depth), depth, -np.inf), 1, constant_values=-np.inf)
    shifted = [z[1:-1, 1:-1], z[2:, 1:-1], z[:-2, 1:-1], z[1:-1, 2:], z[1:-1, :-2]]
    return np.max(shifted, axis=0)
