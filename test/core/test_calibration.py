"""The two experiments and the command: distributions, repeatability, and that the parts are put together rightly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from regnet_core.cli import main
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.errors import InvalidInputError
from regnet_core.policies import load_policy
from regnet_core.robots import reach, trials
from regnet_core.robots.calibration import calibrate
from regnet_core.robots.fits import Samples, fit_grasp, fit_reach
from regnet_core.robots.pictures import binned, draw_calibration
from regnet_core.robots.reach import ReachSamples, ReachSettings, sample_poses, sample_reach, work_table
from regnet_core.robots.trials import DataSetScenes, MadeScenes, Trials, TrialSettings, spread_over_quality


def test_poses_have_the_documented_distribution() -> None:
    settings = ReachSettings("baxter", half_side=0.2, heights=(0.01, 0.15))
    poses = sample_poses(settings, 20_000, np.random.default_rng(0))
    X = poses[:, :3, 0]
    tips = poses[:, :3, 3] + settings.gripper.depth * X - [0.0, 0.0, work_table().upper[2]]
    assert np.abs(tips[:, :2]).max() <= 0.2 + 1e-9 and tips[:, 2].min() >= 0.01 - 1e-9 and tips[:, 2].max() <= 0.15
    assert tips.mean(axis=0) == pytest.approx([0.0, 0.0, 0.08], abs=0.005)
    assert np.linalg.det(poses[:, :3, :3]) == pytest.approx(np.ones(len(poses)))
    # Uniform over the sphere: each coordinate of the approach is uniform in [-1, 1].
    for axis in range(3):
        counts, _ = np.histogram(X[:, axis], 10, (-1.0, 1.0))
        assert counts / len(X) == pytest.approx(np.full(10, 0.1), abs=0.01)


def test_reach_falls_with_the_hands_tilt_and_the_seed_decides(here: Any, backwards: Any) -> None:
    settings = ReachSettings("baxter", samples=130, seed=5)
    first, second = sample_reach(settings, here), sample_reach(settings, backwards)
    assert (first.vertical_score == second.vertical_score).all() and (first.reached == second.reached).all()
    assert len(first.reached) == 130 == sum(first.counts.values())
    assert first.counts[reach.REACHED] == first.reached.sum()
    steep, flat = first.vertical_score > 0.75, first.vertical_score < 0.4
    assert first.reached[steep].mean() > 0.5 and first.reached[flat].mean() == 0.0  # from below, the table is there


def test_a_pre_grasp_can_only_take_away(here: Any) -> None:
    without = sample_reach(ReachSettings("panda", samples=60, pre_grasp_distance=0.0), here)
    needed = sample_reach(ReachSettings("panda", samples=60), here)
    assert (without.vertical_score == needed.vertical_score).all()
    assert not (needed.reached & ~without.reached).any()
    assert needed.counts.get(reach.NO_PRE_GRASP, 0) == (without.reached & ~needed.reached).sum() > 0


def test_grasps_are_chosen_over_the_whole_range_of_quality() -> None:
    rng = np.random.default_rng(0)
    quality = np.sort(1.0 - 0.1 * rng.exponential(size=500).clip(0.0, 9.0))[::-1]  # nearly all are good
    chosen = np.concatenate([quality[spread_over_quality(quality, 5, rng)] for _ in range(200)])
    low, high = quality.min(), quality.max()
    assert chosen.mean() == pytest.approx(0.5 * (low + high), abs=0.08)
    assert len(set(spread_over_quality(quality, 20, rng))) == 20
    assert spread_over_quality(quality[:3], 5, rng) == [0, 1, 2]


def test_executed_grasps_of_a_data_set(tiny: SceneArchive, here: Any, backwards: Any) -> None:
    settings = TrialSettings(DataSetScenes(tiny), grasps=4, per_scene=2, model="random")
    first, second = trials.execute_grasps(settings, here), trials.execute_grasps(settings, backwards)
    assert len(first.outcomes) == 4
    assert first.outcomes == second.outcomes and (first.predicted == second.predicted).all()
    assert ((first.predicted >= 0.0) & (first.predicted <= 1.0)).all() and ((first.true >= 0) & (first.true <= 1)).all()
    assert first.held.sum() == first.outcomes.count("held")
    assert (first.quality("true") == first.true).all()
    with pytest.raises(InvalidInputError, match="predicted or true, got 'hoped'"):
        first.quality("hoped")


def test_made_scenes_take_turns_and_repeat() -> None:
    scenes = MadeScenes(seed=3)
    scene, cloud = scenes(1)  # of the kind "single"
    again, same = scenes(1)
    assert len(scene.objects) == 1 and (scene.poses == again.poses).all() and (cloud.points == same.points).all()
    assert len(cloud.points) > 500 and cloud.viewpoint[2] > scene.table_height


def _experiments() -> tuple[ReachSettings, TrialSettings, ReachSamples, Trials]:
    rng = np.random.default_rng(7)
    score = rng.uniform(size=4000)
    reached = rng.uniform(size=4000) < 1.0 / (1.0 + np.exp(-12.0 * (score - 0.7)))
    counts = {reach.REACHED: int(reached.sum()), reach.OUT_OF_REACH: int((~reached).sum())}
    predicted = rng.uniform(size=2000)
    held = rng.uniform(size=2000) < 0.7 * predicted + 0.2
    executed = Trials(predicted, predicted**2, tuple(np.where(held, "held", "slipped").tolist()))
    samples = ReachSamples(score, reached, counts)
    return ReachSettings("panda", 4000), TrialSettings(grasps=2000), samples, executed


def test_the_policy_file_has_the_fitted_constants_and_their_origin() -> None:
    reach_settings, trial_settings, samples, executed = _experiments()
    result = calibrate(reach_settings, trial_settings, samples, executed)
    curve = fit_reach(Samples.of(samples.vertical_score, samples.reached))
    line = fit_grasp(Samples.of(executed.predicted, executed.held))
    policy = result.file.policy
    found = (policy.quality_gain, policy.quality_offset, policy.slope, policy.midpoint)
    assert found == pytest.approx((line.gain, line.offset, curve.slope, curve.midpoint), abs=5e-5)
    assert policy.slope == pytest.approx(12.0, rel=0.1) and policy.quality_gain == pytest.approx(0.7, abs=0.1)
    assert result.file.origin["robot"] == "Franka Emika Panda"
    assert result.file.origin["reach"]["reached"] == samples.reached.sum()
    assert result.file.origin["grasp"]["held"] == executed.held.sum()
    over_true = calibrate(reach_settings, trial_settings, samples, executed, "true")
    assert over_true.grasp != result.grasp


def test_frequencies_of_the_picture_are_counted_by_hand() -> None:
    score = np.array([0.05, 0.06, 0.07, 0.08, 0.55, 0.95, 0.96, 1.0])
    success = np.array([0, 0, 1, 1, 1, 1, 1, 1])
    frequencies = binned(score, success, bins=10)
    assert frequencies.score == pytest.approx([0.065, 0.97])  # a single sample is no frequency
    assert frequencies.share == pytest.approx([0.5, 1.0])
    # Wilson's interval with z = 1: (p + 1 / 2n) / (1 + 1 / n) -+ sqrt(p q / n + 1 / 4 n^2) / (1 + 1 / n).
    assert frequencies.error[:, 0] == pytest.approx([np.sqrt(0.0625 + 1 / 64) / 1.25] * 2)
    assert frequencies.error[:, 1] == pytest.approx([0.25, 0.0])


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    reach_settings, trial_settings, samples, executed = _experiments()
    draw_calibration(calibrate(reach_settings, trial_settings, samples, executed), tmp_path / "deep" / "fit.png")
    assert (tmp_path / "deep" / "fit.png").read_bytes()[:4] == b"\x89PNG"


def test_the_command_writes_a_policy_that_can_be_loaded(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, here: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("regnet_core.data.generation.executors.LocalExecutor", lambda workers: here)
    executed = _experiments()[-1]
    monkeypatch.setattr("regnet_core.robots.trials.execute_grasps", lambda settings, executor, progress: executed)
    out = tmp_path / "panda.yaml"
    arguments = ["calibrate", "--robot", "panda", "--samples", "60", "--data", str(tiny_folder)]
    assert main([*arguments, "--model", "random", "--seed", "1", "--out", str(out), "-q"]) == 0
    output = capsys.readouterr().out
    assert "midpoint" in output and "10.1244" in output and f"wrote {out}" in output
    assert load_policy(out).origin["grasp"]["model"] == "random"
    assert yaml.safe_load(out.read_text())["origin"]["reach"]["samples"] == 60


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "x.json"], "--out must end in .yaml"),
        (["--out", "x.yaml", "--picture", "x.jpg"], "--picture must end in .png"),
        (["--out", "x.yaml", "--robot", "r2d2"], "no robot 'r2d2'"),
        (["--out", "x.yaml", "--quality", "hoped"], "--quality must be predicted or true"),
        (["--out", "x.yaml", "--samples", "0"], "samples must be in [1"),
    ],
)
def test_wrong_arguments_are_refused_before_any_work(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", *arguments]) == 2
    assert message in capsys.readouterr().err
