"""An episode as a JSON document, from which tables are made and attempts are watched again."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from regnet_core.data.storage.tars import write_whole
from regnet_core.errors import InvalidInputError
from regnet_core.grasps import Grasps
from regnet_core.picking.episode import EpisodeResult, Step
from regnet_core.picking.snapshot import Snapshot

FORMAT = "regnet-picking/1"
Record = Mapping[str, Any]


def episode_record(
    result: EpisodeResult, cell: Mapping[str, str], episode: int, objects: tuple[str, ...], conditions: Record
) -> dict[str, Any]:
    """Everything about an episode.

    Args:
        result: what happened.
        cell: scene, model, policy and camera, by their names.
        episode: its number.
        objects: names of the objects, in their order.
        conditions: all else that it depends on.
    """
    return {
        "format": FORMAT,
        "cell": dict(cell),
        "episode": episode,
        "conditions": dict(conditions),
        "objects": list(objects),
        "end": result.end,
        "reason": result.reason,
        "attempts": [_attempt_record(step) for step in result.steps],
        "after": _rows(result.after),
    }


def _attempt_record(step: Step) -> dict[str, Any]:
    grasp, record, verdict = step.plan.grasp, step.attempt.record, step.attempt.verdict
    return {
        "failure": None if verdict.failure is None else verdict.failure.value,
        "message": verdict.message,
        "placed": list(step.attempt.placed),
        "lifted": list(record.lifted),
        "gripped": [list(side) for side in record.gripped],
        "blocked": record.blocked,
        "contact": record.contact,
        "stopped": record.stopped,
        "lost": record.lost,
        "closed_to": record.opening if math.isfinite(record.opening) else None,
        "simulated_seconds": round(record.duration, 6),
        "grasp": {
            "rotation": grasp.rotation[0].tolist(),
            "translation": grasp.translation[0].tolist(),
            "width": float(grasp.width[0]),
            "quality": float(grasp.quality[0]),
            "vertical_score": float(grasp.vertical_score[0]),
            "confidence": float(grasp.confidence[0]),
        },
        "score": step.plan.score,
        "found": step.plan.found,
        "detection_seconds": step.plan.seconds,
        "before": _rows(step.before),
    }


def write_record(path: Path, record: Record) -> None:
    """Write it, whole or not at all; an attempt is a line."""
    rows = ",\n  ".join(json.dumps(attempt, allow_nan=False) for attempt in record["attempts"])
    frame = json.dumps({**record, "attempts": "ROWS"}, indent=1, allow_nan=False)
    write_whole(path, (frame.replace('"ROWS"', f"[\n  {rows}\n ]" if rows else "[]") + "\n").encode())


def read_record(path: Path) -> dict[str, Any]:
    """Reads what `write_record` wrote.

    Raises:
        InvalidInputError: there is no such file, or it is something else.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["format"] == FORMAT:
            return dict(record)
        reason = f"its format is {record['format']!r}, not {FORMAT!r}"
    except OSError as error:
        reason = str(error)
    except (ValueError, KeyError, TypeError) as error:
        reason = repr(error)
    raise InvalidInputError(f"'{path}' holds no picking episode: {reason}")


def recorded_grasp(attempt: Record) -> Grasps:
    """The grasp of a recorded attempt, exactly as it was tried."""
    grasp = attempt["grasp"]
    return Grasps(
        np.array([grasp["rotation"]], np.float64),
        np.array([grasp["translation"]], np.float64),
        *(np.array([grasp[name]]) for name in ("width", "quality", "vertical_score", "confidence")),
    )


def recorded_state(rows: list[list[float] | None]) -> Snapshot:
    """Where the objects were, as a record has it."""
    return Snapshot(tuple(None if row is None else tuple(row) for row in rows))


def _rows(state: Snapshot) -> list[list[float] | None]:
    return [None if row is None else list(row) for row in state.rows]
