"""Training on several GPUs or machines under torchrun: every process takes its part of each batch.

The gradients are averaged by hand rather than by ``DistributedDataParallel``, whose hooks are tied to one ``forward``,
while training calls the stages one by one.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
from torch import distributed, nn

from regnet_core.errors import InvalidInputError


@dataclass(frozen=True)
class Group:
    """The processes of a run; a single one unless torchrun started more."""

    rank: int = 0
    """Number of this process."""
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes files and reports."""
        return self.rank == 0

    def part_of(self, batch: int) -> slice:
        """This process's part of a batch.

        Raises:
            InvalidInputError: the batch cannot be divided evenly.
        """
        if batch % self.size:
            raise InvalidInputError(f"a batch of {batch} views cannot be shared evenly by {self.size} processes")
        each = batch // self.size
        return slice(self.rank * each, (self.rank + 1) * each)

    def average_gradients(self, network: nn.Module) -> None:
        """Every process gets the mean of all processes' gradients."""
        if self.size > 1:
            self._average([p.grad for p in network.parameters() if p.grad is not None])

    def average_statistics(self, network: nn.Module) -> None:
        """Every process gets the mean of all processes' running means and variances."""
        if self.size > 1:
            self._average([buffer for buffer in network.buffers() if buffer.is_floating_point()])

    def any(self, here: bool) -> bool:
        """Whether it is so in any of the processes."""
        if self.size == 1:
            return here
        flag = torch.tensor([float(here)], device=_device())
        distributed.all_reduce(flag, distributed.ReduceOp.MAX)
        return bool(flag.item())

    def _average(self, tensors: list[torch.Tensor]) -> None:
        joined = torch.cat([tensor.flatten() for tensor in tensors])
        distributed.all_reduce(joined)
        parts = (joined / self.size).split([tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))


def join_group(device: str) -> tuple[Group, str]:
    """The group that torchrun made, if it did, and the device of this process: "cuda" becomes a GPU of its own."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        return Group(), device
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
        torch.cuda.set_device(device)
    if not distributed.is_initialized():
        distributed.init_process_group("nccl" if on_gpu else "gloo")
    return Group(distributed.get_rank(), size), device


def leave_group() -> None:
    """End what ``join_group`` began."""
    if distributed.is_initialized():
        distributed.destroy_process_group()


def _device() -> str:
    return "cuda" if distributed.get_backend() == "nccl" else "cpu"
