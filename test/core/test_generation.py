"""A data set from beginning to end: the same bytes whatever happens on the way, and what its readers give."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from regnet_core.cli import main
from regnet_core.data.dataset import GraspDataset, collate
from regnet_core.data.generation.run import generate
from regnet_core.data.generation.settings import GenerationSettings
from regnet_core.data.labels.candidates import CandidateConfig
from regnet_core.data.labels.confidence import D_TH
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.data.storage.manifest import Manifest, checksum
from regnet_core.data.storage.statistics import statistics
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.gripper import Gripper

SETTINGS = GenerationSettings(
    seed=7,
    scenes=5,
    widths=(0.06, 0.10),
    kinds=(("single", 1.0), ("packed", 1.0), ("pile", 1.0), ("bin", 1.0)),
    paper_views=1,
    dome_views=1,
    objects=9,
    shard_size=2,
    candidates=CandidateConfig(points=120),
)


class Here:
    """Runs everything in this process, in the order given, and may be told to stop."""

    local = True

    def __init__(self, stop_after: int | None = None, backwards: bool = False) -> None:
        self.left = stop_after
        self.backwards = backwards

    def run(self, function: Any, shared: Any, items: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
        for item in reversed(items) if self.backwards else items:
            if self.left == 0:
                raise KeyboardInterrupt
            if self.left is not None:
                self.left -= 1
            yield item, function(shared, item)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set as made without a disturbance."""
    path = tmp_path_factory.mktemp("undisturbed") / "data"
    generate(path, SETTINGS, Here())
    return path


def _checksums(path: Path) -> dict[str, str]:
    files = sorted(file for kind in ("shards", "objects", "candidates") for file in (path / kind).iterdir())
    return {str(file.relative_to(path)): checksum(file) for file in files}


def test_a_data_set_has_what_was_asked_for(folder: Path) -> None:
    manifest = Manifest.load(folder)
    assert manifest.complete and manifest.settings == SETTINGS and len(manifest.objects) == 9
    assert sorted(manifest.shards) == [f"shard-0000{i}.tar" for i in range(3)]
    assert {"numpy", "mujoco", "regnet_ros"} <= set(manifest.made_with)
    assert not list((folder / "parts").iterdir())
    archive = SceneArchive(folder)
    assert archive.indices == (0, 1, 2, 3, 4)
    for index in archive:
        info = archive.info(index)
        assert len(info.views) == 2 and info.widths == (0.06, 0.10) and set(info.objects) <= set(manifest.objects)
        assert info.views[0].sensor == "kinect_v2"


def test_interrupted_runs_give_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    for stop, backwards in ((4, False), (6, True), (1, True), (1, False)):
        with pytest.raises(KeyboardInterrupt):
            generate(tmp_path, SETTINGS, Here(stop, backwards))
    assert not Manifest.load(tmp_path).complete
    generate(tmp_path, SETTINGS, Here(backwards=True))
    assert _checksums(tmp_path) == _checksums(folder)
    assert Manifest.load(tmp_path).shards == Manifest.load(folder).shards


def test_killed_workers_and_a_killed_parent_change_nothing(folder: Path, tmp_path: Path) -> None:
    settings = json.dumps(SETTINGS.to_dict())
    program = (
        "import json, sys; from pathlib import Path\n"
        "from regnet_core.data.generation.executors import LocalExecutor\n"
        "from regnet_core.data.generation.run import generate\n"
        "from regnet_core.data.generation.settings import GenerationSettings\n"
        "if __name__ == '__main__':\n"
        "    settings = GenerationSettings.from_dict(json.loads(sys.argv[2]))\n"
        "    generate(Path(sys.argv[1]), settings, LocalExecutor(2), progress=lambda *p: print(*p, flush=True))\n"
    )
    script = tmp_path / "run.py"
    script.write_text(program)
    out = tmp_path / "data"
    command = [sys.executable, str(script), str(out), settings]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        _wait_for(run.stdout, "objects 3 9")
        workers = _children(run.pid)
        os.kill(workers[-1], signal.SIGKILL)  # a worker dies: its pool is made anew
        _wait_for(run.stdout, "scenes 1 5")
        workers = _children(run.pid)
        run.kill()
    deadline = time.monotonic() + 60.0  # one that compiles notices afterwards
    while any(_alive(pid) for pid in workers):
        assert time.monotonic() < deadline, "workers end when their parent is killed"
        time.sleep(0.05)
    assert not (out / "manifest.json").read_text().count('"complete": true')
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert _checksums(out) == _checksums(folder)


def _wait_for(lines: Any, wanted: str) -> None:
    for line in lines:
        if line.strip() == wanted:
            return
    raise AssertionError(f"the run ended before it printed {wanted!r}")


def _children(pid: int) -> list[int]:
    """Worker processes; the resource tracker of multiprocessing is none."""
    children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return [child for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_data_set_grows(folder: Path, tmp_path: Path) -> None:
    generate(tmp_path, dataclasses.replace(SETTINGS, scenes=3), Here())
    assert len(SceneArchive(tmp_path)) == 3
    generate(tmp_path, SETTINGS, Here())
    assert _checksums(tmp_path) == _checksums(folder)
    with pytest.raises(InvalidInputError, match="data set of 5 scenes; it can get more, not fewer"):
        generate(tmp_path, dataclasses.replace(SETTINGS, scenes=3), Here())


def test_other_settings_are_refused_and_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"other settings \(seed: 7 there, 8 asked for\)"):
        generate(folder, dataclasses.replace(SETTINGS, seed=8), Here())
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InvalidInputError, match=r"holds other files and no manifest\.json"):
        generate(tmp_path, SETTINGS, Here())


def test_two_runs_at_once_are_refused(tmp_path: Path) -> None:
    class Intruder(Here):
        def run(self, function: Any, shared: Any, items: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
            with pytest.raises(InvalidInputError, match="another run of `regnet generate` is at work in"):
                generate(tmp_path, SETTINGS, Here())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path, SETTINGS, Intruder())
    assert Manifest.load(tmp_path).settings == SETTINGS


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"split": "dev"}, "split must be one of train, val, test, got 'dev'"),
        ({"scenes": 0}, "scenes must be in"),
        ({"widths": ()}, "widths must be different numbers"),
        ({"widths": (0.5,)}, r"width must be in \[0.03, 0.16\]"),
        ({"kinds": (("heap", 1.0),)}, "kinds of scenes are pile, single, packed, bin, got 'heap'"),
        ({"kinds": (("pile", 0.0),)}, "at least one kind"),
        ({"paper_views": 0, "dome_views": 0}, "at least one view"),
        ({"shard_size": 2.5}, "shard_size must be a whole number"),
    ],
)
def test_wrong_settings_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        GenerationSettings(**values)


def test_settings_come_back_from_json() -> None:
    assert GenerationSettings.from_dict(json.loads(json.dumps(SETTINGS.to_dict()))) == SETTINGS
    with pytest.raises(InvalidInputError, match="not the settings of a data set"):
        GenerationSettings.from_dict({"seed": 1})


def test_stored_labels_are_free_and_antipodal_on_the_true_meshes(folder: Path) -> None:
    archive, checked = SceneArchive(folder), 0
    for index in archive:
        scene = archive.scene(index)
        truth = GroundTruth(scene.world_meshes(), scene.table, fixtures=scene.fixtures)
        for width, labels in zip(archive.widths, archive.labels(index), strict=True):
            some = labels[:: max(1, len(labels) // 60)]
            grasps, gripper = some.grasps(width), Gripper(width=width)
            assert not truth.collides(grasps, gripper).any()
            np.testing.assert_array_equal(truth.antipodal(grasps, gripper).object_index, some.object_index)
            checked += len(some)
    assert checked > 200


def test_confident_points_have_grasps_near_them(folder: Path) -> None:
    for number in range(0, 20, 3):
        sample = GraspDataset(folder, 4000)[number]
        sure = sample.points[sample.confidence > 0.9]
        assert torch.all(sample.confidence[sample.object_index < 0] == 0.0)
        if len(sure) and len(sample.entry_point):
            near = torch.cdist(sure, sample.entry_point).min(dim=1).values
            # The stored grasps are some of all that count.
            assert (near < 2 * D_TH).float().mean() > 0.9


def test_a_sample_has_the_shapes_and_ranges_it_promises(folder: Path) -> None:
    dataset = GraspDataset(folder, 2500)
    assert len(dataset) == 5 * 2 * 2
    sample = dataset[3]
    assert sample.points.shape == (2500, 3) and sample.points.dtype == torch.float32
    assert (sample.scene, sample.view, round(float(sample.width), 6)) == (0, 1, 0.10)
    assert float(sample.points[:, 2].min()) > 0.66 and float(sample.points[:, 2].max()) < 1.26
    assert float(sample.colors.min()) >= 0.0 and float(sample.colors.max()) <= 1.0
    assert float(sample.confidence.min()) >= 0.0 and float(sample.confidence.max()) <= 1.0
    m = len(sample.score)
    assert sample.rotation.shape == (m, 3, 3) and sample.contacts.shape == (m, 2) and sample.grasp_object.shape == (m,)
    identity = sample.rotation.transpose(1, 2) @ sample.rotation
    torch.testing.assert_close(identity, torch.eye(3).expand_as(identity), atol=1e-5, rtol=0.0)


def test_samples_differ_by_epoch_and_seed_only(folder: Path) -> None:
    first, again, other = GraspDataset(folder, 500), GraspDataset(folder, 500), GraspDataset(folder, 500, seed=1)
    assert torch.equal(first[5].points, again[5].points)
    assert not torch.equal(first[5].points, other[5].points)
    again.set_epoch(1)
    assert not torch.equal(first[5].points, again[5].points)
    assert torch.equal(first[5].translation, again[5].translation)


def test_a_view_with_too_few_points_gives_some_twice(folder: Path) -> None:
    assert GraspDataset(folder, 400_000)[0].points.shape == (400_000, 3)


def test_loader_workers_read_and_collate(folder: Path) -> None:
    dataset = GraspDataset(folder, 300, widths=[0.10], scenes=[1, 3])
    alone = [dataset[i] for i in range(len(dataset))]
    batches = list(DataLoader(dataset, batch_size=2, num_workers=2, collate_fn=collate))
    assert sum(len(batch.scene) for batch in batches) == len(dataset) == 4
    batch = batches[1]
    assert batch.points.shape == (2, 300, 3) and batch.scene == (3, 3) and batch.view == (0, 1)
    torch.testing.assert_close(batch.points[1], alone[3].points)
    assert torch.equal(batch.score[batch.grasp_batch == 1], alone[3].score)


def test_readers_refuse_what_is_not_there(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"is no data set: it has no manifest\.json"):
        GraspDataset(tmp_path)
    with pytest.raises(InvalidInputError, match=r"labels for the widths 0.06, 0.1 m, not 0.08"):
        GraspDataset(folder, widths=[0.08])
    with pytest.raises(InvalidInputError, match="has 5 scenes, and none numbered"):
        GraspDataset(folder, scenes=[9])
    with pytest.raises(InvalidInputError, match="its scenes are 0 to 4"):
        SceneArchive(folder).info(77)
    with pytest.raises(IndexError):
        GraspDataset(folder)[20]


def test_statistics_are_means_of_what_is_stored(folder: Path) -> None:
    archive = SceneArchive(folder)
    result = statistics(archive)
    assert (result.scenes, result.views, sum(result.kinds.values())) == (5, 10, 5)
    scores = np.concatenate([archive.labels(index)[1].score for index in archive])
    assert result.widths[1].stored.grasps == pytest.approx(len(scores) / 5)
    assert result.widths[1].stored.antipodal_score == pytest.approx(scores.mean(), rel=1e-5)
    assert result.widths[1].found >= result.widths[1].stored.grasps


def test_inspect_prints_draws_and_verifies(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(folder), "--verify"]) == 0
    shown = capsys.readouterr().out
    assert "5 scenes" in shown and "883" in shown and "0.8654" in shown and "every file has its checksum" in shown
    assert main(["inspect", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenes"] == 5
    picture = tmp_path / "scene.png"
    assert main(["inspect", str(folder), "--view", str(picture), "--scene", "1", "-w", "0.1"]) == 0
    assert picture.stat().st_size > 20_000
    assert main(["inspect", str(folder), "--view", str(picture), "-w", "0.3"]) == 2
    assert "widths 0.06, 0.1 m, not 0.3" in capsys.readouterr().err


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("damage", ["flipped", "cut short", "missing", "unknown", "object"])
def test_verify_finds_damage_of_every_kind(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: str
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    shard = copy / "shards" / "shard-00001.tar"
    wrong = f"shards/{shard.name}"
    match damage:
        case "flipped":
            _flip(shard)
        case "cut short":
            shard.write_bytes(shard.read_bytes()[:5000])
        case "missing":
            shard.unlink()
        case "unknown":
            wrong = "shards/shard-00077.tar"
            shutil.copy(shard, copy / wrong)
        case "object":
            path = next((copy / "objects").iterdir())
            _flip(path)
            wrong = f"objects/{path.name}"
    assert main(["inspect", str(copy), "--verify"]) == 4
    assert capsys.readouterr().out == f"damaged: {wrong}\n"


def test_other_versions_of_the_libraries_are_refused(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    manifest = Manifest.load(copy)
    manifest.made_with = {**manifest.made_with, "mujoco": "3.0.0"}
    manifest.save(copy)
    with pytest.raises(InvalidInputError, match=r"other versions \(mujoco: 3\.0\.0 there, 4"):
        generate(copy, dataclasses.replace(SETTINGS, scenes=6), Here())


def test_candidates_may_be_deleted_and_come_back(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    shutil.rmtree(copy / "candidates")
    generate(copy, SETTINGS, Here(stop_after=0))  # complete: there is nothing to do
    generate(copy, dataclasses.replace(SETTINGS, scenes=6), Here())
    assert _checksums(copy)["shards/shard-00000.tar"] == _checksums(folder)["shards/shard-00000.tar"]
    assert (copy / "candidates").is_dir() and len(SceneArchive(copy)) == 6


def test_generate_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    command = ["generate", "--out", str(out), "--scenes", "1", "--library", "1", "--kind", "single", "-w", "0.08"]
    assert main([*command, "--paper-views", "1", "--dome-views", "0", "--workers", "1", "-q"]) == 0
    assert capsys.readouterr().out == "" and len(SceneArchive(out)) == 1
    assert main([*command, "--seed", "1"]) == 2
    assert "begun with other settings (seed: 0 there, 1 asked for" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--objects", ".", "--library", "3"], "leave out --library"),
        (["--objects-scale", "0.001"], "it needs --objects DIR"),
        (["--kind", "pile", "--kind", "pile=2"], "--kind pile is given twice"),
        (["--kind", "pile=many"], "--kind takes KIND or KIND=SHARE"),
        (["--workers", "-1"], "workers must be at least 0"),
        (["--objects", "nowhere"], "is not a folder"),
        (["--split", "dev"], "split must be one of"),
    ],
)
def test_options_that_make_no_sense_are_refused(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["generate", "--out", str(tmp_path / "data"), *options]) == 2
    shown = capsys.readouterr().err
    assert message in shown and shown.count("\n") == 1
    assert not (tmp_path / "data").exists()


def test_inspect_refuses_options_that_it_would_ignore(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(folder), "--scene", "3"]) == 2
    assert "--scene says what to draw: it needs --view FILE.png" in capsys.readouterr().err
    assert main(["inspect", str(folder), "--view", "a.png", "--json"]) == 2
    assert "in a call of its own" in capsys.readouterr().err
