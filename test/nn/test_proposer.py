"""The network behind the interface of all methods, and its files. The weights are those of a fresh network."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from regnet_core.errors import ModelError
from regnet_core.gripper import Gripper
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.files import load_network, save_network
from regnet_core.nn.network import RegNet
from regnet_core.nn.proposer import NetworkProposer
from regnet_core.nn.results import Output
from regnet_core.nn.zoo import network_config
from regnet_core.report import StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene


@pytest.fixture(scope="module")
def network() -> RegNet:
    torch.manual_seed(0)
    return RegNet(network_config("regnetv2-s")).eval()


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.4, 0.4, (12000, 2)), np.full(12000, 0.75)])
    boxes = []
    for x in (-0.1, 0.1):
        top = rng.uniform([x - 0.02, -0.05, 0.85], [x + 0.02, 0.05, 0.85], (2500, 3))
        side = rng.uniform([x + 0.02, -0.05, 0.75], [x + 0.02, 0.05, 0.85], (2500, 3))
        boxes += [top, side]
    cloud = np.concatenate([table, *boxes])
    return prepare_scene(cloud, None, SceneConfig(), np.random.default_rng(0), StepRecorder())


def _propose(network: RegNet, scene: Scene, focus: np.ndarray | None = None, seed: int = 0):  # type: ignore[no-untyped-def]
    mask = np.ones(len(scene.objects.points), bool) if focus is None else focus
    return NetworkProposer(network).propose(scene, Gripper(width=0.07), mask, np.random.default_rng(seed))


def test_grasps_come_from_the_objects_ranked_and_right_handed(network: RegNet, scene: Scene) -> None:
    grasps, considered = _propose(network, scene)
    assert 0 < len(grasps) <= considered <= network.config.positives
    assert np.all(np.diff(grasps.quality) <= 1e-9) and np.all((grasps.quality >= 0) & (grasps.quality <= 1))
    np.testing.assert_allclose(np.linalg.det(grasps.rotation), 1.0, atol=1e-5)
    np.testing.assert_allclose(grasps.width, 0.07)
    assert np.all(np.abs(grasps.translation - [0.0, 0.0, 0.8]) < 0.5)


def test_the_same_seed_gives_the_same_grasps(network: RegNet, scene: Scene) -> None:
    first, again = (_propose(network, scene).grasps for _ in range(2))
    np.testing.assert_array_equal(first.translation, again.translation)
    np.testing.assert_array_equal(first.quality, again.quality)


def test_the_network_sees_points_in_random_order(
    network: RegNet, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras give them row after row; a ball query that keeps the first ones would see one side of each ball."""
    seen: list[torch.Tensor] = []

    def spy(clouds: Clouds, *args: object, **kwargs: object) -> Output:
        seen.append(clouds.points)
        return RegNet.forward(network, clouds, *args, **kwargs)  # type: ignore[arg-type]

    proposer = NetworkProposer(network)
    monkeypatch.setattr(network, "forward", spy)
    order = np.lexsort(scene.points.T)
    in_rows = dataclasses.replace(scene, points=scene.points[order], rows=scene.source[order])
    proposer.propose(in_rows, Gripper(), np.ones(len(scene.objects.points), bool), np.random.default_rng(0))
    height = seen[0][:, 2]
    rank_of_neighbours = np.corrcoef(np.arange(len(height)), height.numpy())[0, 1]
    assert len(height) > 5000 and abs(rank_of_neighbours) < 0.05


def test_points_of_too_little_confidence_are_never_positive(scene: Scene) -> None:
    torch.manual_seed(0)
    network = RegNet(network_config("regnetv2-s").replace(least_confidence=0.9)).eval()
    nothing = _propose(network, scene)
    assert len(nothing.grasps) == nothing.considered == 0


@pytest.mark.parametrize("width", [0.03, 0.06, 0.1, 0.12, 0.16])
def test_the_jaw_is_never_opened_wider_than_the_gripper_can(network: RegNet, scene: Scene, width: float) -> None:
    gripper, focus = Gripper(width=width), np.ones(len(scene.objects.points), bool)
    grasps = NetworkProposer(network).propose(scene, gripper, focus, np.random.default_rng(0)).grasps
    np.testing.assert_array_equal(grasps.width, width)
    gripper.bodies(float(grasps.width[0]))


def test_only_what_is_in_focus_becomes_positive(network: RegNet, scene: Scene) -> None:
    right = scene.objects.points[:, 0] > 0.0
    every, some = _propose(network, scene), _propose(network, scene, right)
    assert 0 < len(some.grasps) < len(every.grasps) or some.considered == every.considered
    nothing = _propose(network, scene, np.zeros_like(right))
    assert len(nothing.grasps) == nothing.considered == 0


def test_a_network_comes_back_from_its_file(network: RegNet, scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    digest = save_network(path, network, {"data": "seed 7"})
    loaded, card = load_network(path, digest)
    assert card == {"data": "seed 7"} and loaded.config == network.config and not loaded.training
    before, after = (_propose(one, scene).grasps for one in (network, loaded))
    # Half precision: nearly the same grasps, in nearly the same order.
    assert np.abs(before.quality.mean() - after.quality.mean()) < 0.01


def test_files_that_are_not_weights_are_refused(network: RegNet, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    with pytest.raises(ModelError, match="there are no weights at"):
        load_network(path)
    save_network(path, network, {})
    with pytest.raises(ModelError, match="is not the file that was published"):
        load_network(path, "0" * 64)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ModelError, match="holds no weights of a network"):
        load_network(path)
    path.write_bytes(b"\x80\x04K\x01.")
    with pytest.raises(ModelError, match="holds no weights of a network"):
        load_network(path)
