"""What is served: never an estimate that was not accepted, never health that was not looked at."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce

import numpy as np
import pytest

from coec.calibration.monitor.change_detector import MonitorOutcome, MonitorState, Observation
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.state import (
    CalibrationStatus,
    CommandRefusedError,
    ExtrinsicHold,
    PairRules,
    PairState,
    Provenance,
    after_commissioning,
    after_estimate,
    after_failure,
    after_observation,
    aged,
    apply_pending,
    before_estimate,
    held,
    initial_state,
    overdue,
    released,
    reset,
    restored,
    rolled_back,
    time_stepped_back,
    urgent_window_since,
)
from coec.calibration.state_machine import HealthState
from coec.calibration.types import (
    Decision,
    Estimate,
    MovedWithin,
    Optimum,
    Reason,
    Rig,
    StopReason,
    Uncertainty,
    Verdict,
)
from coec.config import MonitorConfig, PolicyConfig, TrackerConfig
from coec.geometry import se3
from coec.geometry.cameras import build

S = 1_000_000_000
DAY_S = 86_400.0
LATE_NS = 10_000 * S
CRASH = Reason("worker_failed", "The worker crashed twice.")
OVERLAP = Reason("overlap", "too little")
KNOCK = Reason("moved_within_window", "the camera moved")

RULES = PairRules(PolicyConfig(), TrackerConfig(), MonitorConfig())
NEVER = PairRules(PolicyConfig(apply="never"), TrackerConfig(), MonitorConfig())

RIG = Rig(
    "front",
    build("pinhole", width=4, height=3, fx=2.0, fy=2.0, cx=1.5, cy=1.0),
    "camera",
    "lidar",
    se3.perturbation(np.array([0.1, -0.2, 0.3, 0.5, 0.0, 1.0])),
    np.eye(4),
)


def estimate(turned_deg: float, stamp_s: int = 100, decision: Decision = Decision.ACCEPTED) -> Estimate:
    """Of a window that ends at `stamp_s`: the camera is turned by so much in yaw from nominal."""
    xi = np.array([0.0, np.radians(turned_deg), 0.0, 0.0, 0.0, 0.0])
    reasons = () if decision is Decision.ACCEPTED else (OVERLAP,)
    return Estimate(
        window_id=f"front-{(stamp_s - 50) * S}",
        data_stamp_ns=stamp_s * S,
        pairs=20,
        optimum=Optimum(
            T_camera_lidar=se3.perturb(RIG.T_camera_lidar_nominal, xi),
            score=1.0,
            score_at_start=0.5,
            mi=0.5,
            overlap=0.9,
            points_in_view=1000,
            evaluations=50,
            stop_reason=StopReason.TOLERANCE,
            first_derivative=np.zeros(6),
            second_derivative=np.ones(6),
        ),
        verdict=Verdict(decision, (), reasons),
        correction=xi,
        uncertainty=Uncertainty.independent(np.array([5e-4] * 3 + [np.nan] * 3)),
        solved=np.arange(6) < 3,
        unobservable=np.zeros(6, np.bool_),
        compensation={},
        depth_identity="precomputed",
        config_hash="0",
    )


def solved(state: PairState, value: Estimate, rules: PairRules = RULES) -> PairState:
    return after_estimate(state, value, value.data_stamp_ns - 50 * S, rules)


def check(stamp_s: int, flagged: bool = False, cause: str | None = None) -> Observation:
    return Observation(
        stamp_ns=stamp_s * S,
        pair_stamps_ns=tuple((stamp_s - i) * S for i in range(4, -1, -1)),
        metrics=(),
        offset=np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]) if flagged else np.zeros(6),
        sigma=np.full(6, 1e-3),
        noise=np.full(6, 8e-4),
        place=np.full(6, 5e-4),
        dispersion=1.0,
        distance2=9.0 if flagged else 0.1,
        flagged=flagged,
        weak=False,
        flagged_by_paper=None,
        causes=() if cause is None else (CAUSES[cause],),
    )


def watched(state: PairState, *checks: Observation) -> PairState:
    return reduce(lambda before, one: after_observation(before, one, RULES), checks, state)


def flagged_from(stamp_s: int, count: int) -> list[Observation]:
    return [check(stamp_s + 5 * i, flagged=True) for i in range(count)]


def clear_from(stamp_s: int, count: int) -> list[Observation]:
    return [check(stamp_s + 5 * i) for i in range(count)]


HEALTHY = solved(initial_state(RIG), estimate(0.5))


def pose_of(value: Estimate) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return value.optimum.T_camera_lidar


# --- windows ----------------------------------------------------------------------------------------------------


def test_before_anything_the_nominal_extrinsic_is_served_and_health_is_unknown() -> None:
    state = initial_state(RIG)
    assert (state.provenance, state.status, state.health) == (
        Provenance.NOMINAL,
        CalibrationStatus.NOT_ACCEPTED,
        HealthState.UNKNOWN,
    )
    assert [reason.code for reason in state.reasons] == ["not_evaluated"]
    np.testing.assert_array_equal(state.T_camera_lidar, RIG.T_camera_lidar_nominal)


def test_the_first_accepted_estimate_is_served_to_the_last_bit() -> None:
    np.testing.assert_array_equal(HEALTHY.T_camera_lidar, pose_of(estimate(0.5)))
    assert (HEALTHY.provenance, HEALTHY.status, HEALTHY.health) == (
        Provenance.ESTIMATED,
        CalibrationStatus.ACCEPTED,
        HealthState.HEALTHY,
    )
    assert HEALTHY.valid_from_ns == 100 * S
    assert HEALTHY.reasons == ()


@pytest.mark.fault("an estimate that failed", "it is never served")
@pytest.mark.parametrize("before", [initial_state(RIG), HEALTHY])
def test_a_failed_estimate_is_never_served(before: PairState) -> None:
    state = solved(before, estimate(3.0, 300, Decision.FAILED))
    np.testing.assert_array_equal(state.T_camera_lidar, before.T_camera_lidar)
    assert (state.provenance, state.status) == (before.provenance, CalibrationStatus.FAILED)
    assert state.pending is None


@pytest.mark.parametrize(
    "code", ["overlap", "range_edges", "edge_contrast", "runner_up", "mi_over_unrelated", "sigma_deg"]
)
@pytest.mark.parametrize("before", [initial_state(RIG), HEALTHY, watched(HEALTHY, *flagged_from(200, 3))])
def test_a_window_that_cannot_decide_is_no_evidence(before: PairState, code: str) -> None:
    refused = estimate(3.0, 300, Decision.FAILED)
    verdict = Verdict(Decision.FAILED, (), (Reason(code, "too little"), Reason("newton_step_deg", "sloped")))
    state = solved(before, replace(refused, verdict=verdict))
    assert (state.health, state.reasons) == (before.health, before.reasons)


@pytest.mark.parametrize("code", [None, "runner_up", "edge_contrast", "range_edges", "overlap"])
def test_a_window_through_another_lens_degrades_the_pair_and_says_so(code: str | None) -> None:
    """Unless no pose stands out in it: then it says nothing of the lens, either."""
    others = () if code is None else (Reason(code, "too little"),)
    verdict = Verdict(Decision.FAILED, (), (Reason("intrinsics_off", "another lens"), *others))
    state = solved(HEALTHY, replace(estimate(3.0, 300, Decision.FAILED), verdict=verdict))
    np.testing.assert_array_equal(state.T_camera_lidar, HEALTHY.T_camera_lidar)
    if code in (None, "runner_up"):
        assert state.health is HealthState.DEGRADED
        assert [reason.code for reason in state.reasons] == ["intrinsics_off"]
    else:
        assert (state.health, state.reasons) == (HEALTHY.health, HEALTHY.reasons)


def moved_within(before_deg: float, after_deg: float, stamp_s: int = 300) -> Estimate:
    """A window that was refused as the camera turned within it; it was solved to the pose before."""
    refused = estimate(before_deg, stamp_s, Decision.FAILED)
    moved = MovedWithin(
        (stamp_s - 20) * S, (stamp_s - 18) * S, 7, pose_of(estimate(before_deg)), pose_of(estimate(after_deg))
    )
    return replace(refused, verdict=Verdict(Decision.FAILED, (), (KNOCK,)), moved=moved)


OBJECTED = replace(HEALTHY, flagged_since_ns=290 * S)
"""A check has something against the mount, which is no suspicion yet."""


def test_a_window_that_saw_a_knock_speaks_against_what_is_served_and_wants_the_next_one_soon() -> None:
    state = solved(OBJECTED, moved_within(0.5, 3.0))
    assert state.health is HealthState.SUSPECT
    assert state.reasons == (KNOCK,)
    assert np.array_equal(state.T_camera_lidar, HEALTHY.T_camera_lidar)
    assert urgent_window_since(state) == (300 - 18) * S


def test_a_step_within_a_window_counts_unless_a_later_check_acquits_or_the_data_are_at_fault() -> None:
    stepped = moved_within(0.5, 3.0)
    assert stepped.moved is not None
    assert solved(HEALTHY, stepped).health is HealthState.SUSPECT
    after_s = stepped.moved.first_after_ns // S + 1
    assert solved(watched(HEALTHY, check(after_s)), stepped).health is HealthState.HEALTHY
    assert solved(watched(HEALTHY, check(after_s, flagged=True)), stepped).health is HealthState.SUSPECT
    dazzled = replace(OBJECTED, monitor=MonitorState(blind={"open_field": 2.0}))
    assert solved(dazzled, stepped).health is HealthState.HEALTHY


def test_a_window_at_whose_end_the_camera_is_where_it_is_served_speaks_against_nothing() -> None:
    state = solved(HEALTHY, moved_within(3.0, 0.5))
    assert state.health is HealthState.HEALTHY
    assert urgent_window_since(state) is None


def test_a_window_that_cannot_decide_for_another_reason_is_no_cue_of_a_displacement() -> None:
    displaced = moved_within(0.5, 3.0)
    doubtful = replace(displaced, verdict=replace(displaced.verdict, reasons=(KNOCK, OVERLAP)))
    state = solved(HEALTHY, doubtful)
    assert state.health is HealthState.HEALTHY
    assert urgent_window_since(state) is None


def test_a_window_is_requested_no_longer_once_one_was_accepted_or_the_monitor_is_clear() -> None:
    displaced = solved(OBJECTED, moved_within(0.5, 3.0))
    assert urgent_window_since(solved(displaced, estimate(0.5, 400))) is None
    assert urgent_window_since(watched(displaced, *clear_from(310, 3))) is None


def test_the_monitor_reports_since_when_a_window_is_requested() -> None:
    state = watched(HEALTHY, *clear_from(200, 2), *flagged_from(300, 6))
    assert state.flagged_since_ns is not None
    assert urgent_window_since(state) == state.flagged_since_ns


def test_faint_checks_that_add_up_to_no_move_make_the_pair_degraded_and_a_window_urgent() -> None:
    """As in a tunnel, where edges fit elsewhere by chance: the checks accuse the mount, and none acquits it."""
    offsets = ([0.02, 0.0, 0.0, 0.0, 0.0, 0.0], [-0.02, 0.0, 0.0, 0.0, 0.0, 0.0])
    accuse = [
        replace(check(205 + 5 * k, flagged=True), offset=np.array(offset), weak=True)
        for k, offset in enumerate(offsets)
    ]
    state = watched(HEALTHY, check(195), replace(check(200), has_power=False), *accuse)
    assert (state.health, [reason.code for reason in state.reasons]) == (HealthState.DEGRADED, ["not_acquitted"])
    assert urgent_window_since(state) == state.flagged_since_ns is not None


def test_one_poor_stretch_after_another_is_one() -> None:
    poor = MonitorState(outcome=MonitorOutcome.CLEAR, blind={"open_field": 3.0})
    state = watched(replace(HEALTHY, monitor=poor), *clear_from(300, 1))
    assert (state.health, state.poor_since_ns) == (HealthState.DEGRADED, 300 * S)
    early = watched(state, *clear_from(310, 4))
    assert (early.health, [reason.code for reason in early.reasons]) == (HealthState.DEGRADED, ["settling"])
    assert solved(early, estimate(0.5, 340)).health is HealthState.DEGRADED, "a window settles the mount, not the data"
    late = watched(early, *clear_from(361, 1))
    assert (late.health, late.poor_since_ns) == (HealthState.HEALTHY, None)


def test_a_refused_window_in_which_another_pose_stands_out_is_a_suspicion() -> None:
    sloped = Verdict(Decision.FAILED, (), (Reason("newton_step_deg", "not at a maximum"),))
    elsewhere = replace(estimate(3.0, 300, Decision.FAILED), verdict=sloped)
    state = solved(HEALTHY, elsewhere)
    assert (state.health, state.reasons) == (HealthState.SUSPECT, sloped.reasons)
    here = replace(estimate(0.5, 300, Decision.FAILED), verdict=sloped)
    assert solved(HEALTHY, here).health is HealthState.HEALTHY


def test_a_window_that_gave_no_estimate_says_nothing_of_the_mount() -> None:
    state = after_failure(HEALTHY, CRASH)
    np.testing.assert_array_equal(state.T_camera_lidar, HEALTHY.T_camera_lidar)
    assert (state.health, state.status, state.failures) == (HealthState.HEALTHY, CalibrationStatus.FAILED, (CRASH,))
    assert solved(state, estimate(0.5, 300)).health is HealthState.HEALTHY


def test_windows_that_agree_are_averaged() -> None:
    state = solved(HEALTHY, estimate(0.54, 300))
    turned = np.degrees(se3.difference(state.T_camera_lidar, RIG.T_camera_lidar_nominal)[1])
    assert 0.5 < turned < 0.54
    assert state.track is not None
    assert state.track.windows == 2
    assert state.health is HealthState.HEALTHY


def test_a_single_window_that_differs_moves_nothing_and_a_second_one_decides() -> None:
    one = solved(HEALTHY, estimate(2.0, 300))
    np.testing.assert_array_equal(one.T_camera_lidar, HEALTHY.T_camera_lidar)
    assert one.health is HealthState.SUSPECT
    assert [reason.code for reason in one.reasons] == ["step_suspected"]
    assert one.pending is not None
    assert watched(one, *clear_from(310, 3)).health is HealthState.SUSPECT, "against a window a check does not count"
    back = solved(one, estimate(0.5, 500))
    assert back.health is HealthState.HEALTHY
    assert back.pending is None
    two = solved(one, estimate(2.02, 500))
    assert two.health is HealthState.HEALTHY
    assert 1.9 < np.degrees(se3.difference(two.T_camera_lidar, RIG.T_camera_lidar_nominal)[1]) < 2.1


# --- the monitor ------------------------------------------------------------------------------------------------


@pytest.mark.fault("a single bad check", "it decides nothing")
def test_one_bad_check_decides_nothing() -> None:
    state = watched(HEALTHY, *clear_from(110, 3), check(125, flagged=True), *clear_from(130, 2))
    assert state.health is HealthState.HEALTHY
    assert state.flagged_since_ns is None


def test_a_moved_mount_becomes_suspect_then_red_and_the_next_window_corrects_it() -> None:
    states = [watched(HEALTHY, *clear_from(190, 2), *flagged_from(200, count)) for count in range(1, 4)]
    assert [state.health for state in states] == [
        HealthState.HEALTHY,
        HealthState.SUSPECT,
        HealthState.MISCALIBRATED,
    ]
    red = states[-1]
    assert red.flagged_since_ns == 196 * S
    np.testing.assert_array_equal(red.T_camera_lidar, HEALTHY.T_camera_lidar)
    mixed = after_estimate(red, estimate(1.0, 230), 150 * S, RULES)
    assert mixed.health is HealthState.MISCALIBRATED
    np.testing.assert_array_equal(mixed.T_camera_lidar, HEALTHY.T_camera_lidar)
    fresh = after_estimate(mixed, estimate(1.5, 260), 220 * S, RULES)
    assert fresh.health is HealthState.HEALTHY
    np.testing.assert_array_equal(fresh.T_camera_lidar, pose_of(estimate(1.5)))
    assert fresh.monitor.outcome is MonitorOutcome.UNKNOWN
    assert fresh.flagged_since_ns is None


def test_doubt_begins_with_a_check_that_is_undecided_and_ends_with_one_that_is_clear() -> None:
    undecided = replace(check(200), undecided=True)
    doubted = watched(HEALTHY, *clear_from(190, 2), undecided)
    assert doubted.health is HealthState.HEALTHY
    assert doubted.flagged_since_ns == 196 * S
    assert watched(doubted, *flagged_from(205, 3)).flagged_since_ns == 196 * S
    assert watched(doubted, *clear_from(205, 1)).flagged_since_ns is None


def test_a_window_elsewhere_and_a_monitor_that_suspects_are_two_cues() -> None:
    suspect = watched(HEALTHY, *clear_from(110, 2), *flagged_from(120, 2))
    assert suspect.health is HealthState.SUSPECT
    begin_ns = suspect.flagged_since_ns
    assert begin_ns is not None
    moved, near = estimate(2.0, 200), estimate(0.55, 200)
    red = before_estimate(suspect, moved, begin_ns, RULES)
    assert red.health is HealthState.MISCALIBRATED
    assert [reason.code for reason in red.reasons] == ["bent_mount"]
    assert after_estimate(red, moved, begin_ns, RULES).health is HealthState.HEALTHY
    assert before_estimate(suspect, near, begin_ns, RULES) is suspect
    assert before_estimate(suspect, moved, begin_ns - 1, RULES) is suspect, "it mixes two mounts"
    assert before_estimate(suspect, estimate(2.0, 200, Decision.FAILED), begin_ns, RULES) is suspect
    assert before_estimate(HEALTHY, moved, begin_ns, RULES) is HEALTHY, "one source"


def test_where_no_check_was_ever_clear_the_first_window_counts_in_full() -> None:
    red = watched(initial_state(RIG), *flagged_from(200, 3))
    assert red.flagged_since_ns == 0
    assert after_estimate(red, estimate(1.5, 260), 150 * S, RULES).health is HealthState.HEALTHY


def test_a_window_that_agrees_acquits() -> None:
    suspect = watched(HEALTHY, *flagged_from(200, 2))
    state = after_estimate(suspect, estimate(0.5, 260), 220 * S, RULES)
    assert state.health is HealthState.HEALTHY


def test_with_never_the_candidate_waits_and_nothing_else_changes() -> None:
    red = watched(solved(initial_state(RIG), estimate(0.0), NEVER), *flagged_from(200, 3))
    state = after_estimate(red, estimate(1.0, 260), 220 * S, NEVER)
    np.testing.assert_array_equal(state.T_camera_lidar, RIG.T_camera_lidar_nominal)
    assert (state.provenance, state.valid_from_ns) == (red.provenance, red.valid_from_ns)
    assert state.health is HealthState.MISCALIBRATED
    assert [reason.code for reason in state.reasons] == ["candidate_waits", "apply_never"]
    assert state.pending is not None
    np.testing.assert_array_equal(state.pending.T_camera_lidar, pose_of(estimate(1.0)))
    assert watched(state, *clear_from(270, 9)).health is HealthState.MISCALIBRATED
    applied = apply_pending(state, NEVER)
    np.testing.assert_array_equal(applied.T_camera_lidar, pose_of(estimate(1.0)))
    assert (applied.health, applied.provenance, applied.pending) == (HealthState.UNKNOWN, Provenance.ESTIMATED, None)
    assert watched(applied, check(320)).health is HealthState.HEALTHY


def test_red_fades_by_staying_clear_through_yellow_only() -> None:
    red = watched(HEALTHY, *flagged_from(200, 4))
    clears = [watched(red, *clear_from(300, count)).health for count in range(1, 6)]
    assert clears[-1] is HealthState.HEALTHY
    first = clears.index(HealthState.SUSPECT)
    assert set(clears[:first]) <= {HealthState.MISCALIBRATED}
    assert HealthState.MISCALIBRATED not in clears[first:]


@pytest.mark.parametrize("code", sorted(set(CAUSES) - {"bent_mount"}))
def test_a_cause_in_the_data_degrades_with_its_own_reason_and_passes(code: str) -> None:
    state = watched(HEALTHY, *[check(200 + 5 * i, flagged=True, cause=code) for i in range(4)])
    assert state.health is HealthState.DEGRADED
    assert [reason.code for reason in state.reasons] == [code]
    assert watched(state, *clear_from(300, 6)).health is HealthState.HEALTHY


@pytest.mark.fault("bad data while the mount is known to be wrong", "it stays red")
def test_bad_data_do_not_hide_a_red_state() -> None:
    red = watched(HEALTHY, *flagged_from(200, 3))
    dirty = watched(red, *[check(300 + 5 * i, cause="lens_dirty") for i in range(4)])
    assert dirty.health is HealthState.MISCALIBRATED
    assert [reason.code for reason in dirty.reasons] == ["bent_mount", "lens_dirty"]


def test_a_monitor_that_sees_nothing_wrong_makes_no_unproven_extrinsic_healthy() -> None:
    state = watched(initial_state(RIG), *clear_from(100, 5))
    assert state.health is HealthState.UNKNOWN
    assert watched(after_failure(initial_state(RIG), CRASH), *clear_from(100, 5)).health is HealthState.UNKNOWN
    assert watched(initial_state(RIG), *flagged_from(100, 3)).health is HealthState.MISCALIBRATED


# --- policy -----------------------------------------------------------------------------------------------------


@pytest.mark.fault("an estimate that steps beyond what the policy allows", "it waits for a person")
def test_a_step_beyond_the_limits_waits_for_a_person() -> None:
    state = solved(initial_state(RIG), estimate(11.0))
    assert state.health is HealthState.MISCALIBRATED
    assert [reason.code for reason in state.reasons] == ["candidate_waits", "step_too_large"]
    np.testing.assert_array_equal(state.T_camera_lidar, RIG.T_camera_lidar_nominal)
    applied = apply_pending(state, RULES)
    np.testing.assert_array_equal(applied.T_camera_lidar, pose_of(estimate(11.0)))
    assert applied.changes == ()


def test_the_steps_of_a_day_add_up() -> None:
    rules = PairRules(PolicyConfig(max_step_deg=2.0, max_per_day_deg=3.0), TrackerConfig(), MonitorConfig())
    state = solved(initial_state(RIG), estimate(1.9, 100), rules)
    state = reduce(lambda s, e: solved(s, e, rules), [estimate(0.2, 300), estimate(0.2, 500)], state)
    assert [reason.code for reason in state.reasons] == ["candidate_waits", "day_exhausted"]
    next_day = 100 + 86_401
    tomorrow = reduce(lambda s, e: solved(s, e, rules), [estimate(0.2, next_day), estimate(0.2, next_day + 200)], state)
    assert tomorrow.health is HealthState.HEALTHY
    assert tomorrow.pending is None


# --- commands ---------------------------------------------------------------------------------------------------


def test_hold_freezes_everything_but_the_estimates() -> None:
    frozen = held(HEALTHY, ExtrinsicHold())
    state = solved(frozen, estimate(0.55, 300))
    np.testing.assert_array_equal(state.T_camera_lidar, HEALTHY.T_camera_lidar)
    assert state.health is HealthState.HEALTHY, "it agrees with what is served"
    assert state.pending is not None
    assert state.pending.waits.code == "held"
    commands: tuple[Callable[[PairState], PairState], ...] = (
        partial(apply_pending, rules=RULES),
        partial(reset, rig=RIG),
        partial(rolled_back, pose=pose_of(estimate(0.1)), estimate=estimate(0.1), rules=RULES),
    )
    for command in commands:
        with pytest.raises(CommandRefusedError, match="held"):
            command(state)
    moved = apply_pending(released(state), RULES)
    assert not np.array_equal(moved.T_camera_lidar, HEALTHY.T_camera_lidar)


def test_nothing_pending_is_refused() -> None:
    with pytest.raises(CommandRefusedError, match="There is no candidate"):
        apply_pending(HEALTHY, RULES)


def test_a_reset_serves_nominal_and_knows_nothing() -> None:
    state = reset(watched(HEALTHY, *flagged_from(200, 3)), RIG)
    np.testing.assert_array_equal(state.T_camera_lidar, RIG.T_camera_lidar_nominal)
    assert (state.provenance, state.health, state.valid_from_ns) == (Provenance.NOMINAL, HealthState.UNKNOWN, 0)
    assert (state.track, state.accepted, state.pending) == (None, None, None)
    assert watched(state, *clear_from(300, 5)).health is HealthState.UNKNOWN


def test_a_roll_back_is_checked_before_it_is_called_healthy() -> None:
    state = rolled_back(HEALTHY, pose_of(estimate(0.2)), estimate(0.2), RULES)
    np.testing.assert_array_equal(state.T_camera_lidar, pose_of(estimate(0.2)))
    assert (state.provenance, state.health) == (Provenance.RESTORED, HealthState.UNKNOWN)
    assert watched(state, *clear_from(300, 3)).health is HealthState.HEALTHY


def test_commissioning_confirms_what_is_served_and_nothing_else() -> None:
    state = after_commissioning(HEALTHY, HEALTHY.T_camera_lidar)
    assert (state.provenance, state.health) == (Provenance.COMMISSIONED, HealthState.HEALTHY)
    assert after_commissioning(HEALTHY, RIG.T_camera_lidar_nominal) is HEALTHY


# --- time -------------------------------------------------------------------------------------------------------


@pytest.mark.fault("silence", "nothing stays healthy that was not looked at")
def test_what_was_not_checked_for_long_is_stale_not_healthy() -> None:
    assert aged(HEALTHY, DAY_S, DAY_S) is HEALTHY
    state = aged(HEALTHY, DAY_S + 1.0, DAY_S)
    assert (state.health, [reason.code for reason in state.reasons]) == (HealthState.STALE, ["stale", "last_known"])
    assert aged(state, DAY_S + 2.0, DAY_S) is state
    assert solved(state, estimate(0.5, LATE_NS // S)).health is HealthState.HEALTHY
    red = watched(HEALTHY, *flagged_from(200, 3))
    assert aged(red, DAY_S + 1.0, DAY_S) is red
    nothing = initial_state(RIG)
    assert aged(nothing, DAY_S + 1.0, DAY_S) is nothing


WORKER = Reason("overdue_worker", "No check has been completed for 16 s: the worker has not answered.")


def test_without_a_completed_check_green_turns_yellow_and_what_was_known_is_reported() -> None:
    state = overdue(HEALTHY, WORKER)
    assert state.health is HealthState.DEGRADED
    assert [reason.code for reason in state.reasons] == ["overdue_worker", "last_known"]
    assert state.reasons[1].text == "Last known: healthy."
    old = aged(state, DAY_S + 1.0, DAY_S)
    assert [reason.text for reason in old.reasons][1:] == ["Last known: healthy."]
    assert watched(state, check(300)).health is HealthState.HEALTHY
    red = watched(HEALTHY, *flagged_from(200, 3))
    assert overdue(red, WORKER) is red
    suspect = watched(HEALTHY, *flagged_from(200, 2))
    assert overdue(suspect, WORKER) is suspect, "a window is being solved meanwhile"
    assert "Last known: suspect. The latest pairs" in aged(suspect, DAY_S + 1.0, DAY_S).reasons[1].text


def anything(rng: np.random.Generator, stamp_s: int) -> Callable[[PairState], PairState]:
    """Something that happens to a pair at this time."""
    turned_deg = float(rng.choice([0.5, 0.6, 3.0]))
    directions: list[Callable[[PairState], PairState]] = [
        lambda state: watched(state, check(stamp_s)),
        lambda state: watched(state, *flagged_from(stamp_s, 3)),
        lambda state: watched(state, *(check(stamp_s + i, flagged=True, cause="dark") for i in range(3))),
        lambda state: solved(state, estimate(turned_deg, stamp_s)),
        lambda state: solved(state, moved_within(turned_deg, 3.0, stamp_s)),
        lambda state: time_stepped_back(state, stamp_s * S),
        restored,
    ]
    return directions[rng.choice(len(directions), p=[0.4, 0.15, 0.1, 0.15, 0.1, 0.05, 0.05])]


@pytest.mark.fault("checks that are overdue because the machine is busy", "they are reported, and change no decision")
@pytest.mark.parametrize("seed", range(8))
def test_what_the_data_decide_does_not_hang_on_how_long_the_machine_took(seed: int) -> None:
    rng, busy_rng = np.random.default_rng(seed), np.random.default_rng(seed + 1000)
    prompt = busy = initial_state(RIG)
    reported: set[HealthState] = set()
    for stamp_s in range(300, 1200, 20):
        happens = anything(rng, stamp_s)
        prompt, busy = happens(prompt), happens(busy)
        assert (busy.seen, urgent_window_since(busy)) == (prompt.seen, urgent_window_since(prompt))
        assert np.array_equal(busy.T_camera_lidar, prompt.T_camera_lidar)
        for name in ("monitor", "flagged_since_ns", "poor_since_ns", "proven", "status"):
            assert getattr(busy, name) == getattr(prompt, name)
        if busy_rng.random() < 0.5:
            busy = overdue(busy, WORKER)
        if busy_rng.random() < 0.2:
            busy = aged(busy, DAY_S + 1.0, DAY_S)
        reported.add(busy.health)
    assert reported & {HealthState.DEGRADED, HealthState.STALE}


def test_a_check_that_changes_nothing_ends_what_was_reported_of_its_delay() -> None:
    suspect = replace(HEALTHY, health=HealthState.SUSPECT, reasons=(KNOCK,), proven=False)
    late = aged(suspect, DAY_S + 1.0, DAY_S)
    assert late.health is HealthState.STALE
    after = watched(late, check(300), check(305), check(310))
    assert (after.health, after.reasons) == (HealthState.SUSPECT, (KNOCK,))


def test_sensor_time_that_steps_back_leaves_nothing_green_and_no_suspicion_out_of_reach() -> None:
    state = time_stepped_back(HEALTHY, 10 * S)
    assert (state.health, state.reasons[0].code) == (HealthState.UNKNOWN, "time_stepped_back")
    assert watched(state, check(20)).health is HealthState.HEALTHY
    suspect = watched(HEALTHY, check(190), *flagged_from(200, 2))
    assert suspect.flagged_since_ns == 196 * S
    again = time_stepped_back(suspect, 10 * S)
    assert (again.health, again.flagged_since_ns) == (HealthState.SUSPECT, 10 * S)
    elsewhere = estimate(3.0, 90)
    assert solved(again, elsewhere).health is HealthState.HEALTHY, "a window of the new time decides"


def test_an_estimate_read_back_from_disk_is_reported_and_has_not_been_checked() -> None:
    state = restored(HEALTHY)
    assert (state.provenance, state.health) == (Provenance.RESTORED, HealthState.UNKNOWN)
    assert [reason.code for reason in state.reasons] == ["restarted", "last_known"]
    assert watched(state, check(300)).health is HealthState.HEALTHY
    assert restored(initial_state(RIG)).provenance is Provenance.NOMINAL
    red = restored(replace(watched(HEALTHY, *flagged_from(200, 3))))
    assert red.health is HealthState.MISCALIBRATED


@pytest.mark.parametrize(("turned_deg", "health"), [(0.02, HealthState.HEALTHY), (0.15, HealthState.UNKNOWN)])
def test_an_old_window_keeps_what_checks_acquitted_if_it_hardly_changes_the_extrinsic(
    turned_deg: float, health: HealthState
) -> None:
    state = watched(solved(initial_state(RIG), estimate(0.0, 250)), check(300))
    assert state.health is HealthState.HEALTHY
    after = after_estimate(state, estimate(turned_deg, 260), 210 * S, RULES, 300 * S)
    assert not np.array_equal(after.T_camera_lidar, state.T_camera_lidar)
    assert after.health is health
