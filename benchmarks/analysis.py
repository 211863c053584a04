"""From the answers of workers to records: summaries of stages, and their shares of the machine's peak."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from benchmarks.records import PeakRecord, RunRecord, StageRecord
from benchmarks.stages import ALL_STAGES, DETECTION, NETWORK_ENTRY, PREPROCESSING
from benchmarks.summary import Summary
from benchmarks.work import Work, ledger_flops, needed_work
from regnet_core.nn.config import NetworkConfig

Answers = Sequence[Mapping[str, Any]]


def peak_record(threads: int, answers: Answers) -> PeakRecord:
    """The peaks of all trials with so many threads."""
    return PeakRecord(
        threads, **{name: Summary.of([a[name] for a in answers]) for name in ("fp32", "bf16", "copy", "triad", "int8")}
    )


def run_record(
    labels: Mapping[str, Any], answers: Answers, config: NetworkConfig | None, peak: PeakRecord | None
) -> RunRecord:
    """One run.

    Args:
        labels: model, weights, precision, threads, cloud, points and prepared, as the record has them.
        answers: of ``DetectionTask.measure``.
        config: of the network; None for other models.
        peak: of the machine with so many threads, where it was measured.
    """
    work = _work(config, answers)
    nominal = {} if config is None else ledger_flops(config)
    stages = _stages("preprocessor", [a["preprocessor"] for a in answers])
    stages += [
        with_share(stage, work.get(stage.name), nominal.get(stage.name), peak, labels["precision"])
        for stage in _stages("detector", [a["timed"] for a in answers])
    ]
    messages = [a["messages"] for a in answers if "messages" in a]
    stages += _stages("messages", messages)
    return RunRecord(
        **labels,
        seen=round(_count(answers, "points")),
        grasps=round(median(a["grasps"] for a in answers)),
        total=Summary.of([a["plain"]["wall"] for a in answers]),
        cpu=Summary.of([a["plain"]["cpu"] for a in answers]),
        timed=_inclusive([a["timed"] for a in answers], DETECTION),
        network=None if config is None else _inclusive([a["timed"] for a in answers], NETWORK_ENTRY),
        preprocessor=_inclusive([a["preprocessor"] for a in answers], PREPROCESSING),
        messages=_sum(messages),
        peak_memory=max(int(a["peak_bytes"]) for a in answers),
        stages=tuple(stages),
    )


def with_share(
    stage: StageRecord, work: Work | None, nominal: float | None, peak: PeakRecord | None, precision: str
) -> StageRecord:
    """A stage with what it had to do, and how near to the machine's peak it did it.

    The least time is that of the operations at the peak of matrix products or of the bytes at the peak of memory
    traffic, whichever is longer.
    """
    fields = {**vars(stage), "ledger_flops": nominal}
    if work is None:
        return StageRecord(**fields)
    fields.update(needed_flops=work.flops, needed_bytes=work.nbytes)
    if peak is not None and stage.wall.median > 0.0:
        computing, moving = work.flops / peak.flops(precision), work.nbytes / peak.bandwidth
        bound = "matrix product" if computing >= moving else "memory"
        fields.update(bound=bound, share=max(computing, moving) / stage.wall.median)
    return StageRecord(**fields)


def _stages(part: str, samples: Sequence[Mapping[str, Any]]) -> list[StageRecord]:
    """Every stage that ever ran, in the order of the table; a sample in which it did not run counts as 0 s."""
    if not samples:
        return []
    records = []
    names = list(dict.fromkeys(name for sample in samples for name in sample["stages"]))
    for name in names:
        entries = [sample["stages"].get(name, {"calls": 0, "wall": 0.0, "cpu": 0.0}) for sample in samples]
        records.append(
            StageRecord(
                name=name,
                part=part,
                group=_group(name),
                calls=float(median(entry["calls"] for entry in entries)),
                wall=Summary.of([entry["wall"] for entry in entries]),
                cpu=Summary.of([entry["cpu"] for entry in entries]),
            )
        )
    return sorted(records, key=lambda record: _place(record.name))


def _group(name: str) -> str:
    return next(stage.group for stage in ALL_STAGES if _is(stage.name, name))


def _place(name: str) -> tuple[int, str]:
    return next(i for i, stage in enumerate(ALL_STAGES) if _is(stage.name, name)), name


def _is(stage: str, name: str) -> bool:
    return name == stage or name.removeprefix(f"{stage} ").isdigit()


def _inclusive(samples: Sequence[Mapping[str, Any]], stage: str) -> Summary:
    return Summary.of([sample["stages"][stage]["inclusive"] for sample in samples])


def _sum(samples: Sequence[Mapping[str, Any]]) -> Summary | None:
    totals = [sum(entry["wall"] for entry in sample["stages"].values()) for sample in samples]
    return Summary.of(totals) if totals else None


def _work(config: NetworkConfig | None, answers: Answers) -> dict[str, Work]:
    if config is None:
        return {}
    counts = {name: _count(answers, name) for name in answers[0]["timed"]["counts"]}
    return needed_work(config, counts)


def _count(answers: Answers, name: str) -> float:
    return float(median(a["timed"]["counts"].get(name, 0.0) for a in answers))
