"""Ego-motion from `/tf`: how a frame moves in another, from two of its poses.

A transform tells where a frame is, not how fast. Between two poses T₁ and T₂ of the vehicle in `odom`, dt apart, the
twist that leads from one to the other is log(T₁⁻¹·T₂)/dt, expressed in the vehicle's frame: exact while the twist does
not change, and of second order in dt about the middle between the two, where it is dated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.frames.incoming import Refusal
from coec.adapters.ros.heads import Head
from coec.adapters.ros.messages import deserialized
from coec.adapters.ros.motion import checked
from coec.adapters.ros.stamps import frame_id, stamp_ns
from coec.calibration.types import EgoMotion, Matrix4
from coec.errors import DecodeError
from coec.geometry import se3

MAX_TRANSFORMS: Final = 1024
"""Of a message; robots with many joints send some hundred at once."""

MAX_TRANSFORMS_BYTES: Final = 2**19
"""Of a message: so many transforms, with names of usual length."""

MIN_BETWEEN_S: Final = 0.01
"""Least time between the two poses: a millimetre, as fine as a filter's poses lie, is then 0.1 m/s."""

MAX_BETWEEN_S: Final = 0.5
"""Most time: a vehicle changes its velocity within it, and what happened in a longer gap nobody knows."""

MAX_PLACE_M: Final = 1e9
"""Of a pose, per axis, metres: frames of maps may lie at the centre of the earth, 6.4e6 m away."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    stamp_ns: int
    T_parent_child: Matrix4


class MovingFrame:
    """One frame in another, from message to message. Not safe for use from several threads."""

    def __init__(self, parent: str, child: str) -> None:
        self._parent, self._child = parent.lstrip("/"), child.lstrip("/")
        self._before: _Pose | None = None

    def motion(self, payload: bytes) -> EgoMotion | None:
        """The motion since the pose before, of a `TFMessage` in CDR; None where the message holds no new pose of the
        frame, or there was none before.

        Raises:
            DecodeError: no such message; its pose is none, or cannot be reached from the one before.
        """
        found = None
        for stamped in _transforms(payload):
            if stamped.child_frame_id.lstrip("/") != self._child:
                continue
            if stamped.header.frame_id.lstrip("/") == self._parent:
                found = self._moved_to(_pose(stamped)) or found
        return found

    def _moved_to(self, pose: _Pose) -> EgoMotion | None:
        before = self._before
        if before is None:
            self._before = pose
            return None
        between_s = (pose.stamp_ns - before.stamp_ns) * 1e-9
        if 0.0 <= between_s < MIN_BETWEEN_S:
            return None
        self._before = pose
        if not 0.0 < between_s <= MAX_BETWEEN_S:
            return None
        twist = se3.log(se3.inverse(before.T_parent_child) @ pose.T_parent_child) / between_s
        wx, wy, wz, vx, vy, vz = (float(v) for v in twist)
        middle_ns = before.stamp_ns + (pose.stamp_ns - before.stamp_ns) // 2
        return checked(middle_ns, frame_id(self._child), (vx, vy, vz), (wx, wy, wz))


def frames_in(payload: bytes) -> set[tuple[str, str]]:
    """Parent and child of every transform in a `TFMessage` in CDR.

    Raises:
        DecodeError: no such message.
    """
    return {
        (frame_id(t.header.frame_id.lstrip("/")), frame_id(t.child_frame_id.lstrip("/"))) for t in _transforms(payload)
    }


def _transforms(payload: bytes) -> list[Any]:
    if len(payload) > MAX_TRANSFORMS_BYTES or Head(payload).number() > MAX_TRANSFORMS:
        raise DecodeError(
            Refusal.MESSAGE_TOO_LARGE,
            f"a message of transforms has at most {MAX_TRANSFORMS}, in {MAX_TRANSFORMS_BYTES} bytes",
        )
    transforms: list[Any] = deserialized(ros.tf2_msgs__msg__TFMessage, payload).transforms
    return transforms


def _pose(stamped: Any) -> _Pose:
    rotation, place = stamped.transform.rotation, stamped.transform.translation
    place_m = (place.x, place.y, place.z)
    if not all(abs(value) <= MAX_PLACE_M for value in place_m):
        raise DecodeError(Refusal.MOTION_INVALID, "a pose has no finite place, or lies far away")
    try:
        turn = se3.rotation_from_quaternion_xyzw(np.array([rotation.x, rotation.y, rotation.z, rotation.w]))
    except ValueError as error:
        raise DecodeError(Refusal.MOTION_INVALID, f"a pose is none: {error}") from error
    return _Pose(stamp_ns(stamped.header), se3.transform_from(turn, np.array(place_m)))
