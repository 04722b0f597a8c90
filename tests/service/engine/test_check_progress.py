"""Whoever does not look is seen not to look, and the first thing on a frame's way that stands still is named."""

from __future__ import annotations

from dataclasses import replace

import pytest

from coec.calibration.types import Reason
from coec.service.engine.check_progress import Attempts, CheckProgress
from coec.service.ingest.decoder import CAMERA, LIDAR, StreamCounts
from coec.service.ingest.pair_stream import SelectionStatistics, StreamStatistics

S = 1_000_000_000
PERIOD_S = 5.0


def report(
    camera: int = 0,
    lidar: int = 0,
    refused: int = 0,
    pairs: int = 0,
    checks: int = 0,
    not_afforded: int = 0,
    unanswered: int = 0,
) -> StreamStatistics:
    streams = {CAMERA: StreamCounts(camera, camera - refused), LIDAR: StreamCounts(lidar, lidar)}
    selected = SelectionStatistics(checks=checks, not_afforded=not_afforded, unanswered=unanswered, last_ns=1000 * S)
    return StreamStatistics(streams=streams, pairs=pairs, selection=selected, pace=1.0)


BEGIN = report()
ALL = report(camera=100, lidar=100, pairs=100, checks=3)


def started() -> CheckProgress:
    progress = CheckProgress(PERIOD_S, 0.0, BEGIN)
    progress.completed(1000 * S, 100.0, BEGIN, acquits=True)
    return progress


def test_three_periods_on_the_steady_clock() -> None:
    progress = started()
    assert progress.overdue(ALL, 115.0, at_rest=False) is None
    late = progress.overdue(ALL, 115.1, at_rest=False)
    assert late is not None
    assert late.code == "overdue_worker"
    progress.completed(1015 * S, 116.0, ALL, acquits=True)
    assert progress.overdue(ALL, 117.0, at_rest=False) is None


@pytest.mark.fault("checks are completed, and none acquits the extrinsic", "after three periods the pair is not green")
def test_checks_that_do_not_acquit_renew_nothing() -> None:
    progress = started()
    for second in (105.0, 110.0, 114.0):
        progress.completed(round((900.0 + second) * S), second, ALL, acquits=False)
    assert progress.overdue(ALL, 115.0, at_rest=False) is None
    late = progress.overdue(ALL, 115.1, at_rest=False)
    assert late == Reason("not_acquitted", "Checks are completed, but none has confirmed the extrinsic for 15 s.")
    assert progress.overdue(ALL, 115.1, at_rest=True) is None, "the acquitting check of this place still counts"
    stopped = progress.overdue(ALL, 129.1, at_rest=True)
    assert stopped is not None
    assert stopped.text.startswith("No check has been completed for 15 s")


def test_on_the_clock_of_the_sensors_a_replay_may_run_ahead_of_the_answers_by_a_period_more() -> None:
    progress = started()
    ahead = replace(ALL, pace=10.0, selection=replace(ALL.selection, last_ns=1020 * S))
    assert progress.overdue(ahead, 101.0, at_rest=False) is None
    late = replace(ahead, selection=replace(ahead.selection, last_ns=1020 * S + 1))
    assert progress.overdue(late, 101.0, at_rest=False) is not None
    progress.time_stepped_back()
    assert progress.overdue(late, 101.0, at_rest=False) is None, "stamps of before tell nothing any more"


def test_a_replay_slower_than_the_drive_has_as_much_longer() -> None:
    half = replace(ALL, pace=0.5)
    assert started().overdue(half, 130.0, at_rest=False) is None
    assert started().overdue(half, 130.1, at_rest=False) is not None
    crawling = replace(ALL, pace=1e-6)
    assert started().overdue(crawling, 100.0 + 150.1, at_rest=False) is not None, (
        "slower than a tenth is standing still"
    )


@pytest.mark.fault("a stream that stops", "health names the first thing that stands still")
@pytest.mark.parametrize(
    ("now", "code", "word"),
    [
        (report(lidar=100), "data", "no camera frames"),
        (report(camera=100), "data", "no lidar frames"),
        (report(camera=100, refused=100, lidar=100), "data", "every camera frame is refused"),
        (report(camera=100, lidar=100), "pairing", "none belong together"),
        (report(camera=100, lidar=100, pairs=2), "data", "too few pairs"),
        (report(camera=100, lidar=100, pairs=100, unanswered=1), "worker", "a window is being solved"),
        (report(camera=100, lidar=100, pairs=100, not_afforded=3), "budget", "`budget.cores` does not suffice"),
        (ALL, "worker", "has not answered"),
    ],
)
def test_the_first_thing_that_stands_still_is_named(now: StreamStatistics, code: str, word: str) -> None:
    late = started().overdue(now, 116.0, at_rest=False)
    assert late is not None
    assert late.code == f"overdue_{code}"
    assert word in late.text


@pytest.mark.parametrize(
    ("failure", "code"),
    [
        ("bad_model", "depth"),
        ("worker_failed", "worker"),
        ("unsendable", "worker"),
        ("unanswered", "worker"),
        ("bad_input", "data"),
    ],
)
def test_a_failure_is_named_by_whose_it_is(failure: str, code: str) -> None:
    progress = started()
    progress.failed(Reason(failure, "It went wrong."))
    late = progress.overdue(ALL, 116.0, at_rest=False)
    assert late is not None
    assert (late.code, late.text) == (f"overdue_{code}", "No check has been completed for 16 s: It went wrong.")


def test_three_attempts_in_a_row_that_come_to_nothing_are_a_problem_and_one_that_does_ends_it() -> None:
    attempts = Attempts("windows", "windows_in_vain")
    for text in ("No edges.", "No edges."):
        attempts.failed(Reason("range_edges", text))
    assert attempts.problem is None
    attempts.failed(Reason("overlap", "Too little in view."))
    assert attempts.problem == Reason("windows_in_vain", "The last 3 windows gave no result. Too little in view.")
    attempts.succeeded()
    assert attempts.problem is None
    attempts.failed(Reason("overlap", "Too little in view."))
    assert attempts.problem is None, "it is counted from the beginning again"
