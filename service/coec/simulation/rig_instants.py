"""Instants of a rig: a sweep of one LiDAR, and for each camera the picture nearest to it.

Cameras that are exposed when the beam of a LiDAR passes are apart by a share of a turn, but all pair with one sweep. To
get a few pairs of each camera, only these frames have to be drawn, each once, however many pairs use it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import FramePair
from coec.config import PairingConfig
from coec.simulation.rig_drive import EGO, RigDrive
from coec.simulation.schedule import Arrival
from coec.sources.recording import SensorMessage

MOTION_NS = 250_000_000
"""Ego-motion this near to the sweep is a part of its instant: pictures are within 50 ms, motion within 200 ms of it."""

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Instant:
    """Frames of a plan that belong together.

    Attributes:
        pictures: by the name of the camera.
        motions: around the sweep, ascending.
    """

    sweep: Arrival
    pictures: Mapping[str, Arrival]
    motions: tuple[Arrival, ...]


def instants(drive: RigDrive, lidar: str, period_s: float) -> list[Instant]:
    """An instant every `period_s` of a drive, as near as the turns of a LiDAR allow. Instants at the ends of the drive
    that lack a picture are left out."""
    cameras = {drive.stream(camera): camera for camera in drive.cameras}
    by_stream: dict[int, list[Arrival]] = {}
    for entry in drive.plan:
        by_stream.setdefault(entry.stream, []).append(entry)
    turn_ns = NS_PER_S / drive.config.lidar_hz
    result: list[Instant] = []
    next_ns = drive.plan[0].stamp_ns if drive.plan else 0
    for sweep in by_stream.get(drive.stream(lidar), []):
        pictures = {}
        for stream, camera in cameras.items():
            near = min(by_stream.get(stream, []), key=lambda entry: abs(entry.stamp_ns - sweep.stamp_ns), default=None)
            if near is not None and 2 * abs(near.stamp_ns - sweep.stamp_ns) <= turn_ns:
                pictures[camera] = near
        if sweep.stamp_ns < next_ns or len(pictures) < len(cameras):
            continue
        motions = [m for m in by_stream.get(drive.stream(EGO), []) if abs(m.stamp_ns - sweep.stamp_ns) <= MOTION_NS]
        result.append(Instant(sweep, pictures, tuple(motions)))
        next_ns = max(next_ns, sweep.stamp_ns - round(turn_ns / 2)) + round(period_s * NS_PER_S)
    return result


def pair_of(picture: SensorMessage, sweep: SensorMessage, motions: tuple[SensorMessage, ...]) -> FramePair | None:
    """The pair that the service would make of a picture, a sweep and the motion around them; None if it makes none."""
    pairer = Pairer(PairingConfig(), expects_motion=True)
    pairs = []
    for frame in sorted((picture, sweep, *motions), key=lambda frame: frame.stamp_ns):
        pairs += pairer.push(frame)
    return next(iter((*pairs, *pairer.flush())), None)
