"""Poses before and after a grasp."""

import numpy as np
import pytest

from regnet_core.approach import lift_poses, pre_grasp_poses
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import pose_matrix

DOWN = pose_matrix([0.1, 0.2, 0.9], [0.0, np.pi / 2, 0.0])
"""The approach X points along -z."""
TILTED = pose_matrix([1.0, 2.0, 3.0], [0.3, 0.7, -1.1])


def test_the_pre_grasp_of_a_hand_that_points_down_lies_straight_above() -> None:
    before = pre_grasp_poses([DOWN], 0.1)[0]
    np.testing.assert_allclose(before[:3, 3], [0.1, 0.2, 1.0], atol=1e-12)
    np.testing.assert_array_equal(before[:3, :3], DOWN[:3, :3])


def test_the_way_from_pre_grasp_to_grasp_is_along_the_approach() -> None:
    before = pre_grasp_poses([TILTED, DOWN], 0.25)
    way = np.stack([TILTED, DOWN])[:, :3, 3] - before[:, :3, 3]
    np.testing.assert_allclose(way, 0.25 * np.stack([TILTED, DOWN])[:, :3, 0], atol=1e-12)


def test_the_lift_is_vertical_whatever_the_approach() -> None:
    lifted = lift_poses([TILTED, DOWN], 0.3)
    np.testing.assert_allclose(lifted[:, :3, 3] - np.stack([TILTED, DOWN])[:, :3, 3], [[0, 0, 0.3]] * 2, atol=1e-12)
    np.testing.assert_array_equal(lifted[:, :3, :3], np.stack([TILTED, DOWN])[:, :3, :3])


def test_the_poses_given_stay_as_they_are() -> None:
    poses = np.stack([DOWN])
    pre_grasp_poses(poses, 0.1)
    lift_poses(poses, 0.1)
    np.testing.assert_array_equal(poses[0], DOWN)


@pytest.mark.parametrize("length", [-0.1, np.nan, np.inf])
def test_a_length_that_makes_no_sense_is_refused(length: float) -> None:
    with pytest.raises(InvalidInputError, match="pre-grasp distance must be"):
        pre_grasp_poses([DOWN], length)
    with pytest.raises(InvalidInputError, match="lift height must be"):
        lift_poses([DOWN], length)
