"""Which sweeps make a look: by their stamps alone, bounded, and refused by cause."""

from __future__ import annotations

import random

import numpy as np
import pytest

from coec.calibration.rig.lidar_sampling import (
    CANDIDATES_HELD,
    PAIRS,
    SWEEPS_HELD,
    MissedSweep,
    SampledSweeps,
    SweepSampler,
    SweepSet,
)
from coec.calibration.types import EgoMotion, LidarFrame

NS = 1_000_000_000
POINTS = np.ones((2, 3), np.float32)
Arrival = tuple[str, int]


def sampler(**more: bool) -> SweepSampler:
    return SweepSampler(15.0, 0.2, 300.0, 0.5, **more)


def push(of: SweepSampler, stream: str, stamp_ns: int, *, speed_mps: float = 5.0, timed: bool = True) -> SampledSweeps:
    if stream == "ego":
        return of.push_motion(EgoMotion(stamp_ns, "ego", (speed_mps, 0.0, 0.0), (0.0, 0.0, 0.0)))
    sweep = LidarFrame(stamp_ns, stream, POINTS, time_offset_s=np.zeros(2, np.float32) if timed else None)
    return of.push_a(sweep) if stream == "a" else of.push_b(sweep)


def arrivals(until_s: float, phase_ns: int = 30_000_000) -> list[Arrival]:
    """Both at 10 Hz, b `phase_ns` later, ego-motion at 20 Hz."""
    ticks = range(round(10 * until_s))
    return sorted(
        [("a", tick * NS // 10) for tick in ticks]
        + [("b", tick * NS // 10 + phase_ns) for tick in ticks]
        + [("ego", tick * NS // 20) for tick in range(round(20 * until_s))],
        key=lambda one: one[1],
    )


def stamps(result: SampledSweeps) -> list[tuple[int, int]]:
    return [
        (pair.a.stamp_ns, pair.b.stamp_ns)
        for observation in result
        if isinstance(observation, SweepSet)
        for pair in observation.pairs
    ]


def test_a_observation_is_of_two_pairs_at_the_beginning_of_each_period() -> None:
    of = sampler()
    result = [one for stream, stamp_ns in arrivals(40.0) for one in push(of, stream, stamp_ns)]
    near_ns = 30_000_000
    expected = [at_s * NS for at_s in (0, 2, 15, 17, 30, 32)]
    assert stamps(result) == [(at_ns, at_ns + near_ns) for at_ns in expected]
    assert (result[1].start_ns, result[1].stamp_ns) == (15 * NS, 17 * NS)  # type: ignore[union-attr]
    assert not of.losses


@pytest.mark.parametrize("seed", range(5))
def test_the_order_in_which_streams_come_changes_nothing(seed: int) -> None:
    rng = random.Random(seed)
    late_ns = {stream: rng.randrange(900_000_000) for stream in ("a", "b", "ego")}
    mixed = sorted(arrivals(50.0), key=lambda one: one[1] + late_ns[one[0]])
    result, of = [], sampler()
    for stream, stamp_ns in mixed:
        result += push(of, stream, stamp_ns)
        assert of.held <= SWEEPS_HELD + CANDIDATES_HELD + 2 * PAIRS
    plain = [one for each in [sampler()] for stream, at_ns in arrivals(50.0) for one in push(each, stream, at_ns)]
    assert stamps(result) == stamps(plain)


@pytest.mark.fault("one of two LiDARs falls silent", "a bounded number of sweeps of the other is kept")
@pytest.mark.parametrize("silent", ["a", "b", "ego"])
def test_what_is_held_is_bounded_whatever_falls_silent(silent: str) -> None:
    of, most, result = sampler(), 0, []
    for stream, stamp_ns in arrivals(100.0):
        if stream != silent:
            result += push(of, stream, stamp_ns)
            most = max(most, of.held)
    assert most <= SWEEPS_HELD + CANDIDATES_HELD
    assert {one.cause for one in result if isinstance(one, MissedSweep)} == {"a": set(), "b": {"no_sweep"}}.get(
        silent, {"no_ego_motion"}
    )


def test_a_standing_vehicle_and_points_without_time_are_missed_by_cause() -> None:
    of, result = sampler(), []
    for stream, stamp_ns in arrivals(10.0):
        result += push(of, stream, stamp_ns, speed_mps=0.1)
    assert [one.cause for one in result if isinstance(one, MissedSweep)] == ["standing", "standing"]
    of, result = sampler(timed_a=True), []
    for stream, stamp_ns in arrivals(10.0):
        result += push(of, stream, stamp_ns, timed=stream != "a")
    assert len(stamps(result)) == PAIRS
    of, result = sampler(timed_b=True), []
    for stream, stamp_ns in arrivals(10.0):
        result += push(of, stream, stamp_ns, timed=stream != "a")
    assert [one.cause for one in result if isinstance(one, MissedSweep)] == ["no_point_time"] * 2


def test_sensor_time_that_steps_back_begins_anew() -> None:
    of = sampler()
    for stream, stamp_ns in arrivals(16.0):
        push(of, stream, 1000 * NS + stamp_ns)
    result = [one for stream, stamp_ns in arrivals(10.0) for one in push(of, stream, 5 * NS + 10 * NS + stamp_ns)]
    # Five frames have to agree on the new time, which are half a second.
    assert stamps(result) == []
    result = [one for stream, stamp_ns in arrivals(10.0) for one in push(of, stream, 30 * NS + stamp_ns)]
    assert [a_ns for a_ns, _ in stamps(result)] == [30 * NS, 32 * NS]


def test_a_single_stamp_from_another_time_harms_nothing() -> None:
    of, result = sampler(), []
    for stream, stamp_ns in arrivals(40.0):
        if stream == "a" and stamp_ns == 15 * NS:
            result += push(of, "a", 9000 * NS)
            result += push(of, "a", -9000 * NS)
        result += push(of, stream, stamp_ns)
    assert [a_ns // NS for a_ns, _ in stamps(result)] == [0, 2, 15, 17, 30, 32]
