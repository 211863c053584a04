"""Farthest points, ball and box queries, and interpolation: hand-computed cases, brute force, CPU against torch."""

import numpy as np
import pytest
import torch
from scenes import tabletop
from scipy.spatial.transform import Rotation

from benchmarks.padded import padded_ball_query, plain_farthest_points, plain_interpolation
from regnet_core.errors import InvalidInputError
from regnet_core.ops.ball_query import ball_query, ball_query_in_torch
from regnet_core.ops.box_query import Boxes, box_query, box_query_in_torch
from regnet_core.ops.buckets import point_buckets
from regnet_core.ops.farthest_points import farthest_points, farthest_points_in_torch
from regnet_core.ops.interpolation import (
    Interpolation,
    interpolate,
    three_nearest,
    three_nearest_in_torch,
    three_nearest_on_cpu,
)
from regnet_core.ops.neighbourhoods import Neighbourhoods, joined, offsets_from_centres


def as_lists(found: Neighbourhoods) -> list[list[int]]:
    return [sorted(part.tolist()) for part in found.indices.split(found.counts.tolist())]


def same(a: Neighbourhoods, b: Neighbourhoods) -> bool:
    return as_lists(a) == as_lists(b)


def test_farthest_points_of_a_line() -> None:
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [10, 0, 0]])
    assert farthest_points_in_torch(line, 3).tolist() == [0, 4, 3]
    assert farthest_points_in_torch(line, 3, start=4).tolist() == [4, 0, 3]


@pytest.mark.parametrize("count", [1, 2, 100, 600])
@pytest.mark.parametrize("size", [600, 513, 512])
def test_farthest_points_by_the_definition(size: int, count: int) -> None:
    cloud = tabletop(size)
    drawn = farthest_points(cloud, count)
    assert drawn[0] == 0
    assert torch.equal(drawn, plain_farthest_points(cloud, count, 0))
    assert torch.equal(drawn, farthest_points_in_torch(cloud, min(count, size)))
    assert torch.equal(drawn, farthest_points(cloud, count, point_buckets(cloud)))


def test_the_first_farthest_points_are_the_farthest_points_of_all_drawn() -> None:
    cloud = tabletop(3000)
    drawn = farthest_points(cloud, 1000)
    assert torch.equal(farthest_points_in_torch(cloud[drawn], 300), torch.arange(300))
    assert torch.equal(farthest_points(cloud, 300), drawn[:300])


def test_farthest_points_of_few_equal_and_no_points() -> None:
    assert farthest_points(torch.zeros(0, 3), 5).tolist() == []
    assert farthest_points(torch.ones(1, 3), 5).tolist() == [0]
    for size in (40, 2000):
        drawn = farthest_points(torch.ones(size, 3), 30)
        assert len(drawn) == 30 and drawn.min() >= 0 and drawn.max() < size
    with pytest.raises(InvalidInputError, match="must be 0 or more, got -1"):
        farthest_points(torch.zeros(4, 3), -1)
    with pytest.raises(InvalidInputError, match=r"\(N, 3\), got \(4, 2\)"):
        farthest_points(torch.zeros(4, 2), 1)


def test_offsets_are_those_from_each_centre() -> None:
    cloud = tabletop(2000)
    near, centres = ball_query(cloud, cloud[:400], 0.03, 16), cloud[:400]
    expected = (cloud[near.indices] - centres[near.centres()]) / 0.03
    torch.testing.assert_close(offsets_from_centres(cloud, centres, near, 0.03), expected, rtol=1e-6, atol=1e-7)
    nobody = Neighbourhoods(near.indices[:0], torch.zeros(3, dtype=torch.int64))
    assert offsets_from_centres(cloud, centres[:2], nobody, 1.0).shape == (0, 3)


def test_ball_query_by_hand() -> None:
    points = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [1.5, 0, 0], [9.0, 0, 0]])
    centres = torch.tensor([[1.0, 0, 0], [20.0, 0, 0], [0.0, 0, 0]])
    assert as_lists(ball_query(points, centres, 0.5, 8)) == [[1, 2, 3], [], [0, 1]]
    assert as_lists(ball_query(points, centres, 1.0, 3)) == [[0, 1, 2], [], [0, 1, 2]], "the first three in order"
    assert as_lists(ball_query(points, centres, 1.0, 1)) == [[0], [], [0]]


@pytest.mark.parametrize(("radius", "most"), [(0.01, 16), (0.03, 64), (0.1, 64), (0.1, 200), (0.5, 5000)])
def test_ball_query_on_cpu_in_torch_and_padded(radius: float, most: int) -> None:
    cloud = tabletop(4000)
    centres = cloud[:500]
    found = ball_query(cloud, centres, radius, most)
    assert same(found, ball_query_in_torch(cloud, centres, radius, most))
    assert same(found, ball_query(cloud, centres, radius, most, point_buckets(cloud)))
    padded = padded_ball_query(cloud, centres, radius, most)
    for own, row in zip(as_lists(found), padded, strict=True):
        assert own == sorted(set(row.tolist()))


def test_ball_query_of_nothing() -> None:
    nothing, some = torch.zeros(0, 3), torch.ones(2, 3)
    for query in (ball_query, ball_query_in_torch):
        assert as_lists(query(nothing, some, 0.1, 4)) == [[], []]
        assert query(some, nothing, 0.1, 4).offsets.tolist() == [0]


@pytest.mark.parametrize(("radius", "most"), [(0.0, 4), (float("nan"), 4), (0.1, 0)])
def test_ball_query_refuses_what_makes_no_sense(radius: float, most: int) -> None:
    with pytest.raises(InvalidInputError):
        ball_query(torch.zeros(3, 3), torch.zeros(3, 3), radius, most)


def test_neighbourhoods_of_several_clouds_are_joined() -> None:
    a = Neighbourhoods(torch.tensor([0, 1, 1]), torch.tensor([0, 2, 3]))
    b = Neighbourhoods(torch.tensor([2]), torch.tensor([0, 0, 1]))
    both = joined([a, b], [0, 5])
    assert as_lists(both) == [[0, 1], [1], [], [7]]
    assert both.centres().tolist() == [0, 0, 1, 3]
    assert as_lists(joined([b], [5])) == [[], [7]]


def test_neighbourhoods_in_tiles() -> None:
    all_of_them = Neighbourhoods(torch.arange(9), torch.tensor([0, 0, 2, 4, 8, 8, 9]))
    tiles = list(all_of_them.tiles(3))
    assert [(some.start, some.stop) for some, _ in tiles] == [(0, 2), (2, 3), (3, 4), (4, 6)]
    assert [as_lists(part) for _, part in tiles] == [[[], [0, 1]], [[2, 3]], [[4, 5, 6, 7]], [[], [8]]]
    assert list(Neighbourhoods(torch.arange(0), torch.tensor([0])).tiles(3)) == []


def test_box_query_by_hand() -> None:
    # X of the box is the world's Z: the point one above lies at x = 1 in the box's frame.
    rotation = torch.tensor([[[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]])
    points = torch.tensor([[5.0, 5, 6], [5, 5, 8], [6, 5, 6], [5, 5, 5]])
    corners = (torch.tensor([[0.0, -0.5, -0.5]]), torch.tensor([[2.0, 0.5, 0.5]]))
    found = box_query(points, Boxes(rotation, torch.tensor([[5.0, 5, 5]]), *corners), 8)
    assert as_lists(found) == [[0]], "the last point lies on the surface"


@pytest.mark.parametrize("most", [5, 1000])
def test_box_query_on_cpu_and_in_torch(most: int) -> None:
    cloud = tabletop(3000)
    rotation = torch.from_numpy(Rotation.random(200, rng=np.random.default_rng(0)).as_matrix()).float()
    translation = cloud[:200] + 0.02
    lower = -torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) * 0.05
    boxes = Boxes(rotation, translation, lower, lower + 0.06)
    found = box_query(cloud, boxes, most)
    assert same(found, box_query_in_torch(cloud, boxes, most)) and found.counts.max() > 4
    assert same(found, box_query(cloud, boxes, most, point_buckets(cloud)))


def test_interpolation_by_hand() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [50, 0, 0]])
    how = three_nearest(points, torch.tensor([[0.5, 0, 0], [1.0, 0, 0]]))
    assert how.indices.tolist() == [[0, 1, 2], [1, 0, 2]]
    near, far = 1 / 0.25, 1 / 4.25
    expected = torch.tensor([near, near, far]) / (2 * near + far)
    torch.testing.assert_close(how.weights[0], expected)
    torch.testing.assert_close(how.weights[1], torch.tensor([1.0, 0, 0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("few", [3, 4, 100, 1500])
def test_three_nearest_on_cpu_and_in_torch(few: int) -> None:
    cloud = tabletop(4000)
    queries = torch.cat([cloud, torch.tensor([[30.0, -20, 5]])])  # one of them far away
    indices, squared = three_nearest_on_cpu(cloud[:few], queries)
    other, expected = three_nearest_in_torch(cloud[:few], queries)
    torch.testing.assert_close(squared.double(), expected, rtol=1e-5, atol=1e-12)
    # Of points that are equally near to float32's last digit, either may come first.
    away = (cloud[indices].double() - queries[:, None].double()).square().sum(dim=2)
    torch.testing.assert_close(away, expected, rtol=1e-5, atol=1e-12)
    assert (indices == other).all(dim=1).double().mean() > 0.99
    both = three_nearest_on_cpu(cloud[:few], queries, point_buckets(cloud[:few]), point_buckets(queries))
    assert torch.equal(both[0], indices) and torch.equal(both[1], squared)
    values = torch.randn(few, 7, generator=torch.Generator().manual_seed(0))
    carried = interpolate(values, three_nearest(cloud[:few], cloud))
    torch.testing.assert_close(carried, plain_interpolation(values, cloud[:few], cloud))


@pytest.mark.parametrize("few", [1, 2])
def test_interpolation_from_fewer_than_three_points(few: int) -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0]])[:few]
    queries = torch.tensor([[0.25, 0, 0], [7.0, 0, 0]])
    for search in (three_nearest_on_cpu, three_nearest_in_torch):
        assert torch.isinf(search(points, queries)[1][:, few:]).all()
    carried = interpolate(torch.tensor([[1.0], [2.0]])[:few], three_nearest(points, queries))
    torch.testing.assert_close(carried[0], torch.tensor([1.0 if few == 1 else 1.1]))
    with pytest.raises(InvalidInputError, match="at least one point"):
        three_nearest(torch.zeros(0, 3), queries)


def test_gradients_of_interpolation() -> None:
    values = torch.randn(20, 4, dtype=torch.float64, requires_grad=True)
    cloud = tabletop(50)
    how = three_nearest(cloud[:20], cloud)
    how = Interpolation(how.indices, how.weights.double())
    assert torch.autograd.gradcheck(lambda v: interpolate(v, how), values)


def test_bfloat16_is_interpolated() -> None:
    cloud, values = tabletop(200), torch.randn(40, 8, generator=torch.Generator().manual_seed(0))
    how = three_nearest(cloud[:40], cloud)
    low = interpolate(values.bfloat16(), how)
    assert low.dtype == torch.bfloat16
    torch.testing.assert_close(low.float(), interpolate(values, how), atol=0.03, rtol=0.02)
