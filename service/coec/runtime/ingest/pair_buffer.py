"""The queue of pairs of frames that wait until earlier ones are judged. It is bounded in time, and in bytes over all
pairs of a vehicle."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

from coec.calibration.types import CameraFrame, FramePair, LidarFrame
from coec.runtime.ingest.frame_budget import frame_bytes


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
