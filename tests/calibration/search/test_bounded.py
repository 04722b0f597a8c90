"""BOBYQA in a box, on a hill whose top is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.search.local_search import Box, maximum_in

TOP = np.array([0.4, -1.2])


def hill(points: NDArray[np.float64]) -> list[float]:
    return [float(np.exp(-((x - TOP) ** 2).sum())) for x in points]


def box(half: float, tolerance: float = 1e-6) -> Box:
    return Box(np.full(2, -half), np.full(2, half), np.full(2, 0.5), np.full(2, tolerance))


def test_the_top_is_detected() -> None:
    result, exhausted = maximum_in(box(3.0), hill, np.zeros(2), 200)
    np.testing.assert_allclose(result, TOP, atol=1e-5)
    assert not exhausted


def test_nothing_beyond_the_box_is_tried() -> None:
    visited: list[NDArray[np.float64]] = []

    def watched(points: NDArray[np.float64]) -> list[float]:
        visited.extend(points.copy())
        return hill(points)

    result, _ = maximum_in(box(1.0), watched, np.zeros(2), 200)
    assert np.abs(visited).max() <= 1.0
    np.testing.assert_allclose(result, [0.4, -1.0], atol=1e-4)


def test_a_box_too_narrow_for_the_first_step_is_searched_all_the_same() -> None:
    result, _ = maximum_in(box(0.1), hill, np.zeros(2), 200)
    np.testing.assert_allclose(result, [0.1, -0.1], atol=1e-6)


def test_evaluations_that_run_out_are_reported() -> None:
    assert maximum_in(box(3.0), hill, np.zeros(2), 8)[1]


@pytest.mark.parametrize(("coarse", "fine"), [(1e-1, 1e-3), (1e-3, 1e-6)])
def test_a_coarser_tolerance_takes_fewer_evaluations(coarse: float, fine: float) -> None:
    assert evaluations_to(coarse) < evaluations_to(fine)


def evaluations_to(tolerance: float) -> int:
    tried = 0

    def counted(points: NDArray[np.float64]) -> list[float]:
        nonlocal tried
        tried += len(points)
        return hill(points)

    maximum_in(box(3.0, tolerance), counted, np.zeros(2), 500)
    return tried


def test_what_does_not_depend_on_scores_is_requested_at_once_and_not_again() -> None:
    requested: list[NDArray[np.float64]] = []

    def watched(points: NDArray[np.float64]) -> list[float]:
        requested.append(points.copy())
        return hill(points)

    maximum_in(box(3.0), watched, np.zeros(2), 200)
    assert [len(points) for points in requested] == [5] + [1] * (len(requested) - 1)
    assert len(np.unique(np.concatenate(requested), axis=0)) == sum(map(len, requested))


def test_no_more_is_requested_than_may_be() -> None:
    requested: list[int] = []

    def watched(points: NDArray[np.float64]) -> list[float]:
        requested.append(len(points))
        return hill(points)

    assert maximum_in(box(3.0), watched, np.zeros(2), 3)[1]
    assert sum(requested) == 3
