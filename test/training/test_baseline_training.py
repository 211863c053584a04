"""How the learned baselines learn: their examples and labels, the loop, and the command."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnet_core.baselines.closing_area import ClosingAreas
from regnet_core.baselines.examples import ExampleMaker, Examples, ExampleSettings, balanced, make_examples
from regnet_core.baselines.files import load_weights, stored_name
from regnet_core.baselines.gpd import GpdNetwork
from regnet_core.baselines.gpg import GpgConfig
from regnet_core.baselines.pointnetgpd import PointNetGpd
from regnet_core.baselines.runs import BaselineRun, prepare, recipe_of
from regnet_core.baselines.s4g import WIDTH, S4gNetwork, S4gOutput
from regnet_core.baselines.s4g_coding import encode_rotation
from regnet_core.baselines.training import BaselineRecipe, BaselineTrainer
from regnet_core.baselines.training_classifiers import ClassifierLesson
from regnet_core.baselines.training_s4g import (
    IGNORED,
    Grasped,
    PointTargets,
    S4gLesson,
    S4gLoss,
    point_loss,
    point_targets,
)
from regnet_core.baselines.zoo import METHODS
from regnet_core.cli import main
from regnet_core.data.dataset import GraspDataset, collate
from regnet_core.data.generation.run import generate
from regnet_core.data.generation.settings import GenerationSettings
from regnet_core.data.labels.candidates import CandidateConfig
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.errors import InvalidInputError, ModelError

FEW = ExampleSettings(views=1, hands=8, sampler=GpgConfig(points=100, grasps=30))


class Here:
    """Runs everything in this process, the last item first."""

    local = True
    workers = 1

    def run(self, function: Any, shared: Any, items: Any) -> Iterator[tuple[Any, Any]]:
        return ((item, function(shared, item)) for item in reversed(items))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "train"
    settings = GenerationSettings(
        seed=5, scenes=3, kinds=(("packed", 1.0),), objects=4, dome_views=1, candidates=CandidateConfig(points=120)
    )
    generate(folder, settings, Here())
    return folder


@pytest.fixture(scope="module")
def folder(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a few examples."""
    path = tmp_path_factory.mktemp("examples")
    make_examples(path, SceneArchive(data), FEW)
    return path


@pytest.fixture(scope="module")
def examples(folder: Path, data: Path) -> Examples:
    return make_examples(folder, SceneArchive(data), FEW)


# Examples


def test_examples_are_judged_hands_of_every_width(examples: Examples, data: Path) -> None:
    widths = SceneArchive(data).widths
    assert len(examples) <= 3 * len(widths) * 8
    assert {round(float(width), 6) for width in examples.width} == set(widths)
    assert (examples.score >= 0.0).all() and (examples.score <= 1.0).all()
    assert (examples.score >= 0.6).sum() > 10 and (examples.score == 0.0).sum() > 10
    assert examples.areas.counts.min() >= 1
    assert examples.areas.points.min() >= 0.0 and examples.areas.points.max() <= 1.0


def test_examples_depend_on_the_scene_alone(data: Path) -> None:
    archive = SceneArchive(data)
    first, second = (ExampleMaker(archive, FEW).of_scene(1) for _ in range(2))
    np.testing.assert_array_equal(first.areas.points, second.areas.points)
    np.testing.assert_array_equal(first.score, second.score)
    other = ExampleMaker(archive, ExampleSettings(views=1, hands=8, sampler=FEW.sampler, seed=1)).of_scene(1)
    assert not np.array_equal(first.score, other.score)


def test_made_examples_are_read_again(folder: Path, data: Path, examples: Examples, tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    (only,) = folder.glob("*.npz")
    before = only.stat().st_mtime_ns
    again = make_examples(folder, SceneArchive(data), FEW, progress=lambda *counts: done.append(counts))
    assert done == [(1, 1)] and only.stat().st_mtime_ns == before
    np.testing.assert_array_equal(again.areas.points, examples.areas.points)
    elsewhere = make_examples(tmp_path, SceneArchive(data), FEW, Here())
    np.testing.assert_array_equal(elsewhere.score, examples.score)
    np.testing.assert_array_equal(elsewhere.areas.normals, examples.areas.normals)


def test_other_examples_and_damaged_ones_are_refused(folder: Path, data: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="holds examples of other data or settings"):
        make_examples(folder, SceneArchive(data), ExampleSettings())
    make_examples(tmp_path, SceneArchive(data), FEW)
    (only,) = tmp_path.glob("*.npz")
    only.write_bytes(only.read_bytes()[:-100])
    with pytest.raises(InvalidInputError, match="holds no examples of grasps"):
        make_examples(tmp_path, SceneArchive(data), FEW)


@pytest.mark.parametrize(
    ("good", "others", "most", "expected"),
    [(50, 50, 10, (5, 5)), (2, 50, 10, (2, 8)), (50, 1, 10, (9, 1)), (3, 2, 10, (3, 2)), (0, 4, 3, (0, 3))],
)
def test_good_hands_and_others_come_in_equal_numbers(
    good: int, others: int, most: int, expected: tuple[int, int]
) -> None:
    mask = np.random.default_rng(0).permutation(np.repeat([True, False], [good, others]))
    rows = balanced(mask, most, np.random.default_rng(1))
    assert (mask[rows].sum(), (~mask[rows]).sum()) == expected
    assert (np.diff(rows) > 0).all()


# Classifiers


def told_apart_by_x(count: int = 60) -> Examples:
    """Hands whose points are near the palm, which are good, and hands whose points are near the fingertips."""
    rng = np.random.default_rng(0)
    score = np.repeat([0.9, 0.1], count // 2).astype(np.float32)
    points = rng.random((count, 80, 3)) * [0.4, 1.0, 1.0] + np.where(score < 0.5, 0.6, 0.0)[:, None, None] * [1, 0, 0]
    normals = np.tile([-1.0, 0.0, 0.0], (count * 80, 1))
    areas = ClosingAreas(
        points.reshape(-1, 3).astype(np.float16), normals.astype(np.float16), np.arange(count + 1) * 80
    )
    return Examples(areas, score, np.full(count, 0.08, np.float32))


@pytest.mark.parametrize("name", ["gpd-3", "gpd-12", "pointnetgpd"])
def test_classifiers_learn_what_is_easy(name: str, tmp_path: Path) -> None:
    recipe = BaselineRecipe(steps=15, batch=16, learning_rate=1e-3)
    torch.manual_seed(0)
    examples = told_apart_by_x()
    lesson = ClassifierLesson(METHODS[name].network(), recipe, examples, {}, examples)  # type: ignore[arg-type]
    trainer, totals = BaselineTrainer(name, lesson, recipe, tmp_path), []
    found: dict[str, float] = {}

    def report(step: int, values: dict[str, float]) -> None:
        found.update(values)
        totals.extend([values["total"]] if "total" in values else [])

    trainer.report = report
    trainer.train()
    assert len(totals) == 15
    assert np.mean(totals[-3:]) < 0.5 * np.mean(totals[:3])
    assert found["validation/accuracy"] > 0.95 and found["validation/recall at 0.6"] > 0.9


def test_the_loss_is_the_cross_entropy_of_half_good_hands() -> None:
    """A network that always answers one half has the loss log 2, and half of the answers are right."""
    network = GpdNetwork(3)
    torch.nn.init.zeros_(network.output.weight)
    torch.nn.init.zeros_(network.output.bias)
    recipe = BaselineRecipe(steps=1, batch=10, learning_rate=1e-3)
    (loss,) = ClassifierLesson(network, recipe, told_apart_by_x(), {}).losses(0, 1)
    assert loss.total.item() == pytest.approx(np.log(2), abs=1e-6)
    assert loss.terms["accuracy"] == 0.5


def test_hands_that_cannot_be_told_are_not_learnt_from(examples: Examples) -> None:
    recipe = BaselineRecipe(steps=1, batch=4, learning_rate=1e-3)
    lesson = ClassifierLesson(PointNetGpd(), recipe, examples, {})
    used = np.concatenate([lesson._good, lesson._others])
    assert len(used) > 0 and examples.areas.counts[used].min() >= 50
    few = Examples(examples.areas.take(used[:0]), examples.score[:0], examples.width[:0])
    with pytest.raises(InvalidInputError, match="learns from good hands and others, and there are 0 and 0"):
        ClassifierLesson(PointNetGpd(), recipe, few, {})


# S4G


def grasped() -> Grasped:
    """Three grasps that enter at x = 0, 0, and 1: good from the side, as good from above, and bad."""
    from_above = torch.tensor([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    rotation = torch.stack([torch.eye(3), from_above, from_above])
    entry = torch.tensor([[0.0, 0, 0], [0.002, 0, 0], [1.0, 0, 0]])
    return Grasped(entry + torch.tensor([0.0, 0, 0.03]), rotation, torch.tensor([0.93, 0.91, 0.2]), entry)


def test_points_learn_the_best_grasp_that_enters_near_them() -> None:
    points = torch.tensor([[0.001, 0, 0], [-0.007, 0, 0], [1.003, 0, 0], [0.5, 0, 0], [0.6, 0, 0]])
    confidence = torch.tensor([0.9, 0.9, 0.1, 0.0, 0.3])
    target = point_targets(points, confidence, grasped(), 3, 0.03, S4gLoss())
    assert target.label.tolist() == [2, 2, 0, 0, IGNORED]
    torch.testing.assert_close(target.score, torch.tensor([0.91, 0.93, 0.2, 0.0, 0.0]))
    # Both grasps are in reach of the first point, and as good to a tenth: the one from above it is.
    torch.testing.assert_close(target.rotation[0], grasped().rotation[1])
    torch.testing.assert_close(target.rotation[1], torch.eye(3))  # the other one is out of reach
    torch.testing.assert_close(target.offset[0], torch.tensor([0.001 / 0.03, 0.0, 1.0]))
    torch.testing.assert_close(target.offset[1], torch.tensor([0.007 / 0.03, 0.0, 1.0]))


def test_points_without_any_grasp_in_the_view_have_the_lowest_class() -> None:
    nothing = Grasped(*(value[:0] for value in grasped()))
    target = point_targets(torch.rand(4, 3), torch.zeros(4), nothing, 3, 0.03, S4gLoss())
    assert target.label.tolist() == [0] * 4 and (target.score == 0).all()
    output = S4gOutput(torch.zeros(4, 3), torch.rand(4, 6), torch.rand(4, 3))
    loss = point_loss(output, target, S4gLoss())
    assert loss.terms["rotation"] == loss.terms["offset"] == 0.0
    assert loss.terms["score"] == pytest.approx(np.log(3), abs=1e-6)


def targets() -> PointTargets:
    score = torch.tensor([0.8, 0.5, 0.0, 0.0])
    rotation = torch.linalg.qr(torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(0)))[0]
    rotation = rotation * torch.linalg.det(rotation)[:, None, None]
    return PointTargets(score, torch.tensor([2, 1, 0, IGNORED]), rotation, torch.ones(4, 3))


def test_the_loss_of_s4g_by_hand() -> None:
    """Right rotations, offsets off by 0.5 in every coordinate, scores with even odds."""
    target = targets()
    output = S4gOutput(torch.zeros(4, 3), encode_rotation(target.rotation), torch.full((4, 3), 1.5))
    loss = point_loss(output, target, S4gLoss())
    assert loss.terms["score"] == pytest.approx(np.log(3), abs=1e-6)
    assert loss.terms["rotation"] == pytest.approx(0.0, abs=1e-6)
    assert loss.terms["offset"] == pytest.approx((0.8 + 0.5) / 2 * 0.25, abs=1e-6)
    assert float(loss.total) == pytest.approx(np.log(3) + (0.8 + 0.5) / 2 * 0.25, abs=1e-5)
    # The lowest class has half the weight: 1.5 of it, and of the others 0 and 3.
    logits = torch.tensor([[0.0, 0, 50], [0, 50, 0], [1.5, 1.5, 1.5], [9.0, 0, 0]])
    weighted = point_loss(output._replace(score=logits), target, S4gLoss())
    assert weighted.terms["score"] == pytest.approx(0.5 * np.log(3) / 2.5, abs=1e-5)


def test_the_loss_of_s4g_does_not_care_about_the_form_of_a_jaw() -> None:
    target = targets()
    generator = torch.Generator().manual_seed(3)
    output = S4gOutput(*(torch.randn(4, n, generator=generator) for n in (3, 6, 3)))
    turned = target._replace(rotation=target.rotation * torch.tensor([1.0, -1.0, -1.0]))
    assert float(point_loss(output, target, S4gLoss()).total) == pytest.approx(
        float(point_loss(output, turned, S4gLoss()).total), abs=1e-6
    )


# Runs


def run_of(name: str, data: Path, out: Path, folder: Path, **values: Any) -> BaselineRun:
    return BaselineRun(name, data, out, examples=folder, settings=FEW, points=1500, **values)


@pytest.mark.parametrize("name", ["gpd-3", "pointnetgpd", "s4g"])
def test_a_continued_run_ends_as_an_undisturbed_one(name: str, data: Path, folder: Path, tmp_path: Path) -> None:
    recipe = recipe_of(name, steps=4, batch=2 if name == "s4g" else 8)
    whole = prepare(run_of(name, data, tmp_path / "whole", folder), recipe)
    whole.train()
    first = prepare(run_of(name, data, tmp_path / "parts", folder, stop_after=0.0), recipe)
    for _ in range(4):
        first.train()  # a step at a time
        again = prepare(run_of(name, data, tmp_path / "parts", folder, stop_after=0.0), recipe)
        again.resume()
        assert again.step == first.step
        first = again
    assert whole.step == first.step == 4
    for key, value in whole.network.state_dict().items():
        torch.testing.assert_close(first.network.state_dict()[key], value, msg=key)


def test_s4g_learns_a_batch(data: Path) -> None:
    dataset = GraspDataset(data, 1500, widths=[WIDTH])
    torch.manual_seed(0)
    lesson = S4gLesson(S4gNetwork(), BaselineRecipe(steps=1, batch=2, learning_rate=1e-3), dataset)
    batch = collate([dataset[0], dataset[5]])
    optimiser = torch.optim.Adam(lesson.network.parameters(), 3e-3)
    found = []
    for _ in range(25):
        loss = lesson._loss_of(batch)
        optimiser.zero_grad()
        loss.total.backward()
        optimiser.step()
        found.append(loss.terms)
    for term in ("score", "rotation", "offset"):
        assert np.mean([terms[term] for terms in found[-3:]]) < 0.7 * np.mean([terms[term] for terms in found[:3]]), (
            term
        )


def test_the_checkpoint_of_another_run_is_refused(data: Path, folder: Path, tmp_path: Path) -> None:
    prepare(run_of("gpd-3", data, tmp_path, folder), recipe_of("gpd-3", steps=1, batch=4)).save()
    with pytest.raises(InvalidInputError, match=r"is of another run: recipe\.seed was 0 and is 7"):
        prepare(run_of("gpd-3", data, tmp_path, folder), recipe_of("gpd-3", seed=7, steps=1, batch=4)).resume()
    with pytest.raises(InvalidInputError, match="is of another run: network was 'gpd-3' and is 'gpd-12'"):
        prepare(run_of("gpd-12", data, tmp_path, folder), recipe_of("gpd-12", steps=1, batch=4)).resume()


def test_recipes_are_the_usual_ones_but_for_what_is_changed() -> None:
    usual = METHODS["gpd-12"]
    recipe = recipe_of("gpd-12", 3, steps=None, batch=10)
    assert (recipe.steps, recipe.batch, recipe.learning_rate) == (usual.steps, 10, usual.learning_rate)
    assert recipe.seed == 3
    with pytest.raises(InvalidInputError, match="batch"):
        recipe_of("gpd-12", batch=1)
    with pytest.raises(ModelError, match="no learned baseline 'gpd-15'"):
        recipe_of("gpd-15")


def test_the_command_trains_a_baseline_and_resumes(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "--config", "s4g", "--data", str(data), "--out", str(tmp_path), "--workers", "0"]
    command += ["--steps", "2", "--batch", "2", "--points", "1000", "--device", "cpu", "-q"]
    assert main([*command, "--validation", str(data)]) == 0
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 2]
    assert lines[0]["rotation"] >= 0.0 and lines[2]["validation/score"] > 0.0
    assert stored_name(tmp_path / "weights.safetensors") == "s4g"
    network = METHODS["s4g"].network()
    assert load_weights(tmp_path / "weights.safetensors", "s4g", network)["step"] == 2
    assert main(command) == 2
    assert "give --resume to go on" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    assert main([*command, "--resume", "--seed", "1"]) == 2
    assert "recipe.seed was 0 and is 1" in capsys.readouterr().err


def test_the_command_makes_examples_that_classifiers_share(data: Path, tmp_path: Path) -> None:
    command = ["train", "--data", str(data), "--examples", str(tmp_path / "examples"), "--workers", "0"]
    command += ["--steps", "1", "--batch", "4", "--device", "cpu", "-q"]
    assert main([*command, "--config", "gpd-12", "--out", str(tmp_path / "gpd")]) == 0
    (made,) = (tmp_path / "examples").glob("*.npz")
    before = made.stat().st_mtime_ns
    assert main([*command, "--config", "pointnetgpd", "--out", str(tmp_path / "pointnetgpd")]) == 0
    assert made.stat().st_mtime_ns == before
    assert stored_name(tmp_path / "gpd" / "weights.safetensors") == "gpd-12"
    assert stored_name(tmp_path / "pointnetgpd" / "weights.safetensors") == "pointnetgpd"


def test_the_command_says_what_does_not_go_together(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "--data", str(data), "--out", str(tmp_path), "--device", "cpu"]
    assert main([*command, "--config", "gpd-3", "--start", "x.safetensors"]) == 2
    assert "--start is for networks; 'gpd-3' starts from random weights" in capsys.readouterr().err
    assert main([*command, "--config", "regnetv2-s", "--examples", str(tmp_path)]) == 2
    assert "--examples is for baselines that classify hands; 'regnetv2-s' is none" in capsys.readouterr().err
