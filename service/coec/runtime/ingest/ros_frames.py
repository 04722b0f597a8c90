"""Frames in messages of ROS, as the configuration of their pair says that they are to be read."""

from __future__ import annotations

from coec.adapters.frames.incoming import Refusal
from coec.adapters.ros import incoming, messages
from coec.adapters.ros.moving_frames import MovingFrame
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import LimitsConfig, PairConfig
from coec.errors import DecodeError

EXPLAINED = frozenset(
    {
        Refusal.MESSAGE_TYPE,
        Refusal.CLOUD_FIELDS,
        Refusal.CLOUD_TIME,
        Refusal.CLOUD_TIME_AMBIGUOUS,
        Refusal.IMAGE_UNKNOWN_FORMAT,
    }
)
"""Causes whose sentence tells a person what to change in the configuration or the driver."""


class RosFrames:
    """Of one pair.

    Attributes:
        timed_by: of the latest sweep, see `LidarFrame`.
    """

    def __init__(self, pair: PairConfig, limits: LimitsConfig) -> None:
        self.timed_by = ""
        self._limits = limits
        self._time = pair.lidar.time
        self._moving = MovingFrame(*(("", "") if pair.ego is None else (pair.ego.parent, pair.ego.child)))

    def frame(self, type_name: str, payload: bytes) -> CameraFrame | LidarFrame | EgoMotion | None:
        """The frame in a message; None where transforms tell no motion of the vehicle, or not yet.

        Raises:
            DecodeError: with a reason of `Refusal`.
        """
        if type_name == messages.TF:
            return self._moving.motion(payload)
        frame = incoming.decode(type_name, payload, self._limits, point_time=self._time)
        if isinstance(frame, LidarFrame):
            if self._time is not None and frame.time_offset_s is None:
                what = f"the cloud has no field {self._time.field} of one number a point, which `lidar.time` names"
                raise DecodeError(Refusal.CLOUD_FIELDS, what)
            self.timed_by = frame.timed_by
        return frame


def of_another_type(type_name: str, place: str, types: tuple[str, ...]) -> str:
    """That a message on `place` is none of these types, and what to do where people often take it for one."""
    told = incoming.REFUSED.get(type_name)
    expected = f"a message of another type on {place}: expected {' or '.join(types)}"
    return expected if told is None else f"{expected}; {told}"
