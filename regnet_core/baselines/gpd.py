"""GPD: ten Pas, Gualtieri, Saenko and Platt, "Grasp Pose Detection in Point Clouds", IJRR 2017.

Candidates (gpg.py) are told by a convolutional network from their images (grasp_images.py). Its structure is that of
LeNet: 20 and 50 filters of 5 x 5, each followed by the maximum of 2 x 2, then 500 units and 2 classes; rectifiers are
where the authors' PyTorch version has them. A grasp is good when both contacts' normals lie within 20 degrees of the
closing direction, as there.
"""

from __future__ import annotations

import math

import torch
from torch import nn
from torch.nn import functional

from regnet_core.baselines.classification import GraspClassifier
from regnet_core.baselines.closing_area import ClosingAreas
from regnet_core.baselines.grasp_images import grasp_images

FRICTION_CONE = math.radians(20)
"""Greatest angle between a contact's normal and the closing direction in a good grasp [rad]."""


class GpdNetwork(GraspClassifier):
    """The classifier of ``gpd-3`` and ``gpd-12``."""

    good_score = math.cos(FRICTION_CONE) ** 2

    def __init__(self, channels: int) -> None:
        """Args:
        channels: of the images, 3 or 12.
        """
        super().__init__()
        self.name = f"gpd-{channels}"
        self.channels = channels
        self.first = nn.Conv2d(channels, 20, 5)
        self.second = nn.Conv2d(20, 50, 5)
        self.hidden = nn.Linear(50 * 12 * 12, 500)
        self.output = nn.Linear(500, 2)

    def forward(self, areas: ClosingAreas) -> torch.Tensor:
        images = torch.from_numpy(grasp_images(areas, self.channels))
        return self.classify(images.to(self.output.weight.device))

    def classify(self, images: torch.Tensor) -> torch.Tensor:
        """Logits (G, 2) of images (G, channels, 60, 60)."""
        maps = functional.max_pool2d(functional.relu(self.first(images)), 2)  # (G, 20, 28, 28)
        maps = functional.max_pool2d(functional.relu(self.second(maps)), 2)  # (G, 50, 12, 12)
        hidden = functional.relu(self.hidden(maps.flatten(1)))
        return self.output(hidden).float()  # type: ignore[no-any-return]
