"""Checkpoints of a training run: one safetensors file with weights and optimiser, and the run's state as JSON in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from regnet_core.data.storage.tars import write_whole
from regnet_core.errors import InvalidInputError

_MODEL, _OPTIMISER, _STATE = "model.", "optimiser.", "state"


class Checkpoint(NamedTuple):
    """What a run goes on from."""

    model: dict[str, torch.Tensor]
    optimiser: dict[str, torch.Tensor]
    state: dict[str, Any]
    """Recipe, network, data, steps done: whatever JSON holds."""


def save_checkpoint(path: Path, model: nn.Module, optimiser: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all."""
    tensors = {_MODEL + name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()}
    for number, values in optimiser.state_dict()["state"].items():
        for name, value in values.items():
            tensors[f"{_OPTIMISER}{number}.{name}"] = torch.as_tensor(value).detach().cpu().contiguous()
    write_whole(path, save(tensors, {_STATE: json.dumps(state)}))


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        InvalidInputError: it is damaged, or something else.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            state = json.loads((file.metadata() or {})[_STATE])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise InvalidInputError(f"'{path}' is no checkpoint of a training run: {error!r}") from error
    return Checkpoint(_part(tensors, _MODEL), _part(tensors, _OPTIMISER), state)


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: dict[str, torch.Tensor]) -> None:
    """Give an optimiser of the same parameters the state that was saved."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        number, key = name.split(".", 1)
        state.setdefault(int(number), {})[key] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def _part(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
