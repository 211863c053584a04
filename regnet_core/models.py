"""The models by name: the trained networks, the baselines, and a network of one's own by the path of its weights.

What a file of weights is of, REGNet or a learned baseline, is said in the file and not by its name.

torch is imported when a network is asked for and not before: nothing else has to wait for it.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from regnet_core.baselines import LEARNED
from regnet_core.baselines.antipodal import AntipodalSampler
from regnet_core.baselines.random_sampler import RandomSampler
from regnet_core.errors import ModelError
from regnet_core.proposer import Proposer
from regnet_core.weights import SUFFIX, WeightsFile, network_names, weights_file

DEFAULT_MODEL = "regnetv2-s"
_BASELINES: dict[str, Callable[[], Proposer]] = {
    AntipodalSampler.name: AntipodalSampler,
    RandomSampler.name: RandomSampler,
}
_NETWORKS_KEPT = 4
"""So many networks stay loaded, those used last."""
_loading = threading.Lock()


class LoadedModel(NamedTuple):
    """A model that is ready to run."""

    proposer: Proposer
    device: str
    """Where it runs: "cpu" or "cuda:N"."""


def available_models() -> tuple[str, ...]:
    """The names that ``GraspDetector(model=...)`` takes: networks, the default first, then baselines; learned ones that
    have weights."""
    there = network_names()
    networks = sorted((name for name in there if name not in LEARNED), key=lambda name: name != DEFAULT_MODEL)
    return (*networks, *(name for name in LEARNED if name in there), *_BASELINES)


def is_weights_path(model: str) -> bool:
    """Whether a model is given by the path of its weights and not by its name."""
    return model.endswith(SUFFIX)


def load_model(model: str, device: str = "auto") -> LoadedModel:
    """Make a model ready; a network that was loaded before is not loaded again.

    Args:
        model: one of ``available_models()``, or the path of a network's weights (.safetensors).
        device: "auto", "cpu", "cuda" or "cuda:N"; baselines without weights run on the CPU only.

    Raises:
        ModelError: there is no such model or device, or its weights cannot be used.
    """
    if model in _BASELINES:
        if device not in ("auto", "cpu"):
            raise ModelError(f"model '{model}' runs on the device 'cpu' (or 'auto'), not on '{device}'")
        return LoadedModel(_BASELINES[model](), "cpu")
    if is_weights_path(model):
        return _load_network(WeightsFile(Path(model).expanduser().absolute()), device)
    if model not in network_names():
        there = ", ".join(available_models())
        raise ModelError(f"no model '{model}'; there are {there}, and any network by the path of its {SUFFIX}")
    return _load_network(weights_file(model), device)


def _load_network(file: WeightsFile, device: str) -> LoadedModel:
    if not file.path.is_file():
        raise ModelError(f"there are no weights at '{file.path}'")
    # Threads of OpenMP that spin while they wait make a detection up to 20 times slower where other processes want the
    # cores too. torch's OpenMP reads this when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        from regnet_core.nn.devices import resolve_device

        chosen, state = resolve_device(device), os.stat(file.path)
        with _loading:
            return LoadedModel(_network(file, (state.st_mtime_ns, state.st_size), chosen), chosen)
    except ImportError as error:
        if (error.name or "").startswith("regnet_core"):
            raise
        raise ModelError(_remedy(error)) from error


@lru_cache(_NETWORKS_KEPT)
def _network(file: WeightsFile, stamp: tuple[int, int], device: str) -> Proposer:
    """The network of a file; ``stamp`` tells a file from one that was there before."""
    from regnet_core.baselines.files import stored_name

    name = stored_name(file.path)
    try:
        return _baseline(file, name, device) if name in LEARNED else _regnet(file, device)
    except RuntimeError as error:
        raise ModelError(f"the network of '{file.path}' cannot be put on {device}: {error}") from error


def _baseline(file: WeightsFile, name: str, device: str) -> Proposer:
    from regnet_core.baselines.zoo import load_proposer

    return load_proposer(name, file.path, device, file.sha256)


def _regnet(file: WeightsFile, device: str) -> Proposer:
    from regnet_core.nn.files import load_network
    from regnet_core.nn.proposer import NetworkProposer

    network, _ = load_network(file.path, file.sha256)
    return NetworkProposer(network, device)


def _remedy(error: ImportError) -> str:
    if isinstance(error, ModuleNotFoundError):
        return f"networks need the package {error.name}: pip install torch safetensors"
    return f"networks need torch, which cannot be loaded here: {error}"
