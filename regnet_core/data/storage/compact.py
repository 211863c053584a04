"""Arrays as compact bytes: fixed-point numbers, safetensors for the layout, zstd for the size. Nothing is unpickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import zstandard
from safetensors import SafetensorError
from safetensors.numpy import load, save

from regnet_core.errors import InvalidInputError

_LEVEL = 6
Arrays = Mapping[str, npt.NDArray[Any]]


def pack(arrays: Arrays) -> bytes:
    """The arrays as zstd-compressed safetensors; the same arrays give the same bytes."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return zstandard.ZstdCompressor(level=_LEVEL).compress(save(contiguous))


def unpack(data: bytes, what: str) -> dict[str, npt.NDArray[Any]]:
    """What ``pack`` made of arrays.

    Raises:
        InvalidInputError: the bytes are damaged or something else; ``what`` names them in the message.
    """
    try:
        return dict(load(zstandard.ZstdDecompressor().decompress(data)))
    except (zstandard.ZstdError, SafetensorError) as error:
        raise InvalidInputError(f"{what} is not zstd-compressed safetensors: {error}") from error


def to_steps(values: npt.ArrayLike, step: float, dtype: type[np.integer[Any]]) -> npt.NDArray[Any]:
    """Numbers as whole multiples of ``step``.

    Raises:
        InvalidInputError: a number does not fit into the type.
    """
    steps = np.round(np.asarray(values, np.float64) / step)
    limits = np.iinfo(dtype)
    if steps.size and not (limits.min <= steps.min() and steps.max() <= limits.max):
        raise InvalidInputError(
            f"numbers must lie in [{limits.min * step:g}, {limits.max * step:g}] to be stored in steps of {step:g}, "
            f"got {steps.min() * step:g} to {steps.max() * step:g}"
        )
    return steps.astype(dtype)


def from_steps(steps: npt.NDArray[Any], step: float) -> npt.NDArray[np.float32]:
    """The numbers that ``to_steps`` rounded."""
    return steps.astype(np.float32) * np.float32(step)


def to_json(document: object) -> bytes:
    """Compact JSON with sorted keys; the same document gives the same bytes."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
