"""The sensors aboard: each makes a frame from its number alone, given the scene around it and the sensor's faults."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame, Matrix4
from coec.geometry.cameras import Camera
from coec.io.images import encode_depth_png, encode_jpeg
from coec_lab.simulation import faults as wrong
from coec_lab.simulation import render
from coec_lab.simulation.faults import Fault, late_s
from coec_lab.simulation.journey import Journey
from coec_lab.simulation.lidar_model import LidarModel, Sweep, sweep
from coec_lab.simulation.mesh import Floats
from coec_lab.simulation.reflectance import beam_gains
from coec_lab.simulation.scene import Solid
from coec_lab.simulation.shading import around
from coec_lab.simulation.weather import CLEAR, SHOWER_S, rained_lens, rainy_air

Doubles = NDArray[np.float64]
Mount = Callable[[float], Matrix4]
"""Pose (4, 4) of a sensor in the ego frame as a function of time, because it may be knocked."""
Frame = CameraFrame | LidarFrame | EgoMotion

ROW_PARTS = 24
"""Parts in which a rolling shutter takes its rows: at 10 m/s and 30 ms the camera moves 1.3 cm from one part to the
next, less than a pixel of anything beyond 3 m."""
BODY = np.float32(0.05)
"""Share of the horizon's light that the black body of the vehicle reflects."""
NEAREST_M = 1.0
"""Range whose inverse has the largest depth code, 65535."""
_LOSS, _EXPOSURE, _BEAMS, _SWEEP, _GAINS = 130, 131, 132, 133, 137
"""Keys of random numbers, by purpose."""


class SimulatedSensor(Protocol):
    """A sensor that sends frames."""

    @property
    def hz(self) -> float:
        """Frames a second."""
        ...

    def time_s(self, index: int) -> float:
        """True time of a frame: of an exposure, or of the middle of a sweep."""
        ...

    def late_s(self, time_s: float) -> float:
        """How late the stamp of a frame is that is made at a time, seconds."""
        ...

    def is_lost(self, index: int, time_s: float) -> bool:
        """Whether a frame does not arrive."""
        ...

    def frame(self, index: int, stamp_ns: int) -> Frame:
        """The frame of this number."""
        ...


@dataclass(frozen=True, slots=True)
class Wire:
    """The connection that carries a sensor's frames and may lose some.

    Attributes:
        name: of the sensor's coordinate frame.
        hz: frames a second.
        number: of the stream, in the order of messages with equal stamps.
        key: prefix of the keys of the sensor's random numbers; empty if it is the only sensor of its kind.
        faults: of the sensor.
    """

    name: str
    hz: float
    number: int
    key: tuple[int, ...] = ()
    faults: tuple[Fault, ...] = ()

    def is_lost(self, journey: Journey, index: int, time_s: float) -> bool:
        """Whether a frame does not arrive."""
        shares = [fault.share for fault in wrong.now(self.faults, wrong.Loss, time_s)]
        return bool(shares) and journey.rng(_LOSS, self.number, index).random() < max(shares)


class SimulatedOdometer:
    """The odometer, which sends ego-motion."""

    def __init__(self, journey: Journey, wire: Wire) -> None:
        self._journey = journey
        self._wire = wire
        self.hz = wire.hz

    def time_s(self, index: int) -> float:
        """See `SimulatedSensor`."""
        return index / self.hz

    def late_s(self, time_s: float) -> float:  # noqa: ARG002 - never
        """See `SimulatedSensor`."""
        return 0.0

    def is_lost(self, index: int, time_s: float) -> bool:
        """See `SimulatedSensor`."""
        return self._journey.is_odometer_silent(time_s) or self._wire.is_lost(self._journey, index, time_s)

    def frame(self, index: int, stamp_ns: int) -> EgoMotion:
        """See `SimulatedSensor`."""
        return self._journey.motion(index, self.time_s(index), stamp_ns)


class SimulatedLidar:
    """A LiDAR, which sends sweeps.

    Attributes:
        T_ego_lidar: its pose over time.
    """

    def __init__(
        self,
        journey: Journey,
        wire: Wire,
        model: LidarModel,
        T_ego_lidar: Mount,
        *,
        delay_s: float = 0.0,
        own_body: Solid | None = None,
    ) -> None:
        """`own_body`: the vehicle itself, which hides what lies behind it and whose points the driver removes."""
        self.T_ego_lidar = T_ego_lidar
        self.hz = wire.hz
        self._journey, self._wire, self._model = journey, wire, model
        self._delay_s = delay_s
        self._own_body = own_body
        self._repeated: tuple[int, LidarFrame] | None = None
        self._gains: Doubles | None = None
        if model.intensity is not None:
            self._gains = beam_gains(model.intensity, model.pattern.beams, journey.rng(_GAINS, *wire.key))

    def time_s(self, index: int) -> float:
        """See `SimulatedSensor`."""
        return index / self.hz + self._delay_s

    def late_s(self, time_s: float) -> float:  # noqa: ARG002 - never
        """See `SimulatedSensor`."""
        return 0.0

    def is_lost(self, index: int, time_s: float) -> bool:
        """See `SimulatedSensor`."""
        return self._wire.is_lost(self._journey, index, time_s)

    def frame(self, index: int, stamp_ns: int) -> LidarFrame:
        """See `SimulatedSensor`."""
        frozen = next(wrong.now(self._wire.faults, wrong.LidarFrozen, self.time_s(index)), None)
        if frozen is None:
            return self._sweep(index, stamp_ns)
        last = max(math.ceil((frozen.begin_s - self._delay_s) * self.hz) - 1, 0)
        if self._repeated is None or self._repeated[0] != last:
            self._repeated = (last, self._sweep(last, stamp_ns))
        return replace(self._repeated[1], stamp_ns=stamp_ns, sequence=index)

    def _sweep(self, index: int, stamp_ns: int) -> LidarFrame:
        time_s, journey, key = self.time_s(index), self._journey, self._wire.key
        share = max((fault.share for fault in wrong.now(self._wire.faults, wrong.Beams, time_s)), default=0.0)
        dead = journey.rng(_BEAMS, *key).random(self._model.pattern.beams) < share if share else None
        rain = journey.rain(time_s)
        air = rainy_air(rain) if rain else CLEAR
        mounted = self.T_ego_lidar(time_s)  # a knock within a sweep waits for its end

        def poses(times_s: Doubles) -> Doubles:
            return np.asarray(np.einsum("nij,jk->nik", journey.trip.poses(times_s), mounted), np.float64)

        noise = journey.rng(_SWEEP, *key, index)
        measured = sweep(journey.scene(time_s), self._model, poses, time_s, noise, dead, air, self._gains)
        if self._own_body is not None:
            measured = _past(self._own_body, mounted, measured)
        return LidarFrame(
            stamp_ns, self._wire.name, measured.xyz_m, measured.intensity, measured.ring, measured.time_offset_s,
            sequence=index,
        )  # fmt: skip


def _past(own_body: Solid, T_ego_lidar: Matrix4, measured: Sweep) -> Sweep:
    """The points that the vehicle itself does not hide."""
    rays = np.einsum("ij,nj->ni", T_ego_lidar[:3, :3], measured.xyz_m).astype(np.float32)
    origins = np.empty_like(rays)
    origins[:] = T_ego_lidar[:3, 3]
    free = ~own_body.blocked(origins, rays)
    ring = None if measured.ring is None else measured.ring[free]
    intensity = None if measured.intensity is None else measured.intensity[free]
    return Sweep(measured.xyz_m[free], intensity, ring, measured.time_offset_s[free])


@dataclass(frozen=True, slots=True)
class Optics:
    """How a camera takes its pictures: see `drive.DriveConfig`.

    Attributes:
        rows: shares of the height between which the picture is drawn; the rest is black as outside the lens.
    """

    camera: Camera
    half_view_deg: float
    delay_s: float
    rolling_shutter_s: float = 0.0
    depth: bool = False
    lens: render.LensProperties = field(default_factory=render.LensProperties)
    rows: tuple[float, float] = (0.0, 1.0)

    @property
    def first_row(self) -> int:
        """First row that is drawn."""
        return round(self.rows[0] * self.camera.height)

    @property
    def end_row(self) -> int:
        """Row after the last one that is drawn."""
        return round(self.rows[1] * self.camera.height)


class SimulatedCamera:
    """A camera, which sends pictures.

    Attributes:
        T_ego_camera: its pose over time.
    """

    def __init__(self, journey: Journey, wire: Wire, optics: Optics, T_ego_camera: Mount, own_body: Solid) -> None:
        self.T_ego_camera = T_ego_camera
        self.hz = wire.hz
        self._journey, self._wire, self._optics, self._body = journey, wire, optics, own_body
        camera = optics.camera
        self._rays = render.pixel_rays(camera, math.radians(optics.half_view_deg))
        seen = np.zeros(camera.height * camera.width, bool)
        seen[self._rays.pixel] = True
        self._seen = seen.reshape(camera.height, camera.width)
        self._seen[: optics.first_row] = False
        self._seen[optics.end_row :] = False
        self._hidden: tuple[bytes, NDArray[np.bool_]] | None = None
        self._dirt: dict[float, Floats] = {}
        self._repeated: tuple[int, CameraFrame] | None = None

    def mask_at(self, T_ego_camera: Matrix4) -> NDArray[np.bool_]:
        """(height, width): pixels that show the world, less a margin, from where the workshop mounted the camera."""
        usable = self._seen & ~self._own_body(T_ego_camera)
        return np.asarray(cv2.erode(np.pad(usable.astype(np.uint8), 2), np.ones((5, 5), np.uint8))[2:-2, 2:-2] > 0)

    def time_s(self, index: int) -> float:
        """See `SimulatedSensor`."""
        return index / self.hz + self._optics.delay_s

    def late_s(self, time_s: float) -> float:
        """See `SimulatedSensor`."""
        return late_s(self._wire.faults, time_s)

    def is_lost(self, index: int, time_s: float) -> bool:
        """See `SimulatedSensor`."""
        return self._wire.is_lost(self._journey, index, time_s)

    def frame(self, index: int, stamp_ns: int) -> CameraFrame:
        """See `SimulatedSensor`."""
        frozen = next(wrong.now(self._wire.faults, wrong.Frozen, self.time_s(index)), None)
        if frozen is None:
            return self._picture(index, stamp_ns)
        last = max(math.ceil((frozen.begin_s - self._optics.delay_s) * self.hz) - 1, 0)
        if self._repeated is None or self._repeated[0] != last:
            self._repeated = (last, self._picture(last, stamp_ns))
        before = self._repeated[1]
        return CameraFrame(stamp_ns, before.frame_id, before.image, sequence=index, depth=before.depth)

    def _picture(self, index: int, stamp_ns: int) -> CameraFrame:
        time_s, journey, optics, faults = self.time_s(index), self._journey, self._optics, self._wire.faults
        T_ego_camera = self.T_ego_camera(time_s)
        exposures = self._rows(time_s, T_ego_camera)
        scene = journey.scene(time_s)
        radiance = render.render_rows(scene, optics.camera, exposures, half_view_rad=math.radians(optics.half_view_deg))
        hidden = self._own_body(T_ego_camera)
        share, lamps = around(scene, exposures[len(exposures) // 2].T_world_camera[:3, 3])
        radiance.linear[hidden] = BODY * (np.float32(share) * np.array(scene.sky.horizon, np.float32) + lamps)
        light = math.prod(fault.light for fault in wrong.now(faults, wrong.Dark, time_s))
        lens = render.at_night(optics.lens) if journey.is_night(time_s) else optics.lens
        lens = render.against_the_sun(lens) if journey.is_against_the_sun(time_s) else lens
        noise = journey.rng(_EXPOSURE, *self._wire.key, index)
        pixels = render.expose(radiance.linear, self._seen, lens, noise, light=light, dirt=self._cover(time_s))
        size = (optics.camera.width, optics.camera.height)
        image = EncodedImage(ImageFormat.JPEG, *size, encode_jpeg(pixels, optics.lens.jpeg_quality))
        depth = None
        if optics.depth:
            code = np.clip(65535 * NEAREST_M / radiance.range_m, 1, 65535)
            code[np.isnan(code)] = 1  # the sky is far, not unknown
            code[hidden | ~self._seen] = 0
            depth = EncodedImage(ImageFormat.PNG, *size, encode_depth_png(code.astype(np.uint16)))
        return CameraFrame(stamp_ns, self._wire.name, image, sequence=index, depth=depth)

    def _rows(self, time_s: float, T_ego_camera: Matrix4) -> list[render.Exposure]:
        """The parts of a picture's rows, each with the pose of the camera at its time."""
        optics = self._optics
        height, readout_s = optics.camera.height, optics.rolling_shutter_s
        parts = min(ROW_PARTS, height) if readout_s else 1
        bounds = np.linspace(optics.first_row, optics.end_row, parts + 1).round().astype(int)
        times = time_s + readout_s * ((bounds[:-1] + bounds[1:]) / 2 / height - 0.5)
        poses = self._journey.trip.poses(times)
        return [
            render.Exposure(int(first), int(last), product(pose, T_ego_camera), float(at_s))
            for first, last, pose, at_s in zip(bounds[:-1], bounds[1:], poses, times, strict=True)
        ]

    def _cover(self, time_s: float) -> Floats | None:
        """Dirt and drops on the lens, whichever hides more."""
        covers = []
        seed = self._journey.seed_of(*self._wire.key)
        if share := max((fault.share for fault in wrong.now(self._wire.faults, wrong.Dirt, time_s)), default=0.0):
            if share not in self._dirt:
                self._dirt[share] = render.dirt_cover(self._seen.shape, share, seed)
            covers.append(self._dirt[share])
        if rain := self._journey.rain(time_s):
            covers.append(rained_lens(self._seen.shape, rain, seed, int(time_s / SHOWER_S)))
        return np.maximum.reduce(covers) if covers else None

    def _own_body(self, T_ego_camera: Matrix4) -> NDArray[np.bool_]:
        """(h, w): pixels that show the vehicle itself, which depend on the mount of the camera."""
        key = T_ego_camera.tobytes()
        if self._hidden is None or self._hidden[0] != key:
            rays = np.einsum("ij,nj->ni", T_ego_camera[:3, :3], self._rays.directions).astype(np.float32)
            origins = np.empty_like(rays)
            origins[:] = T_ego_camera[:3, 3]
            hidden = np.zeros(self._seen.size, bool)
            hidden[self._rays.pixel] = self._body.blocked(origins, rays)
            self._hidden = (key, hidden.reshape(self._seen.shape))
        return self._hidden[1]


def product(a: Matrix4, b: Matrix4) -> Matrix4:
    """A·B (4, 4), computed without BLAS so that the bits are always the same."""
    result: Matrix4 = np.einsum("ij,jk->ik", a, b)
    return result
