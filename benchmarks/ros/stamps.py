"""Stamps by which a result is matched with the cloud that it belongs to."""

from __future__ import annotations

import struct

from regnet_core.errors import InvalidInputError

_FIRST_SECOND = 1_000_000
"""A stamp of zero would be pointed out by the preprocessor."""
_STAMP = slice(4, 12)
"""Of a serialised message that begins with a header: after the four bytes that say how it is encoded."""


def with_stamp(message: bytes, number: int) -> bytes:
    """A serialised message (CDR) that begins with a std_msgs/Header, with a stamp made of a number.

    Raises:
        InvalidInputError: the message is not in plain CDR.
    """
    if len(message) < 12 or message[0] != 0 or message[1] not in (0, 1):
        raise InvalidInputError(f"a message in plain CDR begins with 0x00 0x00 or 0x00 0x01, got {message[:2]!r}")
    order = "<" if message[1] == 1 else ">"
    changed = bytearray(message)
    changed[_STAMP] = struct.pack(f"{order}iI", _FIRST_SECOND + number, 0)
    return bytes(changed)


def number_of(seconds: int) -> int:
    """The number that a stamp was made of."""
    return seconds - _FIRST_SECOND
