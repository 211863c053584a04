"""Whether memory grows: from samples over many detections to a record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from typing import NamedTuple

from benchmarks.models import Precision, choose_model
from benchmarks.records import GROWTH_DETECTIONS, MemoryRecord
from benchmarks.summary import fit_line
from benchmarks.workers import Worker
from regnet_core.checks import check_range

ALLOWED = float(16 << 20)
"""Growth over 10,000 detections that counts as none [bytes]: 1.7 kB each, less than any array of a detection."""
_LOOKS = 200
"""At the memory, over a whole measurement."""
WIDTHS = (0.06, 0.08, 0.10, 0.12)
"""Grippers that take turns [m]."""


class MemorySample(NamedTuple):
    """One look at a process."""

    done: int
    """Detections so far."""
    resident: int
    """[bytes]"""
    peak: int
    """So far [bytes]."""


def memory_record(
    model: str, weights: str, where: str, samples: Sequence[MemorySample], allowed: float, seconds: float
) -> MemoryRecord:
    """What samples say; the first tenth of the detections is warming up.

    Raises:
        InvalidInputError: there are too few samples for a line.
    """
    last = samples[-1].done
    settled = [sample for sample in samples if sample.done > last / 10]
    line = fit_line([sample.done for sample in settled], [sample.resident for sample in settled])
    return MemoryRecord(
        model=model,
        weights=weights,
        where=where,
        detections=last,
        steady=round(median(sample.resident for sample in samples if sample.done >= last / 2)),
        peak=max(sample.peak for sample in samples),
        growth=line.slope * GROWTH_DETECTIONS,
        growth_error=2.0 * line.error * GROWTH_DETECTIONS,
        allowed=allowed,
        seconds=seconds,
    )


def measure_memory(
    model: str,
    clouds: Sequence[str],
    detections: int,
    *,
    threads: int = 2,
    precision: Precision | None = None,
    points: int = 0,
    weights_seed: int = 0,
    allowed: float = ALLOWED,
    say: Callable[[str], None] = print,
) -> MemoryRecord:
    """Detect many times in a process of its own, on several clouds and for several grippers in turn.

    Args:
        model: as ``choose_model`` takes it.
        clouds: as ``read_cloud`` takes them.
        detections: how many.
        threads: of the process.
        precision: None: the processor's choice.
        points: the most points that the preprocessor passes on; 0: as config/regnet.yaml says.
        weights_seed: of random weights.
        allowed: growth over 10,000 detections that counts as none [bytes].
        say: receives a line now and then.

    Raises:
        InvalidInputError: fewer than ten detections are too few for a line.
        BenchmarkError: the measurement cannot be made.
    """
    check_range("detections", detections, 10)
    choice = choose_model(model, weights_seed)
    settings = {
        "model": model,
        "weights_seed": weights_seed,
        "precision": precision or "",
        "widths": list(WIDTHS),
        "clouds": list(clouds),
        "points": points,
    }
    step, samples, seconds = max(1, detections // _LOOKS), list[MemorySample](), 0.0
    with Worker("memory", threads, settings) as worker:
        while not samples or samples[-1].done < detections:
            done = samples[-1].done if samples else 0
            answer = worker.ask(detections=min(step, detections - done))
            samples.append(MemorySample(answer["done"], answer["resident"], answer["peak"]))
            seconds += answer["seconds"]
            if len(samples) % 20 == 0:
                say(f"{samples[-1].done} of {detections} detections, {samples[-1].resident / 1e6:.0f} MB")
    return memory_record(choice.name, choice.weights, "library", samples, allowed, seconds)
