"""Compiled passes over volumes and clouds, against what scipy and numpy say."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.spatial import ConvexHull, cKDTree

from regnet_core.clusters import cluster
from regnet_core.ops import cell_map
from regnet_core.ops.buckets import CornerBuckets, in_buckets
from regnet_core.ops.cell_map import CellMap
from regnet_core.ops.cells import cells_below, cells_with_points, highest, seen_from_above
from regnet_core.ops.columns import Volume, smoothed_columns, turned_down, walls
from regnet_core.ops.local_planes import local_planes
from regnet_core.ops.nearby import kth_distance, near_any
from regnet_core.ops.neighbourhoods import newly_marked
from regnet_core.ops.outline import convex_outline, corner_candidates, outside
from regnet_core.ops.rows import rows_in_box, valid_rows
from regnet_core.ops.voxel_grid import bounds
from regnet_core.ops.voxels import share_kept
from regnet_core.pointcloud import voxel_downsample

RNG = np.random.default_rng(7)


def _heights() -> np.ndarray:
    """Blocks of different heights on a wide empty margin, one of them as low as can be."""
    top = np.zeros((40, 33))
    top[8:15, 8:20], top[12:30, 15:25], top[33, 26] = 0.06, 0.11, 0.004
    return top


Z = (np.arange(-4, 28) + 0.5) * 0.005


def _dense(volume: Volume) -> np.ndarray:
    return volume.filled[volume.row]


def test_columns_are_smoothed_as_by_scipy() -> None:
    top = _heights()
    occupied = (top[:, :, None] > Z) & (top[:, :, None] > 0.0)
    expected = ndimage.gaussian_filter(occupied.astype(np.float32), 1.2, truncate=2.5)
    volume = smoothed_columns(top, Z, 1.2, 2.5)
    np.testing.assert_allclose(_dense(volume), expected, atol=1e-6)
    # Only what is near is kept, every column in a row of its own.
    near = expected.any(axis=2)
    assert (volume.row > 0).sum() == len(volume.filled) - 1 < near.size / 2 and (volume.row > 0)[near].all()
    np.testing.assert_array_equal(volume.inside[volume.row], (_dense(volume) > 0.5).sum(axis=2))
    nothing = smoothed_columns(np.zeros((9, 8)), Z, 1.2, 2.5)
    assert not nothing.row.any() and not nothing.filled.any() and nothing.filled.shape == (1, len(Z))
    with pytest.raises(ValueError, match="multiple of 16, got 31"):
        smoothed_columns(top, Z[:31], 1.2, 2.5)


@pytest.mark.parametrize("first", [0, 4, 20])
def test_walls_are_where_an_erosion_and_the_gradient_say(first: int) -> None:
    volume = smoothed_columns(_heights(), Z, 1.2, 2.5)
    origin, cell, normal, offset = np.array([0.3, -0.2, Z[0]]), 0.005, np.array([0.0, 0.6, 0.8]), 0.5
    found = walls(volume, first, 0.05, origin, cell, normal, offset)
    dense = _dense(volume).astype(np.float64)
    inside = dense > 0.5
    # The columns go on below the grid.
    eroded = ndimage.binary_erosion(np.concatenate([inside[:, :, :1], inside], axis=2))[:, :, 1:]
    index = np.argwhere(inside & ~eroded)
    index = index[index[:, 2] >= first]
    assert len(found.points) == len(index) > 200
    slope = np.stack(np.gradient(dense), axis=-1)[tuple(index.T)]
    # At the grid's end the gradient is that of the voxel before it.
    assert (index[:, 2] < len(Z) - 1).all() and (index[:, :2] > 0).all()
    steep, middle = np.linalg.norm(slope, axis=1), index[:, 2] > 0
    np.testing.assert_array_equal(found.clear[middle], steep[middle] > 0.05)
    np.testing.assert_allclose(found.normals[middle], (-slope / steep[:, None])[middle], atol=1e-6)
    out = np.clip((dense[tuple(index.T)] - 0.5) / steep, 0.0, 1.0)[:, None]
    at = origin + cell * (index + out * -slope / steep[:, None])
    at[:, 2] = (at[:, 2] + offset - 0.6 * at[:, 1]) / 0.8
    np.testing.assert_allclose(found.points[middle], at[middle], atol=1e-8)


def test_an_empty_volume_has_no_walls() -> None:
    volume = smoothed_columns(np.zeros((9, 8)), Z, 1.2, 2.5)
    found = walls(volume, 0, 0.05, np.zeros(3), 1.0, np.array([0.0, 0.0, 1.0]), 0.0)
    assert found.points.shape == found.normals.shape == (0, 3) and found.clear.shape == (0,)


@pytest.mark.parametrize("radius", [0.004, 0.03])
def test_whether_any_point_is_near(radius: float) -> None:
    points, queries = RNG.uniform(0.0, 0.3, (500, 3)), RNG.uniform(-0.1, 0.4, (700, 3))
    queries[:40] = points[:40]
    nearest = cKDTree(points).query(queries)[0]
    np.testing.assert_array_equal(near_any(points, queries, radius), nearest <= radius)
    assert not near_any(points[:0], queries, radius).any() and near_any(points, queries[:0], radius).shape == (0,)


def test_rows_that_are_numbers() -> None:
    points = np.array([[0, 0, 0], [np.nan, 0, 0], [0, -np.inf, 0], [0, 0, 1001], [-1000, 1000, 5]], np.float32)
    for given in (points, np.asfortranarray(points.astype(np.float64))):
        assert valid_rows(given, 1000.0).tolist() == [0, 4]


@pytest.mark.parametrize("size", [0.003, 0.05, 10.0])
def test_first_point_of_each_voxel(size: float) -> None:
    points = RNG.normal(0.0, 0.2, (3000, 3))
    points = np.concatenate([points, points[::-1], np.zeros((5, 3))])
    expected = np.sort(np.unique(np.floor(points / size), axis=0, return_index=True)[1])
    np.testing.assert_array_equal(voxel_downsample(points, size), expected)
    some = np.arange(100, len(points), 3)
    expected = some[np.sort(np.unique(np.floor(points[some] / size), axis=0, return_index=True)[1])]
    np.testing.assert_array_equal(voxel_downsample(points, size, some), expected)
    np.testing.assert_array_equal(voxel_downsample(points.astype(np.float32), size, some[:0]), [])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [0.001, 0.01, 0.05, 10.0])
def test_what_voxels_keep_is_known_from_a_look_at_some_points(size: float, dtype: type) -> None:
    points = RNG.normal(0.0, 0.1, (20_000, 3)).astype(dtype)
    points[15_000:17_000] = points[:2000]
    for rows in (None, np.flatnonzero(RNG.random(20_000) < 0.4)):
        kept = len(voxel_downsample(points, size, rows)) / (len(points) if rows is None else len(rows))
        found = share_kept(points, rows, size, 1000.0, probes=2000)
        assert found == pytest.approx(kept, abs=4.0 * 0.5 / np.sqrt(2000))
    # Of all points it is exact.
    every = share_kept(points[:300], None, size, 1000.0, probes=300)
    assert every == pytest.approx(len(voxel_downsample(points[:300], size)) / 300, abs=1e-12)
    assert share_kept(points[:0], None, size, 1000.0) == 0.0
    assert share_kept(points, None, 1e-4, 1000.0) == 0.0  # more voxels than it counts


def test_more_voxels_than_can_be_numbered() -> None:
    points = np.array([[0.0, 0.0, 0.0], [900.0, 900.0, 900.0], [0.0, 0.0, 1e-8]])
    assert voxel_downsample(points, 1e-7).tolist() == [0, 1]
    # Small ones beside each other have numbers, wherever they are.
    near = points[[0, 2, 0]] + [0.0, 0.0, 900.0] + [[0.0], [0.0], [3e-7]]
    assert voxel_downsample(near, 1e-7).tolist() == [0, 2]


@pytest.mark.parametrize("flat", [0.0, 1e-9, 1e-3])
def test_normals_of_planes_lines_and_single_points(flat: float) -> None:
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    sheet = RNG.uniform(-0.01, 0.01, (60, 3)) * [1.0, 1.0, flat] @ turn.T
    local = local_planes(CornerBuckets.of(sheet), 0.1)
    _, vectors = np.linalg.eigh(np.cov(sheet.T, bias=True))
    np.testing.assert_allclose(np.abs(local.normal @ vectors[:, 0]), 1.0, atol=1e-9)
    line = np.outer(np.linspace(0.0, 0.01, 9), turn[0])
    along = local_planes(CornerBuckets.of(line), 0.1)
    np.testing.assert_allclose(along.normal @ turn[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(along.normal, axis=1), 1.0, atol=1e-12)
    alone = local_planes(CornerBuckets.of(line[:1]), 0.1)
    np.testing.assert_allclose(np.linalg.norm(alone.normal, axis=1), 1.0, atol=1e-12)


def test_clusters_do_not_depend_on_how_cells_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.concatenate([RNG.normal(at, 0.05, (300, 3)) for at in (-3.0, 0.0, 0.4)])
    dense = cluster(points)
    monkeypatch.setattr(cell_map, "LARGEST", 0)
    sparse = cluster(points)
    np.testing.assert_array_equal(dense.label, sparse.label)
    np.testing.assert_array_equal(dense.size, sparse.size)
    assert len(dense.size) >= 3


def test_cells_that_hang_together() -> None:
    points = np.concatenate([RNG.normal(at, 0.05, (200, 3)) for at in (-0.6, 0.0, 0.4)])
    cells = CellMap.of(points, 0.03)
    assert cells is not None
    index = np.floor(points[:, :2] / 0.03).astype(int) - cells.first
    seen = np.zeros((len(cells.number) // cells.across, cells.across), int)
    np.add.at(seen, (index[:, 0], index[:, 1]), 1)
    np.testing.assert_array_equal(cells.number, seen.reshape(-1))
    labels, number = ndimage.label(seen, np.ones((3, 3)))
    group, sizes = cells.groups()
    assert len(sizes) == number >= 3
    np.testing.assert_array_equal(group, labels.reshape(-1) - 1)
    np.testing.assert_array_equal(sizes, np.bincount(group[cells.place]))
    np.testing.assert_array_equal(cells.of_points(group), labels[index[:, 0], index[:, 1]] - 1)


def test_normals_are_turned_to_where_the_density_falls() -> None:
    density = RNG.random((7, 6, 8)).astype(np.float32)
    rows = np.arange(1, 43, dtype=np.int32).reshape(7, 6)
    volume = Volume(
        rows, np.concatenate([np.zeros((1, 8), np.float32), density.reshape(42, 8)]), np.zeros(43, np.int64)
    )
    where = RNG.uniform(-2.0, 9.0, (400, 3))  # some outside
    origin, cell = np.array([0.3, -0.2, 0.1]), 0.005
    points, normals = origin + cell * where, RNG.normal(size=(400, 3))
    height, points[:, 2] = points[:, 2].copy(), 7.0
    slopes = []
    for step in 1.5 * np.eye(3):
        ahead, behind = (
            ndimage.map_coordinates(density.astype(float), (where + side * step).T, order=1, mode="nearest")
            for side in (1.0, -1.0)
        )
        slopes.append(ahead - behind)
    rise = np.sum(normals * np.transpose(slopes), axis=1)
    expected = normals * np.where(rise > 0, -1, 1)[:, None] / np.linalg.norm(normals, axis=1)[:, None]
    turned = turned_down(normals, volume, origin, cell, points, height, 1.5)
    clear = np.abs(rise) > 1e-5
    assert clear.mean() > 0.7 and 100 < (rise > 1e-5).sum() < 300
    np.testing.assert_allclose(turned[clear], expected[clear], atol=1e-12)


def test_walls_of_a_ramp_by_hand() -> None:
    # Falls along x by 0.2 from one voxel to the next: 1, 0.8, 0.6, 0.4, ...
    filled = np.repeat(np.maximum(1.0 - 0.2 * np.arange(6.0), 0.0), 5)[:, None].astype(np.float32)
    filled = np.concatenate([np.zeros((1, 16), np.float32), np.tile(filled, 16)])
    inside = np.where(filled[:, 0] > 0.5, 16, 0)
    volume = Volume(np.arange(1, 31, dtype=np.int32).reshape(6, 5), filled, inside)
    level = (np.array([0.0, 0.0, 1.0]), 0.0)
    found = walls(volume, 2, 0.05, np.zeros(3), 1.0, *level)
    # Inside are the columns with x of 0 to 2. All voxels are at the surface of those that are on the grid's border or
    # touch columns with x of 3, and the uppermost one of the other three.
    assert len(found.points) == 12 * 14 + 3
    np.testing.assert_allclose(found.normals, np.tile([1.0, 0.0, 0.0], (len(found.normals), 1)), atol=1e-6)
    # 0.1 above the level is half a voxel, 0.3 would be more than a whole one.
    at = found.points[(found.points[:, 1] == 2) & (found.points[:, 0] > 2.0)]
    np.testing.assert_allclose(at, [[2.5, 2.0, z] for z in range(2, 16)], atol=1e-5)
    assert found.clear.all() and not walls(volume, 2, 0.3, np.zeros(3), 1.0, *level).clear.any()


def test_cells_of_points() -> None:
    points = RNG.normal(size=(500, 3))
    np.testing.assert_array_equal(cells_below(points, 0.3), np.floor(points[:, :2] / 0.3))
    for cell in (0.3, 1e-5):  # the small ones are too many for a map
        assert cells_with_points(points, cell) == len(np.unique(np.floor(points[:, :2] / cell), axis=0))
    assert cells_with_points(points[:0], 0.3) == 0
    low = points[:, :2].min(axis=0) - 0.5
    index = np.round((points[:, :2] - low) / 0.3).astype(int)
    marked, top = (
        seen_from_above((points[:200, :2].astype(np.float32), points[200:]), low, 0.3, (40, 40), 0),
        np.zeros((40, 40)),
    )
    np.maximum.at(top, (index[:, 0], index[:, 1]), points[:, 2])
    assert marked.sum() == len(np.unique(index, axis=0)) and marked[index[:, 0], index[:, 1]].all()
    np.testing.assert_array_equal(highest(points, points[:, 2], low, 0.3, (40, 40), 0), top)
    filled = ndimage.grey_closing(top, (5, 5), mode="constant", cval=0.0)
    inner = (slice(4, -4), slice(4, -4))
    closed_too = highest(points, points[:, 2], low, 0.3, (40, 40), 2)
    np.testing.assert_array_equal(closed_too[inner], np.where(top > 0.0, top, filled)[inner])
    assert (closed_too > 0.0).sum() > (top > 0.0).sum()


@pytest.mark.parametrize("usual", [0.01, 0.3, 5.0])
@pytest.mark.parametrize("count", [5, 40, 801])
def test_distance_of_the_kth_nearest(count: int, usual: float) -> None:
    points = RNG.random((count, 3)).astype(np.float32)
    buckets = in_buckets(points)
    own = points[buckets.rows.reshape(-1)[np.arange(min(50, count)) * count // min(50, count)]]
    found = kth_distance(buckets, 50, 6, usual, 0.25)
    if count == 5:
        assert found.shape == (5,) and np.isinf(found).all()
        return
    expected = cKDTree(points).query(own, k=[6])[0][:, 0]
    assert (expected > 0.25).any() == (count == 40)
    np.testing.assert_allclose(found, np.where(expected <= 0.25, expected, np.inf), rtol=1e-5)


def test_corners_of_a_hull_are_among_the_candidates() -> None:
    for points in (RNG.normal(size=(3000, 3)), RNG.random((3000, 2)), np.stack([np.arange(9.0)] * 2, axis=1)):
        cells = CellMap.of(points, 0.05)
        assert cells is not None
        rows = corner_candidates(points, cells, np.ones(len(cells.number), bool))
        if points.shape[1] == 2 and len(points) == 9:  # all in one line
            assert rows.tolist() == list(range(9))
            continue
        hull = ConvexHull(points[:, :2])
        assert set(hull.vertices) <= set(rows.tolist()) and len(rows) < 1500
        left = cells.place % 2 == 0
        some = np.flatnonzero(left)[ConvexHull(points[left, :2]).vertices]
        assert set(some) <= set(corner_candidates(points, cells, np.arange(len(cells.number)) % 2 == 0).tolist())
        again = ConvexHull(points[rows][:, :2])
        assert again.volume == pytest.approx(hull.volume, rel=1e-12)
        probes = 3.0 * RNG.normal(size=(200, 2))
        expected = (probes @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1) > 0.2
        np.testing.assert_array_equal(outside(probes, again.equations, 0.2), expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shift", [-0.6, -0.15, 0.0, 0.35, 12.4])
def test_a_table_that_ends_where_cells_do_keeps_its_corners(shift: float, dtype: type) -> None:
    axis = np.linspace(shift, shift + 1.0, 161)
    table = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2).astype(dtype)
    cells = CellMap.of(table, 0.05)
    assert cells is not None
    rows = corner_candidates(table, cells, np.ones(len(cells.number), bool))
    assert len(rows) < len(table) // 3
    assert ConvexHull(table[rows]).volume == pytest.approx(1.0, abs=1e-5)
    assert len(convex_outline(table, rows)) == 4


def test_a_convex_outline_is_the_hull() -> None:
    square = np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 0.0], [2.0, 2.0], [0.0, 2.0], [1.0, 1.0], [0.0, 0.0]])
    expected = [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, -2.0], [1.0, 0.0, -2.0]]
    np.testing.assert_allclose(sorted(convex_outline(square).tolist()), expected, atol=1e-15)
    for points in (RNG.normal(size=(300, 3)).astype(np.float32), RNG.random((40, 2)), RNG.random((3, 2))):
        hull = ConvexHull(points[:, :2]).equations
        own = convex_outline(points)
        assert len(own) == len(hull)
        np.testing.assert_allclose(own[np.argsort(own[:, 0])], hull[np.argsort(hull[:, 0])], atol=1e-6)
    along = RNG.random(50)[:, None]
    lines = [along * slope + shift for slope in ([1.0, 0.1], [0.3, -0.7]) for shift in ([0.0, 0.0], [30.0, -20.0])]
    lines += [line.astype(np.float32) for line in lines[::2]]
    for points in (*lines, np.stack([np.arange(9.0)] * 2, axis=1), np.ones((5, 3)), np.ones((1, 2)), np.eye(2)):
        assert convex_outline(points).shape == (0, 3)


def test_rows_that_are_marked_for_the_first_time() -> None:
    marked = torch.tensor([True, False, False, True, False])
    assert newly_marked(marked, torch.tensor([4, 0, 1, 4])).tolist() == [1, 4]
    assert marked.tolist() == [True, True, False, True, True]
    assert newly_marked(marked, torch.tensor([4, 1])).tolist() == []
    assert newly_marked(marked, torch.tensor([2, 3, 2])).tolist() == [2] and marked.all()


@pytest.mark.parametrize("count", [1, 15, 16, 17, 50])
def test_bounds(count: int) -> None:
    points = RNG.normal(size=(3, count)).astype(np.float32).T  # its columns are contiguous, not its rows
    lower, upper = bounds(points)
    assert lower.dtype == np.float32
    np.testing.assert_array_equal(lower, points.min(axis=0))
    np.testing.assert_array_equal(upper, points.max(axis=0))


def test_rows_in_a_box() -> None:
    points = RNG.normal(size=(400, 3)).astype(np.float32)
    points[3] = np.nan
    lower, upper = points[0] - np.float32(0.0), points[0] + np.float32(1.5)  # the first point is a corner
    expected = np.flatnonzero(((points >= lower) & (points <= upper)).all(axis=1))
    assert expected[0] == 0 and len(expected) > 3
    np.testing.assert_array_equal(rows_in_box(points, lower, upper), expected)
