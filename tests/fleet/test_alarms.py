"""False alarms of a fleet: added up from what its pairs said last."""

from __future__ import annotations

import pytest

from coec.fleet.report import false_alarms
from coec.schemas.heartbeat import LastWord
from coec.schemas.replies import Alarms
from support.messages import heartbeat


def _reported(vehicle: str, hours: float, confirmed: int, withdrawn: int) -> LastWord:
    return heartbeat(
        vehicle, alarms=Alarms(watched_s=3600.0 * hours, confirmed=confirmed, withdrawn=withdrawn, open=False)
    )


def test_a_rate_with_its_bound_and_the_pairs_that_have_most() -> None:
    reported = false_alarms(
        [_reported("v1", 150, 2, 0), _reported("v2", 30, 0, 1), _reported("v3", 20, 1, 2), heartbeat("v4")]
    )
    assert (reported.pairs, reported.watched_h, reported.confirmed, reported.withdrawn) == (3, 200.0, 3, 3)
    assert reported.per_100_h == pytest.approx(1.5)
    # Three events are at most 7.75 in one draw of twenty (tables of the Poisson distribution).
    assert reported.per_100_h_at_most == pytest.approx(0.5 * 7.75, rel=0.02)
    assert list(reported.by_pair.items()) == [("v3/front", 2), ("v2/front", 1)]


def test_hours_without_an_alarm_bound_the_rate() -> None:
    reported = false_alarms([_reported("v1", 300, 0, 0)])
    assert reported.per_100_h == 0.0
    assert reported.per_100_h_at_most == pytest.approx(1.0, rel=0.03)


def test_nobody_watched() -> None:
    reported = false_alarms([heartbeat("v1")])
    assert (reported.pairs, reported.per_100_h, reported.per_100_h_at_most) == (0, None, None)
