"""What the numbers of frames tell about loss."""

from __future__ import annotations

import numpy as np
import pytest

from coec.service.ingest.decoder import LATE_FRAMES, MAX_GAP, SequenceNumbers


def lost(*numbers: int) -> int:
    reported = SequenceNumbers()
    return sum(reported.lost_by(number) for number in numbers)


def test_a_number_that_never_comes_is_lost_once_it_is_late() -> None:
    assert lost(0, 1, 3) == 0
    assert lost(0, 1, *range(3, 4 + LATE_FRAMES)) == 1
    assert lost(0, 1, *range(3, 300)) == 1


def test_a_frame_that_was_overtaken_is_not_lost() -> None:
    assert lost(0, 2, 1, *range(3, 300)) == 0
    assert lost(0, *range(2, 2 + LATE_FRAMES), 1, *range(2 + LATE_FRAMES, 300)) == 0


def test_a_frame_that_comes_twice_changes_nothing() -> None:
    assert lost(0, 1, 2, 3, 1, 3, *range(4, 300)) == 0


def test_a_long_gap_is_counted_at_once_but_for_what_may_be_on_its_way() -> None:
    assert lost(0, 1001) == 1000 - LATE_FRAMES
    assert lost(0, *range(1001, 1200)) == 1000


def test_a_new_count_is_no_loss() -> None:
    assert lost(1000, 0, 1, 2) == 0
    assert lost(0, MAX_GAP + 1, MAX_GAP + 2) == 0
    assert lost(1000, 1002, 0, *range(1, 300)) == 1, "what the old one left out does not come any more"


@pytest.mark.fault("samples lost, doubled and out of order", "each is received or lost, never both")
@pytest.mark.parametrize("seed", range(5))
def test_what_is_sent_is_received_or_lost_in_whatever_order_it_comes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sent = 1 + np.flatnonzero(rng.random(2000) > 0.1)
    # No frame is overtaken by one that is LATE_FRAMES or more behind it.
    order = sent[np.argsort(sent + rng.uniform(0, LATE_FRAMES, len(sent)))]
    end = int(sent.max())
    assert lost(0, *map(int, order), *range(end + 1, end + 2 * LATE_FRAMES)) == end - len(sent)


def test_a_frame_that_was_lost_here_is_no_gap_as_well() -> None:
    reported = SequenceNumbers()
    losses = [reported.lost_by(number) for number in (0, 1)]
    reported.counted()  # number 2
    losses += [reported.lost_by(number) for number in (3, 4, *range(6, 60))]
    assert sum(losses) == 1, "number 5 only"


def test_a_gap_of_much_later_is_not_taken_for_what_somebody_else_sent() -> None:
    reported = SequenceNumbers()
    reported.lost_by(0)
    reported.counted()  # it had no number
    losses = [reported.lost_by(number) for number in range(1, 100)]
    losses += [reported.lost_by(number) for number in range(101, 200)]
    assert sum(losses) == 1
