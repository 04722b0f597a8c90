"""Pairs that have come and wait until what was seen before them is judged: bounded in bytes, over all pairs of a
vehicle, and in time."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

from coec.calibration.types import CameraFrame, FramePair, LidarFrame
from coec.runtime.ingest.frame_budget import frame_bytes


class WaitingFrames:
    """The frames of all buffers of a vehicle, each counted once however many pairs it is of; one thread uses it."""

    def __init__(self, max_bytes: int, is_tight: Callable[[], bool]) -> None:
        """`is_tight()` says whether frames, wherever they are held, leave little room for the next."""
        self._max_bytes = max_bytes
        self._is_tight = is_tight
        self._holders: Counter[int] = Counter()
        self._bytes = 0
        self._buffers: list[PairBuffer] = []

    def join(self, buffer: PairBuffer) -> None:
        """One more buffer holds frames of these."""
        self._buffers.append(buffer)

    def add(self, frame: CameraFrame | LidarFrame) -> None:
        """A buffer holds a frame."""
        self._holders[id(frame)] += 1
        if self._holders[id(frame)] == 1:
            self._bytes += frame_bytes(frame)

    def remove(self, frame: CameraFrame | LidarFrame) -> None:
        """A buffer holds a frame no more."""
        self._holders[id(frame)] -= 1
        if not self._holders[id(frame)]:
            del self._holders[id(frame)]
            self._bytes -= frame_bytes(frame)

    def has_to_go(self, buffer: PairBuffer) -> bool:
        """Whether a buffer must let go: there are too many, or others hold so many that the next ones would be refused;
        and none holds more pairs. Who waits for long pushes nobody else on."""
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
        """Stamp of the pair whose turn it is."""
        return self._pairs[0].stamp_ns

    def add(self, pair: FramePair) -> None:
        """A pair came."""
        self._pairs.append(pair)
        self._frames.add(pair.camera)
        self._frames.add(pair.lidar)

    def take(self) -> FramePair:
        """The pair whose turn it is."""
        pair = self._pairs.popleft()
        self._frames.remove(pair.camera)
        self._frames.remove(pair.lidar)
        return pair

    def has_waited(self, monotonic_s: float) -> bool:
        """The next pair has to wait: whether it has done so for too long by now, or with too many."""
        self._since_s = monotonic_s if self._since_s is None else self._since_s
        return self._frames.has_to_go(self) or monotonic_s - self._since_s > self._max_wait_s

    def may_go(self) -> None:
        """The next pair need not wait."""
        self._since_s = None
