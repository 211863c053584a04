"""What benchmarks measure: clouds, models, settings, worker processes, and a small run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from benchmarks import padded
from benchmarks.clouds import cloud_source, made_up_cloud, read_cloud
from benchmarks.documents import read_document, write_document
from benchmarks.errors import BenchmarkError
from benchmarks.machine import describe_machine
from benchmarks.measure import MatrixSettings, measure_matrix
from benchmarks.models import choose_model, precision, ready_model
from benchmarks.picture import draw
from benchmarks.records import (
    Document,
)
from benchmarks.stages import DETECTION
from benchmarks.tables import result_tables
from benchmarks.tasks.subject import workspace_of
from benchmarks.work import ledger_flops
from benchmarks.workers import Worker
from regnet_core.errors import InvalidInputError, ModelError
from regnet_core.geometry import Box
from regnet_core.nn import precision as precision_module
from regnet_core.nn.zoo import REGNETV2_S

BAG = Path(__file__).resolve().parents[2] / "bags" / "one_object"


def test_clouds_are_found_by_what_users_write() -> None:
    assert read_cloud(f"{BAG}:2").name == "one_object 2"
    assert read_cloud(str(BAG)).name == "one_object 0"
    assert cloud_source(cloud_source(str(BAG)).text) == cloud_source(str(BAG))
    made = read_cloud("made-up:3000")
    assert (made.name, made.points.shape) == ("made-up 3000", (3000, 3))
    np.testing.assert_array_equal(made.points, made_up_cloud(3000))
    for text, message in (
        (f"{BAG}:9", "has no cloud 9"),
        ("made-up:3", "at least 100 points"),
        ("none.ply", "there is no file"),
        ("notes.txt", "unknown suffix"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            read_cloud(text)


def test_models_are_chosen_by_name(tmp_path: Path) -> None:
    assert choose_model("regnetv2-s").weights == "trained"
    assert not choose_model("antipodal").is_network
    assert choose_model("regnetv2").weights == "trained"
    assert choose_model("regnet", 3).weights == "random, seed 3"
    assert choose_model("untrained:regnetv2-s").network == "regnetv2-s"
    assert choose_model("/somewhere/mine.safetensors").name == "mine"
    with pytest.raises(ModelError, match="no model 'nonsense'; there are regnetv2-s"):
        choose_model("nonsense")
    untrained = choose_model("untrained:regnetv2-s")
    first, again, other = (
        load_file(ready_model(untrained, tmp_path / str(i), seed)) for i, seed in enumerate((0, 0, 1))
    )
    assert all(torch.equal(value, again[name]) for name, value in first.items())
    assert not torch.equal(first["score.output.weight"], other["score.output.weight"])


def test_the_precision_is_forced_for_a_while() -> None:
    before = precision_module.has_fast_bf16()
    with precision("bf16"):
        assert precision_module.autocast(torch.device("cpu")).fast_dtype == torch.bfloat16
        assert precision_module.has_fast_bf16()
        assert precision_module.cpu_precision() == "bf16"
    for other in ("fp32", "int8"):
        with precision(other):
            assert not precision_module.has_fast_bf16() and precision_module.cpu_precision() == other
    assert precision_module.has_fast_bf16() == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"repetitions": 0}, "repetitions must be"),
        ({"threads": (0,)}, "threads must be in"),
        ({"clouds": ()}, "clouds must name at least one"),
        ({"points": -1}, "points must be"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        MatrixSettings(models=("antipodal",), **change)  # type: ignore[arg-type]


def test_a_crop_is_a_box() -> None:
    assert workspace_of([]) is None
    assert workspace_of([0.0, 1.0, 2.0, 3.0, 4.0, 5.0]) == Box((0.0, 1.0, 2.0), (3.0, 4.0, 5.0))
    with pytest.raises(InvalidInputError, match="a crop is six numbers"):
        workspace_of([0.0, 1.0])


def test_a_picture_needs_something_to_draw(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="neither runs nor end-to-end measurements"):
        draw(Document("", describe_machine(), {}), tmp_path / "none.png")


def test_workers_say_what_went_wrong() -> None:
    settings = {"weights_seed": 0, "precision": "", "width": 0.08, "clouds": ["made-up:2000"], "points": 0, "crop": []}
    with pytest.raises(BenchmarkError, match="no model 'nonsense'"):
        Worker("detection", 1, {"model": "nonsense", **settings})
    with pytest.raises(BenchmarkError, match=r"the worker for nonsense ended with exit code 1:\n(.|\n)*KeyError"):
        Worker("nonsense", 1, {})


def test_a_small_run(tmp_path: Path) -> None:
    """One round of a network and its plain implementation: times add up, work is counted, both compute the same."""
    settings = MatrixSettings(
        models=("untrained:regnetv2-s",),
        precisions=("fp32",),
        threads=(1,),
        clouds=("made-up:3000",),
        crop=(-1.0, -1.0, 0.0, 1.0, 1.0, 2.0),
        repetitions=2,
        warm_up=1,
        references=("untrained:regnetv2-s",),
        reference_repetitions=1,
        peak_side=128,
        peak_bytes=1 << 20,
    )
    result = measure_matrix(settings, lambda line: None)
    (run,), (plain,), (peak,) = result.runs, result.references, result.peaks
    assert "validation" in {stage.name for stage in run.stages if stage.part == "preprocessor"}
    assert (run.model, run.weights, run.precision, run.points) == ("regnetv2-s", "random, seed 0", "fp32", 3000)
    assert 0 < run.seen == plain.seen <= run.prepared <= 3000
    stages = {stage.name: stage for stage in run.stages if stage.part == "detector"}
    assert {"validation", "sampling", "farthest points", "ball queries", "abstraction 3", "propagation 1"} <= set(
        stages
    )
    assert {"score head", "regions", "refinement", "decoding", "collision", "ranking", DETECTION} <= set(stages)
    # Two samples: the sum of the medians is the median of the sums.
    assert sum(stage.wall.median for stage in stages.values()) == pytest.approx(run.timed.median, rel=0.02)
    assert run.network is not None and run.network.median < run.timed.median
    assert stages["abstraction 1"].bound == "matrix product"
    assert (stages["abstraction 1"].share or 0.0) > 0.0
    assert stages["ball queries"].share is None
    assert stages["abstraction 1"].ledger_flops == ledger_flops(REGNETV2_S)["abstraction 1"]
    assert plain.difference < 1e-3
    assert plain.searches.median < plain.total.median
    assert peak.fp32.most > 0.0 and peak.bandwidth > 0.0
    one = Document("", describe_machine(), {}, result.load, result.peaks, result.runs, references=result.references)
    write_document(tmp_path / "run.json", one)
    assert "made-up 3000" in result_tables(read_document(tmp_path / "run.json"))


def test_the_plain_searches_give_the_same_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    points = torch.from_numpy(made_up_cloud(500))
    whole = padded.padded_ball_query(points, points[:50], 0.03, 8), padded.nearest_three(points[:60], points)
    monkeypatch.setattr(padded, "_CHUNK", 1000)
    assert torch.equal(padded.padded_ball_query(points, points[:50], 0.03, 8), whole[0])
    assert torch.equal(padded.nearest_three(points[:60], points).indices, whole[1].indices)
