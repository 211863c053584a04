"""The orientation coder: an exact inverse, one canonical form, and the paper's vertical score."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core import coder

ANCHORS = np.array([[1, 1, 1], [1, 1, -1], [1, -1, -1], [1, -1, 1]]) / np.sqrt(3)


@pytest.fixture
def rotations() -> np.ndarray:
    return Rotation.random(2000, random_state=3).as_matrix()


def mirrored(rotation: np.ndarray) -> np.ndarray:
    return rotation * np.array([1.0, -1.0, -1.0])


def test_decode_inverts_encode_exactly(rotations: np.ndarray) -> None:
    canonical = coder.canonical_rotation(rotations)
    assert np.abs(coder.decode_orientation(*coder.encode_orientation(rotations)) - canonical).max() < 1e-14


def test_encode_inverts_decode_exactly() -> None:
    rng = np.random.default_rng(0)
    r = rng.normal(size=(500, 3))
    r[:, 0] = np.abs(r[:, 0])
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    theta = rng.uniform(-np.pi, np.pi, 500)
    back_r, back_theta = coder.encode_orientation(coder.decode_orientation(r, theta))
    assert np.abs(back_r - r).max() < 1e-14
    assert np.abs(back_theta - theta).max() < 1e-12


def test_both_forms_of_a_symmetric_jaw_become_one(rotations: np.ndarray) -> None:
    assert np.array_equal(coder.canonical_rotation(rotations), coder.canonical_rotation(mirrored(rotations)))


def test_canonical_form_is_the_same_grasp_and_stays(rotations: np.ndarray) -> None:
    canonical = coder.canonical_rotation(rotations)
    assert np.array_equal(canonical[:, :, 0], rotations[:, :, 0])
    assert np.allclose(np.linalg.det(canonical), 1.0)
    assert np.array_equal(coder.canonical_rotation(canonical), canonical)


def test_canonical_closing_directions_are_in_the_half_space_of_the_anchors(rotations: np.ndarray) -> None:
    r, theta = coder.encode_orientation(rotations)
    assert (r[:, 0] > 0).all()
    assert ((theta > -np.pi) & (theta <= np.pi)).all()
    # The nearest of all eight cube diagonals is then always one of the four anchors.
    assert ((r @ ANCHORS.T).max(axis=1) >= (r @ -ANCHORS.T).max(axis=1)).all()


@pytest.mark.parametrize("closing", [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
def test_directions_on_the_border_of_the_half_space(closing: tuple[float, float, float]) -> None:
    y = np.array(closing)
    x = np.array([1.0, 0.0, 0.0])
    rotation = np.stack([x, y, np.cross(x, y)], axis=-1)[None]
    r, theta = coder.encode_orientation(rotation)
    assert np.array_equal(r[0], np.abs(y))
    assert np.allclose(coder.decode_orientation(r, theta)[0][:, 0], x)


def test_theta_of_known_grasps() -> None:
    x_of = {0.0: (0.0, -1.0, 0.0), np.pi / 2: (0.0, 0.0, -1.0), np.pi: (0.0, 1.0, 0.0), -np.pi / 2: (0.0, 0.0, 1.0)}
    for theta, approach in x_of.items():
        rotation = coder.decode_orientation(np.array([[1.0, 0.0, 0.0]]), np.array([theta]))
        assert np.allclose(rotation[0][:, 0], approach, atol=1e-15)


def test_vertical_score_is_the_papers_when_the_closing_direction_is_horizontal() -> None:
    theta = np.linspace(-np.pi / 2, np.pi / 2, 21)
    r = np.tile([0.6, -0.8, 0.0], (21, 1))
    assert np.allclose(coder.vertical_score(coder.decode_orientation(r, theta)), 0.5 + theta / np.pi, atol=1e-7)


@pytest.mark.parametrize(
    ("approach", "score"), [((0, 0, -1), 1.0), ((0, 0, 1), 0.0), ((1, 0, 0), 0.5), ((1, 0, -1), 0.75)]
)
def test_vertical_score_by_hand(approach: tuple[float, float, float], score: float) -> None:
    x = np.array(approach) / np.linalg.norm(approach)
    y = np.array([0.0, 1.0, 0.0])
    assert coder.vertical_score(np.stack([x, y, np.cross(x, y)], axis=-1)[None])[0] == pytest.approx(score)
