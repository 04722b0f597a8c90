"""Where a cloud's points were measured from.

Drivers often hand out clouds in the vehicle's frame. Directions and ranges, and with them every range edge, then start
from a place where no sensor is. `from_origin` undoes that with the LiDAR's stated pose in the cloud's frame;
`apparent_origin` tells a statement that the points contradict.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.concatenation import APART_M, SeveralOrigins, several_origins
from coec.calibration.frames.cones import Rings
from coec.calibration.types import LidarFrame, Matrix4

Doubles = NDArray[np.float64]

POINTS = 6000
"""Looked at, evenly chosen: some hundred a ring of a 64-beam sensor."""

NEAR_M, FAR_M = 2.0, 40.0
"""Ranges looked at. Nearer, the lasers' own places in the sensor tell; farther, half a metre turns a ray by less than a
beam's width."""

CONTRADICTED_RAD, EXPLAINED = math.radians(0.5), 0.25
"""Spread of a ring's elevations at the stated origin above which it cannot be that: twice what a beam and an
uncompensated metre of driving leave. And the share of it that may remain where the points come from."""

GIVE_UP = 5
"""Sweeps in a row that no cones explain, after which the LiDAR is taken for one without."""

STRAYS = 0.1
"""Share of the points beyond `CONTRADICTED_RAD`, above which the rings are no single LiDAR's or much else is there."""


@dataclass(frozen=True, slots=True)
class ApparentOrigin:
    """A place from which the points of a cloud look measured, and the stated one does not.

    Attributes:
        origin_m: (3,) of the LiDAR, in the frame in which the points were taken to be.
        spread_rad, stated_rad: of the elevations within a ring seen from there, and from the stated origin.
        cause, setting: under which a loss is counted, and what of a LiDAR's configuration would help.
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
        return f"The points contradict their origin: they look measured from ({place}) m of their frame."


def from_origin(sweep: LidarFrame, T_cloud_lidar: Matrix4, frame_id: str) -> LidarFrame:
    """A sweep in the LiDAR's own frame, of that name: its points were given in a frame in which the LiDAR has the pose
    T_cloud_lidar (4, 4), metres. The identity leaves the points as they are, to the bit."""
    if np.array_equal(T_cloud_lidar, np.eye(4)):
        return replace(sweep, frame_id=frame_id)
    R, t = T_cloud_lidar[:3, :3], T_cloud_lidar[:3, 3]
    xyz_m = ((sweep.xyz_m.astype(np.float64) - t) @ R).astype(np.float32)
    return replace(sweep, frame_id=frame_id, xyz_m=xyz_m)


def apparent_origin(sweep: LidarFrame) -> ApparentOrigin | SeveralOrigins | None:
    """Where the points contradict that they were measured from the origin of their frame, from where they look
    measured; None where they do not, or where nothing is known. See `OriginCheck`."""
    return OriginCheck().look(sweep)


class OriginCheck:
    """Looks at the sweeps of one LiDAR, one after the other.

    A laser of a turning LiDAR has one elevation, seen from the sensor: its points lie on a cone about the sensor's
    axis. From elsewhere they do not, and those of several LiDARs lie on the cones of each. So rings are needed; and
    where no cones explain them (another scanning pattern, a `ring` that numbers something else), nothing is known, and
    after a few such sweeps nothing more is tried.
    """

    def __init__(self) -> None:
        self._cones: Doubles | None = None
        self._several: SeveralOrigins | None = None
        self._unexplained = 0

    def look(self, sweep: LidarFrame) -> ApparentOrigin | SeveralOrigins | None:
        """From where the points of a sweep look measured, if they contradict their origin."""
        rings = None if self._unexplained >= GIVE_UP else _rings(sweep)
        if rings is None:
            return None
        stated_rad = rings.spread_rad(np.zeros(5))
        if stated_rad <= CONTRADICTED_RAD:
            strays = float(np.mean(np.abs(rings.deviations_rad(np.zeros(5))) > CONTRADICTED_RAD))
            return self._several_of(rings) if strays > STRAYS else None
        # What explained the sweep before usually explains this one.
        several = None if self._several is None else self._several_of(rings)
        cones = None if several else self._one_of(rings, stated_rad)
        if several is None and cones is None:
            several = self._several_of(rings)
        self._unexplained = self._unexplained + 1 if several is None and cones is None else 0
        if cones is None:
            return several
        x, y, z = cones[:3].tolist()
        spread_rad = rings.spread_rad(cones)
        return ApparentOrigin((x, y, z), spread_rad, stated_rad) if math.hypot(x, y, z) >= APART_M else None

    def _one_of(self, rings: Rings, stated_rad: float) -> Doubles | None:
        """The cones of a single LiDAR, if they explain the rings."""

        def explain(cones: Doubles) -> bool:
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
    """Those at middle ranges; None where there are too few of them, or points."""
    if sweep.ring is None:
        return None
    stride = max(1, len(sweep.xyz_m) // POINTS)
    xyz_m, ring = sweep.xyz_m[::stride].astype(np.float64), sweep.ring[::stride]
    range_m = np.sqrt((xyz_m**2).sum(axis=1))
    # Measured from the stated origin, which may be the wrong one: generous on both sides.
    inside = (range_m > NEAR_M) & (range_m < FAR_M)
    xyz_m, ring = xyz_m[inside], ring[inside]
    return Rings.of(xyz_m, ring)
