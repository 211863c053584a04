"""Training by several processes: each has its part of the batch, and all end with the same network."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from regnet_core.errors import InvalidInputError
from regnet_core.training.distributed import Group, join_group

AVERAGES = """
import sys
import torch
from regnet_core.training.distributed import join_group, leave_group

group, device = join_group("cpu")
torch.manual_seed(group.rank)
layer = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))
layer(torch.randn(8, 3)).square().sum().backward()
own = [p.grad.clone() for p in layer.parameters()], layer[1].running_mean.clone()
group.average_gradients(layer)
group.average_statistics(layer)
averaged = [p.grad for p in layer.parameters()], layer[1].running_mean
torch.save((own, averaged, group.any(group.rank == 1), group.any(False)), f"{sys.argv[1]}/{group.rank}.pt")
leave_group()
"""


def test_a_batch_is_shared_evenly() -> None:
    parts = [Group(rank, 3).part_of(6) for rank in range(3)]
    assert [list(range(6))[part] for part in parts] == [[0, 1], [2, 3], [4, 5]]
    with pytest.raises(InvalidInputError, match="batch of 5 views cannot be shared evenly by 2"):
        Group(0, 2).part_of(5)


def test_without_torchrun_a_process_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert join_group("cpu") == (Group(), "cpu")
    assert Group().any(True) and not Group().any(False)


def test_processes_average_gradients_and_statistics(tmp_path: Path) -> None:
    script = tmp_path / "averages.py"
    script.write_text(AVERAGES)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    subprocess.run([*command, str(script), str(tmp_path)], check=True, timeout=120, capture_output=True)
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    for k, (one, other) in enumerate(zip(first[0][0], second[0][0], strict=True)):
        assert not torch.equal(one, other)
        for averaged in (first[1][0][k], second[1][0][k]):
            torch.testing.assert_close(averaged, (one + other) / 2)
    torch.testing.assert_close(first[1][1], (first[0][1] + second[0][1]) / 2)
    assert first[2] and second[2] and not first[3] and not second[3]
