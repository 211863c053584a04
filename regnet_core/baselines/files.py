"""Files of trained baselines: as those of the networks (nn/files.py), safetensors in half precision with a card inside.

They name their method where the others name their network, so that any weights are told by what is in the file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from regnet_core.data.storage.tars import write_whole
from regnet_core.errors import ModelError
from regnet_core.nn.files import FORMAT


def stored_name(path: Path) -> str | None:
    """The name of the network or method whose weights a file holds; None where it holds none."""
    try:
        with safe_open(str(path), framework="pt") as file:
            facts = file.metadata() or {}
    except (SafetensorError, OSError):
        return None
    return facts.get("network") if facts.get("format") == FORMAT else None


def save_weights(path: Path, name: str, network: nn.Module, card: Mapping[str, Any]) -> str:
    """Write the weights of the method of that name; their sha256.

    Args:
        path: the file.
        name: of the method.
        network: its network.
        card: what it was trained on and how: whatever JSON holds.
    """
    tensors = {key: _half(value) for key, value in network.state_dict().items()}
    facts = {"format": FORMAT, "network": name, "card": json.dumps(dict(card), sort_keys=True)}
    data = save(tensors, facts)
    write_whole(path, data)
    return hashlib.sha256(data).hexdigest()


def load_weights(path: Path, name: str, network: nn.Module, sha256: str | None = None) -> dict[str, Any]:
    """Fill a network with stored weights, in single precision, and put it in evaluation mode; the card.

    Args:
        path: a file that ``save_weights`` wrote.
        name: of the method that it must be of.
        network: of that method.
        sha256: what the file's must be, where it is known.

    Raises:
        ModelError: the file is missing, damaged, not the one expected, or of another method or version.
    """
    if not path.is_file():
        raise ModelError(f"there are no weights at '{path}'")
    if sha256 is not None and hashlib.sha256(path.read_bytes()).hexdigest() != sha256:
        raise ModelError(f"'{path}' is not the file that was published: its sha256 is not {sha256}")
    there = stored_name(path)
    if there != name:
        raise ModelError(f"'{path}' holds no weights of '{name}'" + (f" but of '{there}'" if there else ""))
    try:
        with safe_open(str(path), framework="pt") as file:
            card: dict[str, Any] = json.loads((file.metadata() or {})["card"])
            tensors = {key: _whole(file.get_tensor(key)) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise ModelError(f"'{path}' holds no weights of '{name}': {error}") from error
    broken = [key for key, value in tensors.items() if not value.isfinite().all()]
    if broken:
        raise ModelError(f"'{path}' cannot be used: {broken[0]} holds numbers that are not finite")
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        first = str(error).splitlines()[1:2] or [str(error)]
        raise ModelError(f"'{path}' is of another version of '{name}' than this one: {first[0].strip()}") from error
    network.eval()
    return card


def _half(value: torch.Tensor) -> torch.Tensor:
    value = value.detach().cpu()
    return (value.half() if value.is_floating_point() else value).contiguous()


def _whole(value: torch.Tensor) -> torch.Tensor:
    return value.float() if value.is_floating_point() else value
