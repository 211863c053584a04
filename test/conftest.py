"""What tests of every part of the project use."""

import os
from pathlib import Path

import pytest

# As the nodes do it, before any test imports torch.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@pytest.fixture(scope="session")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a fresh network `regnetv2-s`, which gives grasps, and bad ones."""
    import torch

    from regnet_core.nn.files import save_network
    from regnet_core.nn.network import RegNet
    from regnet_core.nn.zoo import network_config

    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_network(path, RegNet(network_config("regnetv2-s")).eval(), {"data": "none"})
    return path
