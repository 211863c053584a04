"""The learned baselines by name: network, how it detects, and how it is trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from torch import nn

from regnet_core.baselines.classification import ClassifierProposer
from regnet_core.baselines.files import load_weights
from regnet_core.baselines.gpd import GpdNetwork
from regnet_core.baselines.pointnetgpd import PointNetGpd
from regnet_core.baselines.s4g import S4gNetwork
from regnet_core.baselines.s4g_proposer import S4gProposer
from regnet_core.errors import ModelError
from regnet_core.proposer import Proposer


@dataclass(frozen=True)
class Method:
    """A learned baseline."""

    network: Callable[[], nn.Module]
    """Makes its network, with random weights."""
    proposer: Callable[[Any, str], Proposer]
    """Makes the method of ``GraspDetector`` from the network and the device."""
    steps: int
    """Batches of its usual training run."""
    batch: int
    learning_rate: float


METHODS: dict[str, Method] = {
    "gpd-3": Method(partial(GpdNetwork, 3), ClassifierProposer, 4000, 64, 1e-3),
    "gpd-12": Method(partial(GpdNetwork, 12), ClassifierProposer, 4000, 64, 1e-3),
    "pointnetgpd": Method(PointNetGpd, ClassifierProposer, 4000, 64, 1e-3),
    "s4g": Method(S4gNetwork, S4gProposer, 1500, 4, 2e-3),
}


def method(name: str) -> Method:
    """The method of that name.

    Raises:
        ModelError: there is none.
    """
    if name not in METHODS:
        raise ModelError(f"no learned baseline '{name}'; there are {', '.join(METHODS)}")
    return METHODS[name]


def load_proposer(name: str, path: Path, device: str, sha256: str | None = None) -> Proposer:
    """A trained method, ready to detect.

    Args:
        name: of the method.
        path: of its weights.
        device: where it runs.
        sha256: what the file's must be, where it is known.

    Raises:
        ModelError: there is no such method, or its weights cannot be used.
    """
    chosen = method(name)
    network = chosen.network()
    load_weights(path, name, network, sha256)
    return chosen.proposer(network, device)
