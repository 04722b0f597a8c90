"""From where the points of a cloud were measured: the cones on which a turning LiDAR's points lie, an origin that
contradicts the stated frame, and clouds of several LiDARs joined into one, recognised by their rings if no field
names the source of a point; and whether the numbers in the field that is read as ring are rings at all.

A laser of a turning LiDAR has one elevation, seen from the sensor: its points lie on a cone about the sensor's axis.
Cones are described by their tip (x, y, z; metres) and the slope of their axis (x, y; per metre of height): (5,).

Programs that join clouds append one to the other (`pcl::concatenatePointCloud`, Autoware's `concatenate_data`), so each
LiDAR's points are a block of the message. Each block lies on cones of its own, and looks all around from its own place.

Drivers often give clouds in the vehicle's frame. Directions and ranges, and with them every range edge, then start from
a place where no sensor is. `from_origin` undoes that with the stated pose of the LiDAR in the cloud's frame;
`OriginCheck` finds out whether the points contradict the stated origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import LidarFrame, Matrix4, Recognition

Doubles = NDArray[np.float64]

MIN_RINGS, MIN_POINTS = 4, 12
"""Fewer rings, or fewer points of a ring, do not show where they were measured from."""

FEW_RINGS, FEW_POINTS = 2, 4
"""Fewer rings, or fewer points of a ring, do not show whether they are rings."""

STEPS, STEP = 16, 1e-3
"""Most steps of the search, and its difference step: metres, and slopes of the axis."""

LONGEST = np.array([1.0, 1.0, 1.0, 0.2, 0.2])
"""Longest step of the search: metres, and slopes of the axis."""

DISTINCT = 0.5
"""Rings are scan lines if the elevations within a ring deviate by at most this share of their deviation over all
points. The beams of a turning LiDAR: less than 0.1; the lasers of a rosette, or zones of azimuth: about 1. See
docs/measured.md."""

NORMAL = 1.4826
"""Standard deviation of a normal distribution, in medians of its absolute deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Rings:
    """Points of rings that have enough of them.

    Attributes:
        xyz_m: (N, 3), in the order of the sweep.
        number: (N,) of each point's ring, counted from 0 without gaps.
        names: (R,) what the sensor calls these rings.
    """

    xyz_m: Doubles
    number: NDArray[np.int64]
    names: NDArray[np.int64]

    @classmethod
    def of(cls, xyz_m: Doubles, ring: NDArray[np.integer], least: int = MIN_RINGS) -> Rings | None:
        """The rings among points (N, 3) with the ring names of the sensor (N,); None if there are fewer than `least`
        rings."""
        names, number, count = np.unique(ring, return_inverse=True, return_counts=True)
        full = count >= (MIN_POINTS if least >= MIN_RINGS else FEW_POINTS)
        if full.sum() < least:
            return None
        keep = full[number]
        renumbered = np.cumsum(full) - 1
        return cls(xyz_m[keep], renumbered[number[keep]], names[full].astype(np.int64))

    def part(self, begin: int, end: int) -> Rings | None:
        """The rings among the points from `begin` to before `end`."""
        return Rings.of(self.xyz_m[begin:end], self.names[self.number[begin:end]])

    def beams_rad(self, cones: Doubles) -> Doubles:
        """(R,) elevation of each ring: the median of its points."""
        return self._beams_rad(elevation_rad(self.xyz_m, cones))

    def deviations_rad(self, cones: Doubles) -> Doubles:
        """(N,) of each point's elevation from that of its ring."""
        seen_rad = elevation_rad(self.xyz_m, cones)
        return np.asarray(seen_rad - self._beams_rad(seen_rad)[self.number])

    def spread_rad(self, cones: Doubles) -> float:
        """The typical deviation, as the standard deviation of a normal distribution with the same median."""
        return NORMAL * float(np.median(np.abs(self.deviations_rad(cones))))

    def are_distinct(self, cones: Doubles) -> bool:
        """Whether each ring has an elevation of its own there. From far enough away all points have nearly the same, so
        that thin rings alone prove nothing."""
        seen_rad = elevation_rad(self.xyz_m, cones)
        within_rad = np.abs(seen_rad - self._beams_rad(seen_rad)[self.number]).mean()
        return bool(within_rad <= DISTINCT * np.abs(seen_rad - np.median(seen_rad)).mean())

    def sharpest(self) -> Doubles:
        """The cones (5,) from which the points deviate least: Gauss-Newton on the deviations, without those beyond
        three times the typical one (people beside a ring, reflections)."""
        cones = np.zeros(5)
        for _ in range(STEPS):
            deviation = self.deviations_rad(cones)
            inliers = np.abs(deviation) <= 3 * NORMAL * np.median(np.abs(deviation))
            slopes = np.stack([self._slope(cones, step) for step in STEP * np.eye(5)], axis=1)
            change = np.linalg.lstsq(slopes[inliers], -deviation[inliers], rcond=1e-6)[0]
            cones = cones + np.clip(change, -LONGEST, LONGEST)
            if float(np.linalg.norm(change)) < STEP:
                break
        return cones

    def _slope(self, cones: Doubles, step: Doubles) -> Doubles:
        ahead, behind = (self.deviations_rad(cones + sign * step) for sign in (1.0, -1.0))
        return np.asarray((ahead - behind) / (2 * STEP))

    def _beams_rad(self, seen_rad: Doubles) -> Doubles:
        order = np.lexsort((seen_rad, self.number))
        begins = np.searchsorted(self.number[order], np.arange(len(self.names) + 1))
        return np.asarray(seen_rad[order][(begins[:-1] + begins[1:]) // 2])


def elevation_rad(xyz_m: Doubles, cones: Doubles) -> Doubles:
    """(N,) elevation of points (N, 3) above the plane through the tip of the cones and across their axis."""
    axis = np.array([cones[3], cones[4], 1.0]) / math.sqrt(1.0 + float(cones[3] ** 2 + cones[4] ** 2))
    ray_m = xyz_m - cones[:3]
    along_m = ray_m @ axis
    across_m = np.sqrt(np.maximum((ray_m**2).sum(axis=1) - along_m**2, 0.0))
    return np.asarray(np.arctan2(along_m, across_m))


MIN_SEPARATION_M = 0.3
"""Origins nearer to each other than this count as one: the height of a sensor."""

THIN_RAD = math.radians(0.25)
"""Most spread of the elevations within a ring of one LiDAR: a beam, and a metre of driving during the sweep."""

BELONGS_RAD = 2 * THIN_RAD
"""A point farther than this from the beam of its ring belongs to another LiDAR."""

BEGINNINGS = (1.0, 0.5, 0.25, 0.125)
"""Shares of the points, from the first on, that are tried as the points of one LiDAR."""

BLOCK = 0.1
"""Least share of the points that a further LiDAR must have; fewer may be anything."""

WITHIN, BEYOND = 0.6, 0.6
"""Least share of the points in the first LiDAR's block that fit its beams, and most of the points behind the block that
do. Neither is all or none: a passer-by does not fit the beams, and some points of another LiDAR fit by chance."""

SECTORS, COMMON = 36, 0.5
"""Number of sectors around a LiDAR, 10° each; and the least share of the sectors of one LiDAR that the other must see,
too. That rules out a single LiDAR that drives on while it turns, because it looks into each direction once."""


@dataclass(frozen=True, slots=True, eq=False)
class SeveralOrigins:
    """Two places from which blocks of a cloud's points were measured; a third may be there.

    Attributes:
        cones: those of each LiDAR (see `cones`), in the frame of the points.
        cause, setting: as in `ApparentOrigin`.
    """

    cones: tuple[Doubles, Doubles]

    cause: ClassVar[str] = "cloud_concatenated"
    setting: ClassVar[str] = "source"

    @property
    def origins_m(self) -> tuple[tuple[float, ...], ...]:
        """The place (3,) of each LiDAR."""
        return tuple(tuple(cones[:3].tolist()) for cones in self.cones)

    @property
    def sentence(self) -> str:
        """For people."""
        places = " and ".join("(" + ", ".join(f"{value:+.2f}" for value in origin) + ")" for origin in self.origins_m)
        return f"The cloud is concatenated: its points look as if measured from {places} m in their frame."


def several_origins(rings: Rings, before: SeveralOrigins | None = None) -> SeveralOrigins | None:
    """Two LiDARs, if the points of one follow those of the other; None if several LiDARs cannot be recognised. `before`
    is what explained the last sweep."""
    guesses = (np.zeros(5), *(before.cones if before else ()))
    first = _beginning(rings, guesses)
    if first is None:
        return None
    block, cones = first
    fits = _fits(rings, block, cones)
    end = int(np.argmax(np.cumsum(np.where(fits, 1, -1)))) + 1
    rest = rings.part(end, len(fits))
    if rest is None or len(fits) - end < BLOCK * len(fits) or not _ends(fits, end):
        return None
    second = _beginning(rest, guesses)
    if second is None or math.dist(cones[:3], second[1][:3]) < MIN_SEPARATION_M:
        return None
    around = [_sectors(rings.xyz_m[:end], cones), _sectors(rings.xyz_m[end:], second[1])]
    if (around[0] & around[1]).sum() < COMMON * min(sectors.sum() for sectors in around):
        return None
    return SeveralOrigins((cones, second[1]))


def _beginning(rings: Rings, guesses: tuple[Doubles, ...]) -> tuple[Rings, Doubles] | None:
    """The longest block at the beginning of the points that lies on cones, and those cones; None if none does."""
    for share in BEGINNINGS:
        block = rings.part(0, int(share * len(rings.xyz_m)))
        if block is None:
            return None
        cones = next((guess for guess in guesses if block.spread_rad(guess) <= THIN_RAD), None)
        if cones is None:
            cones = block.sharpest()
        if block.spread_rad(cones) <= THIN_RAD and block.are_distinct(cones):
            return block, cones
    return None


def _fits(rings: Rings, block: Rings, cones: Doubles) -> NDArray[np.bool_]:
    """(N,) whether each point lies on the beam of its ring in the block; rings that are not in the block have no
    beam."""
    beams_rad = np.full(int(rings.names.max()) + 1, np.nan)
    beams_rad[block.names] = block.beams_rad(cones)
    deviation_rad = elevation_rad(rings.xyz_m, cones) - beams_rad[rings.names[rings.number]]
    return np.asarray(np.abs(deviation_rad) <= BELONGS_RAD)


def _ends(fits: NDArray[np.bool_], end: int) -> bool:
    """Whether the points of the first LiDAR end there."""
    return bool(fits[:end].mean() >= WITHIN and fits[end:].mean() <= BEYOND)


def _sectors(xyz_m: Doubles, cones: Doubles) -> NDArray[np.bool_]:
    """(SECTORS,) whether each sector holds points, seen from the tip of the cones."""
    ray_m = xyz_m - cones[:3]
    sector = ((np.arctan2(ray_m[:, 1], ray_m[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    return np.bincount(sector, minlength=SECTORS) > 0


POINTS = 6000
"""How many evenly chosen points are used: some hundred per ring of a 64-beam sensor."""

NEAR_M, FAR_M = 2.0, 40.0
"""Ranges of the points used. Nearer points show where each laser sits in the sensor; for farther ones half a metre
turns a ray by less than a beam's width."""

CONTRADICTED_RAD, EXPLAINED = math.radians(0.5), 0.25
"""The stated origin is contradicted if the elevations of a ring, seen from it, spread more than this: twice what a beam
and an uncompensated metre of driving cause. Another origin explains the points if at most this share of the spread
remains there."""

PERIOD_NS = 10**9
"""Sensor time between two checks of the sweeps of a stream, ns: the frame in which a driver sends changes with its
configuration, not from sweep to sweep, and a check takes some ms."""

GIVE_UP = 5
"""After this many sweeps in a row that no cones explain, the LiDAR counts as one whose points lie on none."""

STRAYS = 0.1
"""If more than this share of the points is beyond `CONTRADICTED_RAD`, the rings are not those of one LiDAR, or much
else is in view."""


NO_SCAN_LINES = Recognition(
    "no_scan_lines",
    "The numbers in the field `ring` (`channel`, `line`) are no scan lines of a turning LiDAR, because the points of a "
    "number do not lie at one elevation. The clouds are read as unordered points.",
)


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


def unordered(sweep: LidarFrame) -> LidarFrame:
    """The sweep without its ring numbers, because they are no scan lines."""
    if sweep.ring is None:
        return sweep
    return replace(sweep, ring=None, recognitions=(*sweep.recognitions, NO_SCAN_LINES))


class OriginCheck:
    """Checks the origin of the sweeps of one LiDAR, one after the other.

    A laser of a turning LiDAR has one elevation, seen from the sensor: its points lie on a cone about the sensor's
    axis. Seen from elsewhere they do not, and the points of several LiDARs lie on the cones of each. So the check needs
    rings. If no cones explain them (another scanning pattern, a `ring` that numbers something else), nothing is known,
    and after a few such sweeps the check gives up.
    """

    def __init__(self) -> None:
        self._cones: Doubles | None = None
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

    def has_scan_lines(self, sweep: LidarFrame) -> bool:
        """Whether the ring numbers of a sweep, which was inspected or follows one that was, are scan lines: each with
        its own elevation, seen from the stated origin or from where the inspected sweep was measured. True where too
        few points tell."""
        rings = _rings(sweep, FEW_RINGS)
        return rings is None or any(
            rings.are_distinct(cones) for cones in (np.zeros(5), self._cones) if cones is not None
        )

    def _one_of(self, rings: Rings, stated_rad: float) -> Doubles | None:
        """The cones of a single LiDAR, if they explain the rings."""

        def explain(cones: Doubles) -> bool:
            return rings.spread_rad(cones) <= EXPLAINED * stated_rad and rings.are_distinct(cones)

        if self._cones is None or not explain(self._cones):
            cones = rings.sharpest()
            self._cones = cones if explain(cones) else None
        return self._cones

    def _several_of(self, rings: Rings) -> SeveralOrigins | None:
        """The origins of several LiDARs, if they explain the rings."""
        self._several = several_origins(rings, self._several)
        return self._several


def _rings(sweep: LidarFrame, least: int = MIN_RINGS) -> Rings | None:
    """The rings of a sweep at middle ranges; None if there are fewer than `least`, or too few points."""
    if sweep.ring is None:
        return None
    stride = max(1, len(sweep.xyz_m) // POINTS)
    xyz_m, ring = sweep.xyz_m[::stride].astype(np.float64), sweep.ring[::stride]
    range_m = np.sqrt((xyz_m**2).sum(axis=1))
    # The limits are generous because ranges are from the stated origin, which may be wrong.
    inside = (range_m > NEAR_M) & (range_m < FAR_M)
    return Rings.of(xyz_m[inside], ring[inside], least)
