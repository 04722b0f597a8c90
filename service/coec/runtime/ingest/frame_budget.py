"""How many bytes of frames are in memory, wherever they are held: whoever keeps them, nobody can keep more."""

from __future__ import annotations

import weakref
from collections import deque

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame


class FrameBudget:
    """Of the frames of one pair. One thread admits; frames may end on any.

    A frame counts from the moment at which it is admitted until nobody holds it any more: not the pairing, not those
    that wait for a judgement, the disk or the worker.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        # A frame may end in the middle of `admit`, when Python looks for garbage: no lock could be taken there.
        self._ended: deque[int] = deque()

    @property
    def bytes(self) -> int:
        """Of all frames that are held."""
        while self._ended:
            self._bytes -= self._ended.popleft()
        return self._bytes

    def admit(self, frame: CameraFrame | LidarFrame | EgoMotion) -> bool:
        """Count a frame; False, and it is not counted, where there is no room for it."""
        size = frame_bytes(frame)
        if self.bytes + size > self._max_bytes:
            return False
        self._bytes += size
        weakref.finalize(frame, self._ended.append, size).atexit = False
        return True


def frame_bytes(frame: CameraFrame | LidarFrame | EgoMotion) -> int:
    """Of its images and its points: all that matters."""
    match frame:
        case CameraFrame():
            return sum(len(image.data) for image in (frame.image, frame.depth) if image is not None)
        case LidarFrame():
            columns = (frame.xyz_m, frame.intensity, frame.ring, frame.time_offset_s)
            return sum(column.nbytes for column in columns if column is not None)
        case EgoMotion():
            return 0
