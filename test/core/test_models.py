"""Models by name and by path: what is listed, loaded once, refused, and where it runs. Networks here are untrained."""

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import shapes
import torch

from regnet_core import DetectorConfig, GraspDetector, Gripper, ModelError, available_models, weights
from regnet_core.collision import CollisionConfig
from regnet_core.io.bags import read_bag_clouds
from regnet_core.models import DEFAULT_MODEL, load_model
from regnet_core.nn import files
from regnet_core.nn.devices import resolve_device

BOX = shapes.single_view(shapes.box(0.05, 0.12, 0.10))
BAGS = Path(__file__).parents[2] / "bags"
BASELINES = ("antipodal", "random")
PUBLISHED = Path(weights.__file__).parent


@pytest.fixture
def folder(untrained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the network `mine`, the only one there is."""
    shutil.copy(untrained, tmp_path / "mine.safetensors")
    monkeypatch.setattr(weights, "_PUBLISHED", tmp_path / "nothing published")
    monkeypatch.setenv(weights.OWN_FOLDER, str(tmp_path))
    return tmp_path


def run(program: str) -> str:
    """The output of a Python process."""
    return subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.strip()


# What there is


def test_networks_are_listed_where_they_have_weights(folder: Path) -> None:
    assert available_models() == ("mine", *BASELINES)
    (folder / "mine.safetensors").unlink()
    assert available_models() == BASELINES


def test_own_networks_stand_beside_the_published_ones_and_before_them(
    folder: Path, untrained: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    published = tmp_path_factory.mktemp("published")
    for name in ("mine", "theirs"):
        shutil.copy(untrained, published / f"{name}.safetensors")
    monkeypatch.setattr(weights, "_PUBLISHED", published)
    assert available_models() == ("mine", "theirs", *BASELINES)
    assert weights.weights_file("mine").path.parent == folder
    assert weights.weights_file("theirs").path.parent == published


def test_published_networks_have_a_card_and_a_checksum_that_holds() -> None:
    published = sorted(path.stem for path in PUBLISHED.glob("*.safetensors"))
    assert DEFAULT_MODEL in published
    for name in published:
        path, digest = weights.weights_file(name)
        assert digest == hashlib.sha256(path.read_bytes()).hexdigest(), f"{weights.CHECKSUMS} is not up to date"
        assert len(weights.model_card(name)) > 500
        assert path.stat().st_size < 30_000_000


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("magic", "no model 'magic'; there are mine, antipodal, random, and any network by the path of its .safetens"),
        ("some/folder", "no model 'some/folder'"),
        ("", "no model ''"),
        ("gone/away.safetensors", r"there are no weights at '/.*/gone/away\.safetensors'"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_unknown_models_are_refused_with_those_there_are(model: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        GraspDetector(model)


def test_a_missing_card_is_named(folder: Path) -> None:
    with pytest.raises(ModelError, match=r"there is no 'mine\.md' in '.*the networks with weights are: mine"):
        weights.model_card("mine")
    (folder / "mine.md").write_text("# mine\n")
    assert weights.model_card("mine") == "# mine\n"


# Networks in use


def test_a_network_detects_by_name_and_by_path_and_says_so(folder: Path) -> None:
    path = folder / "mine.safetensors"
    by_name, by_path = (GraspDetector(model, "cpu").detect(BOX) for model in ("mine", path))
    assert (by_name.report.model, by_name.report.device) == ("mine", "cpu")
    assert (by_path.report.model, by_path.report.device) == (str(path), "cpu")
    assert by_name.report["proposals"].kept > 100
    assert len(by_name.grasps) > 0
    np.testing.assert_array_equal(by_name.grasps.translation, by_path.grasps.translation)


def test_the_same_seed_gives_the_same_grasps_and_another_seed_others(untrained: Path) -> None:
    cloud = list(read_bag_clouds(BAGS / "clutter_10"))[3].points  # more than the network takes
    # Made-up weights hit something nearly always: points do not count, and so small a hand misses the table.
    config = DetectorConfig(collision=CollisionConfig(max_points=10**6))
    hand = Gripper(width=0.05, depth=0.02, height=0.005, thickness=0.003, palm_depth=0.01)
    detectors = (GraspDetector(untrained, "cpu", seed, config) for seed in (3, 3, 4))
    first, second, other = (detector.detect(cloud, hand).grasps for detector in detectors)
    assert len(first) > 0
    for name in ("translation", "rotation", "quality"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert not np.array_equal(first.translation, other.translation)


def test_a_network_is_loaded_once_until_its_file_changes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded, load = [], files.load_network
    monkeypatch.setattr(files, "load_network", lambda *arguments: loaded.append(arguments[0]) or load(*arguments))
    path = folder / "mine.safetensors"
    detectors = [GraspDetector("mine", "cpu", seed) for seed in range(3)]
    assert loaded == [path]
    proposers = {id(load_model(model, "cpu").proposer) for model in ("mine", "mine")}
    assert loaded == [path] and len(proposers) == 1
    content = path.read_bytes()
    path.unlink()
    assert len(detectors[0].detect(BOX).report.steps) > 5  # what is loaded goes on working
    path.write_bytes(content)
    assert load_model("mine", "cpu").proposer is not None
    assert loaded == [path, path]


# Weights that cannot be used


def test_a_file_that_is_not_the_one_listed_is_refused(folder: Path) -> None:
    path = folder / "mine.safetensors"
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / weights.CHECKSUMS).write_text(f"{'0' * 64}  other.safetensors\n{digest} *mine.safetensors\n")
    assert weights.weights_file("mine").sha256 == digest
    assert load_model("mine", "cpu").device == "cpu"
    (folder / weights.CHECKSUMS).write_text(f"{'0' * 64}  mine.safetensors\n")
    with pytest.raises(ModelError, match="is not the file that was published"):
        GraspDetector("mine", "cpu")


def _rewrite(path: Path, change: str) -> None:
    with safetensors.safe_open(str(path), framework="pt") as file:
        facts, tensors = dict(file.metadata()), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    name = next(key for key, value in tensors.items() if value.ndim == 2)
    if change == "format":
        facts["format"] = "other/7"
    elif change == "network":
        facts["network"] = "regnetv9"
    elif change == "missing":
        del tensors[name]
    elif change == "shape":
        tensors[name] = tensors[name][:-1].contiguous()
    else:
        tensors[name][0, 0] = torch.nan
    path.write_bytes(safetensors.torch.save(tensors, facts))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("format", "holds no weights of a network: its format is 'other/7', not 'regnet-weights/1'"),
        ("network", "no network 'regnetv9'; there are regnetv2"),
        ("missing", "is of another version of the network 'regnetv2-s' than this one: Missing key"),
        ("shape", "is of another version of the network 'regnetv2-s' than this one: size mismatch"),
        ("nan", "holds numbers that are not finite"),
    ],
)
def test_weights_that_do_not_fit_are_refused_in_a_line(folder: Path, change: str, message: str) -> None:
    _rewrite(folder / "mine.safetensors", change)
    with pytest.raises(ModelError, match=message) as error:
        GraspDetector("mine", "cpu")
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_a_pickle_is_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    torch.save({"weights": torch.zeros(3)}, path)
    with pytest.raises(ModelError, match="holds no weights of a network"):
        GraspDetector(path)


# Devices


@pytest.mark.parametrize(
    ("wanted", "gpus", "found"),
    [
        ("auto", 0, "cpu"), ("cpu", 0, "cpu"), ("auto", 2, "cuda:1"), ("cpu", 2, "cpu"), ("cuda", 2, "cuda:1"),
        ("cuda:0", 2, "cuda:0"), ("cuda:1", 2, "cuda:1"),
    ],
)  # fmt: skip
def test_devices_are_named_in_full(wanted: str, gpus: int, found: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_gpus(gpus, monkeypatch)
    assert resolve_device(wanted) == found


@pytest.mark.parametrize(
    ("wanted", "gpus", "message"),
    [
        ("cuda", 0, r"does not run on 'cuda' here \(torch .*\); there are auto, cpu$"),
        ("cuda:0", 0, r"does not run on 'cuda:0' here \(torch .*\); there are auto, cpu$"),
        ("cuda:2", 2, r"does not run on 'cuda:2' here; there are auto, cpu, cuda:0, cuda:1$"),
        ("toaster", 0, r"does not run on 'toaster' here; there are auto, cpu$"),
        ("cuda:-1", 2, "there are auto, cpu, cuda:0, cuda:1"),
        ("", 0, "does not run on '' here"),
    ],
)
def test_devices_that_are_not_there_are_refused_with_those_that_are(
    wanted: str, gpus: int, message: str, monkeypatch: pytest.MonkeyPatch, untrained: Path
) -> None:
    pretend_gpus(gpus, monkeypatch)
    with pytest.raises(ModelError, match=message):
        GraspDetector(untrained, wanted)


def pretend_gpus(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if there were so many, the last of them the current one."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: count - 1)


def test_the_random_baseline_ranks_at_random() -> None:
    result = GraspDetector("random").detect(BOX)
    assert (result.report.model, result.report.device) == ("random", "cpu")
    assert len(result.grasps) > 0
    assert (np.diff(result.grasps.quality) <= 0).all() and result.grasps.quality.std() > 0.1


@pytest.mark.parametrize("model", BASELINES)
def test_baselines_run_on_the_cpu_only(model: str) -> None:
    assert GraspDetector(model).device == GraspDetector(model, "cpu").device == "cpu"
    with pytest.raises(ModelError, match=rf"model '{model}' runs on the device 'cpu' \(or 'auto'\), not on 'cuda'"):
        GraspDetector(model, "cuda")


# torch


def test_torch_is_loaded_when_a_network_is_asked_for(untrained: Path) -> None:
    program = (
        "import sys, regnet_core, regnet_core.cli, regnet_core.models; regnet_core.available_models();"
        "regnet_core.GraspDetector('antipodal'); before = 'torch' in sys.modules;"
        f"regnet_core.GraspDetector('{untrained}'); print(before, 'torch' in sys.modules)"
    )
    assert run(program) == "False True"


@pytest.mark.parametrize("package", ["torch", "safetensors"])
def test_a_missing_package_is_named(package: str, untrained: Path) -> None:
    program = (
        f"import sys; sys.modules['{package}'] = None; import regnet_core\n"
        "assert len(regnet_core.GraspDetector('antipodal').detect([[0, 0, 0]]).grasps) == 0\n"
        f"try: regnet_core.GraspDetector('{untrained}')\n"
        "except regnet_core.ModelError as error: print(error)"
    )
    assert run(program) == f"networks need the package {package}: pip install torch safetensors"


def test_networks_need_nothing_that_detection_does_not_install(untrained: Path) -> None:
    extras = (
        "coacd",
        "fcl",
        "manifold3d",
        "mujoco",
        "networkx",
        "open3d",
        "ray",
        "rosbags",
        "tensorboard",
        "zstandard",
    )
    program = (
        f"import sys; sys.modules.update(dict.fromkeys({extras})); import numpy, regnet_core\n"
        f"rng = numpy.random.default_rng(0); detector = regnet_core.GraspDetector('{untrained}', 'cpu')\n"
        "table = numpy.column_stack([rng.uniform(-0.2, 0.2, (5000, 2)), numpy.zeros(5000)])\n"
        "top = rng.uniform([-0.02, -0.05, 0.1], [0.02, 0.05, 0.1], (1500, 3))\n"
        "print(detector.detect(numpy.concatenate([table, top])).report['proposals'].kept > 0)"
    )
    assert run(program) == "True"


def test_openmp_is_asked_not_to_spin_before_torch_is_loaded(untrained: Path) -> None:
    program = (
        "import os; os.environ.pop('OMP_WAIT_POLICY', None); import regnet_core\n"
        "os.environ['OMP_DISPLAY_ENV'] = 'TRUE'\n"
        f"regnet_core.GraspDetector('{untrained}', 'cpu')"
    )
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert "OMP_WAIT_POLICY = 'PASSIVE'" in done.stderr
