"""A study as JSON: its settings and its rates with their errors; the attempts are in the files of the episodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from regnet_core.picking.records import Record
from regnet_core.picking.study import PickSettings
from regnet_core.picking.summary import summarise, summary_record

FORMAT = "regnet-picking-study/1"


def study_document(settings: PickSettings, records: Sequence[Record]) -> dict[str, Any]:
    """What tables and the chart are made of; rates in [0, 1], unknown ones null."""
    weights = {settings.names(cell)["model"]: settings.conditions(cell)["weights"] for cell in settings.cells}
    common = settings.conditions(settings.cells[0])
    return {
        "format": FORMAT,
        "settings": {
            "scenes": list(settings.scenes),
            "models": [{"label": label, "sha256": digest} for label, digest in weights.items()],
            "policies": list(settings.policies),
            "cameras": list(settings.cameras),
            "episodes": settings.episodes,
            "width": settings.width,
            "sensor": settings.sensor,
            "seed": settings.seed,
            "device": settings.device,
            "plan": dataclasses.asdict(settings.plan),
            "physics": dataclasses.asdict(settings.physics),
            "transfer": dataclasses.asdict(settings.transfer),
        },
        "versions": common["versions"],
        "summaries": [summary_record(summary) for summary in summarise(records)],
    }
