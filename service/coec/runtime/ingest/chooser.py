"""What becomes of each pair, one after the other: part of a window, part of a check, or nothing.

Sensor time alone decides, and what was asked earlier: before a pair is looked at, every answer that is due by its stamp
has taken effect. So a drive that is replayed, at any rate, on any machine, cuts the same windows and checks.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import Protocol

from coec.adapters.depth.maps import STEREO
from coec.adapters.frames.msgpack_frames import encode_camera
from coec.adapters.images.codec import Compressed, Inspector
from coec.adapters.system.logs import LossCounter
from coec.calibration.frames.sampling import CheckSampler
from coec.calibration.frames.window import KeptPairs, PairBetween, PairSelected, SliceEnded, WindowCutter
from coec.calibration.monitor.urgency import Urgency
from coec.calibration.types import FramePair, ImageQuality, Matrix4, Rig
from coec.config import MAX_SLICE_S, LimitsConfig, PairConfig, WindowConfig
from coec.runtime.ingest.sensor_clock import SensorClock

_log = logging.getLogger(__name__)

CHECKS_WAITING = 4
"""Checks that may wait for the answer to a window, 15 MB each: of the period in which it is awaited there is one, and
one more for each further window that ends meanwhile."""


@dataclass(frozen=True, slots=True, eq=False)
class Served:
    """An extrinsic (4, 4) that is or was served; `epoch` counts them."""

    epoch: int
    T_camera_lidar: Matrix4


class Asks(Protocol):
    """What the chooser wants to know of others; see `runtime.decisions.questions`."""

    @property
    def stretch(self) -> float:
        """By how much slices are to be longer than configured, at least 1."""

    def affords(self, stamp_ns: int, *, suspected: bool) -> bool:
        """Whether a check may be asked for at a sensor time; it has to be asked for then. What is `suspected` comes
        before what is not."""

    def window_wanted(self, stamp_ns: int) -> int | None:
        """Since which sensor time the rig wants pairs for a window, before a pair of this stamp; told once. None: it
        wants none."""

    def window_turn_s(self, stamp_ns: int) -> float:
        """How much later than at once a window that the rig wants may end, s, so that the budget pays for those before
        it. It is then taken to be on its way."""

    def check(self, pairs: tuple[FramePair, ...], served: Served, stamp_ns: int) -> None:
        """Is `served` right, by these pairs? Asked at a sensor time, once it is known to be afforded."""

    def window(self, window_id: str, stamp_ns: int) -> int:
        """What does a window say that ends at a sensor time? From when on its answer counts, sensor time."""

    def prefetch(self, frame: bytes) -> None:
        """The depth of a camera frame (native msgpack) will be needed."""

    @property
    def unanswered(self) -> int:
        """Checks and windows whose answer has not come."""

    def waits(self, stamp_ns: int) -> bool:
        """Whether an answer is due before a pair of this stamp, and has not come."""

    def settle(self, stamp_ns: int) -> None:
        """Let the answers take effect that are due before a pair of this stamp."""

    def bring_forward(self, stamp_ns: int) -> None:
        """Whatever waits is due before a pair of this stamp: the first of a new time."""

    def time_stepped_back(self, stamp_ns: int) -> None:
        """The clock of the sensors has stepped back, to this stamp."""


class Writes(Protocol):
    """What the chooser hands to the recorder."""

    def add(self, window_id: str, pair: FramePair, T_camera_lidar: Matrix4) -> None:
        """A pair was chosen."""

    def add_between(self, window_id: str, pair: FramePair) -> None:
        """A pair, thinned, is to be recorded beside those."""

    def end(self, ended: SliceEnded) -> None:
        """A slice ended."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """What was chosen so far.

    Attributes:
        selected: pairs in the open slice.
        rejections: pairs that were looked at for a window and refused, by reason.
        quality: of the image looked at last; None before the first.
        frozen: whether images have repeated since the last that was chosen.
        checks: checks that were asked for.
        not_afforded: checks that never got their turn.
        last_ns: stamp of the pair looked at last; None before the first.
        steps_back: how often sensor time has stepped back.
        unanswered: checks and windows whose answer has not come.
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


class Chooser:
    """Belongs to the ingest thread of a pair."""

    def __init__(
        self,
        pair: PairConfig,
        limits: LimitsConfig,
        rig: Rig,
        served: Served,
        asks: Asks,
        recorder: Writes,
        losses: LossCounter,
        first_slice_s: float,
        kept: KeptPairs | None = None,
    ) -> None:
        """`served` is the extrinsic at which pairs are looked at until another is adopted; `kept` are pairs of an
        earlier run that belong to the first window."""
        self._asks = asks
        self._recorder = recorder
        self._losses = losses
        self._served = served
        self._infers = pair.calibration.depth.model != STEREO
        self._window, self._stretch = pair.window, 1.0
        self._cutter = WindowCutter(pair.window, rig, Inspector(limits), Compressed(limits))
        if first_slice_s < pair.window.slice_s:
            self._cutter.hurry(first_slice_s)
        if kept is not None:
            self._cutter.keep(kept)
        self._sampler = CheckSampler(pair.monitor)
        self._urgency = Urgency(pair.monitor)
        self._pace = SensorClock()
        self._last_ns: int | None = None
        self._unasked: deque[tuple[FramePair, ...]] = deque(maxlen=CHECKS_WAITING)
        self._window_due_ns = 0
        self._frozen = False
        self._suspected = False
        self._checks = 0
        self._not_afforded = 0
        self._waits_its_turn = False
        self._steps_back = 0

    @property
    def chosen(self) -> Chosen:
        """What was chosen so far."""
        return Chosen(
            self._cutter.selected,
            tuple((cause, count) for cause, count in self._cutter.rejections.items() if count),
            self._cutter.last_quality,
            self._frozen,
            self._checks,
            self._not_afforded,
            self._last_ns,
            self._steps_back,
            self._asks.unanswered,
        )

    @property
    def slice_end_ns(self) -> int | None:
        """Sensor time at which the open slice ends; None when none is open."""
        return self._cutter.slice_end_ns

    def must_wait(self, stamp_ns: int) -> bool:
        """Whether a pair of this stamp may not be looked at yet. With the first pair of a new time whatever waits in
        the old one is due; a slice that is over by then has ended before it is looked at."""
        if self._has_stepped_back(stamp_ns):
            self._asks.bring_forward(stamp_ns)
        elif not self.end_slice_by(stamp_ns):
            return True
        return self._asks.waits(stamp_ns)

    def choose(self, pair: FramePair) -> None:
        """Look at the next pair: is it one for the window, one for a check?"""
        stepped_back = self._has_stepped_back(pair.stamp_ns)
        if stepped_back:
            self._asks.bring_forward(pair.stamp_ns)
        elif self._slice_is_over(pair.stamp_ns):
            self._end_slice()
        if self._asks.waits(pair.stamp_ns):
            self._losses.add("monitor", "not_awaited")
        self._asks.settle(pair.stamp_ns)
        if stepped_back:
            self._begin_new_time(pair.stamp_ns)
        self._last_ns = pair.stamp_ns
        # The steady clock plays no part: this one only tells at which rate pairs come.
        self._pace.observe(pair.stamp_ns, 0.0)
        self._follow_stretch()
        self._follow_rig(pair.stamp_ns)
        for ended in self._urgency.heed(self._cutter, self._pace.rate_hz):
            self._end(ended, pair.stamp_ns)
        frozen_before = self._cutter.rejections["frozen"]
        T_camera_lidar = self._served.T_camera_lidar
        for event in self._cutter.offer(pair, T_camera_lidar):
            if isinstance(event, PairSelected):
                self._frozen = False
                self._select(event, T_camera_lidar)
            elif isinstance(event, PairBetween):
                self._recorder.add_between(event.window_id, event.pair)
            elif isinstance(event, SliceEnded):
                self._end(event, pair.stamp_ns)
                self._urgency.ended(event, self._cutter, self._pace.rate_hz)
            else:
                told = f"pairs of {event.kept.window_id} since {event.kept.since_ns} ns are in no other window"
                self._losses.add("window", "kept_pairs_forgotten", event.kept.pairs, detail=told)
        self._frozen |= self._cutter.rejections["frozen"] > frozen_before
        check = self._sampler.offer(pair)
        if check is not None:
            self._await_turn(check)
        if pair.stamp_ns >= self._window_due_ns:
            self._ask_checks(pair.stamp_ns)

    def end_slice_by(self, now_ns: int) -> bool:
        """It is so late, sensor time: the open slice ends if it is over. False while an answer that counts by its end
        has not come.

        Whether a pair tells the time or silence, the slice ends at its own end, and what its window says counts from
        the same time on."""
        if not self._slice_is_over(now_ns):
            return True
        end_ns = self._cutter.slice_end_ns
        if end_ns is not None and self._asks.waits(end_ns):
            return False
        self._end_slice()
        return True

    def finish(self) -> SliceEnded | None:
        """End the open slice here and now."""
        for event in self._cutter.finish():
            self._end(event, self._last_ns or 0)
            return event
        return None

    def use(self, window: WindowConfig) -> None:
        """The next slice is to be cut by this."""
        self._window, self._stretch = window, 1.0
        self._cutter.use(window)

    # --- effects of answers -----------------------------------------------------------------------------------------

    def adopt(self, served: Served) -> None:
        """Pairs are looked at with another extrinsic from now on."""
        if served.epoch > self._served.epoch:
            self._served = served

    def alarm(self, since_ns: int) -> None:
        """A window is wanted soon, of pairs since this sensor time."""
        self._suspected = True
        self._urgency.alarm(since_ns)

    def keep(self, kept: KeptPairs) -> None:
        """The camera moved within a window; its pairs after that belong to the next one."""
        self._cutter.keep(kept)

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
        self._asks.time_stepped_back(stamp_ns)

    def _has_stepped_back(self, stamp_ns: int) -> bool:
        return self._last_ns is not None and stamp_ns < self._last_ns

    def _slice_is_over(self, now_ns: int) -> bool:
        end_ns = self._cutter.slice_end_ns
        return end_ns is not None and now_ns >= end_ns

    def _end_slice(self) -> None:
        """End the open slice at its end, with all answers known that count by then."""
        end_ns = self._cutter.slice_end_ns
        if end_ns is None:
            return
        self._asks.settle(end_ns)
        for ended in self._urgency.heed(self._cutter, self._pace.rate_hz):
            self._end(ended, end_ns)
        for ended in self._cutter.advance(end_ns):
            self._end(ended, end_ns)
            self._urgency.ended(ended, self._cutter, self._pace.rate_hz)

    def _follow_stretch(self) -> None:
        """Slices are longer where the budget does not suffice for all windows, as the periods of checks are."""
        stretch = self._asks.stretch
        if stretch != self._stretch:
            self._stretch = stretch
            slice_s = min(stretch * self._window.slice_s, MAX_SLICE_S)
            self._cutter.use(self._window.model_copy(update={"slice_s": slice_s}))

    def _follow_rig(self, stamp_ns: int) -> None:
        """A sensor of the pair was named: what puts it right waits for a window of each of its pairs."""
        since_ns = self._asks.window_wanted(stamp_ns)
        if since_ns is not None and not self._urgency.is_waiting:
            self._urgency.wanted(since_ns, self._asks.window_turn_s(stamp_ns))

    def _await_turn(self, check: tuple[FramePair, ...]) -> None:
        """There are pairs for a check. Those of a period before that still wait for their turn are too old then."""
        if self._waits_its_turn:
            self._not_afforded += len(self._unasked)
            self._losses.add("monitor", "check_not_afforded", len(self._unasked))
            self._unasked.clear()
        if len(self._unasked) == CHECKS_WAITING:
            self._losses.add("monitor", "check_superseded")
        self._unasked.append(check)

    def _ask_checks(self, stamp_ns: int) -> None:
        """Have the latest pairs checked at what is served, when it is their turn. While a window is about to change
        that, they wait: they would be judged at what is no longer served."""
        self._waits_its_turn = False
        while self._unasked:
            if not self._asks.affords(stamp_ns, suspected=self._suspected):
                self._waits_its_turn = True
                return
            self._checks += 1
            self._asks.check(self._unasked.popleft(), self._served, stamp_ns)

    def _select(self, event: PairSelected, T_camera_lidar: Matrix4) -> None:
        self._recorder.add(event.window_id, event.pair, T_camera_lidar)
        if self._infers:
            self._asks.prefetch(encode_camera(event.pair.camera))

    def _end(self, event: SliceEnded, stamp_ns: int) -> None:
        """A slice ended, at this sensor time: what it holds goes to the disk, and from there to the worker."""
        if event.complete:
            self._window_due_ns = self._asks.window(event.window_id, stamp_ns)
        fields = {"window": event.window_id, "pairs": event.pairs, "complete": event.complete}
        _log.info("a slice ended", extra={"fields": fields})
        self._recorder.end(event)
