"""Files of trained networks: safetensors in half precision, with the configuration and a model card's facts inside."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from regnet_core.data.storage.tars import write_whole
from regnet_core.errors import ModelError
from regnet_core.nn.network import RegNet
from regnet_core.nn.zoo import network_config

FORMAT = "regnet-weights/1"


def save_network(path: Path, network: RegNet, card: Mapping[str, Any]) -> str:
    """Write a network of nn/zoo.py; its sha256.

    Args:
        path: the file.
        network: whose configuration has a name.
        card: what it was trained on and how, its metrics and limits: whatever JSON holds.
    """
    tensors = {name: _half(value).contiguous() for name, value in network.state_dict().items()}
    facts = {"format": FORMAT, "network": network.config.name, "card": json.dumps(dict(card), sort_keys=True)}
    data = save(tensors, facts)
    write_whole(path, data)
    return hashlib.sha256(data).hexdigest()


def load_network(path: Path, sha256: str | None = None) -> tuple[RegNet, dict[str, Any]]:
    """A network, in evaluation mode and single precision, and its card.

    Args:
        path: a file that ``save_network`` wrote.
        sha256: what the file's must be, where it is known.

    Raises:
        ModelError: the file is missing, damaged, not the one expected, or of a network that this version does not have.
    """
    if not path.is_file():
        raise ModelError(f"there are no weights at '{path}'")
    try:
        if sha256 is not None and hashlib.sha256(path.read_bytes()).hexdigest() != sha256:
            raise ModelError(f"'{path}' is not the file that was published: its sha256 is not {sha256}")
        with safe_open(str(path), framework="pt") as file:
            facts = file.metadata() or {}
            tensors = {name: _whole(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118
        if facts.get("format") != FORMAT:
            raise ModelError(
                f"'{path}' holds no weights of a network: its format is {facts.get('format')!r}, not {FORMAT!r}"
            )
        network = _network_of(path, facts["network"], tensors)
        card: dict[str, Any] = json.loads(facts["card"])
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"'{path}' holds no weights of a network: {error}") from error
    return network.eval(), card


def _network_of(path: Path, name: str, tensors: Mapping[str, torch.Tensor]) -> RegNet:
    broken = [key for key, value in tensors.items() if not value.isfinite().all()]
    if broken:
        raise ModelError(f"'{path}' cannot be used: {broken[0]} holds numbers that are not finite")
    network = RegNet(network_config(name))
    try:
        network.load_state_dict(dict(tensors))
    except RuntimeError as error:
        first = str(error).splitlines()[1:2] or [str(error)]
        raise ModelError(
            f"'{path}' is of another version of the network '{name}' than this one: {first[0].strip()}"
        ) from error
    return network


def _half(value: torch.Tensor) -> torch.Tensor:
    return value.detach().cpu().half() if value.is_floating_point() else value.detach().cpu()


def _whole(value: torch.Tensor) -> torch.Tensor:
    return value.float() if value.is_floating_point() else value
