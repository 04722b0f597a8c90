"""The plot of error and health over a drive."""

from __future__ import annotations

import cv2
import numpy as np

from coec_lab.demo.demo_plots import timeline

SERIES = [(0.0, 0.0, "unknown"), (10.0, 0.05, "healthy"), (20.0, 3.0, "miscalibrated"), (30.0, 0.05, "healthy")]


def picture(series: list[tuple[float, float, str]], marks: list[tuple[float, str]]) -> np.ndarray:
    return np.asarray(cv2.imdecode(np.frombuffer(timeline(series, marks, 0.3, "title"), np.uint8), cv2.IMREAD_COLOR))


def test_every_state_has_its_ground() -> None:
    healthy = picture([(0.0, 0.0, "healthy"), (10.0, 0.0, "healthy")], [])
    red = picture([(0.0, 0.0, "miscalibrated"), (10.0, 0.0, "healthy")], [])
    middle = healthy.shape[0] // 3, healthy.shape[1] // 2
    blue, green, ground_red = (int(value) for value in healthy[middle])
    assert green > max(blue, ground_red)
    blue, green, ground_red = (int(value) for value in red[middle])
    assert ground_red > max(blue, green)


def test_equal_drives_give_equal_bytes_and_marks_are_rendered() -> None:
    marks = [(18.0, "knock")]
    assert timeline(SERIES, marks, 0.3, "title") == timeline(SERIES, marks, 0.3, "title")
    assert not np.array_equal(picture(SERIES, marks), picture(SERIES, []))
