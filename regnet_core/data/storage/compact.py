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
_LARGEST = 2**30
Arrays = Mapping[str, npt.NDArray[Any]]


def pack(arrays: Arrays) -> bytes:
    """The arrays as zstd-compressed safetensors; the same arrays give the same bytes."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return zstandard.ZstdCompressor(level=_LEVEL).compress(save(contiguous))


def unpack(
    data: bytes, what: str, shapes: Mapping[str, tuple[int | None, ...]] | None = None
) -> dict[str, npt.NDArray[Any]]:
    """What ``pack`` made of arrays.

    Args:
        data: the bytes.
        what: names them in error messages.
        shapes: the arrays that must be there, with their shapes; None stands for any length.

    Raises:
        InvalidInputError: the bytes are damaged, or hold something else.
    """
    try:
        if zstandard.frame_content_size(data) > _LARGEST:
            raise InvalidInputError(f"{what} would take more than {_LARGEST} bytes")
        arrays = dict(load(zstandard.ZstdDecompressor().decompress(data)))
    except (zstandard.ZstdError, SafetensorError) as error:
        raise InvalidInputError(f"{what} is not zstd-compressed safetensors: {error}") from error
    for name, shape in (shapes or {}).items():
        found = arrays[name].shape if name in arrays else None
        if (
            found is None
            or len(found) != len(shape)
            or any(b not in (None, a) for a, b in zip(found, shape, strict=True))
        ):
            raise InvalidInputError(f"{what} must hold {name} of shape {shape}, got {found}")
    return arrays


def _fits(found: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(found) == len(wanted) and all(b in (None, a) for a, b in zip(found, wanted, strict=True))


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
