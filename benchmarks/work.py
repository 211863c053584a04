"""How much work the stages of a network have: operations by the ledger, operations needed, and bytes moved.

The ledger counts what a padded implementation does, as the paper does: for every slot of a neighbourhood, every point
of ``config.points`` and every anchor of a region. Needed is less: the real neighbours and points of the cloud at hand,
features for the points that something asks about, the candidates that are refined, and the linear part of what is
gathered once for each point instead of once for each neighbour. 2 operations count for each multiply-add; what batch
normalisation needs is part of the layers.

Bytes are those that must be moved if a stage keeps in the processor what it makes and uses up itself: inputs, outputs
and weights once, and what is gathered once for each time it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from benchmarks.stages import NETWORK_STAGES, ledger_name
from benchmarks.timer import Observer
from regnet_core.nn.anchors import RESIDUALS
from regnet_core.nn.config import NetworkConfig
from regnet_core.nn.ledger import layers

_FLOAT, _INDEX = 4, 8


class Work(NamedTuple):
    """What a stage has to do for one cloud."""

    flops: float
    nbytes: float


def _of_hierarchy(arguments: tuple[Any, ...], hierarchy: Any) -> Mapping[str, float]:
    found: dict[str, float] = {"points": len(arguments[0].points)}
    for number, level in enumerate(hierarchy.levels, 1):
        found[f"centroids {number}"] = len(level.points)
        found[f"neighbours {number}"] = len(level.neighbours.indices)
    return found


def _of_regions(arguments: tuple[Any, ...], neighbours: Any) -> Mapping[str, float]:
    return {"region points": len(neighbours.indices)}


def _of_selection(arguments: tuple[Any, ...], regions: Any) -> Mapping[str, float]:
    return {"regions": len(regions.source)}


def _of_closing_areas(arguments: tuple[Any, ...], near: Any) -> Mapping[str, float]:
    return {"candidates": len(arguments[1]), "closing points": len(near.indices)}


def _of_score(arguments: tuple[Any, ...], confidence: Any) -> Mapping[str, float]:
    return {"scored": len(confidence)}


def _of_centroids(arguments: tuple[Any, ...], coarse: Any) -> Mapping[str, float]:
    return {"feature bytes": coarse.features.element_size()}


def _of_points(arguments: tuple[Any, ...], features: Any) -> Mapping[str, float]:
    return {"asked": len(features)}


OBSERVERS: dict[str, Observer] = {
    "regnet_core.nn.hierarchy:build_hierarchy": _of_hierarchy,
    "regnet_core.nn.regions:region_neighbours": _of_regions,
    "regnet_core.nn.regions:select_regions": _of_selection,
    "regnet_core.nn.refinement:closing_points": _of_closing_areas,
    "regnet_core.nn.backbone:Backbone.coarse": _of_centroids,
    "regnet_core.nn.backbone:Backbone.fine": _of_points,
    "regnet_core.nn.heads:ScoreHead.forward": _of_score,
}
"""What has to be known of a detection to count its work."""


def ledger_flops(config: NetworkConfig) -> dict[str, float]:
    """Operations by the ledger, by the names of our stages."""
    totals: dict[str, float] = {}
    for layer in layers(config):
        totals[layer.stage] = totals.get(layer.stage, 0.0) + layer.flops
    names = {
        ledger_name(stage, name): name
        for stage in NETWORK_STAGES
        if stage.ledger
        for name in stage.names(len(config.abstractions))
    }
    return {names[stage]: flops for stage, flops in totals.items()}


def needed_work(config: NetworkConfig, counts: Mapping[str, float]) -> dict[str, Work]:
    """What the stages of one detection had to do.

    Args:
        config: of the network.
        counts: what ``OBSERVERS`` noted of the detection.
    """
    size = counts.get("feature bytes", _FLOAT)
    found = {**_abstractions(config, counts, size), **_propagations(config, counts, size)}
    regions = counts.get("regions", 0.0)
    head = [config.features, *config.head]
    found["score head"] = _dense([*head, 1], counts.get("scored", 0.0), size)
    outputs = config.anchors * (RESIDUALS + 2)
    own, last = max(1, config.grasp_heads), [config.head[-1], outputs]  # without heads of its own it uses the score's
    flops = own * _dense(head, regions, size).flops + _dense(last, regions, size).flops
    weights = own * _weights(head, size) + _weights(last, size)
    found["grasp heads"] = Work(flops, size * regions * (config.features + outputs) + weights)
    if config.region is not None:
        gathered = counts.get("region points", 0.0)
        found["regions"] = Work(0.0, gathered * (size * config.features + _INDEX) + size * regions * config.features)
    if config.refinement is not None:
        found["refinement"] = _refinement(config, counts, size)
    return found


def _abstractions(config: NetworkConfig, counts: Mapping[str, float], size: float) -> dict[str, Work]:
    found, below, channels = {}, counts.get("points", 0.0), config.point_channels
    for number, abstraction in enumerate(config.abstractions, 1):
        near, centroids = counts.get(f"neighbours {number}", 0.0), counts.get(f"centroids {number}", 0.0)
        first, *rest = abstraction.channels
        once = _dense([channels, first], below, size)
        each = _dense([first, *rest], near, size)
        flops = once.flops + 2 * near * 3 * first + each.flops
        gathered = near * (size * first + _INDEX + 3 * _FLOAT)
        nbytes = size * below * channels + gathered + size * centroids * abstraction.channels[-1]
        found[f"abstraction {number}"] = Work(flops, nbytes + _weights([3 + channels, first, *rest], size))
        below, channels = centroids, abstraction.channels[-1]
    return found


def _propagations(config: NetworkConfig, counts: Mapping[str, float], size: float) -> dict[str, Work]:
    found = {}
    skips = [3 + config.point_channels, *(abstraction.channels[-1] for abstraction in config.abstractions)]
    rows = [counts.get("asked", counts.get("points", 0.0))]
    rows += [counts.get(f"centroids {number}", 0.0) for number in range(1, len(config.abstractions) + 1)]
    channels = skips[-1]
    for level, sizes in zip(range(len(config.abstractions), 0, -1), config.propagations, strict=True):
        fine, coarse, first = rows[level - 1], rows[level], sizes[0]
        carried = 2 * coarse * channels * first + 2 * 3 * fine * first
        flops = carried + 2 * fine * skips[level - 1] * first + _dense(sizes, fine, size).flops
        gathered = fine * 3 * (size * first + _INDEX + _FLOAT)
        ends = size * (coarse * channels + fine * (skips[level - 1] + sizes[-1]))
        found[f"propagation {level}"] = Work(
            flops, gathered + ends + _weights([channels + skips[level - 1], *sizes], size)
        )
        channels = sizes[-1]
    return found


def _refinement(config: NetworkConfig, counts: Mapping[str, float], size: float) -> Work:
    refinement = config.refinement
    assert refinement is not None
    near, candidates = counts.get("closing points", 0.0), counts.get("candidates", 0.0)
    own, first = 3 + config.point_channels, refinement.channels[0]
    once, gathered = 0.0, near * (_INDEX + 3 * _FLOAT)
    if refinement.point_features:
        once = 2 * counts.get("asked", counts.get("points", 0.0)) * config.features * first
        gathered += near * size * first
    last = refinement.channels[-1] + config.features
    fusion = _dense([last, *refinement.fusion], candidates, size)
    outputs = RESIDUALS + 2
    flops = once + 2 * near * own * first + _dense(refinement.channels, near, size).flops + fusion.flops
    flops += 2 * candidates * (refinement.fusion or (last,))[-1] * outputs
    nbytes = gathered + candidates * (size * config.features + _FLOAT * outputs)
    return Work(flops, nbytes + _weights([own, *refinement.channels], size))


def _dense(channels: Sequence[int], rows: float, size: float) -> Work:
    """Layers from one number of channels to the next, on so many rows."""
    flops = sum(2.0 * rows * a * b for a, b in pairwise(channels))
    return Work(flops, size * rows * (channels[0] + channels[-1]) + _weights(channels, size))


def _weights(channels: Sequence[int], size: float) -> float:
    return size * sum(a * b for a, b in pairwise(channels))
