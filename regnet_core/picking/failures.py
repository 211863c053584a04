"""How a picking attempt ended: one object placed, or one of the four ways to fail that the paper tells apart.

The classes exclude each other and leave nothing out. The first that applies counts:

1. more than one object: two or more were lifted, or came to lie in the place bin;
2. gripper limit: the object between the fingers is wider there than the jaw was opened;
3. collision: the hand touched something hard, or pushed an object, before it closed;
4. more than one object: the two fingers closed on different objects, which were lost;
5. unstable: everything else, that is, missed, slipped, dropped on the way, or fallen beside the place bin.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

_TOLERANCE = 0.001
"""What is wider than the opening by less than this may have gone in [m]."""


class Failure(enum.Enum):
    """Why no single object was placed."""

    UNSTABLE = "unstable"
    """The object was missed, slipped, or was lost on the way."""
    COLLISION = "collision"
    """The hand touched something before it closed."""
    GRIPPER_LIMIT = "gripper limit"
    """The object is too wide for the opening."""
    SEVERAL = "more than one object"
    """The hand took several objects."""


@dataclass(frozen=True)
class Evidence:
    """What is known of an attempt once everything is at rest."""

    placed: tuple[int, ...]
    """The objects that came to lie in the place bin."""
    lifted: tuple[int, ...]
    """The objects that the hand had lifted."""
    gripped: tuple[tuple[int, ...], tuple[int, ...]]
    """The objects that each finger pressed on after closing."""
    opening: float
    """Distance between the finger pads before closing [m]."""
    closed_to: float
    """The same after closing [m], which may be a little below 0; NaN when the hand did not come to that."""
    blocked: bool = False
    """Whether a finger pressed on the table or a bin after closing."""
    contact: str | None = None
    """What the hand touched, or pushed, before it closed; None: nothing."""
    stopped: bool = False
    """Whether the approach was given up because of it."""
    lost: str | None = None
    """Where the hand lost all that it held; None: it did not."""
    between: int | None = None
    """The object that filled most of the space between the fingers before they closed, or stood in their way."""
    extent: float = math.nan
    """How wide that object is there, along the closing direction [m]."""


@dataclass(frozen=True)
class Verdict:
    """The judgement of an attempt."""

    failure: Failure | None
    """None: exactly one object was lifted and placed."""
    message: str
    """One sentence for people: what happened, to which object, with what number."""

    @property
    def success(self) -> bool:
        """Whether exactly one object was lifted and placed."""
        return self.failure is None


def judge(evidence: Evidence) -> Verdict:
    """Success, or the first class of failure that applies."""
    e = evidence
    moved = sorted({*e.lifted, *e.placed})
    if len(moved) > 1:
        return Verdict(Failure.SEVERAL, f"objects {_list(moved)} were taken together, {len(e.placed)} of them placed")
    if e.placed:
        touched = f", though {e.contact}" if e.contact else ""
        return Verdict(None, f"object {e.placed[0]} was placed, held {_metres(e.closed_to)} wide{touched}")
    if e.between is not None and e.extent > e.opening + _TOLERANCE:
        return Verdict(
            Failure.GRIPPER_LIMIT,
            f"object {e.between} is {e.extent:.3f} m wide along the closing direction, and the jaw was open by "
            f"{e.opening:.3f} m",
        )
    if e.contact:
        outcome = "the approach was given up" if e.stopped else _ending(e)
        return Verdict(Failure.COLLISION, f"{e.contact}; {outcome}")
    left, right = e.gripped
    if left and right and not set(left) & set(right):
        return Verdict(
            Failure.SEVERAL,
            f"the fingers closed to {_metres(e.closed_to)} on objects {_list(left)} and {_list(right)}; {_ending(e)}",
        )
    return Verdict(Failure.UNSTABLE, _ending(e))


def _ending(e: Evidence) -> str:
    """How an attempt without a placed object ended."""
    left, right = e.gripped
    wall = ", one against the table or a bin" if e.blocked else ""
    if not left and not right:
        return f"the fingers closed to {_metres(e.closed_to)} on no object{wall}"
    if not left or not right:
        return f"the fingers closed to {_metres(e.closed_to)}, only one of them on object {_list(left or right)}{wall}"
    held = f"object {_list(sorted({*left, *right}))}, gripped {_metres(e.closed_to)} wide, was"
    if e.lost:
        return f"{held} lost {e.lost}"
    if e.lifted:
        return f"{held} released and came to rest beside the place bin"
    return f"{held} not lifted"


def _list(objects: list[int] | tuple[int, ...]) -> str:
    return " and ".join(map(str, objects))


def _metres(opening: float) -> str:
    return f"{max(opening, 0.0):.3f} m"
