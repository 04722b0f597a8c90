"""The plot of error and health over a drive."""

from __future__ import annotations

import cv2
import numpy as np

from coec.reports.page import Charts
from coec_lab.demo.pair_client import PairOutcome
from coec_lab.demo.pair_report import error_curve
from coec_lab.experiments.plots import charts

SERIES = [(0.0, 0.0, "unknown"), (10.0, 0.05, "healthy"), (20.0, 3.0, "miscalibrated"), (30.0, 0.05, "healthy")]
OUTCOME = PairOutcome(15.0, None, 20.0, 25.0, 3.0, 0.05, "healthy")


def plotted(series: list[tuple[float, float, str]], outcome: PairOutcome) -> bytes:
    return charts(Charts((error_curve(series, outcome),)), "title", 1, (11.0, 4.6))


def picture(series: list[tuple[float, float, str]], outcome: PairOutcome = OUTCOME) -> np.ndarray:
    return np.asarray(cv2.imdecode(np.frombuffer(plotted(series, outcome), np.uint8), cv2.IMREAD_COLOR))


def test_every_state_has_its_ground() -> None:
    healthy = picture([(0.0, 0.0, "healthy"), (30.0, 0.0, "healthy")])
    red = picture([(0.0, 0.0, "miscalibrated"), (30.0, 0.0, "healthy")])
    middle = healthy.shape[0] // 2, healthy.shape[1] // 4
    blue, green, ground_red = (int(value) for value in healthy[middle])
    assert green > max(blue, ground_red)
    blue, green, ground_red = (int(value) for value in red[middle])
    assert ground_red > max(blue, green)


def test_equal_drives_give_equal_bytes_and_what_happened_is_marked() -> None:
    assert plotted(SERIES, OUTCOME) == plotted(SERIES, OUTCOME)
    never = PairOutcome(15.0, None, None, None, 3.0, 3.0, "healthy")
    assert not np.array_equal(picture(SERIES), picture(SERIES, never))
