"""Keeps the last seconds of a pair at full rate in memory, and cuts out a snippet around an event."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from coec.calibration.types import Matrix4
from coec.config import SnippetsConfig
from coec.runtime.ingest.decoder import Frame
from coec.runtime.ingest.frame_budget import frame_bytes

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
    """Belongs to the thread of the intake. Holds at most `max_bytes` of frames: half is for those before an event, so
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
