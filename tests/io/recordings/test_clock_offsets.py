"""Streams whose stamps do not overlap: the message names the time scale, the zone or the unit."""

from __future__ import annotations

import numpy as np
import pytest

from coec.io.recordings.window_cutting import clocks_text

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
        assert "images. The stamps" in text(BEGIN_NS + round(offset_s * 1e9))
