"""The lines of the log about one stream: its first frame, its rate, and when it falls silent and comes back."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.runtime.ingest.sensor_clock import NS_PER_S

_log = logging.getLogger(__name__)

LoggedFrame = CameraFrame | LidarFrame | EgoMotion

RATE_FRAMES = 30
"""The rate is measured over the first so many frames."""

SILENT_S = 5.0
"""A stream counts as silent after so long without a frame, s."""

QUIET_S = 60.0
"""Time between two lines about the silence of one stream, s: an unsteady network must not fill the log."""


class StreamLog:
    """Belongs to the intake's thread."""

    def __init__(self, kind: str, sensor: str, clock: Callable[[], float] = time.monotonic) -> None:
        """`kind`: `camera`, `lidar` or `ego`. `sensor`: its name for people. `clock`: a steady clock, s."""
        self._kind = kind
        self._fields = {"stream": kind, "sensor": sensor}
        self._clock = clock
        self._frames = 0
        self._first_ns = 0
        self._latest_s = 0.0
        self._reported_s = -QUIET_S
        self._silent_since_s: float | None = None

    def push(self, frame: LoggedFrame) -> None:
        """A frame was accepted."""
        self._latest_s = self._clock()
        self._frames += 1
        if self._frames == 1:
            self._first_ns = frame.stamp_ns
            _log.info(f"first {self._kind} frame: {_shape(frame)}", extra={"fields": self._fields})
        elif self._frames == RATE_FRAMES and frame.stamp_ns > self._first_ns:
            rate_hz = (RATE_FRAMES - 1) * NS_PER_S / (frame.stamp_ns - self._first_ns)
            _log.info(f"{self._kind} frames come at {rate_hz:.1f} Hz by their stamps", extra={"fields": self._fields})
        if self._silent_since_s is not None:
            silent_s = self._latest_s - self._silent_since_s
            self._silent_since_s = None
            _log.info(f"{self._kind} frames come again after {silent_s:.0f} s", extra={"fields": self._fields})

    def tick(self) -> None:
        """Time has passed."""
        now_s = self._clock()
        if not self._frames or self._silent_since_s is not None or now_s - self._latest_s < SILENT_S:
            return
        if now_s - self._reported_s >= QUIET_S:
            self._reported_s, self._silent_since_s = now_s, self._latest_s
            text = f"no {self._kind} frames for {now_s - self._latest_s:.0f} s: check the sensor and the network"
            _log.warning(text, extra={"fields": self._fields})


def _shape(frame: LoggedFrame) -> str:
    match frame:
        case CameraFrame():
            return f"{frame.image.width}×{frame.image.height}, frame {frame.frame_id!r}"
        case LidarFrame():
            return f"{len(frame.xyz_m)} points, frame {frame.frame_id!r}"
        case EgoMotion():
            return f"frame {frame.frame_id!r}"
