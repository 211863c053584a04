"""Results as they are kept: plain frozen dataclasses of numbers and texts, which documents.py writes and reads.

Times are seconds, sizes bytes, rates per second, unless a field says otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from benchmarks.machine import Machine
from benchmarks.summary import Summary

FORMAT = "regnet-benchmark/1"
GROWTH_DETECTIONS = 10_000
"""Growth of memory is said for so many detections, and judged after as many."""


class RunKey(NamedTuple):
    """What tells one run from the others of a document, and finds it in another document."""

    model: str
    weights: str
    precision: str
    threads: int
    cloud: str


@dataclass(frozen=True)
class PeakRecord:
    """What the machine can do with so many threads; the best of all trials is the peak."""

    threads: int
    fp32: Summary
    """Matrix product [FLOP/s]."""
    bf16: Summary
    """[FLOP/s]"""
    copy: Summary
    """[bytes/s]"""
    triad: Summary
    """[bytes/s]"""
    int8: Summary | None = None
    """Matrix product of bytes [operations/s]; None where it was not measured."""

    def flops(self, precision: str) -> float:
        """The peak of matrix products in a precision [FLOP/s]."""
        if precision == "int8" and self.int8 is not None:
            return self.int8.most
        return self.bf16.most if precision == "bf16" else self.fp32.most

    @property
    def bandwidth(self) -> float:
        """The peak of memory traffic [bytes/s]."""
        return max(self.copy.most, self.triad.most)


@dataclass(frozen=True)
class StageRecord:
    """One stage of a run."""

    name: str
    part: str
    """Whose: the preprocessor's, the detector's, or that of messages."""
    group: str
    calls: float
    """In each detection (median)."""
    wall: Summary
    """Without the stages inside."""
    cpu: Summary
    """Of all threads, without the stages inside."""
    ledger_flops: float | None = None
    """Operations that a padded implementation needs (regnet_core/nn/ledger.py)."""
    needed_flops: float | None = None
    """Operations that the cloud needed (benchmarks/work.py)."""
    needed_bytes: float | None = None
    bound: str = ""
    """What the stage could be limited by: "matrix product" or "memory"."""
    share: float | None = None
    """Least time at the machine's peak over the median measured: 1 cannot be beaten."""


@dataclass(frozen=True)
class RunRecord:
    """One model in one precision with so many threads on one cloud."""

    model: str
    weights: str
    """"trained", "file", "random, seed N" or "none"."""
    precision: str
    """"int8", "bf16", "fp32", or empty for models that have none."""
    threads: int
    cloud: str
    points: int
    """Of the cloud."""
    prepared: int
    """Left by the preprocessor."""
    seen: int
    """By the network; 0 for other models."""
    grasps: int
    total: Summary
    """A detection, cloud to ranked grasps, without stage timers."""
    cpu: Summary
    """The same, computing time of all threads."""
    timed: Summary
    """A detection with stage timers."""
    network: Summary | None
    """All of the network, from its input points to refined numbers."""
    preprocessor: Summary
    """What the preprocessor node computes."""
    messages: Summary | None
    """Conversions and serialisations of all nodes together; None without ROS."""
    peak_memory: int
    """Of the process that did only this [bytes]."""
    stages: tuple[StageRecord, ...]

    @property
    def key(self) -> RunKey:
        """What it is a run of."""
        return RunKey(self.model, self.weights, self.precision, self.threads, self.cloud)

    @property
    def label(self) -> str:
        """For people."""
        words = [self.model, self.precision, f"{self.threads} thread{'s' if self.threads > 1 else ''}", self.cloud]
        return ", ".join(word for word in words if word)


@dataclass(frozen=True)
class ReferenceRecord:
    """The plain padded network in fp32 on the same points."""

    model: str
    threads: int
    cloud: str
    seen: int
    total: Summary
    """Searches and layers, refining what our configuration refines."""
    searches: Summary
    """Of that, the brute-force searches."""
    layers: Summary
    """Of that, everything else."""
    all_anchors: Summary
    """The total when the proposals of all anchors are refined, as the published code does."""
    difference: float
    """Largest difference of the confidence's logits from our fp32 network's, in their standard deviations."""


@dataclass(frozen=True)
class NodeUse:
    """What a node's process used."""

    node: str
    cores: float
    """Busy on average."""
    resident: int
    """[bytes]"""
    peak: int
    """[bytes]"""


@dataclass(frozen=True)
class LatencyRecord:
    """From the publication of a PointCloud2 to the arrival of its GraspArray in another process, one at a time."""

    model: str
    weights: str
    threads: int
    cloud: str
    points: int
    message_bytes: int
    grasps: int
    clouds: int
    total: Summary
    slowest: float
    """95th percentile."""
    proposals: Summary
    """Of that, the model: what the step "proposals" of the GraspArray says."""
    outside: Summary
    """Everything else: transport, conversions, preparation, collision."""
    detection: Summary
    """A whole detection, as the GraspArray says."""
    parts: dict[str, Summary]
    """What the nodes say of themselves in /diagnostics."""
    transport: Summary
    """What is left of the total: serialisation, DDS, waiting for a thread to run."""
    others: float
    """Cores that processes other than ours kept busy meanwhile."""


@dataclass(frozen=True)
class ThroughputRecord:
    """Clouds of a replayed bag that become GraspArrays."""

    model: str
    weights: str
    threads: int
    bag: str
    offered: float
    """Clouds that are to be published in a second."""
    received: float
    """Clouds that reached the preprocessor in a second."""
    sustained: float
    """GraspArrays arriving in a second."""
    seconds: float
    """How long it was watched."""
    nodes: tuple[NodeUse, ...]
    others: float
    """Cores that processes other than ours kept busy meanwhile."""
    at_a_time: int = 1
    """Clouds that the detector works on at a time."""
    detection: float = math.nan
    """Median of what each GraspArray says that its detection took [s]."""


@dataclass(frozen=True)
class MemoryRecord:
    """Memory over many detections."""

    model: str
    weights: str
    where: str
    """"library", or the node whose process it is."""
    detections: int
    steady: int
    """Median over the second half [bytes]."""
    peak: int
    """[bytes]"""
    growth: float
    """Over 10,000 detections, by a line through what followed the first tenth [bytes]."""
    growth_error: float
    """Two standard errors of that [bytes]."""
    allowed: float
    """What growth counts as none [bytes]."""
    seconds: float

    @property
    def conclusive(self) -> bool:
        """Whether there were enough detections to tell growth from warming up."""
        return self.detections >= GROWTH_DETECTIONS

    @property
    def grows(self) -> bool:
        """Whether memory surely grows by more than is allowed."""
        return self.conclusive and self.growth > self.allowed


@dataclass(frozen=True)
class Load:
    """What others did meanwhile."""

    others: Summary
    """Cores that other processes kept busy."""
    share_quiet: float
    """Share of the looks at which that was next to none."""


@dataclass(frozen=True)
class Document:
    """Everything that was measured in one go."""

    created: str
    """UTC, ISO 8601."""
    machine: Machine
    settings: dict[str, str]
    """The options that numbers depend on."""
    load: Load | None = None
    peaks: tuple[PeakRecord, ...] = ()
    runs: tuple[RunRecord, ...] = ()
    references: tuple[ReferenceRecord, ...] = ()
    latencies: tuple[LatencyRecord, ...] = ()
    throughputs: tuple[ThroughputRecord, ...] = ()
    memory: tuple[MemoryRecord, ...] = ()
    warnings: tuple[str, ...] = field(default=())
    format: str = FORMAT
