"""Reads messages of moving or static transforms (`tf2_msgs/TFMessage`), with bounds."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.frames.incoming import Refusal
from coec.adapters.ros.heads import MessageCursor
from coec.adapters.ros.messages import deserialized
from coec.calibration.types import Matrix4
from coec.errors import DecodeError
from coec.geometry.se3 import rotation_from_quaternion_xyzw, transform_from

MAX_TRANSFORMS: Final = 2048
"""Most transforms of a message; robots with many joints send some hundred at once."""

MAX_MESSAGE_BYTES: Final = 2**20
"""Largest message; `MAX_TRANSFORMS` transforms with names of usual length have 300 kB."""

MAX_PLACE_M: Final = 1e9
"""Largest translation per axis, metres; map frames may lie at the centre of the earth, 6.4e6 m away."""


def transforms_in(payload: bytes) -> list[Any]:
    """The `TransformStamped` in a `TFMessage` in CDR, unchanged.

    Raises:
        DecodeError: `message_too_large`, `transforms_too_many` or `message_malformed`.
    """
    if len(payload) > MAX_MESSAGE_BYTES:
        what = f"a message of transforms has at most {MAX_MESSAGE_BYTES} bytes"
        raise DecodeError(Refusal.MESSAGE_TOO_LARGE, what)
    if MessageCursor(payload).number() > MAX_TRANSFORMS:
        raise DecodeError(Refusal.TRANSFORMS_TOO_MANY, f"a message of transforms has at most {MAX_TRANSFORMS}")
    transforms: list[Any] = deserialized(ros.tf2_msgs__msg__TFMessage, payload).transforms
    return transforms


def pose_of(stamped: Any) -> Matrix4:
    """T_parent_child (4, 4), the pose of the child in its parent.

    Raises:
        DecodeError: `transform_invalid`.
    """
    rotation, place = stamped.transform.rotation, stamped.transform.translation
    place_m = np.array([place.x, place.y, place.z])
    if not (np.abs(place_m) <= MAX_PLACE_M).all():
        raise DecodeError(
            Refusal.TRANSFORM_INVALID, "not a rigid transform: its translation is not finite, or far away"
        )
    try:
        turn = rotation_from_quaternion_xyzw(np.array([rotation.x, rotation.y, rotation.z, rotation.w]))
    except ValueError as error:
        raise DecodeError(Refusal.TRANSFORM_INVALID, f"not a rigid transform: {error}") from error
    return transform_from(turn, place_m)


def bare(frame_id: str) -> str:
    """A frame id without the leading slash of ROS 1."""
    return frame_id.lstrip("/")
