"""Points about planes, against numpy."""

import numpy as np

from regnet_core.geometry import normalised
from regnet_core.ops.slabs import slab_counts, slab_moments

RNG = np.random.default_rng(4)
POINTS = RNG.normal((5.0, -3.0, 1.0), size=(3000, 3))
NORMALS = normalised(RNG.normal(size=(70, 3)))
OFFSETS = NORMALS @ [5.0, -3.0, 1.0] + RNG.normal(size=70)


def test_counts() -> None:
    expected = (np.abs(POINTS @ NORMALS.T - OFFSETS) < 0.3).sum(axis=0)
    assert np.array_equal(slab_counts(POINTS, NORMALS, OFFSETS, 0.3), expected) and expected.max() > 500


def test_moments() -> None:
    near = POINTS[np.abs(POINTS @ NORMALS[0] - OFFSETS[0]) < 0.3]
    found = slab_moments(POINTS, NORMALS[0], float(OFFSETS[0]), 0.3)
    assert found.points == len(near)
    np.testing.assert_allclose(found.mean, near.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(found.covariance, np.cov(near.T, bias=True), atol=1e-12)


def test_no_points() -> None:
    assert slab_moments(POINTS, NORMALS[0], 1e3, 0.3).points == 0
    assert slab_counts(np.zeros((0, 3)), NORMALS, OFFSETS, 0.3).tolist() == [0] * 70
