"""What is remembered over a restart: states bit for bit, of the same rig only; results line by line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coec.adapters.state_store import History, StateStore
from coec.adapters.wire import result_of
from coec.calibration.lifecycle import PairState, Provenance, Status, after_estimate, after_failure, initial_state
from coec.calibration.values import (
    Decision,
    Estimate,
    Metric,
    Optimum,
    Reason,
    Rig,
    StopReason,
    Verdict,
)
from coec.errors import StateError
from coec.geometry import se3
from coec.geometry.cameras import build

RIG = Rig(
    "front",
    build("pinhole", width=4, height=3, fx=2.0, fy=2.0, cx=1.5, cy=1.0),
    "camera",
    "lidar",
    se3.perturbation(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])),
    np.eye(4),
)


def estimate(window: int, decision: Decision = Decision.ACCEPTED) -> Estimate:
    rng = np.random.default_rng(window)
    return Estimate(
        window_id=f"front-{window}",
        data_stamp_ns=window,
        pairs=3,
        optimum=Optimum(
            se3.perturbation(rng.normal(size=6)),
            score=float(rng.normal()),
            score_at_start=float(rng.normal()),
            mi=float(rng.normal()),
            overlap=float(rng.normal()),
            points_in_view=5,
            evaluations=6,
            stop_reason=StopReason.TOLERANCE,
            first_derivative=np.append(rng.normal(size=3), 3 * [np.nan]),
            second_derivative=np.append(rng.normal(size=3), 3 * [np.nan]),
        ),
        verdict=Verdict(decision, (Metric("mi", 1 / 3, 0.1, True),), ()),
        correction=rng.normal(size=6),
        sigma=np.full(6, np.nan),
        solved=np.arange(6) < 3,
        compensation={"done": 3},
        depth_identity="precomputed",
        config_hash="c" * 16,
    )


def restarted(folder: Path, rig: Rig = RIG) -> PairState | None:
    remembered = StateStore(folder, "test").recall(rig)
    return remembered.state if remembered else None


def test_a_state_comes_back_bit_for_bit_and_says_that_it_was_restored(tmp_path: Path) -> None:
    state = after_estimate(after_estimate(initial_state(RIG), estimate(1)), estimate(2, Decision.FAILED))
    StateStore(tmp_path, "test").remember(RIG, after_failure(state, Reason("worker_failed", "crash")), 77)
    remembered = StateStore(tmp_path, "test").recall(RIG)
    assert remembered is not None
    assert remembered.evaluated_wall_ns == 77
    back = remembered.state
    assert np.array_equal(back.T_camera_lidar, estimate(1).optimum.T_camera_lidar)
    assert (back.provenance, back.status, back.valid_from_ns) == (Provenance.RESTORED, Status.FAILED, 1)
    assert back.failures == (Reason("worker_failed", "crash"),)
    assert back.latest is not None
    assert back.accepted is not None
    for kept, made in ((back.latest, estimate(2, Decision.FAILED)), (back.accepted, estimate(1))):
        assert result_of(kept, RIG, "test") == result_of(made, RIG, "test")
        assert np.array_equal(kept.correction, made.correction)


def test_pairs_do_not_touch_each_other(tmp_path: Path) -> None:
    rear = replace(RIG, pair="rear")
    store = StateStore(tmp_path, "test")
    store.remember(RIG, after_estimate(initial_state(RIG), estimate(1)), None)
    store.remember(rear, initial_state(rear), None)
    front, back = restarted(tmp_path), restarted(tmp_path, rear)
    assert front is not None
    assert front.status is Status.ACCEPTED
    assert back is not None
    assert back.status is Status.NOT_ACCEPTED


def test_the_state_of_another_rig_is_not_used(tmp_path: Path) -> None:
    StateStore(tmp_path, "test").remember(RIG, after_estimate(initial_state(RIG), estimate(1)), None)
    assert restarted(tmp_path, replace(RIG, T_camera_lidar_nominal=np.eye(4))) is None
    assert restarted(tmp_path, replace(RIG, pair="other")) is None


def test_an_intact_file_of_another_form_is_an_error(tmp_path: Path) -> None:
    store = StateStore(tmp_path, "test")
    store._file.save({"pairs": {"front": {"matrix": 1}}})
    with pytest.raises(StateError, match="another form"):
        StateStore(tmp_path, "test").recall(RIG)


def test_history_keeps_the_newest_over_a_restart_and_its_file_stays_bounded(tmp_path: Path) -> None:
    path = tmp_path / "history.jsonl"
    history = History(path, limit=3)
    for window in range(20):
        history.append(result_of(estimate(window), RIG, "test"))
    assert [result.data_stamp_ns for result in history.results()] == [17, 18, 19]
    assert History(path, limit=3).results() == history.results()
    assert len(path.read_bytes().splitlines()) <= 6


def test_a_damaged_line_costs_its_result_only(tmp_path: Path) -> None:
    path = tmp_path / "history.jsonl"
    history = History(path, limit=5)
    for window in range(3):
        history.append(result_of(estimate(window), RIG, "test"))
    lines = path.read_bytes().splitlines(keepends=True)
    lines[1] = lines[1].replace(b'"pairs":3', b'"pairs":4')
    path.write_bytes(b"".join(lines) + b"half a li")
    again = History(path, limit=5)
    assert [result.data_stamp_ns for result in again.results()] == [0, 2]
    assert again.damaged == 2
