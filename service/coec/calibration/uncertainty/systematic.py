"""The errors that all frames of a window share, so that no number of frames averages them away: one term for each, in
units of the resolution of its sensors.

Each term is a displacement of the rays to the points by the standard deviation of an error. The pose moves by the
least-squares answer to that displacement, over the points that settled it. An error that is the same for all things in
view acts on a rotation; one that only near things have acts on a translation. Errors that differ from edge to edge,
such as the place of an edge within a beam or a column, are in the scatter of the noise and have no term here.

A held translation is such an error, too: it was measured once, and not to the last millimetre. A camera model that was
fitted to another one is refused if its residual alone makes every result too uncertain.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, hypot, sqrt
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import PointsInView
from coec.calibration.types import LidarFrame, Matrix4, Window
from coec.errors import LensError
from coec.geometry.cameras import Camera, name_of, pixel_rad
from coec.geometry.cameras.double_sphere_fit import DoubleSphereFit
from coec.geometry.edges.scan_lines import NEIGHBOUR_RAD
from coec.geometry.linalg import inverted
from coec.geometry.points import BAND_RAD, distinct_rings, thinned


def lens_error_px(residual_max_px: float) -> float:
    """Standard deviation of a fitted camera at the edges of a scene, pixels.

    There every error up to the largest is equally likely, because edges gather on the horizon and at the rim, while the
    fit was best for the whole image.
    """
    return residual_max_px / sqrt(3.0)


def require_fit(camera: Camera, fit: DoubleSphereFit, max_sigma_deg: float) -> None:
    """Refuse a fit with which no result could be certain enough to be accepted.

    More frames do not reduce the error of a lens, because all frames share it. As an angle on the optical axis it is
    the least σ that a rotation may claim. If that alone exceeds `max_sigma_deg`, above which results are refused
    (`verdict.max_sigma_deg`), a search is useless.

    Raises:
        LensError: the fit is refused. Its details are those of the fit.
    """
    error_deg = degrees(lens_error_px(fit.residual_max_px) * pixel_rad(camera))
    if error_deg <= max_sigma_deg:
        return
    name = name_of(camera)
    raise LensError(
        f"double_sphere does not fit this {name} lens: it is off by {fit.residual_max_px:.1f} px at most "
        f"({fit.residual_rms_px:.2f} px rms), so a rotation may be wrong by {error_deg:.2f}°; a result is accepted "
        f"up to {max_sigma_deg:g}°. Calibrate with the lens's own model: leave --camera-model out",
        {
            "camera_fit": {
                "model": "double_sphere",
                "of": name,
                "residual_rms_px": fit.residual_rms_px,
                "residual_max_px": fit.residual_max_px,
                "coverage": fit.coverage,
                "error_deg": error_deg,
                "limit_deg": max_sigma_deg,
            }
        },
    )


LENS_PX = 0.05
"""Error that a target-based calibration of a lens leaves in its principal point, and in its scale at the rim. It is
half of the 0.1 px to which a corner is found, because its pictures hold a few independent corners near every place of
the image. See docs/measured.md."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorResolution:
    """The angular resolution of the sensors in one window.

    Attributes:
        pixel_rad: the angle of a pixel on the optical axis.
        lens_px: standard deviation of the camera model, pixels.
        column_rad: the turn between two firings of a beam.
        velocity_mps, turn_radps: (F, 3) of the LiDAR in each pair, camera frame; zero if unknown.
        held_m: standard deviation of a held camera centre, along each axis.
    """

    pixel_rad: float
    lens_px: float
    column_rad: float
    velocity_mps: NDArray[np.float64]
    turn_radps: NDArray[np.float64]
    held_m: float


def sensor_resolution(window: Window, T_camera_lidar: Matrix4, held_m: float) -> SensorResolution:
    """The angular resolution of a window whose camera is at `T_camera_lidar` (4, 4); a held centre is known to
    `held_m`."""
    velocity_mps, turn_radps = _rates(window, T_camera_lidar)
    return SensorResolution(
        pixel_rad=pixel_rad(window.rig.camera),
        lens_px=hypot(LENS_PX, lens_error_px(window.rig.camera_residual_px)),
        column_rad=column_rad(window.pairs[0].lidar),
        velocity_mps=velocity_mps,
        turn_radps=turn_radps,
        held_m=held_m,
    )


def column_rad(sweep: LidarFrame) -> float:
    """Median turn between neighbours of a scan line, radians; without usable rings, of a row of nearly equal elevation.
    0 if no point has a neighbour."""
    x, y, z = (sweep.xyz_m[:, axis].astype(np.float64) for axis in range(3))
    azimuth, across = np.arctan2(y, x), np.hypot(x, y)
    ring = distinct_rings(sweep.ring)
    row = np.floor(np.arctan2(z, across) / BAND_RAD) if ring is None else ring.astype(np.float64)
    order = np.lexsort((azimuth, row))
    turn = np.diff(azimuth[order])
    neighbours = turn[(np.diff(row[order]) == 0.0) & (turn > 0.0) & (turn < NEIGHBOUR_RAD)]
    return float(np.median(neighbours)) if len(neighbours) else 0.0


def _rates(window: Window, T_camera_lidar: Matrix4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    R_camera_lidar, T_lidar_ego = T_camera_lidar[:3, :3], window.rig.T_lidar_ego
    velocity, turn = np.zeros((len(window.pairs), 3)), np.zeros((len(window.pairs), 3))
    for index, pair in enumerate(window.pairs):
        if pair.motion is None:
            continue
        omega = T_lidar_ego[:3, :3] @ np.array(pair.motion.angular_radps)
        # The origin of the ego frame is not at the LiDAR: a turn carries the LiDAR around it.
        turn[index] = R_camera_lidar @ omega
        if pair.motion.linear_mps is None:
            continue
        linear = T_lidar_ego[:3, :3] @ np.array(pair.motion.linear_mps) - np.cross(omega, T_lidar_ego[:3, 3])
        velocity[index] = R_camera_lidar @ linear
    return velocity, turn


POINTS = 5_000
"""Number of sight lines that stand for all: least squares over six unknowns needs no more."""

EDGE_PX = 0.1
"""How far the edges of near things together may be displaced against those of far ones: blur and gamma move an image
edge to the brighter side by about that much, and which side is nearer depends on the scene."""

COLUMN_SHARE = 0.05
"""The same for range edges, in columns. On either side they lie half a column inside the near thing on average. An
error is left if more left sides than right ones are in view. See docs/measured.md."""

STAMP_S = 1e-3 / sqrt(12.0)
"""Standard deviation of stamps that are rounded to the millisecond, s."""


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Sight lines, with all that the terms need.

    Attributes:
        towards: (N, 3) unit vectors.
        p_camera: (N, 3) the points, metres.
        range_m: (N,) ranges of the points.
        near: (N, 1) 1 for the points nearer than the median range, else 0.
        frame: (N,) index of the frame of each point.
        axis_of_sweep: (3,) the axis about which the LiDAR turns, camera frame.
    """

    towards: NDArray[np.float64]
    p_camera: NDArray[np.float64]
    range_m: NDArray[np.float64]
    near: NDArray[np.float64]
    frame: NDArray[np.int64]
    axis_of_sweep: NDArray[np.float64]

    def perpendicular(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) the part of a direction (3,) or (N, 3) that lies across each sight line."""
        along = np.sum(self.towards * direction, axis=1, keepdims=True)
        return np.asarray(direction - self.towards * along)


Term = Callable[[_Rays, SensorResolution], NDArray[np.float64]]
"""The displacement (N, 3) of the sight lines by one standard deviation of an error, radians."""

RIGHT, DOWN, FORWARD = np.eye(3)

TERMS: MappingProxyType[str, Term] = MappingProxyType(
    {
        "lens_across": lambda lines, resolution: resolution.lens_px * resolution.pixel_rad * lines.perpendicular(RIGHT),
        "lens_down": lambda lines, resolution: resolution.lens_px * resolution.pixel_rad * lines.perpendicular(DOWN),
        "lens_scale": lambda lines, resolution: (
            resolution.lens_px * resolution.pixel_rad * _of_mean_one(lines.perpendicular(-FORWARD))
        ),
        "near_edges_across": lambda lines, resolution: (
            EDGE_PX * resolution.pixel_rad * lines.near * lines.perpendicular(RIGHT)
        ),
        "near_edges_down": lambda lines, resolution: (
            EDGE_PX * resolution.pixel_rad * lines.near * lines.perpendicular(DOWN)
        ),
        "columns": lambda lines, resolution: (
            COLUMN_SHARE * resolution.column_rad * lines.near * np.cross(lines.axis_of_sweep, lines.towards)
        ),
        "stamps": lambda lines, resolution: STAMP_S * _passing(lines, resolution),
    }
)
"""The terms by name, in a fixed order. The lens is displaced to the right, down and outwards (principal point and focal
length); finer errors of it differ from sector to sector of the image and are in the scatter."""

OF_SENSORS = frozenset({"near_edges_across", "near_edges_down", "columns", "stamps"})
"""Terms that are not parameters of the posterior of a window."""

HELD: MappingProxyType[int, str] = MappingProxyType({3: "held_across", 4: "held_down", 5: "held_forward"})
"""Names of further terms, one for each translation that was not searched, by its place in ξ."""


def systematic_shifts(
    points: PointsInView, resolution: SensorResolution, moved: tuple[int, ...], axis_of_sweep: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """By how much each term moves a pose, by name: (6,) radians and metres, zero on axes that were not `moved`. Empty
    if the points in view do not determine the pose.

    `axis_of_sweep` (3,) is the axis about which the LiDAR turns, camera frame.
    """
    indices = thinned(len(points.p_camera), POINTS)
    p_camera, weight = points.p_camera[indices], points.weight[indices]
    range_m = np.sqrt(np.sum(p_camera * p_camera, axis=1))
    towards = p_camera / range_m[:, None]
    near = (range_m < np.median(range_m)).astype(np.float64)[:, None] if len(range_m) else np.zeros((0, 1))
    lines = _Rays(towards, p_camera, range_m, near, points.frame[indices], axis_of_sweep)
    answers = np.stack([_answer(lines, axis) for axis in moved], axis=2)  # (N, 3, n)
    # Sums without a BLAS product are the same to the bit in every process.
    weighted = answers * weight[:, None, None]
    each = range(len(moved))
    normal = [[float(np.sum(weighted[:, :, i] * answers[:, :, j])) for j in each] for i in each]
    try:
        inverse = np.array(inverted(normal))
    except ValueError:
        return {}
    displacements = {name: term(lines, resolution) for name, term in TERMS.items()}
    for axis, name in HELD.items():
        if axis not in moved:
            displacements[name] = resolution.held_m * _answer(lines, axis)
    shifts = {}
    for name, displaced in displacements.items():
        right = np.array([float(np.sum(weighted[:, :, i] * displaced)) for i in each])
        shift = np.zeros(6)
        shift[list(moved)] = np.sum(inverse * right[None], axis=1)
        shifts[name] = shift
    return shifts


def _answer(lines: _Rays, axis: int) -> NDArray[np.float64]:
    """(N, 3) how the sight lines move with one axis of ξ, per radian or metre."""
    unit = np.eye(3)[axis % 3]
    if axis < 3:
        return np.asarray(np.cross(unit, lines.towards))
    return lines.perpendicular(unit) / lines.range_m[:, None]


def _of_mean_one(displaced: NDArray[np.float64]) -> NDArray[np.float64]:
    """The displacement scaled to a root mean square of one."""
    mean = np.sqrt(np.mean(np.sum(displaced * displaced, axis=1)))
    return np.asarray(displaced / max(float(mean), 1e-12))


def _passing(lines: _Rays, resolution: SensorResolution) -> NDArray[np.float64]:
    """(N, 3) how fast the sight lines move as the vehicle passes, radians per second."""
    # Standing things move against the motion of the vehicle.
    speed = resolution.velocity_mps[lines.frame] + np.cross(resolution.turn_radps[lines.frame], lines.p_camera)
    return lines.perpendicular(-speed) / lines.range_m[:, None]
