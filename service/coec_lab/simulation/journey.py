"""The way of a vehicle through a simulated place: where it is, what stands and drives around it, the weather, and what
its odometer reports. It does not depend on the sensors."""

import math
from collections.abc import Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion, Matrix4
from coec.errors import UsageError
from coec_lab.simulation import faults as wrong
from coec_lab.simulation.faults import Fault
from coec_lab.simulation.passages import passages
from coec_lab.simulation.scene import Scene, Town
from coec_lab.simulation.shading import headlights, night_sky
from coec_lab.simulation.surroundings import SCENES, Surroundings
from coec_lab.simulation.vehicle_motion import Trip, build_pace, build_trip
from coec_lab.simulation.weather import Sky, low_sun_sky, rainy_sky

Doubles = NDArray[np.float64]
F = TypeVar("F", bound=Fault)

START_NS = 1_600_000_000_000_000_000
DAYLIGHT = np.empty((0, 4, 3))
"""No headlights."""
SPEED_SCALE_SIGMA, SPEED_SIGMA_MPS = 0.004, 0.02
TURN_BIAS_SIGMA_RADPS, TURN_SIGMA_RADPS = 0.0005, 0.002
"""Errors of odometry and gyroscope, as in series sensors: one constant over a drive, and one of each sample."""


class Journey:
    """The way of a seed.

    Attributes:
        trip: the true way of the vehicle.
        seconds: how long it lasts.
    """

    def __init__(
        self, seed: int, scene: str, seconds: float, *, speed_mps: float | None, start_m: float, traffic: bool,
        faults: tuple[Fault, ...], go_s: float = 20.0, stop_s: float = 0.0,
    ) -> None:  # fmt: skip
        """See `drive.DriveConfig`; only faults of the surroundings and of the odometer have an effect here.

        Raises:
            UsageError: an unknown scene, or a fault that the scene cannot have.
        """
        self.seconds = seconds
        self._seed = seed
        self._faults = faults
        surroundings = _surroundings(scene, seed, speed_mps, faults)
        pace = build_pace(seed, start_m, surroundings.speed_mps if speed_mps is None else speed_mps, go_s, stop_s)
        poor = passages(faults, pace, seconds)
        self._town = Town(seed, start_m + pace.fastest_mps * seconds, poor, surroundings, traffic=traffic)
        self.trip: Trip = build_trip(seed, self._town.road, self._town.lane_left_m(), pace)

    def rng(self, *key: int) -> np.random.Generator:
        """Random numbers for a purpose: the same key gives the same numbers."""
        return np.random.default_rng([self._seed, *key])

    def seed_of(self, *key: int) -> int:
        """A seed for functions that take one: that of the drive, or with a key another."""
        return int(self.rng(136, *key).integers(2**31)) if key else self._seed

    def pose(self, time_s: float) -> Matrix4:
        """True T_world_ego (4, 4)."""
        return np.asarray(self.trip.poses(np.array([time_s]))[0], np.float64)

    def scene(self, time_s: float) -> Scene:
        """The surroundings of the vehicle at a time."""
        at_m = float(self.trip.pace.progress(np.array([time_s]))[0])
        scene = self._town.scene(at_m, time_s, self.trip.pace.progress)
        sky = self._weather(time_s)
        night = self.is_night(time_s)
        scene.sky = night_sky(sky) if night else sky
        scene.headlights = headlights(self.pose(time_s)) if night else DAYLIGHT
        return scene

    def is_night(self, time_s: float) -> bool:
        """Whether lamps are the only light."""
        return any(self._now(wrong.Night, time_s))

    def is_against_the_sun(self, time_s: float) -> bool:
        """Whether the sun stands low ahead of the vehicle."""
        return any(self._now(wrong.LowSun, time_s))

    def rain(self, time_s: float) -> float:
        """Rain in millimetres an hour."""
        return max((fault.mmph for fault in self._now(wrong.Rain, time_s)), default=0.0)

    def is_odometer_silent(self, time_s: float) -> bool:
        """Whether no ego-motion is sent."""
        return any(self._now(wrong.NoEgo, time_s))

    def motion(self, index: int, time_s: float, stamp_ns: int) -> EgoMotion:
        """The sample of this number, with errors of odometer and gyroscope."""
        if any(self._now(wrong.ZeroEgo, time_s)):
            return EgoMotion(stamp_ns, "ego", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), sequence=index)
        linear, angular = self.trip.twist(time_s)
        constant, sample = self.rng(134), self.rng(135, index)
        linear = linear * (1 + constant.normal(0, SPEED_SCALE_SIGMA)) + sample.normal(0, SPEED_SIGMA_MPS, 3)
        bias = constant.normal(0, TURN_BIAS_SIGMA_RADPS, 3)
        angular = angular + bias + sample.normal(0, TURN_SIGMA_RADPS, 3)
        vx, vy, vz = (float(value) for value in linear)
        wx, wy, wz = (float(value) for value in angular)
        return EgoMotion(stamp_ns, "ego", (vx, vy, vz), (wx, wy, wz), sequence=index)

    def _weather(self, time_s: float) -> Sky:
        sky = self._town.sky
        for sunny in self._now(wrong.LowSun, time_s):
            ahead = self.pose(sunny.begin_s)
            sky = low_sun_sky(sky, math.atan2(ahead[1, 0], ahead[0, 0]))
        rain = self.rain(time_s)
        return rainy_sky(sky, rain) if rain else sky

    def _now(self, kind: type[F], time_s: float) -> Iterator[F]:
        return wrong.now(self._faults, kind, time_s)


def _surroundings(scene: str, seed: int, speed_mps: float | None, faults: tuple[Fault, ...]) -> Surroundings:
    if scene not in SCENES:
        raise UsageError(f"there is no scene {scene!r}; choose one of {', '.join(SCENES)}")
    made = SCENES[scene](seed)
    stretches = [fault for fault in faults if isinstance(fault, wrong.Tunnel | wrong.OpenRoad)]
    if stretches and not made.poor:
        raise UsageError(f"a tunnel or an open road is a stretch of a street, not of a {scene}")
    if speed_mps == 0 and any(isinstance(fault, wrong.Tunnel) for fault in stretches):
        raise UsageError("a standing vehicle comes into no tunnel: give it a speed")
    return made
