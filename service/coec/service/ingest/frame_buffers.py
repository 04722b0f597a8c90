"""Frames in memory: the budget of bytes wherever in the process they are held, the queue of pairs of frames that wait
until earlier ones are judged, and the ring of the last seconds of a pair at full rate, from which a snippet around
an event is cut.
"""

from __future__ import annotations

import weakref
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

from coec.calibration.types import CameraFrame, EgoMotion, Frame, FramePair, LidarFrame, Matrix4
from coec.config import SnippetsConfig


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
        return too_many and len(buffer) == max(map(len, self._buffers))


class PairBuffer:
    """A queue of pairs, oldest first; one thread uses it."""

    def __init__(self, frames: WaitingFrames, max_wait_s: float) -> None:
        self._frames = frames
        self._max_wait_s = max_wait_s
        self._pairs: deque[FramePair] = deque()
        self._since_s: float | None = None
        frames.join(self)

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def next_ns(self) -> int:
        """Stamp of the oldest pair."""
        return self._pairs[0].stamp_ns

    def add(self, pair: FramePair) -> None:
        """A pair came."""
        self._pairs.append(pair)
        self._frames.add(pair.camera)
        self._frames.add(pair.lidar)

    def take(self) -> FramePair:
        """Takes out the oldest pair."""
        pair = self._pairs.popleft()
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


NS_PER_S = 1_000_000_000

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
