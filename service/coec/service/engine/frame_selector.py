"""Decides what each pair of frames is used for, one after the other: a window, a check, or nothing.

The decision depends only on sensor time and on earlier questions: before a pair is looked at, every answer that is due
by its stamp has taken effect. So a replay of a drive gives the same windows and checks, at any rate and on any machine.
"""

import logging
import time
from collections import deque
from dataclasses import dataclass
from typing import Protocol

from coec.calibration.frames.window import (
    CarriedOverPairs,
    CheckSampler,
    PairBetween,
    PairSelected,
    SliceClosed,
    UrgentWindow,
    WindowCutter,
)
from coec.calibration.types import FramePair, ImageQuality, Matrix4, Rig
from coec.config import MAX_SLICE_S, LimitsConfig, PairConfig, WindowConfig
from coec.io.depth.depth_maps import STEREO
from coec.io.images import CompressingReducer, Inspector
from coec.io.logs import LossCounter
from coec.io.msgpack_frames import encode_camera
from coec.service.timing import SensorClock

_log = logging.getLogger(__name__)

CHECKS_WAITING = 4
"""How many checks may wait for the answer to a window, 15 MB each: one for the period in which that answer is awaited,
and one more for each further window that ends meanwhile."""


PROGRESS_S = 15.0
"""Time between two lines of the log about the pairs of a window, s."""


@dataclass(frozen=True, slots=True, eq=False)
class ServedExtrinsic:
    """An extrinsic (4, 4) that is or was served; `epoch` counts the extrinsics that were served."""

    epoch: int
    T_camera_lidar: Matrix4


class JobRequester(Protocol):
    """What the chooser asks of the rest of the service; see `runtime.decisions.questions`."""

    @property
    def stretch(self) -> float:
        """Factor by which slices are to be longer than configured, at least 1."""

    def try_acquire(self, stamp_ns: int, *, suspected: bool) -> bool:
        """Whether the budget allows a check at a sensor time. If it does, the caller must ask for that check. Checks of
        `suspected` pairs come first."""

    def pop_window_request(self, stamp_ns: int) -> int | None:
        """Sensor time since which the rig wants pairs for a window, asked before a pair of this stamp; returned once.
        None: it wants no window."""

    def window_turn_s(self, stamp_ns: int) -> float:
        """By how much the end of a window that the rig wants may be delayed, s, so that the budget can pay for the
        windows before it. The window then counts as being on its way."""

    def check(self, pairs: tuple[FramePair, ...], served: ServedExtrinsic, stamp_ns: int) -> None:
        """Asks at a sensor time whether `served` is right according to these pairs. Only after `affords`."""

    def window(self, window_id: str, stamp_ns: int) -> int:
        """Asks for the result of a window that ends at a sensor time. Returns from which sensor time the answer
        counts."""

    def prefetch(self, frame: bytes) -> None:
        """Announces that the depth of a camera frame (native msgpack) will be needed."""

    @property
    def unanswered(self) -> int:
        """Number of checks and windows whose answer has not come."""

    def waits(self, stamp_ns: int) -> bool:
        """Whether an answer is due before a pair of this stamp and has not come."""

    def settle(self, stamp_ns: int) -> None:
        """Lets the answers take effect that are due before a pair of this stamp."""

    def bring_forward(self, stamp_ns: int) -> None:
        """Makes all outstanding answers due before a pair of this stamp, which is the first after a step back of sensor
        time."""

    def time_stepped_back(self, stamp_ns: int) -> None:
        """The clock of the sensors has stepped back, to this stamp."""


class WindowSink(Protocol):
    """What the chooser hands to the recorder."""

    def add(self, window_id: str, pair: FramePair, T_camera_lidar: Matrix4) -> None:
        """A pair was chosen for a window."""

    def add_between(self, window_id: str, pair: FramePair) -> None:
        """A thinned pair is to be recorded beside the chosen ones."""

    def end(self, closed: SliceClosed) -> None:
        """A slice ended."""


@dataclass(frozen=True, slots=True)
class SelectionStatistics:
    """What was chosen so far.

    Attributes:
        selected: number of pairs in the open slice.
        rejections: number of pairs that were looked at for a window and refused, by reason.
        quality: quality of the latest image that was looked at; None before the first.
        frozen: whether images have repeated since the last chosen one.
        checks: number of checks that were asked for.
        not_afforded: number of checks that never got their turn.
        last_ns: stamp of the latest pair that was looked at; None before the first.
        steps_back: how often sensor time has stepped back.
        unanswered: number of checks and windows whose answer has not come.
    """

    selected: int = 0
    rejections: tuple[tuple[str, int], ...] = ()
    quality: ImageQuality | None = None
    frozen: bool = False
    checks: int = 0
    not_afforded: int = 0
    last_ns: int | None = None
    steps_back: int = 0
    unanswered: int = 0


class FrameSelector:
    """Belongs to the ingest thread of a pair."""

    def __init__(
        self,
        pair: PairConfig,
        limits: LimitsConfig,
        rig: Rig,
        served: ServedExtrinsic,
        requester: JobRequester,
        recorder: WindowSink,
        losses: LossCounter,
        first_slice_s: float,
        carried_over: CarriedOverPairs | None = None,
    ) -> None:
        """`served` is the extrinsic at which pairs are looked at until another is adopted. `kept` are pairs of an
        earlier run that belong to the first window."""
        self._name = pair.name
        self._logged_s = -PROGRESS_S
        self._requester = requester
        self._recorder = recorder
        self._losses = losses
        self._served = served
        self._infers = pair.calibration.depth.model != STEREO
        self._window, self._stretch = pair.window, 1.0
        self._cutter = WindowCutter(pair.window, rig, Inspector(limits), CompressingReducer(limits))
        if first_slice_s < pair.window.slice_s:
            self._cutter.hurry(first_slice_s)
        if carried_over is not None:
            self._cutter.carry_over(carried_over)
        self._sampler = CheckSampler(pair.monitor)
        self._urgency = UrgentWindow(pair.monitor)
        self._pace = SensorClock()
        self._last_ns: int | None = None
        self._waiting_checks: deque[tuple[FramePair, ...]] = deque(maxlen=CHECKS_WAITING)
        self._window_due_ns = 0
        self._frozen = False
        self._suspected = False
        self._checks = 0
        self._not_afforded = 0
        self._waits_its_turn = False
        self._steps_back = 0

    @property
    def statistics(self) -> SelectionStatistics:
        """What was chosen so far."""
        return SelectionStatistics(
            self._cutter.selected,
            tuple((cause, count) for cause, count in self._cutter.rejections.items() if count),
            self._cutter.last_quality,
            self._frozen,
            self._checks,
            self._not_afforded,
            self._last_ns,
            self._steps_back,
            self._requester.unanswered,
        )

    @property
    def slice_end_ns(self) -> int | None:
        """Sensor time at which the open slice ends; None when none is open."""
        return self._cutter.slice_end_ns

    def must_wait(self, stamp_ns: int) -> bool:
        """Whether a pair of this stamp may not be looked at yet, because an answer is missing. The first pair after a
        step back of sensor time makes all outstanding answers due. A slice that is over by this stamp is ended
        first."""
        if self._has_stepped_back(stamp_ns):
            self._requester.bring_forward(stamp_ns)
        elif not self.end_slice_by(stamp_ns):
            return True
        return self._requester.waits(stamp_ns)

    def choose(self, pair: FramePair) -> None:
        """Looks at the next pair and uses it for the window, for a check, or not at all."""
        stepped_back = self._has_stepped_back(pair.stamp_ns)
        if stepped_back:
            self._requester.bring_forward(pair.stamp_ns)
        elif self._slice_is_over(pair.stamp_ns):
            self._end_slice()
        if self._requester.waits(pair.stamp_ns):
            self._losses.add("monitor", "not_awaited")
        self._requester.settle(pair.stamp_ns)
        if stepped_back:
            self._begin_new_time(pair.stamp_ns)
        self._last_ns = pair.stamp_ns
        # No steady clock is given, because this `SensorClock` only measures the rate at which pairs come.
        self._pace.observe(pair.stamp_ns, 0.0)
        self._follow_stretch()
        self._follow_rig(pair.stamp_ns)
        for closed in self._urgency.apply(self._cutter, self._pace.rate_hz):
            self._end(closed, pair.stamp_ns)
        frozen_before = self._cutter.rejections["frozen"]
        T_camera_lidar = self._served.T_camera_lidar
        for event in self._cutter.offer(pair, T_camera_lidar):
            if isinstance(event, PairSelected):
                self._frozen = False
                self._select(event, T_camera_lidar)
            elif isinstance(event, PairBetween):
                self._recorder.add_between(event.window_id, event.pair)
            elif isinstance(event, SliceClosed):
                self._end(event, pair.stamp_ns)
                self._urgency.on_slice_closed(event, self._cutter, self._pace.rate_hz)
            else:
                lost = event.carried_over
                detail = f"pairs of {lost.window_id} since {lost.since_ns} ns are in no other window"
                self._losses.add("window", "kept_pairs_forgotten", lost.pairs, detail=detail)
        self._frozen |= self._cutter.rejections["frozen"] > frozen_before
        check = self._sampler.offer(pair)
        if check is not None:
            self._await_turn(check)
        if pair.stamp_ns >= self._window_due_ns:
            self._submit_checks(pair.stamp_ns)

    def end_slice_by(self, now_ns: int) -> bool:
        """Ends the open slice if it is over at this sensor time. Returns False while an answer that counts by the end
        of the slice has not come.

        The slice ends at its own end, whether a pair or silence tells the time; so the answer to its window counts from
        the same time on in both cases."""
        if not self._slice_is_over(now_ns):
            return True
        end_ns = self._cutter.slice_end_ns
        if end_ns is not None and self._requester.waits(end_ns):
            return False
        self._end_slice()
        return True

    def finish(self) -> SliceClosed | None:
        """Ends the open slice at once."""
        for event in self._cutter.finish():
            self._end(event, self._last_ns or 0)
            return event
        return None

    def reconfigure(self, window: WindowConfig) -> None:
        """Cuts the next slice by these settings."""
        self._window, self._stretch = window, 1.0
        self._cutter.reconfigure(window)

    # --- effects of answers -----------------------------------------------------------------------------------------

    def adopt(self, served: ServedExtrinsic) -> None:
        """Looks at pairs with another extrinsic from now on."""
        if served.epoch > self._served.epoch:
            self._served = served

    def alarm(self, since_ns: int) -> None:
        """A suspicion arose: a window of pairs since this sensor time is wanted soon."""
        self._suspected = True
        self._urgency.alarm(since_ns)

    def carry_over(self, carried_over: CarriedOverPairs) -> None:
        """The camera moved within a window; the pairs after the move belong to the next window."""
        self._cutter.carry_over(carried_over)

    def calm(self) -> None:
        """There is no suspicion any more."""
        self._suspected = False
        self._urgency.calm()

    # --- inside -----------------------------------------------------------------------------------------------------

    def _begin_new_time(self, stamp_ns: int) -> None:
        self._steps_back += 1
        self._losses.add("monitor", "time_stepped_back", detail="the clock of the sensors stepped back")
        self.calm()
        self._urgency.forget()
        self._window_due_ns = stamp_ns
        self._requester.time_stepped_back(stamp_ns)

    def _has_stepped_back(self, stamp_ns: int) -> bool:
        return self._last_ns is not None and stamp_ns < self._last_ns

    def _slice_is_over(self, now_ns: int) -> bool:
        end_ns = self._cutter.slice_end_ns
        return end_ns is not None and now_ns >= end_ns

    def _end_slice(self) -> None:
        """Ends the open slice at its end; the answers that count by then take effect first."""
        end_ns = self._cutter.slice_end_ns
        if end_ns is None:
            return
        self._requester.settle(end_ns)
        for closed in self._urgency.apply(self._cutter, self._pace.rate_hz):
            self._end(closed, end_ns)
        for closed in self._cutter.advance(end_ns):
            self._end(closed, end_ns)
            self._urgency.on_slice_closed(closed, self._cutter, self._pace.rate_hz)

    def _follow_stretch(self) -> None:
        """Makes slices longer if the budget does not suffice for all windows, just as periods of checks get longer."""
        stretch = self._requester.stretch
        if stretch != self._stretch:
            self._stretch = stretch
            slice_s = min(stretch * self._window.slice_s, MAX_SLICE_S)
            self._cutter.reconfigure(self._window.model_copy(update={"slice_s": slice_s}))

    def _follow_rig(self, stamp_ns: int) -> None:
        """If the rig has named a sensor of this pair as moved, hurries a window: the repair waits for a window of each
        pair of that sensor."""
        since_ns = self._requester.pop_window_request(stamp_ns)
        if since_ns is not None and not self._urgency.is_waiting:
            self._urgency.request(since_ns, self._requester.window_turn_s(stamp_ns))

    def _await_turn(self, check: tuple[FramePair, ...]) -> None:
        """Queues pairs for a check. Pairs of an earlier period that still wait for their turn are dropped as too
        old."""
        if self._waits_its_turn:
            self._not_afforded += len(self._waiting_checks)
            self._losses.add("monitor", "check_not_afforded", len(self._waiting_checks))
            self._waiting_checks.clear()
        if len(self._waiting_checks) == CHECKS_WAITING:
            self._losses.add("monitor", "check_superseded")
        self._waiting_checks.append(check)

    def _submit_checks(self, stamp_ns: int) -> None:
        """Has the latest pairs checked at the served extrinsic when it is their turn. Not called while a window is to
        change that extrinsic, because the check would judge one that is no longer served."""
        self._waits_its_turn = False
        while self._waiting_checks:
            if not self._requester.try_acquire(stamp_ns, suspected=self._suspected):
                self._waits_its_turn = True
                return
            self._checks += 1
            self._requester.check(self._waiting_checks.popleft(), self._served, stamp_ns)

    def _select(self, event: PairSelected, T_camera_lidar: Matrix4) -> None:
        self._log_progress(event.window_id)
        self._recorder.add(event.window_id, event.pair, T_camera_lidar)
        if self._infers:
            self._requester.prefetch(encode_camera(event.pair.camera))

    def _log_progress(self, window_id: str) -> None:
        """Logs how many pairs the open window has, at a bounded rate."""
        now_s = time.monotonic()
        if now_s - self._logged_s < PROGRESS_S:
            return
        self._logged_s = now_s
        fields = {"pair": self._name, "window": window_id}
        _log.info(f"window: {self._cutter.selected} of {self._window.pairs} pairs", extra={"fields": fields})

    def _end(self, event: SliceClosed, stamp_ns: int) -> None:
        """A slice ended at this sensor time: its pairs go to the disk, and from there to the worker."""
        if event.complete:
            self._window_due_ns = self._requester.window(event.window_id, stamp_ns)
        fields = {"pair": self._name, "window": event.window_id, "pairs": event.pairs, "complete": event.complete}
        enough = "it is recorded" if event.complete else f"too few, {self._window.min_pairs} are needed"
        _log.info(f"window ended with {event.pairs} pairs: {enough}", extra={"fields": fields})
        self._logged_s = -PROGRESS_S
        self._recorder.end(event)
