"""Colours of the pictures, red, green, blue in 0..1."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Plane

Rgb = npt.NDArray[np.float32]
"""(..., 3) in 0..1."""

SELECTED = np.array([0.10, 0.42, 1.00], np.float32)
"""The selected grasp."""
TABLE = np.array([0.80, 0.81, 0.83], np.float32)
"""Points of the support plane in a cloud without colours."""

_RANKS = np.array([[0.10, 0.66, 0.28], [0.62, 0.79, 0.18], [0.98, 0.78, 0.15], [0.95, 0.48, 0.14], [0.84, 0.16, 0.16]])
_HEIGHTS = np.array(
    [[0.33, 0.45, 0.66], [0.38, 0.60, 0.72], [0.60, 0.74, 0.74], [0.88, 0.80, 0.68], [0.93, 0.66, 0.52]]
)
_TABLE_HEIGHT = 0.008
_LOWEST_SPAN = 0.05
_FAR_ABOVE = 0.05
"""A cloud that starts this high above the plane does not show it [m]."""


def rank_colors(count: int) -> Rgb:
    """(count, 3): green for the first, over yellow, to red for the last."""
    return _ramp(_RANKS, np.linspace(0.0, 1.0, count) if count > 1 else np.zeros(count))


def height_colors(points: npt.NDArray[np.floating[Any]], plane: Plane | None) -> Rgb:
    """(N, 3): by height above the support plane, which is grey; above the lowest points when no plane is near them."""
    if len(points) == 0:
        return np.zeros((0, 3), np.float32)
    height = points[:, 2] if plane is None else plane.height(points)
    lowest = float(np.percentile(height, 2))
    on_plane = plane is not None and lowest < _FAR_ABOVE
    base = 0.0 if on_plane else lowest
    top = max(float(np.percentile(height, 99.8)) - base, _LOWEST_SPAN)
    colors = _ramp(_HEIGHTS, np.clip((height - base) / top, 0.0, 1.0))
    if on_plane:
        colors[height < _TABLE_HEIGHT] = TABLE
    return colors


def css(color: npt.NDArray[np.floating[Any]]) -> str:
    """The colour as a page's style sheet writes it."""
    red, green, blue = (int(v) for v in np.rint(np.clip(color, 0.0, 1.0) * 255.0))
    return f"rgb({red},{green},{blue})"


def _ramp(stops: npt.NDArray[np.float64], position: npt.NDArray[np.floating[Any]]) -> Rgb:
    at = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(position, at, stops[:, c]) for c in range(3)], axis=-1).astype(np.float32)
