"""`coec paper`: how a drive is cut."""

from __future__ import annotations

import numpy as np
import pytest

from coec_lab.commands.paper_experiments import windows_of


@pytest.mark.parametrize(
    ("seconds", "rate_hz", "slice_s", "count"),
    [(120, 10.0, 60.0, 2), (120, 1.0, 60.0, 2), (119, 10.0, 60.0, 1), (121, 10.0, 60.0, 2), (5, 1.0, 60.0, 1)],
)
def test_a_recording_of_two_minutes_has_two_windows_of_one(
    seconds: int, rate_hz: float, slice_s: float, count: int
) -> None:
    jitter_s = np.random.default_rng(3).uniform(-0.01, 0.01, round(seconds * rate_hz)) / rate_hz
    stamps_s = np.arange(round(seconds * rate_hz)) / rate_hz + jitter_s
    assert windows_of([round(1e9 * stamp) for stamp in stamps_s], slice_s) == count


def test_one_frame_is_one_window() -> None:
    assert windows_of([5], 60.0) == 1
