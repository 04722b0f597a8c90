"""From the frames of one camera and one LiDAR to the frame pairs that wait to be evaluated: frames are paired in time,
bounded in memory wherever in the process they are held, and kept for some seconds at full rate, from which a snippet
around an event is cut. Silence of the streams is noticed.
"""

from __future__ import annotations

import weakref
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import NS_PER_S, CameraFrame, EgoMotion, Frame, FramePair, ImageQuality, LidarFrame, Matrix4
from coec.config import PairConfig, SnippetsConfig
from coec.io.logs import LossCounter
from coec.service.ingest.decoder import LIDAR, SensorStream, StreamCounts
from coec.service.timing import QUICK_S, Histogram, SensorClock

# --- frames in memory -------------------------------------------------------------------------------------------------


class FrameBudget:
    """The budget of a vehicle's frames. One thread admits frames; they may be freed on any thread.

    A frame counts from its admission until nothing holds it any more: not the pairing, and no queue for a judgement,
    the disk or the worker.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        # The garbage collector may free a frame in the middle of `admit`, where no lock could be taken.
        self._freed: deque[int] = deque()

    @property
    def bytes(self) -> int:
        """Bytes of all frames that are held."""
        while self._freed:
            self._bytes -= self._freed.popleft()
        return self._bytes

    def admit(self, frame: Frame) -> bool:
        """Counts a frame if there is room for it; else returns False."""
        size = frame_bytes(frame)
        if self.bytes + size > self._max_bytes:
            return False
        self._bytes += size
        weakref.finalize(frame, self._freed.append, size).atexit = False
        return True


def frame_bytes(frame: Frame) -> int:
    """Bytes of the images and points of a frame; everything else is negligible."""
    match frame:
        case CameraFrame():
            return sum(len(image.data) for image in (frame.image, frame.depth) if image is not None)
        case LidarFrame():
            columns = (frame.xyz_m, frame.intensity, frame.ring, frame.time_offset_s)
            return sum(column.nbytes for column in columns if column is not None)
        case EgoMotion():
            return 0


class WaitingFrames:
    """The frames in all buffers of a vehicle, each counted once however many pairs it belongs to; one thread uses
    it."""

    def __init__(self, max_bytes: int, is_tight: Callable[[], bool]) -> None:
        """`is_tight()` says whether all frames in memory leave little room for new ones."""
        self._max_bytes = max_bytes
        self._is_tight = is_tight
        self._holders: Counter[int] = Counter()
        self._bytes = 0
        self._buffers: list[PairBuffer] = []

    def join(self, buffer: PairBuffer) -> None:
        """Adds a buffer."""
        self._buffers.append(buffer)

    def add(self, frame: CameraFrame | LidarFrame) -> None:
        """A buffer holds a frame."""
        self._holders[id(frame)] += 1
        if self._holders[id(frame)] == 1:
            self._bytes += frame_bytes(frame)

    def remove(self, frame: CameraFrame | LidarFrame) -> None:
        """A buffer no longer holds a frame."""
        self._holders[id(frame)] -= 1
        if not self._holders[id(frame)]:
            del self._holders[id(frame)]
            self._bytes -= frame_bytes(frame)

    def must_evict(self, buffer: PairBuffer) -> bool:
        """Whether a buffer must let a pair go: there are too many bytes of frames, or so many elsewhere in memory that
        new ones would be refused, and no other buffer holds more pairs. So a pair that waits for long does not push on
        the others."""
        too_many = self._bytes > self._max_bytes or self._is_tight()
        return too_many and len(buffer.pairs) == max(len(each.pairs) for each in self._buffers)


class PairBuffer:
    """The frame pairs that wait to be evaluated; one thread uses it.

    Attributes:
        pairs: the frame pairs, oldest first.
    """

    def __init__(self, frames: WaitingFrames, max_wait_s: float) -> None:
        self._frames = frames
        self._max_wait_s = max_wait_s
        self.pairs: deque[FramePair] = deque()
        self._since_s: float | None = None
        frames.join(self)

    def add(self, pair: FramePair) -> None:
        """A pair came."""
        self.pairs.append(pair)
        self._frames.add(pair.camera)
        self._frames.add(pair.lidar)

    def take(self) -> FramePair:
        """Takes out the oldest pair."""
        pair = self.pairs.popleft()
        self._frames.remove(pair.camera)
        self._frames.remove(pair.lidar)
        return pair

    def has_waited(self, monotonic_s: float) -> bool:
        """The oldest pair has to wait. Whether it has waited too long by now, or too many frames wait."""
        self._since_s = monotonic_s if self._since_s is None else self._since_s
        return self._frames.must_evict(self) or monotonic_s - self._since_s > self._max_wait_s

    def stop_waiting(self) -> None:
        """The oldest pair need not wait."""
        self._since_s = None


# --- the seconds around an event --------------------------------------------------------------------------------------

SILENT_S = 3.0
"""After this time without a frame (steady clock, s) no more frames of an event are awaited."""


@dataclass(frozen=True, slots=True, eq=False)
class Snippet:
    """Frames around an event, in the order in which they came.

    Attributes:
        event: what happened, by the name that `health` uses.
        stamp_ns: sensor time of the last frame before the event was reported.
        T_camera_lidar: (4, 4), the extrinsic that was served then.
    """

    event: str
    stamp_ns: int
    T_camera_lidar: Matrix4
    frames: tuple[Frame, ...]


@dataclass(slots=True)
class _OpenEvent:
    """An event whose frames are still coming."""

    event: str
    stamp_ns: int
    T_camera_lidar: Matrix4


class FrameRing:
    """Belongs to the thread of the engine. Holds at most `max_bytes` of frames: half is for those before an event, so
    that there is room for those that follow."""

    def __init__(self, config: SnippetsConfig, max_bytes: int, deliver: Callable[[Snippet], None]) -> None:
        """`deliver(snippet)` takes over the frames; it must not wait."""
        self._before_ns, self._after_ns = round(config.before_s * NS_PER_S), round(config.after_s * NS_PER_S)
        self._max_bytes = max_bytes
        self._deliver = deliver
        self._frames: deque[tuple[Frame, int]] = deque()
        self._bytes = 0
        self._received_s = 0.0
        self._open: _OpenEvent | None = None

    @property
    def bytes(self) -> int:
        """Bytes of the frames that are held."""
        return self._bytes

    def push(self, frame: Frame, monotonic_s: float) -> None:
        """A frame came."""
        size, self._received_s = frame_bytes(frame), monotonic_s
        opened = self._open
        if opened is not None:
            later_ns = frame.stamp_ns - opened.stamp_ns  # far below zero after sensor time has stepped back
            if not -self._before_ns <= later_ns <= self._after_ns or self._bytes + size > self._max_bytes:
                self.finish()
        self._frames.append((frame, size))
        self._bytes += size
        if self._open is None:
            self._forget(frame.stamp_ns)

    def event(self, name: str, T_camera_lidar: Matrix4) -> None:
        """An event happened while this extrinsic (4, 4) is served. A further event before the end of the first belongs
        to the same snippet."""
        if self._open is None and self._frames:
            self._open = _OpenEvent(name, self._frames[-1][0].stamp_ns, T_camera_lidar)

    def tick(self, monotonic_s: float) -> None:
        """Time has passed: ends an open snippet if no frame has come for `SILENT_S`."""
        if self._open is not None and monotonic_s - self._received_s > SILENT_S:
            self.finish()

    def finish(self) -> None:
        """Delivers the frames of the open event; does nothing if there is none."""
        opened, self._open = self._open, None
        if opened is None:
            return
        frames = tuple(frame for frame, _ in self._frames)
        self._frames.clear()
        self._bytes = 0
        self._deliver(Snippet(opened.event, opened.stamp_ns, opened.T_camera_lidar, frames))

    def _forget(self, now_ns: int) -> None:
        """Drops frames that are too old, from before a step back of sensor time, or too many."""
        while self._frames and (
            2 * self._bytes > self._max_bytes or not 0 <= now_ns - self._frames[0][0].stamp_ns <= self._before_ns
        ):
            self._bytes -= self._frames.popleft()[1]


# --- the stream of one pair -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SelectionStatistics:
    """What was selected so far.

    Attributes:
        selected: number of frame pairs in the open slice.
        rejections: number of frame pairs that were evaluated for a window and refused, by reason.
        quality: quality of the latest image that was evaluated; None before the first.
        frozen: whether images have repeated since the last selected one.
        checks: number of checks that were requested.
        not_afforded: number of checks that never got their turn.
        last_ns: stamp of the latest frame pair that was evaluated; None before the first.
        steps_back: how often sensor time has stepped back.
        unanswered: number of checks and windows without a result.
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


@dataclass(frozen=True, slots=True)
class StreamStatistics:
    """Counters since the start, and the latest figures.

    Attributes:
        streams: samples and frames, by stream.
        unpaired: number of frames that got into no frame pair, by `<stream>_<cause>`.
        pairs: number of frame pairs that were formed.
        held: how many of these wait to be evaluated.
        selection: what was selected from the others.
        rate_hz: frame pairs per second of sensor time; 0 when the streams have stopped, None before the second pair.
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


GRACE_NS = NS_PER_S
"""Sensor time that must pass after the end of a slice before silence ends it, ns: late pairs may still be on their
way."""

QUIET_TICKS = 3
"""Ticks without a frame before a stream may count as silent. If the process slept, a tick is late, and frames that came
meanwhile need another tick to arrive here."""


class PairStream:
    """Takes the frames of one camera-LiDAR pair. `losses` and `report` are for any thread, everything else is for that
    of the engine. `now_s` is the time of the steady clock, s.

    Attributes:
        sensors: the streams, by kind; other pairs may share them.
        report: the latest statistics.
        waiting_took: how long each frame pair waited from when it was certain until it was evaluated.
        held: frame pairs that wait to be evaluated.
    """

    def __init__(
        self,
        pair: PairConfig,
        sensors: Mapping[str, SensorStream],
        held: PairBuffer,
        losses: LossCounter,
        ring: FrameRing | None = None,
    ) -> None:
        """`losses` counts those of this pair. `ring` keeps the last seconds, if they are wanted."""
        self.sensors = sensors
        self.report = StreamStatistics()
        self.waiting_took = Histogram(QUICK_S)
        self.held = held
        self._pairer = Pairer(pair.pairing, expects_motion=pair.ego is not None)
        self._clock = SensorClock()
        self._received_s: deque[float] = deque()
        self._losses = losses
        self._ring = ring
        self._pairs = 0
        self._sync_error_s: float | None = None
        self._quiet_ticks = 0
        self._silence: tuple[int, int] | None = None

    def losses(self) -> dict[tuple[str, str], int]:
        """Losses of the pair and of its streams, by place and cause."""
        counted = self._losses.snapshot()
        for sensor in self.sensors.values():
            counted |= sensor.losses.snapshot()
        return counted

    # --- frames -----------------------------------------------------------------------------------------------------

    def push(self, frame: Frame, now_s: float) -> None:
        """Takes the next frame of one of the streams; each frame says of which."""
        self._quiet_ticks = 0
        if self._ring is not None:
            self._ring.push(frame, now_s)
        if self._silence is not None:
            self._check_silence(*self._silence, frame.stamp_ns)
        pairs = self._pairer.push(frame)
        if pairs:
            self.hold(pairs, now_s, set_clock=True)

    def hold(self, pairs: list[FramePair], now_s: float, *, set_clock: bool) -> None:
        """New frame pairs wait for their turn. `set_clock`: their stamps tell the sensor time now."""
        for pair in pairs:
            camera_ns = pair.camera.stamp_ns
            self._received_s.append(now_s)
            self._pairs += 1
            self._sync_error_s = (camera_ns - pair.lidar.stamp_ns) / NS_PER_S
            self.held.add(pair)
            if set_clock:
                self._clock.observe(camera_ns, now_s)

    def take(self, now_s: float) -> FramePair:
        """Takes out the oldest frame pair."""
        pair = self.held.take()
        self.waiting_took.add(now_s - self._received_s.popleft())
        return pair

    def flush(self, now_s: float) -> None:
        """Forms the frame pairs for which no better partner is awaited any more."""
        self.hold(self._pairer.flush(), now_s, set_clock=False)

    # --- the seconds around an event --------------------------------------------------------------------------------

    def keep_snippet(self, event: str, T_camera_lidar: Matrix4) -> None:
        """The seconds around an event are to be kept, if snippets are; `T_camera_lidar` (4, 4) is served then."""
        if self._ring is not None:
            self._ring.event(event, T_camera_lidar)

    def finish_snippet(self) -> None:
        """Ends the open snippet without waiting for further frames."""
        if self._ring is not None:
            self._ring.finish()

    # --- time -------------------------------------------------------------------------------------------------------

    def tick(self, selection: SelectionStatistics, now_s: float, *, waiting: bool) -> None:
        """Time has passed; `waiting`: samples of the streams are in the inbox. Renews the report."""
        self._quiet_ticks = 0 if waiting else self._quiet_ticks + 1
        if self._ring is not None:
            self._ring.tick(now_s)
        self.renew_report(selection, now_s)

    def silence_ends(self, slice_end_ns: int, now_s: float) -> bool:
        """Whether the open slice, which ends at this sensor time, is over by extrapolated time, because the streams
        have stopped and no frame pair waits."""
        if self.held.pairs or self._quiet_ticks <= QUIET_TICKS:
            return False
        now_ns = self._clock.silent_now_ns(now_s)
        return now_ns is not None and now_ns >= slice_end_ns + GRACE_NS

    def end_in_silence(self, slice_end_ns: int, last_ns: int | None, now_s: float) -> None:
        """The slice is ended in silence; `last_ns` is the stamp of the last frame pair that was evaluated. Frame pairs
        that are certain only by the silence came earlier, so they do not set the clock."""
        pairs = self._pairer.flush()
        self.hold(pairs, now_s, set_clock=False)
        self._silence = (pairs[-1].stamp_ns if pairs else last_ns) or 0, slice_end_ns

    def _check_silence(self, last_ns: int, end_ns: int, stamp_ns: int) -> None:
        """Checks, when a frame comes, whether a slice that ended in silence ended too early. If the frame belongs to
        that slice, the streams were not silent but held up. The window then differs from that of a replay, and that is
        counted."""
        self._silence = None
        if last_ns < stamp_ns < end_ns:
            self._losses.add("window", "ended_too_early", detail="frames that were held up came after the slice ended")

    def renew_report(self, selection: SelectionStatistics, now_s: float) -> None:
        """Renews the report, with the statistics of the selection."""
        silent = self._clock.is_silent(now_s)
        rate_hz = self._clock.rate_hz
        self.report = StreamStatistics(
            streams={kind: sensor.decoder.counts() for kind, sensor in self.sensors.items()},
            unpaired=dict(self._pairer.losses),
            pairs=self._pairs,
            held=len(self.held.pairs),
            selection=selection,
            rate_hz=0.0 if silent and rate_hz is not None else rate_hz,
            pace=self._clock.pace,
            sync_error_s=self._sync_error_s,
            timed_by=self.sensors[LIDAR].decoder.timed_by,
        )
