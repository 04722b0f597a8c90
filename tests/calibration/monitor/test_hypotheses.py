"""Tests of a move: what each of them may claim."""

from __future__ import annotations

from math import radians

import pytest

from coec.calibration.monitor.change_detector import ROTATIONS
from coec.calibration.monitor.sequential_tests import (
    STAY,
    CheckMeasurement,
    Hypotheses,
    Hypothesis,
    OffsetPosterior,
    Three,
    after_check,
)

NOISE, PLACE, RIG = (radians(0.05) ** 2,) * 3, (radians(0.07) ** 2,) * 3, (radians(0.12) ** 2,) * 3
KNOWN: Three = (1e-9, 1e-9, 1e-9)
EVIDENCE, MOST = 14.0, 16.0


def at(degrees: float) -> Three:
    return radians(degrees), 0.0, 0.0


def evidence_after(seen_deg: float, right_deg: float, age: float) -> float:
    """Of an old test that took the mount to have moved to where the next check sees it, too."""
    reported = CheckMeasurement(at(seen_deg), NOISE, PLACE, PLACE, RIG, at(seen_deg), weak=False)
    rig = OffsetPosterior(at(0.0), KNOWN)
    test = Hypothesis(
        1, age, EVIDENCE, OffsetPosterior(at(seen_deg), KNOWN), OffsetPosterior(at(right_deg), KNOWN), rig
    )
    leading = after_check(Hypotheses(rig, (test,), reported.before), reported, ROTATIONS, 1.0, MOST).leading
    assert leading is not None
    return leading.evidence


@pytest.mark.fault(
    "a place where all checks are off, then others where none is",
    "no evidence is left for a move to where the mount has always been",
)
def test_a_move_to_where_the_mount_was_is_none() -> None:
    """Both sides had followed the place, and the side without a move comes back from it more slowly."""
    assert evidence_after(0.0, right_deg=0.5, age=100.0) == 0.0


def test_a_move_keeps_its_evidence() -> None:
    assert evidence_after(0.5, right_deg=0.0, age=100.0) > EVIDENCE


def test_what_one_place_may_explain_several_do_not() -> None:
    """A small displacement that lasts for hours is a move."""
    short, long = (evidence_after(0.15, right_deg=0.15, age=age) for age in (STAY, 20.0 * STAY))
    assert short < 1.0
    assert long == pytest.approx(EVIDENCE, abs=0.1)
