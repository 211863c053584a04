"""Stages, peaks and the plain reference, measured by worker processes that take turns.

Every combination of model, precision and number of threads has a process of its own, as the node's would be. In each
round every process measures once, in alternating order, so that whatever else the machine does meets all alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from benchmarks.analysis import peak_record, run_record
from benchmarks.machine import LoadMeter
from benchmarks.models import PRECISIONS, ModelChoice, Precision, choose_model
from benchmarks.records import Load, PeakRecord, ReferenceRecord, RunRecord
from benchmarks.summary import Summary
from benchmarks.workers import Worker
from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.nn.zoo import network_config

QUIET = 0.1
"""Fewer busy cores than this are next to none."""
Say = Callable[[str], None]


@dataclass(frozen=True)
class MatrixSettings:
    """What to measure.

    Raises:
        InvalidInputError: a number is out of range, or there is nothing to measure.
    """

    models: tuple[str, ...]
    """As ``choose_model`` takes them."""
    precisions: tuple[Precision, ...] = PRECISIONS
    threads: tuple[int, ...] = (1, 2)
    clouds: tuple[str, ...] = ("bags/clutter_20",)
    """As ``read_cloud`` takes them; the plain reference gets the first."""
    points: int = 0
    """The most points that the preprocessor passes on; 0: as config/regnet.yaml says."""
    crop: tuple[float, ...] = ()
    """Lower and upper corner of the preprocessor's workspace, six numbers [m]; empty: nothing is cropped."""
    width: float = 0.08
    """Of the gripper [m]."""
    repetitions: int = 20
    warm_up: int = 3
    """Rounds that do not count."""
    references: tuple[str, ...] = ()
    """Networks to measure the plain implementation of."""
    reference_repetitions: int = 3
    weights_seed: int = 0
    peak_side: int = 2048
    """Of the matrices that the peak is measured with."""
    peak_bytes: int | None = None
    """Size of the arrays that the peak is measured with; None: by the cache's size."""

    def __post_init__(self) -> None:
        for name in ("repetitions", "reference_repetitions"):
            check_range(name, getattr(self, name), 1)
        for name in ("points", "warm_up", "weights_seed"):
            check_range(name, getattr(self, name), 0)
        for count in self.threads:
            check_range("threads", count, 1, 1024)
        for name in ("threads", "clouds", "precisions"):
            if not getattr(self, name):
                raise InvalidInputError(f"{name} must name at least one")


@dataclass(frozen=True)
class MatrixResult:
    """What was measured."""

    peaks: tuple[PeakRecord, ...]
    runs: tuple[RunRecord, ...]
    references: tuple[ReferenceRecord, ...]
    load: Load


@dataclass
class _Cell:
    """A worker and what it answered."""

    worker: Worker
    choice: ModelChoice
    precision: str
    threads: int
    answers: list[list[dict[str, Any]]]
    """Of every cloud."""

    def measure(self, timed_first: bool) -> None:
        for cloud, answers in enumerate(self.answers):
            answers.append(self.worker.ask(cloud=cloud, timed_first=timed_first))


@dataclass
class _Reference:
    worker: Worker
    model: str
    threads: int
    usual: list[dict[str, Any]] = field(default_factory=list)
    all_anchors: list[dict[str, Any]] = field(default_factory=list)

    def measure(self) -> None:
        self.usual.append(self.worker.ask(all_anchors=False))
        self.all_anchors.append(self.worker.ask(all_anchors=True))


def measure_matrix(settings: MatrixSettings, say: Say = print) -> MatrixResult:
    """Measure every model in every precision with every number of threads.

    Args:
        settings: what.
        say: receives a line for each step.

    Raises:
        BenchmarkError: a measurement cannot be made.
        ModelError: there is no such model.
    """
    with ExitStack() as stack:
        peaks = {count: stack.enter_context(_peak_worker(settings, count)) for count in settings.threads}
        cells = _cells(settings, stack, say)
        references = [_reference(settings, stack, model, say) for model in settings.references]
        processes = [*peaks.values(), *(cell.worker for cell in cells), *(item.worker for item in references)]
        found: dict[int, list[dict[str, Any]]] = {count: [] for count in peaks}
        loads = []
        for number in range(settings.warm_up + settings.repetitions):
            if number == settings.warm_up:
                _forget(cells, references)
            meter = LoadMeter(worker.pid for worker in processes)
            for count, worker in peaks.items():
                found[count].append(worker.ask())
            for cell in cells if number % 2 == 0 else reversed(cells):
                cell.measure(timed_first=number % 2 == 1)
            if number == 0 or settings.warm_up <= number < settings.warm_up + settings.reference_repetitions:
                for item in references:
                    item.measure()
            loads.append(meter.others())
            say(f"round {number + 1} of {settings.warm_up + settings.repetitions}, others used {loads[-1]:.2f} cores")
        return _result(settings, found, cells, references, loads)


def load_of(others: Sequence[float]) -> Load:
    """The record of how many cores others kept busy at each look."""
    return Load(Summary.of(others), sum(value < QUIET for value in others) / len(others))


def load_warning(load: Load) -> str:
    """What to say of a machine that was not quiet; empty where it was."""
    if load.share_quiet >= 0.9:
        return ""
    return (
        f"other processes kept {load.others.median:.2f} cores busy (up to {load.others.most:.2f}): the times are not "
        "those of this machine; measure again when it is quiet"
    )


def _peak_worker(settings: MatrixSettings, threads: int) -> Worker:
    return Worker("peaks", threads, {"side": settings.peak_side, "array_bytes": settings.peak_bytes})


def _cells(settings: MatrixSettings, stack: ExitStack, say: Say) -> list[_Cell]:
    cells = []
    for text in settings.models:
        choice = choose_model(text, settings.weights_seed)
        for precision in settings.precisions if choice.is_network else ("",):
            for threads in settings.threads:
                say(f"making ready: {choice.name} {precision} with {threads} thread{'s' if threads > 1 else ''}")
                worker = stack.enter_context(
                    Worker(
                        "detection",
                        threads,
                        {
                            "model": text,
                            "weights_seed": settings.weights_seed,
                            "precision": precision,
                            "width": settings.width,
                            "clouds": list(settings.clouds),
                            "points": settings.points,
                            "crop": list(settings.crop),
                        },
                    )
                )
                cells.append(_Cell(worker, choice, precision, threads, [[] for _ in settings.clouds]))
    return cells


def _reference(settings: MatrixSettings, stack: ExitStack, model: str, say: Say) -> _Reference:
    threads = max(settings.threads)
    say(f"making ready: the plain implementation of {model} with {threads} thread{'s' if threads > 1 else ''}")
    worker = stack.enter_context(
        Worker(
            "reference",
            threads,
            {
                "model": model,
                "weights_seed": settings.weights_seed,
                "width": settings.width,
                "cloud": settings.clouds[0],
                "points": settings.points,
                "crop": list(settings.crop),
            },
        )
    )
    return _Reference(worker, choose_model(model, settings.weights_seed).name, threads)


def _forget(cells: Sequence[_Cell], references: Sequence[_Reference]) -> None:
    """The rounds so far do not count."""
    for cell in cells:
        for answers in cell.answers:
            answers.clear()
    for item in references:
        item.usual.clear()
        item.all_anchors.clear()


def _result(
    settings: MatrixSettings,
    found: dict[int, list[dict[str, Any]]],
    cells: Sequence[_Cell],
    references: Sequence[_Reference],
    loads: Sequence[float],
) -> MatrixResult:
    peaks = {count: peak_record(count, answers) for count, answers in found.items()}
    runs = []
    for cell in cells:
        network = cell.worker.facts["network"]
        for cloud, answers in zip(cell.worker.facts["clouds"], cell.answers, strict=True):
            labels = {
                "model": cell.choice.name,
                "weights": cell.choice.weights,
                "precision": cell.precision,
                "threads": cell.threads,
                "cloud": cloud["name"],
                "points": cloud["points"],
                "prepared": cloud["prepared"],
            }
            config = network_config(network) if network else None
            runs.append(run_record(labels, answers, config, peaks[cell.threads]))
    cloud = cells[0].worker.facts["clouds"][0]["name"] if cells else settings.clouds[0]
    return MatrixResult(
        tuple(peaks.values()),
        tuple(runs),
        tuple(_reference_record(item, cloud) for item in references),
        load_of(loads[settings.warm_up :]),
    )


def _reference_record(item: _Reference, cloud: str) -> ReferenceRecord:
    return ReferenceRecord(
        model=item.model,
        threads=item.threads,
        cloud=cloud,
        seen=int(item.worker.facts["points"]),
        total=Summary.of([a["wall"] for a in item.usual]),
        searches=Summary.of([a["searches"] for a in item.usual]),
        layers=Summary.of([a["wall"] - a["searches"] for a in item.usual]),
        all_anchors=Summary.of([a["wall"] for a in item.all_anchors]),
        difference=max(float(a["difference"]) for a in item.usual),
    )
