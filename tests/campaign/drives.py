"""Drives of the campaign as recordings: rendered once by `coec sim drive`, kept between runs, with their truth."""

from __future__ import annotations

import hashlib
import os
from bisect import bisect_right
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from coec.calibration.types import Matrix4
from coec.geometry.se3 import rotation_angle_rad, rotation_from_quaternion_xyzw
from coec.io.mcap.writer import write_bag
from coec.io.recordings.layouts import open_source
from e2e.processes import coec

NS_PER_S = 1_000_000_000
RATE_HZ = 1.0
"""Pairs per second of driving: as many as the monitor takes."""
CAMERA, LIDAR = "pinhole480x240", 32
RENDER_S = 900.0
OPTIONS = {"speed_mps": "--speed", "go_s": "--go", "stop_s": "--stop", "intrinsics_off": "--intrinsics-off"}
"""Of `coec sim drive`, for the same words of a SOURCE."""
TRUTH_TOPIC = "/ground_truth/tf"


@dataclass(frozen=True, slots=True)
class Drive:
    """What `coec sim drive` is asked for; `words` are further keys of a SOURCE, of `OPTIONS`, with their values."""

    seed: int
    seconds: int
    faults: tuple[str, ...] = ()
    text: tuple[tuple[str, str], ...] = ()

    @property
    def source(self) -> str:
        """The same drive as a SOURCE: for the rig and its mask, which a bag has no place for."""
        text = (*self.text, *((("faults", ";".join(self.faults)),) if self.faults else ()))
        return (
            f"sim:seed={self.seed}&seconds={self.seconds}&camera={CAMERA}&lidar={LIDAR}"
            f"&camera_hz={RATE_HZ}&lidar_hz={RATE_HZ}" + "".join(f"&{key}={value}" for key, value in text)
        )

    def recorded(self, folder: Path) -> Path:
        """The drive as a file, rendered unless it is there: in `$CAMPAIGN_CACHE`, else in a folder of this run."""
        cache = Path(os.environ.get("CAMPAIGN_CACHE", folder))
        name = hashlib.sha256(repr(self).encode()).hexdigest()[:12]
        path = cache / f"drive-{self.seed}-{name}.mcap"
        if not path.exists():
            faults = [word for fault in self.faults for word in ("--fault", fault)]
            faults += [word for key, value in self.text for word in (OPTIONS[key], value)]
            sizes = ("--camera", CAMERA, "--lidar", LIDAR, "--camera-hz", RATE_HZ, "--lidar-hz", RATE_HZ)
            done = coec("sim", "drive", "--output", path, "--seed", self.seed, "--seconds", self.seconds, *sizes,
                        *faults, timeout_s=RENDER_S)  # fmt: skip
            assert done.returncode == 0, done.stderr
        return path


class Truth:
    """T_camera_lidar of a recording over time, from its ground-truth channel; of one that is played in a loop, too."""

    def __init__(self, path: Path) -> None:
        with AnyReader([path]) as reader:
            selected = [connection for connection in reader.connections if connection.topic == TRUTH_TOPIC]
            messages = [reader.deserialize(data, of.msgtype) for of, _, data in reader.messages(selected)]
        transforms = [message.transforms[0] for message in messages]  # type: ignore[attr-defined]  # a TFMessage
        poses = [one for one in transforms if one.header.frame_id == "camera"]
        turns = [one.transform.rotation for one in poses]
        self._stamps_ns = [one.header.stamp.sec * NS_PER_S + one.header.stamp.nanosec for one in poses]
        self._turns = [rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w])) for q in turns]
        places = [one.transform.translation for one in poses]
        self._places = [np.array([place.x, place.y, place.z]) for place in places]
        recording = open_source(str(path))
        stamps_ns = [frame.stamp_ns for frame in recording.messages()]
        self.first_ns = min(stamps_ns)
        # As `cadence.repeated` has it: a pass begins a camera period after the last frame of the one before.
        pause_ns = int(np.median(np.diff(recording.camera_stamps_ns)))
        self.pass_ns = max(stamps_ns) - self.first_ns + pause_ns

    def second(self, stamp_ns: int) -> float:
        """Of the pass."""
        return ((stamp_ns - self.first_ns) % self.pass_ns) / NS_PER_S

    def error_deg(self, served: Matrix4, stamp_ns: int) -> float:
        """Geodesic angle of what is served from what was true at a time."""
        return float(np.degrees(rotation_angle_rad(served[:3, :3] @ self._turns[self._number(stamp_ns)].T)))

    def error_m(self, served: Matrix4, stamp_ns: int) -> float:
        """Distance of the translation that is served from the true one at a time."""
        return float(np.linalg.norm(served[:3, 3] - self._places[self._number(stamp_ns)]))

    def _number(self, stamp_ns: int) -> int:
        at_ns = self.first_ns + (stamp_ns - self.first_ns) % self.pass_ns
        return max(bisect_right(self._stamps_ns, at_ns) - 1, 0)


def part(source: Path, begin_s: float, end_s: float, ahead_s: float, into: Path) -> Path:
    """A part of a recording as a recording, its stamps moved by so many seconds."""
    recording = open_source(str(source))
    start_ns = recording.camera_stamps_ns[0]
    frames = (
        replace(frame, stamp_ns=frame.stamp_ns + round(ahead_s * NS_PER_S))
        for frame in recording.messages()
        if begin_s <= (frame.stamp_ns - start_ns) / NS_PER_S + 0.5 / RATE_HZ < end_s
    )
    write_bag(into, recording.rig, recording.T_camera_lidar_start, frames, lambda _: None)
    return into
