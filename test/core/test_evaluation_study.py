"""Studies on a tiny data set: the same results whatever worker, named scenes in errors, and physics."""

import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from regnet_core.cli import main
from regnet_core.data.generation.executors import LocalExecutor
from regnet_core.data.objects.models import ObjectModel, build_mesh
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.errors import InvalidInputError, ModelError
from regnet_core.evaluation.execution import NO_GRASP, Execution
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.evaluation.methods import MAIN_TABLE, main_table
from regnet_core.evaluation.metrics import MetricConfig
from regnet_core.evaluation.observed import RecordedViews
from regnet_core.evaluation.study import (
    EvaluationError,
    StudySettings,
    ViewResult,
    device_of,
    model_labels,
    run_seeds,
    run_study,
    views_of,
)
from regnet_core.evaluation.variants import network_records
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.models import available_models
from regnet_core.sim.outcome import Outcome

DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: approach -z, closing +y, their cross product +x."""
GRIPPER = Gripper(width=0.08)
SETTINGS = StudySettings(
    models=("random", "antipodal"),
    widths=(0.06, 0.10),
    scenes=(0, 1, 2),
    clouds=RecordedViews(6000),
    metrics=MetricConfig(checked=200, kept=20),
)


def without_times(results: list[ViewResult]) -> list[tuple[Any, ...]]:
    """What must be the same in each run; NaN as None."""
    plain = [(r.model, r.scene, r.view, r.kind, r.outcome, *vars(r.metrics).values()) for r in results]
    return [tuple(None if value != value else value for value in row) for row in plain]


@pytest.fixture(scope="module")
def results(tiny_folder: Path) -> list[ViewResult]:
    """Of SETTINGS, by two workers."""
    return run_study(SceneArchive(tiny_folder), SETTINGS, LocalExecutor(2))


def test_results_are_complete_and_in_order(results: list[ViewResult], tiny: SceneArchive) -> None:
    heads = [(r.scene, r.metrics.width, r.model) for r in results]
    assert heads == [(s, w, m) for s in (0, 1, 2) for w in SETTINGS.widths for m in SETTINGS.models]
    assert all(r.view == r.scene % 2 and r.kind == tiny.info(r.scene).kind for r in results)
    assert all(0.0 < r.times.proposals < r.times.total for r in results)
    for r in results:
        labels = tiny.labels(r.scene)[tiny.widths.index(r.metrics.width)]
        assert r.metrics.labels == len(labels)
        assert r.metrics.checked <= 200 and r.metrics.kept <= 20
    assert any(r.metrics.cfr > 0.5 for r in results) and any(r.metrics.coverage > 0.0 for r in results)


def test_results_do_not_depend_on_who_judges_in_what_order(
    results: list[ViewResult], tiny: SceneArchive, backwards: Any
) -> None:
    done: list[tuple[int, int]] = []
    again = run_study(tiny, SETTINGS, backwards, lambda *progress: done.append(progress))
    assert without_times(again) == without_times(results)
    assert done == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_all_methods_and_widths_see_the_same_cloud(tiny: SceneArchive, here: Any) -> None:
    alone = run_study(tiny, dataclasses.replace(SETTINGS, models=("antipodal",), widths=(0.10,), scenes=(1,)), here)
    together = run_study(tiny, dataclasses.replace(SETTINGS, scenes=(1,)), here)
    assert without_times(alone) == without_times(together[3:])


def test_a_network_is_judged_by_the_path_of_its_weights(tiny: SceneArchive, untrained: Path, here: Any) -> None:
    settings = dataclasses.replace(SETTINGS, models=(str(untrained),), scenes=(1,))
    found = run_study(tiny, settings, here)
    assert [r.model for r in found] == ["untrained"] * 2 and all(r.times.proposals > 0.0 for r in found)
    assert without_times(run_study(tiny, settings, here)) == without_times(found)


def test_each_seed_has_clouds_and_choices_of_its_own(tiny: SceneArchive, here: Any) -> None:
    settings = dataclasses.replace(SETTINGS, widths=(0.10,), scenes=(0, 1), seed=3)
    done: list[tuple[int, int]] = []
    found = run_seeds(tiny, settings, 2, here, lambda *progress: done.append(progress))
    assert [(r.seed, r.scene) for r in found[::2]] == [(3, 0), (3, 1), (4, 0), (4, 1)]
    assert done[0] == (0, 4) and done[-1] == (4, 4)
    alone = run_study(tiny, dataclasses.replace(settings, seed=4, clouds=RecordedViews(6000, 4)), here)
    assert without_times(found[4:]) == without_times(alone) != without_times(found[:4])
    with pytest.raises(InvalidInputError, match="seeds must be"):
        run_seeds(tiny, settings, 0, here)
    done.clear()
    largest = 2**31 - 1
    last = dataclasses.replace(settings, seed=largest, clouds=RecordedViews(6000, largest))
    with pytest.raises(InvalidInputError, match="seed must be"):
        run_seeds(tiny, last, 2, here, lambda *progress: done.append(progress))
    assert done == []  # refused before anything ran


def test_networks_are_told_apart_by_their_variant(untrained: Path) -> None:
    (one,) = network_records(("antipodal", str(untrained)))
    assert (one["label"], one["network"], one["layer"], one["region"]) == ("untrained", "regnetv2-s", 1, 0.02)
    assert one["width"] and not one["colour"] and one["parameters"] == 527_923


def test_main_table_has_what_there_are_weights_for() -> None:
    ready, missing = main_table()
    assert ready[:2] == ("random", "antipodal") and ready[-1] == "regnetv2-s"
    assert set(ready) <= set(available_models()) and not set(missing) & set(available_models())
    assert sorted(ready + missing) == sorted(MAIN_TABLE)


def test_one_view_of_each_scene_in_turn_or_all() -> None:
    assert [tuple(views_of(SETTINGS, scene, 4)) for scene in range(5)] == [(0,), (1,), (2,), (3,), (0,)]
    assert list(views_of(dataclasses.replace(SETTINGS, all_views=True), 7, 4)) == [0, 1, 2, 3]


def test_a_bad_scene_is_named(tiny_folder: Path, tmp_path: Path, here: Any) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(tiny_folder, copy)
    archive = SceneArchive(copy)
    (copy / "objects" / f"{archive.info(1).objects[0]}.safetensors").write_bytes(b"\x80\x04K\x01.")
    with pytest.raises(EvaluationError, match=r"scene 1 of '.*copy' cannot be judged: "):
        run_study(archive, dataclasses.replace(SETTINGS, scenes=(1,)), here)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"models": ()}, "at least one of the models"),
        ({"models": ("random", "random")}, "random more than once"),
        ({"widths": (0.06, 0.06)}, "0.06 more than once"),
        ({"scenes": (0, 9)}, r"has 3 scenes, and none numbered \[9\]"),
        ({"widths": (0.08,)}, "labels for the widths 0.06, 0.1 m, not for 0.08"),
    ],
)
def test_what_is_not_there_is_refused(tiny: SceneArchive, here: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        run_study(tiny, dataclasses.replace(SETTINGS, **changes), here)


def test_an_unknown_model_is_refused_before_any_scene(tiny: SceneArchive, backwards: Any) -> None:
    with pytest.raises(ModelError, match="no model 'best'"):
        run_study(tiny, dataclasses.replace(SETTINGS, models=("best",)), backwards)


def test_baselines_stay_on_the_cpu_when_networks_are_sent_elsewhere(tiny: SceneArchive) -> None:
    dataclasses.replace(SETTINGS, device="cuda:77").check(tiny)
    assert device_of("antipodal", "cuda") == "auto" and device_of("out/net.safetensors", "cuda") == "cuda"


def test_labels_of_models_are_short_and_tell_them_apart() -> None:
    models = ["net", "a/x/weights.safetensors", "b/x/weights.safetensors", "out/net.safetensors", "z/one.safetensors"]
    assert list(model_labels(models).values()) == ["net", "a/x", "b/x", "out/net", "one"]
    assert model_labels(["weights.safetensors"]) == {"weights.safetensors": "weights"}


def _bricks() -> Scene:
    """Bricks 0.05 x 0.04 x 0.06 m at x = 0 and at x = 0.3 m."""
    params = {"x": 0.05, "y": 0.04, "z": 0.06}
    models = [ObjectModel(f"brick{i}", "box", params, build_mesh("box", params), (9, 9, 9), 500.0, 0.5) for i in (0, 1)]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = (0.0, 0.0, 0.78), (0.3, 0.0, 0.78)
    return Scene(tuple(models), poses, default_table())


@pytest.fixture(scope="module")
def execution() -> Execution:
    scene = _bricks()
    return Execution(scene, GroundTruth(scene.world_meshes(), scene.table))


def _grasp(*centres: tuple[float, float, float], width: float = 0.08) -> Grasps:
    m = len(centres)
    quality = np.linspace(0.9, 0.5, m)
    return Grasps.from_poses(np.tile(DOWN, (m, 1, 1)), np.array(centres), np.full(m, width), quality)


def test_the_target_is_what_the_grasp_is_on(execution: Execution) -> None:
    assert execution.target(_grasp((0.3, 0.0, 0.83)), GRIPPER) == 1  # both pads touch it
    assert execution.target(_grasp((0.0, 0.0, 0.83), width=0.03), GRIPPER) == 0  # the fingers stand in it
    assert execution.target(_grasp((0.2, 0.0, 0.95)), GRIPPER) == 1  # the nearest
    assert execution.target(_grasp((0.1, 0.2, 0.95)), GRIPPER) == 0
    empty = Scene((), np.zeros((0, 4, 4)), default_table())
    assert Execution(empty, GroundTruth([], empty.table)).target(_grasp((0.0, 0.0, 0.9)), GRIPPER) is None


def test_the_best_grasp_is_executed(execution: Execution) -> None:
    good, empty = (0.0, 0.0, 0.83), (0.2, 0.2, 0.83)
    assert execution.outcome(_grasp(good, empty), GRIPPER, labels=3) == Outcome.HELD.value
    assert execution.outcome(_grasp(empty, good), GRIPPER, labels=3) == Outcome.MISSED.value
    backwards = _grasp(empty, good)[np.array([1, 0])]  # the order does not matter, the quality does
    assert execution.outcome(backwards, GRIPPER, labels=3) == Outcome.MISSED.value


def test_no_grasp_is_a_failure_where_there_was_one_to_find(execution: Execution) -> None:
    assert execution.outcome(Grasps.empty(), GRIPPER, labels=3) == NO_GRASP
    assert execution.outcome(Grasps.empty(), GRIPPER, labels=0) is None


def test_enclosed_objects_are_told() -> None:
    boxes = [trimesh.creation.box(extents=(0.05, 0.04, 0.06)).apply_translation((x, 0.0, 0.03)) for x in (0.0, 0.3)]
    found = GroundTruth(boxes, None).enclosed(_grasp((0.3, 0.0, 0.08), (0.0, 0.0, 0.08), (0.15, 0.0, 0.08)), GRIPPER)
    assert found.object_index.tolist() == [1, 0, -1]
    np.testing.assert_allclose(found.width, [0.04, 0.04, np.nan], atol=1e-6)


def test_the_command_prints_writes_and_draws(
    tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture = tmp_path / "e" / "all.json", tmp_path / "e" / "all.png"
    command = ["evaluate", "--data", str(tiny_folder), "--model", "antipodal", "--scenes", "2", "--points", "6000"]
    command += ["--workers", "1", "-q", "--by-width", "--simulate"]
    assert main([*command, "--out", str(out), "--picture", str(picture), "--trained-widths", "0.06,0.1"]) == 0
    shown = capsys.readouterr().out
    assert "2 scenes, 4 detections of each method" in shown
    assert all(title in shown for title in ("CFR", "AS(w/ C)", "TCR", "kept", "forward", "held [%]"))
    document = json.loads(out.read_text())
    assert document["settings"]["views"] == "one" and document["settings"]["clouds"]["points"] == 6000
    assert [row["width"] for row in document["summaries"][:3]] == [None, 0.06, 0.1]
    every = document["summaries"][0]
    assert every["held"]["tried"] == sum(every["held"]["outcomes"].values()) == 4
    assert f"{every['cfr']:.4f}" in shown and len(document["views"]["rows"]) == 4
    assert picture.stat().st_size > 20_000


def test_every_option_that_its_page_shows_is_one_of_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")
    commands = re.findall(r"^regnet evaluate (?:.*\\\n)*.*$", text, flags=re.M)
    options = {option for command in commands for option in re.findall(r"--[a-z-]+", command)}
    options |= set(re.findall(r"`(--[a-z-]+)", text.split("## A camera")[0]))
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["evaluate", "--help"]) == 0
    shown = capsys.readouterr().out
    assert len(options) > 8 and [option for option in options if option not in shown] == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--model", "best"], "no model 'best'"),
        (["-w", "0.08"], "not for 0.08"),
        (["--scenes", "4"], "--scenes must be 1 to 3"),
        (["--views", "two"], "--views must be one or all"),
        (["--out", "a.npz"], "--out must end in .json"),
        (["--picture", "a.svg"], "--picture must end in .png"),
        (["--trained-widths", "0.06"], "it needs --picture"),
        (["--picture", "a.png", "--trained-widths", "6 cm"], "metres with commas between"),
        (["--workers", "-1"], "workers must be at least 0"),
        (["--points", "0"], "points must be in"),
    ],
)
def test_options_that_make_no_sense_are_refused(
    tiny_folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["evaluate", "--data", str(tiny_folder), "--model", "antipodal", "-q", *options]) == 2
    shown = capsys.readouterr().err
    assert message in shown and shown.count("\n") == 1
