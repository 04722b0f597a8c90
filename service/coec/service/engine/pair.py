"""One camera-LiDAR pair as a state machine: events in, actions out.

`step` takes one event after the other: the streams have come to a sensor time, a frame pair, the outcome of a job, the
passing of time, another configuration. It returns what is to be done outside, as values (`messages`). `execute` of
`commands` does the same for a command of a person. Nothing here waits or has a thread, and the clocks are given by the
caller.

What a job changes takes effect in two steps (`schedule`). Its outcome is concluded as soon as it and those of all
earlier requests have come: that changes the state and what is served. What that changes in the selection of frames is
applied at the sensor time that was fixed when the job was submitted. Only this class changes the state of the pair.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from types import MappingProxyType

import numpy as np

from coec.calibration import state as lifecycle
from coec.calibration.monitor.change_detector import MonitorOutcome, holds_at_rest
from coec.calibration.state import PairRules, PairState
from coec.calibration.state_machine import HealthState
from coec.calibration.types import Decision, FramePair, Matrix4, Reason
from coec.config import PairConfig
from coec.geometry import se3
from coec.io.logs import LossCounter
from coec.io.serialise import check_of, estimate_of, matrix_of
from coec.reports.formatting import hold_text
from coec.schemas.replies import CalibrationResult, CheckReply, EvidenceEvent
from coec.service.engine import messages
from coec.service.engine.check_progress import Attempts, CheckProgress
from coec.service.engine.frame_selector import GRACE_S, FrameSelector
from coec.service.engine.rig import PairCorrection, RigMember
from coec.service.ingest.pair_stream import StreamStatistics
from coec.service.recording.recorder import WindowLost, WindowRecorded
from coec.service.recording.window_store import WindowVersion, start_ns_of
from coec.service.records.pair_store import PairStore, StateTransition
from coec.service.records.rig_store import RigBaseline
from coec.service.timing import Clock
from coec.service.worker.job_queue import STOPPING
from coec.service.worker.worker_jobs import Checked, Commissioned, JobOutcome, RenderedImage, Solved, WrittenFile

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

TICK_S = 1.0
"""Longest time between two evaluations of the clocks, s. While the engine runs, health is never older than that."""

SERVED_CAPTION = "what was served when it turned red"
"""Caption of the first extrinsic of a picture."""

HELD = "held"
"""Code of the only reason in `problems` that is no problem: the extrinsic is on hold."""

_NO_ANSWER = Reason("unanswered", "The worker did not answer.")
_NOT_RECORDED = Reason("not_recorded", "The window was not written to the disk.")


class Pair:
    """The state machine of one pair.

    Attributes:
        store: its state and records.
        selector: its selection of frames.
        warms_up: the worker compiles kernels before it takes jobs. No result is awaited then, because that takes longer
            than frames can be held.
        ticked_s: steady clock at the latest `Tick`, s; -∞ if something has changed since, so that the next one is due.
        is_unpublished: what is known waits for the disk before it is published.
        is_waiting: frame pairs of the sensor time of the latest `SensorTime` may not be evaluated yet, because a result
            of the worker or of the rig that counts before them has not come.
    """

    def __init__(
        self,
        pair: PairConfig,
        stale_after_s: float,
        store: PairStore,
        baseline: RigBaseline,
        schedule: messages.PairSchedule,
        selector: FrameSelector,
        member: RigMember,
        losses: LossCounter,
        clock: Clock,
    ) -> None:
        self.store = store
        self.selector = selector
        self.warms_up = self.is_waiting = False
        self._name = pair.name
        self._rules = PairRules(pair.policy, pair.tracker, pair.monitor)
        self._stale_after_s = stale_after_s
        self._baseline = baseline
        self._schedule = schedule
        self._member = member
        self._losses = losses
        self._clock = clock
        self._statistics = StreamStatistics()
        self.ticked_s = -inf
        self._counted_s = clock.monotonic_s()
        selector.tick(self._counted_s)
        self._progress = CheckProgress(pair.monitor.period_s, clock.monotonic_s(), self._statistics)
        self._latest_check: CheckReply | None = None
        self._checks = self._solved = 0
        self._check_attempts = Attempts("checks", "monitor_blind")
        self._window_attempts = Attempts("windows", "windows_in_vain")
        self._overdue: Reason | None = None
        self.is_unpublished = False
        self._health = store.state.health
        self._actions: list[messages.Action] = []

    # --- for the caller: predicates, which change nothing -----------------------------------------------------------

    @property
    def unanswered(self) -> int:
        """Number of requests without a result."""
        return self._schedule.unanswered

    @property
    def oldest_request(self) -> messages.PairRequest | None:
        """The request whose result is to be concluded next; None if there is none."""
        return self._schedule.oldest

    def snapshot(self) -> messages.PairSnapshot:
        """What is known now."""
        state, latest = self.store.state, self.store.state.latest
        accepted = None if state.accepted is None else state.accepted.sigma
        return messages.PairSnapshot(
            state=state,
            served=self.store.served,
            check=self._latest_check,
            problems=self._problems(),
            drift=self._baseline.drift(state.T_camera_lidar, accepted),
            result_drift=None if latest is None else self._baseline.drift(latest.optimum.T_camera_lidar, latest.sigma),
            since_ns=self.store.since_ns,
            completed_stamp_ns=self.store.completed_stamp_ns,
            age_s=self.store.age_s,
            checks=self._checks,
            solved=self._solved,
            transitions=tuple(self.store.transitions.items()),
        )

    # --- events -----------------------------------------------------------------------------------------------------

    def step(self, event: messages.Event) -> list[messages.Action]:
        """Takes an event; returns what is to be done, in order."""
        match event:
            case messages.SensorTime():
                self._advance(event.stamp_ns)
            case messages.Evaluate():
                self._evaluate(event.pair, is_forced=event.is_forced)
            case messages.JobDone():
                self._on_job(event)
            case WindowRecorded():
                self._actions.append(
                    messages.SubmitSolve(messages.WindowSubject(event.window_id, event.live), event.path)
                )
            case WindowLost():
                request = self._schedule.unanswered_about(messages.WindowSubject(event.window_id))
                if request is not None:
                    self._answer(request, _NOT_RECORDED)
            case messages.Tick():
                self._tick(event)
            case messages.Reconfigured():
                self._reconfigure(event)
        before, state = self._health, self.store.state
        self._health = state.health
        if state.health is not before and state.health in INCIDENT_STATES:
            self._actions.append(messages.KeepSnippet(state.health.value, state.T_camera_lidar))
        actions, self._actions = self._actions, []
        return actions

    def take_actions(self) -> list[messages.Action]:
        """What is to be done since the last step."""
        actions, self._actions = self._actions, []
        return actions

    def _advance(self, stamp_ns: int) -> None:
        """The streams have come to a sensor time: ends a slice that is over by then, unless a result that counts by its
        end is missing, and takes the corrections of the rig. The first frame pair after a step back of sensor time
        makes all outstanding results due."""
        end_ns = self.selector.slice_end_ns
        if self.selector.is_step_back(stamp_ns):
            self._schedule.bring_forward(stamp_ns)
        elif end_ns is not None and end_ns <= stamp_ns:
            self._follow_rig(end_ns)
            if self.is_waiting:
                return
            self._actions += self.selector.end_slice()
        self._follow_rig(stamp_ns)

    def _follow_rig(self, stamp_ns: int) -> None:
        """Reports to the rig how far the pair has come, and takes its corrections that count by then, unless a result
        that counts by then has not come."""
        waits = self._schedule.waits(stamp_ns) and not self.warms_up
        self._member.report_time(stamp_ns, waits=waits)
        self.is_waiting = waits or self._member.waits(stamp_ns)
        if self.is_waiting:
            return
        for correction in self._member.corrections(stamp_ns):
            self._answer(self._schedule.submit(correction, correction.from_ns, self._counted_s + GRACE_S), correction)

    def _evaluate(self, pair: FramePair, *, is_forced: bool) -> None:
        if is_forced and self.is_waiting:
            self._losses.add("monitor", "not_awaited")
        stamp_ns = pair.camera.stamp_ns
        steps_back = self.selector.is_step_back(stamp_ns)
        if steps_back:
            self._begin_new_time(stamp_ns)
        self._actions += self.selector.select(pair)
        since_ns = self.store.state.flagged_since_ns
        if steps_back and since_ns is not None:
            self._actions += self.selector.apply(messages.SelectionChange(urgent_since_ns=since_ns))

    def _begin_new_time(self, stamp_ns: int) -> None:
        """The clock of the sensors has stepped back, to this stamp."""
        self._member.time_stepped_back(stamp_ns)
        self._progress.time_stepped_back()
        self._latest_check = None
        self.ticked_s = -inf
        self.store.update(lambda state: lifecycle.time_stepped_back(state, stamp_ns), stamp_ns, completed=False)

    def _tick(self, event: messages.Tick) -> None:
        """Gives up requests that have waited too long, ages the state, and publishes it."""
        now_s = self._clock.monotonic_s()
        self.ticked_s = now_s
        self._statistics, self._counted_s = event.statistics, now_s - event.uncounted_s
        self.selector.tick(self._counted_s)
        for request in self._schedule.expired(self._counted_s):
            self._losses.add("monitor", "unanswered")
            self._answer(request, _NO_ANSWER)
        at_rest = holds_at_rest(self.store.state.monitor)
        self._overdue = self._progress.overdue(event.statistics, now_s, at_rest=at_rest)
        self.store.age(self._overdue, self._progress.silent_s(now_s), self._stale_after_s)
        # As long as the disk is only busy, nothing is published that a restart would not know.
        self.is_unpublished = not self.store.may_be_published()
        if not self.is_unpublished:
            self._actions.append(messages.Publish(self.snapshot()))

    def publish(self) -> None:
        """Publishes what is known, even if it is not on the disk yet."""
        self.is_unpublished = False
        self._actions.append(messages.Publish(self.snapshot()))

    def _reconfigure(self, event: messages.Reconfigured) -> None:
        self._rules = PairRules(event.pair.policy, event.pair.tracker, event.pair.monitor)
        self._stale_after_s = event.stale_after_s
        self.selector.reconfigure(event.pair)
        self._baseline.reconfigure(event.pair)
        self._actions.append(messages.UseCalibration(self._baseline.calibration))
        self.store.note_command("reload", "reloaded", event.history_text, "SIGHUP", accepted=True)
        self.store.save()
        self.ticked_s = -inf

    # --- outcomes ---------------------------------------------------------------------------------------------------

    def _on_job(self, event: messages.JobDone) -> None:
        self.ticked_s = -inf
        match event.subject:
            case messages.WindowSubject():
                self._on_solved(event.subject, event.outcome)
            case messages.PictureSubject():
                self._on_picture(event.subject, event.outcome)
            case messages.CommissioningSubject():
                self._on_commissioned(event.subject.window_ids, event.outcome)
            case request:
                self._answer(request, event.outcome)

    def _on_solved(self, subject: messages.WindowSubject, outcome: JobOutcome) -> None:
        """The solve of a window has ended. If no request waits for it, it was solved by command, or is of an earlier
        run: then it counts at once."""
        request = self._schedule.unanswered_about(subject) if subject.live else None
        if request is not None:
            self._answer(request, outcome)
        else:
            self._apply(self._conclude_window(None, subject, outcome))

    def _answer(self, request: messages.PairRequest, result: messages.PairResult) -> None:
        """A result has come: concludes all whose turn it is. A second result of a request is ignored."""
        self.ticked_s = -inf
        self._schedule.answer(request, result)
        while (answered := self._schedule.next_answered()) is not None:
            self._schedule.conclude(answered, self._conclude(answered))

    def _apply(self, change: messages.SelectionChange | None) -> None:
        """Applies a change that no sensor time delays."""
        if change is not None:
            self._actions += self.selector.apply(change)

    def _conclude(self, request: messages.PairRequest) -> messages.SelectionChange | None:
        """Takes a result into the state; returns what it changes in the selection."""
        subject, result = request.subject, request.result
        assert result is not None  # `next_answered` returns no other
        match subject:
            case messages.CheckSubject():
                return self._conclude_check(request, subject, result)
            case messages.WindowSubject():
                return self._conclude_window(request, subject, result)
            case PairCorrection():
                return self._conclude_correction(request, subject)

    def _conclude_check(
        self, request: messages.PairRequest, subject: messages.CheckSubject, result: messages.PairResult
    ) -> messages.SelectionChange | None:
        answer = result.answer if isinstance(result, JobOutcome) else None
        if not isinstance(answer, Checked):
            reason = _why_not(result)
            self._losses.add("monitor", f"check_{reason.code}", detail=reason.text)
            self._progress.failed(reason)
            self._check_attempts.failed(reason)
            return None
        refused = answer.baseline_not_used is not None and self._baseline.refuse(answer.baseline_not_used)
        observation = replace(answer.observation, standing_stamps_ns=subject.standing_ns)
        before = self.store.state
        change = self._update(
            lambda state: lifecycle.after_observation(state, observation, self._rules),
            observation.stamp_ns,
            completed=True,
            request=request,
            epoch=subject.epoch,
            by_check=True,
        )
        if change is None:
            self._losses.add("monitor", "check_overtaken")
        else:
            self._member.on_check(request.due_ns, before, self.store.state, observation)
            self._check_attempts.succeeded()
            self._checks += 1
            self._latest_check = check_of(observation, self.store.state)
            self.store.note_check(self._latest_check)
            self._log_finding(before.monitor.outcome, self.store.state.monitor.outcome)
        return self._with_calibration(change) if refused else change

    def _conclude_window(
        self, request: messages.PairRequest | None, subject: messages.WindowSubject, result: messages.PairResult
    ) -> messages.SelectionChange | None:
        answer = result.answer if isinstance(result, JobOutcome) else None
        if not isinstance(answer, Solved):
            return self._conclude_failure(_why_not(result), live=subject.live)
        solved = answer.result
        self._log_result(solved)
        if answer.written is not None:
            self._note_file(solved, answer.written)
        if answer.note is not None:
            self._losses.add("window", "result_not_written", detail=answer.note.text)
        fits = self._baseline.fits_network(solved.depth_identity)
        if not fits:
            self._baseline.refuse("It was made with another depth network.")
        self.store.note_result(solved)
        self._solved += 1
        self._window_attempts.succeeded()
        latest = self.store.state.latest
        change = None
        # A window of an earlier run says nothing new when a newer one has been evaluated.
        if subject.live or latest is None or latest.data_stamp_ns <= solved.data_stamp_ns:
            change = self._judge(request, solved)
        else:
            self.store.save()
        return change if fits else self._with_calibration(change)

    def _conclude_failure(self, reason: Reason, *, live: bool) -> messages.SelectionChange | None:
        if reason.code == STOPPING.code:
            return None  # the window stays on the disk, and is solved after the next start
        self._losses.add("window", reason.code, detail=reason.text)
        if not live:
            return None
        self._window_attempts.failed(reason)
        return self._update(lambda state: lifecycle.after_failure(state, reason), None, completed=False)

    def _judge(
        self, request: messages.PairRequest | None, result: CalibrationResult
    ) -> messages.SelectionChange | None:
        estimate, start_ns = self._baseline.unbiased(estimate_of(result)), start_ns_of(result.window_id)
        # When the result counts, whenever it came: a replay decides alike.
        now_ns = self.selector.statistics.last_ns if request is None else request.due_ns
        has_estimate = estimate.verdict.decision is not Decision.FAILED
        if has_estimate:
            self._member.accepted(None if request is None else request.due_ns, estimate)
        self._update(
            lambda state: lifecycle.before_estimate(state, estimate, start_ns, self._rules),
            result.data_stamp_ns,
            completed=False,
            request=request,
        )
        self._add_window_after(result)
        change = self._update(
            lambda state: lifecycle.after_estimate(state, estimate, start_ns, self._rules, now_ns),
            result.data_stamp_ns,
            completed=has_estimate,
            request=request,
        )
        carried_over = lifecycle.carried_over_pairs(estimate)
        return change if carried_over is None or change is None else replace(change, carried_over=carried_over)

    def _conclude_correction(
        self, request: messages.PairRequest, correction: PairCorrection
    ) -> messages.SelectionChange | None:
        """Serves the correction that the rig found for all pairs of a moved sensor together, as far as the policy
        allows it."""
        state = self.store.state
        latest = state.latest
        estimate = latest if latest is not None and latest.verdict.decision is Decision.ACCEPTED else state.accepted
        if estimate is None:
            self._losses.add("monitor", "correction_of_nothing")
            return None
        joint = lifecycle.with_rig_covariance(
            self._baseline.moved(estimate, correction.joint_pose.T_a_b), correction.joint_pose.covariance
        )
        self.store.note_command("rig", "corrected", correction.text, "service", accepted=True)
        return self._update(
            lambda state: lifecycle.after_joint(state, joint, correction.stamp_ns, self._rules),
            correction.stamp_ns,
            completed=False,
            request=request,
        )

    def _on_commissioned(self, window_ids: tuple[str, ...], outcome: JobOutcome) -> None:
        """A commissioning from these windows has ended."""
        answer = outcome.answer
        if not isinstance(answer, Commissioned):
            reason = _why_not(outcome)
            self._losses.add("window", "commissioning_failed", detail=reason.text)
            self.store.note_command("commission", reason.code, f"failed: {reason.text}", "service", accepted=False)
            self.store.save()
            return
        self._baseline.load()
        self._actions.append(messages.UseCalibration(self._baseline.calibration))
        some = f"{answer.windows} window{'' if answer.windows == 1 else 's'}"
        text = f"Commissioned from {some}, {answer.pairs} pairs; baseline {answer.baseline_hash}."
        self.store.note_commissioned(text, window_ids)
        pose = answer.pose
        self._apply(self._update(lambda state: lifecycle.after_commissioning(state, pose), None, completed=False))

    def replaced(self) -> None:
        """A person has replaced the extrinsic, so no earlier check is about the served one."""
        self._latest_check = None
        self._member.serves(None, self.store.state)
        self._apply(messages.SelectionChange(served=self.store.served, is_calm=True))

    # --- the state --------------------------------------------------------------------------------------------------

    def _update(
        self,
        step: Callable[[PairState], PairState],
        stamp_ns: int | None,
        *,
        completed: bool,
        request: messages.PairRequest | None = None,
        epoch: int | None = None,
        by_check: bool = False,
    ) -> messages.SelectionChange | None:
        """Changes the state, and has the picture of an incident rendered. Returns what that changes in the selection;
        None if the step was meant for another extrinsic."""
        taken = self.store.update(step, stamp_ns, completed=completed, epoch=epoch)
        if taken is None:
            return None
        before, after = taken.before, taken.after
        if completed:
            acquits = stamp_ns is not None and after.monitor.acquitted_ns == stamp_ns
            self._progress.completed(stamp_ns, self._clock.monotonic_s(), self._statistics, acquits=acquits)
        if not np.array_equal(before.T_camera_lidar, after.T_camera_lidar):
            self._latest_check = None
            self._member.serves(None if request is None else request.due_ns, after)
        event = self.store.incidents.newest
        red = HealthState.MISCALIBRATED
        if after.health is red and before.health is not red and event is not None:
            self._render_beginning(event, after)
        return _selection_change(taken, by_check=by_check)

    def _with_calibration(self, change: messages.SelectionChange | None) -> messages.SelectionChange:
        """The change, and with it another configuration for the windows that begin once this result counts."""
        return replace(change or messages.SelectionChange(), calibration=self._baseline.calibration)

    # --- evidence ---------------------------------------------------------------------------------------------------

    def _add_window_after(self, result: CalibrationResult) -> None:
        """Adds a result to the evidence of an incident if it is the first window that began after the event began. The
        windows before and after it are rendered, each at the served extrinsic and at the one of this result: the first
        fits the images before the event, the second those after it."""
        waiting, since_ns = self.store.incidents.awaiting, self.store.state.flagged_since_ns
        if waiting is None or start_ns_of(result.window_id) < (waiting.stamp_ns if since_ns is None else since_ns):
            return
        event = self.store.incidents.add_window_after(result.window_id)
        self.store.protect()
        if event is not None:
            self._render_both_sides(event, matrix_of(result.camera_from_lidar), result.verdict.decision)

    def _render_beginning(self, event: EvidenceEvent, state: PairState) -> None:
        """An incident has begun. If a window has caused it, that is the window after it; else nothing but the window
        before it is known, which is rendered at the served extrinsic."""
        latest = state.latest
        if latest is not None and event.window_after == latest.window_id:
            self._render_both_sides(event, latest.optimum.T_camera_lidar, latest.verdict.decision.value)
        elif event.window_before is not None:
            self._actions.append(
                messages.SubmitPicture(
                    messages.PictureSubject(event.event_id, "before"),
                    event.window_before,
                    (matrix_of(event.camera_from_lidar),),
                    (f"{event.window_before}  at {SERVED_CAPTION}",),
                )
            )

    def _render_both_sides(self, event: EvidenceEvent, estimated: Matrix4, decision: str) -> None:
        """Has the windows before and after an event rendered, each at the served and at the estimated extrinsic."""
        poses = (matrix_of(event.camera_from_lidar), estimated)
        captions = (SERVED_CAPTION, f"found by the window after it ({decision})")
        for side, window_id in (("before", event.window_before), ("after", event.window_after)):
            if window_id is not None:
                subject = messages.PictureSubject(event.event_id, "before" if side == "before" else "after")
                self._actions.append(messages.SubmitPicture(subject, window_id, poses, captions))

    def _on_picture(self, subject: messages.PictureSubject, outcome: JobOutcome) -> None:
        if isinstance(outcome.answer, RenderedImage):
            self.store.add_picture(subject.event_id, subject.side, outcome.answer.jpeg)
        elif outcome.reason is not None:
            self._losses.add("storage", "overlay_not_drawn", detail=outcome.reason.text)

    def _note_file(self, result: CalibrationResult, file: WrittenFile) -> None:
        version = WindowVersion(
            size_bytes=file.size_bytes,
            modified_ns=file.modified_ns,
            sha256=file.sha256,
            pairs=file.pairs,
            decision=result.verdict.decision,
        )
        self.store.note_window(result.window_id, version)

    # --- for people -------------------------------------------------------------------------------------------------

    def _log_result(self, result: CalibrationResult) -> None:
        """Logs the verdict of a window, how far its estimate is from what is served, and why it is refused."""
        step = se3.difference(matrix_of(result.camera_from_lidar), self.store.state.T_camera_lidar)
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

    def _problems(self) -> tuple[Reason, ...]:
        own = (
            self.store.damage,
            self._baseline.problem,
            self._check_attempts.problem,
            self._window_attempts.problem,
            self._overdue,
        )
        reported = {reason.code for reason in self.store.state.reasons}
        hold = self.store.state.hold
        held = None
        if hold is not None:
            text = hold_text(hold.sender, hold.since_ns, hold.reason)
            held = Reason(HELD, f"The extrinsic is {text}.")
        return tuple(reason for reason in (*own, held) if reason is not None and reason.code not in reported)


def _why_not(result: messages.PairResult) -> Reason:
    """Why there is no answer."""
    if isinstance(result, Reason):
        return result
    return (result.reason if isinstance(result, JobOutcome) else None) or _NO_ANSWER


def _selection_change(taken: StateTransition, *, by_check: bool) -> messages.SelectionChange:
    """What a change of the state changes in the selection: the extrinsic at which frame pairs are evaluated, and
    whether a window is wanted soon. It is if the monitor's outcome or health has changed, if a window did not settle
    the suspicion, or if a window saw a step."""
    before, after = taken.before, taken.after
    since_ns = lifecycle.urgent_window_since(after)
    if since_ns is None:
        return messages.SelectionChange(taken.served, is_calm=True)
    waiting = after.pending is not None and after.pending.contradicts
    unchanged = before.monitor.outcome is after.monitor.outcome and before.seen is after.seen
    return messages.SelectionChange(
        taken.served, urgent_since_ns=None if waiting or (by_check and unchanged) else since_ns
    )
