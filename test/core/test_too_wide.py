"""Whether a method keeps to the gripper that it is told of: sizes, needs and shares against known answers."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from regnet_core.data.storage.archive import SceneArchive
from regnet_core.errors import InvalidInputError, ModelError
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.evaluation.observed import RecordedViews
from regnet_core.evaluation.too_wide import (
    Asked,
    TooWideSettings,
    needed_on,
    run_too_wide,
    size_across,
    summarise_too_wide,
)
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper

ROOT = Path(__file__).resolve().parents[2]
DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: approach -z, closing +y, their cross product +x."""


def _turned(mesh: trimesh.Trimesh, axis: str, degrees: float) -> trimesh.Trimesh:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return mesh.copy().apply_transform(T)


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 90.0])
def test_the_size_across_is_the_least_horizontal_extent_as_it_lies(degrees: float) -> None:
    box = trimesh.creation.box(extents=(0.12, 0.08, 0.03))
    assert size_across(_turned(box, "z", degrees)) == pytest.approx(0.08)
    upright = _turned(box, "x", 90.0)  # it now stands on its long edge
    assert size_across(_turned(upright, "z", degrees)) == pytest.approx(0.03)
    can = trimesh.creation.cylinder(radius=0.04, height=0.2, sections=256)
    assert size_across(_turned(can, "z", degrees)) == pytest.approx(0.08, abs=1e-5)


def test_what_is_between_the_fingers_is_measured_on_the_objects_asked_for() -> None:
    wide = trimesh.creation.box(extents=(0.08, 0.08, 0.06)).apply_translation((0.0, 0.0, 0.03))
    narrow = trimesh.creation.box(extents=(0.02, 0.02, 0.06)).apply_translation((0.3, 0.0, 0.03))
    truth, gripper = GroundTruth([wide, narrow], None), Gripper(width=0.06)
    centres = np.array([(0.0, 0.0, 0.08), (0.3, 0.0, 0.08), (0.6, 0.0, 0.08)])
    grasps = Grasps.from_poses(np.tile(DOWN, (3, 1, 1)), centres, np.full(3, 0.06), np.ones(3))
    np.testing.assert_allclose(needed_on(truth, grasps, gripper, [0]), [0.08], atol=1e-6)
    np.testing.assert_allclose(needed_on(truth, grasps, gripper, [0, 1]), [0.08, 0.02], atol=1e-6)
    assert len(needed_on(truth, grasps, gripper, [])) == 0


def _asked(model: str, scene: int, width: float, proposed: list[float], final: list[float]) -> Asked:
    return Asked(model, scene, width, np.array(proposed), np.array(final), np.array(final[:1]))


def test_shares_are_of_all_proposals_with_errors_over_scenes() -> None:
    rows = summarise_too_wide(
        [
            _asked("net", 0, 0.12, [0.08, 0.13], [0.08]),
            _asked("net", 0, 0.06, [0.05, 0.08, 0.07], [0.05]),
            _asked("net", 3, 0.06, [0.04], []),
            _asked("blind", 0, 0.06, [], []),
        ]
    )
    assert [(row.width, row.model) for row in rows][:2] == [(0.06, "net"), (0.06, "blind")]
    net, blind, wide = rows[0], rows[1], rows[2]
    assert (net.proposed.count, net.final.count) == (4, 1)
    assert net.proposed.above_told.mean == 0.5 == net.proposed.above_least.mean
    # Deviations by scene: 0.5 and -0.5; sqrt(2 * 0.5) / 4.
    assert net.proposed.above_told.error == pytest.approx(0.25)
    assert net.final.above_told.mean == 0.0
    assert blind.proposed.count == 0 and np.isnan(blind.proposed.above_told.mean)
    assert (wide.proposed.above_told.mean, wide.proposed.above_least.mean) == (0.5, 1.0)
    assert summarise_too_wide([]) == []


def test_random_hands_need_more_than_the_gripper_opens(tiny: SceneArchive, here: Any) -> None:
    settings = TooWideSettings(("random",), (0,), (0.04, 0.12), (0.05, 0.2), RecordedViews(8000))
    narrow, wide = run_too_wide(tiny, settings, here)
    assert (narrow.model, narrow.scene, narrow.width, wide.width) == ("random", 0, 0.04, 0.12)
    assert len(narrow.proposed) > 20 and len(narrow.final) < len(narrow.proposed)
    assert narrow.best.tolist() == narrow.final[: len(narrow.best)].tolist()
    row = summarise_too_wide([narrow])[0]
    assert row.proposed.above_told.mean > 0.5  # nothing tells a random hand how wide the object is
    left, given = row.final, row.proposed
    assert (
        left.count * np.nan_to_num(left.above_told.mean) < 0.1 * given.count * given.above_told.mean
    )  # most are found
    again = run_too_wide(tiny, settings, here)
    np.testing.assert_array_equal(again[0].proposed, narrow.proposed)
    nothing = TooWideSettings(("random",), tiny.indices, across=(0.9, 1.0))
    assert run_too_wide(tiny, nothing, here) == []


def test_impossible_studies_are_refused(tiny: SceneArchive, here: Any) -> None:
    with pytest.raises(InvalidInputError, match="across is"):
        TooWideSettings(("random",), (0,), across=(0.09, 0.07))
    with pytest.raises(InvalidInputError, match="at least one model"):
        TooWideSettings((), (0,))
    with pytest.raises(ModelError, match="no model 'best'"):
        run_too_wide(tiny, TooWideSettings(("best",), (0,)), here)


def _tool(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_study_of_widths_prints_and_draws(
    tiny_folder: Path, tmp_path: Path, here: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "width.png"
    options = [str(tiny_folder), "--model", "random", "--model", "antipodal", "--scenes", "2"]
    options += ["--across", "0.03", "0.12", "--points", "6000", "--out", str(picture)]
    monkeypatch.setattr(sys, "argv", ["study_width.py", *options])
    tool = _tool("study_width")
    monkeypatch.setattr(tool, "LocalExecutor", lambda workers: here)
    tool.main()
    shown = capsys.readouterr().out
    assert "2 scenes have objects of 3 to 12 cm" in shown and shown.count("antipodal") == 2
    assert picture.stat().st_size > 15_000


def test_the_study_of_cameras_prints_both_side_by_side(
    tiny_folder: Path, tmp_path: Path, here: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [str(tiny_folder), "--model", "antipodal", "--scenes", "2", "--width", "0.10"]
    options += ["--points", "6000", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["study_unseen_camera.py", *options])
    tool = _tool("study_unseen_camera")
    monkeypatch.setattr(tool, "LocalExecutor", lambda workers: here)
    tool.main()
    shown = capsys.readouterr().out
    assert "848 x 480" in shown and "1.50 to 1.72" in shown
    assert all(text in shown for text in ("seen", "unseen", "change", "AS(w/ C)", "TCR"))
    assert {path.name for path in tmp_path.iterdir()} == {"seen.json", "unseen.json"}
