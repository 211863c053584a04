"""The coders: exact inverses, one grasp for both forms of a jaw, and gradients everywhere."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from regnet_core import coder
from regnet_core.errors import InvalidInputError
from regnet_core.nn.anchors import (
    CENTRE,
    CLOSING,
    RESIDUALS,
    THETA,
    CoderConfig,
    GraspCoder,
    Pose,
    RefineCoder,
    facing,
    reference_direction,
)

MIRROR = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
PAPER = CoderConfig(reference_depth=0.0, centre_scale=0.1)
CONFIGS = [CoderConfig(), PAPER, CoderConfig(anchors=((1.0, 0.0, 0.0),))]


def random_pose(count: int, seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(count, random_state=seed).as_matrix()
    return Pose(torch.from_numpy(rotation), torch.from_numpy(rng.uniform(-0.5, 0.5, (count, 3))))


def mirrored(pose: Pose) -> Pose:
    return Pose(pose.rotation * MIRROR, pose.translation)


def canonical(pose: Pose) -> np.ndarray:
    return coder.canonical_rotation(pose.rotation.numpy())


def points_and_anchors(count: int, config: CoderConfig) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(5)
    points = torch.from_numpy(rng.uniform(-0.5, 0.5, (count, 3)))
    return points, torch.from_numpy(rng.integers(0, len(config.anchors), count))


@pytest.mark.parametrize("config", CONFIGS)
def test_decode_inverts_encode_for_every_anchor(config: CoderConfig) -> None:
    grasps = random_pose(500, 1)
    points, anchor = points_and_anchors(500, config)
    back = GraspCoder(config).decode(points, anchor, GraspCoder(config).encode(points, anchor, grasps))
    assert np.abs(canonical(back) - canonical(grasps)).max() < 1e-12
    assert (back.translation - grasps.translation).abs().max() < 1e-12


def test_encode_inverts_decode() -> None:
    points, anchor = points_and_anchors(500, CoderConfig())
    grasps = random_pose(500, 2)
    code = GraspCoder().encode(points, anchor, grasps)
    again = GraspCoder().encode(points, anchor, GraspCoder().decode(points, anchor, code))
    assert (again - code).abs().max() < 1e-10


def test_both_forms_of_a_jaw_have_one_code() -> None:
    points, anchor = points_and_anchors(500, CoderConfig())
    grasps = random_pose(500, 3)
    assert torch.equal(
        GraspCoder().encode(points, anchor, grasps), GraspCoder().encode(points, anchor, mirrored(grasps))
    )
    proposals = random_pose(500, 4)
    assert torch.equal(RefineCoder().encode(proposals, grasps), RefineCoder().encode(proposals, mirrored(grasps)))


def test_angles_agree_with_the_numpy_coder() -> None:
    """Sin and cos of the numpy theta, seen from the form of the jaw that faces the anchor."""
    grasps = random_pose(500, 6)
    anchor = torch.zeros(500, dtype=torch.int64)
    code = GraspCoder().encode(grasps.translation, anchor, grasps)
    r, theta = coder.encode_orientation(grasps.rotation.numpy())
    back = r @ np.ones(3) < 0  # the canonical form looks away from anchor 0: theta becomes pi - theta
    theta = np.where(back, np.pi - theta, theta)
    direction = np.ones(3) / math.sqrt(3)
    np.testing.assert_allclose(code[:, THETA].numpy(), np.stack([np.sin(theta) - 1, np.cos(theta)], -1), atol=1e-12)
    np.testing.assert_allclose(code[:, CLOSING].numpy(), np.where(back, -1, 1)[:, None] * r - direction, atol=1e-12)


def test_reference_direction_agrees_with_numpy_where_r_is_vertical_too() -> None:
    r = np.concatenate([Rotation.random(50, random_state=0).as_matrix()[:, 0], [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    np.testing.assert_allclose(reference_direction(torch.from_numpy(r)), coder.reference_direction(r), atol=1e-15)


@pytest.mark.parametrize("number", range(4))
def test_residuals_of_zero_are_a_hand_from_above_along_the_anchor(number: int) -> None:
    point = torch.tensor([0.1, 0.2, 0.3])
    grasp = GraspCoder().decode(point, torch.tensor(number), torch.zeros(RESIDUALS))
    assert torch.allclose(grasp.closing, GraspCoder().anchors(point)[number], atol=1e-6)
    reference = grasp.translation + 0.03 * grasp.approach
    assert torch.allclose(reference, point, atol=1e-6)
    steepest = -math.sqrt(1.0 - 1.0 / 3.0)  # the approach is perpendicular to a closing direction that is not level
    assert grasp.approach[2].item() == pytest.approx(steepest, abs=1e-6)


def test_code_of_a_known_grasp() -> None:
    """Straight down, closing along x, the entry point 0.04 m from the palm at the region's point."""
    down = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])  # columns -z, x, -y
    grasp = Pose(down, torch.tensor([0.0, 0.0, 0.14]))
    code = GraspCoder().encode(torch.tensor([0.0, 0.0, 0.10]), torch.tensor(0), grasp)
    a = 1 / math.sqrt(3)
    expected = [0.0, 0.0, 0.5, 1 - a, -a, -a, 0.0, 0.0]  # 0.03 from the palm is 0.01 above the point: half a radius
    assert torch.allclose(code, torch.tensor(expected), atol=1e-6)


def test_codes_do_not_jump_where_the_canonical_form_does() -> None:
    """Closing directions on both sides of x = 0, where coder.py turns the jaw round."""
    rotations = Rotation.from_euler("z", [[math.pi / 2 - 1e-4], [math.pi / 2 + 1e-4]]).as_matrix()
    down = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    grasps = Pose(torch.from_numpy(rotations @ down), torch.zeros(2, 3, dtype=torch.float64))
    assert grasps.closing[0, 0] > 0 > grasps.closing[1, 0]
    for number in range(4):
        first, second = GraspCoder().encode(torch.zeros(2, 3).double(), torch.tensor([number] * 2), grasps)
        assert (first - second).abs().max() < 1e-3


def test_codes_do_not_jump_at_theta_pi() -> None:
    """Approaches a little above and below level, on the side where theta is pi."""
    r = np.tile([[1.0, 0.0, 0.0]], (2, 1))
    rotation = torch.from_numpy(coder.decode_orientation(r, np.array([np.pi - 1e-4, -np.pi + 1e-4])))
    code = GraspCoder().encode(torch.zeros(2, 3).double(), torch.tensor([0, 0]), Pose(rotation, torch.zeros(2, 3)))
    assert (code[0] - code[1]).abs().max() < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_decoded_rotations_are_rotations_whatever_the_network_says(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    residual = 3 * torch.randn(1000, RESIDUALS, generator=generator, dtype=torch.float64)
    points, anchor = points_and_anchors(1000, CoderConfig())
    for pose in (GraspCoder().decode(points, anchor, residual), RefineCoder().decode(random_pose(1000, 1), residual)):
        product = pose.rotation.transpose(1, 2) @ pose.rotation
        assert (product - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-12
        assert (torch.linalg.det(pose.rotation) - 1).abs().max() < 1e-12


@pytest.mark.parametrize("config", CONFIGS)
def test_without_gradients_the_same_comes_from_one_loop(config: CoderConfig) -> None:
    """Also where residuals cancel the anchor or the angle, or make the closing direction vertical."""
    points, anchor = points_and_anchors(300, config)
    residual = torch.randn(300, RESIDUALS, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    directions = GraspCoder(config).anchors(points)[anchor]
    residual[0, CLOSING] = -directions[0]
    residual[1, THETA] = torch.tensor([-1.0, 0.0], dtype=torch.float64)
    residual[2, CLOSING] = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) - directions[2]
    residual[3, THETA] = torch.tensor([0.0, -1.0], dtype=torch.float64)
    residual[4, CLOSING] = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    wanted = residual.clone().requires_grad_()
    proposals = random_pose(300, 4)
    for found, expected in (
        (GraspCoder(config).decode(points, anchor, residual), GraspCoder(config).decode(points, anchor, wanted)),
        (RefineCoder(config).decode(proposals, residual), RefineCoder(config).decode(proposals, wanted)),
    ):
        assert expected.rotation.requires_grad and not found.rotation.requires_grad
        assert (found.rotation - expected.rotation).abs().max() < 1e-9
        assert (found.translation - expected.translation).abs().max() < 1e-9


def test_a_region_and_all_its_anchors_at_once() -> None:
    points, _ = points_and_anchors(7, CoderConfig())
    residual = torch.randn(7, 4, RESIDUALS, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    together = GraspCoder().decode(points[:, None], torch.arange(4), residual)
    assert together.rotation.shape == (7, 4, 3, 3) and together.translation.shape == (7, 4, 3)
    alone = GraspCoder().decode(points[3], torch.tensor(2), residual[3, 2])
    assert torch.equal(together.rotation[3, 2], alone.rotation)
    code = GraspCoder().encode(points[:, None], torch.arange(4), together)
    assert code.shape == (7, 4, RESIDUALS)
    assert torch.equal(code[3, 2], GraspCoder().encode(points[3], torch.tensor(2), alone))


def test_decoding_has_right_gradients() -> None:
    points, anchor = points_and_anchors(5, CoderConfig())
    residual = 0.3 * torch.randn(5, RESIDUALS, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    residual.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: tuple(GraspCoder().decode(points, anchor, x)), residual)
    proposals = random_pose(5, 0)
    assert torch.autograd.gradcheck(lambda x: tuple(RefineCoder().decode(proposals, x)), residual)


def test_gradients_are_finite_where_a_direction_is_lost() -> None:
    """Residuals that cancel the anchor, the angle, or make r vertical."""
    a = 1 / math.sqrt(3)
    residual = torch.zeros(3, RESIDUALS)
    residual[0, CLOSING] = -a
    residual[1, THETA] = torch.tensor([-1.0, 0.0])
    residual[2, CLOSING] = torch.tensor([-a, -a, 0.0])
    residual.requires_grad_()
    pose = GraspCoder().decode(torch.zeros(3, 3), torch.zeros(3, dtype=torch.int64), residual)
    (pose.rotation.sum() + pose.translation.sum()).backward()  # type: ignore[no-untyped-call]
    assert residual.grad is not None and residual.grad.isfinite().all()
    product = pose.rotation.transpose(1, 2) @ pose.rotation
    assert (product - torch.eye(3)).abs().max() < 1e-5


def test_no_digits_are_lost_under_autocast() -> None:
    proposals, grasps = (
        Pose(p.rotation.float(), p.translation.float()) for p in (random_pose(50, 1), random_pose(50, 2))
    )
    with torch.autocast("cpu", dtype=torch.bfloat16):
        code = RefineCoder().encode(proposals, grasps)
        back = RefineCoder().decode(proposals, code)
        rough = RefineCoder().decode(proposals, code.bfloat16())
    assert (back.translation - grasps.translation).abs().max() < 1e-5
    assert rough.rotation.dtype == torch.float32
    product = rough.rotation.transpose(1, 2) @ rough.rotation
    assert (product - torch.eye(3)).abs().max() < 1e-5


def test_refining_inverts() -> None:
    proposals, grasps = random_pose(500, 7), random_pose(500, 8)
    back = RefineCoder().decode(proposals, RefineCoder().encode(proposals, grasps))
    assert np.abs(canonical(back) - canonical(grasps)).max() < 1e-12
    assert (back.translation - grasps.translation).abs().max() < 1e-12


def test_refining_by_nothing_changes_nothing() -> None:
    proposals = random_pose(20, 9)
    assert RefineCoder().encode(proposals, proposals).abs().max() < 1e-12
    back = RefineCoder().decode(proposals, torch.zeros(20, RESIDUALS, dtype=torch.float64))
    assert (back.rotation - proposals.rotation).abs().max() < 1e-12


def test_a_refinement_is_the_same_in_every_frame() -> None:
    proposals, grasps = random_pose(20, 10), random_pose(20, 11)
    turn = torch.from_numpy(Rotation.random(random_state=1).as_matrix())
    moved = [Pose(turn @ p.rotation, p.translation @ turn.T + 1.0) for p in (proposals, grasps)]
    assert torch.allclose(RefineCoder().encode(*moved), RefineCoder().encode(proposals, grasps), atol=1e-12)


def test_a_known_refinement() -> None:
    """The grasp is 4 mm farther along the proposal's approach and turned by 0.2 rad about its closing direction."""
    proposal = random_pose(1, 12)
    turn = torch.from_numpy(Rotation.from_euler("y", 0.2).as_matrix())
    rotation = proposal.rotation @ turn
    reference = proposal.translation + (0.03 + 0.004) * proposal.approach
    grasp = Pose(rotation, reference - 0.03 * rotation[..., :, 0])
    code = RefineCoder().encode(proposal, grasp)[0]
    assert torch.allclose(code[CENTRE], torch.tensor([0.4, 0.0, 0.0]).double(), atol=1e-12)
    assert code[CLOSING].abs().max() < 1e-12
    assert torch.allclose(code[THETA].abs(), torch.tensor([math.sin(0.2), 1 - math.cos(0.2)]).double(), atol=1e-12)


def test_facing_turns_the_jaw_only() -> None:
    pose = random_pose(100, 13)
    direction = torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64)
    turned = facing(pose.rotation, direction)
    assert ((turned[:, :, 1] * direction).sum(-1) >= 0).all()
    assert torch.equal(turned[:, :, 0], pose.approach)
    assert np.array_equal(coder.canonical_rotation(turned.numpy()), canonical(pose))


@pytest.mark.parametrize(
    "wrong", [{"anchors": ()}, {"anchors": ((0.0, 0.0, 0.0),)}, {"centre_scale": 0.0}, {"reference_depth": -0.01}]
)
def test_impossible_codes_are_refused(wrong: dict) -> None:
    with pytest.raises(InvalidInputError):
        CoderConfig(**wrong)
