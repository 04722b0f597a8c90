"""Forms pairs from the frames of one camera and one LiDAR, gives each pair in its turn to the frame selector, and
reports on the streams of the pair.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from coec.calibration.frames.pairing import Pairer
from coec.calibration.frames.window import CarriedOverPairs
from coec.calibration.types import FramePair, Matrix4
from coec.config import Config, PairConfig
from coec.io.logs import LossCounter
from coec.service.engine.frame_selector import FrameSelector, SelectionStatistics, ServedExtrinsic
from coec.service.engine.vehicle import Arrivals, Intake, SensorStream
from coec.service.ingest.decoder import LIDAR, Frame, StreamCounts
from coec.service.ingest.frame_buffers import FrameRing, PairBuffer
from coec.service.task_queue import DeferredCall
from coec.service.timing import NS_PER_S, QUICK_S, Histogram, SensorClock


@dataclass(frozen=True, slots=True)
class StreamStatistics:
    """Counters since the start, and the latest figures.

    Attributes:
        streams: samples and frames, by stream.
        unpaired: number of frames that got into no pair, by `<stream>_<cause>`.
        pairs: number of pairs that were formed.
        held: how many of these pairs wait to be looked at.
        chosen: what was chosen from the others.
        rate_hz: pairs per second of sensor time; 0 when the streams have stopped, None before the second pair.
        pace: seconds of sensor time per second; None before the second pair.
        sync_error_s: how much later than its sweep the latest camera frame was taken.
        timed_by: how the times of the latest sweep's points were read, see `LidarFrame`.
    """

    streams: dict[str, StreamCounts] = field(default_factory=dict)
    unpaired: dict[str, int] = field(default_factory=dict)
    pairs: int = 0
    held: int = 0
    selection: SelectionStatistics = field(default_factory=SelectionStatistics)
    rate_hz: float | None = None
    pace: float | None = None
    sync_error_s: float | None = None
    timed_by: str = ""


T = TypeVar("T")

GRACE_NS = NS_PER_S
"""Sensor time that must pass after the end of a slice before silence ends it, ns: late pairs may still be on their
way."""

QUIET_TICKS = 3
"""Ticks without a frame before a stream may count as silent. If the process slept, a tick is late, and frames that came
meanwhile need another tick to arrive here."""


class PairStream:
    """Takes the frames of one camera-LiDAR pair, on the intake's thread. `ask`, `call`, `arrivals` and `losses` are for
    any thread. `report` is the intake thread's latest report on the pair.

    Attributes:
        sensors: the streams, by kind; other pairs may share them.
        waiting_took: how long each pair waited from when it was certain until it was looked at.
    """

    def __init__(
        self,
        pair: PairConfig,
        config: Config,
        intake: Intake,
        selector: FrameSelector,
        has_room: Callable[[], bool],
        losses: LossCounter,
        ring: FrameRing | None = None,
    ) -> None:
        """`has_room()` says whether the recorder would take a chosen pair now. `losses` counts those of this pair.
        `ring` keeps the last seconds, if they are wanted."""
        self._intake = intake
        self.sensors: Mapping[str, SensorStream] = intake.sensors_of(pair)
        self.report = StreamStatistics()
        self.waiting_took = Histogram(QUICK_S)
        self._selector = selector
        self._has_room = has_room
        self._pairer = Pairer(pair.pairing, expects_motion=pair.ego is not None)
        self._clock = SensorClock()
        self._held = PairBuffer(intake.waiting_frames, config.worker.timeout_s)
        self._received_s: deque[float] = deque()
        self._losses = losses
        self._ring = ring
        self._pairs = 0
        self._sync_error_s: float | None = None
        self._quiet_ticks = 0
        self._silence: tuple[int, int] | None = None
        intake.join(self)

    def losses(self) -> dict[tuple[str, str], int]:
        """Losses of the pair and of its streams, by place and cause."""
        counted = self._losses.snapshot()
        for sensor in self.sensors.values():
            counted |= sensor.losses.snapshot()
        return counted

    def arrivals(self) -> dict[str, Arrivals]:
        """What came on its streams, by kind."""
        return self._intake.arrivals(self.sensors)

    def call_and_wait(self, work: Callable[[], T], timeout_s: float) -> T:
        """Has `work` done between two samples, after every pair that has come was looked at, and waits for its result.

        Raises:
            BusyError: the work was not begun within `timeout_s`, and nothing was done; or it has not ended.
        """

        def everything_first() -> T:
            self.finish_pairs()
            return work()

        handed = DeferredCall(everything_first)
        self._intake.inbox.call(handed.run)
        return handed.result(timeout_s)

    def call(self, effect: Callable[[], None]) -> None:
        """Has the effect of a decision run on the intake's thread, between two samples."""
        self._intake.inbox.call(effect)

    def adopt(self, served: ServedExtrinsic) -> None:
        """See `Chooser`; on this thread."""
        self._selector.adopt(served)

    def alarm(self, since_ns: int) -> None:
        """See `Chooser`; on this thread."""
        self._selector.alarm(since_ns)

    def carry_over(self, carried_over: CarriedOverPairs) -> None:
        """See `Chooser`; on this thread."""
        self._selector.carry_over(carried_over)

    def calm(self) -> None:
        """See `Chooser`; on this thread."""
        self._selector.calm()

    def event(self, name: str, T_camera_lidar: Matrix4) -> None:
        """See `FrameRing`; on this thread."""
        if self._ring is not None:
            self._ring.event(name, T_camera_lidar)

    def finish_snippet(self) -> None:
        """Ends the open snippet without waiting for further frames; on this thread, or after its end."""
        if self._ring is not None:
            self._ring.finish()

    def finish_pairs(self) -> None:
        """Looks at every pair that has come, even if it should wait for an answer. For the thread of the intake, or
        after its end."""
        self._hold(self._pairer.flush())
        while self._held:
            self._choose()

    def taker(self, name: str) -> Callable[[Frame], None]:
        """`push` for every stream, because each frame says what it is."""
        del name
        return self.push

    def push(self, frame: Frame) -> None:
        """Takes the next frame of one of the streams."""
        self._quiet_ticks = 0
        if self._ring is not None:
            self._ring.push(frame, time.monotonic())
        self._check_silence(frame.stamp_ns)
        self.take(self._pairer.push(frame))

    def take(self, pairs: list[FramePair]) -> None:
        """Takes new pairs: their stamps tell the time, and they wait for their turn."""
        for pair in pairs:
            self._clock.observe(pair.stamp_ns, time.monotonic())
        self._hold(pairs)

    def _choose(self) -> None:
        self.waiting_took.add(time.monotonic() - self._received_s.popleft())
        self._selector.choose(self._held.take())

    def _hold(self, pairs: list[FramePair]) -> None:
        for pair in pairs:
            self._received_s.append(time.monotonic())
            self._pairs += 1
            self._sync_error_s = (pair.camera.stamp_ns - pair.lidar.stamp_ns) / NS_PER_S
            self._held.add(pair)

    def choose_next(self) -> bool:
        """Looks at the oldest waiting pair if it may be looked at; returns whether it did."""
        if not self.may_choose():
            return False
        self._choose()
        return True

    def may_choose(self) -> bool:
        """Whether a pair waits and may be looked at: everything that has to be judged before it is judged, or it has
        waited too long, or too many frames wait."""
        if not self._held:
            return False
        if self._has_room() and not self._selector.must_wait(self._held.next_ns):
            self._held.stop_waiting()
            return True
        return self._held.has_waited(time.monotonic())

    def tick(self, *, waiting: bool) -> None:
        """Time has passed; `waiting`: samples of the streams are in the inbox. Ends a slice in silence, and renews the
        report."""
        self._quiet_ticks = 0 if waiting else self._quiet_ticks + 1
        if self._quiet_ticks > QUIET_TICKS:
            self._end_in_silence()
        if self._ring is not None:
            self._ring.tick(time.monotonic())
        self.renew_report()

    def _end_in_silence(self) -> None:
        """Ends the slice by extrapolated time if the streams have stopped."""
        end_ns = self._selector.slice_end_ns
        if end_ns is None or self._held:
            return
        now_ns = self._clock.silent_now_ns(time.monotonic())
        if now_ns is None or now_ns < end_ns + GRACE_NS:
            return
        # The flushed pairs came earlier and are certain only by the silence, so they do not set the clock.
        pairs = self._pairer.flush()
        self._hold(pairs)
        last_ns = pairs[-1].stamp_ns if pairs else self._selector.statistics.last_ns
        self._silence = last_ns or 0, end_ns
        if not self._held:
            self._selector.end_slice_by(end_ns)

    def _check_silence(self, stamp_ns: int) -> None:
        """Checks, when a frame comes, whether a slice that ended in silence ended too early. If the frame belongs to
        that slice, the streams were not silent but held up. The window then differs from that of a replay, and that is
        counted."""
        if self._silence is None:
            return
        last_ns, end_ns = self._silence
        self._silence = None
        if last_ns < stamp_ns < end_ns:
            self._losses.add("window", "ended_too_early", detail="frames that were held up came after the slice ended")

    def renew_report(self) -> None:
        """Renews the report."""
        silent = self._clock.is_silent(time.monotonic())
        rate_hz = self._clock.rate_hz
        self.report = StreamStatistics(
            streams={kind: sensor.decoder.counts() for kind, sensor in self.sensors.items()},
            unpaired=dict(self._pairer.losses),
            pairs=self._pairs,
            held=len(self._held),
            selection=self._selector.statistics,
            rate_hz=0.0 if silent and rate_hz is not None else rate_hz,
            pace=self._clock.pace,
            sync_error_s=self._sync_error_s,
            timed_by=self.sensors[LIDAR].decoder.timed_by,
        )
