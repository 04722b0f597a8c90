"""False alarms of a fleet: added up from what its pairs said last."""

from __future__ import annotations

import pytest

from coec.fleet.report import false_alarms
from coec.schemas.heartbeat import LastWord
from coec.schemas.replies import Alarms
from support.messages import heartbeat


def _told(vehicle: str, hours: float, confirmed: int, withdrawn: int) -> LastWord:
    return heartbeat(
        vehicle, alarms=Alarms(watched_s=3600.0 * hours, confirmed=confirmed, withdrawn=withdrawn, open=False)
    )


def test_a_rate_with_its_bound_and_the_pairs_that_have_most() -> None:
    told = false_alarms([_told("v1", 150, 2, 0), _told("v2", 30, 0, 1), _told("v3", 20, 1, 2), heartbeat("v4")])
    assert (told.pairs, told.watched_h, told.confirmed, told.withdrawn) == (3, 200.0, 3, 3)
    assert told.per_100_h == pytest.approx(1.5)
    # Three events are at most 7.75 in one draw of twenty (tables of the Poisson distribution).
    assert told.per_100_h_at_most == pytest.approx(0.5 * 7.75, rel=0.02)
    assert list(told.by_pair.items()) == [("v3/front", 2), ("v2/front", 1)]


def test_hours_without_an_alarm_bound_the_rate() -> None:
    told = false_alarms([_told("v1", 300, 0, 0)])
    assert told.per_100_h == 0.0
    assert told.per_100_h_at_most == pytest.approx(1.0, rel=0.03)


def test_nobody_watched() -> None:
    told = false_alarms([heartbeat("v1")])
    assert (told.pairs, told.per_100_h, told.per_100_h_at_most) == (0, None, None)
