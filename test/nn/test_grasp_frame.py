"""Points and shapes as seen from grasps, against the definition."""

import pytest
import torch

from regnet_core.ops.grasp_frame import seen_from_grasps, seen_from_grasps_in_torch
from regnet_core.ops.local_shape import unique_entries
from regnet_core.ops.neighbourhoods import Neighbourhoods

NEAR = Neighbourhoods(torch.tensor([1, 4, 0, 1, 2, 3]), torch.tensor([0, 2, 2, 6]))
OWNERS = [0, 0, 2, 2, 2, 2]


def scene() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(1)
    points, translation = torch.randn(5, 3, generator=random), torch.randn(3, 3, generator=random)
    rotation = torch.linalg.qr(torch.randn(3, 3, 3, generator=random)).Q
    square = torch.randn(5, 3, 3, generator=random)
    return points, square + square.transpose(1, 2), rotation, translation


NOTHING = torch.zeros(3, 0)
both = pytest.mark.parametrize("look", [seen_from_grasps, seen_from_grasps_in_torch])


@both
def test_places_numbers_and_shapes_by_the_definition(look) -> None:  # type: ignore[no-untyped-def]
    points, shapes, rotation, translation = scene()
    carried = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    seen = look(points, shapes, rotation, translation, NEAR, 0.5, carried)
    for e, (row, g) in enumerate(zip(NEAR.indices.tolist(), OWNERS, strict=True)):
        r = rotation[g].double()
        place = r.T @ (points[row] - translation[g]).double() / 0.5
        shape = unique_entries((r.T @ shapes[row].double() @ r)[None])[0]
        expected = torch.cat([place, carried[g].double(), shape])
        torch.testing.assert_close(seen[e].double(), expected, atol=1e-5, rtol=1e-5)


@both
def test_without_shapes_and_without_points(look) -> None:  # type: ignore[no-untyped-def]
    points, shapes, rotation, translation = scene()
    with_shapes = look(points, shapes, rotation, translation, NEAR, 1.0, NOTHING)
    assert torch.equal(look(points, None, rotation, translation, NEAR, 1.0, NOTHING), with_shapes[:, :3])
    nothing = Neighbourhoods(torch.zeros(0, dtype=torch.int64), torch.zeros(4, dtype=torch.int64))
    assert look(points, shapes, rotation, translation, nothing, 1.0, NOTHING).shape == (0, 9)
