"""What is between the fingers, as points and as images: against brute force, and for shapes that a hand can compute."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core.baselines.closing_area import HALF_HEIGHT, ClosingAreas, closing_areas
from regnet_core.baselines.grasp_images import SIZE, VIEWS, grasp_images
from regnet_core.errors import InvalidInputError
from regnet_core.gripper import Gripper

GRIPPER = Gripper(width=0.08)


def areas(points: np.ndarray, normals: np.ndarray) -> ClosingAreas:
    """The area of a single hand, in its own units."""
    return ClosingAreas(np.asarray(points, np.float32), np.asarray(normals, np.float32), np.array([0, len(points)]))


def cloud(seed: int = 0, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    return rng.uniform(-0.1, 0.1, (count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def hands(count: int = 6) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.random(count, random_state=3).as_matrix(), np.random.default_rng(1).uniform(-0.05, 0.05, (count, 3))


# Closing areas


@pytest.mark.parametrize("width", [0.05, 0.12])
def test_areas_hold_what_is_between_the_fingers(width: float) -> None:
    (points, normals), (rotation, translation) = cloud(), hands()
    found = closing_areas(rotation, translation, Gripper(width=width), points, normals)
    assert len(found) == 6
    for g in range(6):
        own = (points - translation[g]) @ rotation[g]
        inside = (own[:, 0] > 0) & (own[:, 0] < 0.06) & (np.abs(own[:, 1]) < width / 2) & (np.abs(own[:, 2]) < 0.02)
        rows = slice(found.offsets[g], found.offsets[g + 1])
        unit = own[inside] / [0.06, width, 2 * HALF_HEIGHT] + [0.0, 0.5, 0.5]
        assert inside.sum() > 10
        # In any order.
        order, wanted = np.lexsort(found.points[rows].T), np.lexsort(unit.T)
        np.testing.assert_allclose(found.points[rows][order], unit[wanted], atol=1e-6)
        np.testing.assert_allclose(found.normals[rows][order], (normals[inside] @ rotation[g])[wanted], atol=1e-6)
    assert found.points.min() > 0.0 and found.points.max() < 1.0


def test_of_many_points_the_first_ones_are_kept() -> None:
    (points, normals), (rotation, translation) = cloud(), hands(1)
    everything = closing_areas(rotation, translation, GRIPPER, points, normals)
    few = closing_areas(rotation, translation, GRIPPER, points, normals, most=10)
    own = (points - translation[0]) @ rotation[0]
    unit = own / [GRIPPER.depth, GRIPPER.width, 2 * HALF_HEIGHT] + [0.0, 0.5, 0.5]
    first = unit[((unit > 0.0) & (unit < 1.0)).all(axis=1)][:10]
    assert len(everything.points) > 20 and few.points.shape == (10, 3)
    np.testing.assert_allclose(np.sort(few.points, axis=0), np.sort(first, axis=0), atol=1e-6)


def test_an_empty_area_has_no_points() -> None:
    rotation, translation = hands(2)
    found = closing_areas(rotation, translation + 5.0, GRIPPER, *cloud())
    assert len(found) == 2 and found.counts.tolist() == [0, 0]
    none = closing_areas(rotation[:0], translation[:0], GRIPPER, *cloud())
    assert len(none) == 0 and len(none.take(np.zeros(0, np.int64))) == 0


def test_areas_can_be_taken_and_joined() -> None:
    found = closing_areas(*hands(), GRIPPER, *cloud())
    some = found.take(np.array([4, 1, 4]))
    assert some.counts.tolist() == found.counts[[4, 1, 4]].tolist()
    np.testing.assert_array_equal(some.take(np.array([1])).points, found.take(np.array([1])).points)
    both = ClosingAreas.joined([found.take(np.arange(2)), found.take(np.arange(2, 6))])
    np.testing.assert_array_equal(both.points, found.points)
    np.testing.assert_array_equal(both.offsets, found.offsets)
    assert len(ClosingAreas.joined([])) == 0


def test_the_other_form_of_a_jaw_sees_the_same_from_the_other_side() -> None:
    (points, normals), (rotation, translation) = cloud(), hands()
    found = closing_areas(rotation, translation, GRIPPER, points, normals)
    turned = closing_areas(rotation * [1.0, -1.0, -1.0], translation, GRIPPER, points, normals)
    which = np.array([True, False, True, True, False, False])
    flipped = found.flipped(which)
    for g in range(6):
        expected = (turned if which[g] else found).take(np.array([g]))
        own = flipped.take(np.array([g]))
        np.testing.assert_allclose(own.points, expected.points, atol=1e-6)
        np.testing.assert_allclose(own.normals, expected.normals, atol=1e-6)


def test_areas_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="need a normal for each point"):
        ClosingAreas(np.zeros((3, 3)), np.zeros((2, 3)), np.array([0, 3]))
    with pytest.raises(InvalidInputError, match="offsets that end at their number"):
        ClosingAreas(np.zeros((3, 3)), np.zeros((3, 3)), np.array([0, 2]))


# Images


def test_a_point_becomes_nine_cells_in_each_view() -> None:
    """At (0.5, 0.25, 0.75) of the area, the normal (0.6, -0.8, 0): cells 30, 15 and 45 along x, y and z."""
    image = grasp_images(areas([[0.5, 0.25, 0.75]], [[0.6, -0.8, 0.0]]), 12)[0]
    cells = {0: 30, 1: 15, 2: 45}
    for view, (row, column, depth) in enumerate(((0, 1, 2), (2, 1, 0), (2, 0, 1))):
        assert tuple(VIEWS[view]) == (row, column, depth)
        layers = image[4 * view : 4 * view + 4]
        lit = np.zeros((SIZE, SIZE), bool)
        lit[cells[row] - 1 : cells[row] + 2, cells[column] - 1 : cells[column] + 2] = True
        assert (layers[3][lit] == 1.0).all()  # the only height is the largest one
        np.testing.assert_allclose(layers[0][lit], 0.75)  # 0.6 / 0.8: normals are divided by the largest component
        np.testing.assert_allclose(layers[1][lit], 1.0)
        assert (layers[2] == 0.0).all() and (layers[:, ~lit] == 0.0).all()


def test_a_plane_across_the_jaw_is_seen_from_every_side() -> None:
    """The plane x = 0.4 with the normal -x fills the view along x, and is a line of three cells in the others."""
    rng = np.random.default_rng(0)
    points = np.column_stack([np.full(60000, 0.4), rng.random((60000, 2))])
    image = grasp_images(areas(points, np.tile([-1.0, 0, 0], (60000, 1))), 12)[0]
    line = np.zeros(SIZE, bool)
    line[23:26] = True  # cell 24 and the ones beside it
    along_z, along_x, along_y = image[:4], image[4:8], image[8:]
    np.testing.assert_array_equal(along_z[0], np.tile(line[:, None], (1, SIZE)))  # rows are x
    np.testing.assert_array_equal(along_y[0], np.tile(line, (SIZE, 1)))  # columns are x
    assert (along_x[0] == 1.0).all()
    np.testing.assert_allclose(along_x[3], 1.0, atol=1e-6)  # all of one height
    assert (image[[1, 2, 5, 6, 9, 10]] == 0.0).all()  # no normal has a y or z


def test_a_box_between_the_fingers() -> None:
    """Its three visible faces: the top at x = 0.5, and the sides at y = 0.3 and y = 0.7, over all of z."""
    rng = np.random.default_rng(0)
    n = 40000
    top = np.column_stack([np.full(n, 0.5), rng.uniform(0.3, 0.7, n), rng.random(n)])
    low = np.column_stack([rng.uniform(0.5, 1.0, n), np.full(n, 0.3), rng.random(n)])
    high = np.column_stack([rng.uniform(0.5, 1.0, n), np.full(n, 0.7), rng.random(n)])
    normals = np.repeat([[-1.0, 0, 0], [0, -1.0, 0], [0, 1.0, 0]], n, axis=0)
    image = grasp_images(areas(np.concatenate([top, low, high]), normals), 12)[0]
    front = image[:4]
    # Away from the corner, cells next to a side have the whole |y|, and the middle of the top the whole |x|.
    np.testing.assert_allclose(front[1, 35:58, 18], 1.0)
    np.testing.assert_allclose(front[1, 35:58, 42], 1.0)
    np.testing.assert_allclose(front[0, 30, 22:38], 1.0)
    assert (front[:, :28] == 0.0).all() and (front[:, 33:, 21:40] == 0.0).all()
    # As the palm sees it, the top is nearest: a height of 0.5, against the sides' mean depth of 0.75.
    palm = image[4:8]
    np.testing.assert_allclose(palm[3, 10:50, 22:38], 1.0)
    assert (palm[3, :, :16] == 0.0).all() and (palm[3, :, 45:] == 0.0).all()
    np.testing.assert_allclose(palm[0, 10:50, 22:38], 1.0)
    # A finger sees the side and, through it, the other one: the mean depth is 0.5 wherever there is something.
    side = image[8:12]
    assert (side[3, :, :28] == 0.0).all()
    np.testing.assert_allclose(side[1, 10:50, 35:58], 1.0)


def test_normals_and_heights_are_averaged_in_a_cell() -> None:
    """Two points in one cell: |n| (0.8, 0.6, 0) and (0, 1, 0) make (0.4, 0.8, 0); depths 0.2 and 0.6 a height of 0.6.

    A third one, in another cell, has the height 1 - 0.25 = 0.75.
    """
    points = [[0.505, 0.505, 0.2], [0.51, 0.51, 0.6], [0.1, 0.1, 0.25]]
    image = grasp_images(areas(points, [[-0.8, 0.6, 0], [0, -1.0, 0], [0, 0, 1.0]]), 12)[0]
    np.testing.assert_allclose(image[:4, 30, 30], [0.4, 0.8, 0.0, 0.6 / 0.75], atol=1e-6)
    np.testing.assert_allclose(image[:4, 6, 6], [0.0, 0.0, 1.0, 1.0], atol=1e-6)


def test_three_channels_are_the_normals_of_the_first_view() -> None:
    found = closing_areas(*hands(), GRIPPER, *cloud())
    np.testing.assert_array_equal(grasp_images(found, 3), grasp_images(found, 12)[:, :3])


def test_images_stay_in_their_range_and_do_not_depend_on_the_others() -> None:
    found = closing_areas(*hands(40), GRIPPER, *cloud(count=20000))
    images = grasp_images(found, 12)
    assert images.shape == (40, 12, SIZE, SIZE) and images.dtype == np.float32
    assert images.min() == 0.0 and images.max() == 1.0
    np.testing.assert_array_equal(grasp_images(found.take(np.array([17])), 12)[0], images[17])


def test_the_edge_of_the_area_is_in_the_last_cell() -> None:
    image = grasp_images(areas([[1.0, 0.0, 1.0]], [[0.0, 0.0, 1.0]]), 3)[0]
    assert image[2, SIZE - 1, 0] == 1.0 and (image[2] > 0).sum() == 4


def test_an_empty_area_is_black() -> None:
    assert (grasp_images(areas(np.zeros((0, 3)), np.zeros((0, 3))), 12) == 0.0).all()
    assert grasp_images(ClosingAreas.joined([]), 3).shape == (0, 3, SIZE, SIZE)


def test_other_numbers_of_channels_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="grasp images have 3 or 12 channels, not 15"):
        grasp_images(ClosingAreas.joined([]), 15)
