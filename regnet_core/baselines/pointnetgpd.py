"""PointNetGPD: Liang et al., "PointNetGPD: Detecting Grasp Configurations from Point Sets", ICRA 2019.

Candidates (gpg.py) are told by a PointNet (Qi et al., 2017) from the points in their closing areas, in the frame of the
hand: a small network turns and stretches them (the spatial transformer), layers of 64, 128 and 1024 channels that all
points share, the maximum over the points, and layers of 512 and 256 before the 2 classes.

As in the authors' code at most 750 points are looked at, a hand with fewer than 50 is not told, and a grasp is good
when it holds at a friction coefficient of 0.6. The code draws points again where there are fewer than 750; to the
maximum repeats make no difference, so that here areas of different sizes stand side by side without any.
"""

from __future__ import annotations

import torch
from torch import nn

from regnet_core.baselines.classification import GraspClassifier
from regnet_core.baselines.closing_area import ClosingAreas
from regnet_core.nn.layers import Mlp
from regnet_core.ops.segments import segment_max

FRICTION = 0.6
"""Coefficient at which a good grasp holds."""
_SHARED, _AFTER = (64, 128, 1024), (512, 256)


class PointNetGpd(GraspClassifier):
    """The classifier of ``pointnetgpd``."""

    name = "pointnetgpd"
    good_score = 1.0 / (1.0 + FRICTION**2)  # the squared cosine of the friction cone's half-angle
    least_points = 50
    most_points = 750

    def __init__(self) -> None:
        super().__init__()
        self.transformer = _Transformer()
        self.shared = Mlp(3, _SHARED)
        self.after = Mlp(_SHARED[-1], _AFTER)
        self.output = nn.Linear(_AFTER[-1], 2)

    def forward(self, areas: ClosingAreas) -> torch.Tensor:
        device = self.output.weight.device
        points = torch.from_numpy(areas.points).float().to(device)
        return self.classify(2.0 * points - 1.0, torch.from_numpy(areas.offsets).to(device))

    def classify(self, points: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
        """Logits (G, 2) of G sets of points (E, 3); set g has the rows ``offsets[g]`` to ``offsets[g + 1]``."""
        owner = torch.repeat_interleave(torch.arange(len(offsets) - 1, device=points.device), offsets.diff())
        turn = self.transformer(points, offsets)
        # Not a matrix product, which autocast would round to bf16.
        turned = (points[:, :, None] * turn.index_select(0, owner)).sum(dim=1)
        pooled = segment_max(self.shared(turned), offsets)
        return self.output(self.after(pooled)).float()  # type: ignore[no-any-return]


class _Transformer(nn.Module):
    """A matrix (3, 3) for each set of points, the identity before anything is learnt."""

    def __init__(self) -> None:
        super().__init__()
        self.shared = Mlp(3, _SHARED)
        self.after = Mlp(_SHARED[-1], _AFTER)
        self.output = nn.Linear(_AFTER[-1], 9)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, points: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
        pooled = segment_max(self.shared(points), offsets)
        change = self.output(self.after(pooled)).float().view(-1, 3, 3)
        return change + torch.eye(3, device=points.device)
