"""Points about planes, against numpy."""

import numpy as np
import pytest

from regnet_core.geometry import normalised
from regnet_core.ops.slabs import fitted_plane, planes_of_triples, slab_counts

RNG = np.random.default_rng(4)
POINTS = RNG.normal((5.0, -3.0, 1.0), size=(3000, 3))
NORMALS = normalised(RNG.normal(size=(70, 3)))
OFFSETS = NORMALS @ [5.0, -3.0, 1.0] + RNG.normal(size=70)


def test_counts() -> None:
    expected = (np.abs(POINTS @ NORMALS.T - OFFSETS) < 0.3).sum(axis=0)
    assert np.array_equal(slab_counts(POINTS, NORMALS, OFFSETS, 0.3), expected) and expected.max() > 500


def test_one_round_of_least_squares() -> None:
    near = POINTS[np.abs(POINTS @ NORMALS[0] - OFFSETS[0]) < 0.3]
    expected = np.linalg.eigh(np.cov(near.T, bias=True))[1][:, 0]
    expected *= np.sign(expected[2])
    normal, offset = fitted_plane(POINTS, NORMALS[0], float(OFFSETS[0]), 0.3, 1)
    np.testing.assert_allclose(normal, expected, atol=1e-10)
    assert offset == pytest.approx(expected @ near.mean(axis=0), abs=1e-10)


def test_rounds_end_at_the_plane_that_the_points_lie_on() -> None:
    true = normalised(np.array([0.1, -0.2, 1.0]))
    flat = RNG.uniform(-1, 1, (2000, 3))
    flat += np.outer(0.7 + 0.001 * RNG.normal(size=2000) - flat @ true, true)
    normal, offset = fitted_plane(flat, normalised(true + np.array([0.01, 0.0, 0.0])), 0.69, 0.05, 10)
    assert normal @ true > 1.0 - 1e-7 and offset == pytest.approx(0.7, abs=1e-4)


def test_planes_of_triples_are_those_that_are_not_too_steep() -> None:
    a, b, c = RNG.normal(size=(3, 200, 3))
    b[0] = a[0]  # in a line
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    usable = (length > 1e-5) & (np.abs(normals[:, 2]) > 0.8 * length)
    expected = normals[usable] / length[usable, None] * np.sign(normals[usable, 2:])
    found = planes_of_triples(a, b, c, 0.8, 1e-5)
    assert 10 < len(found.offsets) == usable.sum() < 200
    np.testing.assert_allclose(found.normals, expected, atol=1e-12)
    np.testing.assert_allclose(found.offsets, (expected * a[usable]).sum(axis=1), atol=1e-12)


def test_no_points() -> None:
    normal, offset = fitted_plane(POINTS, NORMALS[0], 1e3, 0.3, 4)
    assert normal.tolist() == NORMALS[0].tolist() and offset == 1e3
    assert slab_counts(np.zeros((0, 3)), NORMALS, OFFSETS, 0.3).tolist() == [0] * 70
