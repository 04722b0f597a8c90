"""Ego-motion from `/tf`: how a frame moves in another, from two of its poses.

A transform tells where a frame is, not how fast. Between two poses T₁ and T₂ of the vehicle in `odom`, dt apart, the
twist that leads from one to the other is log(T₁⁻¹·T₂)/dt, expressed in the vehicle's frame: exact while the twist does
not change, and of second order in dt about the middle between the two, where it is dated.
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
"""Least time between the two poses: a millimetre, as fine as a filter's poses lie, is then 0.1 m/s."""

MAX_BETWEEN_S: Final = 0.5
"""Most time: a vehicle changes its velocity within it, and what happened in a longer gap nobody knows."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    stamp_ns: int
    T_parent_child: Matrix4


class MovingFrame:
    """One frame in another, from message to message. Not safe for use from several threads."""

    def __init__(self, parent: str, child: str) -> None:
        self._parent, self._child = bare(parent), bare(child)
        self._before: _Pose | None = None

    def motion(self, payload: bytes) -> EgoMotion | None:
        """The motion since the pose before, of a `TFMessage` in CDR; None where the message holds no new pose of the
        frame, or there was none before.

        Raises:
            DecodeError: no such message; its pose is none, or cannot be reached from the one before.
        """
        found = None
        for stamped in transforms_in(payload):
            if bare(stamped.child_frame_id) != self._child:
                continue
            if bare(stamped.header.frame_id) == self._parent:
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
    return {(frame_id(bare(t.header.frame_id)), frame_id(bare(t.child_frame_id))) for t in transforms_in(payload)}


def _pose(stamped: Any) -> _Pose:
    return _Pose(stamp_ns(stamped.header), pose_of(stamped))
