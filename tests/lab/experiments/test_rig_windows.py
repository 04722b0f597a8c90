"""Windows that pairs of a drawn rig are hurried to: of those that suspect, after a slice, and of one mount."""

from __future__ import annotations

from functools import cache
from math import radians

import numpy as np

from coec.geometry import se3
from coec_lab.experiments.rig_evidence import (
    FOUR,
    NS_PER_S,
    SLICE_S,
    TAKES_S,
    Happening,
    Lasting,
    TimedEvidence,
    moved,
    simulate_checks,
    urgent_evidence,
)

AT_S, UNTIL_S = 100.0, 1000.0
DRIVES = 4


@cache
def driven(number: int) -> tuple[Happening, list[TimedEvidence], list[TimedEvidence]]:
    """One whose front camera is knocked by 1°: what happens, the looks, and the windows."""
    rng = np.random.default_rng([41, number])
    after = moved(FOUR.poses, ("front",), radians(1.0), rng)
    drive = Happening(FOUR.poses, after, None, AT_S, UNTIL_S)
    checked = simulate_checks(FOUR, drive, rng)
    return drive, checked, urgent_evidence(FOUR, drive, checked, Lasting.of(FOUR, rng), rng)


def test_the_pair_that_was_displaced_has_windows_of_after_it_and_these_are_right() -> None:
    reported = 0
    for number in range(DRIVES):
        drive, _, windows = driven(number)
        edge = FOUR.graph.edge["front-roof"]
        for at_s, observation in windows:
            if observation.edge != edge.name or observation.stamp_ns < AT_S * NS_PER_S:
                continue
            reported += 1
            off = se3.difference(observation.T_a_b, se3.perturb(edge.T_a_b, drive.where(edge, at_s)))
            assert np.degrees(np.abs(off[:3]).max()) < 0.5, "of 1°"
    assert reported >= DRIVES


def test_a_window_is_known_a_slice_and_a_solve_after_the_pair_suspects_and_holds_no_move() -> None:
    for number in range(DRIVES):
        _, checked, windows = driven(number)
        assert windows == sorted(windows, key=lambda one: one[0])
        for at_s, observation in windows:
            begin_s = observation.stamp_ns / NS_PER_S
            assert SLICE_S + TAKES_S[0] <= at_s - begin_s <= SLICE_S + TAKES_S[1]
            suspecting = [one for at, one in checked if one.edge == observation.edge and abs(at - begin_s) < 1e-6]
            assert suspecting[0].stepped_ns is not None
            assert observation.edge != "front-roof" or not begin_s < AT_S <= begin_s + SLICE_S
