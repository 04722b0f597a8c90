"""Climbs along what an assumption and the pose that answers it leave: a ridge, which may have dents."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.uncertainty.nuisance_parameters import (
    BEGINS,
    PRINCIPAL_POINT,
    SIZE,
    AssumedEdges,
    ParameterSubset,
    ends_along,
    local_ascent,
)

SUMMIT = np.array([0.016, -0.012])
"""Where the principal point is, in focal lengths from where it was assumed."""


def ridge(dent: float) -> AssumedEdges:
    """A level on which significance falls from the summit as it does for a principal point that a turn answers, by a
    few units, with dents of this depth every five thousandths of a focal length."""

    def significances(deviations: NDArray[np.float64]) -> NDArray[np.float64]:
        off = (deviations[:, list(PRINCIPAL_POINT)] - SUMMIT) / 0.01
        dents = np.cos(2.0 * np.pi * deviations[:, list(PRINCIPAL_POINT)] / 0.005)
        return np.asarray(60.0 - 0.4 * np.sum(off * off, axis=1) + dent * np.sum(dents, axis=1))

    level: Any = SimpleNamespace(frames=SimpleNamespace(camera=SimpleNamespace(width=700)), significances=significances)
    return cast(AssumedEdges, level)


def options() -> ParameterSubset:
    """The principal point, and nothing else, is set free; half a thousandth moves the edges by a pixel beyond the turn
    that answers it."""
    directions = np.zeros((SIZE, 2))
    directions[list(PRINCIPAL_POINT), [0, 1]] = 1.0
    return ParameterSubset(directions, np.full(2, 5e-4), tuple(PRINCIPAL_POINT), np.eye(2))


def off(end: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(end[list(PRINCIPAL_POINT)] - SUMMIT))


def test_a_dent_holds_one_ascent_and_not_all_of_them() -> None:
    dented, start = ridge(0.5), np.zeros(SIZE)
    led, *others = ends_along(PRINCIPAL_POINT, [dented], options(), start)
    assert off(led) > 0.015
    assert len(others) == BEGINS
    assert min(off(end) for end in others) < 0.007


def test_a_ridge_without_dents_has_one_end() -> None:
    for end in ends_along(PRINCIPAL_POINT, [ridge(0.0)], options(), np.zeros(SIZE)):
        assert off(end) == pytest.approx(0.0, abs=2e-3)


def test_what_no_pose_answers_has_one_ascent() -> None:
    (end,) = ends_along((), [ridge(0.5)], options(), np.zeros(SIZE))
    np.testing.assert_array_equal(end, local_ascent([ridge(0.5)], options(), np.zeros(SIZE)))
