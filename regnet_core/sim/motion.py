"""Motions of the hand along a line that start and end at rest."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from regnet_core.geometry import Array


class Waypoint(NamedTuple):
    """Where the hand should be at one instant, in the grasp frame."""

    position: Array
    """(3,) [m]."""
    velocity: Array
    """(3,) [m/s]."""


def line(start: Array, end: Array, speed: float, timestep: float) -> Iterator[Waypoint]:
    """From start (3,) to end (3,) at a mean speed [m/s], the speed rising and falling as a parabola."""
    way = end - start
    duration = float(np.linalg.norm(way)) / speed
    steps = math.ceil(duration / timestep)
    for i in range(1, steps + 1):
        s = i / steps
        yield Waypoint(start + (3.0 - 2.0 * s) * s * s * way, 6.0 * s * (1.0 - s) / duration * way)


def shake(start: Array, amplitude: float, period: float, timestep: float) -> Iterator[Waypoint]:
    """To and fro once along each axis: start + amplitude (1 - cos(2 pi t / period)) / 2."""
    steps = math.ceil(period / timestep)
    for axis in np.eye(3):
        for i in range(1, steps + 1):
            phase = 2.0 * math.pi * i / steps
            offset = 0.5 * amplitude * (1.0 - math.cos(phase))
            rate = amplitude * math.pi / period * math.sin(phase)
            yield Waypoint(start + offset * axis, rate * axis)


def stay(position: Array, duration: float, timestep: float) -> Iterator[Waypoint]:
    """At one place for a time [s]."""
    for _ in range(round(duration / timestep)):
        yield Waypoint(position, np.zeros(3))
