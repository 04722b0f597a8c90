"""Pairs that have come and wait until what was seen before them is judged: bounded in bytes and in time."""

from __future__ import annotations

from collections import deque

from coec.calibration.types import FramePair
from coec.runtime.ingest.frame_budget import frame_bytes


class PairBuffer:
    """A queue of pairs, oldest first; one thread uses it."""

    def __init__(self, max_bytes: int, max_wait_s: float) -> None:
        self._max_bytes = max_bytes
        self._max_wait_s = max_wait_s
        self._pairs: deque[FramePair] = deque()
        self._bytes = 0
        self._since_s: float | None = None

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def next_ns(self) -> int:
        """Stamp of the pair whose turn it is."""
        return self._pairs[0].stamp_ns

    def add(self, pair: FramePair) -> None:
        """A pair came."""
        self._pairs.append(pair)
        self._bytes += bytes_of(pair)

    def take(self) -> FramePair:
        """The pair whose turn it is."""
        pair = self._pairs.popleft()
        self._bytes -= bytes_of(pair)
        return pair

    def has_waited(self, monotonic_s: float) -> bool:
        """The next pair has to wait: whether it has done so for too long by now, or with too many behind it."""
        self._since_s = monotonic_s if self._since_s is None else self._since_s
        return self._bytes > self._max_bytes or monotonic_s - self._since_s > self._max_wait_s

    def may_go(self) -> None:
        """The next pair need not wait."""
        self._since_s = None


def bytes_of(pair: FramePair) -> int:
    """Of its images and its points."""
    return frame_bytes(pair.camera) + frame_bytes(pair.lidar)
