"""Disjoint halves: how they are drawn, and what is told of their differences."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec_lab.experiments.solve_statistics import SolveOutcome, Trial, compare, score, split
from lab.experiments.test_statistics import FAR, REFERENCE, _estimate, _xi


@pytest.mark.parametrize("available", [2, 5, 10, 25])
def test_halves_share_no_frame_and_are_of_equal_size(available: int) -> None:
    for trial in range(20):
        one, other = split(available, trial)
        assert len(one) == len(other) == available // 2
        assert not set(one) & set(other)
        assert set(one) | set(other) <= set(range(available))
        assert one == sorted(one)


def test_every_trial_splits_in_its_own_way_and_always_the_same() -> None:
    assert split(10, 3) == split(10, 3)
    assert len({tuple(split(10, trial)[0]) for trial in range(30)}) > 20


def test_one_frame_has_no_halves() -> None:
    with pytest.raises(ValueError, match="at least two"):
        split(1, 0)


def _finished(*deg: float, sigma_deg: float = 0.1, accepted: bool = True) -> SolveOutcome:
    estimate = _estimate(_xi(*deg), accepted, radians(sigma_deg))
    return score(Trial(FAR, estimate, 1.0), REFERENCE, 3)


def test_differences_and_their_cover_are_per_axis() -> None:
    halves = compare([(_finished(0.1, 0.0), _finished(-0.1, 0.5)), (_finished(0.0, 0.1), _finished(0.1, 0.1))], 5, 3)
    assert (halves.splits, halves.pairs, halves.solved, halves.accepted) == (2, 5, 2, 2)
    np.testing.assert_allclose(np.degrees(halves.rms[:3]), [np.sqrt(0.025), np.sqrt(0.125), 0.0], atol=2e-3)
    np.testing.assert_allclose(np.degrees(halves.largest[:3]), [0.2, 0.5, 0.0], atol=2e-3)
    np.testing.assert_allclose(np.degrees(halves.sigma[:3]), 0.1 * np.sqrt(2.0))
    np.testing.assert_array_equal(halves.covered[:3], [1.0, 0.5, 1.0])
    assert np.isnan(halves.rms[3:]).all()
    assert np.isnan(halves.covered[3:]).all()


def test_halves_that_claim_nothing_cover_nothing() -> None:
    halves = compare([(_finished(0.1, sigma_deg=np.nan), _finished(0.1))], 2, 3)
    assert halves.claimed.tolist() == [0] * 6
    assert np.isnan(halves.covered).all()
    assert np.isnan(halves.sigma).all()


def test_what_was_not_solved_or_not_accepted_is_counted() -> None:
    lost = replace(_finished(0.0), trial=Trial(FAR, None, 1.0), accepted=False)
    halves = compare([(lost, _finished(0.1)), (_finished(0.1), _finished(0.2, accepted=False))], 5, 3)
    assert (halves.splits, halves.solved, halves.accepted, halves.hits) == (2, 1, 0, 1)
    nothing = compare([(lost, lost)], 5, 3)
    assert nothing.solved == 0
    assert np.isnan(nothing.rms).all()


def test_three_sigma_cover_normal_noise() -> None:
    rng = np.random.default_rng(3)
    pairs = [(_finished(*rng.normal(0, 0.1, 3)), _finished(*rng.normal(0, 0.1, 3))) for _ in range(200)]
    halves = compare(pairs, 5, 3)
    assert (halves.covered[:3] > 0.98).all()
    np.testing.assert_allclose(halves.rms[:3], halves.sigma[:3], rtol=0.2)
