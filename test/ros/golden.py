"""The golden files of tools/make_golden.py, and how near to them a result must be.

On the machine that made them everything agrees to the digits. Elsewhere rounding lets equally good grasps change
places, and a network runs in bf16 or in single precision, whichever the processor is made for: test_golden_files.py.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from live import REPOSITORY

from regnet_core import Grasps

BAGS = {path.parent.name for path in REPOSITORY.glob("bags/*/metadata.yaml")}
FILES: dict[tuple[str, str], dict[str, Any]] = {
    (path.parent.name, path.stem): json.loads(path.read_text())
    for path in sorted((REPOSITORY / "test" / "bags" / "golden").glob("*/*.json"))
}
"""By model and bag."""


@dataclass(frozen=True)
class Tolerance:
    """How far a result may be from a golden file."""

    best: int
    """So many of the best grasps are compared."""
    among: int
    """Each with so many of the best ones of the file."""
    alike: float
    """Share of them that must be like one of those."""
    position: float
    """[m]"""
    angle: float
    """Of approach and closing direction [degrees]."""
    quality: float
    width: float = 0.003
    """[m]"""
    count: float = 0.1
    """Of any number of points or grasps, as a share of it."""
    score: float = 0.03
    """Of the selected grasp."""


ANTIPODAL = Tolerance(best=1, among=10, alike=1.0, position=0.005, angle=5.0, quality=0.02)
NETWORK = Tolerance(best=10, among=30, alike=0.8, position=0.01, angle=10.0, quality=0.03)


def tolerance(model: str) -> Tolerance:
    """That of a model."""
    return ANTIPODAL if model == "antipodal" else NETWORK


def assert_count(found: int, expected: int, limits: Tolerance) -> None:
    """Fail where a number of points or grasps is too different."""
    assert abs(found - expected) <= max(2.0, limits.count * expected), f"{found} instead of {expected}"


def assert_alike(grasps: Grasps, file: Sequence[dict[str, Any]], limits: Tolerance) -> None:
    """Fail unless most of the best grasps are like one of the best ones of a golden file."""
    best, others = grasps[: limits.best], file[: limits.among]
    alike = np.array([any(_alike(grasp, other, limits) for other in others) for grasp in best])
    assert alike.mean() >= limits.alike, f"{best[~alike]} are like none of {others}"


def _alike(grasp: Grasps, other: dict[str, Any], limits: Tolerance) -> bool:
    cos = np.cos(np.radians(limits.angle))
    return bool(
        np.linalg.norm(grasp.translation[0] - other["position"]) < limits.position
        and grasp.approach[0] @ other["approach"] > cos
        and abs(grasp.closing[0] @ other["closing"]) > cos
        and abs(grasp.width[0] - other["width"]) < limits.width
        and abs(grasp.quality[0] - other["quality"]) < limits.quality
    )
