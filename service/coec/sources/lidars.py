"""Recordings of two LiDARs of one vehicle: a simulated rig, or two topics of a bag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from coec.calibration.lidar_to_lidar.types import LidarRig, SweepPair
from coec.calibration.types import EgoMotion, LidarFrame, Matrix4
from coec.errors import SourceError, UsageError
from coec.sources.recording import MOTION_REACH_NS
from coec.sources.spec import SourceSpec, is_bag, is_rig, parse_spec

MAX_STAMP_DIFFERENCE_NS = 60_000_000
"""Two sweeps are a pair if their stamps differ by at most this, ns: a little more than half a turn at 10 Hz."""


@dataclass(frozen=True, slots=True)
class FrameStream:
    """The frames of one stream: ascending stamps, and a function that loads the frame at an index when it is needed."""

    stamps_ns: tuple[int, ...]
    load: Callable[[int], LidarFrame | EgoMotion]


@dataclass(frozen=True, slots=True, eq=False)
class LidarRecording:
    """Sweeps of two LiDARs, and ego-motion.

    Attributes:
        name: name for people to read.
        truth: true T_a_b (4, 4) at a time; None if it is unknown.
    """

    name: str
    rig: LidarRig
    a: FrameStream
    b: FrameStream
    motion: FrameStream
    truth: Callable[[int], Matrix4] | None = None

    def pairs(self, count: int) -> list[SweepPair]:
        """At most `count` pairs, evenly spread over the recording.

        Raises:
            SourceError: a frame cannot be read, or no sweep of one LiDAR is near a sweep of the other.
        """
        near = [
            (i, j)
            for i, stamp in enumerate(self.a.stamps_ns)
            if (j := _nearest(self.b, stamp, MAX_STAMP_DIFFERENCE_NS)) is not None
        ]
        if not near:
            raise SourceError(
                f"{self.name}: no sweep of {self.rig.a} within {MAX_STAMP_DIFFERENCE_NS / 1e6:g} ms of one of {self.rig.b}"
            )
        selected = sorted({round(place) for place in np.linspace(0, len(near) - 1, count)})
        return [self._pair(*near[place]) for place in selected]

    def _pair(self, i: int, j: int) -> SweepPair:
        a, b = self.a.load(i), self.b.load(j)
        assert isinstance(a, LidarFrame)
        assert isinstance(b, LidarFrame)
        k = _nearest(self.motion, a.stamp_ns, MOTION_REACH_NS // 5)
        motion = None if k is None else self.motion.load(k)
        assert not isinstance(motion, LidarFrame)
        return SweepPair(a, b, motion)


def open_lidars(source: str, a: str, b: str) -> LidarRecording:
    """Opens the LiDARs `a` and `b` of `sim:rig=...` (names of sensors) or of a bag (topics).

    Raises:
        UsageError: another kind of source, or no such sensor.
        SourceError: the bag is absent or damaged, has no such topic, or does not give the poses of the LiDARs.
    """
    if a == b:
        raise UsageError(f"{a} is named twice: name two LiDARs")
    spec = parse_spec(source)
    if is_rig(spec):
        return _of_rig(spec, a, b)
    if is_bag(spec):
        from coec.sources.bag.lidars import lidars_of_bag

        return lidars_of_bag(spec, a, b)
    raise UsageError(f"{source} has no two LiDARs: give a bag, or sim:rig=four-fisheyes&... without `pair`")


def _of_rig(spec: SourceSpec, a: str, b: str) -> LidarRecording:
    from coec.geometry.se3 import inverse
    from coec.simulation.source import open_rig

    drive = open_rig(spec.query)
    if unknown := [name for name in (a, b) if name not in drive.lidars]:
        raise UsageError(f"the rig has no LiDAR {', '.join(unknown)}; it has {', '.join(drive.lidars)}")

    def frames(sensor: str) -> FrameStream:
        places = [entry for entry in drive.plan if entry.stream == drive.stream(sensor)]

        def load(place: int) -> LidarFrame | EgoMotion:
            frame = drive.message(places[place])
            assert isinstance(frame, LidarFrame | EgoMotion)
            return frame

        return FrameStream(tuple(entry.stamp_ns for entry in places), load)

    T_a_ego = drive.T_sensor_ego_nominal(a)
    rig = LidarRig(a, b, T_a_ego @ inverse(drive.T_sensor_ego_nominal(b)), T_a_ego)
    return LidarRecording(
        drive.name, rig, frames(a), frames(b), frames("ego"),
        lambda stamp_ns: drive.T_sensor_ego(a, stamp_ns) @ inverse(drive.T_sensor_ego(b, stamp_ns)),
    )  # fmt: skip


def _nearest(frames: FrameStream, stamp_ns: int, within_ns: int) -> int | None:
    """Index of the frame nearest to a stamp; None if none is near enough."""
    if not frames.stamps_ns:
        return None
    differences_ns = np.abs(np.array(frames.stamps_ns, np.int64) - stamp_ns)
    place = int(differences_ns.argmin())
    return place if differences_ns[place] <= within_ns else None
