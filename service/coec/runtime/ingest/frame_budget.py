"""Limits the bytes of frames in memory, wherever in the process the frames are held."""

from __future__ import annotations

import weakref
from collections import deque

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame


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

    def admit(self, frame: CameraFrame | LidarFrame | EgoMotion) -> bool:
        """Counts a frame if there is room for it; else returns False."""
        size = frame_bytes(frame)
        if self.bytes + size > self._max_bytes:
            return False
        self._bytes += size
        weakref.finalize(frame, self._freed.append, size).atexit = False
        return True


def frame_bytes(frame: CameraFrame | LidarFrame | EgoMotion) -> int:
    """Bytes of the images and points of a frame; everything else is negligible."""
    match frame:
        case CameraFrame():
            return sum(len(image.data) for image in (frame.image, frame.depth) if image is not None)
        case LidarFrame():
            columns = (frame.xyz_m, frame.intensity, frame.ring, frame.time_offset_s)
            return sum(column.nbytes for column in columns if column is not None)
        case EgoMotion():
            return 0
