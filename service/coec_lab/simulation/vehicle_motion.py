"""How the vehicle moves, where its sensors sit, and which parts of its body the camera sees."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.se3 import rotation_exp, rotation_log
from coec_lab.simulation.mesh import Material, Mesh, join, quads
from coec_lab.simulation.road import Road

Doubles = NDArray[np.float64]

SPEED_SWING, SPEED_PERIOD_S = 0.25, 31.0
"""The share by which the speed swings about its mean, and the period of the swing."""
BRAKE_S = 3.0
"""How long a vehicle brakes before it stands, and speeds up after that."""
WANDER_M, WANDER_PERIOD_M = 0.25, 83.0
"""How far the vehicle sways within its lane, and over which distance."""
PITCH_RAD, PITCH_HZ = 0.004, (1.3, 0.41)
ROLL_RAD, ROLL_HZ = 0.003, (1.1, 0.33)
HEAVE_M, HEAVE_HZ = 0.008, 1.2
"""Movements on the springs, as usual for a car on an even street at `LIVELY_MPS`."""
LIVELY_MPS = 8.5
"""Below this speed, the springs move less in proportion; a standing vehicle is still."""
TWIST_STEP_S = 0.005
"""Half the span of the central difference that gives velocities."""

P_EGO_LIDAR_M = np.array([1.35, 0.0, 1.95])
P_EGO_CAMERA_M = np.array([1.62, 0.06, 1.72])
"""Places on the roof, in the ego frame, whose origin is the middle of the rear axle on the ground. Both are close
together, because a camera's depth differs more from the LiDAR's range the further away it is (METHOD, section 1)."""
CAMERA_MOUNT_RAD = np.deg2rad([4.0, -2.0, 1.0])
"""Rotation of the camera about its x, y, z axes from looking straight ahead."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast the vehicle is.

    Attributes:
        start_m: arc length at time 0.
        phase: of the swing of its speed, radians.
        speed_mps: mean speed while it drives; 0 for a standing vehicle.
        go_s, stop_s: how long it drives between two stops, and how long it then stands; without a stop it drives on.
    """

    start_m: float
    phase: float
    speed_mps: float
    go_s: float = 20.0
    stop_s: float = 0.0

    def liveliness(self, time_s: Doubles) -> Doubles:
        """How much the vehicle moves on its springs at times in seconds, 0 to 1."""
        braking, gaining = self._ramps(time_s)
        share: Doubles = 1.0 - (braking - gaining) / BRAKE_S
        return min(self.speed_mps / LIVELY_MPS, 1.0) * share

    @property
    def fastest_mps(self) -> float:
        """The greatest speed."""
        return self.speed_mps * (1.0 + SPEED_SWING)

    def progress(self, time_s: Doubles) -> Doubles:
        """Arc length at times in seconds, metres."""
        omega = 2 * np.pi / SPEED_PERIOD_S
        swing = self.speed_mps * SPEED_SWING / omega
        driven_s = self._driven_s(time_s)
        result: Doubles = (
            self.start_m
            + self.speed_mps * driven_s
            + swing * (np.cos(self.phase) - np.cos(omega * driven_s + self.phase))
        )
        return result

    @property
    def _cycle_s(self) -> float:
        """From one start to the next."""
        return self.go_s + 2 * BRAKE_S + self.stop_s

    def _driven_s(self, time_s: Doubles) -> Doubles:
        """How long a vehicle that never stops takes to come as far."""
        if self.stop_s == 0.0:
            return time_s
        cycles = np.floor(time_s / self._cycle_s)
        braking, gaining = self._ramps(time_s)
        driven: Doubles = (
            cycles * (self.go_s + BRAKE_S)
            + np.minimum(time_s - cycles * self._cycle_s, self.go_s)
            + braking
            - braking**2 / (2 * BRAKE_S)
            + gaining**2 / (2 * BRAKE_S)
        )
        return driven

    def _ramps(self, time_s: Doubles) -> tuple[Doubles, Doubles]:
        """How long the vehicle has been braking, and speeding up again, in its cycle at times in seconds."""
        if self.stop_s == 0.0:
            return np.zeros_like(time_s), np.zeros_like(time_s)
        within = np.mod(time_s, self._cycle_s)
        begin_s = self.go_s + BRAKE_S + self.stop_s
        return np.clip(within - self.go_s, 0.0, BRAKE_S), np.clip(within - begin_s, 0.0, BRAKE_S)


@dataclass(frozen=True, slots=True, eq=False)
class Trip:
    """The true way of the vehicle along a road in its own lane.

    Attributes:
        pace: along the road.
        left_m: middle of the lane.
        phases: (7,) of the swings, radians.
    """

    road: Road
    pace: Pace
    left_m: float
    phases: Doubles

    def poses(self, time_s: Doubles) -> Doubles:
        """(N, 4, 4) maps ego coordinates (x forward, y left, z up) to the world."""
        time = np.asarray(time_s, np.float64)
        s = self.pace.progress(time)
        wave = 2 * np.pi * s / WANDER_PERIOD_M + self.phases[1]
        left = self.left_m + WANDER_M * np.sin(wave)
        turn = np.arctan(WANDER_M * 2 * np.pi / WANDER_PERIOD_M * np.cos(wave))
        heading = self.road.at(s)[:, 3] + turn
        lively = self.pace.liveliness(time)
        pitch = -self.road.at(s)[:, 4] + _swing(time, lively * PITCH_RAD, PITCH_HZ, self.phases[2:4])
        roll = _swing(time, lively * ROLL_RAD, ROLL_HZ, self.phases[4:6])
        heave = lively * HEAVE_M * np.sin(2 * np.pi * HEAVE_HZ * time + self.phases[6])
        result = np.zeros((len(time), 4, 4))
        result[:, :3, :3] = _rotations(heading, pitch, roll)
        result[:, :3, 3] = self.road.points(s, left, heave)
        result[:, 3, 3] = 1.0
        return result

    def twist(self, time_s: float) -> tuple[Doubles, Doubles]:
        """True linear (m/s) and angular (rad/s) velocity in the ego frame."""
        before, now, after = self.poses(time_s + np.array([-TWIST_STEP_S, 0.0, TWIST_STEP_S]))
        linear = _through(now[:3, :3].T, after[:3, 3] - before[:3, 3]) / (2 * TWIST_STEP_S)
        turned = np.einsum("ji,jk->ik", before[:3, :3], after[:3, :3])
        return linear, rotation_log(turned) / (2 * TWIST_STEP_S)


def build_pace(seed: int, start_m: float, speed_mps: float, go_s: float = 20.0, stop_s: float = 0.0) -> Pace:
    """The pace of a seed."""
    return Pace(start_m, float(_phases(seed)[0]), speed_mps, go_s, stop_s)


def build_trip(seed: int, road: Road, left_m: float, pace: Pace) -> Trip:
    """The trip of a seed."""
    return Trip(road, pace, left_m, _phases(seed))


def _phases(seed: int) -> Doubles:
    return np.random.default_rng([seed, 110]).uniform(0, 2 * np.pi, 7)


def T_ego_lidar() -> Matrix4:
    """(4, 4) pose of the LiDAR: upright above the axle."""
    transform = np.eye(4)
    transform[:3, 3] = P_EGO_LIDAR_M
    return transform


def workshop_T_camera_lidar() -> Matrix4:
    """(4, 4) true extrinsic as the camera was mounted."""
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    axes = np.einsum("ij,jk->ik", ahead, rotation_exp(CAMERA_MOUNT_RAD))
    transform = np.eye(4)
    transform[:3, :3] = axes.T
    transform[:3, 3] = _through(axes.T, P_EGO_LIDAR_M - P_EGO_CAMERA_M)
    return transform


@lru_cache(maxsize=1)
def body() -> Mesh:
    """Roof front, windscreen, bonnet and mirrors in the ego frame: what a camera on the roof sees of its own car."""
    dark = (0.035, 0.03, 0.03)
    rails = [(1.75, 0.60, 1.50), (2.35, 0.72, 0.98), (3.15, 0.74, 0.80), (3.45, 0.66, 0.55), (3.5, 0.6, 0.3)]
    rows = np.array([[[x, -y, z], [x, y, z]] for x, y, z in rails])
    skin = np.stack([rows[:-1, 0], rows[1:, 0], rows[1:, 1], rows[:-1, 1]], axis=1)
    roof = np.array([[0.9, -0.6, 1.52], [0.9, 0.6, 1.52], [1.75, 0.6, 1.5], [1.75, -0.6, 1.5]])
    sides = [
        [[0.9, s * 0.6, 1.52], [1.75, s * 0.6, 1.5], [2.35, s * 0.72, 0.98], [2.35, s * 0.86, 0.5], [0.9, s * 0.9, 0.5]]
        for s in (-1.0, 1.0)
    ]
    flanks = [[side[a] for a in corner] for side in sides for corner in ((0, 1, 2, 2), (0, 2, 3, 4))]
    parts = [quads(roof[None], dark, Material.LACQUER), quads(skin[1:], dark, Material.LACQUER)]
    parts.append(quads(skin[:1], (0.06, 0.05, 0.045), Material.GLASS))
    parts.append(quads(flanks, dark, Material.LACQUER))
    for s in (-1.0, 1.0):
        mirror = [[2.2, s * 0.9, 1.0], [2.2, s * 1.12, 1.0], [2.2, s * 1.12, 1.18], [2.2, s * 0.9, 1.18]]
        parts.append(quads([mirror], dark, Material.LACQUER))
    return join(parts)


@lru_cache(maxsize=1)
def whole_body() -> Mesh:
    """The body from bumper to bumper in the ego frame, closed on all sides: what sensors all around see of their own
    car."""
    dark = (0.035, 0.03, 0.03)
    # Along the middle: (x, half width, height) of the bonnet's nose, its end, the roof's front, its rear, the tail.
    rails = [(3.5, 0.78, 0.72), (2.45, 0.86, 0.98), (1.75, 0.62, 1.5), (-0.3, 0.62, 1.5), (-0.85, 0.8, 0.95)]
    belt = [(x, 0.9 if x < 3.0 else 0.8, min(z, 0.98)) for x, _, z in rails]
    sill_m = 0.3
    top = [[[x, -w, z], [x, w, z], [x2, w2, z2], [x2, -w2, z2]] for (x, w, z), (x2, w2, z2) in pairwise(rails)]
    flanks = []
    for s in (-1.0, 1.0):
        for (upper, upper2), (lower, lower2) in zip(pairwise(rails), pairwise(belt), strict=True):
            corners = [[x, s * w, z] for x, w, z in (upper, upper2, lower2, lower)]
            sills = [[x, s * w, z] for x, w, z in (lower, lower2)]
            flanks += [corners, [*sills, *([x, s * w, sill_m] for x, w, _ in (lower2, lower))]]
    ends = [
        [[x, -w, sill_m], [x, w, sill_m], [x, w2, z], [x, -w2, z]]
        for x, w, w2, z in ((3.5, 0.8, 0.8, 0.72), (-0.85, 0.9, 0.9, 0.95))
    ]
    mirrors = [
        [[2.2, s * 0.9, 1.0], [2.2, s * 1.1, 1.0], [2.2, s * 1.1, 1.16], [2.2, s * 0.9, 1.16]] for s in (-1.0, 1.0)
    ]
    return quads([*top, *flanks, *ends, *mirrors], dark, Material.LACQUER)


def _swing(time_s: Doubles, size: Doubles, hertz: tuple[float, float], phases: Doubles) -> Doubles:
    first = np.sin(2 * np.pi * hertz[0] * time_s + phases[0])
    result: Doubles = size * (0.4 * first + 0.6 * np.sin(2 * np.pi * hertz[1] * time_s + phases[1]))
    return result


def _rotations(heading: Doubles, pitch: Doubles, roll: Doubles) -> Doubles:
    """(N, 3, 3) = Rz(heading) · Ry(pitch) · Rx(roll); positive pitch looks down."""
    ch, sh, cp, sp, cr, sr = (f(a) for a in (heading, pitch, roll) for f in (np.cos, np.sin))
    rows = [
        [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
        [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _through(rotation: Doubles, vector: Doubles) -> Doubles:
    result: Doubles = np.einsum("ij,j->i", rotation, vector)
    return result
