"""The models that are measured: trained ones, files of weights, and networks of the zoo with random weights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks.patching import replace, resolve
from regnet_core.errors import ModelError
from regnet_core.models import available_models, is_weights_path
from regnet_core.weights import network_names

UNTRAINED = "untrained:"
"""Before the name of a network that is wanted with random weights, although it has trained ones."""
Precision = Literal["int8", "bf16", "fp32"]
PRECISIONS: tuple[Precision, ...] = ("int8", "bf16", "fp32")
_CHOICE, _BF16 = "regnet_core.nn.precision:cpu_precision", "regnet_core.nn.precision:has_fast_bf16"


@dataclass(frozen=True)
class ModelChoice:
    """One model."""

    name: str
    """As tables show it; never a path."""
    model: str
    """What GraspDetector takes; empty for random weights, which have to be written to a file first."""
    weights: str
    """Which weights: trained, a file's, random ones from a seed, or none."""
    network: str
    """The network in the zoo whose weights are to be random; empty for others."""

    @property
    def is_network(self) -> bool:
        """Whether it has a precision."""
        return self.weights != "none"


def choose_model(text: str, seed: int = 0) -> ModelChoice:
    """A model by name: a trained one where there is one, else a network of the zoo with random weights.

    Args:
        text: a name, the path of a .safetensors file, or ``untrained:NAME``.
        seed: of random weights.

    Raises:
        ModelError: there is no such model.
    """
    if is_weights_path(text):
        return ModelChoice(Path(text).stem, text, "file", "")
    name = text.removeprefix(UNTRAINED)
    if text in available_models():
        return ModelChoice(text, text, "trained" if text in network_names() else "none", "")
    from regnet_core.nn.zoo import NETWORKS  # loads torch, which other models do without

    if name in NETWORKS:
        return ModelChoice(name, "", f"random, seed {seed}", name)
    there = ", ".join(dict.fromkeys([*available_models(), *NETWORKS]))
    raise ModelError(f"no model '{name}'; there are {there}, and any network by the path of its .safetensors")


def ready_model(choice: ModelChoice, folder: Path, seed: int = 0) -> str:
    """What GraspDetector and the detector node take for a model; random weights are written to a file.

    Args:
        choice: the model.
        folder: for random weights.
        seed: of them; the same seed gives the same weights.
    """
    if not choice.network:
        return choice.model
    import torch

    from regnet_core.nn.files import save_network
    from regnet_core.nn.network import RegNet
    from regnet_core.nn.zoo import network_config

    path = folder / f"{choice.network}-seed{seed}.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        save_network(path, RegNet(network_config(choice.network)).eval(), {"data": "none: random weights"})
    return str(path)


@contextmanager
def precision(wanted: Precision) -> Iterator[None]:
    """Make networks on the CPU compute in int8, bf16 or fp32, whatever this processor is better at.

    It must hold before a network is loaded, which may prepare its weights for one of them.

    Raises:
        StageError: the choice is no longer made where it was.
    """
    with ExitStack() as stack:
        replace(stack, resolve(_CHOICE), lambda: wanted)
        replace(stack, resolve(_BF16), lambda: wanted == "bf16")
        yield
