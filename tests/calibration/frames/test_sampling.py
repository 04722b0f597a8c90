"""Checks of the monitor: evenly over periods of sensor time, the same ones wherever the stream begins."""

from dataclasses import replace

import pytest

from coec.calibration.frames.window import CheckSampler, drives, stands
from coec.calibration.types import EgoMotion, FramePair, Window
from coec.config import MonitorConfig, WindowConfig

S = 1_000_000_000
CONFIG = MonitorConfig(period_s=5.0, pairs=5, min_pairs=4)


def at(street: Window, stamp_ns: int, speed_mps: float | None = 5.0) -> FramePair:
    pair = street.pairs[0]
    motion = None if speed_mps is None else EgoMotion(stamp_ns, "ego", (speed_mps, 0.0, 0.0), (0.0, 0.0, 0.0))
    return FramePair(replace(pair.camera, stamp_ns=stamp_ns), replace(pair.lidar, stamp_ns=stamp_ns), motion)


def checks(street: Window, stamps_s: list[float], speed_mps: float | None = 5.0) -> list[list[float]]:
    sampler = CheckSampler(CONFIG)
    offered = (sampler.offer(at(street, round(stamp * S), speed_mps)) for stamp in stamps_s)
    return [[pair.stamp_ns / S for pair in check] for check in offered if check is not None]


def test_ten_hertz_are_thinned_to_the_pairs_of_a_check_per_period(street: Window) -> None:
    made = checks(street, [100.0 + 0.1 * i for i in range(160)])
    assert made == [[100.0 + 5 * k + i for i in range(5)] for k in range(3)]


def test_a_stream_that_begins_in_the_middle_makes_the_same_checks_from_then_on(street: Window) -> None:
    stamps = [100.0 + 0.1 * i for i in range(210)]
    assert checks(street, stamps[73:])[-2:] == checks(street, stamps)[-2:]


@pytest.mark.fault("one frame pair in a period of the monitor", "a check in every period; checks share pairs")
def test_checks_of_a_slow_stream_share_pairs_so_that_one_ends_in_every_period(street: Window) -> None:
    assert checks(street, [100.0 + 3 * i for i in range(8)]) == [
        [100.0, 103.0, 106.0, 109.0],
        [100.0, 103.0, 106.0, 109.0, 112.0],
        [106.0, 109.0, 112.0, 115.0, 118.0],
    ]
    one_a_period = checks(street, [100.0 + 5 * i for i in range(12)])
    assert [check[-1] for check in one_a_period] == [115.0 + 5 * i for i in range(8)]
    assert {len(check) for check in one_a_period[1:]} == {5}


def test_a_standing_vehicle_is_checked_like_any_other(street: Window) -> None:
    stamps = [100.0 + 0.5 * i for i in range(60)]
    assert checks(street, stamps, speed_mps=0.0) == checks(street, stamps, speed_mps=5.0)
    window = WindowConfig(min_speed_mps=0.5)
    assert [stands(at(street, S, speed), window) for speed in (0.0, 0.4, 0.6, None)] == [True, True, False, False]


def test_a_vehicle_drives_where_most_pairs_know_that_it_does(street: Window) -> None:
    def driving(*speeds_mps: float | None) -> bool:
        return drives([at(street, S, speed_mps) for speed_mps in speeds_mps])

    assert driving(5.0, 5.0, 0.0)
    assert not driving(5.0, 0.0, 0.0)
    assert not driving(5.0, 5.0, None, None), "half of them is not most"
    assert not driving(0.9, 0.9)
    assert not driving()


def test_pairs_hours_from_each_other_are_not_one_check(street: Window) -> None:
    first = [100.0 + 0.5 * i for i in range(9)]
    assert checks(street, [*first, 8 * 3600.0]) == []
    separation = checks(street, [100.0, 131.0, 162.0, 193.0, 224.0, 255.0])
    assert separation == [], "no four of them lie within six periods"
    assert checks(street, [100.0, 107.0, 114.0, 121.0, 128.0]) == [[100.0, 107.0, 114.0, 121.0]]


def test_sensor_time_that_steps_back_starts_anew(street: Window) -> None:
    made = checks(street, [100.0 + 0.5 * i for i in range(9)] + [50.0 + 0.5 * i for i in range(12)])
    assert made == [[50.0, 51.0, 52.0, 53.0, 54.0]]
