"""Streams whose stamps do not overlap: the message names the time scale, the zone or the unit."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coec.calibration.types import LidarFrame
from coec.io.recordings.clocks import clock_separation_text, clocks_text, header_clock_text, irregular_stamps_text
from coec.io.recordings.layouts import open_source
from coec.recording import stamped_text

BEGIN_NS, FRAMES_NS = 1_700_000_000_000_000_000, [k * 100_000_000 for k in range(20)]


def text(sweep_begin_ns: int, camera_begin_ns: int = BEGIN_NS, scale: int = 1) -> str:
    cameras = [camera_begin_ns + late for late in FRAMES_NS]
    return clocks_text(cameras, [sweep_begin_ns + late // scale for late in FRAMES_NS])


@pytest.mark.parametrize(
    ("offset_s", "cause"),
    [
        (37.0, "this is TAI - UTC"),
        (-37.0, "this is TAI - UTC"),
        (18.0, "this is GPS time - UTC"),
        (19.02, "this is TAI - GPS time"),
        (-7200.0, "whole hours, -2: one driver probably stamps in local time"),
        (-315_964_782.0, "GPS time, which counts from 1980"),
        (-315_964_800.0, "GPS time, which counts from 1980, lacks to time since 1970, without its leap seconds"),
    ],
)
def test_known_differences_are_named(offset_s: float, cause: str) -> None:
    assert cause in text(BEGIN_NS + round(offset_s * 1e9))


def test_units_and_the_start_of_a_computer_are_named() -> None:
    for factor, unit in ((10**3, "microseconds"), (10**6, "milliseconds"), (10**9, "seconds")):
        assert f"the stamps of one stream are probably {unit}" in text(BEGIN_NS // factor, scale=factor)
    assert "from the start of a computer" in text(123_456_000_000)


def test_an_offset_that_is_nothing_known_gets_no_cause() -> None:
    rng = np.random.default_rng(0)
    for offset_s in rng.uniform(40.0, 3500.0, 20):
        assert "images: the images begin at" in text(BEGIN_NS + round(offset_s * 1e9))


def test_both_begins_are_given_and_what_to_type() -> None:
    tai = text(BEGIN_NS + 37 * 10**9)
    assert "the images begin at 2023-11-14 22:13:20.000, the clouds at 2023-11-14 22:13:57.000" in tai
    assert "?lidar_offset=-37," in tai
    started = text(668_403_185_160)
    assert "the clouds at 668.403 s" in started
    assert "?lidar_offset=SECONDS," in started


def test_images_that_are_stamped_when_received_are_suspected() -> None:
    assert "stamped when it was received" in text(BEGIN_NS - 80_000_000, scale=10**6)


def test_a_known_difference_of_sparse_frames_is_named() -> None:
    cameras = [BEGIN_NS + round(1e9 * at_s) for at_s in (0.0, 12.3, 25.1, 36.4, 50.2, 61.0)]
    assert "37.000 s ahead of the images (this is TAI - UTC" in clocks_text(cameras, [t + 37 * 10**9 for t in cameras])
    assert "11.000 s behind" not in clocks_text(cameras[:2], [t + 37 * 10**9 for t in cameras[:2]])


def streams(offset_s: float, seconds: int = 90, late_s: float = 0.0) -> tuple[list[int], list[int]]:
    cameras = [BEGIN_NS + k * 1_000_000_000 for k in range(seconds)]
    return cameras, [stamp + round(offset_s * 1e9) + 10_000_000 for stamp in cameras[round(late_s) :]]


@pytest.mark.parametrize("late_s", [0.0, 3.0])
@pytest.mark.parametrize("offset_s", [37.0, -18.0, 3600.0])
def test_streams_that_overlap_but_begin_and_end_at_other_times(offset_s: float, late_s: float) -> None:
    cameras, sweeps = streams(offset_s, late_s=late_s)
    assert f"the clouds are {abs(offset_s):.3f} s" in clock_separation_text(cameras, sweeps)


@pytest.mark.parametrize("offset_s", [0.0, 0.08, -1.4, 3.0, 25.0, 60.0])
def test_other_streams_are_not(offset_s: float) -> None:
    cameras, sweeps = streams(offset_s)
    assert clock_separation_text(cameras, sweeps) == ""
    # A LiDAR that is switched on later or off earlier is of the same clock.
    assert clock_separation_text(cameras, cameras[37:]) == ""
    assert clock_separation_text(cameras, cameras[:-37]) == ""
    assert clock_separation_text(cameras[:2], sweeps[:2]) == ""


def test_sparse_streams_do_not_show_when_they_begin() -> None:
    sparse = [BEGIN_NS + k * 60_000_000_000 for k in range(10)]
    assert clock_separation_text(sparse, [stamp + 20_000_000 for stamp in sparse]) == ""


@pytest.mark.parametrize("folder", ["tamu_right_os", "tamu_right_vlp", "fisheye_lab_vlp16", "yoco_fisheye_bpearl"])
def test_real_streams_are_of_one_clock(folder: str, sample_data: Path) -> None:
    recording = open_source(str(sample_data / folder))
    assert clock_separation_text(recording.camera_stamps_ns, recording.sweep_stamps_ns) == ""


@pytest.mark.parametrize(
    ("begin_s", "offset_s", "expected"),
    [
        (0.0, 0.05, "half of a sweep: .* count from its begin, .* of its middle .*lidar_offset=-0.0500"),
        (0.0, 0.1, "a whole sweep: .* count from its begin, .* of its end .*lidar_offset=-0.1000"),
        (-0.1, -0.05, "half of a sweep: .* count from its end, .* of its middle .*lidar_offset=0.0500"),
        (-0.1, -0.1, "a whole sweep: .* count from its end, .* of its begin .*lidar_offset=0.1000"),
        (0.0, -0.05, "stamped when they are received"),
        (0.0, 0.075, "stamped when they are received"),
        (-0.05, 0.05, "stamped when they are received"),
    ],
)
def test_an_offset_of_half_a_sweep_is_that_of_its_stamp(begin_s: float, offset_s: float, expected: str) -> None:
    times_s = np.linspace(begin_s, begin_s + 0.1, 50, dtype=np.float32)
    sweep = LidarFrame(0, "lidar", np.ones((50, 3), np.float32), time_offset_s=times_s)
    assert re.search(expected, stamped_text(sweep, offset_s, 0.004))
    assert "received" in stamped_text(replace(sweep, time_offset_s=None), offset_s, 0.004)


# --- the times of receipt ---------------------------------------------------------------------------------------------

LAG_S = [0.02, 0.03, 0.05, 0.02, 0.04]


@pytest.mark.parametrize(
    ("lag_s", "first_s", "expected"),
    [
        (
            -37.0,
            1.6e9 + 37,
            "37.0 s ahead of the clock of the recorder, which those on /image follow (this is TAI",
        ),
        (18.0, 1.6e9 - 18, "18.0 s behind the clock of the recorder, which those on /image follow (this is GPS time"),
        (-7200.0, 1.6e9 + 7200, "7200.0 s ahead of the clock of the recorder, .*whole hours, \\+2"),
        (1.6e9 - 668.0, 668.0, "one stream counts from the start of a computer"),
        (25.0, 1.6e9 - 25, "25.0 s behind the clock of the recorder, which those on /image follow: let the driver of"),
    ],
)
def test_a_topic_whose_stamps_do_not_follow_the_recorder_is_named(lag_s: float, first_s: float, expected: str) -> None:
    lags_s = {"/image": LAG_S, "/points": [lag_s + late_s for late_s in LAG_S]}
    text = header_clock_text(lags_s, {"/image": 1.6e9, "/points": first_s})
    assert "the stamps on /points are" in text
    assert re.search(re.escape(expected) if "\\" not in expected else expected, text)


@pytest.mark.parametrize(
    "other_s",
    [
        LAG_S,
        [0.5 + late_s for late_s in LAG_S],  # an image that is compressed, or a slow network
        [-37.0, -37.0],  # too few
        [0.0, -10.0, -20.0, -30.0, -40.0],  # a tool wrote one time for all
    ],
)
def test_late_messages_and_times_of_no_recorder_show_no_other_clock(other_s: list[float]) -> None:
    assert header_clock_text({"/image": LAG_S, "/points": other_s}, {"/image": 1.6e9, "/points": 1.6e9}) == ""


def test_one_clock_that_is_not_the_recorders_does_no_harm() -> None:
    simulated = [1.6e9 + late_s for late_s in LAG_S]
    assert header_clock_text({"/image": simulated, "/points": simulated}, {"/image": 5.0, "/points": 5.0}) == ""
    assert header_clock_text({}, {}) == ""


def test_irregular_stamps_are_reported_and_lost_frames_are_not() -> None:
    rng = np.random.default_rng(2)
    regular = 10**18 + np.arange(200) * 100_000_000
    steady = regular + rng.integers(-5_000_000, 5_000_000, 200)
    jittered = np.sort(regular + rng.integers(-80_000_000, 80_000_000, 200))
    lossy = np.delete(steady, rng.choice(200, 60, replace=False))
    assert irregular_stamps_text({"camera": steady.tolist(), "LiDAR": lossy.tolist()}) == ""
    assert irregular_stamps_text({"camera": jittered[:15].tolist(), "LiDAR": []}) == ""
    text = irregular_stamps_text({"camera": steady.tolist(), "LiDAR": jittered.tolist()})
    assert re.match(r"The stamps of the LiDAR are irregular: at 1\d\.\d Hz, half of their intervals are 2\d ms", text)
