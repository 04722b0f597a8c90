"""A simulated drive of a vehicle with several cameras and LiDARs: where each sensor sits, when it measures, the
recording of each pair, and instants (a sweep of one LiDAR, and for each camera the picture nearest to it). Cameras
that are exposed when the beam of a LiDAR passes differ by a share of a turn, but all pair with one sweep. To get a
few pairs of each camera, only the frames of instants have to be rendered, each once, however many pairs use it.

Every frame follows from the seed, its sensor and its number alone. A pair of the rig is a recording like any other. As
a stream of all sensors, each frame is made once, however many pairs use it.

Cameras that are exposed when the beam of a LiDAR passes are apart by a share of a turn, but all pair with one sweep. To
get a few pairs of each camera, only these frames have to be drawn, each once, however many pairs use it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import Frame, FramePair, LidarFrame, Matrix4, Rig
from coec.config import PairingConfig
from coec.errors import UsageError
from coec.geometry.cameras import Camera
from coec.geometry.se3 import inverse, perturb, rotation_exp
from coec.io.recordings.recording_source import CLOUD, IMAGE, KINDS, MOTION
from coec_lab.simulation import simulated_sensors
from coec_lab.simulation.drive import Arrival, arrivals, camera_of, check_rates, lidar_of, needed, seconds_of, stamps_of
from coec_lab.simulation.faults import SensorFault, shifted
from coec_lab.simulation.journey import Journey
from coec_lab.simulation.lidar_model import LIDARS, LidarModel, Turn, even_deg
from coec_lab.simulation.reflectance import INTENSITIES
from coec_lab.simulation.render import LensProperties
from coec_lab.simulation.scene import Solid
from coec_lab.simulation.vehicle_motion import whole_body

NEAR = LidarModel(
    Turn(even_deg(-52.0, 52.0, 32), columns=900), reach_m=30.0, nearest_m=0.3, noise_m=0.02, divergence_rad=0.003,
    intensity=INTENSITIES["reflectivity"],
)  # fmt: skip
"""A short-range LiDAR that sees nearly a hemisphere, with angles and reach of common blind-spot sensors."""


@dataclass(frozen=True, slots=True, eq=False)
class MountedCamera:
    """A fisheye where it was mounted.

    Attributes:
        T_ego_camera: (4, 4).
        phase: when it exposes, as a share of the period of its pictures.
    """

    name: str
    T_ego_camera: Matrix4
    phase: float


@dataclass(frozen=True, slots=True, eq=False)
class MountedLidar:
    """A LiDAR where it was mounted.

    Attributes:
        T_ego_lidar: (4, 4).
        phase: when the middle of its turn is, as a share of its period.
    """

    name: str
    T_ego_lidar: Matrix4
    model: LidarModel
    phase: float


@dataclass(frozen=True, slots=True)
class RigLayout:
    """The sensors of a vehicle, with unique names."""

    cameras: tuple[MountedCamera, ...]
    lidars: tuple[MountedLidar, ...]
    half_view_deg: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all sensors, cameras first."""
        return (*(camera.name for camera in self.cameras), *(lidar.name for lidar in self.lidars))

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Every camera with every LiDAR."""
        return tuple((camera.name, lidar.name) for camera in self.cameras for lidar in self.lidars)


def _camera(
    name: str, heading_deg: float, down_deg: float, at_m: tuple[float, float, float], phase: float
) -> MountedCamera:
    """A camera that looks towards a heading (counted from ahead to the left) and down."""
    turn = rotation_exp(np.array([0.0, 0.0, np.deg2rad(heading_deg)]))
    nod = rotation_exp(np.array([0.0, np.deg2rad(down_deg), 0.0]))
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    transform = np.eye(4)
    transform[:3, :3] = np.einsum("ij,jk,kl->il", turn, nod, ahead)
    transform[:3, 3] = at_m
    return MountedCamera(name, transform, phase)


def _lidar(
    name: str, turned_deg: tuple[float, float, float], at_m: tuple[float, float, float], model: LidarModel, phase: float
) -> MountedLidar:
    """A LiDAR that is turned from looking ahead by a rotation vector about x, y, z."""
    transform = np.eye(4)
    transform[:3, :3] = rotation_exp(np.deg2rad(np.array(turned_deg)))
    transform[:3, 3] = at_m
    return MountedLidar(name, transform, model, phase)


FOUR_FISHEYES = RigLayout(
    cameras=(
        _camera("front", 1.0, 8.0, (1.95, 0.02, 1.68), 0.02),
        _camera("left", 91.0, 12.0, (1.15, 0.62, 1.70), 0.77),
        _camera("rear", -178.5, 9.0, (0.25, -0.03, 1.69), 0.52),
        _camera("right", -89.0, 11.0, (1.20, -0.63, 1.70), 0.27),
    ),
    lidars=(
        _lidar("roof", (0.4, -0.6, 1.0), (1.20, 0.0, 2.00), LIDARS["64"], 0.0),
        _lidar("near_left", (-3.0, 1.0, 88.0), (1.30, 1.00, 1.05), NEAR, 0.13),
        _lidar("near_right", (3.0, 1.0, -91.0), (1.28, -1.00, 1.05), NEAR, 0.37),
    ),
    half_view_deg=95.0,
)
"""Fisheyes of 190° on the four edges of a roof rack, each exposed when the beam of the roof LiDAR passes its axis; a
64-beam LiDAR between them; and a free-running short-range LiDAR on each flank. The cameras are on the roof to be near
the LiDAR, because their depth differs more the further away they are (METHOD, section 1). As on real mounts, no angle
is a round number."""

RIGS: Mapping[str, RigLayout] = MappingProxyType({"four-fisheyes": FOUR_FISHEYES})


EGO = "ego"
"""Name of the odometer's stream, and of the vehicle's frame."""

Vector6 = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class RigDriveConfig:
    """What to drive: like `drive.DriveConfig`, for a rig.

    Attributes:
        camera: model of every camera of the rig, `fisheyeW`.
        faults: of single sensors or of all; a step or drift turns a sensor about its own axes: T_sensor_ego becomes
            exp(ξ)·T_sensor_ego.
        workshop: by sensor, (6,) ξ, degrees and metres about its own axes, by which its nominal pose is wrong.
        intensity: of every LiDAR, see `drive.DriveConfig`.
        rows: of every camera, see `Optics`: comparing edges with a LiDAR needs only the rows that the LiDAR sees.
    """

    layout: RigLayout = FOUR_FISHEYES
    seed: int = 0
    scene: str = "street"
    seconds: float = 60.0
    camera: str = "fisheye700"
    intensity: str | None = None
    camera_hz: float = 10.0
    lidar_hz: float = 10.0
    ego_hz: float = 50.0
    speed_mps: float | None = None
    traffic: bool = True
    start_m: float = 0.0
    faults: tuple[SensorFault, ...] = ()
    workshop: tuple[tuple[str, Vector6], ...] = ()
    depth: bool = False
    lens: LensProperties = field(default_factory=LensProperties)
    rows: tuple[float, float] = (0.0, 1.0)

    def drive(self) -> RigDrive:
        """The drive that it describes."""
        return RigDrive(self)


class RigDrive:
    """The drive of a configuration.

    Attributes:
        config: as given.
        cameras, lidars: names of the sensors.
        camera: intrinsics of every camera.

    Raises:
        UsageError: an unknown camera or sensor, or figures out of range; the message names them.
    """

    def __init__(self, config: RigDriveConfig) -> None:
        check_rates(config)
        layout = config.layout
        self.config = config
        self.cameras = tuple(sensor.name for sensor in layout.cameras)
        self.lidars = tuple(sensor.name for sensor in layout.lidars)
        self.camera: Camera = camera_of(config.camera, layout.half_view_deg)
        named = {*(fault.sensor for fault in config.faults if fault.sensor is not None), *dict(config.workshop)}
        if unknown := sorted(named - set(layout.names)):
            raise UsageError(f"the rig has no sensor {', '.join(unknown)}; it has {', '.join(layout.names)}")
        self._mounted = {sensor.name: inverse(sensor.T_ego_camera) for sensor in layout.cameras} | {
            sensor.name: inverse(sensor.T_ego_lidar) for sensor in layout.lidars
        }
        common = tuple(fault.fault for fault in config.faults if fault.sensor is None)
        self._faults = {
            name: (*common, *(fault.fault for fault in config.faults if fault.sensor == name)) for name in layout.names
        }
        self._journey = Journey(
            config.seed, config.scene, config.seconds,
            speed_mps=config.speed_mps, start_m=config.start_m, traffic=config.traffic, faults=common,
        )  # fmt: skip
        self._body = Solid(whole_body())
        self._order = (EGO, *self.lidars, *self.cameras)
        self._eyes: dict[str, simulated_sensors.SimulatedCamera] = {}
        self._streams: dict[str, simulated_sensors.SimulatedSensor] = {
            EGO: simulated_sensors.SimulatedOdometer(
                self._journey, simulated_sensors.Wire(EGO, config.ego_hz, 0, (), common)
            )
        }
        for lidar in layout.lidars:
            self._streams[lidar.name] = simulated_sensors.SimulatedLidar(
                self._journey, self._wire(lidar.name, config.lidar_hz), lidar_of(lidar.model, config.intensity),
                self._mount(lidar.name),
                delay_s=lidar.phase / config.lidar_hz, own_body=self._body,
            )  # fmt: skip
        for camera in layout.cameras:
            optics = simulated_sensors.Optics(
                self.camera, layout.half_view_deg, camera.phase / config.camera_hz,
                depth=config.depth, lens=config.lens, rows=config.rows,
            )  # fmt: skip
            self._eyes[camera.name] = simulated_sensors.SimulatedCamera(
                self._journey, self._wire(camera.name, config.camera_hz), optics, self._mount(camera.name), self._body
            )
        self._streams |= self._eyes

    @property
    def name(self) -> str:
        """Name for people."""
        return f"simulated drive of a rig, seed {self.config.seed}"

    @property
    def message_count(self) -> int:
        """How many `messages()` there are."""
        return len(self.plan)

    @cached_property
    def plan(self) -> list[Arrival]:
        """Everything that arrives, in the order of the stamps. Streams are numbered: ego, LiDARs, cameras."""
        return arrivals([self._streams[name] for name in self._order], self.config.seconds)

    def messages(self) -> Iterator[Frame]:
        """All frames of all sensors in the order of their stamps; `frame_id` is the name of the sensor."""
        for entry in self.plan:
            yield self.message(entry)

    def part(self, begin: int, end: int) -> list[Frame]:
        """Messages `begin` to `end` (excluded) of `messages()`, so that several processes can share the work."""
        return [self.message(entry) for entry in self.plan[begin:end]]

    def message(self, entry: Arrival) -> Frame:
        """The message of one entry of the plan."""
        return self._streams[self._order[entry.stream]].frame(entry.number, entry.stamp_ns)

    def stream(self, sensor: str) -> int:
        """Number of the stream of a sensor, or of `EGO`, in the plan."""
        return self._order.index(sensor)

    def T_sensor_ego(self, sensor: str, stamp_ns: int) -> Matrix4:
        """(4, 4) true pose at a time."""
        return shifted(self._mounted[sensor], self._faults[sensor], seconds_of(stamp_ns))

    def T_sensor_ego_nominal(self, sensor: str) -> Matrix4:
        """(4, 4) pose that the workshop assumes."""
        xi = dict(self.config.workshop).get(sensor, (0.0,) * 6)
        return perturb(self._mounted[sensor], np.array([*np.deg2rad(xi[:3]), *xi[3:]]))

    def true_pose(self, stamp_ns: int) -> Matrix4:
        """True T_world_ego (4, 4) at a time."""
        return self._journey.pose(seconds_of(stamp_ns))

    def mask(self, camera: str) -> NDArray[np.bool_]:
        """(height, width): pixels of a camera that show the world, from where the camera was mounted."""
        return self._eyes[camera].mask_at(inverse(self._mounted[camera]))

    def pair(self, camera: str, lidar: str) -> SimulatedRigPair:
        """The recording of a camera and a LiDAR of the rig.

        Raises:
            UsageError: there is no such sensor.
        """
        for sensor, known, kind in ((camera, self.cameras, "camera"), (lidar, self.lidars, "LiDAR")):
            if sensor not in known:
                raise UsageError(f"the rig has no {kind} {sensor!r}; it has {', '.join(known)}")
        return SimulatedRigPair(self, camera, lidar)

    def _wire(self, name: str, hz: float) -> simulated_sensors.Wire:
        number = self._order.index(name)
        return simulated_sensors.Wire(name, hz, number, (number,), self._faults[name])

    def _mount(self, name: str) -> simulated_sensors.Mount:
        return lambda time_s: inverse(shifted(self._mounted[name], self._faults[name], time_s))


class SimulatedRigPair:
    """A camera and a LiDAR of a rig, as a `sources.recording.Recording` whose truth is known.

    Attributes:
        rig: with the workshop's poses as nominal, and a mask of lens and body.
        configuration: None, as for every recording that is not a window.
    """

    configuration = None

    def __init__(self, drive: RigDrive, camera: str, lidar: str) -> None:
        self._drive = drive
        self._camera, self._lidar = camera, lidar
        self._streams = {IMAGE: drive.stream(camera), CLOUD: drive.stream(lidar), MOTION: drive.stream(EGO)}
        T_lidar_ego = drive.T_sensor_ego_nominal(lidar)
        nominal = simulated_sensors.product(drive.T_sensor_ego_nominal(camera), inverse(T_lidar_ego))
        self.rig = Rig(f"{camera}-{lidar}", drive.camera, camera, lidar, nominal, T_lidar_ego, mask=drive.mask(camera))

    @property
    def name(self) -> str:
        """Name for people."""
        return f"{self._drive.name}, {self.rig.pair}"

    @property
    def T_camera_lidar_start(self) -> Matrix4:
        """(4, 4) the workshop's calibration."""
        return self.rig.T_camera_lidar_nominal

    @property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames that arrive, ascending."""
        return stamps_of(self._plan, self._streams[IMAGE])

    @property
    def sweep_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the sweeps that arrive, ascending."""
        return stamps_of(self._plan, self._streams[CLOUD])

    @property
    def motion_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the ego-motion that arrives, ascending."""
        return stamps_of(self._plan, self._streams[MOTION])

    def truth(self, stamp_ns: int) -> Matrix4:
        """True T_camera_lidar (4, 4) at a time."""
        T_lidar_ego = self._drive.T_sensor_ego(self._lidar, stamp_ns)
        return simulated_sensors.product(self._drive.T_sensor_ego(self._camera, stamp_ns), inverse(T_lidar_ego))

    def messages(self, cameras: Collection[int] | None = None, kinds: Collection[str] = KINDS) -> Iterator[Frame]:
        """See `Recording.messages`."""
        required = self._plan if cameras is None else needed(self._plan, cameras, *self._streams.values())
        loaded = {self._streams[kind] for kind in kinds}
        return (self._drive.message(entry) for entry in required if entry.stream in loaded)

    def sweeps(self, stamps_ns: Collection[int]) -> Iterator[LidarFrame]:
        """See `Recording.sweeps`."""
        sweeps = (one for one in self._plan if one.stream == self._streams[CLOUD] and one.stamp_ns in stamps_ns)
        return (frame for frame in map(self._drive.message, sweeps) if isinstance(frame, LidarFrame))

    @cached_property
    def _plan(self) -> list[Arrival]:
        return [entry for entry in self._drive.plan if entry.stream in self._streams.values()]


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


def pair_of(picture: Frame, sweep: Frame, motions: tuple[Frame, ...]) -> FramePair | None:
    """The pair that the service would make of a picture, a sweep and the motion around them; None if it makes none."""
    pairer = Pairer(PairingConfig(), expects_motion=True)
    pairs = []
    for frame in sorted((picture, sweep, *motions), key=lambda frame: frame.stamp_ns):
        pairs += pairer.push(frame)
    return next(iter((*pairs, *pairer.flush())), None)
