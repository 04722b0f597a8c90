"""The change detector on streams of checks whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from coec.config import MonitorConfig
from coec_lab.experiments import alarm_statistics

CONFIG = MonitorConfig()


def test_a_right_mount_is_accused_no_more_often_than_is_stated() -> None:
    for row in alarm_statistics.false_alarms(CONFIG, 1.0):
        assert row.alarms <= 1.0 + 3.0 * np.sqrt(row.driven_h / row.stated_h)


@pytest.mark.slow
def test_a_right_mount_is_not_accused_in_a_hundred_hours() -> None:
    for row in alarm_statistics.false_alarms(CONFIG, 100.0):
        assert row.alarms <= row.driven_h / row.stated_h


@pytest.mark.parametrize(("step_deg", "within_s"), [(0.5, 60.0), (1.0, 20.0), (3.0, 30.0), (7.0, 60.0)])
def test_a_step_is_confirmed_after_a_few_checks(step_deg: float, within_s: float) -> None:
    delay = alarm_statistics.delay(CONFIG, step_deg, 4)
    assert max(delay.confirmed_s) <= within_s
    assert all(suspect <= confirmed for suspect, confirmed in zip(delay.suspect_s, delay.confirmed_s, strict=True))


def test_what_streets_differ_by_is_not_noticed() -> None:
    assert alarm_statistics.delay(CONFIG, 0.05, 1).confirmed_s == (np.inf,)


@pytest.mark.slow
def test_a_creep_of_a_tenth_of_a_degree_an_hour_is_noticed_within_some_hours() -> None:
    assert max(alarm_statistics.creep(CONFIG).confirmed_h) < 6.0


def test_same_stream_same_evidence() -> None:
    assert alarm_statistics.delay(CONFIG, 1.0, 1) == alarm_statistics.delay(CONFIG, 1.0, 1)


@pytest.mark.parametrize(("off_deg", "share"), [(0.5, 0.95), (1.0, 1.0), (3.0, 1.0)])
def test_of_a_mount_that_is_wrong_from_the_first_check_a_window_is_requested_soon(off_deg: float, share: float) -> None:
    """Whether the mount is wrong or the estimator off by half a degree on this rig, checks alone cannot tell for sure:
    a window has to, and soon."""
    expected_s = alarm_statistics.from_start(CONFIG, off_deg, 40).requested_s
    assert np.median(expected_s) <= 4 * CONFIG.period_s
    assert np.mean(np.isfinite(expected_s)) >= share


def test_of_most_right_rigs_none_is_requested_in_their_first_minute() -> None:
    assert np.mean(np.isfinite(alarm_statistics.from_start(CONFIG, 0.0, 20).requested_s)) <= 0.25
