"""The constants of a simulated grasp: the physics, the hand's drive, its motion, and what counts as what."""

from __future__ import annotations

from dataclasses import dataclass

from regnet_core.checks import check_range


@dataclass(frozen=True)
class SimConfig:
    """How a grasp is tried and judged.

    Attributes:
        timestep: of the physics [s].
        impratio: how much stiffer friction is than the normal direction of a contact; high values end creep.
        grip_force: the force with which each finger presses at most [N].
        pad_friction: sliding friction of the fingers against anything, whatever its own friction: rubber.
        pad_torsion: torsional friction of one pad's contacts as a length: torque per normal force [m]. A round patch of
            radius a gives 2/3 pad_friction a.
        pad_time: time constant of the pads' contacts [s]. At 0.005 s and 30 N a pad yields by 0.05 mm to an object of
            0.3 kg and by 0.5 mm to one of 10 g. What slides along a much harder pad makes it chatter.
        pre_grasp_distance: the hand starts this far behind the grasp, along its approach [m].
        approach_speed: mean speed of the approach [m/s].
        closing_speed: rate at which the opening shrinks [m/s].
        lift_height: how far the hand is lifted [m].
        lift_speed: mean speed of the lift [m/s].
        shake_amplitude: how far the lifted hand is moved to and fro, once along each of its axes [m].
        shake_period: time of one such movement [s].
        hold_time: time of the last phase, in which the hand stands still [s].
        contact_force: touching with more than this before closing is a collision [N].
        push_distance: an object that is pushed further than this before closing was collided with [m].
        push_angle: an object that is turned further than this before closing was collided with [rad].
        creep_distance: an object that moves further than this in the hand during the last phase is slipping [m].
    """

    timestep: float = 0.001
    impratio: float = 100.0
    grip_force: float = 30.0
    pad_friction: float = 0.8
    pad_torsion: float = 0.0025
    pad_time: float = 0.005
    pre_grasp_distance: float = 0.1
    approach_speed: float = 0.2
    closing_speed: float = 0.2
    lift_height: float = 0.2
    lift_speed: float = 0.2
    shake_amplitude: float = 0.02
    shake_period: float = 0.35
    hold_time: float = 0.3
    contact_force: float = 5.0
    push_distance: float = 0.005
    push_angle: float = 0.1
    creep_distance: float = 0.002

    def __post_init__(self) -> None:
        """Check every constant.

        Raises:
            InvalidInputError: one is not a number inside its range.
        """
        for name, (low, high, unit) in _RANGES.items():
            check_range(name, getattr(self, name), low, high, unit)


_RANGES = {
    "timestep": (1e-4, 0.004, "s"),
    "impratio": (1.0, 1000.0, ""),
    "grip_force": (0.1, 1000.0, "N"),
    "pad_friction": (0.0, 5.0, ""),
    "pad_torsion": (0.0, 0.1, "m"),
    "pad_time": (0.002, 0.1, "s"),
    "pre_grasp_distance": (0.0, 1.0, "m"),
    "approach_speed": (0.01, 2.0, "m/s"),
    "closing_speed": (0.01, 2.0, "m/s"),
    "lift_height": (0.02, 2.0, "m"),
    "lift_speed": (0.01, 2.0, "m/s"),
    "shake_amplitude": (0.0, 0.2, "m"),
    "shake_period": (0.05, 10.0, "s"),
    "hold_time": (0.0, 1000.0, "s"),
    "contact_force": (0.0, 1000.0, "N"),
    "push_distance": (0.0, 1.0, "m"),
    "push_angle": (0.0, 3.2, "rad"),
    "creep_distance": (0.0, 1.0, "m"),
}
