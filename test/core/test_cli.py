"""The command ``regnet``: exit codes, messages, tables, JSON, .npz and pictures; in this process and as a real one."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import shapes
from PIL import Image
from typer.testing import CliRunner

import regnet_core
from regnet_core import AnalyticPolicy, GraspDetector, Grasps, Gripper
from regnet_core.cli import app, main
from regnet_core.models import DEFAULT_MODEL

BAGS = Path(__file__).parents[2] / "bags"
BOX = shapes.single_view(shapes.box(0.05, 0.12, 0.10))
TABLE = shapes.single_view(None)
CAMERA_POSE = (0.8, 0.0, 1.7, 2.5, 0.0, 1.5)


@pytest.fixture(scope="module")
def clouds(tmp_path_factory) -> Path:
    """A folder with a box on a table, the same in a camera's frame, and an empty table."""
    folder = tmp_path_factory.mktemp("clouds")
    np.savez(folder / "box.npz", points=BOX, colors=np.full((len(BOX), 3), 128, np.uint8))
    np.save(folder / "table.npy", TABLE)
    pose = regnet_core.geometry.pose_matrix(CAMERA_POSE[:3], CAMERA_POSE[3:])
    np.save(folder / "camera.npy", regnet_core.geometry.transform_points(np.linalg.inv(pose), BOX))
    return folder


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr."""
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def run_detect(capsys, *arguments: object) -> tuple[int, str, str]:
    """The same of `regnet detect` with the model antipodal, unless another one is named."""
    return run(capsys, "detect", "--model", "antipodal", *arguments)


def records(capsys, *arguments: object) -> list[dict]:
    code, out, err = run_detect(capsys, "--json", *arguments)
    assert (code in (0, 3), err) == (True, "")
    document = json.loads(out)
    assert document["regnet_version"] == regnet_core.__version__
    return document["results"]


# Tables


def test_the_tables_show_steps_grasps_and_the_selected_one(clouds, capsys):
    code, out, err = run_detect(capsys, clouds / "box.npz", "--top", 3)
    assert (code, err) == (0, "")
    detection = GraspDetector("antipodal").detect(BOX)
    selected = regnet_core.select(detection.grasps, regnet_core.HeuristicPolicy())
    assert f"{len(detection.grasps)} grasps" in out and f"{len(BOX)} points" in out
    for step in detection.report.steps:
        assert any(line.split()[-3:-1] == [str(step.kept), str(step.rejected)] for line in out.splitlines())
    marked = [line.split() for line in out.splitlines() if line.strip().startswith(">")]
    assert [(row[1], row[4]) for row in marked] == [(str(selected.rank), f"{selected.score:.3f}")]
    assert f"selected: rank {selected.rank} by the heuristic policy (score {selected.score:.3f})" in out


def test_no_grasp_is_exit_code_3_with_the_reason(clouds, capsys):
    code, out, err = run_detect(capsys, clouds / "table.npy")
    assert (code, err) == (3, "")
    assert "no grasp: nothing stands on the support plane" in out


def test_quiet_prints_nothing(clouds, capsys):
    assert run_detect(capsys, "-q", clouds / "box.npz") == (0, "", "")
    assert run_detect(capsys, "-q", clouds / "table.npy") == (3, "", "")


# JSON and .npz


def test_json_holds_the_detection_in_plain_numbers(clouds, capsys):
    (record,) = records(capsys, clouds / "box.npz", "--policy", "analytic", "--seed", 4, "-w", 0.07)
    detection = GraspDetector("antipodal", seed=4).detect(BOX, Gripper(width=0.07))
    grasps = detection.grasps
    assert record["source"] == {
        "file": str(clouds / "box.npz"),
        "topic": None,
        "message": None,
        "stamp_ns": None,
        "points": len(BOX),
    }
    assert record["gripper"]["width"] == 0.07 and record["frame"] is None and record["reason"] == ""
    assert [step["name"] for step in record["steps"]] == [step.name for step in detection.report.steps]
    assert [g["rank"] for g in record["grasps"]] == list(range(len(grasps)))
    for name in ("rotation", "translation", "width", "quality", "vertical_score", "confidence"):
        np.testing.assert_allclose([g[name] for g in record["grasps"]], getattr(grasps, name), err_msg=name)
    score = AnalyticPolicy().score(grasps.quality, grasps.vertical_score)
    np.testing.assert_allclose([g["policy_score"] for g in record["grasps"]], score)
    assert record["selected"] == {"rank": int(score.argmax()), "score": pytest.approx(score.max())}
    x, y, z, w = record["grasps"][0]["quaternion_xyzw"]
    assert [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)] == pytest.approx(grasps.approach[0])


def test_out_writes_what_json_prints_and_npz_that_grasps_load(clouds, capsys, tmp_path):
    printed = records(capsys, clouds / "box.npz", "--out", tmp_path / "out.json")
    written = json.loads((tmp_path / "out.json").read_text())["results"]
    assert written == printed
    code, out, _ = run_detect(capsys, clouds / "box.npz", "--out", tmp_path / "new" / "out.npz")
    assert code == 0 and f"wrote {tmp_path / 'new' / 'out.npz'}" in out
    loaded = Grasps.load(tmp_path / "new" / "out.npz")
    np.testing.assert_array_equal(loaded.translation, GraspDetector("antipodal").detect(BOX).grasps.translation)


def test_an_empty_result_is_written_too(clouds, capsys, tmp_path):
    assert run_detect(capsys, "-q", clouds / "table.npy", "--out", tmp_path / "out.npz")[0] == 3
    assert len(Grasps.load(tmp_path / "out.npz")) == 0


# Options


def test_every_width_and_every_file_has_its_result(clouds, capsys):
    found = records(capsys, clouds / "box.npz", clouds / "table.npy", "-w", 0.08, "-w", 0.04)
    assert [(Path(r["source"]["file"]).name, r["gripper"]["width"], bool(r["grasps"])) for r in found] == [
        ("box.npz", 0.08, True),
        ("box.npz", 0.04, False),
        ("table.npy", 0.08, False),
        ("table.npy", 0.04, False),
    ]
    assert run_detect(capsys, "-q", clouds / "box.npz", "-w", 0.08, "-w", 0.04)[0] == 0


def test_gripper_dimensions_reach_the_detector(clouds, capsys):
    dimensions = {"width": 0.09, "depth": 0.05, "height": 0.02, "thickness": 0.008, "palm_depth": 0.1}
    options = [f"--gripper-{name.replace('_', '-')}={value}" for name, value in dimensions.items()]
    assert records(capsys, clouds / "box.npz", *options)[0]["gripper"] == dimensions


def test_filters_limit_the_grasps(clouds, capsys):
    everything = records(capsys, clouds / "box.npz")[0]["grasps"]
    assert min(g["vertical_score"] for g in everything) < 0.8
    steep = records(capsys, clouds / "box.npz", "--approach-angle", 20)[0]["grasps"]
    assert steep and min(g["vertical_score"] for g in steep) >= 1 - 20 / 180 - 1e-9
    least = sorted(g["quality"] for g in everything)[len(everything) // 2]
    good = records(capsys, clouds / "box.npz", "--min-quality", least)[0]["grasps"]
    assert 0 < len(good) < len(everything) and min(g["quality"] for g in good) >= least
    one_end = records(capsys, clouds / "box.npz", "--target", *(-1, 0.01, 0.7, 1, 1, 1))[0]["grasps"]
    assert one_end and min(g["translation"][1] for g in one_end) > -0.01 > min(g["translation"][1] for g in everything)


def test_a_network_of_ones_own_detects_by_the_path_of_its_weights(clouds, capsys, untrained, tmp_path):
    (record,) = records(capsys, clouds / "box.npz", "--model", untrained, "--device", "cpu")
    expected = GraspDetector(untrained, "cpu").detect(BOX)
    assert (record["model"], record["device"]) == (str(untrained), "cpu")
    assert [step["kept"] for step in record["steps"]] == [step.kept for step in expected.report.steps]
    np.testing.assert_array_equal([g["translation"] for g in record["grasps"]], expected.grasps.translation)
    code, out, err = run_detect(capsys, clouds / "box.npz", "--model", untrained, "--device", "toaster")
    assert (code, out) == (2, "") and "a network does not run on 'toaster' here" in err


def test_crop_drops_points_before_detection(clouds, capsys):
    (record,) = records(capsys, clouds / "box.npz", "--crop", *(-0.2, -0.2, 0.5, 0.2, 0.2, 0.76))
    inside = (np.abs(BOX[:, :2]) <= 0.2).all(axis=1) & (BOX[:, 2] <= 0.76)
    assert record["source"]["points"] == inside.sum()
    assert record["grasps"] == [] and record["reason"] and record["selected"] is None


def test_the_sensor_pose_brings_a_camera_cloud_upright(clouds, capsys):
    (record,) = records(capsys, clouds / "camera.npy", "--sensor-pose", *CAMERA_POSE)
    expected = GraspDetector("antipodal").detect(BOX, viewpoint=CAMERA_POSE[:3]).grasps
    assert len(record["grasps"]) == pytest.approx(len(expected), rel=0.1)
    np.testing.assert_allclose(record["grasps"][0]["translation"], expected.translation[0], atol=0.03)
    assert 0.75 < record["grasps"][0]["translation"][2] < 0.93


def test_the_detector_is_told_where_the_camera_was(clouds, capsys, monkeypatch):
    seen = []
    detect = GraspDetector.detect

    def recording(self, *arguments, viewpoint=None, **settings):
        seen.append(viewpoint)
        return detect(self, *arguments, viewpoint=viewpoint, **settings)

    monkeypatch.setattr(GraspDetector, "detect", recording)
    box, tilted = clouds / "box.npz", BAGS / "tilted_depth_only"
    assert run_detect(capsys, "-q", box)[0] == 0
    assert run_detect(capsys, "-q", box, "--viewpoint", 1, 2, 3)[0] == 0
    assert run_detect(capsys, "-q", clouds / "camera.npy", "--sensor-pose", *CAMERA_POSE)[0] == 0
    assert run_detect(capsys, "-q", tilted, "--crop", -0.5, -0.5, 0.6, 0.5, 0.5, 1.2)[0] == 0
    camera = json.loads((tilted / "scene.json").read_text())["T_world_camera"][0]
    assert seen[:3] == [None, (1, 2, 3), CAMERA_POSE[:3]]
    np.testing.assert_allclose(seen[3], np.array(camera)[:3, 3], atol=1e-6)


# Bags


def test_a_bag_gives_its_message_in_the_frame_of_its_root(capsys):
    (record,) = records(capsys, BAGS / "one_object", "--message", 1)
    assert record["frame"] == "world" and record["grasps"]
    assert record["source"]["message"] == 1 and record["source"]["stamp_ns"] > 0


def test_all_messages_of_a_bag(capsys):
    found = records(capsys, BAGS / "empty_table", "--all")
    assert [record["source"]["message"] for record in found] == list(range(len(found))) and len(found) > 1
    assert all(record["reason"] for record in found)


def test_a_depth_camera_in_its_own_frame_is_turned_upright_by_the_bag(capsys):
    (record,) = records(capsys, BAGS / "tilted_depth_only", "--crop", *(-0.5, -0.5, 0.6, 0.5, 0.5, 1.2))
    assert record["frame"] == "world" and len(record["grasps"]) > 50
    assert 0.7 < np.median([g["translation"][2] for g in record["grasps"]]) < 1.0


# Pictures


def test_view_writes_the_page_and_the_picture(clouds, capsys, tmp_path):
    code, out, err = run_detect(capsys, clouds / "box.npz", "-w", 0.08, "-w", 0.1, "--view", tmp_path / "box.html")
    assert (code, err) == (0, "")
    assert f"wrote {tmp_path / 'box.html'}" in out and f"wrote {tmp_path / 'box.png'}" in out
    page = (tmp_path / "box.html").read_text()
    assert "selected (rank" in page and "gripper width 100 mm" in page and 'src="http' not in page
    picture = np.asarray(Image.open(tmp_path / "box.png"))
    assert picture.shape[1] > 1.5 * picture.shape[0] and picture.std() > 20


def test_a_png_alone_of_a_scene_without_grasps(clouds, capsys, tmp_path):
    assert run_detect(capsys, "-q", clouds / "table.npy", "--view", tmp_path / "table.png") == (3, "", "")
    assert [file.name for file in tmp_path.iterdir()] == ["table.png"]


# Errors


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("there is no file 'nothing.pcd'", ["nothing.pcd"]),
        ("there is no file 'folder.npy'", ["folder.npy"]),
        ("unknown suffix '.txt'", ["cloud.txt"]),
        ("there is no bag 'gone.mcap'", ["gone.mcap"]),
        ("gripper width must be in [0.03, 0.16] m, got 0.5", ["BOX", "-w", 0.5]),
        ("Invalid value for '--seed'", ["BOX", "--seed", -1]),
        ("gripper depth must be in", ["BOX", "--gripper-depth", 9]),
        ("'--gripper-width'", ["BOX", "-w", "wide"]),
        ("no model 'magic'; there are", ["BOX", "--model", "magic"]),
        ("there are no weights at '/", ["BOX", "--model", "my.safetensors"]),
        ("not on 'abacus'", ["BOX", "--device", "abacus"]),
        ("no policy 'luck'; there are heuristic, analytic", ["BOX", "--policy", "luck"]),
        ("--crop: a box needs lower < upper", ["BOX", "--crop", 0, 0, 0, 0, 1, 1]),
        ("--target: a box needs lower < upper", ["BOX", "--target", 0, 0, 0, "nan", 1, 1]),
        ("'--crop'", ["BOX", "--crop", 0, 0]),
        ("min_quality must be in [0, 1], got 2", ["BOX", "--min-quality", 2]),
        ("--approach-angle must be more than 0", ["BOX", "--approach-angle", 0]),
        ("--sensor-pose must be six finite numbers", ["BOX", "--sensor-pose", 0, 0, 0, 0, 0, "inf"]),
        ("--out must end in .json or .npz, got 'x.csv'", ["BOX", "--out", "x.csv"]),
        ("--out: the folder '/dev/null' cannot be made", ["BOX", "--out", "/dev/null/x.json"]),
        ("there will be 2", ["BOX", "-w", 0.05, "-w", 0.06, "--out", "x.npz"]),
        ("--view must end in .html or .png, got 'x.gif'", ["BOX", "--view", "x.gif"]),
        ("--topic is for bags", ["BOX", "--topic", "/points"]),
        ("--message is for bags", ["BOX", "--message", 0]),
        ("--message picks one cloud and --all takes every one", [BAGS / "one_object", "--message", 0, "--all"]),
        ("numbered from 0; got --message 99", [BAGS / "one_object", "--message", 99]),
        ("no clouds on '/nothing'; its topics of clouds are: /", [BAGS / "one_object", "--topic", "/nothing"]),
        ("No such option: --colour", ["BOX", "--colour", 1]),
        ("Missing argument", []),
    ],
)
def test_wrong_input_is_exit_code_2_with_one_line_on_stderr(message, arguments, clouds, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    code, out, err = run_detect(capsys, *[clouds / "box.npz" if a == "BOX" else a for a in arguments])
    assert (code, out) == (2, "")
    assert err.startswith("regnet: ") and message in err and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_the_program_itself_is_exit_code_1_with_its_traceback(clouds, capsys, monkeypatch):
    monkeypatch.setattr(GraspDetector, "detect", lambda *_, **__: 1 / 0)
    code, out, err = run_detect(capsys, clouds / "box.npz")
    assert (code, out) == (1, "")
    assert "Traceback" in err and err.splitlines()[-1] == "regnet: internal error: ZeroDivisionError: division by zero"


def test_a_cloud_in_a_camera_frame_without_transform_is_doubted(capsys, monkeypatch):
    clouds = [cloud._replace(T_root_cloud=None, root_frame=cloud.frame_id) for cloud in one_tilted_cloud()]
    monkeypatch.setattr("regnet_core.cli.inputs.read_bag_clouds", lambda *_: iter(clouds))
    code, _, err = run_detect(capsys, "-q", BAGS / "tilted_depth_only", "--crop", -0.1, -0.1, 0, 0.1, 0.1, 0.1)
    assert code == 3
    assert err.startswith("regnet: warning: ") and "give --sensor-pose" in err and err.count("\n") == 1


def one_tilted_cloud():
    return list(regnet_core.io.bags.read_bag_clouds(BAGS / "tilted_depth_only"))[:1]


# The command itself


def test_version_models_and_help(capsys):
    assert run(capsys, "--version") == (0, f"regnet {regnet_core.__version__}\n", "")
    assert run(capsys, "models") == (0, "\n".join(regnet_core.available_models()) + "\n", "")
    code, _, err = run(capsys, "models", "--card", "antipodal")
    assert code == 2 and "there is no 'antipodal.md'" in err
    code, out, _ = run(capsys)
    assert code == 0 and "detect" in out and "models" in out
    code, _, err = run(capsys, "detekt")
    assert code == 2 and "No such command 'detekt'" in err


def test_help_of_detect_explains_the_options_and_exit_codes():
    result = CliRunner().invoke(app, ["detect", "--help"], env={"COLUMNS": "200", "TERM": "dumb"})
    assert result.exit_code == 0
    text = " ".join(result.output.split())
    assert f"[default: {DEFAULT_MODEL}]" in text
    assert "Exit codes: 0 grasps were found" in text and "--sensor-pose" in text and "0.03 to 0.16 m" in text


def test_the_real_process_keeps_stdout_for_results_and_its_exit_code_for_scripts(clouds):
    def process(*arguments: object) -> subprocess.CompletedProcess:
        command = [sys.executable, "-c", "import sys; from regnet_core.cli import main; sys.exit(main())"]
        return subprocess.run(
            [*command, *map(str, arguments)], capture_output=True, text=True, timeout=120, cwd=BAGS.parent
        )

    done = process("detect", clouds / "box.npz", "--json", "--model", "antipodal")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["results"][0]["grasps"]
    assert process("detect", "-q", clouds / "table.npy", "--model", "antipodal").returncode == 3
    failed = process("detect", "missing.ply")
    assert (failed.returncode, failed.stdout) == (2, "")
    assert failed.stderr == "regnet: there is no file 'missing.ply'\n"
