"""What counts as watched, and which alarms were false."""

from __future__ import annotations

from itertools import pairwise

import pytest

from coec.calibration.state_machine import GAP_NS, AlarmRecord, HealthState

S = 1_000_000_000
HEALTHY, SUSPECT, RED = HealthState.HEALTHY, HealthState.SUSPECT, HealthState.MISCALIBRATED


@pytest.mark.parametrize(
    ("stamps", "watched_s"),
    [
        pytest.param((0, 5 * S, 10 * S), 10, id="in turn"),
        pytest.param((None, 5 * S, 10 * S), 5, id="the first"),
        pytest.param((0, 5 * S, 5 * S + 2 * GAP_NS, 10 * S + 2 * GAP_NS), 10, id="parked between"),
        pytest.param((100 * S, 20 * S, 25 * S), 5, id="the clock stepped back"),
        pytest.param((0, 5 * S, 5 * S), 5, id="the same data"),
    ],
)
def test_what_lies_between_checks_was_watched(stamps: tuple[int | None, ...], watched_s: int) -> None:
    record = AlarmRecord()
    for before, after in pairwise(stamps):
        record = record.watched(before, after)
    assert record.watched_ns == watched_s * S


@pytest.mark.parametrize(
    ("entered", "counted"),
    [
        pytest.param([(SUSPECT, False), (HEALTHY, False)], (0, 0, False), id="a suspicion is no alarm"),
        pytest.param([(RED, False), (RED, False)], (0, 0, True), id="one alarm goes on"),
        pytest.param([(RED, False), (HEALTHY, False)], (0, 1, False), id="it was false"),
        pytest.param(
            [(RED, False), (SUSPECT, False), (RED, False), (HEALTHY, False)], (0, 1, False), id="one that wavers is one"
        ),
        pytest.param([(RED, False), (HEALTHY, True)], (1, 0, False), id="a window repaired it"),
        pytest.param(
            [(RED, False), (HealthState.UNKNOWN, True), (HEALTHY, False)], (1, 0, False), id="a person replaced it"
        ),
        pytest.param(
            [(RED, False), (RED, True), (HEALTHY, False)], (1, 1, False), id="what replaced it is accused in turn"
        ),
        pytest.param([(HEALTHY, True), (HEALTHY, True)], (0, 0, False), id="drift is followed without an alarm"),
    ],
)
def test_alarms_end_confirmed_or_withdrawn(
    entered: list[tuple[HealthState, bool]], counted: tuple[int, int, bool]
) -> None:
    record = AlarmRecord()
    for health, replaced in entered:
        record = record.entered(health, replaced=replaced)
    assert (record.confirmed, record.withdrawn, record.accused) == counted
