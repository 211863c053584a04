"""Means, standard errors and JSON of results that are written by hand."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from regnet_core.data.storage.archive import SceneArchive
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.bars import draw_bars
from regnet_core.evaluation.curves import draw_curves
from regnet_core.evaluation.document import read_document, study_document, write_document
from regnet_core.evaluation.leads import leads
from regnet_core.evaluation.metrics import SceneMetrics
from regnet_core.evaluation.study import StudySettings, Times, ViewResult
from regnet_core.evaluation.summary import estimate, summarise


def result(
    model: str,
    scene: int,
    width: float,
    cfr: float,
    outcome: str | None = None,
    kind: str = "pile",
    labels: int = 5,
    seed: int = 0,
) -> ViewResult:
    metrics = SceneMetrics(width, 9, 9, 9, 9, labels, cfr, cfr / 2, cfr / 4, cfr / 5, cfr / 3)
    return ViewResult(model, scene, 0, kind, metrics, Times(0.1 * (scene + 1), 0.3 * (scene + 1)), outcome, seed)


def test_an_error_of_single_values_is_that_of_a_mean() -> None:
    values = [0.2, 0.5, 0.9, 1.0]
    found = estimate(values, [0, 1, 2, 3])
    assert found.mean == pytest.approx(0.65)
    assert found.error == pytest.approx(np.std(values, ddof=1) / 2.0)


def test_values_of_one_scene_do_not_count_as_independent() -> None:
    """Two scenes with four equal values each tell no more than two with one each."""
    once = estimate([0.2, 0.8], [0, 1])
    often = estimate([0.2] * 4 + [0.8] * 4, [0] * 4 + [1] * 4)
    assert often.mean == pytest.approx(once.mean) and often.error == pytest.approx(once.error)
    opposite = estimate([0.2, 0.8, 0.8, 0.2], [0, 0, 1, 1])
    assert opposite.error == pytest.approx(0.0)


def test_what_is_unknown_is_left_out() -> None:
    found = estimate([0.2, math.nan, 0.8, math.nan], [0, 0, 1, 2])
    assert found == pytest.approx(estimate([0.2, 0.8], [0, 1]))
    assert math.isnan(estimate([0.4, 0.6], [7, 7]).error) and estimate([0.4, 0.6], [7, 7]).mean == 0.5
    assert math.isnan(estimate([math.nan], [0]).mean)


RESULTS = [
    result("a", 0, 0.06, 1.0, "held"),
    result("b", 0, 0.06, 0.5, "no grasp"),
    result("a", 0, 0.08, 0.6, "missed"),
    result("b", 0, 0.08, math.nan, None, labels=0),
    result("a", 1, 0.06, 0.8, "held", kind="bin"),
    result("b", 1, 0.06, 0.3, "collision", kind="bin"),
    result("a", 1, 0.08, 0.2, "held", kind="bin"),
    result("b", 1, 0.08, 0.1, "held", kind="bin"),
]


SEEDS = [
    result(model, scene, 0.08, cfr, seed=seed)
    for seed, values in ((4, {"a": (0.9, 0.7), "b": (0.5, 0.5), "c": (0.1, 0.9)}),
                         (5, {"a": (0.8, 0.8), "b": (0.4, 0.2), "c": (math.nan, 0.6)}))
    for model, both in values.items()
    for scene, cfr in enumerate(both)
]  # fmt: skip


def test_spread_is_that_of_the_seeds_means() -> None:
    a, b, c = summarise(SEEDS)[:3]
    assert a.spread["cfr"] == pytest.approx(0.0) and a.errors["cfr"] == pytest.approx(0.05)
    assert b.spread["cfr"] == pytest.approx(np.std([0.5, 0.3], ddof=1))
    assert c.spread["cfr"] == pytest.approx(np.std([0.5, 0.6], ddof=1))  # what is unknown is left out
    assert all(math.isnan(value) for value in summarise(RESULTS)[0].spread.values())


def test_lead_of_the_best_is_taken_scene_by_scene() -> None:
    (lead, *others) = leads(SEEDS)
    assert (lead.metric, lead.best, lead.second) == ("cfr", "a", "c")  # means 0.8, 0.4 and 0.533
    # Scenes 0 and 1 of seed 4, and scene 1 of seed 5: in its scene 0 the second has no value.
    differences, scenes = [0.8, -0.2, 0.2], [0, 1, 1]
    assert lead.difference == pytest.approx(np.mean(differences))
    assert lead.error == pytest.approx(estimate(differences, scenes).error)
    assert lead.spread == pytest.approx(np.std([0.3, 0.2], ddof=1))
    assert [other.metric for other in others] == ["antipodal", "antipodal_with_collisions", "coverage"]
    assert leads([one for one in SEEDS if one.model == "a"]) == []


def test_summaries_are_of_all_then_of_each_width_then_of_each_kind() -> None:
    rows = summarise(RESULTS)
    heads = [(row.model, row.width, row.kind) for row in rows]
    assert heads == [
        ("a", None, None), ("b", None, None),
        ("a", 0.06, None), ("b", 0.06, None), ("a", 0.08, None), ("b", 0.08, None),
        ("a", None, "pile"), ("b", None, "pile"), ("a", None, "bin"), ("b", None, "bin"),
    ]  # fmt: skip
    every = rows[0]
    assert (every.scenes, every.means.scenes) == (2, 4)
    assert every.means.cfr == pytest.approx(0.65) and every.means.coverage == pytest.approx(0.13)
    # Deviations by scene: 0.35 - 0.05 = 0.3 and 0.15 - 0.45 = -0.3; sqrt(2 * (0.09 + 0.09)) / 4.
    assert every.errors["cfr"] == pytest.approx(0.15)
    assert every.times.proposals == pytest.approx(0.15) and every.times.total == pytest.approx(0.45)
    assert every.times.processing == pytest.approx(0.3)
    assert rows[5].means.cfr == 0.1  # the scene with nothing to find is left out
    assert rows[8].means.cfr == pytest.approx(0.5)


def test_a_method_without_a_grasp_has_failed_and_one_with_nothing_to_find_has_not() -> None:
    held = [row.held for row in summarise(RESULTS)[:2]]
    assert held[0] is not None and held[1] is not None
    assert (held[0].tried, held[0].rate.mean) == (4, 0.75)
    assert dict(held[0].outcomes) == {"held": 3, "missed": 1}
    assert (held[1].tried, held[1].rate.mean) == (3, pytest.approx(1 / 3))
    assert dict(held[1].outcomes) == {"no grasp": 1, "collision": 1, "held": 1}
    assert summarise([result("a", 0, 0.06, 1.0)])[0].held is None


def test_a_document_comes_back_from_its_file(tiny: SceneArchive, tmp_path: Path) -> None:
    weights = tmp_path / "run" / "weights.safetensors"
    weights.parent.mkdir()
    weights.write_bytes(b"abc")
    settings = StudySettings(("a", str(weights)), (0.06, 0.10), (0, 1), simulate=True)
    document = study_document(tiny, settings, RESULTS, workers=2)
    path = tmp_path / "out.json"
    write_document(path, document)
    assert read_document(path) == document
    text = path.read_text()
    assert "NaN" not in text and str(tmp_path) not in text
    assert json.loads(text)["settings"]["models"] == [
        {"label": "a", "sha256": None},
        {"label": "run", "sha256": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"},
    ]
    views = document["views"]
    row = dict(zip(views["columns"], views["rows"][3], strict=True))
    assert (row["model"], row["scene"], row["width"], row["cfr"], row["outcome"]) == ("b", 0, 0.08, None, None)
    assert len(views["rows"]) == 8
    assert document["summaries"][0]["held"]["mean"] == 0.75 and document["summaries"][0]["errors"]["cfr"] == 0.15
    assert {"numpy", "torch", "regnet_ros"} <= set(document["versions"])


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "regnet-scenes/1"}'])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match="holds no evaluation"):
        read_document(path)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="holds no evaluation"):
        read_document(tmp_path / "none.json")


def _picture(archive: SceneArchive, path: Path, rows: list[ViewResult], widths: tuple[float, ...]) -> np.ndarray:
    settings = StudySettings(("a", "b"), (0.06, 0.08), (0, 1), simulate=rows is RESULTS)
    draw_curves(study_document(archive, settings, rows, 1), path, widths)
    return np.asarray(Image.open(path).convert("RGB"))


def test_the_picture_has_every_method_and_the_widths_of_the_training(tiny: SceneArchive, tmp_path: Path) -> None:
    executed = _picture(tiny, tmp_path / "folder" / "a.png", RESULTS, (0.06,))
    unmarked = _picture(tiny, tmp_path / "b.png", RESULTS, ())
    # A method without any result for a width, and nothing executed.
    rows = [result("a", 0, 0.06, 1.0), result("a", 0, 0.08, 0.5), result("b", 0, 0.06, math.nan, labels=0)]
    plain = _picture(tiny, tmp_path / "c.png", rows, ())
    colours = {tuple(colour) for colour in np.unique(executed.reshape(-1, 3), axis=0).tolist()}
    assert {(0x1B, 0x6E, 0x9C), (0xC0, 0x39, 0x2B)} <= colours
    assert executed.shape == unmarked.shape and (executed != unmarked).any(axis=2).sum() > 1000
    assert plain.shape[1] < executed.shape[1]  # one panel less across


def test_one_width_is_drawn_as_bars(tiny: SceneArchive, tmp_path: Path) -> None:
    settings = StudySettings(("a", "b", "c"), (0.08,), (0, 1))
    path = tmp_path / "folder" / "bars.png"
    draw_bars(study_document(tiny, settings, SEEDS, 1), path)
    picture = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    first, second = (int((picture == colour).all(axis=1).sum()) for colour in ((0x1B, 0x6E, 0x9C), (0xC0, 0x39, 0x2B)))
    assert first > second > 0  # a's bars are longer than b's


@pytest.mark.parametrize("cfr", [0.4, 0.0, math.nan])
def test_bars_of_a_single_scene_have_no_errors(tiny: SceneArchive, tmp_path: Path, cfr: float) -> None:
    rows = [result("a", 0, 0.08, cfr), result("b", 0, 0.08, cfr)]
    path = tmp_path / "one.png"
    draw_bars(study_document(tiny, StudySettings(("a", "b"), (0.08,), (0,)), rows, 1), path)
    assert path.stat().st_size > 5_000
