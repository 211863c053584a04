"""Augmentation of a sample: the scene turned, "up" a little wrong, points moved and lost. The labels go along."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch.utils.data import Dataset

from regnet_core.data.dataset import PIVOT, GraspDataset, GraspSample
from regnet_core.nn.anchors import Pose
from regnet_core.training.recipe import Augmentation


def augment(sample: GraspSample, config: Augmentation, generator: torch.Generator) -> GraspSample:
    """The sample changed at random; everything in it stays consistent, and rotations stay in canonical form."""
    turn = _turn(config, generator)
    points = _moved(sample.points, turn)
    points = points + config.jitter * torch.randn(points.shape, generator=generator)
    rotation, contacts = _canonical(turn @ sample.rotation, sample.contacts)
    changed = dataclasses.replace(
        sample,
        points=points,
        viewpoint=_moved(sample.viewpoint, turn),
        turn=turn @ sample.turn,
        translation=_moved(sample.translation, turn),
        rotation=rotation,
        contacts=contacts,
        entry_point=_moved(sample.entry_point, turn),
    )
    return _with_losses(changed, config.dropout, generator)


class AugmentedDataset(Dataset[GraspSample]):
    """A data set whose samples are augmented, by the seed, the epoch and the sample's number alone."""

    def __init__(self, dataset: GraspDataset, config: Augmentation, seed: int) -> None:
        self.dataset = dataset
        self._config = config
        self._seed = seed
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Other changes from now on."""
        self._epoch = epoch
        self.dataset.set_epoch(epoch)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, number: int) -> GraspSample:
        mixed = (self._seed * 1_000_003 + self._epoch) * 1_000_003 + number
        generator = torch.Generator().manual_seed(mixed % 2**63)
        return augment(self.dataset[number], self._config, generator)


def unturned(pose: Pose, turn: torch.Tensor) -> Pose:
    """Grasps (..., 3, 3), (..., 3) of a sample turned by (3, 3), in the world as it was; in double precision."""
    back = turn.double().T
    pivot = back.new_tensor(PIVOT)
    return Pose(back @ pose.rotation.double(), (pose.translation.double() - pivot) @ back.T + pivot)


def _turn(config: Augmentation, generator: torch.Generator) -> torch.Tensor:
    """(3, 3): a turn about z, then a small one about a level axis."""
    angle, axis = (float(v) * 2.0 * math.pi for v in torch.rand(2, generator=generator))
    tilt = config.tilt * float(torch.randn((), generator=generator))
    about_z = _rotation(torch.tensor([0.0, 0.0, 1.0]), angle if config.rotation else 0.0)
    return _rotation(torch.tensor([math.cos(axis), math.sin(axis), 0.0]), tilt) @ about_z


def _rotation(axis: torch.Tensor, angle: float) -> torch.Tensor:
    """(3, 3) by the angle [rad] about a unit axis (3,)."""
    x, y, z = axis.tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return torch.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _moved(points: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
    pivot = points.new_tensor(PIVOT)
    return (points - pivot) @ turn.T + pivot


def _canonical(rotation: torch.Tensor, contacts: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The form of each jaw whose closing direction has x > 0, and its contacts at -Y and +Y."""
    back = rotation[:, 0, 1] < 0.0
    sign = torch.where(back, -1.0, 1.0)
    rotation = rotation * torch.stack([torch.ones_like(sign), sign, sign], dim=1)[:, None, :]
    return rotation, torch.where(back[:, None], -contacts.flip(1), contacts)


def _with_losses(sample: GraspSample, most: float, generator: torch.Generator) -> GraspSample:
    """Some points are lost; others stand twice in their place, so that there are as many as before."""
    n = len(sample.points)
    lost = int(n * most * float(torch.rand((), generator=generator)))
    if lost == 0:
        return sample
    order = torch.randperm(n, generator=generator)
    kept = order[lost:]
    rows = torch.cat([kept, kept[torch.randint(len(kept), (lost,), generator=generator)]])
    names = ("points", "colors", "confidence", "object_index")
    return dataclasses.replace(sample, **{name: getattr(sample, name)[rows] for name in names})
