"""Preparation of a camera's cloud."""

import numpy as np
import pytest

from regnet_core.errors import CloudError, InvalidInputError
from regnet_core.geometry import Box, pose_matrix, transform_points
from regnet_core.preprocessing import PreprocessingConfig, preprocess


def table(height: float = 0.75, count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)), np.full(count, height)])


def test_points_are_moved_to_the_target_frame() -> None:
    T_world_camera = pose_matrix([0.5, 0.0, 1.5], [-2.4, 0.0, 1.0])
    seen = transform_points(np.linalg.inv(T_world_camera), table())
    result = preprocess(seen, None, T_world_camera)
    np.testing.assert_allclose(result.points, table(), atol=1e-12)
    assert result.colors is None


def test_colours_follow_their_points_through_every_step() -> None:
    points = table()
    points[::7] = np.nan
    colors = np.zeros((len(points), 3), np.uint8)
    colors[:, 0] = np.nan_to_num(np.round((points[:, 0] + 0.4) * 300))
    config = PreprocessingConfig(Box((-0.2, -0.2, 0.0), (0.2, 0.2, 1.0)), voxel_size=0.01, max_points=200, seed=3)
    result = preprocess(points, colors, np.eye(4), config)
    assert result.colors is not None
    assert len(result.points) == len(result.colors) == 200
    np.testing.assert_array_equal(result.colors[:, 0], np.round((result.points[:, 0] + 0.4) * 300))
    assert (np.abs(result.points[:, :2]) <= 0.2).all()


def test_the_steps_account_for_every_point() -> None:
    points = np.concatenate([table(), np.full((50, 3), np.nan)])
    box = Box((-0.1, -1.0, 0.0), (0.1, 1.0, 1.0))
    result = preprocess(points, None, np.eye(4), PreprocessingConfig(box, max_points=100))
    steps = {step.name: step for step in result.steps}
    inside = int((np.abs(table()[:, 0]) <= 0.1).sum())
    assert (steps["valid points"].kept, steps["valid points"].rejected) == (4000, 50)
    assert (steps["workspace"].kept, steps["workspace"].rejected) == (inside, 4000 - inside)
    assert (steps["down-sampling"].kept, steps["down-sampling"].rejected) == (100, inside - 100)
    assert result.reason == ""


def test_one_point_stays_in_each_voxel() -> None:
    result = preprocess(table(), None, np.eye(4), PreprocessingConfig(voxel_size=0.05))
    cells = np.floor(result.points / 0.05).astype(int)
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_the_same_seed_draws_the_same_points_and_another_seed_others() -> None:
    first, again, other = (
        preprocess(table(), None, np.eye(4), PreprocessingConfig(max_points=300, seed=seed)).points
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    ("points", "box", "reason"),
    [
        (np.zeros((0, 3)), None, "no points"),
        (np.full((7, 3), np.nan), None, "none of the cloud's 7 points"),
        (np.full((7, 3), 1e5), None, "none of the cloud's 7 points"),
        (table(), Box((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)), "all 4000 valid points lie outside the workspace"),
    ],
)
def test_when_nothing_is_left_the_reason_is_given(points: np.ndarray, box: Box | None, reason: str) -> None:
    result = preprocess(points, None, np.eye(4), PreprocessingConfig(box))
    assert result.points.shape == (0, 3)
    assert reason in result.reason


def test_input_that_makes_no_sense_is_refused() -> None:
    with pytest.raises(CloudError, match="shape"):
        preprocess(np.zeros((5, 2)), None, np.eye(4))
    with pytest.raises(InvalidInputError, match="voxel_size"):
        PreprocessingConfig(voxel_size=-0.1)
    with pytest.raises(InvalidInputError, match="max_points"):
        PreprocessingConfig(max_points=-1)


@pytest.mark.parametrize("shape", [(5, 3), (4000, 4), (12000,)])
def test_colours_that_do_not_match_the_points_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(CloudError, match=r"colors must have shape \(4000, 3\)"):
        preprocess(table(), np.zeros(shape, np.uint8), np.eye(4))


@pytest.mark.parametrize("transform", [np.eye(3), np.full((4, 4), np.nan), "eye", None, [[1, 2], [3]]])
def test_a_transform_that_is_none_is_refused(transform: object) -> None:
    with pytest.raises(InvalidInputError, match="T_target_source must"):
        preprocess(table(), None, transform)
