"""The thread that takes the samples of a pair: sample -> frame -> pair, and each pair in its turn to the chooser."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import TypeVar

from coec.adapters.system.logs import LossCounter
from coec.adapters.system.threads import ServiceThread
from coec.calibration.frames.pairing import Pairer
from coec.calibration.frames.window import KeptPairs
from coec.calibration.types import FramePair
from coec.config import Config, PairConfig
from coec.runtime.handover import Handover
from coec.runtime.ingest.chooser import Chooser, Served
from coec.runtime.ingest.decoder import CAMERA, EGO, LIDAR, Decoder
from coec.runtime.ingest.frame_budget import FrameBudget
from coec.runtime.ingest.inbox import Call, Inbox, Parcel
from coec.runtime.ingest.pair_buffer import PairBuffer
from coec.runtime.ingest.sensor_clock import NS_PER_S, SensorClock
from coec.runtime.ingest.stream_statistics import StreamStatistics
from coec.runtime.timings import QUICK_S, Histogram

T = TypeVar("T")

FRAMES_WAITING = 16
"""Samples of camera or LiDAR that may wait for the ingest thread: 1.6 s at 10 Hz."""

MOTIONS_WAITING = 512
"""Ego-motion samples that may wait: 2.5 s at 200 Hz."""

ALL_FRAMES = 1.5
"""Bytes of all frames that a pair may have in memory, in those that may be held: the others wait for their partner, the
disk or the worker, 25 pairs of 2.5 MB."""

GRACE_NS = NS_PER_S
"""Sensor time after the end of a slice before silence ends it: late pairs may still be on their way."""

IDLE_S = 0.25
"""Longest wait for a sample: how soon silence is noticed."""


class Stream:
    """Takes the samples of one pair. `inbox` is for any thread, `report` is what the thread last told of itself.

    Attributes:
        decoding_took: of each sample, by stream.
        waiting_took: of each pair, from when it was certain until it was looked at.
    """

    def __init__(
        self, pair: PairConfig, config: Config, chooser: Chooser, has_room: Callable[[], bool], losses: LossCounter
    ) -> None:
        """`has_room()` says whether the recorder would take a chosen pair now."""
        depths = {CAMERA: FRAMES_WAITING, LIDAR: FRAMES_WAITING, EGO: MOTIONS_WAITING}
        self._decoder = Decoder(pair, config.limits, losses)
        self.inbox = Inbox(depths, config.limits.max_waiting_bytes, self._decoder.overrun)
        self.thread = ServiceThread(f"ingest-{pair.name}", self._run)
        self.report = StreamStatistics()
        self.decoding_took = Histogram(QUICK_S)
        self.waiting_took = Histogram(QUICK_S)
        self._chooser = chooser
        self._has_room = has_room
        self._pairer = Pairer(pair.pairing, expects_motion=pair.ego is not None)
        self._clock = SensorClock()
        self._held = PairBuffer(config.limits.max_held_bytes, config.worker.timeout_s)
        self._came_s: deque[float] = deque()
        self._budget = FrameBudget(round(ALL_FRAMES * config.limits.max_held_bytes))
        self._losses = losses
        self._pairs = 0
        self._sync_error_s: float | None = None

    def request_stop(self) -> None:
        """End the thread."""
        self.thread.request_stop()
        self.inbox.wake()

    def ask(self, work: Callable[[], T], timeout_s: float) -> T:
        """Have `work` done between two samples, once every pair that has come was looked at, and wait for what it
        returns.

        Raises:
            BusyError: it was not begun within `timeout_s`: nothing was done.
        """

        def everything_first() -> T:
            self.finish_pairs()
            return work()

        handed = Handover(everything_first)
        self.inbox.call(handed.run)
        return handed.result(timeout_s)

    def call(self, effect: Callable[[], None]) -> None:
        """Have an effect of a decision run on this thread, between two samples."""
        self.inbox.call(effect)
        self.inbox.wake()

    def adopt(self, served: Served) -> None:
        """See `Chooser`; on this thread."""
        self._chooser.adopt(served)

    def alarm(self, since_ns: int) -> None:
        """See `Chooser`; on this thread."""
        self._chooser.alarm(since_ns)

    def keep(self, kept: KeptPairs) -> None:
        """See `Chooser`; on this thread."""
        self._chooser.keep(kept)

    def calm(self) -> None:
        """See `Chooser`; on this thread."""
        self._chooser.calm()

    def finish_pairs(self) -> None:
        """Look at every pair that has come, whatever it waits for. For the stream's thread, or after its end."""
        self._hold(self._pairer.flush())
        while self._held:
            self._choose()

    def take(self, pairs: list[FramePair]) -> None:
        """Pairs came: they tell the time, and wait their turn."""
        for pair in pairs:
            self._clock.observe(pair.stamp_ns, time.monotonic())
        self._hold(pairs)

    def _choose(self) -> None:
        self.waiting_took.add(time.monotonic() - self._came_s.popleft())
        self._chooser.choose(self._held.take())

    def _hold(self, pairs: list[FramePair]) -> None:
        for pair in pairs:
            self._came_s.append(time.monotonic())
            self._pairs += 1
            self._sync_error_s = (pair.camera.stamp_ns - pair.lidar.stamp_ns) / NS_PER_S
            self._held.add(pair)

    def choose_next(self) -> bool:
        """Look at the pair whose turn it is, if it may be looked at; whether one was."""
        if not self._may_choose():
            return False
        self._choose()
        return True

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            item = self.inbox.take(0.0 if self._may_choose() else IDLE_S)
            if isinstance(item, Call):
                item.run()
            elif item is not None:
                self._take_frame(item)
            self.choose_next()
            if item is None:
                self._end_in_silence()
            self.tell()

    def _take_frame(self, parcel: Parcel) -> None:
        begun_s = time.monotonic()
        frame = self._decoder.frame(parcel)
        self.decoding_took.add(time.monotonic() - begun_s, parcel.stream)
        if frame is None:
            return
        if not self._budget.admit(frame):
            self._losses.add(parcel.stream, "memory_full")
            return
        self.take(self._pairer.push(frame))

    def _may_choose(self) -> bool:
        """Whether the next pair has come, and all is judged that has to be before it is looked at; or it has waited for
        too long, or with too many."""
        if not self._held:
            return False
        if self._has_room() and not self._chooser.must_wait(self._held.next_ns):
            self._held.may_go()
            return True
        return self._held.has_waited(time.monotonic())

    def _end_in_silence(self) -> None:
        """Let the slice end by extrapolated time when the streams have stopped."""
        end_ns = self._chooser.slice_end_ns
        if end_ns is None or self._held:
            return
        now_ns = self._clock.silent_now_ns(time.monotonic())
        if now_ns is None or now_ns < end_ns + GRACE_NS:
            return
        # They are certain because nothing came for long: now is not when they came.
        self._hold(self._pairer.flush())
        if not self._held:
            self._chooser.advance(now_ns, end_ns)

    def tell(self) -> None:
        """Renew the report."""
        silent = self._clock.is_silent(time.monotonic())
        rate_hz = self._clock.rate_hz
        self.report = StreamStatistics(
            streams={stream: self._decoder.counts(stream) for stream in (CAMERA, LIDAR, EGO)},
            unpaired=dict(self._pairer.losses),
            pairs=self._pairs,
            held=len(self._held),
            chosen=self._chooser.chosen,
            rate_hz=0.0 if silent and rate_hz is not None else rate_hz,
            pace=self._clock.pace,
            sync_error_s=self._sync_error_s,
            timed_by=self._decoder.ros.timed_by,
        )
