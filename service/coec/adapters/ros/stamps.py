"""Checks stamp and frame id of message headers."""

from __future__ import annotations

from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.frames.incoming import MAX_FRAME_ID, Refusal
from coec.errors import DecodeError


def stamp_ns(header: ros.std_msgs__msg__Header) -> int:
    """Nanoseconds of the header's stamp.

    Raises:
        DecodeError: `stamp_invalid`.
    """
    seconds, nanoseconds = header.stamp.sec, header.stamp.nanosec
    if seconds < 0 or nanoseconds >= 10**9:
        raise DecodeError(Refusal.STAMP_INVALID, "the stamp is negative or has more than 10⁹ nanoseconds")
    return seconds * 10**9 + nanoseconds


def frame_id(text: str) -> str:
    """The frame id, unchanged, if it is not too long.

    Raises:
        DecodeError: `frame_id_invalid`.
    """
    if len(text) > MAX_FRAME_ID:
        raise DecodeError(Refusal.FRAME_ID_INVALID, f"the frame id is longer than {MAX_FRAME_ID} characters")
    return text
