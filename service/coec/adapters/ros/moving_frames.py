"""Ego-motion from `/tf`: the velocity of a frame in another, from two of its poses.

A transform tells where a frame is, not how fast it moves. For two poses T₁ and T₂ of the vehicle in `odom`, dt apart,
the twist between them is log(T₁⁻¹·T₂)/dt, in the vehicle's frame. It is exact if the twist is constant. Otherwise its
error is of second order in dt at the middle between the two poses, and that middle is its stamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from coec.adapters.ros.motion import checked
from coec.adapters.ros.stamps import frame_id, stamp_ns
from coec.adapters.ros.transforms import bare, pose_of, transforms_in
from coec.calibration.types import EgoMotion, Matrix4
from coec.geometry import se3

MIN_BETWEEN_S: Final = 0.01
"""Least time between the two poses; then a millimetre, the resolution of a filter's poses, is 0.1 m/s."""

MAX_BETWEEN_S: Final = 0.5
"""Most time between the two poses; in a longer gap the velocity may have changed unnoticed."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    stamp_ns: int
    T_parent_child: Matrix4


class MovingFrame:
    """Motion of one frame in another, from message to message. Not safe for use from several threads."""

    def __init__(self, parent: str, child: str) -> None:
        self._parent, self._child = bare(parent), bare(child)
        self._before: _Pose | None = None

    def motion(self, payload: bytes) -> EgoMotion | None:
        """The motion since the previous pose, from a `TFMessage` in CDR; None if the message holds no new pose of the
        frame, or if there was no previous pose.

        Raises:
            DecodeError: not this message, its pose is invalid, or the motion to it is impossible.
        """
        motion = None
        for stamped in transforms_in(payload):
            if bare(stamped.child_frame_id) != self._child:
                continue
            if bare(stamped.header.frame_id) == self._parent:
                motion = self._moved_to(_pose(stamped)) or motion
        return motion

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
        DecodeError: not this message.
    """
    return {(frame_id(bare(t.header.frame_id)), frame_id(bare(t.child_frame_id))) for t in transforms_in(payload)}


def _pose(stamped: Any) -> _Pose:
    return _Pose(stamp_ns(stamped.header), pose_of(stamped))
