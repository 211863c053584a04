"""Episodes of picking: when they end, what the rates are, and the command from end to end."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from regnet_core.cli import app
from regnet_core.data.generation.executors import LocalExecutor
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.picking.clearance import meets_boxes
from regnet_core.picking.episode import GIVEN_UP, USED_UP, StopRule
from regnet_core.picking.objects import draw_objects
from regnet_core.picking.scenes import pick_scene
from regnet_core.picking.study import PickSettings, run_study
from regnet_core.picking.summary import ALL, summarise
from regnet_core.picking.workcell import CAMERA_POSES, PICK_BIN, bin_workcell

DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""X, the approach, straight down."""


def test_an_episode_ends_after_spare_attempts_or_failures_in_a_row() -> None:
    paper, vgn = StopRule(spare=5), StopRule(failures=2)
    assert paper.reason(3, [False] * 7) is None and paper.reason(3, [False] * 8) == USED_UP
    assert vgn.reason(5, [False, True, False]) is None and vgn.reason(5, [True, False, False]) == GIVEN_UP
    assert vgn.reason(5, [True] * 50) is None
    with pytest.raises(InvalidInputError, match="may never end"):
        StopRule()


def test_the_protocols_of_the_paper_and_of_vgn() -> None:
    assert pick_scene("mixed-20").rule == StopRule(spare=5)
    assert pick_scene("packed-5").rule == StopRule(failures=2)
    for wrong in ("mixed", "mixed-0", "soft-10", "easy-x"):
        with pytest.raises(InvalidInputError, match="scene"):
            pick_scene(wrong)


def test_objects_are_of_their_class_and_of_a_seed() -> None:
    wanted = pick_scene("mixed-4").objects
    first, again = draw_objects(wanted, 3, 0), draw_objects(wanted, 3, 0)
    assert [model.name for model in first] == [model.name for model in again] and len(first) == 4
    assert all(model.name.startswith("test") for model in first)  # of the split that nothing is trained on
    other = draw_objects(wanted, 3, 1)
    assert any(
        a.name != b.name or not np.array_equal(a.mesh.vertices, b.mesh.vertices)
        for a, b in zip(first, other, strict=True)
    )


def record(
    episode: int, camera: str, objects: int, attempts: list[tuple[str | None, int, str | None]]
) -> dict[str, Any]:
    """An episode with attempts (class of failure, objects placed, touch)."""
    return {
        "cell": {"scene": "easy-4", "model": "m", "policy": "analytic", "camera": camera},
        "episode": episode,
        "objects": ["x"] * objects,
        "end": "nothing left",
        "attempts": [
            {"failure": failure, "placed": list(range(placed)), "contact": touch, "detection_seconds": 0.1}
            for failure, placed, touch in attempts
        ],
    }


def test_rates_by_hand() -> None:
    rows = summarise(
        [
            record(0, "front", 4, [(None, 1, None), (None, 1, "a touch"), ("collision", 0, "x"), (None, 1, None)]),
            record(1, "front", 4, [("more than one object", 2, None), (None, 1, None)]),
            record(0, "above", 4, [(None, 1, None)] * 4),
        ]
    )
    front, above, both = rows
    assert (front.camera, above.camera, both.camera) == ("front", "above", ALL)
    assert (front.episodes, front.objects, front.attempts, front.successes, front.placed) == (2, 8, 6, 4, 6)
    assert front.success_rate.mean == pytest.approx(4 / 6) and front.completion_rate.mean == pytest.approx(6 / 8)
    assert front.untouched == pytest.approx(3 / 6)
    assert front.failures == {"unstable": 0, "collision": 1, "gripper limit": 0, "more than one object": 1}
    assert above.success_rate.mean == above.completion_rate.mean == 1.0
    assert both.attempts == 10 and both.success_rate.mean == pytest.approx(8 / 10)
    assert summarise([record(0, "front", 3, [])])[0].attempts == 0
    assert math.isnan(summarise([record(0, "front", 3, [])])[0].success_rate.mean)


def test_hands_that_would_meet_a_box() -> None:
    gripper = Gripper(width=0.08)
    d = gripper.depth  # the fingertips are at the origin, beside it, and above it
    centres = np.array([[0.0, 0.0, d], [0.2, 0.0, d], [0.0, 0.0, 0.3 + d]])
    grasps = Grasps.from_poses(np.tile(DOWN, (3, 1, 1)), centres, np.full(3, 0.08), np.ones(3))
    finger = Box((-0.02, 0.042, 0.01), (0.02, 0.048, 0.02))  # where the finger at +Y of the first hand is
    assert meets_boxes(grasps, gripper, [finger], 0.1, 0.0).tolist() == [True, False, False]
    beside = Box((-0.02, 0.053, 0.01), (0.02, 0.06, 0.02))
    assert meets_boxes(grasps, gripper, [beside], 0.1, 0.0).tolist() == [False, False, False]
    assert meets_boxes(grasps, gripper, [beside], 0.1, 0.004).tolist() == [True, False, False]
    above = Box((-0.01, -0.01, 0.2), (0.01, 0.01, 0.21))  # the palm comes through there on its way
    assert meets_boxes(grasps, gripper, [above], 0.1, 0.0).tolist() == [True, False, False]
    assert meets_boxes(grasps, gripper, [above], 0.0, 0.0).tolist() == [False, False, False]


def test_all_cameras_see_the_whole_floor_of_the_bin() -> None:
    lower, upper = np.array(PICK_BIN.inside.lower), np.array(PICK_BIN.inside.upper)
    for pose in CAMERA_POSES.values():
        towards = 0.5 * (lower + upper) - pose[:3, 3]
        assert pose[2, 3] > upper[2] and towards @ pose[:3, 2] > 0.9 * np.linalg.norm(towards)  # z is the viewing axis
    cell = bin_workcell()
    middle = np.tile(np.eye(4), (2, 1, 1))
    middle[0, :3, 3], middle[1, :3, 3] = 0.5 * (lower + upper), [*cell.place, lower[2] + 0.03]
    assert cell.to_pick(middle).tolist() == [True, False] and cell.placed(middle).tolist() == [False, True]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small study by the command."""
    folder = tmp_path_factory.mktemp("picking")
    done = CliRunner().invoke(app, [*command(folder), "--picture", str(folder / "chart.png")])
    assert done.exit_code == 0, done.output
    assert "easy-2" in done.output and "SR" in done.output
    return folder


def command(folder: Path) -> list[str]:
    return f"simulate --out {folder} --scene easy-2 --model antipodal --episodes 1 --workers 1 -q".split()


def test_the_command_picks_writes_and_draws(finished: Path) -> None:
    document = json.loads((finished / "study.json").read_text())
    (episode,) = (finished / "episodes").rglob("*.json")
    steps = json.loads(episode.read_text())["attempts"]
    (row,) = document["summaries"]
    assert row["attempts"] == len(steps) <= 7 and row["successes"] == sum(step["failure"] is None for step in steps)
    assert row["successes"] >= 1  # two easy objects: antipodal grasps place at least one of them
    assert (finished / "chart.png").stat().st_size > 5_000


def test_a_finished_study_is_not_run_again_and_gives_the_same_anew(finished: Path, tmp_path: Path) -> None:
    (episode,) = (finished / "episodes").rglob("*.json")
    before = episode.stat().st_mtime_ns
    assert CliRunner().invoke(app, command(finished)).exit_code == 0
    assert episode.stat().st_mtime_ns == before
    settings = PickSettings(
        scenes=("easy-2",), models=("antipodal",), policies=("analytic",), cameras=("front",), episodes=1
    )
    (anew,) = run_study(tmp_path, settings, LocalExecutor(1))
    old = json.loads(episode.read_text())

    def facts(record: Any) -> Any:
        return [(a["failure"], a["placed"], a["message"]) for a in record["attempts"]]

    assert facts(anew) == facts(old)


def test_other_settings_in_the_same_folder_are_refused(finished: Path) -> None:
    done = CliRunner().invoke(app, [*command(finished), "--gripper-width", "0.1"])
    assert done.exit_code != 0 and "width" in str(done.output) + str(done.exception)


def test_an_attempt_is_watched(finished: Path) -> None:
    done = CliRunner().invoke(app, [*command(finished), "--watch", "0:0"])
    assert done.exit_code == 0, done.output
    (picture,) = (finished / "watched").glob("*.png")
    assert picture.stat().st_size > 20_000
    assert CliRunner().invoke(app, [*command(finished), "--watch", "0:99"]).exit_code != 0
