"""S4G: its coding inverts, does not care which form a jaw is in, and gives the best grasps around."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from regnet_core.baselines.s4g import S4gConfig, S4gNetwork, S4gOutput
from regnet_core.baselines.s4g_coding import (
    best_around,
    decode,
    decode_rotation,
    encode_offset,
    encode_rotation,
    expected_score,
    score_class,
    symmetric_error,
)
from regnet_core.baselines.s4g_proposer import S4gProposer, S4gSelection
from regnet_core.errors import InvalidInputError
from regnet_core.gripper import Gripper
from regnet_core.nn.anchors import Pose
from regnet_core.nn.clouds import Clouds
from regnet_core.report import StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene

FLIP = torch.tensor([1.0, -1.0, -1.0])


def rotations(count: int = 50, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix()).float()


# Coding


def test_rotations_come_back_from_their_codes() -> None:
    wanted = rotations()
    torch.testing.assert_close(decode_rotation(encode_rotation(wanted)), wanted, atol=1e-6, rtol=0)
    # A code is of any length, and its second vector need not be perpendicular to the first.
    code = torch.cat([3.0 * wanted[..., 0], 0.5 * wanted[..., 1] - 2.0 * wanted[..., 0]], dim=1)
    torch.testing.assert_close(decode_rotation(code), wanted, atol=1e-5, rtol=0)


def test_any_code_is_a_rotation() -> None:
    generator = torch.Generator().manual_seed(0)
    code = torch.randn(100, 6, generator=generator)
    code[0] = 0.0
    code[1, 3:] = 2.0 * code[1, :3]
    code[2, :3] = 0.0
    code.requires_grad_()
    found = decode_rotation(code)
    torch.testing.assert_close(found.transpose(1, 2) @ found, torch.eye(3).expand(100, 3, 3), atol=1e-5, rtol=0)
    assert (torch.linalg.det(found) > 0.999).all()
    found.sum().backward()
    assert code.grad is not None and code.grad.isfinite().all()


def test_grasps_come_back_from_points_and_offsets() -> None:
    wanted = Pose(rotations(), torch.randn(50, 3, generator=torch.Generator().manual_seed(1)))
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(2))
    offset = encode_offset(points, wanted.translation, 0.03)
    found = decode(points, encode_rotation(wanted.rotation), offset, 0.03)
    torch.testing.assert_close(found.translation, wanted.translation, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.rotation, wanted.rotation, atol=1e-5, rtol=0)


def test_scores_have_classes_of_equal_width() -> None:
    scores = torch.tensor([0.0, 0.2, 1 / 3 - 1e-4, 0.4, 0.6666, 0.67, 1.0])
    assert score_class(scores, 3).tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert score_class(scores, 2).tolist() == [0, 0, 0, 0, 1, 1, 1]


def test_the_expected_score_is_the_mean_of_the_classes() -> None:
    share = torch.tensor([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(expected_score(share.log()), torch.tensor([0.65, 0.0, 1.0]))


# Symmetry


def test_the_error_is_the_same_for_both_forms_of_a_jaw() -> None:
    predicted, wanted = rotations(seed=1), rotations(seed=2)
    error = symmetric_error(predicted, wanted)
    torch.testing.assert_close(symmetric_error(predicted, wanted * FLIP), error)
    torch.testing.assert_close(symmetric_error(predicted * FLIP, wanted), error)
    torch.testing.assert_close(symmetric_error(wanted * FLIP, wanted), torch.zeros(50), atol=1e-6, rtol=0)
    assert (error <= (predicted - wanted).square().mean(dim=(1, 2)) + 1e-6).all()


def test_the_error_of_a_turn_is_known() -> None:
    """A turn by a about any axis changes the nine numbers by 4 (1 - cos a) together; 180 degrees about X by none."""
    for angle in (0.1, 1.0):
        turn = torch.from_numpy(Rotation.from_rotvec([0, 0, angle]).as_matrix()).float()
        assert float(symmetric_error(turn, torch.eye(3))) == pytest.approx(4 * (1 - math.cos(angle)) / 9, abs=1e-6)


# Non-maximum suppression


def test_only_the_best_of_grasps_that_are_alike_stays() -> None:
    base = torch.eye(3)
    turned = torch.from_numpy(Rotation.from_euler("z", 60, degrees=True).as_matrix()).float()
    rotation = torch.stack([base, base, base * FLIP, turned, base])
    translation = torch.tensor([[0.0, 0, 0], [0.004, 0, 0], [0.005, 0, 0], [0.0, 0, 0], [0.05, 0, 0]])
    score = torch.tensor([0.5, 0.9, 0.7, 0.6, 0.1])
    kept = best_around(Pose(rotation, translation), score, 0.01, math.radians(30))
    # 0 and 2, which is the other form of a jaw, are next to 1 and alike; 3 is turned; 4 is far away.
    assert kept.tolist() == [1, 3, 4]
    assert best_around(Pose(rotation, translation), score, 0.0, 0.5).tolist() == [1, 2, 3, 0, 4]
    nothing = best_around(Pose(rotation[:0], translation[:0]), score[:0], 0.01, 0.5)
    assert nothing.tolist() == []


def test_a_suppressed_grasp_suppresses_none() -> None:
    rotation = torch.eye(3).repeat(3, 1, 1)
    translation = torch.tensor([[0.0, 0, 0], [0.008, 0, 0], [0.016, 0, 0]])
    kept = best_around(Pose(rotation, translation), torch.tensor([0.9, 0.8, 0.7]), 0.01, 0.5)
    assert kept.tolist() == [0, 2]


# The network, and how it detects


@pytest.fixture(scope="module")
def network() -> S4gNetwork:
    torch.manual_seed(0)
    return S4gNetwork().eval()


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.3, 0.3, (9000, 2)), np.full(9000, 0.75)])
    top = rng.uniform([-0.02, -0.05, 0.85], [0.02, 0.05, 0.85], (2500, 3))
    side = rng.uniform([0.02, -0.05, 0.75], [0.02, 0.05, 0.85], (2500, 3))
    cloud = np.concatenate([table, top, side])
    return prepare_scene(cloud, None, SceneConfig(), np.random.default_rng(0), StepRecorder())


def test_the_network_predicts_at_every_point_and_knows_no_width(network: S4gNetwork) -> None:
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.3, 0.3, 0.02])
    with torch.no_grad():
        narrow, wide = (network(Clouds.of([points], [width])) for width in (0.05, 0.12))
        moved = network(Clouds.of([points + 0.5], [0.05]))
    assert [tuple(value.shape) for value in narrow] == [(3000, 3), (3000, 6), (3000, 3)]
    for first, second, third in zip(narrow, wide, moved, strict=True):
        torch.testing.assert_close(first, second)
        torch.testing.assert_close(first, third, atol=2e-3, rtol=0)
    # Before it is trained, hands come from above.
    assert (decode_rotation(narrow.rotation)[:, 2, 0] < -0.9).all()


def test_the_best_grasps_around_are_given_in_order(network: S4gNetwork, scene: Scene) -> None:
    focus = np.ones(len(scene.objects.points), bool)
    proposer = S4gProposer(network, selection=S4gSelection(least_score=0.0))
    found, again = (proposer.propose(scene, Gripper(), focus, np.random.default_rng(3)) for _ in range(2))
    assert 0 < len(found.grasps) < found.considered
    assert (np.diff(found.grasps.quality) <= 0).all() and (found.grasps.width == 0.08).all()
    np.testing.assert_array_equal(found.grasps.translation, again.grasps.translation)
    distance = np.linalg.norm(found.grasps.translation[:, None] - found.grasps.translation[None], axis=2)
    alike = np.einsum("ai,bi->ab", found.grasps.approach, found.grasps.approach) > math.cos(math.radians(29.9))
    alike &= np.abs(np.einsum("ai,bi->ab", found.grasps.closing, found.grasps.closing)) > math.cos(math.radians(29.9))
    assert not (alike & (distance < 0.0099) & ~np.eye(len(distance), dtype=bool)).any()


def test_only_focused_points_have_grasps(network: S4gNetwork, scene: Scene) -> None:
    proposer = S4gProposer(network, selection=S4gSelection(least_score=0.0))
    rng = np.random.default_rng(0)
    assert proposer.propose(scene, Gripper(), np.zeros(len(scene.objects.points), bool), rng).considered == 0
    top = scene.objects.points[:, 2] > 0.845
    found = proposer.propose(scene, Gripper(), top, np.random.default_rng(0))
    everything = proposer.propose(scene, Gripper(), np.ones_like(top), np.random.default_rng(0))
    assert 0 < found.considered < everything.considered


def test_points_without_a_score_have_no_grasp(network: S4gNetwork) -> None:
    points, count = torch.zeros(4, 3), 4
    points[:, 0] = torch.arange(count) * 0.1
    logits = torch.tensor([[9.0, 0, 0], [0, 0, 9.0], [0, 9.0, 0], [9.0, 0, 0]])
    code = torch.tensor([0.0, 0, -1, 1, 0, 0]).repeat(count, 1)
    pose, score = S4gProposer(network)._best(points, S4gOutput(logits, code, torch.zeros(count, 3)))
    np.testing.assert_allclose(pose.translation[:, 0], [0.1, 0.2], atol=1e-7)
    assert score[0] > 0.99 and 0.49 < score[1] < 0.51


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: S4gConfig(classes=1),
        lambda: S4gConfig(unit=0.0),
        lambda: S4gSelection(most=0),
        lambda: S4gSelection(angle=3.0),
    ],
)
def test_impossible_numbers_are_refused(wrong) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InvalidInputError):
        wrong()
