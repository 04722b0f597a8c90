"""How the messages of a bag are read where they leave it open, as a query says it."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import ValidationError

from coec.adapters.ros import incoming
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import LimitsConfig, PointTimeConfig, describe
from coec.errors import UsageError


@dataclass(frozen=True, slots=True)
class Clouds:
    """How the clouds of a bag are read.

    Attributes:
        point_time: how points are timed, where that was said.
        source: number of the LiDAR, of clouds of several.
    """

    point_time: PointTimeConfig | None = None
    source: int | None = None

    @classmethod
    def asked(cls, time: str | None, source: str | None) -> Clouds:
        """As a query asks for it: `FIELD,UNIT[,BASE]`, and a number.

        Raises:
            UsageError: it does not.
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

    def decoded(self, type_name: str, data: bytes) -> CameraFrame | LidarFrame | EgoMotion:
        """The frame in a message of this type.

        Raises:
            DecodeError: there is none.
        """
        return incoming.decode(type_name, data, LimitsConfig(), point_time=self.point_time, source=self.source)
