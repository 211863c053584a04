"""What ``regnet detect`` found, as JSON and as .npz."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from regnet_core import __version__
from regnet_core.cli.inputs import CloudInput
from regnet_core.detector import Detection
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, quaternion_from_matrix
from regnet_core.policy import Policy, Selection, select

OUT_SUFFIXES = (".json", ".npz")


@dataclass(frozen=True)
class Result:
    """One detection and the grasp that was selected from it."""

    source: CloudInput
    detection: Detection
    policy: str
    scores: Array
    """(M,): the policy's score of each grasp."""
    selection: Selection | None

    @classmethod
    def of(cls, source: CloudInput, detection: Detection, policy: Policy) -> Result:
        """Score the grasps and select one."""
        grasps = detection.grasps
        scores = policy.score(grasps.quality, grasps.vertical_score)
        return cls(source, detection, policy.name, scores, select(grasps, policy))


def as_document(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The JSON document that ``--json`` prints and ``--out`` writes."""
    return {"regnet_version": __version__, "results": list(results)}


def as_record(result: Result) -> dict[str, Any]:
    """One result in plain types; lengths in m, ranks from 0, poses in ``frame`` (null: the file's own frame)."""
    source, detection = result.source, result.detection
    report = detection.report
    return {
        "source": {
            "file": str(source.file),
            "topic": source.topic,
            "message": source.message,
            "stamp_ns": source.stamp_ns,
            "points": len(source.points),
        },
        "frame": source.frame,
        "gripper": asdict(detection.gripper),
        "model": report.model,
        "device": report.device,
        "steps": [asdict(step) for step in report.steps],
        "total_seconds": report.total_seconds,
        "reason": report.reason,
        "warnings": list(report.warnings),
        "policy": result.policy,
        "selected": None
        if result.selection is None
        else {"rank": result.selection.rank, "score": result.selection.score},
        "grasps": _grasp_records(result),
    }


def write_results(path: Path, records: Sequence[dict[str, Any]], detections: Sequence[Detection]) -> None:
    """Write all records as .json, or the grasps of the only detection as .npz."""
    if path.suffix == ".npz":
        detections[0].grasps.save(path)
    else:
        path.write_text(json.dumps(as_document(records), indent=1) + "\n", encoding="utf-8")


def check_out(path: Path, count: int) -> None:
    """Refuse early what ``write_results`` could not do for ``count`` results, and make the folder.

    Raises:
        InvalidInputError: the suffix is unknown, the folder cannot be made, or an .npz would hold several results.
    """
    if path.suffix not in OUT_SUFFIXES:
        raise InvalidInputError(f"--out must end in {' or '.join(OUT_SUFFIXES)}, got '{path.name}'")
    if path.suffix == ".npz" and count > 1:
        raise InvalidInputError(
            f"an .npz holds the grasps of one result, but there will be {count}: give one cloud and one width, "
            "or write .json"
        )
    make_folder(path, "--out")


def make_folder(path: Path, option: str) -> None:
    """Make the folder that ``path`` names where it is missing.

    Raises:
        InvalidInputError: it cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"{option}: the folder '{path.parent}' cannot be made: {error.strerror}") from error


def _grasp_records(result: Result) -> list[dict[str, Any]]:
    grasps = result.detection.grasps
    if len(grasps) == 0:
        return []
    columns = {
        "rank": list(range(len(grasps))),
        "translation": grasps.translation.tolist(),
        "rotation": grasps.rotation.tolist(),
        "quaternion_xyzw": quaternion_from_matrix(grasps.rotation).tolist(),
        "width": grasps.width.tolist(),
        "quality": grasps.quality.tolist(),
        "vertical_score": grasps.vertical_score.tolist(),
        "confidence": grasps.confidence.tolist(),
        "policy_score": result.scores.tolist(),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
