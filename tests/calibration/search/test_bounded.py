"""BOBYQA in a box, on a hill whose top is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.search.bounded import Box, maximum_in

TOP = np.array([0.4, -1.2])


def hill(x: NDArray[np.float64]) -> float:
    return float(np.exp(-((x - TOP) ** 2).sum()))


def box(half: float, tolerance: float = 1e-6) -> Box:
    return Box(np.full(2, -half), np.full(2, half), np.full(2, 0.5), np.full(2, tolerance))


def test_the_top_is_found() -> None:
    found, exhausted = maximum_in(box(3.0), hill, np.zeros(2), 200)
    np.testing.assert_allclose(found, TOP, atol=1e-5)
    assert not exhausted


def test_nothing_outside_of_the_box_is_tried() -> None:
    visited: list[NDArray[np.float64]] = []

    def watched(x: NDArray[np.float64]) -> float:
        visited.append(x.copy())
        return hill(x)

    found, _ = maximum_in(box(1.0), watched, np.zeros(2), 200)
    assert np.abs(visited).max() <= 1.0
    np.testing.assert_allclose(found, [0.4, -1.0], atol=1e-4)


def test_a_box_too_narrow_for_the_first_step_is_searched_all_the_same() -> None:
    found, _ = maximum_in(box(0.1), hill, np.zeros(2), 200)
    np.testing.assert_allclose(found, [0.1, -0.1], atol=1e-6)


def test_evaluations_that_run_out_are_told() -> None:
    assert maximum_in(box(3.0), hill, np.zeros(2), 8)[1]


@pytest.mark.parametrize(("coarse", "fine"), [(1e-1, 1e-3), (1e-3, 1e-6)])
def test_a_coarser_tolerance_takes_fewer_evaluations(coarse: float, fine: float) -> None:
    assert evaluations_to(coarse) < evaluations_to(fine)


def evaluations_to(tolerance: float) -> int:
    tried = 0

    def counted(x: NDArray[np.float64]) -> float:
        nonlocal tried
        tried += 1
        return hill(x)

    maximum_in(box(3.0, tolerance), counted, np.zeros(2), 500)
    return tried
