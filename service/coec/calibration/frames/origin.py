"""Where a cloud's points were measured from.

Drivers often give clouds in the vehicle's frame. Directions and ranges, and with them every range edge, then start from
a place where no sensor is. `from_origin` undoes that with the stated pose of the LiDAR in the cloud's frame;
`apparent_origin` finds out whether the points contradict the stated origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.concatenation import MIN_SEPARATION_M, SeveralOrigins, several_origins
from coec.calibration.frames.cones import Rings
from coec.calibration.types import LidarFrame, Matrix4

DoublesOfOrigin = NDArray[np.float64]

POINTS = 6000
"""How many evenly chosen points are used: some hundred per ring of a 64-beam sensor."""

NEAR_M, FAR_M = 2.0, 40.0
"""Ranges of the points used. Nearer points show where each laser sits in the sensor; for farther ones half a metre
turns a ray by less than a beam's width."""

CONTRADICTED_RAD, EXPLAINED = math.radians(0.5), 0.25
"""The stated origin is contradicted if the elevations of a ring, seen from it, spread more than this: twice what a beam
and an uncompensated metre of driving cause. Another origin explains the points if at most this share of the spread
remains there."""

GIVE_UP = 5
"""After this many sweeps in a row that no cones explain, the LiDAR counts as one whose points lie on none."""

STRAYS = 0.1
"""If more than this share of the points is beyond `CONTRADICTED_RAD`, the rings are not those of one LiDAR, or much
else is in view."""


@dataclass(frozen=True, slots=True)
class ApparentOrigin:
    """The place from which the points of a cloud look measured, if that is not the stated origin.

    Attributes:
        origin_m: (3,) place of the LiDAR in the assumed frame of the points.
        spread_rad, stated_rad: spread of the elevations within a ring, seen from there and from the stated origin.
        cause, setting: the cause under which a loss is counted, and the setting of the LiDAR that would help.
    """

    cause: ClassVar[str] = "cloud_origin"
    setting: ClassVar[str] = "T_cloud_lidar"

    origin_m: tuple[float, float, float]
    spread_rad: float
    stated_rad: float

    @property
    def sentence(self) -> str:
        """For people."""
        place = ", ".join(f"{value:+.2f}" for value in self.origin_m)
        return f"The points contradict their origin: they look as if measured from ({place}) m in their frame."


def from_origin(sweep: LidarFrame, T_cloud_lidar: Matrix4, frame_id: str) -> LidarFrame:
    """The sweep in the LiDAR's own frame, named `frame_id`. Its points were given in a frame in which the LiDAR has the
    pose T_cloud_lidar (4, 4), metres. The identity leaves the points as they are, to the bit."""
    if np.array_equal(T_cloud_lidar, np.eye(4)):
        return replace(sweep, frame_id=frame_id)
    R, t = T_cloud_lidar[:3, :3], T_cloud_lidar[:3, 3]
    xyz_m = ((sweep.xyz_m.astype(np.float64) - t) @ R).astype(np.float32)
    return replace(sweep, frame_id=frame_id, xyz_m=xyz_m)


def apparent_origin(sweep: LidarFrame) -> ApparentOrigin | SeveralOrigins | None:
    """From where the points look measured, if they contradict the origin of their frame; None if they do not, or if
    that is unknown. See `OriginCheck`."""
    return OriginCheck().inspect(sweep)


class OriginCheck:
    """Checks the origin of the sweeps of one LiDAR, one after the other.

    A laser of a turning LiDAR has one elevation, seen from the sensor: its points lie on a cone about the sensor's
    axis. Seen from elsewhere they do not, and the points of several LiDARs lie on the cones of each. So the check needs
    rings. If no cones explain them (another scanning pattern, a `ring` that numbers something else), nothing is known,
    and after a few such sweeps the check gives up.
    """

    def __init__(self) -> None:
        self._cones: DoublesOfOrigin | None = None
        self._several: SeveralOrigins | None = None
        self._unexplained = 0

    def inspect(self, sweep: LidarFrame) -> ApparentOrigin | SeveralOrigins | None:
        """From where the points of a sweep look measured, if they contradict the origin of their frame."""
        rings = None if self._unexplained >= GIVE_UP else _rings(sweep)
        if rings is None:
            return None
        stated_rad = rings.spread_rad(np.zeros(5))
        if stated_rad <= CONTRADICTED_RAD:
            strays = float(np.mean(np.abs(rings.deviations_rad(np.zeros(5))) > CONTRADICTED_RAD))
            return self._several_of(rings) if strays > STRAYS else None
        # The cones that explained the last sweep usually explain this one.
        several = None if self._several is None else self._several_of(rings)
        cones = None if several else self._one_of(rings, stated_rad)
        if several is None and cones is None:
            several = self._several_of(rings)
        self._unexplained = self._unexplained + 1 if several is None and cones is None else 0
        if cones is None:
            return several
        x, y, z = cones[:3].tolist()
        spread_rad = rings.spread_rad(cones)
        return ApparentOrigin((x, y, z), spread_rad, stated_rad) if math.hypot(x, y, z) >= MIN_SEPARATION_M else None

    def _one_of(self, rings: Rings, stated_rad: float) -> DoublesOfOrigin | None:
        """The cones of a single LiDAR, if they explain the rings."""

        def explain(cones: DoublesOfOrigin) -> bool:
            return rings.spread_rad(cones) <= EXPLAINED * stated_rad

        if self._cones is None or not explain(self._cones):
            cones = rings.sharpest()
            self._cones = cones if explain(cones) else None
        return self._cones

    def _several_of(self, rings: Rings) -> SeveralOrigins | None:
        """The origins of several LiDARs, if they explain the rings."""
        self._several = several_origins(rings, self._several)
        return self._several


def _rings(sweep: LidarFrame) -> Rings | None:
    """The rings of a sweep at middle ranges; None if there are too few rings or points."""
    if sweep.ring is None:
        return None
    stride = max(1, len(sweep.xyz_m) // POINTS)
    xyz_m, ring = sweep.xyz_m[::stride].astype(np.float64), sweep.ring[::stride]
    range_m = np.sqrt((xyz_m**2).sum(axis=1))
    # The limits are generous because ranges are from the stated origin, which may be wrong.
    inside = (range_m > NEAR_M) & (range_m < FAR_M)
    xyz_m, ring = xyz_m[inside], ring[inside]
    return Rings.of(xyz_m, ring)
