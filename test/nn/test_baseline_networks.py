"""The learned baselines' networks, how they detect, and their files. The weights are those of fresh networks."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import nn

from regnet_core import GraspDetector, ModelError, available_models, weights
from regnet_core.baselines import LEARNED
from regnet_core.baselines.classification import ClassificationConfig, ClassifierProposer, GraspClassifier
from regnet_core.baselines.closing_area import ClosingAreas
from regnet_core.baselines.files import load_weights, save_weights, stored_name
from regnet_core.baselines.gpd import GpdNetwork
from regnet_core.baselines.gpg import GpgConfig, GpgSampler
from regnet_core.baselines.pointnetgpd import PointNetGpd
from regnet_core.baselines.zoo import METHODS, load_proposer, method
from regnet_core.errors import InvalidInputError
from regnet_core.gripper import Gripper
from regnet_core.report import StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene


def areas(counts: list[int], seed: int = 0) -> ClosingAreas:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(sum(counts), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = rng.random((sum(counts), 3)).astype(np.float32)
    return ClosingAreas(points, normals.astype(np.float32), np.cumsum([0, *counts]))


def parameters(network: nn.Module) -> int:
    return sum(value.numel() for value in network.parameters())


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.3, 0.3, (9000, 2)), np.full(9000, 0.75)])
    top = rng.uniform([-0.02, -0.05, 0.85], [0.02, 0.05, 0.85], (2500, 3))
    side = rng.uniform([0.02, -0.05, 0.75], [0.02, 0.05, 0.85], (2500, 3))
    return np.concatenate([table, top, side])


@pytest.fixture(scope="module")
def scene(cloud: np.ndarray) -> Scene:
    return prepare_scene(cloud, None, SceneConfig(), np.random.default_rng(0), StepRecorder())


# Networks


@pytest.mark.parametrize("channels", [3, 12])
def test_the_network_of_gpd_is_lenet(channels: int) -> None:
    network = GpdNetwork(channels)
    first, second = 20 * (25 * channels + 1), 50 * (25 * 20 + 1)
    assert parameters(network) == first + second + 500 * (50 * 12 * 12 + 1) + 2 * 501
    assert network.classify(torch.zeros(5, channels, 60, 60)).shape == (5, 2)
    assert network(areas([30, 1, 0])).shape == (3, 2)
    assert network.good_score == pytest.approx(np.cos(np.radians(20)) ** 2)


def test_gpd_tells_hands_by_their_images_alone() -> None:
    network = GpdNetwork(12).eval()
    some = areas([40, 40])
    with torch.no_grad():
        both = network(some)
        first = network(some.take(np.array([0])))
    torch.testing.assert_close(both[:1], first)
    assert not torch.equal(both[0], both[1])


def test_pointnet_has_its_layers() -> None:
    """Linear layers without bias, each with two numbers of batch normalisation for an output, and two last layers."""
    shared = sum(a * b + 2 * b for a, b in ((3, 64), (64, 128), (128, 1024)))
    after = sum(a * b + 2 * b for a, b in ((1024, 512), (512, 256)))
    network = PointNetGpd()
    assert parameters(network) == 2 * (shared + after) + 256 * 9 + 9 + 256 * 2 + 2
    assert network.good_score == pytest.approx(np.cos(np.arctan(0.6)) ** 2)


def fresh_pointnet() -> PointNetGpd:
    """With batch statistics and a transformer that are not those of the start."""
    torch.manual_seed(0)
    network = PointNetGpd()
    nn.init.normal_(network.transformer.output.weight, std=0.05)
    network.train()
    for seed in range(3):
        network(areas([60, 80, 100, 120], seed))
    return network.eval()


@torch.no_grad()
def test_pointnet_does_not_depend_on_the_order_of_the_points_nor_on_repeats() -> None:
    network, some = fresh_pointnet(), areas([90, 50])
    expected = network(some)
    rng = np.random.default_rng(1)
    order = np.concatenate([rng.permutation(90), 90 + rng.permutation(50)])
    mixed = ClosingAreas(some.points[order], some.normals[order], some.offsets)
    torch.testing.assert_close(network(mixed), expected, atol=1e-5, rtol=1e-5)
    rows = np.concatenate([np.arange(90), rng.integers(0, 90, 660), 90 + np.arange(50)])
    repeated = ClosingAreas(some.points[rows], some.normals[rows], np.array([0, 750, 800]))
    torch.testing.assert_close(network(repeated), expected, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(expected[0], expected[1])


@torch.no_grad()
def test_pointnet_turns_the_points_by_what_it_sees() -> None:
    network, some = fresh_pointnet(), areas([80])
    points, offsets = torch.from_numpy(some.points) * 2 - 1, torch.from_numpy(some.offsets)
    turn = network.transformer(points, offsets)[0]
    assert (turn - torch.eye(3)).abs().max() > 0.01
    plain = network.classify(points, offsets)
    # The same, computed for this one set step by step.
    pooled = network.shared(points @ turn).amax(dim=0, keepdim=True)
    torch.testing.assert_close(network.output(network.after(pooled)), plain, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(PointNetGpd().eval().transformer(points, offsets)[0], torch.eye(3))


# Detection


class Told(GraspClassifier):
    """Says what it is told to, and notes what it is asked."""

    name = "told"
    good_score = 0.5

    def __init__(self, probability: np.ndarray, least: int = 1) -> None:
        super().__init__()
        self.least_points = least
        self.probability, self.asked = probability, ClosingAreas.joined([])

    def forward(self, areas: ClosingAreas) -> torch.Tensor:
        self.asked = areas
        return torch.from_numpy(np.log(np.column_stack([1 - self.probability, self.probability]))[: len(areas)])


def everywhere(scene: Scene) -> np.ndarray:
    return np.ones(len(scene.objects.points), bool)


def test_hands_above_the_threshold_are_grasps(scene: Scene) -> None:
    probability = np.linspace(0.05, 0.95, 100)
    network = Told(probability)
    found = ClassifierProposer(network).propose(scene, Gripper(), everywhere(scene), np.random.default_rng(0))
    hands = GpgSampler().sample(scene, Gripper(), everywhere(scene), np.random.default_rng(0))
    good = probability > 0.6
    assert found.considered == hands.tried and len(hands.rotation) == 100
    np.testing.assert_allclose(found.grasps.translation, hands.translation[good])
    np.testing.assert_allclose(found.grasps.quality, probability[good])
    assert (found.grasps.width == Gripper().width).all()
    assert len(network.asked) == 100 and network.asked.counts.min() >= 1


def test_hands_with_too_few_points_are_not_told(scene: Scene) -> None:
    counts = Told(np.full(100, 0.9))
    ClassifierProposer(counts).propose(scene, Gripper(), everywhere(scene), np.random.default_rng(0))
    least = int(np.median(counts.asked.counts))
    network = Told(np.full(100, 0.9), least)
    found = ClassifierProposer(network).propose(scene, Gripper(), everywhere(scene), np.random.default_rng(0))
    assert network.asked.counts.min() >= least
    assert len(found.grasps) == (counts.asked.counts >= least).sum() < 100


@pytest.mark.parametrize("network", [GpdNetwork(3), PointNetGpd()])
def test_a_scene_without_candidates_has_no_grasps(network: GraspClassifier, scene: Scene) -> None:
    nowhere = np.zeros(len(scene.objects.points), bool)
    found = ClassifierProposer(network).propose(scene, Gripper(), nowhere, np.random.default_rng(0))
    assert len(found.grasps) == 0 and found.considered == 0


def test_impossible_thresholds_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="threshold"):
        ClassificationConfig(threshold=1.5)
    assert ClassificationConfig().sampler == GpgConfig(points=1000, grasps=100)


# Files and names


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of all learned baselines."""
    path = tmp_path_factory.mktemp("baselines")
    for name in LEARNED:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            save_weights(path / f"{name}.safetensors", name, method(name).network(), {"data": "none"})
    return path


@pytest.mark.parametrize("name", LEARNED)
def test_networks_come_back_from_their_files_in_half_precision(name: str, folder: Path, tmp_path: Path) -> None:
    torch.manual_seed(1)
    network, other = method(name).network(), method(name).network()
    digest = save_weights(tmp_path / "net.safetensors", name, network, {"recipe": [1, 2]})
    assert digest == hashlib.sha256((tmp_path / "net.safetensors").read_bytes()).hexdigest()
    assert stored_name(tmp_path / "net.safetensors") == name
    assert load_weights(tmp_path / "net.safetensors", name, other, digest) == {"recipe": [1, 2]}
    assert not other.training
    for key, value in network.state_dict().items():
        torch.testing.assert_close(other.state_dict()[key], value.half().to(value.dtype), msg=key)


def test_the_methods_are_those_that_have_names() -> None:
    assert tuple(METHODS) == LEARNED
    for name in LEARNED:
        assert method(name).proposer(method(name).network(), "cpu").name == name
    with pytest.raises(ModelError, match="no learned baseline 'gpd-15'; there are gpd-3, gpd-12, pointnetgpd, s4g"):
        method("gpd-15")


def test_files_that_do_not_fit_are_refused(folder: Path, tmp_path: Path) -> None:
    path = folder / "gpd-3.safetensors"
    with pytest.raises(ModelError, match="there are no weights at"):
        load_proposer("gpd-3", tmp_path / "gone.safetensors", "cpu")
    with pytest.raises(ModelError, match="is not the file that was published"):
        load_proposer("gpd-3", path, "cpu", "0" * 64)
    with pytest.raises(ModelError, match="holds no weights of 'gpd-12' but of 'gpd-3'"):
        load_proposer("gpd-12", path, "cpu")
    tensors = safetensors.torch.load_file(path)
    facts = {"format": "regnet-weights/1", "network": "gpd-12", "card": "{}"}
    safetensors.torch.save_file(tensors, tmp_path / "wrong.safetensors", facts)
    with pytest.raises(ModelError, match="is of another version of 'gpd-12' than this one: size mismatch"):
        load_proposer("gpd-12", tmp_path / "wrong.safetensors", "cpu")
    tensors["output.bias"][0] = torch.nan
    safetensors.torch.save_file(tensors, tmp_path / "nan.safetensors", facts | {"network": "gpd-3"})
    with pytest.raises(ModelError, match=r"output\.bias holds numbers that are not finite"):
        load_proposer("gpd-3", tmp_path / "nan.safetensors", "cpu")
    (tmp_path / "pickle.safetensors").write_bytes(b"\x80\x04K\x01.")
    assert stored_name(tmp_path / "pickle.safetensors") is None
    with pytest.raises(ModelError, match="holds no weights of 'gpd-3'"):
        load_proposer("gpd-3", tmp_path / "pickle.safetensors", "cpu")


def test_they_are_listed_after_the_networks_where_they_have_weights(
    folder: Path, tmp_path: Path, untrained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weights, "_PUBLISHED", tmp_path)
    monkeypatch.delenv(weights.OWN_FOLDER, raising=False)
    for name in ("s4g", "gpd-12"):
        (tmp_path / f"{name}.safetensors").write_bytes((folder / f"{name}.safetensors").read_bytes())
    (tmp_path / "zebra.safetensors").write_bytes(untrained.read_bytes())
    assert available_models() == ("zebra", "gpd-12", "s4g", "antipodal", "random")


@pytest.mark.parametrize("name", LEARNED)
def test_they_detect_by_name_and_by_path(
    name: str, folder: Path, cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(weights.OWN_FOLDER, str(folder))
    by_name, by_path = (GraspDetector(model, "cpu").detect(cloud) for model in (name, folder / f"{name}.safetensors"))
    assert (by_name.report.model, by_name.report.device) == (name, "cpu")
    steps = {step.name for step in by_name.report.steps}
    assert {"proposals", "collision with cloud", "ranking"} <= steps
    np.testing.assert_array_equal(by_name.grasps.translation, by_path.grasps.translation)
    again = GraspDetector(name, "cpu").detect(cloud).grasps
    np.testing.assert_array_equal(by_name.grasps.quality, again.quality)
