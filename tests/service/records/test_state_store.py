"""What is remembered over a restart: states bit for bit, of the same rig only; results line by line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coec.calibration.monitor.change_detector import MonitorOutcome, MonitorState
from coec.calibration.monitor.sequential_tests import Hypotheses, Hypothesis, OffsetPosterior
from coec.calibration.state import (
    CalibrationStatus,
    ExtrinsicHold,
    Health,
    PairRules,
    PairState,
    Provenance,
    after_estimate,
    after_failure,
    held,
    initial_state,
    overdue,
)
from coec.calibration.state_machine import AppliedChange, HealthState
from coec.calibration.types import Decision, LensEstimate, Reason, Rig
from coec.config import MonitorConfig, PolicyConfig, TrackerConfig
from coec.errors import StateError
from coec.io.serialise import result_of
from coec.io.storage import StateFile
from coec.service.records.state_store import Clocks, StateStore
from support.estimates import ESTIMATE_RIG, estimate

RULES = PairRules(PolicyConfig(apply="always"), TrackerConfig(), MonitorConfig())
NEVER = PairRules(PolicyConfig(apply="never"), TrackerConfig(), MonitorConfig())
CLOCKS = Clocks(77, 88, 99)
HEADS = {"results": "3 abc", "commands": "4 def"}


def saved(store: StateStore, rig: Rig, state: PairState, heads: dict[str, str]) -> None:
    store.update(rig, state, CLOCKS, lambda: heads)
    store.flush()


def restarted(folder: Path, rig: Rig = ESTIMATE_RIG) -> PairState | None:
    remembered = StateStore(folder, "test").load(rig)
    return remembered.state if remembered else None


def test_a_state_comes_back_bit_for_bit(tmp_path: Path) -> None:
    state = after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, RULES)
    state = after_estimate(state, estimate(2, Decision.FAILED), 0, RULES)
    saved(StateStore(tmp_path, "test"), ESTIMATE_RIG, after_failure(state, Reason("worker_failed", "crash")), HEADS)
    remembered = StateStore(tmp_path, "test").load(ESTIMATE_RIG)
    assert remembered is not None
    assert (remembered.clocks, remembered.history_heads) == (CLOCKS, HEADS)
    back = remembered.state
    assert np.array_equal(back.T_camera_lidar, estimate(1).optimum.T_camera_lidar)
    assert (back.provenance, back.status, back.valid_from_ns) == (Provenance.ESTIMATED, CalibrationStatus.FAILED, 1)
    assert back.failures == (Reason("worker_failed", "crash"),)
    assert back.latest is not None
    assert back.accepted is not None
    for retained, made in ((back.latest, estimate(2, Decision.FAILED)), (back.accepted, estimate(1))):
        assert result_of(retained, ESTIMATE_RIG, "test") == result_of(made, ESTIMATE_RIG, "test")
        assert np.array_equal(retained.correction, made.correction)
    assert (back.health, back.reasons, back.proven) == (HealthState.HEALTHY, (), True)


def test_what_was_known_before_nobody_checked_comes_back(tmp_path: Path) -> None:
    late = overdue(
        after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, RULES), Reason("overdue_worker", "No answer.")
    )
    saved(StateStore(tmp_path, "test"), ESTIMATE_RIG, late, HEADS)
    back = restarted(tmp_path)
    assert back is not None
    assert back.unseen_from == late.unseen_from == Health(HealthState.HEALTHY, ())


def test_what_waits_and_what_was_seen_come_back_to_the_byte(tmp_path: Path) -> None:
    hold = ExtrinsicHold(7, "operator", "the mirror is being changed")
    state = held(after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, NEVER), hold)
    posterior = OffsetPosterior((1 / 3, 0.1, -0.0), (1e-9, 0.2, 0.3), 0.7)
    tests = Hypotheses(posterior, (Hypothesis(1, 2.5, 1 / 7, posterior, posterior, posterior),), (0.1, 0.2, 0.3))
    monitor = MonitorState(
        MonitorOutcome.SUSPECT, tests, Hypotheses(), {"dark": 0.1}, {"40": 2.5}, 0.5, (5, 6), stood=True
    )
    state = replace(state, monitor=monitor, flagged_since_ns=4, changes=(AppliedChange(3, (0.1,) * 6),))
    saved(StateStore(tmp_path, "test"), ESTIMATE_RIG, state, {})
    first = (tmp_path / "state.json").read_bytes()
    back = restarted(tmp_path)
    assert back is not None
    assert (back.hold, back.monitor, back.flagged_since_ns, back.changes) == (hold, monitor, 4, state.changes)
    assert back.pending is not None
    assert back.pending.contradicts
    assert np.array_equal(back.pending.T_camera_lidar, estimate(1).optimum.T_camera_lidar)
    saved(StateStore(tmp_path, "test"), ESTIMATE_RIG, back, {})
    assert (tmp_path / "state.json").read_bytes() == first


def test_what_an_earlier_version_held_is_held_though_nobody_knows_by_whom(tmp_path: Path) -> None:
    store = StateStore(tmp_path, "test")
    saved(store, ESTIMATE_RIG, held(initial_state(ESTIMATE_RIG), ExtrinsicHold(7, "operator", "why")), {})
    del store._pairs[ESTIMATE_RIG.pair]["hold"]
    store.flush()
    back = restarted(tmp_path)
    assert back is not None
    assert back.hold == ExtrinsicHold()


def test_the_lens_of_a_window_comes_back_and_an_earlier_version_knew_none(tmp_path: Path) -> None:
    values = np.random.default_rng(5).normal(size=(4, 4))
    lens = LensEstimate(values[0], values[1], values[2], values[3], np.array([True, False, True, True]), 0.1)
    store = StateStore(tmp_path, "test")
    state = after_estimate(initial_state(ESTIMATE_RIG), replace(estimate(1), lens=lens), 0, RULES)
    saved(store, ESTIMATE_RIG, state, {})
    back = restarted(tmp_path)
    assert back is not None
    assert back.latest is not None
    assert back.latest.lens is not None
    np.testing.assert_array_equal(back.latest.lens.free_sigma, lens.free_sigma)
    for name in ("latest", "accepted"):
        del store._pairs[ESTIMATE_RIG.pair][name]["lens"], store._pairs[ESTIMATE_RIG.pair][name]["intrinsics"]["sha256"]
    store.flush()
    older = StateStore(tmp_path, "test").load(ESTIMATE_RIG)
    assert older is not None
    assert not older.lost
    assert older.state.latest is not None
    assert older.state.latest.lens is None


def test_pairs_do_not_touch_each_other(tmp_path: Path) -> None:
    rear = replace(ESTIMATE_RIG, pair="rear")
    store = StateStore(tmp_path, "test")
    saved(store, ESTIMATE_RIG, after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, RULES), {})
    saved(store, rear, initial_state(rear), {})
    front, back = restarted(tmp_path), restarted(tmp_path, rear)
    assert front is not None
    assert front.status is CalibrationStatus.ACCEPTED
    assert back is not None
    assert back.status is CalibrationStatus.NOT_ACCEPTED


@pytest.mark.fault("the state of another rig", "it is not used")
def test_the_state_of_another_rig_is_not_used(tmp_path: Path) -> None:
    saved(
        StateStore(tmp_path, "test"),
        ESTIMATE_RIG,
        after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, RULES),
        {},
    )
    assert restarted(tmp_path, replace(ESTIMATE_RIG, T_camera_lidar_nominal=np.eye(4))) is None
    assert restarted(tmp_path, replace(ESTIMATE_RIG, pair="other")) is None


def test_a_pair_without_a_single_known_field_is_as_at_a_first_start(tmp_path: Path) -> None:
    store = StateStore(tmp_path, "test")
    store._file.save({"pairs": {"front": {"matrix": 1}}})
    remembered = StateStore(tmp_path, "test").load(ESTIMATE_RIG)
    assert remembered is not None
    assert {lost.part for lost in remembered.lost} == {"rig", "extrinsic"}
    assert np.array_equal(remembered.state.T_camera_lidar, ESTIMATE_RIG.T_camera_lidar_nominal)
    assert remembered.state.health is HealthState.UNKNOWN


def test_a_pair_that_is_no_object_is_an_error(tmp_path: Path) -> None:
    StateStore(tmp_path, "test")._file.save({"pairs": {"front": 3}})
    with pytest.raises(StateError, match="no JSON object"):
        StateStore(tmp_path, "test").load(ESTIMATE_RIG)


@pytest.mark.fault(
    "a state with a pair that the service does not know, in an unknown form",
    "the pair stays as it is, and the state is written",
)
@pytest.mark.parametrize("foreign", [2, None, [], "x", {"history_heads": 1}])
def test_what_is_there_of_an_unknown_pair_stays(tmp_path: Path, foreign: object) -> None:
    StateStore(tmp_path, "test")._file.save({"pairs": {"": foreign}})
    saved(StateStore(tmp_path, "test"), ESTIMATE_RIG, initial_state(ESTIMATE_RIG), HEADS)
    assert restarted(tmp_path) is not None
    body = StateFile(tmp_path / "state.json").load().body
    assert body is not None
    assert body["pairs"][""] == foreign


ZERO = [[0.0] * 4] * 4
SHEARED = [[1.0, 0.1, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


LOST = {"T_camera_lidar": "extrinsic", "pending": "candidate", "accepted": "accepted estimate", "track": "track"}


@pytest.mark.fault("a state with a matrix that is no pose, checksum right", "it is not used; everything else is")
@pytest.mark.parametrize("rows", [ZERO, SHEARED], ids=["zero", "sheared"])
@pytest.mark.parametrize("where", LOST)
def test_a_forged_pose_is_not_used_whatever_its_checksum(tmp_path: Path, where: str, rows: list[list[float]]) -> None:
    served = after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, RULES)
    waiting = after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, NEVER)
    saved(StateStore(tmp_path, "test"), ESTIMATE_RIG, waiting if where == "pending" else served, HEADS)
    file = StateFile(tmp_path / "state.json")
    body = file.load().body
    assert body is not None
    stored = body["pairs"][ESTIMATE_RIG.pair]
    match where:
        case "T_camera_lidar":
            stored["T_camera_lidar"] = rows
        case "pending":
            stored["pending"]["T_camera_lidar"] = rows
        case "accepted":
            stored["accepted"]["camera_from_lidar"]["matrix"] = rows
        case _:
            stored["track"]["slow"]["T_camera_lidar"] = rows
    file.save(body)
    forged = (tmp_path / "state.json").read_bytes()
    store = StateStore(tmp_path, "test")
    remembered = store.load(ESTIMATE_RIG)
    assert remembered is not None
    (lost,) = remembered.lost
    assert (lost.part, lost.written_by) == (LOST[where], None)
    assert "no rigid transform" in lost.why
    back = remembered.state
    expected = ESTIMATE_RIG.T_camera_lidar_nominal if where in ("T_camera_lidar", "pending") else served.T_camera_lidar
    assert np.array_equal(back.T_camera_lidar, expected)
    assert (back.pending, back.latest is None) == (None, False)
    assert back.health is not HealthState.HEALTHY
    assert remembered.history_heads == HEADS
    saved(store, ESTIMATE_RIG, initial_state(ESTIMATE_RIG), {})
    assert (tmp_path / "state.json.broken").read_bytes() == forged
    assert restarted(tmp_path) is not None


@pytest.mark.fault("a forged state with invalid numbers and shapes", "the part of the state is lost, and no other")
@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("completed_wall_ns", -(10**4000), "clocks"),
        ("since_wall_ns", 10**400, "clocks"),
        ("T_camera_lidar", [[10**400] * 4] * 4, "extrinsic"),
        ("track", {"slow": []}, "track"),
        ("monitor", 3, "monitor"),
        ("changes", [{"stamp_ns": 1, "step": "x"}], "changes"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_numbers_and_shapes_that_nobody_wrote_cost_their_part_alone(
    tmp_path: Path, name: str, value: object, part: str
) -> None:
    saved(
        StateStore(tmp_path, "test"),
        ESTIMATE_RIG,
        after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, RULES),
        {},
    )
    file = StateFile(tmp_path / "state.json")
    body = file.load().body
    assert body is not None
    body["pairs"][ESTIMATE_RIG.pair][name] = value
    file.save(body)
    remembered = StateStore(tmp_path, "test").load(ESTIMATE_RIG)
    assert remembered is not None
    assert [lost.part for lost in remembered.lost] == [part]


@pytest.mark.fault("a forged state with corrections beyond all measure", "the estimate is not used; everything else is")
@pytest.mark.parametrize("name", ["correction_rad_m", "noise", "systematic"])
def test_a_result_beyond_all_measure_is_not_used(tmp_path: Path, name: str) -> None:
    saved(
        StateStore(tmp_path, "test"),
        ESTIMATE_RIG,
        after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, RULES),
        {},
    )
    file = StateFile(tmp_path / "state.json")
    body = file.load().body
    assert body is not None
    huge = [1e308] * 6
    beyond = {"correction_rad_m": huge, "noise": [huge] * 6, "systematic": {"stamps": huge}}
    body["pairs"][ESTIMATE_RIG.pair]["latest"][name] = beyond[name]
    file.save(body)
    remembered = StateStore(tmp_path, "test").load(ESTIMATE_RIG)
    assert remembered is not None
    assert [lost.part for lost in remembered.lost] == ["latest estimate"]
    assert remembered.state.latest is None
    assert np.array_equal(remembered.state.T_camera_lidar, estimate(1).optimum.T_camera_lidar)
