"""Points about planes, against numpy."""

import numpy as np
import pytest

from regnet_core.geometry import normalised
from regnet_core.ops.slabs import fitted_plane, horizontal_planes, layers

RNG = np.random.default_rng(4)
POINTS = RNG.normal((5.0, -3.0, 1.0), size=(3000, 3))
NORMALS = normalised(RNG.normal(size=(70, 3)))
OFFSETS = NORMALS @ [5.0, -3.0, 1.0] + RNG.normal(size=70)


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


def _level(height: float, count: int, tilt: float = 0.0, noise: float = 0.001) -> np.ndarray:
    points = RNG.uniform(-1, 1, (count, 3))
    points[:, 2] = height + np.tan(tilt) * points[:, 0] + noise * RNG.normal(size=count)
    return points


def _planes(points: np.ndarray, **changed: float) -> list[tuple[np.ndarray, float, int]]:
    given = {"least_cosine": np.cos(0.26), "tolerance": 0.008, "least_share": 0.05, "flat": 0.45} | changed
    return list(zip(*horizontal_planes(points, np.random.default_rng(1).random((4, 400, 3)), **given), strict=True))


def test_planes_are_found_those_with_the_most_points_first() -> None:
    levels = {0.3: 2500, 0.9: 1500, -0.4: 700}
    points = np.concatenate([_level(height, count, 0.1) for height, count in levels.items()])
    scattered = RNG.uniform(-1, 1, (800, 3))
    found = _planes(RNG.permutation(np.concatenate([points, scattered])))
    assert len(found) == 3
    for (normal, offset, count), (height, number) in zip(found, levels.items(), strict=True):
        np.testing.assert_allclose(normal, [-np.sin(0.1), 0.0, np.cos(0.1)], atol=1e-3)
        assert offset == pytest.approx(height * np.cos(0.1), abs=1e-3)
        assert number <= count <= number + 30


def test_steep_thin_and_round_things_are_no_planes() -> None:
    assert _planes(_level(0.3, 3000, tilt=0.4)) == []
    assert len(_planes(_level(0.3, 3000, tilt=0.4), least_cosine=np.cos(0.5))) == 1
    few = np.concatenate([_level(0.3, 100), RNG.uniform(-1, 1, (2900, 3))])
    assert _planes(few) == []
    assert len(_planes(few, least_share=0.02)) == 1
    assert _planes(RNG.uniform(-1, 1, (3000, 3)) * [1, 1, 0.05], least_share=0.01) == []  # fills the slab
    assert _planes(np.zeros((3000, 3))) == [] and _planes(POINTS[:2]) == []


def test_layers() -> None:
    height = POINTS @ NORMALS[0] - OFFSETS[0]
    found = layers(POINTS, NORMALS[0], float(OFFSETS[0]), 0.3)
    above = np.flatnonzero(height > 0.3)
    assert 20 < len(above) < 2900
    np.testing.assert_array_equal(found.above, above)
    np.testing.assert_array_equal(found.points, POINTS[above])
    np.testing.assert_allclose(found.height, height[above], atol=1e-12)
    np.testing.assert_array_equal(found.ground, POINTS[np.abs(height) <= 0.3, :2].astype(np.float32))
    some = layers(POINTS, NORMALS[0], float(OFFSETS[0]), 0.3, ground=30)
    every = len(found.ground) // 30
    assert every > 3 and len(found.ground) // every <= len(some.ground) <= 1.3 * len(found.ground) / every
    own = {tuple(xy): n for n, xy in enumerate(found.ground.tolist())}
    assert np.diff([own[tuple(xy)] for xy in some.ground.tolist()]).max() <= every
    np.testing.assert_array_equal(some.points, found.points)
    assert len(layers(POINTS, NORMALS[0], float(OFFSETS[0]), 0.3, ground=100_000).ground) == len(found.ground)
    assert [len(part) for part in layers(POINTS[:0], NORMALS[0], 0.0, 0.3)] == [0] * 4


def test_no_points() -> None:
    normal, offset = fitted_plane(POINTS, NORMALS[0], 1e3, 0.3, 4)
    assert normal.tolist() == NORMALS[0].tolist() and offset == 1e3
