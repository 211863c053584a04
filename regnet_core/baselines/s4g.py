"""S4G: Qin et al., "S4G: Amodal Single-view Single-Shot SE(3) Grasp Detection in Cluttered Scenes", CoRL 2019.

One pass of a PointNet++ over the scene's points predicts a grasp at every point: a class of its score, its rotation in
the continuous 6-D representation (Zhou et al., 2019: the first two columns before they are made orthonormal), and
where its centre is from the point. Three heads of their own follow the backbone, as in the paper. The score's classes
are the published ones: three of equal width, the lowest of which means no grasp.

The backbone is ours (nn/backbone.py) with the layers of ``regnetv2-s``: a size that two cores of a CPU train. The
published one has those of ``regnetv2``, the paper's size. The width is no input: it is trained for one gripper.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import nn

from regnet_core.checks import check_range
from regnet_core.nn.backbone import Backbone
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.config import AbstractionConfig, NetworkConfig
from regnet_core.nn.hierarchy import Hierarchy, build_hierarchy
from regnet_core.nn.layers import Mlp, output_layer

WIDTH = 0.08
"""The gripper's width that it is trained for [m]."""

BACKBONE = NetworkConfig(
    name="s4g",
    points=16384,
    width=False,
    abstractions=(
        AbstractionConfig(2048, 0.02, 32, (32, 32, 64)),
        AbstractionConfig(512, 0.06, 32, (64, 64, 128)),
        AbstractionConfig(128, 0.20, 32, (128, 128, 256)),
    ),
    propagations=((256, 256), (128, 128), (128, 128)),
    head=(128, 64),
    region=None,
    refinement=None,
)


@dataclass(frozen=True)
class S4gConfig:
    """The network.

    Raises:
        InvalidInputError: a number is out of range.
    """

    backbone: NetworkConfig = field(default=BACKBONE)
    """Its set abstractions, feature propagations and the layers of its heads; what else is in it is not used."""
    classes: int = 3
    """Of the score, equally wide; the first one is of points without a grasp."""
    unit: float = 0.03
    """Unit of the offsets from points to grasp centres [m]."""

    def __post_init__(self) -> None:
        check_range("classes", self.classes, 2, 100)
        check_range("unit", self.unit, 1e-4, 1.0, "m")


class S4gOutput(NamedTuple):
    """Predictions at N points."""

    score: torch.Tensor
    """(N, classes): logits."""
    rotation: torch.Tensor
    """(N, 6): approach and closing direction, before they are made orthonormal."""
    offset: torch.Tensor
    """(N, 3): from the point to the grasp centre c, in units of the configuration."""


class S4gNetwork(nn.Module):
    """The network of ``s4g``."""

    def __init__(self, config: S4gConfig | None = None) -> None:
        super().__init__()
        self.config = config or S4gConfig()
        backbone = self.config.backbone
        self.backbone = Backbone(backbone)
        self.score = _Head(backbone, self.config.classes)
        self.rotation = _Head(backbone, 6)
        self.offset = _Head(backbone, 3)
        # Before anything is learnt every hand comes from straight above and closes along x.
        with torch.no_grad():
            self.rotation.output.bias.copy_(torch.tensor([0.0, 0.0, -1.0, 1.0, 0.0, 0.0]))

    def forward(self, clouds: Clouds, hierarchy: Hierarchy | None = None) -> S4gOutput:
        """Predictions at all points of the clouds; the hierarchy where it was made ahead."""
        features = self.backbone(clouds, hierarchy or build_hierarchy(clouds, self.config.backbone))
        return S4gOutput(self.score(features), self.rotation(features), self.offset(features))


class _Head(nn.Module):
    """Layers that all points share, and the last one."""

    def __init__(self, config: NetworkConfig, outputs: int) -> None:
        super().__init__()
        self.mlp = Mlp(config.features, config.head)
        self.output = output_layer(config.head[-1], outputs)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return self.output(self.mlp(features)).float()  # type: ignore[no-any-return]
