"""The task of measuring the plain padded implementation on the very input that our network gets."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Any

import torch

from benchmarks import padded
from benchmarks.clouds import read_cloud
from benchmarks.errors import BenchmarkError
from benchmarks.patching import replace, resolve
from benchmarks.stage import Stage
from benchmarks.tasks.subject import Prepared, Subject
from benchmarks.timer import StageTimer
from regnet_core.gripper import Gripper
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.network import RegNet
from regnet_core.nn.results import Candidates, Output, Proposed, Refined, StagePrediction

SEARCHES = Stage(
    "searches",
    "search",
    "farthest points, neighbours, nearest centroids, closing areas and local shapes, by brute force",
    (
        "benchmarks.padded:plain_farthest_points",
        "benchmarks.padded:padded_ball_query",
        "benchmarks.padded:nearest_three",
        "benchmarks.padded:closing_index",
        "benchmarks.padded:plain_shapes",
    ),
)
_FORWARD = "regnet_core.nn.network:RegNet.forward"


class _Seen:
    """What the network was called with, and what it gave."""

    network: RegNet
    clouds: Clouds
    output: Output


class ReferenceTask:
    """Every measurement is the whole network once, padded, in fp32."""

    def __init__(self, model: str, weights_seed: int, width: float, cloud: str, points: int, crop: list[float]) -> None:
        self._subject = Subject(model, weights_seed, "fp32", width)
        if self._subject.network is None:
            raise BenchmarkError(f"the plain implementation is one of networks, and {model} is none")
        self._seen = _Seen()
        self._look(Prepared(read_cloud(cloud), points, crop))
        self._timer = StageTimer([SEARCHES])

    def facts(self) -> dict[str, Any]:
        """How many points the network sees."""
        return {"points": len(self._seen.clouds.points)}

    @torch.inference_mode()
    def measure(self, all_anchors: bool) -> dict[str, Any]:
        """One cloud.

        Args:
            all_anchors: refine the proposals of all anchors of every region, as the published code does, and not only
                those that our configuration refines.
        """
        with self._timer as timer:
            wall, cpu = time.perf_counter(), time.process_time()
            logits, confidence = self._run(all_anchors)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            searches = timer.take().stages[SEARCHES.name].wall
        ours = self._seen.output.proposed.confidence
        known = ours.isfinite()
        return {
            "wall": wall,
            "cpu": cpu,
            "searches": searches,
            "refined": len(logits),
            "difference": float((confidence - ours)[known].abs().max() / ours[known].std().clamp(min=1e-9)),
        }

    def _run(self, all_anchors: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """The last logits, and the confidence of all points."""
        network, ours = self._seen.network, self._seen.output.proposed
        clouds = padded.with_plain_shapes(network, self._seen.clouds)
        features = padded.backbone_features(network, clouds)
        confidence = padded.confidence(network, features)
        # Our regions: those of the plain confidence could differ in the last digits of two equally good points.
        pooled = padded.region_features(network, clouds, features, ours.regions.source)
        logits, numbers = padded.anchor_numbers(network, pooled)
        anchors = StagePrediction(logits, numbers[..., :-1], numbers[..., -1])
        proposed = ours._replace(confidence=confidence, region_features=pooled, anchors=anchors)
        refinement = network.config.refinement
        if refinement is None:
            return logits, confidence
        if all_anchors:
            candidates = network.best_anchors(proposed, network.config.anchors)
        else:
            candidates = network.first_candidates(proposed)
        refined = self._refine(candidates, proposed, features, clouds)
        for number in range(1, refinement.passes):
            candidates = network.next_candidates(candidates, refined, proposed, number)
            refined = self._refine(candidates, proposed, features, clouds)
        return refined.prediction.logit, confidence

    def _refine(self, candidates: Candidates, proposed: Proposed, features: torch.Tensor, clouds: Clouds) -> Refined:
        network = self._seen.network
        logits, numbers = padded.refined_numbers(
            network, clouds, features, proposed.region_features, candidates, self._subject.gripper
        )
        occupied = torch.ones(len(logits), dtype=torch.bool)
        return Refined(StagePrediction(logits, numbers[:, :-1], numbers[:, -1]), occupied)

    def _look(self, prepared: Prepared) -> None:
        """Detect once, and keep what goes into the network and comes out of it."""
        target = resolve(_FORWARD)

        def forward(network: RegNet, clouds: Clouds, gripper: Gripper | None = None, **named: Any) -> Output:
            output: Output = target.function(network, clouds, gripper, **named)
            self._seen.network, self._seen.clouds, self._seen.output = network, clouds, output
            return output

        with ExitStack() as stack:
            replace(stack, target, forward)
            self._subject.detect(prepared.result)
        if not hasattr(self._seen, "output"):
            raise BenchmarkError(f"{_FORWARD} was not called in a detection on the cloud {prepared.cloud.name}")
