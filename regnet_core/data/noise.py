"""The noise of a time-of-flight depth camera (Kinect v2).

Axial noise: Fankhauser, Bloesch, Rodriguez, Kaestner, Hutter, Siegwart, "Kinect v2 for mobile robot navigation:
evaluation and modeling", ICAR 2015:

    sigma_z [mm] = 1.5 - 0.5 z + 0.3 z^2 + 0.1 z^1.5 theta^2 / (pi/2 - theta)^2

with the depth z in metres and the angle of incidence theta. Lateral noise moves the ray inside its pixel's
neighbourhood, so that edges fray and slanted surfaces become rougher, as they do on the device. The other effects (loss
at grazing incidence and at depth edges, flying pixels between foreground and background, quantisation) are plausible
sizes for such devices, not measured ones; they are the fields of `DepthNoise`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DepthNoise:
    """Strength of each effect; the defaults are a Kinect v2's.

    Attributes:
        axial: factor on Fankhauser's sigma_z; 0 switches axial noise off.
        lateral: standard deviation of the ray's place in the image [pixel].
        quantum: step of the reported depth [m].
        near, far: range of reported depths [m].
        grazing: no return beyond this angle of incidence [rad].
        edge_step: a depth discontinuity larger than this is an edge [m].
            Lateral noise makes far, very slanted surfaces (a floor near the horizon) as ragged, so they thin out too.
        edge_loss: share of edge pixels without a return.
        edge_flying: share of edge pixels that float between foreground and background.
        dropout: share of all pixels without a return.
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


def axial_sigma(depth: NDArray[np.float64], incidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fankhauser's standard deviation of the depth [m], for depths [m] and angles of incidence [rad] of one shape."""
    theta = np.minimum(incidence, np.radians(88.0))
    slant = (theta / (0.5 * np.pi - theta)) ** 2
    return 1e-3 * (1.5 - 0.5 * depth + 0.3 * depth**2 + 0.1 * depth**1.5 * slant)


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
    edge = depth_edges(depth, noise.edge_step)
    chance = rng.uniform(size=depth.shape)
    result = depth + noise.axial * axial_sigma(depth, incidence) * rng.standard_normal(depth.shape)
    flying = edge & (chance > 1.0 - noise.edge_flying)
    behind = _farthest_neighbour(depth)
    result[flying] = (depth + rng.uniform(size=depth.shape) * (behind - depth))[flying]
    lost = (edge & (chance < noise.edge_loss)) | (incidence > noise.grazing)
    lost |= rng.uniform(size=depth.shape) < noise.dropout
    if noise.quantum > 0.0:
        result = noise.quantum * np.round(result / noise.quantum)
    with np.errstate(invalid="ignore"):
        lost |= ~((result >= noise.near) & (result <= noise.far))
    result[lost] = np.nan
    return result


def _farthest_neighbour(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest finite depth among each pixel and its four neighbours."""
    z = np.pad(np.where(np.isfinite(depth), depth, -np.inf), 1, constant_values=-np.inf)
    shifted = [z[1:-1, 1:-1], z[2:, 1:-1], z[:-2, 1:-1], z[1:-1, 2:], z[1:-1, :-2]]
    return np.max(shifted, axis=0)
