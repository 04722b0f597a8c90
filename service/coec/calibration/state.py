"""The state of a pair and every step that it can take: by windows, checks of the monitor, age, commands of people.

An estimate that was not accepted is never served as current. A pair that was not looked at is never healthy. An
extrinsic that a person holds does not move. Each function returns the whole next state; `PairState` is all that
survives a restart.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import degrees, fsum, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration import state_machine
from coec.calibration.frames.window import CarriedOverPairs
from coec.calibration.monitor.change_detector import (
    ACCUSING,
    ACQUITTAL_PERIODS,
    BLIND_AT,
    AlarmLevels,
    MonitorOutcome,
    MonitorState,
    Observation,
    after_window,
    alarm_levels,
    diagnose,
    is_acquitted,
    leading_cause,
)
from coec.calibration.monitor.change_detector import after_observation as check_taken
from coec.calibration.monitor.sensor_faults import CAUSES, Cause
from coec.calibration.state_machine import TRANSITIONS, AlarmRecord, HealthEvent, HealthState
from coec.calibration.tracker import Measurement, StepState, Track, fits, prior_sigma, update_track
from coec.calibration.types import INTRINSICS_OFF, Decision, Estimate, Matrix4, MovedWithin, Reason, Rig
from coec.config import MonitorConfig, PolicyConfig, TrackerConfig
from coec.errors import CoecError
from coec.geometry import se3

BENT_MOUNT = "bent_mount"
"""The one cause of `diagnose` that lies in the calibration; every other lies in the data."""

NOT_ACQUITTED = "not_acquitted"
"""Code of the reason that no check vouches for the served extrinsic."""

LAST_KNOWN = "last_known"
"""Code of the reason that says what was last known before checks stopped."""

RESTARTED = Reason("restarted", "The service was restarted; no check has been completed since.")

SETTLING_NS = 60_000_000_000
"""Sensor time, a minute, for which a pair stays degraded or suspect at least once its data could not be judged, or no
check acquitted it. Poor stretches that follow each other then count as one, and readers of health do not see two
changes a minute."""

SETTLING = Reason("settling", "The data can be evaluated again, after an interval in which they could not.")

TRANSLATION_OPEN = Reason(
    "translation_open",
    "The checks detect a displacement of the mount, and the latest window, with `search.dof: 3`, cannot confirm it; "
    "calibrate with 6 degrees of freedom, or inspect the mount.",
)
"""A window that searches rotations alone is accepted while checks accuse the translation."""

NOT_EVALUATED = Reason("not_evaluated", "No window has been evaluated yet.")


class Provenance(StrEnum):
    """Where the served extrinsic comes from."""

    NOMINAL = "nominal"
    COMMISSIONED = "commissioned"
    ESTIMATED = "estimated"
    RESTORED = "restored"


class CalibrationStatus(StrEnum):
    """How the latest calibration ended; `not_accepted` before the first."""

    NOT_ACCEPTED = "not_accepted"
    ACCEPTED = "accepted"
    FAILED = "failed"


class CommandRefusedError(CoecError):
    """A command that cannot be carried out now.

    Attributes:
        code: machine-readable outcome.
    """

    reply_code = "refused"

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True, eq=False)
class PendingEstimate:
    """A pose (4, 4) from an accepted estimate that waits for `apply`; why it waits, and whether it contradicts the
    served pose, being too far from it for both to be right."""

    T_camera_lidar: Matrix4
    estimate: Estimate
    waits: Reason
    contradicts: bool


@dataclass(frozen=True, slots=True)
class ExtrinsicHold:
    """A person holds the extrinsic: since when (wall clock, ns since 1970), who, and why, in their words; None and
    empty if unknown."""

    since_ns: int | None = None
    sender: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Health:
    """A state with its reasons."""

    state: HealthState
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True)
class PairRules:
    """The configuration that the owner of the vehicle has set."""

    policy: PolicyConfig
    tracker: TrackerConfig
    monitor: MonitorConfig

    @property
    def alarm(self) -> AlarmLevels:
        """The levels that the evidence of checks has to reach."""
        return alarm_levels(self.monitor)


@dataclass(frozen=True, slots=True, eq=False)
class PairState:
    """Everything that survives a restart.

    Attributes:
        T_camera_lidar: (4, 4) the served extrinsic.
        valid_from_ns: sensor time of the data it rests on; 0 for the nominal one.
        latest: the last estimate, accepted or not.
        accepted: the accepted estimate on which the served extrinsic rests; None for a nominal one.
        failures: why the last attempt produced no estimate; empty if it produced one.
        health, reasons: the state of health, and why the pair is in it.
        unseen_from: the health before time without a check changed it; None if time did not. Events in the data go on
            from there, because they do not depend on how long the machine took for a check.
        pending: the candidate that waits for `apply`.
        hold: who holds the extrinsic as it is; None if nobody does.
        proven: whether a window, or commissioning, has confirmed the served extrinsic.
        track: the combination of accepted windows since the extrinsic last jumped; None before the first.
        monitor: what the checks since the last confirmation or replacement add up to.
        flagged_since_ns: sensor time since which the monitor has something against the pairs; None if it has nothing. A
            window that began earlier mixes two mounts: it neither corrects nor acquits.
        poor_since_ns: sensor time since which the data could not be judged; None once health has recovered.
        changes: steps of the last day that no person ordered.
        record: how long the pair was watched, and how its alarms ended.
    """

    T_camera_lidar: Matrix4
    provenance: Provenance
    status: CalibrationStatus
    valid_from_ns: int
    latest: Estimate | None = None
    accepted: Estimate | None = None
    failures: tuple[Reason, ...] = ()
    health: HealthState = HealthState.UNKNOWN
    reasons: tuple[Reason, ...] = (NOT_EVALUATED,)
    unseen_from: Health | None = None
    pending: PendingEstimate | None = None
    hold: ExtrinsicHold | None = None
    proven: bool = False
    track: Track | None = None
    monitor: MonitorState = field(default_factory=MonitorState)
    flagged_since_ns: int | None = None
    poor_since_ns: int | None = None
    changes: tuple[state_machine.AppliedChange, ...] = ()
    record: AlarmRecord = field(default_factory=AlarmRecord)

    @property
    def seen(self) -> HealthState:
        """Health according to the last look, however long ago it was."""
        return self.health if self.unseen_from is None else self.unseen_from.state


def initial_state(rig: Rig) -> PairState:
    """The first state: nominal extrinsic, not accepted, nothing looked at."""
    return PairState(rig.T_camera_lidar_nominal, Provenance.NOMINAL, CalibrationStatus.NOT_ACCEPTED, 0)


def restored(state: PairState) -> PairState:
    """The state after a restart. An estimate read back from disk is marked as restored, and nothing counts as looked at
    since, whatever the clock says. A suspicion or an alarm outlives the restart."""
    if state.provenance is Provenance.ESTIMATED:
        state = replace(state, provenance=Provenance.RESTORED)
    # The mount may have moved since, and the vehicle too.
    monitor = replace(state.monitor, acquitted_ns=None, unacquitted=0, stood=False, standstill=None)
    return _unseen(replace(state, monitor=monitor), HealthEvent.RESTARTED, RESTARTED)


def moved(estimate: Estimate, pose: Matrix4, rig: Rig) -> Estimate:
    """The estimate with another pose (4, 4), from which the known bias of the estimator was removed."""
    optimum = replace(estimate.optimum, T_camera_lidar=pose)
    return replace(estimate, optimum=optimum, correction=se3.difference(pose, rig.T_camera_lidar_nominal))


def agrees(T_one: Matrix4, T_other: Matrix4, rules: PolicyConfig) -> bool:
    """Whether two extrinsics are too near each other to speak of a contradiction."""
    return state_machine.agrees(state_machine.step_between(T_one, T_other), rules)


def happened(state: PairState, event: HealthEvent, *reasons: Reason) -> PairState:
    """The state after an event: the table decides on health, and the given reasons replace the old ones."""
    return replace(state, health=TRANSITIONS[state.seen, event], reasons=reasons, unseen_from=None)


# --- windows --------------------------------------------------------------------------------------------------------


def before_estimate(state: PairState, estimate: Estimate, window_start_ns: int, rules: PairRules) -> PairState:
    """The state when a window was solved, before `after_estimate`. If the window is accepted and its pose is elsewhere
    than an extrinsic that the monitor suspects, two sources agree: the mount has moved, even if the next step
    corrects it at once."""
    mixed = state.flagged_since_ns is not None and window_start_ns < state.flagged_since_ns
    if estimate.verdict.decision is Decision.FAILED or mixed or not _accused_elsewhere(state, estimate, rules):
        return state
    return _unless_red(state, HealthEvent.MOUNT_MOVED, CAUSES[BENT_MOUNT].as_reason())


def after_estimate(
    state: PairState, estimate: Estimate, window_start_ns: int, rules: PairRules, now_ns: int | None = None
) -> PairState:
    """The state after a window was solved.

    Args:
        window_start_ns: stamp of its first pair.
        now_ns: sensor time now: a window whose data are older than three periods does not make a pair healthy. None:
            the time of its last pair.
    """
    state = replace(state, latest=estimate, failures=())
    if estimate.verdict.decision is Decision.FAILED:
        state = replace(state, status=CalibrationStatus.FAILED)
        moved = _unambiguous_move(estimate)
        if estimate.verdict.shows_another_lens:
            return _poor(state, HealthEvent.DATA_CAUSE, estimate.data_stamp_ns, CAUSES[INTRINSICS_OFF].as_reason())
        # In a tunnel two poses fit as well as before and after a step: checks that acquit later pairs outweigh that.
        if (moved is None and estimate.verdict.is_inconclusive) or (moved is not None and _is_outweighed(state, moved)):
            return state
        # If the camera moved within the window, the end of the window shows where it is now.
        latest = estimate.optimum.T_camera_lidar if moved is None else moved.T_after
        if agrees(state.T_camera_lidar, latest, rules.policy):
            return state
        return _unless_red(state, HealthEvent.REFUSED_ELSEWHERE, *estimate.verdict.reasons)
    state = replace(state, status=CalibrationStatus.ACCEPTED)
    if state.flagged_since_ns is not None and window_start_ns < state.flagged_since_ns:
        return state
    track = _tracked(state, estimate, rules)
    state = replace(state, track=track)
    if track.step is StepState.SUSPECTED and track.candidate is not None:
        step = state_machine.step_between(state.T_camera_lidar, track.candidate.T_camera_lidar)
        why = Reason("step_suspected", f"The latest window differs by {_step_text(step)}; the next window decides.")
        pending = PendingEstimate(track.candidate.T_camera_lidar, estimate, why, contradicts=True)
        return _unless_red(replace(state, pending=pending), HealthEvent.STEP_SUSPECTED, why)
    # A track of one window has that window's pose to the last bit.
    pose = estimate.optimum.T_camera_lidar if track.windows <= 1 else track.T_camera_lidar
    return _applied_or_waiting(state, pose, estimate, estimate.data_stamp_ns, rules, now_ns)


def _is_outweighed(state: PairState, moved: MovedWithin) -> bool:
    """Whether a move that a window dates counts for nothing: something is wrong with the data, or a check acquits pairs
    after it and none has anything against them."""
    if _data_cause(state.monitor) is not None:
        return True
    acquitted_ns = state.monitor.acquitted_ns
    return state.flagged_since_ns is None and acquitted_ns is not None and acquitted_ns > moved.first_after_ns


def _data_cause(monitor: MonitorState) -> Cause | None:
    """The cause in the data, if one is certain enough."""
    cause = diagnose(monitor)
    return None if cause is None or cause.code == BENT_MOUNT else cause


def _unambiguous_move(estimate: Estimate) -> MovedWithin | None:
    """The move within a window; None if there is none or if another reason also makes the window doubtful."""
    return estimate.moved if estimate.verdict.shows_two_poses else None


def urgent_window_since(state: PairState) -> int | None:
    """The sensor time since which pairs are wanted for an urgent window; None if none is urgent. It is urgent if the
    monitor accuses the served extrinsic; if the camera moved within the latest window and health is `suspect` or
    `miscalibrated`; or if checks have made health `suspect`, or contradict the extrinsic and none confirms it."""
    if state.monitor.outcome in ACCUSING and state.flagged_since_ns is not None:
        return state.flagged_since_ns
    moved = None if state.latest is None else _unambiguous_move(state.latest)
    if moved is not None and state.seen in (HealthState.SUSPECT, HealthState.MISCALIBRATED):
        return moved.first_after_ns
    unconfirmed = state.seen is HealthState.SUSPECT or any(reason.code == NOT_ACQUITTED for reason in state.reasons)
    return state.flagged_since_ns if unconfirmed else None


def carried_over_pairs(estimate: Estimate) -> CarriedOverPairs | None:
    """The pairs of a window that come after the camera moved within it: the next window may use them as its own. None
    if there are none."""
    moved = estimate.moved
    if moved is None or not moved.pairs_after:
        return None
    return CarriedOverPairs(estimate.window_id, moved.first_after_ns, estimate.data_stamp_ns, moved.pairs_after)


def with_rig_covariance(estimate: Estimate, covariance: NDArray[np.float64]) -> Estimate:
    """The estimate with the uncertainty of all pairs of the rig together: their covariance (6, 6), NaN on axes that it
    does not determine."""
    return replace(estimate, uncertainty=replace(estimate.uncertainty, noise=covariance, systematic={}))


def after_joint(state: PairState, joint: Estimate, stamp_ns: int, rules: PairRules) -> PairState:
    """The state after a sensor of the pair moved and the windows of all its pairs together said where it is, decided at
    the sensor time `stamp_ns`. The track starts again from that pose. The policy applies, and so does a hold."""
    pose = joint.optimum.T_camera_lidar
    track = Track.initial(pose, prior_sigma(rules.tracker), stamp_ns)
    track = update_track(track, replace(Measurement.from_estimate(joint), stamp_ns=stamp_ns), rules.tracker)
    return _applied_or_waiting(replace(state, track=track), pose, joint, stamp_ns, rules)


def after_failure(state: PairState, reason: Reason) -> PairState:
    """The state after a window from which no estimate could be made. The served extrinsic and its health stay, because
    this says nothing about them."""
    return replace(state, status=CalibrationStatus.FAILED, failures=(reason,))


def _tracked(state: PairState, estimate: Estimate, rules: PairRules) -> Track:
    """The track with the estimate in it. It starts anew from the estimate if there is no track yet, or if the monitor
    already accuses the served extrinsic and the estimate is elsewhere: then two sources agree that the mount
    moved."""
    measurement = Measurement.from_estimate(estimate)
    pose = estimate.optimum.T_camera_lidar
    track = state.track
    if track is None or _accused_elsewhere(state, estimate, rules):
        track = Track.initial(pose, prior_sigma(rules.tracker), estimate.data_stamp_ns)
    doubted = state.monitor.unacquitted > 0 or state.seen in (HealthState.SUSPECT, HealthState.MISCALIBRATED)
    return update_track(track, measurement, rules.tracker, doubted=doubted)


def _accused_elsewhere(state: PairState, estimate: Estimate, rules: PairRules) -> bool:
    """Whether the monitor accuses the served extrinsic, and the estimate is too far from it for both to be right."""
    accused = state.monitor.outcome in ACCUSING
    return accused and not agrees(state.T_camera_lidar, estimate.optimum.T_camera_lidar, rules.policy)


def _applied_or_waiting(
    state: PairState, pose: Matrix4, estimate: Estimate, stamp_ns: int, rules: PairRules, now_ns: int | None = None
) -> PairState:
    """The state after an accepted pose (4, 4) that rests on data up to the sensor time `stamp_ns`; for `now_ns` see
    `after_estimate`."""
    step = state_machine.step_between(state.T_camera_lidar, pose)
    if not step.any():
        return _confirmed(_served(state, pose, estimate), pose, estimate, stamp_ns, rules, now_ns)
    past = state_machine.remembered(state.changes, estimate.data_stamp_ns)
    waits = state_machine.objection(step, past, estimate.data_stamp_ns, rules.policy)
    if state.hold is not None:
        waits = Reason("held", "The extrinsic is held by command; the candidate waits for its release.")
    if waits is None:
        change = state_machine.AppliedChange(estimate.data_stamp_ns, tuple(abs(float(value)) for value in step))
        served = replace(_served(state, pose, estimate), changes=(*past, change))
        return _confirmed(served, state.T_camera_lidar, estimate, stamp_ns, rules, now_ns)
    close = state_machine.agrees(step, rules.policy)
    state = replace(state, pending=PendingEstimate(pose, estimate, waits, contradicts=not close))
    if close:
        return _confirmed(state, state.T_camera_lidar, estimate, stamp_ns, rules, now_ns)
    why = Reason("candidate_waits", f"An accepted window differs by {_step_text(step)} from the served extrinsic.")
    return happened(state, HealthEvent.CONTRADICTED, why, waits)


NEGLIGIBLE_STEP = np.array([*[radians(0.05)] * 3, *[0.01] * 3])
"""By how much (rad, m) an extrinsic may differ along each axis from the one that a check acquitted: no check tells them
apart. See docs/measured.md."""


def _served(state: PairState, pose: Matrix4, estimate: Estimate) -> PairState:
    # A check, however recent, acquits only the extrinsic that it checked.
    is_other = bool((np.abs(state_machine.step_between(state.T_camera_lidar, pose)) > NEGLIGIBLE_STEP).any())
    return replace(
        state,
        monitor=replace(state.monitor, acquitted_ns=None, standstill=None) if is_other else state.monitor,
        T_camera_lidar=pose,
        provenance=Provenance.ESTIMATED,
        valid_from_ns=estimate.data_stamp_ns,
        accepted=estimate,
        pending=None,
    )


def _confirmed(
    state: PairState, T_before: Matrix4, estimate: Estimate, stamp_ns: int, rules: PairRules, now_ns: int | None
) -> PairState:
    """The state after a window with data up to the sensor time `stamp_ns` was accepted, and its combination with
    earlier ones is served, or agrees with what is served; `T_before` (4, 4) was served before. If the window vouches
    for that, what the monitor had against it is dropped, as far as the window could judge it; causes in the data stay.
    A window that lies beside it, as while the mount drifts, renews and clears nothing."""
    if not fits(state.T_camera_lidar, replace(Measurement.from_estimate(estimate), stamp_ns=stamp_ns)):
        return replace(state, proven=True)
    monitor = after_window(
        state.monitor,
        stamp_ns,
        rules.alarm,
        solved_translation=bool(estimate.solved[3:].all()),
        agrees=agrees(T_before, state.T_camera_lidar, rules.policy),
    )
    accused = monitor.outcome in (MonitorOutcome.SUSPECT, MonitorOutcome.CONFIRMED)
    since_ns = (state.flagged_since_ns or state.valid_from_ns) if accused else None
    state = replace(state, proven=True, monitor=monitor, flagged_since_ns=since_ns)
    if accused:
        event = HealthEvent.MOUNT_MOVED if monitor.outcome is MonitorOutcome.CONFIRMED else HealthEvent.SUSPECTED
        return _unless_red(state, event, TRANSLATION_OPEN)
    if not is_acquitted(monitor, stamp_ns if now_ns is None else now_ns, rules.monitor):
        text = "A window confirms the extrinsic, but its last pairs are old; no check has confirmed it since."
        return happened(state, HealthEvent.CONFIRMED_EARLIER, Reason(NOT_ACQUITTED, text))
    cause = _data_cause(monitor)
    if cause is None:
        return _well_again(state, HealthEvent.CONFIRMED_BY_WINDOW, stamp_ns)
    after = happened(happened(state, HealthEvent.CONFIRMED_BY_WINDOW), HealthEvent.DATA_CAUSE, cause.as_reason())
    return after if state.seen is HealthState.DEGRADED else replace(after, poor_since_ns=stamp_ns)


# --- the monitor, and time ------------------------------------------------------------------------------------------


def after_observation(state: PairState, observation: Observation, rules: PairRules) -> PairState:
    """The state after the monitor checked the served extrinsic. One check decides nothing: `MonitorState` adds them
    up."""
    monitor = check_taken(state.monitor, observation, rules.alarm)
    since_ns = state.flagged_since_ns
    if (observation.flagged or observation.undecided) and not observation.causes:
        if since_ns is None:
            # Without a clear check before, nothing shows that earlier pairs were better.
            was_clear = state.monitor.outcome is MonitorOutcome.CLEAR
            since_ns = observation.pair_stamps_ns[0] if was_clear else state.valid_from_ns
    elif monitor.outcome in (MonitorOutcome.CLEAR, MonitorOutcome.UNKNOWN):
        since_ns = None
    elif since_ns is None and monitor.outcome in ACCUSING:
        # All checks together accuse the extrinsic, but none by itself: then all pairs count as flagged.
        since_ns = state.valid_from_ns
    state = replace(state, monitor=monitor, flagged_since_ns=since_ns)
    cause = _data_cause(monitor)
    if cause is not None:
        return _poor(state, HealthEvent.DATA_CAUSE, observation.stamp_ns, cause.as_reason())
    if monitor.outcome is MonitorOutcome.CONFIRMED:
        return happened(state, HealthEvent.MOUNT_MOVED, CAUSES[BENT_MOUNT].as_reason())
    if monitor.outcome is MonitorOutcome.SUSPECT:
        text = "The latest pairs do not fit the served extrinsic; a window is being recorded to decide."
        return _unless_red(state, HealthEvent.SUSPECTED, Reason("monitor_suspects", text))
    if monitor.outcome is MonitorOutcome.AT_ODDS:
        text = "The latest checks contradict the extrinsic and each other; a window is being recorded to decide."
        return _poor(state, HealthEvent.AT_ODDS, observation.stamp_ns, Reason("checks_at_odds", text))
    if monitor.unacquitted > 0:
        return _not_renewed(state, observation, rules)
    # A clear monitor does not outweigh an accepted window that contradicts the served extrinsic.
    if state.pending is None or not state.pending.contradicts:
        if state.proven:
            return _well_again(state, HealthEvent.CLEAR, observation.stamp_ns)
        after = _well_again(state, HealthEvent.NO_OBJECTION, observation.stamp_ns, NOT_EVALUATED)
        settles = [reason.code for reason in after.reasons] == [SETTLING.code]
        return after if settles or after.health is not state.seen else _seen_again(state)
    return state


def _not_renewed(state: PairState, observation: Observation, rules: PairRules) -> PairState:
    """The state after a check that neither acquits nor makes the monitor accuse. Health stays as it is for three
    periods from the last acquitting check; then the cause that explains most checks is the answer."""
    monitor = state.monitor
    lapsed = monitor.acquitted_ns is not None or monitor.unacquitted >= ACQUITTAL_PERIODS
    if is_acquitted(monitor, observation.stamp_ns, rules.monitor) or not lapsed:
        return state
    # What explains less than a whole check, or of the mount no more than one, explains nothing of the others.
    least = {BENT_MOUNT: BLIND_AT}
    cause = leading_cause({code: weight for code, weight in monitor.blind.items() if weight >= least.get(code, 1.0)})
    accused = cause is not None and cause.code == BENT_MOUNT
    # Where edges are faint, as in a tunnel, single checks find them elsewhere by chance: that adds up to no move.
    if accused and monitor.evidence >= rules.alarm.clear:
        text = "The latest checks contradict the extrinsic, and none confirms it."
        return _poor(state, HealthEvent.SUSPECTED, observation.stamp_ns, Reason("monitor_suspects", text))
    text = "No check of the latest pairs can confirm the extrinsic: their edges are faint, or do not fit well enough."
    why = Reason(NOT_ACQUITTED, text) if cause is None or accused else cause.as_reason()
    return _poor(state, HealthEvent.NOT_ACQUITTED, observation.stamp_ns, why)


def _poor(state: PairState, event: HealthEvent, stamp_ns: int, why: Reason) -> PairState:
    """The state after an event because of which the data cannot be judged, or the mount cannot be acquitted, at this
    sensor time."""
    after = _unless_red(state, event, why)
    goes_on = state.seen in _DOUBTED and state.poor_since_ns is not None
    return after if goes_on else replace(after, poor_since_ns=stamp_ns)


def _well_again(state: PairState, event: HealthEvent, stamp_ns: int, *reasons: Reason) -> PairState:
    """The state after an event at this sensor time that makes a pair healthy, unless its poor stretch began less than
    `SETTLING_NS` before."""
    since_ns = state.poor_since_ns
    # A window decides a suspicion; a check that acquits does not end it at once.
    settles = state.seen is HealthState.DEGRADED or (
        state.seen is HealthState.SUSPECT and event is not HealthEvent.CONFIRMED_BY_WINDOW
    )
    if settles and since_ns is not None and stamp_ns - since_ns < SETTLING_NS:
        return replace(_seen_again(state), reasons=(SETTLING,))
    return replace(happened(state, event, *reasons), poor_since_ns=None)


def overdue(state: PairState, why: Reason) -> PairState:
    """The state after no check was completed in time, for this reason; the last known state is added to the reasons."""
    return _by_the_clock(state, HealthEvent.OVERDUE, why)


def aged(state: PairState, age_s: float, stale_after_s: float) -> PairState:
    """The state after `age_s` without a completed check."""
    if age_s <= stale_after_s:
        return state
    text = f"No check has been completed for {age_s:.0f} s, more than {stale_after_s:.0f} s."
    return _by_the_clock(state, HealthEvent.AGED, Reason("stale", text))


def _by_the_clock(state: PairState, event: HealthEvent, why: Reason) -> PairState:
    """The state after an event of the clock: it is reported until something is looked at, and then forgotten."""
    after = _unseen(state, event, why)
    return (
        state
        if after is state
        else replace(after, unseen_from=state.unseen_from or Health(state.health, state.reasons))
    )


def _seen_again(state: PairState) -> PairState:
    """The state after a check that changes nothing: health returns to what it was before checks stopped."""
    seen = state.unseen_from
    return state if seen is None else replace(state, health=seen.state, reasons=seen.reasons, unseen_from=None)


def _unseen(state: PairState, event: HealthEvent, why: Reason) -> PairState:
    if TRANSITIONS[state.health, event] is state.health:
        return state
    known = [reason for reason in state.reasons if reason.code == LAST_KNOWN]
    text = "; ".join(reason.text for reason in state.reasons)
    known = known or [Reason(LAST_KNOWN, f"Last known: {state.health.value}{'. ' if text else '.'}{text}")]
    return happened(state, event, why, *known)


def time_stepped_back(state: PairState, stamp_ns: int) -> PairState:
    """The state after the clock of the sensors stepped back to `stamp_ns`. If pairs since some time of the old clock
    were suspected, every pair of the new clock is."""
    since_ns = None if state.flagged_since_ns is None else stamp_ns
    state = replace(
        state,
        flagged_since_ns=since_ns,
        poor_since_ns=None,
        monitor=replace(state.monitor, last_stamps_ns=(), acquitted_ns=None, unacquitted=0, standstill=None),
    )
    why = Reason("time_stepped_back", "The clock of the sensors stepped back; no check has been completed since.")
    return _unseen(state, HealthEvent.TIME_STEPPED_BACK, why)


# --- commands -------------------------------------------------------------------------------------------------------


def apply_pending(state: PairState, rules: PairRules) -> PairState:
    """The state after a person accepts the candidate; the limits of the policy do not bind people. It has to be checked
    before it counts as healthy: the window that found it may be hours old.

    Raises:
        CommandRefusedError: nothing waits, or the extrinsic is held.
    """
    _refuse_if_held(state)
    if state.pending is None:
        raise CommandRefusedError("nothing_pending", "There is no candidate.")
    pose, estimate, track = state.pending.T_camera_lidar, state.pending.estimate, state.track
    if track is None or not np.array_equal(track.T_camera_lidar, pose):
        track = Track.initial(pose, prior_sigma(rules.tracker), estimate.data_stamp_ns)
    state = _served(_replaced(state, pose, "Applied by command; not checked since."), pose, estimate)
    return replace(state, proven=True, track=track)


def rolled_back(state: PairState, pose: Matrix4, estimate: Estimate, rules: PairRules) -> PairState:
    """The state after a person returns to an earlier accepted calibration. It has to be looked at again before it
    counts as healthy.

    Raises:
        CommandRefusedError: the extrinsic is held.
    """
    _refuse_if_held(state)
    state = _replaced(state, pose, "Rolled back by command; not checked since.")
    return replace(
        state,
        provenance=Provenance.RESTORED,
        valid_from_ns=estimate.data_stamp_ns,
        accepted=estimate,
        proven=True,
        track=Track.initial(pose, prior_sigma(rules.tracker), estimate.data_stamp_ns),
    )


def reset(state: PairState, rig: Rig) -> PairState:
    """The state after a person returns to the workshop calibration.

    Raises:
        CommandRefusedError: the extrinsic is held.
    """
    _refuse_if_held(state)
    state = _replaced(state, rig.T_camera_lidar_nominal, "Reset to nominal by command; not checked since.")
    return replace(state, provenance=Provenance.NOMINAL, valid_from_ns=0, accepted=None, proven=False, track=None)


def held(state: PairState, hold: ExtrinsicHold) -> PairState:
    """The state after a person freezes the extrinsic: estimates go on, but none is applied."""
    return replace(state, hold=hold)


def released(state: PairState) -> PairState:
    """The state after a hold ends: the extrinsic may move again. A candidate still waits for `apply` or for the next
    window."""
    return replace(state, hold=None)


def after_commissioning(state: PairState, T_commissioned: Matrix4) -> PairState:
    """The state after the rig was commissioned: if the commissioned pose is the served one, it is the baseline of this
    rig. Health stays: the windows that it was learned from may be old, and a check has to acquit it."""
    if not np.array_equal(T_commissioned, state.T_camera_lidar):
        return state
    monitor = MonitorState(vouched=True, acquitted_ns=state.monitor.acquitted_ns, standstill=state.monitor.standstill)
    return replace(state, provenance=Provenance.COMMISSIONED, proven=True, monitor=monitor)


def _replaced(state: PairState, pose: Matrix4, text: str) -> PairState:
    state = replace(state, T_camera_lidar=pose, pending=None, monitor=MonitorState(), flagged_since_ns=None, changes=())
    state = replace(state, poor_since_ns=None)
    return happened(state, HealthEvent.REPLACED, Reason("replaced", text))


def _refuse_if_held(state: PairState) -> None:
    if state.hold is not None:
        raise CommandRefusedError("held", 'The extrinsic is held: release it first with `hold` and {"release": true}.')


def _unless_red(state: PairState, event: HealthEvent, *reasons: Reason) -> PairState:
    """The state after an event. If the pair stays miscalibrated, the reasons for that stay too, before the new ones."""
    after = happened(state, event, *reasons)
    if state.health is after.health is HealthState.MISCALIBRATED:
        red = tuple(reason for reason in state.reasons if reason.code in _RED)
        return replace(after, reasons=(*red, *reasons))
    return after


_DOUBTED = (HealthState.DEGRADED, HealthState.SUSPECT)
"""States in which a stretch that cannot be judged goes on."""

_RED = (BENT_MOUNT, "candidate_waits")
"""Codes of the reasons for which a pair is miscalibrated."""


def _step_text(step: NDArray[np.float64]) -> str:
    """A step (6,) in a few words."""
    angle_deg = degrees(se3.rotation_angle_rad(se3.perturbation(step)))
    metres = sqrt(fsum(float(value) ** 2 for value in step[3:]))
    return f"{angle_deg:.2f}° and {100 * metres:.1f} cm"
