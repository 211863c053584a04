"""The compiled kernels: known answers, the same on any number of cores and threads, after a fork, without a cache."""

import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core import Grasps, Gripper
from regnet_core.collision import SceneCollision
from regnet_core.ops import compiled, parallel
from regnet_core.ops.buckets import CornerBuckets
from regnet_core.ops.jaw_profile import JawProfile, jaw_profile
from regnet_core.ops.local_planes import local_planes
from regnet_core.ops.team import Team
from regnet_core.ops.voxel_grid import build_grid

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-0.1, 0.1, (6000, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
ROTATION = Rotation.random(3000, random_state=1).as_matrix()
CENTRES = RNG.uniform(-0.2, 0.2, (3000, 3))


def every_kernel() -> list[np.ndarray]:
    grid = build_grid(POINTS, 0.012)
    profile = jaw_profile(ROTATION, CENTRES, Gripper(), grid, NORMALS[grid.order], np.arange(6000) % 2 == 0)
    planes = local_planes(CornerBuckets.of(POINTS), 0.012)
    grasps = Grasps.from_poses(ROTATION, CENTRES, np.full(3000, 0.05), np.ones(3000))
    return [*profile, *planes, *SceneCollision(POINTS, None).occupancy(grasps, Gripper())]


def assert_same(a: list[np.ndarray], b: list[np.ndarray]) -> None:
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.fixture
def cores(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """So many cores, as far as loops know, and teams of their own."""
    teams: list[Team] = []
    monkeypatch.setattr(parallel, "available_cores", lambda: request.param)
    monkeypatch.setattr(parallel, "_idle", teams)
    yield request.param
    for team in teams:
        team.end()


@pytest.mark.parametrize("cores", [1, 2, 7], indirect=True)
def test_the_result_does_not_depend_on_the_number_of_cores(cores: int) -> None:
    with parallel.on_one_core():
        expected = every_kernel()
    assert expected[0].any() and expected[-2].any()
    assert_same(every_kernel(), expected)


def test_several_threads_may_call_at_a_time() -> None:
    expected = every_kernel()
    with ThreadPoolExecutor(4) as callers:
        for result in [callers.submit(every_kernel) for _ in range(8)]:
            assert_same(result.result(timeout=60), expected)


def finished(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, timeout=120)


@compiled.compiled
def note(start, stop, begun):  # type: ignore[no-untyped-def]
    """Write where each turn's range began."""
    for i in range(start, stop):
        begun[i] = start


def ranges(count: int, each: float) -> int:
    begun = np.full(count, -1)
    parallel.for_each_range(note, count, each, begun)
    assert (begun >= 0).all()
    return len(np.unique(begun))


@pytest.mark.parametrize("cores", [2], indirect=True)
@pytest.mark.parametrize(("count", "each", "expected"), [(1000, 1e5, 8), (3, 1e9, 3), (1000, 10.0, 1), (0, 1e9, 0)])
def test_work_is_split_where_that_pays(count: int, each: float, expected: int, cores: int) -> None:
    assert ranges(count, each) == expected


@pytest.mark.parametrize("cores", [4], indirect=True)
def test_computations_side_by_side_share_the_cores(cores: int) -> None:
    with parallel.sharing_cores():
        assert ranges(1000, 1e5) == 16
        with parallel.sharing_cores():  # as another thread would
            assert ranges(1000, 1e5) == 8
            with parallel.sharing_cores():
                assert ranges(1000, 1e5) == 1
        assert ranges(1000, 1e5) == 16
        with ThreadPoolExecutor(1) as others:  # work of another kind takes the cores that are left
            assert others.submit(ranges, 1000, 1e5).result(timeout=60) == 12


def test_a_forked_process_can_go_on_working() -> None:
    script = """
import os, signal
import numpy as np
from regnet_core.ops import parallel
from regnet_core.ops.buckets import CornerBuckets
from regnet_core.ops.local_planes import local_planes
parallel._cores_of_the_process = lambda: 2
points = np.random.default_rng(0).random((5000, 3))
def work():
    return int(local_planes(CornerBuckets.of(points), 0.1).neighbours.sum())
before = work()
child = os.fork()
if child == 0:
    signal.alarm(20)
    os._exit(0 if work() == before else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), work() == before)
"""
    result = finished(script)
    assert (result.stdout, result.stderr) == ("0 True\n", "")


def test_without_a_place_for_the_cache_functions_are_compiled_all_the_same() -> None:
    script = """
from numba.core import caching
cache = getattr(caching, "CacheImpl", None) or caching._CacheImpl
cache._locator_classes = []
import numpy as np
import regnet_core
from regnet_core.ops.buckets import CornerBuckets
from regnet_core.ops.local_planes import local_planes
points = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [0.1, 0.1, 0.0]
print(np.abs(local_planes(CornerBuckets.of(points), 0.05).normal[:, 2]).min() > 0.999)
"""
    result = finished(script)
    assert (result.stdout, result.stderr) == ("True\n", "")


def test_an_error_in_the_function_itself_is_not_hidden() -> None:
    def wrong(x: float) -> float:
        return x.no_such_thing  # type: ignore[attr-defined, no-any-return]

    with pytest.raises(Exception, match="no_such_thing"):
        compiled.compiled(wrong)(1.0)


def test_local_planes_equal_those_of_each_neighbourhood() -> None:
    result = local_planes(CornerBuckets.of(POINTS), 0.02)
    for i, query in enumerate(POINTS[:300]):
        near = POINTS[np.linalg.norm(POINTS - query, axis=1) <= 0.02]
        assert result.neighbours[i] == len(near)
        np.testing.assert_allclose(result.mean[i], near.mean(axis=0), atol=1e-8)
        _, vectors = np.linalg.eigh(np.cov(near.T, bias=True).reshape(3, 3))
        if len(near) > 5:
            assert abs(result.normal[i] @ vectors[:, 0]) > 1 - 1e-6


def wall(y: float, step: float) -> np.ndarray:
    x, z = np.meshgrid(np.arange(0.002, 0.198, step), np.arange(-0.048, 0.048, step))
    return np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()])


def profile_of(points: np.ndarray, gripper: Gripper) -> JawProfile:
    grid = build_grid(points, 0.012)
    normals = np.sign(points[grid.order]) * [0.0, 1.0, 0.0]
    return jaw_profile(np.eye(3)[None], np.zeros((1, 3)), gripper, grid, normals, np.ones(len(points), bool))


def test_a_dense_surface_between_large_fingers_is_seen_whole() -> None:
    gripper = Gripper(width=0.16, depth=0.2, height=0.1)
    middle = np.array([[0.1, 0.0, 0.0]])
    points = np.concatenate([wall(-0.05, 0.0015), middle, wall(0.05, 0.0015), middle])
    assert len(points) > 16000  # more than there is room for at first
    points[:, 1] += np.where(points[:, 1] == 0.0, 0.0, np.where(points[:, 0] > 0.19, np.sign(points[:, 1]) * 0.005, 0))
    filled = np.concatenate([points, *([[0.1, y, 0.0]] for y in np.arange(-0.05, 0.05, 0.001))])
    profile = profile_of(filled, gripper)
    assert profile.found[0]
    assert (profile.low[0], profile.high[0]) == pytest.approx((-0.055, 0.055), abs=1e-9)
    assert (profile.cos_low[0], profile.cos_high[0]) == pytest.approx((1.0, 1.0))


def test_the_profile_of_a_plate_by_hand() -> None:
    plate = np.concatenate([wall(-0.003, 0.003), wall(0.003, 0.003)])
    profile = profile_of(plate, Gripper(width=0.08))
    assert profile.found[0]
    assert (profile.low[0], profile.high[0]) == pytest.approx((-0.003, 0.003))
    assert (profile.cos_low[0], profile.cos_high[0], profile.evidence[0]) == pytest.approx((1.0, 1.0, 1.0))
    apart = profile_of(np.concatenate([wall(-0.045, 0.003), wall(0.045, 0.003)]), Gripper(width=0.08))
    assert not apart.found[0]
