"""A training run in small: it learns, goes on after an interruption as if there had been none, and is judged."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnet_core.cli import main
from regnet_core.data.dataset import GraspDataset, collate
from regnet_core.data.generation.run import generate
from regnet_core.data.generation.settings import GenerationSettings
from regnet_core.data.labels.candidates import CandidateConfig
from regnet_core.errors import InvalidInputError, ModelError
from regnet_core.nn.anchors import Pose
from regnet_core.nn.files import load_network
from regnet_core.training.augmentation import augment
from regnet_core.training.judging import BatchJudge
from regnet_core.training.recipe import Augmentation, Recipe
from regnet_core.training.step import draw_positives
from regnet_core.training.trainer import Run, Trainer

RECIPE = Recipe(steps=6, batch=2, points=1500, regions=24, learning_rate=3e-3)


class Here:
    """Runs everything in this process."""

    local = True

    def run(self, function: Any, shared: Any, items: Any) -> Iterator[tuple[Any, Any]]:
        return ((item, function(shared, item)) for item in items)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "train"
    settings = GenerationSettings(
        seed=5, scenes=3, kinds=(("packed", 1.0),), objects=4, dome_views=1, candidates=CandidateConfig(points=120)
    )
    generate(folder, settings, Here())
    return folder


def _trainer(data: Path, out: Path, recipe: Recipe = RECIPE, **values: Any) -> Trainer:
    return Trainer(Run("regnetv2-s", data, out, workers=0, **values), recipe)


def test_a_continued_run_ends_as_an_undisturbed_one(data: Path, tmp_path: Path) -> None:
    whole = _trainer(data, tmp_path / "whole")
    whole.train()
    first = _trainer(data, tmp_path / "parts", stop_after=0.0)
    for _ in range(RECIPE.steps):
        first.train()  # a step at a time
        again = _trainer(data, tmp_path / "parts", stop_after=0.0)
        again.resume()
        assert again.step == first.step
        first = again
    assert whole.step == first.step == RECIPE.steps
    for name, value in whole.network.state_dict().items():
        torch.testing.assert_close(first.network.state_dict()[name], value, msg=name)


def test_the_loss_falls_on_a_few_views(data: Path, tmp_path: Path) -> None:
    recipe = dataclasses.replace(RECIPE, steps=24)
    totals: list[float] = []
    trainer = _trainer(data, tmp_path, recipe)
    trainer.report = lambda step, values: totals.append(values["total"])
    trainer.train()
    assert len(totals) == 24
    assert sum(totals[-6:]) < 0.8 * sum(totals[:6])


def test_the_metrics_of_a_network_can_be_computed(data: Path, tmp_path: Path) -> None:
    trainer = _trainer(data, tmp_path, validation=data, validation_samples=2)
    metrics = trainer.validate()
    assert metrics.scenes == 2
    assert trainer.network.training


def test_the_checkpoint_of_another_run_is_refused(data: Path, tmp_path: Path) -> None:
    _trainer(data, tmp_path, dataclasses.replace(RECIPE, steps=1)).train()
    with pytest.raises(InvalidInputError, match="is of another run"):
        _trainer(data, tmp_path, dataclasses.replace(RECIPE, steps=1, seed=1)).resume()
    (tmp_path / "checkpoint.safetensors").write_bytes(b"\x80\x04K\x01.")
    with pytest.raises(InvalidInputError, match="is no checkpoint of a training run"):
        _trainer(data, tmp_path).resume()


def test_the_command_trains_logs_and_resumes(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["train", "--config", "regnetv2-s", "--data", str(data), "--out", str(tmp_path), "--workers", "0"]
    command += ["--steps", "2", "--batch", "1", "--points", "1000", "--device", "cpu", "-q"]
    assert main(command) == 0
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2] and lines[0]["grasp/quality"] >= 0.0
    assert load_network(tmp_path / "weights.safetensors")[1]["step"] == 2
    assert main(command) == 2
    assert "give --resume to go on" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    assert main([*command[:2], "regnetv9", *command[3:], "--resume"]) == 2
    assert "no network 'regnetv9'" in capsys.readouterr().err


def test_a_recipe_comes_back_from_json() -> None:
    assert Recipe.from_dict(json.loads(json.dumps(RECIPE.to_dict()))) == RECIPE
    with pytest.raises(InvalidInputError, match="this is no recipe"):
        Recipe.from_dict({"epochs": 3})
    with pytest.raises(InvalidInputError, match="schedule must be"):
        Recipe(schedule="steps")  # type: ignore[arg-type]


def test_a_turned_scene_is_judged_as_the_scene_was(data: Path) -> None:
    dataset = GraspDataset(data, 1000)
    judge = BatchJudge(dataset.archive)
    augmentation = Augmentation(tilt=0.1)
    plain = [dataset[i] for i in (0, 7)]
    turned = [augment(sample, augmentation, torch.Generator().manual_seed(3)) for sample in plain]
    for samples in (plain, turned):
        batch = collate(samples)
        worth = judge(batch, Pose(batch.rotation, batch.translation), batch.grasp_batch)
        assert len(worth) > 20
        # In single precision a pad may just touch, or just miss, another edge.
        assert ((worth - batch.score).abs() < 0.005).float().mean() > 0.97


def test_samples_show_what_is_around_the_objects(data: Path) -> None:
    whole = GraspDataset(data, 200_000)
    near, far = whole[0], whole.archive.view(0, 0)
    seen = int(np.isfinite(far.depth).sum())
    objects = near.points[near.object_index >= 0]
    assert len(near.points.unique(dim=0)) < 0.9 * seen
    assert (near.points >= objects.amin(dim=0) - 0.1001).all() and (near.points <= objects.amax(dim=0) + 0.1001).all()
    few = GraspDataset(data, 3000)[0]
    assert len(few.points.unique(dim=0)) == 3000


def test_a_run_for_one_width_sees_no_other(data: Path, tmp_path: Path) -> None:
    trainer = _trainer(data, tmp_path / "run", dataclasses.replace(RECIPE, widths=(0.08,), between=1.0))
    assert {round(float(trainer.dataset[i].width), 6) for i in range(len(trainer.dataset))} == {0.08}
    with pytest.raises(InvalidInputError, match=r"0\.07"):
        _trainer(data, tmp_path / "run", dataclasses.replace(RECIPE, widths=(0.07,)))


def test_widths_in_between_have_labels_that_fit(data: Path) -> None:
    dataset = GraspDataset(data, 500, between=1.0)
    widths = dataset.archive.widths
    for number in range(len(widths)):
        sample = dataset[number]
        width, lower = float(sample.width), 0.03 if number == 0 else widths[number - 1]
        assert lower <= width < widths[number]
        assert (sample.contacts.abs() <= width / 2).all()
        assert ((sample.confidence >= 0.0) & (sample.confidence <= 1.0)).all()


def test_walls_and_the_table_are_learnt_at_as_well(data: Path) -> None:
    batch = collate([GraspDataset(data, 2000)[0]])
    owner = torch.full_like(batch.object_index, -1)
    owner[:, :1000] = -2
    confidence = torch.zeros_like(batch.confidence)
    confidence[:, 1900:] = 0.5
    batch = dataclasses.replace(batch, object_index=owner, confidence=confidence)
    rows = draw_positives(batch, 4000, torch.Generator().manual_seed(0))
    walls, table, confident = (rows < 1000).sum(), ((rows >= 1000) & (rows < 1900)).sum(), (rows >= 1900).sum()
    # Their weights are 1000 x 0.02, 900 x 0.002 and 100 x 0.502.
    assert 1000 < walls < 1250 and 60 < table < 140 and 2650 < confident < 2950


def test_a_run_starts_from_the_weights_of_another(data: Path, tmp_path: Path) -> None:
    first = _trainer(data, tmp_path / "first", dataclasses.replace(RECIPE, steps=2))
    first.train()
    weights = tmp_path / "first" / "weights.safetensors"
    second = _trainer(data, tmp_path / "second", start=weights)
    for name, value in first.network.state_dict().items():
        torch.testing.assert_close(second.network.state_dict()[name], value, atol=1e-3, rtol=1e-3, msg=name)
    second.save()
    with pytest.raises(InvalidInputError, match="is of another run: start was"):
        _trainer(data, tmp_path / "second").resume()
    with pytest.raises(ModelError, match="is of 'regnetv2-s', and cannot start 'regnetv2-s-no-width'"):
        Trainer(Run("regnetv2-s-no-width", data, tmp_path, start=weights), RECIPE)


def test_a_whole_network_goes_on_from_what_a_coarser_one_has_learnt(data: Path, tmp_path: Path) -> None:
    whole = _trainer(data, tmp_path / "whole")
    coarse = _trainer(data, tmp_path / "coarse", dataclasses.replace(RECIPE, steps=1, detail=0.25))
    sizes = [(a.centroids, a.neighbours) for a in coarse.network.config.abstractions]
    assert sizes == [(512, 8), (128, 8), (32, 8)]  # a fourth of regnetv2-s's, nn/zoo.py
    coarse.train()
    learnt, card = load_network(tmp_path / "coarse" / "weights.safetensors")
    assert learnt.config == whole.network.config
    assert card["recipe"]["detail"] == 0.25
    second = _trainer(data, tmp_path / "second", start=tmp_path / "coarse" / "weights.safetensors")
    assert second.network.config == whole.network.config
    for name, value in coarse.network.state_dict().items():
        torch.testing.assert_close(second.network.state_dict()[name], value, atol=1e-3, rtol=1e-3, msg=name)
    with pytest.raises(InvalidInputError, match="detail must be"):
        dataclasses.replace(RECIPE, detail=1.5)
