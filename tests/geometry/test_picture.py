"""Figures of an image, held against plain NumPy."""

import numpy as np
import pytest

from coec.geometry.images import connected_groups, level_counts, neighbour_differences, square_sums

GREY = np.random.default_rng(6).integers(0, 256, (47, 70), np.uint8)


@pytest.mark.parametrize("side", [1, 4, 8])
def test_sums_of_squares(side: int) -> None:
    rows, columns = GREY.shape[0] // side, GREY.shape[1] // side
    whole = GREY[: rows * side, : columns * side].astype(np.int64)
    expected = whole.reshape(rows, side, columns, side).sum(axis=(1, 3))
    np.testing.assert_array_equal(square_sums(GREY, side), expected)


def test_differences_are_those_of_every_second_row() -> None:
    rows, columns = 5, 4
    height, width = GREY.shape[0] // rows, GREY.shape[1] // columns
    whole = GREY[: rows * height, : columns * width].astype(np.int64)
    separation = np.zeros(whole.shape, np.int64)
    separation[:, :-1] += np.abs(np.diff(whole, axis=1))
    separation[:-1] += np.abs(np.diff(whole, axis=0))
    blocks = separation.reshape(rows, height, columns, width)[:, ::2]
    np.testing.assert_allclose(neighbour_differences(GREY, rows, columns), blocks.mean(axis=(1, 3)))


@pytest.mark.parametrize("step", [1, 4])
def test_levels_are_counted_as_numpy_counts_them(step: int) -> None:
    grey = np.random.default_rng(3).integers(0, 256, (37, 53)).astype(np.uint8)
    expected = np.bincount(grey[::step, ::step].ravel(), minlength=256)
    assert level_counts(grey, step).tolist() == expected.tolist()


def test_a_flat_image_has_none() -> None:
    assert not neighbour_differences(np.full((36, 64), 9, np.uint8), 18, 32).any()


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4, 0.55, 1.0])
def test_groups_are_those_of_a_flood(share: float) -> None:
    cells = np.random.default_rng(round(10 * share)).random((31, 44)) < share
    expected = np.zeros(cells.shape, np.int64)
    groups = 0
    for start in zip(*np.nonzero(cells), strict=True):
        if expected[start]:
            continue
        groups += 1
        flooded = [start]
        while flooded:
            y, x = flooded.pop()
            if 0 <= y < 31 and 0 <= x < 44 and cells[y, x] and not expected[y, x]:
                expected[y, x] = groups
                flooded += [(y + dy, x + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    np.testing.assert_array_equal(connected_groups(cells), expected)
