"""Results as tables in Markdown: for README.md, and for whoever reads a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from benchmarks.records import (
    Document,
    LatencyRecord,
    MemoryRecord,
    PeakRecord,
    ReferenceRecord,
    RunRecord,
    StageRecord,
    ThroughputRecord,
)
from benchmarks.stage import GROUPS, Stage
from benchmarks.stages import (
    DECISION_STAGES,
    MESSAGE_STAGES,
    NETWORK_STAGES,
    PREPROCESSOR_STAGES,
    PROPOSALS,
    SCENE_STAGES,
)
from benchmarks.summary import Summary

Rows = Sequence[Sequence[str]]
BEGIN, END = "<!-- results -->", "<!-- end of results -->"
"""Lines of README.md between which ``write_results`` puts the tables."""
STAGES_BEGIN, STAGES_END = "<!-- stages -->", "<!-- end of stages -->"


def markdown(header: Sequence[str], rows: Rows) -> str:
    """A table; the first column is text, the others are set to the right."""
    rule = ["---", *("---:" for _ in header[1:])]
    return "\n".join(f"| {' | '.join(row)} |" for row in [header, rule, *rows])


def milliseconds(summary: Summary | None) -> str:
    """Median and quartiles of seconds, in ms."""
    if summary is None:
        return "–"
    low, middle, high = (f"{1e3 * value:.1f}" for value in (summary.lower, summary.median, summary.upper))
    return f"{middle} ({low} to {high})"


def result_tables(document: Document) -> str:
    """All that a document holds."""
    return "\n\n".join(_sections(document)) + "\n"


def stage_table() -> str:
    """What the stages are."""
    parts: list[tuple[str, Sequence[Stage]]] = [
        ("messages", MESSAGE_STAGES),
        ("preprocessor", PREPROCESSOR_STAGES),
        ("detector", (*SCENE_STAGES, *NETWORK_STAGES, PROPOSALS, *DECISION_STAGES)),
    ]
    rows = [
        [f"{stage.name} *k*" if stage.numbered else stage.name, part, stage.group, stage.what]
        for part, stages in parts
        for stage in stages
    ]
    table = [["stage", "part", "group", "what its time goes into"], ["---"] * 4, *rows]
    groups = "; ".join(f"{name}: {what}" for name, what in GROUPS.items())
    return f"Groups: {groups}.\n\n" + "\n".join(f"| {' | '.join(row)} |" for row in table)


def replaced(text: str, begin: str, end: str, content: str) -> str:
    """A text with what stands between two marks replaced; the marks stay.

    Raises:
        ValueError: a mark is missing.
    """
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise ValueError(f"the text has no '{begin}' followed by '{end}'")
    return f"{before}{begin}\n{content.strip()}\n{end}{after}"


def _sections(document: Document) -> Iterator[str]:
    machine = document.machine
    packages = ", ".join(f"{name} {version}" for name, version in machine.packages.items())
    load = document.load
    busy = "" if load is None else f" Others kept {load.others.median:.2f} cores busy (up to {load.others.most:.2f})."
    yield (
        f"{machine.processor}, {machine.cores} cores ({', '.join(machine.units) or 'no special units'}), "
        f"{machine.memory / 2**30:.0f} GiB; Python {machine.python}, {packages}; code {machine.commit or 'unknown'}, "
        f"{document.created}.{busy} Medians, with quartiles in brackets."
    )
    for warning in document.warnings:
        yield f"**Warning:** {warning}."
    if document.peaks:
        yield _peaks(document.peaks)
    if document.runs:
        yield _runs(document.runs)
        yield from _stages(document.runs)
    if document.references:
        yield _references(document.references, document.runs)
    if document.latencies:
        yield _latencies(document.latencies)
    if document.throughputs:
        yield _throughputs(document.throughputs)
    if document.memory:
        yield _memory(document.memory)


def _peaks(peaks: Sequence[PeakRecord]) -> str:
    header = ["peak, threads", "fp32 [GFLOP/s]", "bf16 [GFLOP/s]", "int8 [GOP/s]", "copy [GB/s]", "triad [GB/s]"]
    rows = [
        [
            str(peak.threads),
            *(
                "–" if s is None else f"{s.most / 1e9:.1f}"
                for s in (peak.fp32, peak.bf16, peak.int8, peak.copy, peak.triad)
            ),
        ]
        for peak in peaks
    ]
    return markdown(header, rows)


def _runs(runs: Sequence[RunRecord]) -> str:
    header = [
        "model", "precision", "threads", "cloud", "points", "network sees", "detection [ms]", "of it network [ms]",
        "computing time [ms]", "preprocessor [ms]", "messages [ms]", "grasps", "memory [MB]",
    ]  # fmt: skip
    rows = [
        [
            _weighted(run.model, run.weights), run.precision or "–", str(run.threads), run.cloud, str(run.points),
            str(run.seen or "–"), milliseconds(run.total), milliseconds(run.network), f"{1e3 * run.cpu.median:.1f}",
            milliseconds(run.preprocessor), milliseconds(run.messages), str(run.grasps), f"{run.peak_memory / 1e6:.0f}",
        ]
        for run in runs
    ]  # fmt: skip
    return markdown(header, rows)


def _stages(runs: Sequence[RunRecord]) -> Iterator[str]:
    for model, weights, cloud in dict.fromkeys((run.model, run.weights, run.cloud) for run in runs):
        own = [run for run in runs if (run.model, run.weights, run.cloud) == (model, weights, cloud)]
        names = dict.fromkeys((stage.part, stage.name) for run in own for stage in run.stages)
        header = [f"{_weighted(model, weights)} on {cloud} [ms]", *(_variant(run) for run in own)]
        rows = []
        for part, name in names:
            found = [_stage(run, part, name) for run in own]
            prefix = "" if part == "detector" else f"{part}: "
            rows.append([prefix + name, *(_cell(stage) for stage in found)])
        yield markdown(header, rows)


def _stage(run: RunRecord, part: str, name: str) -> StageRecord | None:
    return next((stage for stage in run.stages if (stage.part, stage.name) == (part, name)), None)


def _cell(stage: StageRecord | None) -> str:
    if stage is None:
        return "–"
    text = f"{1e3 * stage.wall.median:.2f}"
    if stage.share is None:
        return text
    rate = f", {stage.needed_flops / stage.wall.median / 1e9:.0f} GFLOP/s" if stage.needed_flops else ""
    return f"{text} ({100 * stage.share:.0f} % of {stage.bound}{rate})"


def _references(references: Sequence[ReferenceRecord], runs: Sequence[RunRecord]) -> str:
    header = [
        "plain padded fp32", "threads", "cloud", "network [ms]", "of it layers [ms]", "with all anchors [ms]",
        "and ours", "network, times faster", "its layers alone, times faster", "cloud to grasps, times faster",
    ]  # fmt: skip
    rows = []
    for item in references:
        plain = [
            item.model, str(item.threads), item.cloud, milliseconds(item.total), milliseconds(item.layers),
            milliseconds(item.all_anchors),
        ]  # fmt: skip
        ours = [run for run in runs if (run.model, run.threads, run.cloud) == (item.model, item.threads, item.cloud)]
        for run in ours:
            ratios = speed_ups(item, run)
            rows.append([*plain, f"{run.precision}, {run.threads} threads", *(f"{ratio:.1f}" for ratio in ratios)])
        if not ours:
            rows.append([*plain, "–", "–", "–", "–"])
    return markdown(header, rows)


def speed_ups(plain: ReferenceRecord, run: RunRecord) -> tuple[float, float, float]:
    """How many times faster a run is than the plain implementation, by medians: the network; our network against the
    plain one's layers alone, as if its searches took no time; and cloud to grasps, with everything else as ours."""
    assert run.network is not None
    network, total = run.network.median, run.total.median
    outside = max(total - network, 0.0)
    return plain.total.median / network, plain.layers.median / network, (outside + plain.total.median) / total


def _latencies(latencies: Sequence[LatencyRecord]) -> str:
    header = [
        "publication to arrival", "threads", "cloud", "points", "total [ms]", "95 % within [ms]", "model [ms]",
        "everything else [ms]", "of it transport [ms]", "preprocessor [ms]", "grasps",
    ]  # fmt: skip
    rows = [
        [
            _weighted(item.model, item.weights), str(item.threads), item.cloud, str(item.points),
            milliseconds(item.total), f"{1e3 * item.slowest:.1f}", milliseconds(item.proposals),
            milliseconds(item.outside), milliseconds(item.transport),
            milliseconds(item.parts.get("preprocessor total")), str(item.grasps),
        ]
        for item in latencies
    ]  # fmt: skip
    return markdown(header, rows)


def _throughputs(throughputs: Sequence[ThroughputRecord]) -> str:
    header = [
        "replayed", "threads", "at a time", "bag", "offered [1/s]", "received [1/s]", "grasps [1/s]", "detection [ms]",
        "cores", "memory [MB]",
    ]  # fmt: skip
    rows = [
        [
            _weighted(item.model, item.weights), str(item.threads), str(item.at_a_time), item.bag,
            f"{item.offered:.1f}", f"{item.received:.1f}", f"{item.sustained:.1f}", f"{item.detection * 1e3:.1f}",
            ", ".join(f"{node.node} {node.cores:.2f}" for node in item.nodes),
            ", ".join(f"{node.node} {node.peak / 1e6:.0f}" for node in item.nodes),
        ]
        for item in throughputs
    ]  # fmt: skip
    return markdown(header, rows)


def _memory(memory: Sequence[MemoryRecord]) -> str:
    header = ["memory", "process", "detections", "steady [MB]", "peak [MB]", "growth in 10,000 [MB]", "grows"]
    rows = [
        [
            _weighted(item.model, item.weights), item.where, str(item.detections), f"{item.steady / 1e6:.1f}",
            f"{item.peak / 1e6:.1f}", f"{item.growth / 1e6:+.2f} ± {item.growth_error / 1e6:.2f}",
            ("yes" if item.grows else "no") if item.conclusive else "too few to say",
        ]
        for item in memory
    ]  # fmt: skip
    return markdown(header, rows)


def _weighted(model: str, weights: str) -> str:
    return f"{model} ({weights})" if weights.startswith("random") else model


def _variant(run: RunRecord) -> str:
    return ", ".join(filter(None, [run.precision, f"{run.threads} thread{'s' if run.threads > 1 else ''}"]))
