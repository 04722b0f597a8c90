"""Values as the number of the share that they are in."""

from __future__ import annotations

import numpy as np
import pytest

from coec.geometry.mutual_information import share_of_pixels


@pytest.mark.parametrize(("edges", "narrow"), [(1, np.uint8), (31, np.uint8), (254, np.uint8), (255, np.uint16)])
def test_a_pixel_is_in_the_share_whose_edges_are_about_it(edges: int, narrow: type) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(7, 50)).astype(np.float32)
    usable = rng.random((7, 50)) < 0.8
    steps = np.sort(rng.normal(size=edges)).astype(np.float32)
    values[0, :5] = steps[0]  # on an edge: beyond it
    share = share_of_pixels(values, usable, steps)
    assert share.dtype == narrow
    expected = np.where(usable, np.searchsorted(steps, values, side="right"), edges + 1)
    np.testing.assert_array_equal(share[:-1].reshape(7, 50), expected)
    assert share[-1] == edges + 1


def test_what_is_no_number_is_in_no_share_unless_it_counts() -> None:
    values = np.array([[np.nan, 1.0], [np.inf, -np.inf]], np.float32)
    share = share_of_pixels(values, np.isfinite(values), np.array([0.0], np.float32))
    assert share.tolist() == [2, 1, 2, 2, 2]
