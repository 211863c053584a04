"""Closing of maps, against scipy."""

import numpy as np
import pytest
from scipy import ndimage

from regnet_core.ops.squares import closed_loop

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("reach", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("shape", [(30, 41), (3, 5), (1, 1), (12, 2)])
def test_heights_as_scipy_has_them(shape: tuple[int, int], reach: int) -> None:
    heights, size = RNG.random(shape), (2 * reach + 1,) * 2
    before = heights.copy()
    np.testing.assert_array_equal(closed_loop(heights, reach), ndimage.grey_closing(heights, size=size))
    np.testing.assert_array_equal(heights, before)


@pytest.mark.parametrize("reach", [1, 5])
def test_gaps_in_what_was_seen_are_closed(reach: int) -> None:
    seen = np.pad(RNG.random((40, 30)) > 0.9, reach + 1)
    expected = ndimage.binary_closing(seen, np.ones((3, 3)), iterations=reach)
    np.testing.assert_array_equal(closed_loop(seen.view(np.uint8), reach).view(bool), expected)
    assert expected.sum() > 1.5 * seen.sum()
