"""A study as JSON: its settings, its means with their errors, and the result of every view."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from regnet_core.data.storage.archive import SceneArchive
from regnet_core.data.storage.manifest import checksum, library_versions
from regnet_core.data.storage.tars import write_whole
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.leads import leads
from regnet_core.evaluation.metrics import SceneMetrics
from regnet_core.evaluation.study import StudySettings, ViewResult, model_labels
from regnet_core.evaluation.summary import Summary, summarise
from regnet_core.models import is_weights_path
from regnet_core.weights import network_names, weights_file

FORMAT = "regnet-evaluation/2"
_METRICS = tuple(field.name for field in fields(SceneMetrics))
_DIGITS = 6
"""Of all numbers."""


def study_document(
    archive: SceneArchive,
    settings: StudySettings,
    results: Sequence[ViewResult],
    workers: int,
    networks: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Everything that tables and figures are made of; NaN is null.

    Args:
        archive: the data set.
        settings: of the study; where there were several seeds, with the first one.
        results: of all seeds.
        workers: how many processes there were.
        networks: what tells the networks among the methods apart (``network_records``).
    """
    return _plain(
        {
            "format": FORMAT,
            "settings": settings_record(archive, settings) | {"seeds": sorted({result.seed for result in results})},
            "machine": {"workers": workers, "cores": os.cpu_count(), "processor": platform.machine()},
            "versions": {**library_versions(), "torch": _torch_version()},
            "summaries": [summary_record(summary) for summary in summarise(results)],
            "leads": [asdict(lead) for lead in leads(results)],
            "networks": list(networks),
            "views": {"columns": view_columns(), "rows": [view_row(result) for result in results]},
        }
    )


def settings_record(archive: SceneArchive, settings: StudySettings) -> dict[str, Any]:
    """What the results depend on; weights are told by their checksum, not by where they lie."""
    data, labels = archive.manifest.settings, model_labels(settings.models)
    return {
        "data": {"split": data.split, "seed": data.seed, "scenes": data.scenes, "complete": archive.manifest.complete},
        "models": [_model_record(model, label) for model, label in labels.items()],
        "widths": settings.widths,
        "scenes": settings.scenes,
        "views": "all" if settings.all_views else "one",
        "clouds": settings.clouds.settings(),
        "seed": settings.seed,
        "device": settings.device,
        "simulate": settings.simulate,
        "metrics": asdict(settings.metrics),
    }


def summary_record(summary: Summary) -> dict[str, Any]:
    """One method's means, flat but for ``errors`` and ``held``; times in seconds."""
    means = asdict(summary.means)
    held = summary.held
    return {
        "model": summary.model,
        "width": summary.width,
        "kind": summary.kind,
        "results": means.pop("scenes"),
        "scenes": summary.scenes,
        **means,
        "errors": dict(summary.errors),
        "spread": dict(summary.spread),
        "proposal_seconds": summary.times.proposals,
        "processing_seconds": summary.times.processing,
        "total_seconds": summary.times.total,
        "held": held and {"tried": held.tried, **held.rate._asdict(), "outcomes": dict(held.outcomes)},
    }


def view_columns() -> list[str]:
    """Names of the columns of ``view_row``."""
    return ["model", "seed", "scene", "view", "kind", *_METRICS, "proposal_seconds", "total_seconds", "outcome"]


def view_row(result: ViewResult) -> list[Any]:
    """One result."""
    numbers = [getattr(result.metrics, name) for name in _METRICS]
    return [result.model, result.seed, result.scene, result.view, result.kind, *numbers, *result.times, result.outcome]


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write it, whole or not at all; a row of ``views`` is a line."""
    rows = ",\n  ".join(json.dumps(row, allow_nan=False) for row in document["views"]["rows"])
    frame = json.dumps({**document, "views": {**document["views"], "rows": "ROWS"}}, indent=1, allow_nan=False)
    write_whole(path, (frame.replace('"ROWS"', f"[\n  {rows}\n ]") + "\n").encode())


def read_document(path: Path) -> dict[str, Any]:
    """Reads what ``write_document`` wrote.

    Raises:
        InvalidInputError: there is no such file, or it is something else.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["format"] == FORMAT:
            return dict(document)
        reason = f"its format is {document['format']!r}, not {FORMAT!r}"
    except OSError as error:
        reason = str(error)
    except (ValueError, KeyError, TypeError) as error:
        reason = repr(error)
    raise InvalidInputError(f"'{path}' holds no evaluation: {reason}")


def _model_record(model: str, label: str) -> dict[str, Any]:
    weights = Path(model).expanduser() if is_weights_path(model) else None
    if model in network_names():
        weights = weights_file(model).path
    return {"label": label, "sha256": weights and checksum(weights)}


def _torch_version() -> str:
    try:
        return version("torch")
    except PackageNotFoundError:
        return "not installed"


def _plain(value: Any) -> Any:
    """With lists for tuples, null for NaN, and numbers of a few digits."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return round(value, _DIGITS) if math.isfinite(value) else None
    return value
