"""Thinning: as many as asked for, the same every time, and no beat with the order in which things come."""

import numpy as np
import pytest

from coec.geometry.points import thinned

BEAMS = 16


@pytest.mark.parametrize(("count", "at_most"), [(0, 5), (1, 1), (7, 7), (7, 100), (1000, 1), (30_000, 3_000), (9, 0)])
def test_so_many_are_left_each_once_and_in_order(count: int, at_most: int) -> None:
    selected = thinned(count, at_most)
    assert len(selected) == min(count, at_most)
    assert (np.diff(selected) > 0).all()
    assert ((selected >= 0) & (selected < count)).all()


def test_all_are_left_where_there_are_no_more() -> None:
    assert thinned(7, 100).tolist() == list(range(7))


def test_the_counts_alone_decide_the_choice() -> None:
    first = thinned(28_000, 7_000).copy()
    thinned.cache_clear()
    np.testing.assert_array_equal(thinned(28_000, 7_000), first)


def test_nobody_can_change_what_others_get() -> None:
    with pytest.raises(ValueError, match="read-only"):
        thinned(100, 10)[0] = 3


@pytest.mark.parametrize("one_in", [2, 3, 4, 8, 16])
def test_every_beam_of_a_sweep_in_firing_order_keeps_its_share(one_in: int) -> None:
    """A VLP-16 fires its beams in turn: every second point is eight of them, every sixteenth is one."""
    beam = np.arange(28_800) % BEAMS
    left = np.bincount(beam[thinned(len(beam), len(beam) // one_in)], minlength=BEAMS)
    share = len(beam) / one_in / BEAMS
    # Four standard deviations of a draw without return.
    assert np.abs(left - share).max() < 4.0 * np.sqrt(share * (1.0 - 1.0 / one_in))


def test_every_part_of_a_sweep_keeps_its_share() -> None:
    left, _ = np.histogram(thinned(100_000, 20_000), 20, (0, 100_000))
    assert np.abs(left - 1_000).max() < 4.0 * np.sqrt(1_000 * 0.8)


def test_negative_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="negative"):
        thinned(-1, 3)
