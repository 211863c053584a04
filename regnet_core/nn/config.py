"""The configuration that every variant of the network is built from; named ones are in zoo.py."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

from regnet_core.checks import check_range, is_whole
from regnet_core.errors import InvalidInputError
from regnet_core.nn.anchors import CoderConfig
from regnet_core.ops.local_shape import SHAPE_CHANNELS


def _check_channels(name: str, channels: tuple[int, ...]) -> None:
    if not channels or not all(is_whole(c) and c > 0 for c in channels):
        raise InvalidInputError(f"{name} must hold at least one number of channels, each above 0, got {channels!r}")


@dataclass(frozen=True)
class AbstractionConfig:
    """One set abstraction of PointNet++.

    Raises:
        InvalidInputError: a number is out of range.
    """

    centroids: int
    """How many of the points below become centroids, at most."""
    radius: float
    """Of the ball query [m]."""
    neighbours: int
    """K, the most neighbours of a centroid."""
    channels: tuple[int, ...]
    """Of the layers; the last one's are the centroids' features."""

    def __post_init__(self) -> None:
        check_range("centroids", self.centroids, 1)
        check_range("radius", self.radius, 1e-4, 10.0, "m")
        check_range("neighbours", self.neighbours, 1)
        _check_channels("the channels of a set abstraction", self.channels)


@dataclass(frozen=True)
class RegionConfig:
    """Grasp regions: what the second stage sees of the surroundings of a positive point.

    Raises:
        InvalidInputError: a number is out of range.
    """

    radius: float = 0.02
    """Of the region [m]."""
    points: int = 256
    """K, the most points of a region."""

    def __post_init__(self) -> None:
        check_range("radius", self.radius, 1e-4, 1.0, "m")
        check_range("points", self.points, 1)


@dataclass(frozen=True)
class RefinementConfig:
    """The Refine Network.

    Raises:
        InvalidInputError: a number is out of range.
    """

    points: int = 64
    """The most points of a closing area that it looks at."""
    channels: tuple[int, ...] = (512, 256, 256, 128)
    """Of the layers that each of these points goes through."""
    fusion: tuple[int, ...] = ()
    """Channels of further layers, after the maximum over the points has joined the region's features. The paper has
    none, so that what is seen of the closing area and of the region only adds up."""
    margin: float = 0.0
    """The area looked at is the closing area grown by this on every side [m]: what the hand may hit comes in sight."""
    point_features: bool = False
    """Whether the points bring the backbone's features with them; otherwise only where they are (and their colours)."""
    passes: int = 1
    """How often proposals are refined, each time from what the last pass made of them."""
    proposals: tuple[int, ...] = ()
    """The most proposals of a cloud that each pass refines, those of which the best is expected; the others are given
    up. Empty: all of them, as in the paper. In training it is always all."""

    def __post_init__(self) -> None:
        for name in ("points", "passes"):
            check_range(name, getattr(self, name), 1)
        if self.proposals and len(self.proposals) != self.passes:
            raise InvalidInputError(
                f"proposals must have a number for each of the {self.passes} passes, got {self.proposals!r}"
            )
        for count in self.proposals:
            check_range("proposals", count, 1)
        _check_channels("the channels of the refinement", self.channels)
        if self.fusion:
            _check_channels("fusion", self.fusion)
        check_range("margin", self.margin, 0.0, 0.1, "m")


PAPER_ABSTRACTIONS = (
    AbstractionConfig(5120, 0.02, 64, (128, 128, 256)),
    AbstractionConfig(1024, 0.08, 64, (256, 256, 512)),
    AbstractionConfig(256, 0.32, 64, (512, 512, 1024)),
)


@dataclass(frozen=True)
class NetworkConfig:
    """A network. The defaults are the paper's size, with positive points from layer 1.

    Raises:
        InvalidInputError: a number is out of range, or parts do not fit together.
    """

    name: str = "regnetv2"
    points: int = 25600
    """N, the points of a cloud that it is made for; others work."""
    width: bool = True
    """Whether the gripper's width is a feature of every point."""
    colour: bool = False
    """Whether the points' colours are features."""
    shape_radius: float = 0.0
    """The shape of the surface within this radius is a feature of every point, and of every closing area's points as
    seen from the grasp (ops/local_shape.py) [m]; 0: no such feature, as in the paper."""
    abstractions: tuple[AbstractionConfig, ...] = PAPER_ABSTRACTIONS
    """Set abstractions, fine to coarse."""
    propagations: tuple[tuple[int, ...], ...] = ((1024, 1024), (512, 512), (256, 256, 256))
    """Channels of the feature propagations, coarse to fine, as many as set abstractions."""
    head: tuple[int, ...] = (512, 256, 256, 128)
    """Channels of each head's layers, before its output."""
    layer: int = 1
    """Where positive points come from: 1 all points, 2 the first set abstraction's centroids, 3 the second's, ..."""
    positives: int = 768
    """k1, how many positive points are taken from each cloud, at most."""
    least_confidence: float = 0.0
    """Points below this confidence are never positive, so that fewer than k1 may be."""
    spacing: float = 0.0
    """Grasps whose centres are nearer than this to that of a better grasp are left out [m]: the others are spread over
    the objects. 0 keeps them all, as the paper does."""
    region: RegionConfig | None = field(default_factory=RegionConfig)
    """None: a positive point's own features are used instead of its region's."""
    grasp_heads: Literal[0, 1, 2] = 2
    """2: class and residuals have a head each. 1: they share one. 0: they share the Score Network's."""
    coder: CoderConfig = field(default_factory=CoderConfig)
    """Anchors and units; a single anchor is the ablation without anchors."""
    refinement: RefinementConfig | None = field(default_factory=RefinementConfig)
    """None: no third stage."""

    def __post_init__(self) -> None:
        check_range("points", self.points, 1)
        check_range("positives", self.positives, 1)
        check_range("least_confidence", self.least_confidence, 0.0, 1.0)
        check_range("spacing", self.spacing, 0.0, 1.0, "m")
        check_range("shape_radius", self.shape_radius, 0.0, 0.1, "m")
        _check_channels("head", self.head)
        if len(self.propagations) != len(self.abstractions) or not self.abstractions:
            raise InvalidInputError(
                f"there must be as many feature propagations as set abstractions, at least one, got "
                f"{len(self.propagations)} and {len(self.abstractions)}"
            )
        for channels in self.propagations:
            _check_channels("the channels of a feature propagation", channels)
        centroids = [abstraction.centroids for abstraction in self.abstractions]
        if centroids != sorted(centroids, reverse=True):
            raise InvalidInputError(
                f"each set abstraction must have at most the centroids of the last, got {centroids}"
            )
        if not is_whole(self.layer) or not 1 <= self.layer <= len(self.abstractions):
            raise InvalidInputError(f"layer must be 1 to {len(self.abstractions)}, got {self.layer!r}")
        if self.grasp_heads not in (0, 1, 2):
            raise InvalidInputError(f"grasp_heads must be 0, 1 or 2, got {self.grasp_heads!r}")

    @property
    def point_channels(self) -> int:
        """Features that every point comes with."""
        return int(self.width) + 3 * int(self.colour) + SHAPE_CHANNELS * int(self.shape_radius > 0.0)

    @property
    def features(self) -> int:
        """Features of every point that the backbone gives."""
        return self.propagations[-1][-1]

    @property
    def anchors(self) -> int:
        """M."""
        return len(self.coder.anchors)

    def coarser(self, detail: float) -> NetworkConfig:
        """The same layers on fewer centroids with fewer neighbours, by this share of them: faster, and less exact.

        Raises:
            InvalidInputError: the share is not above 0 and at most 1.
        """
        check_range("detail", detail, 1e-3, 1.0)

        def part(count: int) -> int:
            return max(round(detail * count), 1)

        abstractions = (
            dataclasses.replace(a, centroids=part(a.centroids), neighbours=part(a.neighbours))
            for a in self.abstractions
        )
        return self.replace(abstractions=tuple(abstractions))

    def replace(self, **changes: Any) -> NetworkConfig:
        """The same with some fields changed."""
        return dataclasses.replace(self, **changes)
