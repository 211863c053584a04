"""Two documents side by side: what became faster, what slower, and what did not change beyond its spread."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from benchmarks.records import Document, RunRecord, ThroughputRecord
from benchmarks.summary import Summary
from benchmarks.tables import markdown
from regnet_core.checks import check_range

_SMALL = 0.01
"""Stages of less than this share of a detection in both documents are left out."""
_SAME = 0.03
"""Medians nearer than this share are the same, however small the spread is."""


class Change(NamedTuple):
    """One number in both documents."""

    what: str
    before: Summary
    after: Summary
    unit: str
    """"ms", "GFLOP/s", "GB/s" or "1/s"."""
    scale: float
    """From the unit of the record to that."""
    lower_is_better: bool
    headline: bool
    """Whether it is what a user notices, rather than a part of it."""

    @property
    def ratio(self) -> float:
        """The median after, by that before."""
        return self.after.median / self.before.median if self.before.median > 0.0 else float("nan")

    @property
    def verdict(self) -> str:
        """ "better" or "worse" where the quartiles do not overlap and the medians differ, else "same"."""
        apart = self.after.lower > self.before.upper or self.after.upper < self.before.lower
        if not apart or not abs(self.ratio - 1.0) > _SAME:
            return "same"
        return "better" if (self.ratio < 1.0) == self.lower_is_better else "worse"


def compare(before: Document, after: Document) -> list[Change]:
    """Everything that both documents measured."""
    return [*_peaks(before, after), *_runs(before, after), *_ros(before, after)]


def comparison_table(before: Document, after: Document, changes: list[Change]) -> str:
    """The changes, and what speaks against comparing."""
    rows = [
        [
            change.what,
            f"{change.scale * change.before.median:.2f}",
            f"{change.scale * change.after.median:.2f}",
            change.unit,
            f"{change.ratio:.3f}",
            change.verdict,
        ]
        for change in changes
    ]
    table = markdown(["", "before", "after", "unit", "after / before", "verdict"], rows)
    return "\n".join([*(f"Beware: {doubt}." for doubt in doubts(before, after)), "", table]).strip() + "\n"


def doubts(before: Document, after: Document) -> list[str]:
    """Why the two cannot quite be compared."""
    found = []
    for name in ("processor", "cores", "units", "python", "packages"):
        old, new = getattr(before.machine, name), getattr(after.machine, name)
        if old != new:
            found.append(f"the machines differ: {name} {old} and {new}")
    different = {key for key in before.settings if before.settings[key] != after.settings.get(key)}
    found += [
        f"the option {key} was {before.settings[key]} and is {after.settings.get(key)}" for key in sorted(different)
    ]
    for name, document in (("before", before), ("after", after)):
        found += [f"{name}: {warning}" for warning in document.warnings]
    missing = {run.key for run in before.runs} - {run.key for run in after.runs}
    if missing:
        found.append(f"{len(missing)} runs of the first file are not in the second")
    return found


def worse_by(changes: list[Change], factor: float) -> list[Change]:
    """The headlines that became worse by more than a factor.

    Raises:
        InvalidInputError: the factor is less than 1.
    """
    check_range("factor", factor, 1.0)
    worse = [change for change in changes if change.headline and change.verdict == "worse"]
    return [change for change in worse if max(change.ratio, 1.0 / change.ratio) > factor]


def _times(what: str, before: Summary | None, after: Summary | None, headline: bool = False) -> Iterator[Change]:
    if before is not None and after is not None:
        yield Change(what, before, after, "ms", 1e3, True, headline)


def _peaks(before: Document, after: Document) -> Iterator[Change]:
    later = {peak.threads: peak for peak in after.peaks}
    for old in before.peaks:
        new = later.get(old.threads)
        if new is not None:
            words = f"peak, {old.threads} threads"
            yield Change(f"{words}, fp32", old.fp32, new.fp32, "GFLOP/s", 1e-9, False, False)
            yield Change(f"{words}, bf16", old.bf16, new.bf16, "GFLOP/s", 1e-9, False, False)
            if old.int8 is not None and new.int8 is not None:
                yield Change(f"{words}, int8", old.int8, new.int8, "GOP/s", 1e-9, False, False)
            yield Change(f"{words}, triad", old.triad, new.triad, "GB/s", 1e-9, False, False)


def _runs(before: Document, after: Document) -> Iterator[Change]:
    later = {run.key: run for run in after.runs}
    for old in before.runs:
        new = later.get(old.key)
        if new is not None:
            yield from _run(old, new)


def _run(old: RunRecord, new: RunRecord) -> Iterator[Change]:
    yield from _times(f"{old.label}: detection", old.total, new.total, headline=True)
    yield from _times(f"{old.label}: computing time", old.cpu, new.cpu)
    yield from _times(f"{old.label}: network", old.network, new.network)
    yield from _times(f"{old.label}: preprocessor", old.preprocessor, new.preprocessor, headline=True)
    yield from _times(f"{old.label}: messages", old.messages, new.messages, headline=True)
    stages = {(stage.part, stage.name): stage for stage in new.stages}
    for stage in old.stages:
        other = stages.get((stage.part, stage.name))
        if other is None:
            continue
        least = _SMALL * min(old.total.median, new.total.median)
        if max(stage.wall.median, other.wall.median) >= least:
            yield from _times(f"{old.label}: {stage.part}, {stage.name}", stage.wall, other.wall)


def _ros(before: Document, after: Document) -> Iterator[Change]:
    later = {(item.model, item.weights, item.threads, item.cloud): item for item in after.latencies}
    for old in before.latencies:
        new = later.get((old.model, old.weights, old.threads, old.cloud))
        if new is not None:
            words = f"{old.model}, {old.threads} threads, {old.cloud}"
            yield from _times(f"{words}: publication to arrival", old.total, new.total, headline=True)
            yield from _times(f"{words}: all but the model", old.outside, new.outside, headline=True)
            yield from _times(f"{words}: transport", old.transport, new.transport)
    rates = {_flow(item): item for item in after.throughputs}
    for flow in before.throughputs:
        other = rates.get(_flow(flow))
        if other is not None:
            words = f"{flow.model}, {flow.threads} threads, {flow.at_a_time} at a time, {flow.bag}: grasps a second"
            old_rate, new_rate = (Summary.of([value]) for value in (flow.sustained, other.sustained))
            yield Change(words, old_rate, new_rate, "1/s", 1.0, False, True)


def _flow(item: ThroughputRecord) -> tuple[object, ...]:
    """What makes two rates comparable."""
    return item.model, item.weights, item.threads, item.at_a_time, item.bag, item.offered
