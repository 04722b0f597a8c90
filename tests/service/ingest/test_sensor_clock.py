"""Extrapolated sensor time: the same slices at any rate, nothing while pairs come."""

from __future__ import annotations

import pytest

from coec.calibration.types import NS_PER_S
from coec.service.timing import MIN_SILENCE_S, SILENT_GAPS, SensorClock


@pytest.mark.parametrize("rate", [0.5, 1.0, 20.0, 400.0])
def test_time_runs_on_at_the_rate_of_the_replay(rate: float) -> None:
    clock = SensorClock()
    for index in range(10):
        clock.observe(index * 100_000_000, 50.0 + index * 0.1 / rate)
    last_s = 50.0 + 0.9 / rate
    silence_s = max(MIN_SILENCE_S, SILENT_GAPS * 0.1 / rate)
    assert clock.silent_now_ns(last_s + 0.9 * silence_s) is None
    now_ns = clock.silent_now_ns(last_s + 1.1 * silence_s)
    assert now_ns is not None
    assert now_ns / NS_PER_S == pytest.approx(0.9 + 1.1 * silence_s * rate)
    assert clock.rate_hz == pytest.approx(10.0)


def test_pauses_of_a_slow_stream_are_no_silence() -> None:
    clock = SensorClock()
    for index in range(4):
        clock.observe(index * 13 * NS_PER_S, index * 13.0)
    assert clock.silent_now_ns(39.0 + 2 * 13.0) is None
    assert clock.silent_now_ns(39.0 + 3 * 13.0) == 78 * NS_PER_S


def test_without_a_pair_there_is_no_time_and_with_one_it_runs_like_the_wall() -> None:
    clock = SensorClock()
    assert clock.silent_now_ns(1e9) is None
    assert clock.rate_hz is None
    clock.observe(7 * NS_PER_S, 100.0)
    assert clock.silent_now_ns(110.0) == 17 * NS_PER_S


def test_a_step_back_starts_anew() -> None:
    clock = SensorClock()
    for stamp_s, wall_s in ((100, 0.0), (200, 1.0), (5, 2.0), (6, 3.0)):
        clock.observe(stamp_s * NS_PER_S, wall_s)
    assert clock.silent_now_ns(13.0) == 16 * NS_PER_S


def test_a_burst_does_not_run_away() -> None:
    clock = SensorClock()
    for index in range(3):
        clock.observe(index * NS_PER_S, 1.0)
    assert clock.silent_now_ns(11.0) == 12 * NS_PER_S
