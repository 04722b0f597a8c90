"""The thread that decides about a pair. It takes every answer, every command and the passing of time, one after the
other, and determines what is served from then on.

Only this thread changes the state of a pair. Answers come through the mailbox and count in the order in which their
questions were asked (`queue`). What an answer changes in the choice of further pairs goes to the stream as an effect.
"""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Protocol

import numpy as np

from coec.calibration import state as lifecycle
from coec.calibration.baseline import BaselineDrift
from coec.calibration.frames.window import CarriedOverPairs
from coec.calibration.monitor.change_detector import MonitorOutcome, holds_at_rest
from coec.calibration.state import PairRules, PairState
from coec.calibration.state_machine import HealthState
from coec.calibration.types import Decision, Matrix4, Reason
from coec.config import CalibrationConfig, PairConfig
from coec.geometry import se3
from coec.io.logs import LossCounter
from coec.io.serialise import check_of, estimate_of, matrix_of
from coec.io.system import ServiceThread
from coec.reports.formatting import hold_text
from coec.schemas.replies import CalibrationResult, CheckReply
from coec.service.engine.check_progress import Attempts, CheckProgress
from coec.service.engine.frame_selector import ServedExtrinsic
from coec.service.engine.job_client import IncidentPictures
from coec.service.engine.pair_stream import StreamStatistics
from coec.service.engine.rig import PairCorrection, RigMember
from coec.service.engine.schedule import Effect, PendingRequest, ResultSchedule, TakeResult
from coec.service.recording.window_store import WindowVersion, start_ns_of
from coec.service.records.pair_store import PairStore, StateTransition
from coec.service.records.rig_store import RigBaseline
from coec.service.task_queue import TaskQueue
from coec.service.worker.job_queue import STOPPING
from coec.service.worker.worker_jobs import Checked, Commissioned, JobOutcome, Solved, WrittenFile

_log = logging.getLogger(__name__)

INCIDENT_STATES = (HealthState.SUSPECT, HealthState.DEGRADED, HealthState.MISCALIBRATED)
"""States whose beginning is an event. A snippet of the seconds around it is recorded, if snippets are wanted."""

FINDINGS: Mapping[MonitorOutcome, str] = MappingProxyType(
    {
        MonitorOutcome.UNKNOWN: "not enough to judge what is served",
        MonitorOutcome.CLEAR: "they agree with what is served",
        MonitorOutcome.AT_ODDS: "they contradict what is served, but not by one move of the mount",
        MonitorOutcome.SUSPECT: "the mount may have moved; a window is wanted soon",
        MonitorOutcome.CONFIRMED: "the mount has moved",
    }
)
"""What the checks of a pair say, for the log."""

UNPUBLISHED_RETRY_S = 0.02
"""Time between two attempts to report a state that is about to reach the disk, s."""

TICK_S = 1.0
"""Longest time between two looks at the clocks, s. While the thread lives, health is never older than that."""


class StreamControl(Protocol):
    """The stream of the pair, as the decider uses it. `adopt`, `alarm`, `keep`, `calm` and `event` are called on the
    stream's thread."""

    @property
    def report(self) -> StreamStatistics:
        """The stream's latest report."""

    def call(self, effect: Effect) -> None:
        """Has an effect run on the stream's thread."""

    def adopt(self, served: ServedExtrinsic) -> None:
        """Another extrinsic is served."""

    def alarm(self, since_ns: int) -> None:
        """A window of pairs since this sensor time is wanted soon."""

    def carry_over(self, carried_over: CarriedOverPairs) -> None:
        """Pairs of a window belong to the next one."""

    def calm(self) -> None:
        """There is no suspicion any more."""

    def event(self, name: str, T_camera_lidar: Matrix4) -> None:
        """An event happened while this extrinsic (4, 4) is served."""


@dataclass(frozen=True, slots=True)
class PairSnapshot:
    """Everything that is known of a pair at one moment, from which its answers are made.

    Attributes:
        state: state of the pair.
        served: the extrinsic that is served.
        check: the latest check of that extrinsic.
        troubles: troubles of the service itself, or that the extrinsic is on hold.
        drift, result_drift: drift of the served extrinsic and of the latest result from the commissioned one; None
            before commissioning.
        since_ns: wall clock when the state of health began.
        completed_stamp_ns, age_s: sensor time and age of the last completed check; None if unknown.
        checks, solved: number of completed checks and of solved windows.
        transitions: number of changes of health, by the state that was entered.
    """

    state: PairState
    served: ServedExtrinsic
    check: CheckReply | None
    problems: tuple[Reason, ...]
    drift: BaselineDrift | None
    result_drift: BaselineDrift | None
    since_ns: int
    completed_stamp_ns: int | None
    age_s: float | None
    checks: int
    solved: int
    transitions: tuple[tuple[str, int], ...]


class CalibrationManager:
    """Decides about one pair. `mailbox` is for any thread; everything else belongs to `thread`."""

    def __init__(
        self,
        pair: PairConfig,
        stale_after_s: float,
        store: PairStore,
        baseline: RigBaseline,
        queue: ResultSchedule,
        pictures: IncidentPictures,
        stream: StreamControl,
        rig: RigMember,
        mailbox: TaskQueue,
        losses: LossCounter,
        calibrate_with: Callable[[CalibrationConfig], None],
        on_update: Callable[[PairSnapshot], None],
    ) -> None:
        """`calibrate_with` is called with the configuration for windows that begin from then on. `tell` is called with
        what is known, whenever something may have changed and once a second."""
        self.thread = ServiceThread(f"decisions-{pair.name}", self._run)
        self._name = pair.name
        self._rules = PairRules(pair.policy, pair.tracker, pair.monitor)
        self._stale_after_s = stale_after_s
        self._store = store
        self._baseline = baseline
        self._queue = queue
        self._pictures = pictures
        self._stream = stream
        self._rig = rig
        self._mailbox = mailbox
        self._losses = losses
        self._calibrate_with = calibrate_with
        self._on_update = on_update
        self._progress = CheckProgress(pair.monitor.period_s, time.monotonic(), stream.report)
        self._clocks_checked_s = time.monotonic()
        self._latest_check: CheckReply | None = None
        self._checks = 0
        self._solved = 0
        self._check_attempts = Attempts("checks", "monitor_blind")
        self._window_attempts = Attempts("windows", "windows_in_vain")
        self._overdue: Reason | None = None
        self._unpublished = False
        self._health = store.state.health

    def request_stop(self) -> None:
        """Has the thread take what has come, and end."""
        self.thread.request_stop()
        self._mailbox.wake()

    def snapshot(self) -> PairSnapshot:
        """What is known now."""
        state, latest = self._store.state, self._store.state.latest
        accepted = None if state.accepted is None else state.accepted.sigma
        return PairSnapshot(
            state=state,
            served=self._store.served,
            check=self._latest_check,
            problems=self._problems(),
            drift=self._baseline.drift(state.T_camera_lidar, accepted),
            result_drift=None if latest is None else self._baseline.drift(latest.optimum.T_camera_lidar, latest.sigma),
            since_ns=self._store.since_ns,
            completed_stamp_ns=self._store.completed_stamp_ns,
            age_s=self._store.age_s,
            checks=self._checks,
            solved=self._solved,
            transitions=tuple(self._store.transitions.items()),
        )

    # --- the thread -------------------------------------------------------------------------------------------------

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            self.work(TICK_S)
        self.finish()

    def finish(self) -> None:
        """Takes what has come, and saves the state; for the end of the service."""
        while (item := self._mailbox.take(0.0)) is not None:
            item()
        self._store.save()

    def work(self, timeout_s: float) -> bool:
        """Does the next piece of work, or looks at the clocks if none comes for `timeout_s`. Returns whether there was
        work."""
        item = self._mailbox.take(UNPUBLISHED_RETRY_S if self._unpublished else timeout_s)
        if item is not None:
            item()
        now_s = time.monotonic()
        if item is not None or self._unpublished or now_s - self._clocks_checked_s >= TICK_S:
            self.check_clocks(now_s)
        self._note_event()
        return item is not None

    def _note_event(self) -> None:
        """If the pair has just entered a state of `EVENTS`, has the stream keep the seconds around it. This changes no
        decision."""
        before, state = self._health, self._store.state
        self._health = state.health
        if state.health is not before and state.health in INCIDENT_STATES:
            self._stream.call(partial(self._stream.event, state.health.value, state.T_camera_lidar))

    def publish(self) -> None:
        """Reports what is known, even if it is not on the disk yet."""
        self._unpublished = False
        self._on_update(self.snapshot())

    def check_clocks(self, monotonic_s: float) -> None:
        """Gives up questions that have waited too long, ages the state, and reports it."""
        self._clocks_checked_s = monotonic_s
        lost = self._queue.expire(monotonic_s, self._lost_question)
        if lost:
            self._losses.add("monitor", "unanswered", lost)
        at_rest = holds_at_rest(self._store.state.monitor)
        self._overdue = self._progress.overdue(self._stream.report, monotonic_s, at_rest=at_rest)
        self._store.age(self._overdue, self._progress.silent_s(monotonic_s), self._stale_after_s)
        # As long as the disk is only busy, nothing is reported that a restart would not know.
        self._unpublished = not self._store.may_be_published()
        if not self._unpublished:
            self.publish()

    def reconfigure(self, pair: PairConfig, stale_after_s: float, history_text: str) -> None:
        """Judges by other settings from now on; `told` is the entry for the history."""
        self._rules = PairRules(pair.policy, pair.tracker, pair.monitor)
        self._stale_after_s = stale_after_s
        self._baseline.reconfigure(pair)
        self._calibrate_with(self._baseline.calibration)
        self._store.note_command("reload", "reloaded", history_text, "SIGHUP", accepted=True)
        self._store.save()

    # --- answers ----------------------------------------------------------------------------------------------------

    def checked(self, request: PendingRequest, epoch: int, standing_ns: tuple[int, ...], outcome: JobOutcome) -> None:
        """A check of the extrinsic of `epoch` has ended. `standing_ns`: stamps of its pairs that were taken while the
        vehicle stood."""
        self._queue.answer(request, partial(self._take_check, request, epoch, standing_ns, outcome))

    def solved(self, window_id: str, outcome: JobOutcome, *, live: bool) -> None:
        """The solve of a window has ended."""
        request = self._queue.about(window_id) if live else None
        take: TakeResult = (
            partial(self._take_result, request, outcome.answer, live)
            if isinstance(outcome.answer, Solved)
            else partial(self._take_failure, outcome.reason or _NO_ANSWER, live)
        )
        if request is not None:
            self._queue.answer(request, take)
        elif (effect := take()) is not None:
            # No question waits for this window: it was solved by command, or is of an earlier run.
            self._stream.call(effect)

    def lost(self, window_id: str) -> None:
        """A window ended without being recorded."""
        request = self._queue.about(window_id)
        if request is not None:
            self._queue.answer(request, partial(self._take_failure, _NOT_RECORDED, True))

    def corrected(self, request: PendingRequest, correction: PairCorrection) -> None:
        """The rig has a correction for the pair."""
        self._queue.answer(request, partial(self._take_correction, request, correction))

    def time_stepped_back(self, stamp_ns: int) -> None:
        """The clock of the sensors has stepped back, to this stamp."""
        self._progress.time_stepped_back()
        self._latest_check = None
        taken = self._store.update(
            lambda state: lifecycle.time_stepped_back(state, stamp_ns), stamp_ns, completed=False
        )
        if taken is not None and taken.after.flagged_since_ns is not None:
            since_ns = taken.after.flagged_since_ns
            self._stream.call(lambda: self._stream.alarm(since_ns))

    def replaced(self) -> None:
        """A person has replaced the extrinsic, so no earlier check is about the served one."""
        self._latest_check = None
        served = self._store.served
        self._rig.serves(None, self._store.state)

        def start_over() -> None:
            self._stream.adopt(served)
            self._stream.calm()

        self._stream.call(start_over)

    def commissioned(self, window_ids: tuple[str, ...], outcome: JobOutcome) -> None:
        """A commissioning from these windows has ended."""
        answer = outcome.answer
        if not isinstance(answer, Commissioned):
            reason = outcome.reason or _NO_ANSWER
            self._losses.add("window", "commissioning_failed", detail=reason.text)
            self._store.note_command("commission", reason.code, f"failed: {reason.text}", "service", accepted=False)
            self._store.save()
            return
        self._baseline.load()
        self._calibrate_with(self._baseline.calibration)
        some = f"{answer.windows} window{'' if answer.windows == 1 else 's'}"
        text = f"Commissioned from {some}, {answer.pairs} pairs; baseline {answer.baseline_hash}."
        self._store.note_commissioned(text, window_ids)
        pose = answer.pose
        effect = self._step(lambda state: lifecycle.after_commissioning(state, pose), None, completed=False)
        if effect is not None:
            self._stream.call(effect)

    # --- taking them, in order --------------------------------------------------------------------------------------

    def _take_check(
        self, request: PendingRequest, epoch: int, standing_ns: tuple[int, ...], outcome: JobOutcome
    ) -> Effect | None:
        answer = outcome.answer
        if not isinstance(answer, Checked):
            self._check_failed(outcome.reason or _NO_ANSWER)
            return None
        refused = answer.baseline_not_used is not None and self._baseline.refuse(answer.baseline_not_used)
        observation = replace(answer.observation, standing_stamps_ns=standing_ns)
        before = self._store.state
        effect = self._step(
            lambda state: lifecycle.after_observation(state, observation, self._rules),
            observation.stamp_ns,
            completed=True,
            request=request,
            epoch=epoch,
            by_check=True,
        )
        if effect is None:
            self._losses.add("monitor", "check_overtaken")
        else:
            self._rig.on_check(request.due_ns, before, self._store.state, observation)
            self._check_attempts.succeeded()
            self._checks += 1
            self._latest_check = check_of(observation, self._store.state)
            self._store.note_check(self._latest_check)
            self._log_finding(before.monitor.outcome, self._store.state.monitor.outcome)
        return self._with_new_configuration(effect) if refused else effect

    def _check_failed(self, reason: Reason) -> None:
        self._losses.add("monitor", f"check_{reason.code}", detail=reason.text)
        self._progress.failed(reason)
        self._check_attempts.failed(reason)

    def _take_result(self, request: PendingRequest | None, answer: Solved, live: bool) -> Effect | None:
        result = answer.result
        self._log_result(result)
        if answer.written is not None:
            self._note_file(result, answer.written)
        if answer.note is not None:
            self._losses.add("window", "result_not_written", detail=answer.note.text)
        fits = self._baseline.fits_network(result.depth_identity)
        if not fits:
            self._baseline.refuse("It was made with another depth network.")
        self._store.note_result(result)
        self._solved += 1
        self._window_attempts.succeeded()
        latest = self._store.state.latest
        # A window of an earlier run is old news when a newer one has been evaluated.
        effect = None
        if live or latest is None or latest.data_stamp_ns <= result.data_stamp_ns:
            effect = self._judge(request, result)
        else:
            self._store.save()
        return effect if fits else self._with_new_configuration(effect)

    def _log_result(self, result: CalibrationResult) -> None:
        """Logs the verdict of a window, how far its estimate is from what is served, and why it is refused."""
        step = se3.difference(matrix_of(result.camera_from_lidar), self._store.state.T_camera_lidar)
        turned_deg, moved_m = float(np.degrees(np.linalg.norm(step[:3]))), float(np.linalg.norm(step[3:]))
        sigma_deg = max((value for value in result.sigma[:3] if value is not None), default=None)
        text = f"window solved, {result.verdict.decision}: {turned_deg:.2f}° and {moved_m:.3f} m from what is served"
        if sigma_deg is not None:
            text += f", σ {sigma_deg:.2f}°"
        if result.verdict.reasons:
            text += f"; {' '.join(reason.text for reason in result.verdict.reasons)}"
        fields = {
            "pair": self._name,
            "window": result.window_id,
            "decision": result.verdict.decision,
            "change_deg": round(turned_deg, 4),
            "change_m": round(moved_m, 4),
            "sigma_deg": None if sigma_deg is None else round(sigma_deg, 4),
            "reasons": [reason.code for reason in result.verdict.reasons],
        }
        _log.info(text, extra={"fields": fields})

    def _log_finding(self, before: MonitorOutcome, after: MonitorOutcome) -> None:
        """Logs what the checks say if that has changed, or is said for the first time."""
        if after is not before or self._checks == 1:
            fields = {"pair": self._name, "from": before.value, "to": after.value, "checks": self._checks}
            _log.info(f"checks: {FINDINGS[after]}", extra={"fields": fields})

    def _note_file(self, result: CalibrationResult, file: WrittenFile) -> None:
        version = WindowVersion(
            size_bytes=file.size_bytes,
            modified_ns=file.modified_ns,
            sha256=file.sha256,
            pairs=file.pairs,
            decision=result.verdict.decision,
        )
        self._store.note_window(result.window_id, version)

    def _judge(self, request: PendingRequest | None, result: CalibrationResult) -> Effect | None:
        estimate, start_ns = self._baseline.unbiased(estimate_of(result)), start_ns_of(result.window_id)
        # When the answer counts, whenever it came: a replay decides alike.
        now_ns = self._stream.report.selection.last_ns if request is None else request.due_ns
        has_estimate = estimate.verdict.decision is not Decision.FAILED
        if has_estimate:
            self._rig.accepted(_due_ns(request), estimate)
        self._step(
            lambda state: lifecycle.before_estimate(state, estimate, start_ns, self._rules),
            result.data_stamp_ns,
            completed=False,
            request=request,
        )
        self._add_window_after(result)
        effect = self._step(
            lambda state: lifecycle.after_estimate(state, estimate, start_ns, self._rules, now_ns),
            result.data_stamp_ns,
            completed=has_estimate,
            request=request,
        )
        carried_over = lifecycle.carried_over_pairs(estimate)
        return (
            effect
            if carried_over is None or effect is None
            else partial(self._carry_over_and_apply, carried_over, effect)
        )

    def _with_new_configuration(self, effect: Effect | None) -> Effect:
        """The effect, and with it another configuration for the windows that begin once this answer counts."""
        configuration = self._baseline.calibration

        def both() -> None:
            self._calibrate_with(configuration)
            if effect is not None:
                effect()

        return both

    def _take_correction(self, request: PendingRequest, correction: PairCorrection) -> Effect | None:
        """Serves the correction that the rig found for all pairs of a moved sensor together, as far as the policy
        allows it."""
        state = self._store.state
        latest = state.latest
        estimate = latest if latest is not None and latest.verdict.decision is Decision.ACCEPTED else state.accepted
        if estimate is None:
            self._losses.add("monitor", "correction_of_nothing")
            return None
        joint = lifecycle.with_rig_covariance(
            self._baseline.moved(estimate, correction.joint_pose.T_a_b), correction.joint_pose.covariance
        )
        self._store.note_command("rig", "corrected", correction.text, "service", accepted=True)
        return self._step(
            lambda state: lifecycle.after_joint(state, joint, correction.stamp_ns, self._rules),
            correction.stamp_ns,
            completed=False,
            request=request,
        )

    def _take_failure(self, reason: Reason, live: bool) -> Effect | None:
        if reason.code == STOPPING.code:
            return None  # the window stays on the disk, and is solved after the next start
        self._losses.add("window", reason.code, detail=reason.text)
        if not live:
            return None
        self._window_attempts.failed(reason)
        return self._step(lambda state: lifecycle.after_failure(state, reason), None, completed=False)

    def _lost_question(self, request: PendingRequest) -> TakeResult:
        if request.name:
            return partial(self._take_failure, _NO_ANSWER, True)

        def take() -> None:
            self._check_failed(_NO_ANSWER)

        return take

    def _step(
        self,
        step: Callable[[PairState], PairState],
        stamp_ns: int | None,
        *,
        completed: bool,
        request: PendingRequest | None = None,
        epoch: int | None = None,
        by_check: bool = False,
    ) -> Effect | None:
        """Takes a step, the answer to a question, and has the pictures of a red event drawn. Returns its effect on the
        pairs to come; None if the step was meant for another extrinsic."""
        taken = self._store.update(step, stamp_ns, completed=completed, epoch=epoch)
        if taken is None:
            return None
        before, after = taken.before, taken.after
        if completed:
            acquits = stamp_ns is not None and after.monitor.acquitted_ns == stamp_ns
            self._progress.completed(stamp_ns, time.monotonic(), self._stream.report, acquits=acquits)
        if not np.array_equal(before.T_camera_lidar, after.T_camera_lidar):
            self._latest_check = None
            self._rig.serves(_due_ns(request), after)
        red, event = HealthState.MISCALIBRATED, self._store.incidents.newest
        if after.health is red and before.health is not red and event is not None:
            self._pictures.request_overlay(event)
        return partial(self._apply_to_stream, taken, by_check)

    def _add_window_after(self, result: CalibrationResult) -> None:
        """Adds a result to the evidence of a red event if it is the first window that began after the event began."""
        waiting, since_ns = self._store.incidents.awaiting, self._store.state.flagged_since_ns
        if waiting is None or start_ns_of(result.window_id) < (waiting.stamp_ns if since_ns is None else since_ns):
            return
        event = self._store.incidents.add_window_after(result.window_id)
        self._store.protect()
        if event is not None:
            self._pictures.request_comparison(event, matrix_of(result.camera_from_lidar), result.verdict.decision)

    # --- on the stream's thread -------------------------------------------------------------------------------------

    def _carry_over_and_apply(self, carried_over: CarriedOverPairs, effect: Effect) -> None:
        self._stream.carry_over(carried_over)
        effect()

    def _apply_to_stream(self, taken: StateTransition, by_check: bool) -> None:
        """The effect of a step on the pairs to come: the extrinsic at which they are looked at, and whether a window is
        wanted soon. It is if the monitor's outcome or health has changed, if a window did not settle the suspicion, or
        if a window saw a step."""
        self._stream.adopt(taken.served)
        before, after = taken.before, taken.after
        since_ns = lifecycle.urgent_window_since(after)
        if since_ns is None:
            self._stream.calm()
            return
        waiting = after.pending is not None and after.pending.contradicts
        unchanged = before.monitor.outcome is after.monitor.outcome and before.seen is after.seen
        if not waiting and not (by_check and unchanged):
            self._stream.alarm(since_ns)

    # --- what ails --------------------------------------------------------------------------------------------------

    def _problems(self) -> tuple[Reason, ...]:
        own = (
            self._store.damage,
            self._baseline.problem,
            self._check_attempts.problem,
            self._window_attempts.problem,
            self._overdue,
        )
        reported = {reason.code for reason in self._store.state.reasons}
        hold = self._store.state.hold
        held = None
        if hold is not None:
            text = hold_text(hold.sender, hold.since_ns, hold.reason)
            held = Reason(HELD, f"The extrinsic is {text}.")
        return tuple(reason for reason in (*own, held) if reason is not None and reason.code not in reported)


def _due_ns(request: PendingRequest | None) -> int | None:
    """Sensor time from which the answer to a question counts; None: from now on, because no stream asked for it."""
    return None if request is None else request.due_ns


HELD = "held"
"""Code of the only reason in `troubles` that is no trouble: the extrinsic is on hold."""

_NO_ANSWER = Reason("unanswered", "The worker did not answer.")
_NOT_RECORDED = Reason("not_recorded", "The window was not written to the disk.")
