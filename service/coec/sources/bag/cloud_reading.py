"""How the messages of a bag are read: what they leave open, a query can say."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import ValidationError

from coec.adapters.ros import incoming
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import LimitsConfig, PointTimeConfig, describe
from coec.errors import UsageError


@dataclass(frozen=True, slots=True)
class CloudDecoder:
    """How the clouds of a bag are read.

    Attributes:
        point_time: how points are timed; None: the messages tell.
        source: number of the LiDAR to choose from clouds of several LiDARs; None: all points.
    """

    point_time: PointTimeConfig | None = None
    source: int | None = None

    @classmethod
    def from_query(cls, time: str | None, source: str | None) -> CloudDecoder:
        """From the values of a query: `time` is `FIELD,UNIT[,BASE]`, `source` a whole number.

        Raises:
            UsageError: a value does not fit this form.
        """
        names = ("field", "unit", "base")
        try:
            timed = None if time is None else dict(zip(names, time.split(",", 2), strict=False))
            point_time = None if timed is None else PointTimeConfig.model_validate(timed)
        except ValidationError as error:
            raise UsageError(f"time={time}: {describe(error)}; for example time=timestamp,s,clock") from error
        try:
            return cls(point_time, None if source is None else int(source))
        except ValueError:
            raise UsageError(f"lidar_source={source}: it is a whole number, as in the points' field") from None

    def decode(self, type_name: str, data: bytes) -> CameraFrame | LidarFrame | EgoMotion:
        """The frame in a message of this type.

        Raises:
            DecodeError: the message holds no frame.
        """
        return incoming.decode(type_name, data, LimitsConfig(), point_time=self.point_time, source=self.source)
