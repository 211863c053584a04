"""The ledger: parameters and floating-point operations of a network, from its configuration.

Operations are counted as the paper's are, for a padded implementation that works for all neighbours of a centroid,
repeats included, and applies the first layer of a set abstraction to each of them: 2 for each multiply-add of a dense
layer, and 4 for each number that is batch-normalised (as thop, a common counter, does; biases, rectifiers and maxima
are free). So counted, the published architecture has 151.02 GFLOP without refinement and 244.99 with it; the paper
says 151.03 and 245.0. The refinement is counted for all anchors of all regions, 768 x 4 x 64 points.

What we do differently changes little of this:
- the width is one feature instead of three equal ones;
- a class is one logit instead of two;
- the score has no batch normalisation of its own;
- after the closing area's points are pooled, one row goes through the last layer of the refinement, not 64 of them
  (1.7 GFLOP less), and the points bring the width with them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from regnet_core.nn.anchors import RESIDUALS
from regnet_core.nn.config import NetworkConfig


class Layer(NamedTuple):
    """A dense layer and how often it is applied to one cloud."""

    stage: str
    """The module it is in, such as "abstraction 1" or "score"."""
    inputs: int
    outputs: int
    rows: int
    """How many rows of a padded implementation go through it."""
    normalised: bool = True
    """Followed by batch normalisation; otherwise it has a bias."""

    @property
    def parameters(self) -> int:
        return self.inputs * self.outputs + self.outputs * (2 if self.normalised else 1)

    @property
    def flops(self) -> int:
        return self.rows * (2 * self.inputs * self.outputs + 4 * self.outputs * self.normalised)


def layers(config: NetworkConfig) -> list[Layer]:
    """Every dense layer of a network."""
    return [*_backbone(config), *_heads(config), *_refinement(config)]


def count_parameters(config: NetworkConfig) -> int:
    """How many numbers are trained."""
    return sum(layer.parameters for layer in layers(config))


def count_flops(config: NetworkConfig, *, refinement: bool = True) -> int:
    """Floating-point operations for one cloud of ``config.points``, with or without the third stage."""
    return sum(layer.flops for layer in layers(config) if refinement or layer.stage != "refinement")


def _mlp(stage: str, inputs: int, channels: tuple[int, ...], rows: int) -> Iterator[Layer]:
    for outputs in channels:
        yield Layer(stage, inputs, outputs, rows)
        inputs = outputs


def _backbone(config: NetworkConfig) -> Iterator[Layer]:
    channels, rows = config.point_channels, [config.points]
    skips = [3 + channels]
    for i, abstraction in enumerate(config.abstractions, 1):
        rows.append(min(abstraction.centroids, rows[-1]))
        yield from _mlp(f"abstraction {i}", 3 + channels, abstraction.channels, rows[-1] * abstraction.neighbours)
        channels = abstraction.channels[-1]
        skips.append(channels)
    for i, sizes in zip(range(len(skips) - 1, 0, -1), config.propagations, strict=True):
        yield from _mlp(f"propagation {i}", channels + skips[i - 1], sizes, rows[i - 1])
        channels = sizes[-1]


def _candidates(config: NetworkConfig) -> int:
    """How many regions a cloud has."""
    centroids = [config.points, *(abstraction.centroids for abstraction in config.abstractions)]
    return min(config.positives, *centroids[: config.layer])


def _heads(config: NetworkConfig) -> Iterator[Layer]:
    regions, last, anchors = _candidates(config), config.head[-1], config.anchors
    yield from _mlp("score", config.features, config.head, config.points)
    yield Layer("score", last, 1, config.points, normalised=False)
    for _ in range(config.grasp_heads):
        yield from _mlp("regions", config.features, config.head, regions)
    yield Layer("regions", last, anchors, regions, normalised=False)
    yield Layer("regions", last, anchors * (RESIDUALS + 1), regions, normalised=False)


def _refinement(config: NetworkConfig) -> Iterator[Layer]:
    if config.refinement is None:
        return
    proposals = _candidates(config) * config.anchors
    inputs = 3 + config.point_channels + (config.features if config.refinement.point_features else 0)
    yield from _mlp("refinement", inputs, config.refinement.channels, proposals * config.refinement.points)
    pooled = config.refinement.channels[-1] + config.features
    yield from _mlp("refinement", pooled, config.refinement.fusion, proposals)
    pooled = config.refinement.fusion[-1] if config.refinement.fusion else pooled
    yield Layer("refinement", pooled, 1, proposals, normalised=False)
    yield Layer("refinement", pooled, RESIDUALS + 1, proposals, normalised=False)
