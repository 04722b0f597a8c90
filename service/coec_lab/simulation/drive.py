"""A simulated drive with one camera and one LiDAR, as a recording that knows the truth; and the order in which the
frames of all sensors arrive.

It is a `sources.recording.Recording`. Every frame follows from the seed and its number alone and is made on request, so
a drive of any length needs only the memory of one place in the street.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from coec.calibration.types import Frame, LidarFrame, Matrix4, Rig
from coec.errors import UsageError
from coec.geometry.cameras import Camera, build, intrinsics_of, name_of
from coec.geometry.se3 import inverse, perturb
from coec.io.recordings.recording_source import KINDS, MOTION_REACH_NS, selected_indices
from coec_lab.simulation import simulated_sensors
from coec_lab.simulation.faults import Fault, shifted
from coec_lab.simulation.journey import START_NS, Journey
from coec_lab.simulation.lidar_model import LIDARS, LidarModel
from coec_lab.simulation.reflectance import INTENSITIES
from coec_lab.simulation.render import LensProperties
from coec_lab.simulation.scene import Solid
from coec_lab.simulation.vehicle_motion import T_ego_lidar, body, workshop_T_camera_lidar


class Arrival(NamedTuple):
    """Frame `number` of stream `stream`, with its stamp. Sorts by stamp, then by stream."""

    stamp_ns: int
    stream: int
    number: int


def arrivals(streams: Sequence[simulated_sensors.SimulatedSensor], seconds: float) -> list[Arrival]:
    """Everything that arrives, in the order of the stamps."""
    plan = []
    for stream, sensor in enumerate(streams):
        for index in range(math.ceil(seconds * sensor.hz)):
            time_s = sensor.time_s(index)
            if not sensor.is_lost(index, time_s):
                plan.append(Arrival(START_NS + round((time_s + sensor.late_s(time_s)) * 1e9), stream, index))
    return sorted(plan)


def seconds_of(stamp_ns: int) -> float:
    """The second of the drive at a stamp."""
    return (stamp_ns - START_NS) / 1e9


XI, ALPHA = -0.2, 0.6
"""Parameters of the double sphere fisheye, close to those of common lenses."""
WIDE_DEG, PINHOLE_DEG = 90, (10, 120)
"""Default field of view of a pinhole camera, and the least and greatest."""
_EGO, _LIDAR, _CAMERA = 0, 1, 2
"""Streams in the order of messages with equal stamps."""


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """What to drive.

    Attributes:
        seconds: length of the drive.
        scene: one of `surroundings.SCENES`.
        camera: `fisheyeW` (double sphere, W×W pixels), `pinholeWxH` (90° wide), `pinholeWxH@D` (D degrees wide), or any
            camera.
        half_view_deg: the lens sees this far off its axis: 92.5 for 185°.
        lidar: a name in `LIDARS`, or any model.
        intensity: a name in `reflectance.INTENSITIES`, for a LiDAR that writes another kind than its model; None: its
            own.
        camera_hz, lidar_hz, ego_hz: frames per second; a sweep always lasts one period of its model.
        camera_delay_s: the camera exposes this long after the stamp of its sweep.
        speed_mps: mean speed, 0 for a standing vehicle; None = as usual in the scene.
        go_s, stop_s: in dense traffic the vehicle drives and stands by turns, so long each; 0 = it never stops.
        traffic: whether anything else moves.
        start_m: where along the road the drive begins.
        rolling_shutter_s: time from the first row of a picture to the last; the stamp is that of the middle row.
        intrinsics_off: (3,) by how many percent the rig's focal length (of itself) and principal point (of width and
            height) differ from those of the camera that takes the pictures.
        faults: see `faults`.
        workshop: (6,) ξ, degrees and metres about the camera axes, by which the calibration of the rig is wrong.
        depth: attach the exact depth of each picture.
    """

    seed: int = 0
    scene: str = "street"
    seconds: float = 60.0
    camera: str | Camera = "fisheye700"
    half_view_deg: float = 92.5
    lidar: str | LidarModel = "64"
    intensity: str | None = None
    camera_hz: float = 10.0
    lidar_hz: float = 10.0
    ego_hz: float = 50.0
    camera_delay_s: float = 0.01
    speed_mps: float | None = None
    go_s: float = 20.0
    stop_s: float = 0.0
    traffic: bool = True
    start_m: float = 0.0
    rolling_shutter_s: float = 0.0
    intrinsics_off: tuple[float, float, float] = (0.0, 0.0, 0.0)
    faults: tuple[Fault, ...] = ()
    workshop: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    depth: bool = False
    lens: LensProperties = field(default_factory=LensProperties)

    def drive(self) -> SimulatedDrive:
        """The drive that it describes."""
        return SimulatedDrive(self)


class SimulatedDrive:
    """The drive of a configuration.

    Attributes:
        config: as given.
        rig: with the workshop's calibration as nominal, the intrinsics that the workshop assumes, and a mask of lens
            and body.
        camera: the true camera that takes the pictures.
        configuration: None, as for every recording that is not a window.

    Raises:
        UsageError: an unknown camera or LiDAR, or figures out of range; the message names them.
    """

    configuration = None

    def __init__(self, config: DriveConfig) -> None:
        check_rates(config)
        self.config = config
        self._journey = Journey(
            config.seed, config.scene, config.seconds,
            speed_mps=config.speed_mps, start_m=config.start_m, traffic=config.traffic, faults=config.faults,
            go_s=config.go_s, stop_s=config.stop_s,
        )  # fmt: skip
        self._true = workshop_T_camera_lidar()
        self._turning = simulated_sensors.SimulatedLidar(
            self._journey,
            simulated_sensors.Wire("lidar", config.lidar_hz, _LIDAR, faults=config.faults),
            lidar_of(config.lidar, config.intensity),
            lambda _: T_ego_lidar(),
        )  # fmt: skip
        self._mount()

    def _mount(self) -> None:
        """Mounts the camera of the configuration beside the other sensors."""
        config = self.config
        self.camera = camera_of(config.camera, config.half_view_deg)
        optics = simulated_sensors.Optics(
            self.camera,
            config.half_view_deg,
            config.camera_delay_s,
            config.rolling_shutter_s,
            config.depth,
            config.lens,
        )
        eye = simulated_sensors.SimulatedCamera(
            self._journey, simulated_sensors.Wire("camera", config.camera_hz, _CAMERA, faults=config.faults), optics,
            self._T_ego_camera, Solid(body()),
        )  # fmt: skip
        odometer = simulated_sensors.SimulatedOdometer(
            self._journey, simulated_sensors.Wire("ego", config.ego_hz, _EGO, faults=config.faults)
        )
        self._streams: tuple[simulated_sensors.SimulatedSensor, ...] = (odometer, self._turning, eye)
        xi = np.array([*np.deg2rad(config.workshop[:3]), *config.workshop[3:]])
        assumed = _assumed_camera(self.camera, config.intrinsics_off)
        mask = eye.mask_at(simulated_sensors.product(T_ego_lidar(), inverse(self._true)))
        self.rig = Rig("sim", assumed, "camera", "lidar", perturb(self._true, xi), inverse(T_ego_lidar()), mask=mask)

    def through(self, camera: str | Camera, half_view_deg: float) -> SimulatedDrive:
        """The same drive with another lens. Both share their surroundings, so they are best drawn in step.

        Raises:
            UsageError: an unknown camera.
        """
        other = copy(self)
        other.config = replace(self.config, camera=camera, half_view_deg=half_view_deg)
        other._mount()
        return other

    @property
    def name(self) -> str:
        """Name for people."""
        return f"simulated drive, seed {self.config.seed}"

    @property
    def T_camera_lidar_start(self) -> Matrix4:
        """(4, 4) the workshop's calibration."""
        return self.rig.T_camera_lidar_nominal

    @cached_property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames that arrive, ascending."""
        return stamps_of(self._plan, _CAMERA)

    @cached_property
    def sweep_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the sweeps that arrive, ascending."""
        return stamps_of(self._plan, _LIDAR)

    @cached_property
    def motion_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the ego-motion that arrives, ascending."""
        return stamps_of(self._plan, _EGO)

    def truth(self, stamp_ns: int) -> Matrix4:
        """True T_camera_lidar (4, 4) at a time."""
        return shifted(self._true, self.config.faults, seconds_of(stamp_ns))

    def true_pose(self, stamp_ns: int) -> Matrix4:
        """True T_world_ego (4, 4) at a time."""
        return self._journey.pose(seconds_of(stamp_ns))

    def messages(self, cameras: Collection[int] | None = None, kinds: Collection[str] = KINDS) -> Iterator[Frame]:
        """See `Recording.messages`."""
        required = self._plan if cameras is None else needed(self._plan, cameras, _CAMERA, _LIDAR, _EGO)
        return (self._message(entry) for entry in required if KINDS[entry.stream] in kinds)

    def sweeps(self, stamps_ns: Collection[int]) -> Iterator[LidarFrame]:
        """See `Recording.sweeps`."""
        required = (entry for entry in self._plan if entry.stream == _LIDAR and entry.stamp_ns in stamps_ns)
        return (frame for frame in map(self._message, required) if isinstance(frame, LidarFrame))

    def part(self, begin: int, end: int) -> list[Frame]:
        """Messages `begin` to `end` (excluded) of `messages()`, so that several processes can share the work."""
        return [self._message(entry) for entry in self._plan[begin:end]]

    @property
    def message_count(self) -> int:
        """How many `messages()` there are."""
        return len(self._plan)

    @cached_property
    def _plan(self) -> list[Arrival]:
        return arrivals(self._streams, self.config.seconds)

    def _message(self, entry: Arrival) -> Frame:
        return self._streams[entry.stream].frame(entry.number, entry.stamp_ns)

    def _T_ego_camera(self, time_s: float) -> Matrix4:
        return simulated_sensors.product(T_ego_lidar(), inverse(shifted(self._true, self.config.faults, time_s)))


class Rated(Protocol):
    """A configuration with a length and rates."""

    @property
    def seconds(self) -> float:
        """Length of the drive."""
        ...

    @property
    def camera_hz(self) -> float:
        """Pictures a second."""
        ...

    @property
    def lidar_hz(self) -> float:
        """Sweeps a second."""
        ...

    @property
    def ego_hz(self) -> float:
        """Samples of ego-motion a second."""
        ...


def check_rates(config: Rated) -> None:
    """Raises UsageError where the length of a drive or a rate is not above 0."""
    for name in ("seconds", "camera_hz", "lidar_hz", "ego_hz"):
        if not 0 < getattr(config, name) < 1e6:
            raise UsageError(f"{name} of a simulated drive must be above 0, not {getattr(config, name)}")


def stamps_of(plan: Iterable[Arrival], stream: int) -> tuple[int, ...]:
    """Stamps of one stream, ascending."""
    return tuple(entry.stamp_ns for entry in plan if entry.stream == stream)


def needed(plan: list[Arrival], cameras: Collection[int], camera: int, lidar: int, ego: int) -> Iterator[Arrival]:
    """The part of a plan that chosen frames of a camera need: these frames, the sweep nearest to each, and the motion
    around them.

    Args:
        cameras: indices into the arrivals of the stream `camera`.
        camera, lidar, ego: numbers of the streams.

    Raises:
        UsageError: an index out of range.
    """
    exposures = [entry for entry in plan if entry.stream == camera]
    picked = [exposures[index] for index in selected_indices(cameras, len(exposures))]
    stamps = np.array([entry.stamp_ns for entry in picked], dtype=np.int64)
    sweeps = [entry for entry in plan if entry.stream == lidar]
    times = np.array([entry.stamp_ns for entry in sweeps], dtype=np.int64)
    near = {int(np.abs(times - stamp).argmin()) for stamp in stamps} if len(times) else set()
    required = {*picked, *(sweeps[index] for index in near)}
    for entry in plan:
        around = entry.stream == ego and len(stamps) and np.abs(stamps - entry.stamp_ns).min() <= MOTION_REACH_NS
        if entry in required or around:
            yield entry


def lidar_of(choice: str | LidarModel, intensity: str | None = None) -> LidarModel:
    """The model of a name, with a kind of intensity. Raises UsageError, which lists the known names."""
    if isinstance(choice, str) and choice not in LIDARS:
        raise UsageError(f"there is no LiDAR {choice!r}; choose one of {', '.join(LIDARS)}")
    model = LIDARS[choice] if isinstance(choice, str) else choice
    if intensity is None:
        return model
    if intensity not in INTENSITIES:
        raise UsageError(f"there is no intensity {intensity!r}; choose one of {', '.join(INTENSITIES)}")
    return replace(model, intensity=INTENSITIES[intensity])


def camera_of(choice: str | Camera, half_view_deg: float) -> Camera:
    """The camera of a name, see `DriveConfig`. Raises UsageError, which lists the allowed forms."""
    if not isinstance(choice, str):
        return choice
    if match := re.fullmatch(r"fisheye(\d{2,4})", choice):
        return fisheye(int(match[1]), half_view_deg)
    if match := re.fullmatch(r"pinhole(\d{2,4})x(\d{2,4})(?:@(\d{1,3}))?", choice):
        width, height, wide_deg = int(match[1]), int(match[2]), int(match[3] or WIDE_DEG)
        if PINHOLE_DEG[0] <= wide_deg <= PINHOLE_DEG[1]:
            focal = width / 2 / math.tan(math.radians(wide_deg) / 2) if wide_deg != WIDE_DEG else width / 2
            return build(
                "pinhole", width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2
            )
    raise UsageError(
        f"unknown camera {choice!r}; write fisheye700 (any width), pinhole1000x400 (any width and height, 90° wide) or "
        f"pinhole640x400@40 (so many degrees wide, {PINHOLE_DEG[0]} to {PINHOLE_DEG[1]})"
    )


def _assumed_camera(camera: Camera, off_percent: tuple[float, float, float]) -> Camera:
    """The camera as the workshop assumes it to be."""
    focal, across, down = (value / 100.0 for value in off_percent)
    parameters = {
        "fx": camera.fx * (1.0 + focal),
        "fy": camera.fy * (1.0 + focal),
        "cx": camera.cx + across * camera.width,
        "cy": camera.cy + down * camera.height,
    }
    return build(name_of(camera), **intrinsics_of(camera) | parameters)


def fisheye(width_px: int, half_view_deg: float) -> Camera:
    """A square double sphere camera into which the circle of this half angle just fits."""
    half = math.radians(half_view_deg)
    sine, cosine = math.sin(half), math.cos(half)
    shifted_z = XI + cosine
    # Usenko, Demmel, Cremers 2018, equations (40) to (42), at the rim: u - cx = fx · x / (α d2 + (1 - α) z').
    rim = sine / (ALPHA * math.hypot(sine, shifted_z) + (1 - ALPHA) * shifted_z)
    focal, centre = (width_px - 1) / 2 / rim, (width_px - 1) / 2
    return build(
        "double_sphere", width=width_px, height=width_px, fx=focal, fy=focal, cx=centre, cy=centre, xi=XI, alpha=ALPHA
    )  # fmt: skip
