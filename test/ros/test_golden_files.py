"""The golden files of networks hold with every number format, so that any processor can be compared with them."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
from golden import BAGS, FILES, assert_alike, assert_count, tolerance
from live import REPOSITORY

from regnet_core import Grasps, models
from regnet_core.models import DEFAULT_MODEL
from regnet_core.nn import precision

MODELS = sorted({model for model, _ in FILES})


@pytest.fixture(scope="module")
def make_golden() -> ModuleType:
    specification = importlib.util.spec_from_file_location("make_golden", REPOSITORY / "tools" / "make_golden.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_there_are_files_of_every_bag_for_each_model() -> None:
    assert {"antipodal", DEFAULT_MODEL} <= set(MODELS)
    assert {model: {bag for m, bag in FILES if m == model} for model in MODELS} == dict.fromkeys(MODELS, BAGS)
    assert len(BAGS) >= 5


@pytest.fixture
def nothing_loaded() -> Iterator[None]:
    """Networks are made ready for the processor when they are loaded, and kept."""
    models._network.cache_clear()
    yield
    models._network.cache_clear()


@pytest.mark.usefixtures("nothing_loaded")
@pytest.mark.parametrize("numbers", ["int8", "bf16", "fp32"])
@pytest.mark.parametrize("model", [model for model in MODELS if model != "antipodal"])
def test_every_number_format_gives_what_the_file_says(
    model: str, numbers: str, make_golden: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precision, "cpu_precision", lambda: numbers)
    limits = tolerance(model)
    for bag in sorted(BAGS):
        found = make_golden.golden(REPOSITORY / "bags" / bag, model)
        for cloud, expected in zip(found["clouds"], FILES[model, bag]["clouds"], strict=True):
            assert_count(cloud["grasps"], expected["grasps"], limits)
            assert cloud["has_reason"] == expected["has_reason"]
            assert cloud["steps"] == expected["steps"]
            if cloud["best"]:
                assert_alike(_grasps(cloud["best"]), expected["best"], limits)
                assert cloud["selected_score"] == pytest.approx(expected["selected_score"], abs=limits.score)


def _grasps(best: list[dict]) -> Grasps:
    approach, closing = (np.array([grasp[axis] for grasp in best]) for axis in ("approach", "closing"))
    rotation = np.stack([approach, closing, np.cross(approach, closing)], axis=-1)
    columns = (np.array([grasp[name] for grasp in best]) for name in ("position", "width", "quality"))
    return Grasps.from_poses(rotation, *columns)
