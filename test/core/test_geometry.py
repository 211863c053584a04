"""Transforms and rotations, against scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core.geometry import matrix_from_quaternion, quaternion_from_matrix

HALVES = [[np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [0, 0, 0], [np.pi, 0, 1e-9], [3.1415, 1e-3, 0.2]]


@pytest.mark.parametrize("rotations", [Rotation.random(2000, random_state=3), Rotation.from_euler("xyz", HALVES)])
def test_quaternions_are_those_of_scipy(rotations: Rotation) -> None:
    matrices = rotations.as_matrix()
    found = quaternion_from_matrix(matrices)
    np.testing.assert_allclose(found, rotations.as_quat(canonical=True), atol=1e-14)
    np.testing.assert_allclose(matrix_from_quaternion(found), matrices, atol=1e-14)
    assert quaternion_from_matrix(matrices[:0]).shape == (0, 4)
