"""Selects what each frame pair is used for, one after the other: a window, a check, or nothing.

The selection depends only on sensor time and on earlier requests: before a frame pair is evaluated, every result that
is due by its stamp has taken effect. So a replay of a drive gives the same windows and checks, at any rate and on any
machine.
"""

import logging
from collections import deque

from coec.calibration.frames import window
from coec.calibration.types import NS_PER_S, FramePair, Rig
from coec.config import MAX_SLICE_S, LimitsConfig, PairConfig
from coec.io.depth.depth_maps import STEREO
from coec.io.images import CompressingReducer, Inspector
from coec.io.logs import LossCounter
from coec.service.cpu_budget import Budget
from coec.service.engine import messages
from coec.service.engine.rig import RigMember
from coec.service.ingest.pair_stream import SelectionStatistics
from coec.service.recording.recorder import RecordBetween, RecordPair
from coec.service.recording.window_store import start_ns_of
from coec.service.records.pair_store import ServedExtrinsic
from coec.service.worker.worker_jobs import DEADLINE_S, Kind

_log = logging.getLogger(__name__)

CHECKS_WAITING = 4
"""How many checks may wait for the result of a window, 15 MB each: one for the period in which that result is awaited,
and one more for each further window that ends meanwhile."""

RESULT_PERIODS = 1
"""After so many periods of the monitor the result of a check or a window counts in the selection of further frames. At
5 s this is longer than either takes. If a result takes longer, the stream waits, and its frame pairs are held."""

GRACE_S = 30.0
"""Time beyond the worker's deadline, s, for a result to get from there to here, and for a window to get to the disk.
After that it is given up as lost."""

PROGRESS_S = 15.0
"""Time between two lines of the log about the frame pairs of a window, s."""


class FrameSelector:
    """The selection of one pair. What its methods return is to be done outside."""

    def __init__(
        self,
        pair: PairConfig,
        limits: LimitsConfig,
        rig: Rig,
        served: ServedExtrinsic,
        schedule: messages.PairSchedule,
        budget: Budget,
        member: RigMember,
        losses: LossCounter,
        first_slice_s: float,
        carried_over: window.CarriedOverPairs | None = None,
    ) -> None:
        """`served` is the extrinsic at which frame pairs are evaluated until another is served. `carried_over` are
        pairs of an earlier run that belong to the first window."""
        self._pair = pair
        self._schedule, self._budget, self._member = schedule, budget, member
        self._losses = losses
        self._served = served
        self._infers = pair.calibration.depth.model != STEREO
        # The period stays that of the start, because the due times of open requests were set by it.
        self._period_ns = round(pair.monitor.period_s * NS_PER_S)
        self._window, self._stretch = pair.window, 1.0
        self._cutter = window.WindowCutter(pair.window, rig, Inspector(limits), CompressingReducer(limits))
        if first_slice_s < pair.window.slice_s:
            self._cutter.hurry(first_slice_s)
        if carried_over is not None:
            self._cutter.carry_over(carried_over)
        self._sampler = window.CheckSampler(pair.monitor)
        self._urgency = window.UrgentWindow(pair.monitor)
        self._waiting_checks: deque[tuple[FramePair, ...]] = deque(maxlen=CHECKS_WAITING)
        self._waits_its_turn = False
        self._suspected = False
        self._frozen = False
        self._last_ns: int | None = None
        self._window_due_ns = self._latest_window_ns = 0
        self._checks = self._not_afforded = self._steps_back = 0
        self._counted_s = 0.0
        self._logged_s = -PROGRESS_S

    @property
    def statistics(self) -> SelectionStatistics:
        """What was selected so far."""
        return SelectionStatistics(
            self._cutter.selected,
            tuple((cause, count) for cause, count in self._cutter.rejections.items() if count),
            self._cutter.last_quality,
            self._frozen,
            self._checks,
            self._not_afforded,
            self._last_ns,
            self._steps_back,
            self._schedule.unanswered,
        )

    @property
    def slice_end_ns(self) -> int | None:
        """Sensor time at which the open slice ends; None when none is open."""
        return self._cutter.slice_end_ns

    def is_step_back(self, stamp_ns: int) -> bool:
        """Whether sensor time has stepped back if this is the stamp of the next frame pair."""
        return self._last_ns is not None and stamp_ns < self._last_ns

    def ends_slice(self, stamp_ns: int) -> bool:
        """Whether the open slice is over at this sensor time."""
        end_ns = self._cutter.slice_end_ns
        return end_ns is not None and stamp_ns >= end_ns

    def tick(self, counted_s: float) -> None:
        """`counted_s`: the time by which requests expire."""
        self._counted_s = counted_s

    def reconfigure(self, pair: PairConfig) -> None:
        """Cuts the next slice, and requests checks, by these settings."""
        self._pair = pair
        self._window, self._stretch = pair.window, 1.0
        self._cutter.reconfigure(pair.window)

    def expires_s(self, kind: Kind) -> float:
        """When the result of a job that is submitted now is given up."""
        return self._counted_s + DEADLINE_S[kind] + GRACE_S

    # --- selection --------------------------------------------------------------------------------------------------

    def select(self, pair: FramePair) -> list[messages.Action]:
        """Evaluates the next frame pair and uses it for the window, for a check, or not at all."""
        stamp_ns = pair.camera.stamp_ns
        actions: list[messages.Action] = []
        self._follow_budget()
        if self.is_step_back(stamp_ns):
            self._schedule.bring_forward(stamp_ns)
            actions += self._apply_due(stamp_ns)
            self._begin_new_time(stamp_ns)
        else:
            if self.ends_slice(stamp_ns):
                actions += self.end_slice()
            actions += self._apply_due(stamp_ns)
        self._last_ns = stamp_ns
        since_ns = self._member.pop_window_request(stamp_ns)
        if since_ns is not None:
            self._hurry_for_rig(since_ns, stamp_ns)
        frozen_before = self._cutter.rejections["frozen"]
        self._urgency.observe(stamp_ns)
        urgent = self._urgency.apply(self._cutter)
        events = self._cutter.offer(pair, self._served.T_camera_lidar)
        check = self._sampler.offer(pair)
        for closed in urgent:
            actions.append(self._close(closed, stamp_ns))
        for event in events:
            actions += self._on_window_event(event, stamp_ns)
        self._frozen |= self._cutter.rejections["frozen"] > frozen_before
        if check is not None:
            self._await_turn(check)
        if self._waiting_checks and stamp_ns >= self._window_due_ns:
            actions += self._submit_checks(stamp_ns)
        return actions

    def end_slice(self) -> list[messages.Action]:
        """Ends the open slice at its end, whether a frame pair or silence tells the time; the results that count by
        then take effect first. So the result of its window counts from the same time on in both cases."""
        end_ns = self._cutter.slice_end_ns
        if end_ns is None:
            return []
        actions = self._apply_due(end_ns)
        for closed in self._urgency.apply(self._cutter):
            actions.append(self._close(closed, end_ns))
        for closed in self._cutter.advance(end_ns):
            actions += self._on_window_event(closed, end_ns)
        return actions

    def finish(self) -> window.SliceClosed | None:
        """Ends the open slice at once; None if none is open. The `SliceClosed` is an action."""
        for closed in self._cutter.finish():
            return self._close(closed, self._last_ns or 0)
        return None

    # --- changes by results -----------------------------------------------------------------------------------------

    def apply(self, change: messages.SelectionChange) -> list[messages.Action]:
        """Takes over what a result changes."""
        if change.served is not None and change.served.epoch > self._served.epoch:
            self._served = change.served
        if change.carried_over is not None:
            self._cutter.carry_over(change.carried_over)
        if change.is_calm:
            self._suspected = False
            self._urgency.calm()
        if change.urgent_since_ns is not None:
            self._suspected = True
            self._urgency.alarm(change.urgent_since_ns)
        return [] if change.calibration is None else [messages.UseCalibration(change.calibration)]

    def _apply_due(self, stamp_ns: int) -> list[messages.Action]:
        actions: list[messages.Action] = []
        for change in self._schedule.take_due(stamp_ns):
            actions += self.apply(change)
        return actions

    def _begin_new_time(self, stamp_ns: int) -> None:
        self._steps_back += 1
        self._losses.add("monitor", "time_stepped_back", detail="the clock of the sensors stepped back")
        self._suspected = False
        self._urgency.calm()
        self._urgency.forget()
        self._window_due_ns, self._latest_window_ns = stamp_ns, 0

    # --- inside -----------------------------------------------------------------------------------------------------

    def _follow_budget(self) -> None:
        """Makes slices longer if the budget does not suffice for all windows, just as periods of checks get longer."""
        stretch = self._budget.stretch
        if stretch != self._stretch:
            self._stretch = stretch
            slice_s = min(stretch * self._window.slice_s, MAX_SLICE_S)
            self._cutter.reconfigure(self._window.model_copy(update={"slice_s": slice_s}))

    def _hurry_for_rig(self, since_ns: int, stamp_ns: int) -> None:
        """The rig has named a sensor of this pair as moved, at `since_ns`: hurries a window, because the correction
        waits for a window of each pair of that sensor. One that began after the move may be on its way already."""
        if since_ns > self._latest_window_ns and not self._urgency.is_waiting:
            self._urgency.request(since_ns, self._budget.window_turn_s(self._pair.name, stamp_ns))

    def _on_window_event(self, event: window.WindowEvent, stamp_ns: int) -> list[messages.Action]:
        """What is to be done after a frame pair of this stamp was offered to the window."""
        match event:
            case window.PairSelected():
                self._frozen = False
                self._log_progress(event.window_id)
                record = RecordPair(event.window_id, event.pair, self._served.T_camera_lidar)
                return [record, messages.Prefetch(event.pair.camera)] if self._infers else [record]
            case window.PairBetween():
                return [RecordBetween(event.window_id, event.pair)]
            case window.SliceClosed():
                self._urgency.on_slice_closed(event, self._cutter)
                return [self._close(event, stamp_ns)]
            case window.CarriedOverDropped():
                lost = event.carried_over
                detail = f"pairs of {lost.window_id} since {lost.since_ns} ns are in no other window"
                self._losses.add("window", "kept_pairs_forgotten", lost.pairs, detail=detail)
                return []

    def _await_turn(self, check: tuple[FramePair, ...]) -> None:
        """Queues frame pairs for a check. Those of an earlier period that still wait for their turn are dropped as too
        old."""
        if self._waits_its_turn:
            self._not_afforded += len(self._waiting_checks)
            self._losses.add("monitor", "check_not_afforded", len(self._waiting_checks))
            self._waiting_checks.clear()
        if len(self._waiting_checks) == CHECKS_WAITING:
            self._losses.add("monitor", "check_superseded")
        self._waiting_checks.append(check)

    def _submit_checks(self, stamp_ns: int) -> list[messages.Action]:
        """Has the latest frame pairs checked at the served extrinsic when it is their turn. Not called while a window
        is to change that extrinsic, because the check would judge one that is no longer served."""
        self._waits_its_turn = False
        actions: list[messages.Action] = []
        while self._waiting_checks:
            if not self._budget.try_acquire(self._pair.name, stamp_ns, suspected=self._suspected):
                self._waits_its_turn = True
                break
            self._checks += 1
            pairs = self._waiting_checks.popleft()
            standing = tuple(pair.stamp_ns for pair in pairs if window.stands(pair, self._pair.window))
            request = self._schedule.submit(
                messages.CheckSubject(self._served.epoch, standing),
                stamp_ns + RESULT_PERIODS * self._period_ns,
                self.expires_s(Kind.CHECK),
            )
            actions.append(messages.SubmitCheck(request, pairs, self._served, self._pair.calibration))
        return actions

    def _close(self, closed: window.SliceClosed, stamp_ns: int) -> window.SliceClosed:
        """A slice ended at this sensor time: its frame pairs go to the disk, and from there to the worker."""
        if closed.complete:
            self._latest_window_ns = start_ns_of(closed.window_id)
            due_ns = stamp_ns + RESULT_PERIODS * self._period_ns
            request = self._schedule.submit(
                messages.WindowSubject(closed.window_id), due_ns, self.expires_s(Kind.SOLVE)
            )
            self._window_due_ns = request.due_ns
        fields = {
            "pair": self._pair.name,
            "window": closed.window_id,
            "pairs": closed.pairs,
            "complete": closed.complete,
        }
        enough = "it is recorded" if closed.complete else f"too few, {self._window.min_pairs} are needed"
        _log.info(f"window ended with {closed.pairs} pairs: {enough}", extra={"fields": fields})
        self._logged_s = -PROGRESS_S
        return closed

    def _log_progress(self, window_id: str) -> None:
        """Logs how many frame pairs the open window has, at a bounded rate."""
        if self._counted_s - self._logged_s < PROGRESS_S:
            return
        self._logged_s = self._counted_s
        fields = {"pair": self._pair.name, "window": window_id}
        _log.info(f"window: {self._cutter.selected} of {self._window.pairs} pairs", extra={"fields": fields})
