"""A drive that never was: frames of a camera, a LiDAR and an odometer on one vehicle, with faults, and the truth.

A `sources.recording.Recording`: every frame follows from the seed and its number alone, and is made when it is asked
for, so a drive of any length needs the memory of one place in the street.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.adapters.images.codec import encode_depth_png, encode_jpeg
from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame, Matrix4, Rig
from coec.errors import UsageError
from coec.geometry.cameras import Camera, build, intrinsics_of, name_of
from coec.geometry.se3 import inverse, perturb
from coec.simulation import faults as wrong
from coec.simulation.exposure import Lens, against_the_sun, at_night, dirt_cover, expose
from coec.simulation.faults import Fault, late_s, shifted
from coec.simulation.lamps import around, headlights, night_sky
from coec.simulation.lidar import LIDARS, LidarModel, sweep
from coec.simulation.mesh import Floats
from coec.simulation.passages import passages
from coec.simulation.render import Exposure, pixel_rays, render_rows
from coec.simulation.scene import Scene, Solid, Town
from coec.simulation.sky import Sky
from coec.simulation.surroundings import SCENES, Surroundings
from coec.simulation.vehicle import T_ego_lidar, Trip, body, build_pace, build_trip, workshop_T_camera_lidar
from coec.simulation.weather import CLEAR, SHOWER_S, Air, low_sun_sky, rained_lens, rainy_air, rainy_sky
from coec.sources.recording import MOTION_REACH_NS, Message, chosen_indices

Doubles = NDArray[np.float64]
F = TypeVar("F", bound=Fault)

START_NS = 1_600_000_000_000_000_000
ROW_PARTS = 24
"""Parts in which a rolling shutter takes its rows: at 10 m/s and 30 ms the camera moves 1.3 cm from one to the next,
less than a pixel of anything beyond 3 m."""
XI, ALPHA = -0.2, 0.6
"""Of the double sphere fisheye: near those of common lenses."""
BODY = np.float32(0.05)
"""Share of the light of the horizon that the black body of the vehicle sends back."""
DAYLIGHT = np.empty((0, 4, 3))
"""No headlights."""
WIDE_DEG, PINHOLE_DEG = 90, (10, 120)
"""Width of a pinhole camera unless told otherwise, and the least and greatest."""
NEAREST_M = 1.0
"""Range whose inverse has the largest depth code, 65535."""
SPEED_SCALE_SIGMA, SPEED_SIGMA_MPS = 0.004, 0.02
TURN_BIAS_SIGMA_RADPS, TURN_SIGMA_RADPS = 0.0005, 0.002
"""Errors of odometry and gyroscope, as of series sensors: constant over a drive, and of each sample."""
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
        camera_hz, lidar_hz, ego_hz: frames per second; a sweep always takes the turn of its model.
        camera_delay_s: the camera exposes this long after the stamp of its sweep.
        speed_mps: mean speed, 0 stands; None = as usual in the scene.
        traffic: whether anything else moves.
        start_m: where along the road the drive begins.
        rolling_shutter_s: from the first row of a picture to the last; its stamp is that of the middle row.
        intrinsics_off: (3,) percent by which the focal length of the rig (of itself) and its principal point (of width
            and height) differ from those of the camera that takes the pictures.
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
    camera_hz: float = 10.0
    lidar_hz: float = 10.0
    ego_hz: float = 50.0
    camera_delay_s: float = 0.01
    speed_mps: float | None = None
    traffic: bool = True
    start_m: float = 0.0
    rolling_shutter_s: float = 0.0
    intrinsics_off: tuple[float, float, float] = (0.0, 0.0, 0.0)
    faults: tuple[Fault, ...] = ()
    workshop: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    depth: bool = False
    lens: Lens = field(default_factory=Lens)


class SimulatedDrive:
    """The drive of a configuration.

    Attributes:
        config: as given.
        rig: with the workshop's calibration as nominal, the intrinsics that the workshop believes in, and a mask of
            lens and body.
        camera: that takes the pictures.
        configuration: None, as for every recording that is not a window.

    Raises:
        UsageError: a camera or a LiDAR that is not known, or figures out of range; names them.
    """

    configuration = None

    def __init__(self, config: DriveConfig) -> None:
        for name in ("seconds", "camera_hz", "lidar_hz", "ego_hz"):
            if not 0 < getattr(config, name) < 1e6:
                raise UsageError(f"{name} of a simulated drive must be above 0, not {getattr(config, name)}")
        self.config = config
        self.lidar = _lidar(config.lidar)
        surroundings = _surroundings(config)
        speed_mps = surroundings.speed_mps if config.speed_mps is None else config.speed_mps
        pace = build_pace(config.seed, config.start_m, speed_mps)
        poor = passages(config.faults, pace, config.seconds)
        reach_m = config.start_m + pace.fastest_mps * config.seconds
        town = Town(config.seed, reach_m, poor, surroundings, traffic=config.traffic)
        self._town = town
        self._trip: Trip = build_trip(config.seed, town.road, town.lane_left_m(), pace)
        self._true = workshop_T_camera_lidar()
        self._body = Solid(body())
        self._mount()

    def _mount(self) -> None:
        """The camera of the configuration."""
        config = self.config
        self.camera = _camera(config.camera, config.half_view_deg)
        self._rays = pixel_rays(self.camera, math.radians(config.half_view_deg))
        seen = np.zeros(self.camera.height * self.camera.width, bool)
        seen[self._rays.pixel] = True
        self._seen = seen.reshape(self.camera.height, self.camera.width)
        self._hidden: tuple[bytes, NDArray[np.bool_]] | None = None
        self._dirt: dict[float, Floats] = {}
        self._repeated: tuple[int, CameraFrame] | None = None
        xi = np.array([*np.deg2rad(config.workshop[:3]), *config.workshop[3:]])
        usable = self._seen & ~self._own_body(self._true)
        mask = cv2.erode(np.pad(usable.astype(np.uint8), 2), np.ones((5, 5), np.uint8))[2:-2, 2:-2] > 0
        told = _told(self.camera, config.intrinsics_off)
        self.rig = Rig("sim", told, "camera", "lidar", perturb(self._true, xi), inverse(T_ego_lidar()), mask=mask)

    def through(self, camera: str | Camera, half_view_deg: float) -> SimulatedDrive:
        """The same drive with another lens: its surroundings are shared, so it is best drawn in step with this one.

        Raises:
            UsageError: a camera that is not known.
        """
        other = copy(self)
        other.config = replace(self.config, camera=camera, half_view_deg=half_view_deg)
        other._mount()
        return other

    @property
    def name(self) -> str:
        """For people."""
        return f"simulated drive, seed {self.config.seed}"

    @property
    def T_camera_lidar_start(self) -> Matrix4:
        """(4, 4) the workshop's."""
        return self.rig.T_camera_lidar_nominal

    @cached_property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames that arrive, ascending."""
        return tuple(stamp for stamp, stream, _ in self._plan if stream == _CAMERA)

    @cached_property
    def sweep_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the sweeps that arrive, ascending."""
        return tuple(stamp for stamp, stream, _ in self._plan if stream == _LIDAR)

    @cached_property
    def motion_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the ego-motion that arrives, ascending."""
        return tuple(stamp for stamp, stream, _ in self._plan if stream == _EGO)

    def truth(self, stamp_ns: int) -> Matrix4:
        """True T_camera_lidar (4, 4) at a time."""
        return shifted(self._true, self.config.faults, (stamp_ns - START_NS) / 1e9)

    def true_pose(self, stamp_ns: int) -> Matrix4:
        """True T_world_ego (4, 4) at a time."""
        pose: Matrix4 = self._trip.poses(np.array([(stamp_ns - START_NS) / 1e9]))[0]
        return pose

    def messages(self, cameras: Collection[int] | None = None) -> Iterator[Message]:
        """See `Recording.messages`."""
        for entry in self._chosen(cameras):
            yield self._message(*entry)

    def part(self, begin: int, end: int) -> list[Message]:
        """Messages `begin` to `end` (excluded) of all, by their place in `messages()`: for several processes."""
        return [self._message(*entry) for entry in self._plan[begin:end]]

    @property
    def message_count(self) -> int:
        """How many `messages()` there are."""
        return len(self._plan)

    def _message(self, stamp_ns: int, stream: int, index: int) -> Message:
        if stream == _CAMERA:
            return self._expose(index, stamp_ns)
        return self._sweep(index, stamp_ns) if stream == _LIDAR else self._motion(index, stamp_ns)

    # --- when -------------------------------------------------------------------------------------------------

    @cached_property
    def _plan(self) -> list[tuple[int, int, int]]:
        """(stamp_ns, stream, number) of everything that arrives, in the order of the stamps."""
        config = self.config
        plan = []
        for stream, rate_hz in ((_EGO, config.ego_hz), (_LIDAR, config.lidar_hz), (_CAMERA, config.camera_hz)):
            for index in range(math.ceil(config.seconds * rate_hz)):
                time_s = self._time_s(stream, index)
                if not self._lost(stream, index, time_s):
                    late = late_s(config.faults, time_s) if stream == _CAMERA else 0.0
                    plan.append((START_NS + round((time_s + late) * 1e9), stream, index))
        return sorted(plan)

    def _time_s(self, stream: int, index: int) -> float:
        """True time of a frame: of an exposure, or of the middle of a sweep."""
        config = self.config
        if stream == _CAMERA:
            return index / config.camera_hz + config.camera_delay_s
        return index / (config.lidar_hz if stream == _LIDAR else config.ego_hz)

    def _lost(self, stream: int, index: int, time_s: float) -> bool:
        if stream == _EGO and any(self._now(wrong.NoEgo, time_s)):
            return True
        shares = [fault.share for fault in self._now(wrong.Loss, time_s)]
        return bool(shares) and self._rng(130, stream, index).random() < max(shares)

    def _now(self, kind: type[F], time_s: float) -> Iterator[F]:
        return (fault for fault in self.config.faults if isinstance(fault, kind) and fault.active(time_s))

    def _chosen(self, cameras: Collection[int] | None) -> Iterator[tuple[int, int, int]]:
        """The part of the plan that the chosen camera frames need: the sweep nearest to each, motion around it."""
        if cameras is None:
            yield from self._plan
            return
        exposures = [entry for entry in self._plan if entry[1] == _CAMERA]
        picked = [exposures[index] for index in chosen_indices(cameras, len(exposures))]
        stamps = np.array([entry[0] for entry in picked], dtype=np.int64)
        sweeps = [entry for entry in self._plan if entry[1] == _LIDAR]
        times = np.array([entry[0] for entry in sweeps], dtype=np.int64)
        near = {int(np.abs(times - stamp).argmin()) for stamp in stamps} if len(times) else set()
        wanted = {*picked, *(sweeps[index] for index in near)}
        for entry in self._plan:
            around = entry[1] == _EGO and len(stamps) and np.abs(stamps - entry[0]).min() <= MOTION_REACH_NS
            if entry in wanted or around:
                yield entry

    # --- what -------------------------------------------------------------------------------------------------

    def _rng(self, *key: int) -> np.random.Generator:
        return np.random.default_rng([self.config.seed, *key])

    def _scene(self, time_s: float) -> Scene:
        at_m = float(self._trip.pace.progress(np.array([time_s]))[0])
        scene = self._town.scene(at_m, time_s, self._trip.pace.progress)
        night = any(self._now(wrong.Night, time_s))
        sky = self._weather(time_s)
        scene.sky = night_sky(sky) if night else sky
        scene.headlights = headlights(self._trip.poses(np.array([time_s]))[0]) if night else DAYLIGHT
        return scene

    def _weather(self, time_s: float) -> Sky:
        sky = self._town.sky
        for sunny in self._now(wrong.LowSun, time_s):
            ahead = self._trip.poses(np.array([sunny.begin_s]))[0]
            sky = low_sun_sky(sky, math.atan2(ahead[1, 0], ahead[0, 0]))
        rain = self._rain(time_s)
        return rainy_sky(sky, rain) if rain else sky

    def _rain(self, time_s: float) -> float:
        """Millimetres an hour."""
        return max((fault.mmph for fault in self._now(wrong.Rain, time_s)), default=0.0)

    def _expose(self, index: int, stamp_ns: int) -> CameraFrame:
        time_s = self._time_s(_CAMERA, index)
        frozen = next(self._now(wrong.Frozen, time_s), None)
        if frozen is None:
            return self._picture(index, stamp_ns)
        last = max(math.ceil((frozen.begin_s - self.config.camera_delay_s) * self.config.camera_hz) - 1, 0)
        if self._repeated is None or self._repeated[0] != last:
            self._repeated = (last, self._picture(last, stamp_ns))
        before = self._repeated[1]
        return CameraFrame(stamp_ns, before.frame_id, before.image, sequence=index, depth=before.depth)

    def _picture(self, index: int, stamp_ns: int) -> CameraFrame:
        time_s = self._time_s(_CAMERA, index)
        T_camera_lidar = shifted(self._true, self.config.faults, time_s)
        exposures = self._rows(time_s, _times(T_ego_lidar(), inverse(T_camera_lidar)))
        view = math.radians(self.config.half_view_deg)
        scene = self._scene(time_s)
        radiance = render_rows(scene, self.camera, exposures, half_view_rad=view)
        hidden = self._own_body(T_camera_lidar)
        share, lamps = around(scene, exposures[len(exposures) // 2].T_world_camera[:3, 3])
        radiance.linear[hidden] = BODY * (np.float32(share) * np.array(scene.sky.horizon, np.float32) + lamps)
        light = math.prod(fault.light for fault in self._now(wrong.Dark, time_s))
        lens = at_night(self.config.lens) if any(self._now(wrong.Night, time_s)) else self.config.lens
        lens = against_the_sun(lens) if any(self._now(wrong.LowSun, time_s)) else lens
        cover = self._cover(time_s)
        pixels = expose(radiance.linear, self._seen, lens, self._rng(131, index), light=light, dirt=cover)
        size = (self.camera.width, self.camera.height)
        image = EncodedImage(ImageFormat.JPEG, *size, encode_jpeg(pixels, self.config.lens.jpeg_quality))
        depth = None
        if self.config.depth:
            code = np.clip(65535 * NEAREST_M / radiance.range_m, 1, 65535)
            code[np.isnan(code)] = 1  # the sky is far, not unknown
            code[hidden | ~self._seen] = 0
            depth = EncodedImage(ImageFormat.PNG, *size, encode_depth_png(code.astype(np.uint16)))
        return CameraFrame(stamp_ns, "camera", image, sequence=index, depth=depth)

    def _rows(self, time_s: float, T_ego_camera: Matrix4) -> list[Exposure]:
        """Where the camera is while it takes its rows."""
        height, readout_s = self.camera.height, self.config.rolling_shutter_s
        bounds = np.linspace(0, height, (min(ROW_PARTS, height) if readout_s else 1) + 1).round().astype(int)
        times = time_s + readout_s * ((bounds[:-1] + bounds[1:]) / 2 / height - 0.5)
        poses = self._trip.poses(times)
        return [
            Exposure(int(first), int(last), _times(pose, T_ego_camera), float(at_s))
            for first, last, pose, at_s in zip(bounds[:-1], bounds[1:], poses, times, strict=True)
        ]

    def _cover(self, time_s: float) -> Floats | None:
        """Dirt and drops on the lens, whichever hides more."""
        covers = []
        if share := max((fault.share for fault in self._now(wrong.Dirt, time_s)), default=0.0):
            if share not in self._dirt:
                self._dirt[share] = dirt_cover(self._seen.shape, share, self.config.seed)
            covers.append(self._dirt[share])
        if rain := self._rain(time_s):
            covers.append(rained_lens(self._seen.shape, rain, self.config.seed, int(time_s / SHOWER_S)))
        return np.maximum.reduce(covers) if covers else None

    def _own_body(self, T_camera_lidar: Matrix4) -> NDArray[np.bool_]:
        """(h, w): pixels that show the vehicle itself; depends on how the camera is mounted."""
        key = T_camera_lidar.tobytes()
        if self._hidden is None or self._hidden[0] != key:
            T_ego_camera = _times(T_ego_lidar(), inverse(T_camera_lidar))
            rays = np.einsum("ij,nj->ni", T_ego_camera[:3, :3], self._rays.directions).astype(np.float32)
            origins = np.empty_like(rays)
            origins[:] = T_ego_camera[:3, 3]
            hidden = np.zeros(self._seen.size, bool)
            hidden[self._rays.pixel] = self._body.blocked(origins, rays)
            self._hidden = (key, hidden.reshape(self._seen.shape))
        return self._hidden[1]

    def _sweep(self, index: int, stamp_ns: int) -> LidarFrame:
        time_s = self._time_s(_LIDAR, index)
        share = max((fault.share for fault in self._now(wrong.Beams, time_s)), default=0.0)
        dead = self._rng(132).random(self.lidar.pattern.beams) < share if share else None
        rain = self._rain(time_s)
        air: Air = rainy_air(rain) if rain else CLEAR
        found = sweep(self._scene(time_s), self.lidar, self._lidar_poses, time_s, self._rng(133, index), dead, air)
        return LidarFrame(
            stamp_ns, "lidar", found.xyz_m, found.intensity, found.ring, found.time_offset_s, sequence=index
        )  # fmt: skip

    def _lidar_poses(self, time_s: Doubles) -> Doubles:
        poses: Doubles = np.einsum("nij,jk->nik", self._trip.poses(time_s), T_ego_lidar())
        return poses

    def _motion(self, index: int, stamp_ns: int) -> EgoMotion:
        linear, angular = self._trip.twist(self._time_s(_EGO, index))
        constant, sample = self._rng(134), self._rng(135, index)
        linear = linear * (1 + constant.normal(0, SPEED_SCALE_SIGMA)) + sample.normal(0, SPEED_SIGMA_MPS, 3)
        bias = constant.normal(0, TURN_BIAS_SIGMA_RADPS, 3)
        angular = angular + bias + sample.normal(0, TURN_SIGMA_RADPS, 3)
        vx, vy, vz = (float(value) for value in linear)
        wx, wy, wz = (float(value) for value in angular)
        return EgoMotion(stamp_ns, "ego", (vx, vy, vz), (wx, wy, wz), sequence=index)


def _times(a: Matrix4, b: Matrix4) -> Matrix4:
    # Not `@`: the same bits whatever BLAS does.
    product: Matrix4 = np.einsum("ij,jk->ik", a, b)
    return product


def _surroundings(config: DriveConfig) -> Surroundings:
    if config.scene not in SCENES:
        raise UsageError(f"there is no scene {config.scene!r}; choose one of {', '.join(SCENES)}")
    made = SCENES[config.scene](config.seed)
    stretches = [fault for fault in config.faults if isinstance(fault, wrong.Tunnel | wrong.OpenRoad)]
    if stretches and not made.poor:
        raise UsageError(f"a tunnel or an open road is a stretch of a street, not of a {config.scene}")
    if config.speed_mps == 0 and any(isinstance(fault, wrong.Tunnel) for fault in stretches):
        raise UsageError("a standing vehicle comes into no tunnel: give it a speed")
    return made


def _lidar(choice: str | LidarModel) -> LidarModel:
    if isinstance(choice, LidarModel):
        return choice
    if choice not in LIDARS:
        raise UsageError(f"there is no LiDAR {choice!r}; choose one of {', '.join(LIDARS)}")
    return LIDARS[choice]


def _camera(choice: str | Camera, half_view_deg: float) -> Camera:
    if not isinstance(choice, str):
        return choice
    if found := re.fullmatch(r"fisheye(\d{2,4})", choice):
        return fisheye(int(found[1]), half_view_deg)
    if found := re.fullmatch(r"pinhole(\d{2,4})x(\d{2,4})(?:@(\d{1,3}))?", choice):
        width, height, wide_deg = int(found[1]), int(found[2]), int(found[3] or WIDE_DEG)
        if PINHOLE_DEG[0] <= wide_deg <= PINHOLE_DEG[1]:
            focal = width / 2 / math.tan(math.radians(wide_deg) / 2) if wide_deg != WIDE_DEG else width / 2
            return build(
                "pinhole", width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2
            )
    raise UsageError(
        f"unknown camera {choice!r}; write fisheye700 (any width), pinhole1000x400 (any width and height, 90° wide) or "
        f"pinhole640x400@40 (so many degrees wide, {PINHOLE_DEG[0]} to {PINHOLE_DEG[1]})"
    )


def _told(camera: Camera, off_percent: tuple[float, float, float]) -> Camera:
    """The camera as the workshop believes it to be."""
    focal, across, down = (value / 100.0 for value in off_percent)
    told = {
        "fx": camera.fx * (1.0 + focal),
        "fy": camera.fy * (1.0 + focal),
        "cx": camera.cx + across * camera.width,
        "cy": camera.cy + down * camera.height,
    }
    return build(name_of(camera), **intrinsics_of(camera) | told)


def fisheye(width_px: int, half_view_deg: float) -> Camera:
    """A square double sphere camera whose circle of this half angle just fits."""
    half = math.radians(half_view_deg)
    sine, cosine = math.sin(half), math.cos(half)
    shifted_z = XI + cosine
    # Usenko, Demmel, Cremers 2018, equations (40) to (42), at the rim: u - cx = fx · x / (α d2 + (1 - α) z').
    rim = sine / (ALPHA * math.hypot(sine, shifted_z) + (1 - ALPHA) * shifted_z)
    focal, centre = (width_px - 1) / 2 / rim, (width_px - 1) / 2
    return build(
        "double_sphere", width=width_px, height=width_px, fx=focal, fy=focal, cx=centre, cy=centre, xi=XI, alpha=ALPHA
    )  # fmt: skip
