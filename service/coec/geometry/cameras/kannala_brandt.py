"""Kannala-Brandt fisheye with four coefficients (OpenCV's `fisheye`, ROS `equidistant`).

With r = sqrt(x^2 + y^2) and theta = atan2(r, z):

    d(theta) = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    u = fx d(theta) x/r + cx,   v = fy d(theta) y/r + cy

J. Kannala, S. S. Brandt, "A generic camera model and calibration method for conventional, wide-angle, and fish-eye
lenses", PAMI 28(8), 2006, equations (6) and (7) in OpenCV's normalisation. Domain: theta below the angle at which
d stops growing, and below pi. OpenCV has no such bound.

The fit finds the camera closest to any other one, for programs that know no other wide lens (ROS's `equidistant`). It
is plain Python, because the process that serves queries has no compiler and a few hundred rays need none.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras.base import (
    CameraFields,
    common_intrinsics,
    finite,
    guarded_pixel,
    guarded_ray,
    like,
    monotonic_limit_squared,
    odd_polynomial,
    polar_angle,
    solve_odd_polynomial,
)

# Keeps x/r finite on the optical axis, where x = r = 0 (then theta = 0 too). Nearer to the axis than this, the pixel is
# the principal point to the last bit, with or without; and a float32 can hold it. Unit: m.
_MIN_RADIUS_M = 1e-30


class KannalaBrandt(NamedTuple):
    """Size, focal lengths and principal point in pixels; distortion coefficients; derived: max_theta_rad."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    k3: float
    k4: float
    max_theta_rad: float


def build(
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    k1: float,
    k2: float,
    k3: float,
    k4: float,
) -> KannalaBrandt:
    """A checked camera. Raises ValueError that names the field."""
    return KannalaBrandt(
        *common_intrinsics(width, height, fx, fy, cx, cy),
        finite("k1", k1),
        finite("k2", k2),
        finite("k3", k3),
        finite("k4", k4),
        min(math.sqrt(monotonic_limit_squared((k1, k2, k3, k4))), math.pi),
    )


def image_point(camera: KannalaBrandt, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel of a point in the camera frame, and whether the point is in the domain."""
    radius = math.sqrt(x * x + y * y)
    theta = polar_angle(radius, z)
    in_domain = theta < camera.max_theta_rad
    distorted = odd_polynomial(camera.k1, camera.k2, camera.k3, camera.k4, theta)
    least = like(_MIN_RADIUS_M, z)
    scale = distorted / (radius if radius > least else least)
    return camera.fx * (x * scale) + camera.cx, camera.fy * (y * scale) + camera.cy, in_domain


def unproject_point(camera: KannalaBrandt, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray in the camera frame of a pixel, and whether the pixel is the image of a point in the domain."""
    mx = (u - camera.cx) / camera.fx
    my = (v - camera.cy) / camera.fy
    distorted = math.sqrt(mx * mx + my * my)
    theta, converged = solve_odd_polynomial(camera.k1, camera.k2, camera.k3, camera.k4, distorted, camera.max_theta_rad)
    scale = math.sin(theta) / distorted if distorted > _MIN_RADIUS_M else 1.0
    return guarded_ray(mx * scale, my * scale, math.cos(theta), converged)


# theta, theta^3 ... theta^9: as many as the model has coefficients, with the focal length. Two more for the centre.
_POWERS = (1, 3, 5, 7, 9)
_PARAMETERS = len(_POWERS) + 2

# The image is compared at this many columns and rows of pixels, evenly from border to border. Corners are included,
# because a wide lens has its largest residual there. The residual is that of a polynomial of ninth degree against a
# smooth function.
_GRID = 33


RayOf = Callable[[float, float], tuple[float, float, float, bool]]
"""The unit ray of a pixel of the source, and whether there is one."""


class KannalaBrandtFit(NamedTuple):
    """The fitted camera and what separates it from its source.

    residual_rms_px, residual_max_px: distance between the source's pixel and the fitted camera's for the same ray, over
    the pixels compared that the source sees; infinite where the fitted camera does not see all of them.
    """

    camera: KannalaBrandt
    residual_rms_px: float
    residual_max_px: float


def fit_kannala_brandt(camera: CameraFields, ray_of: RayOf) -> KannalaBrandtFit:
    """Least squares of the reprojection error over the source's image. Deterministic. `ray_of` gives the source's unit
    ray of a pixel, and whether there is one.

    With the ratio of the focal lengths kept, u and v are linear in the focal length times each coefficient and in the
    principal point: one linear problem. The fitted focal length is that of the axis, which is not the source's.

    Raises ValueError if the source sees too few of the pixels compared, or no camera of the model comes near it.
    """
    uv_px, rays = _seen(camera, ray_of)
    if len(uv_px) < _PARAMETERS:
        raise ValueError(f"only {len(uv_px)} pixels of the camera have a ray: too few to fit a model")
    theta, sides = _polar(rays)
    powers = theta[:, None] ** np.array(_POWERS)
    focal = np.array([camera.fx, camera.fy])
    # (N, 2, 5) and a column for each of cx and cy: rows of u and of v, one below the other.
    radial = (focal * sides)[:, :, None] * powers[:, None, :]
    centre = np.broadcast_to(np.eye(2), (len(theta), 2, 2))
    design = np.concatenate([radial, centre], axis=2).reshape(-1, _PARAMETERS)
    # Columns differ by powers of theta: scale them to unit length, so that the small ones are not rounded off.
    scale = np.linalg.norm(design, axis=0)
    solution = np.linalg.lstsq(design / scale, uv_px.reshape(-1), rcond=None)[0] / scale
    first, *higher = (float(value) for value in solution[: len(_POWERS)])
    if not first > 0.0:
        raise ValueError("no Kannala-Brandt model approximates this camera")
    k1, k2, k3, k4 = (value / first for value in higher)
    fitted = build(
        width=camera.width,
        height=camera.height,
        fx=camera.fx * first,
        fy=camera.fy * first,
        cx=float(solution[-2]),
        cy=float(solution[-1]),
        k1=k1,
        k2=k2,
        k3=k3,
        k4=k4,
    )
    error_px = _errors_px(fitted, uv_px, rays)
    return KannalaBrandtFit(fitted, float(np.sqrt(np.mean(error_px**2))), float(error_px.max()))


def _seen(camera: CameraFields, ray_of: RayOf) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Those of the pixels compared (N, 2) that have a ray, and their rays (N, 3)."""
    columns, rows = (np.linspace(0.0, size - 1.0, _GRID) for size in (camera.width, camera.height))
    # NumPy's numbers divide by zero as compiled code does, to an infinity: outside a domain a formula may.
    with np.errstate(all="ignore"):
        rays = [((u, v), ray_of(u, v)) for v in rows for u in columns]
    seen = [(uv, (x, y, z)) for uv, (x, y, z, valid) in rays if valid]
    return np.array([uv for uv, _ in seen]).reshape(-1, 2), np.array([ray for _, ray in seen]).reshape(-1, 3)


def _polar(rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angle from the optical axis (N,), rad, and the direction (N, 2) in which a ray leaves it."""
    radius = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.array([polar_angle(r, z) for r, z in zip(radius.tolist(), rays[:, 2].tolist(), strict=True)])
    # On the axis every direction is the same: the radius there is zero.
    return theta, rays[:, :2] / np.maximum(radius, np.finfo(np.float64).tiny)[:, None]


def _errors_px(camera: KannalaBrandt, uv_px: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reprojection error (N,) of the rays; infinite where the camera does not see one."""
    projected = [guarded_pixel(camera, x, y, z, *image_point(camera, x, y, z)) for x, y, z in rays.tolist()]
    seen = np.array([valid for *_, valid in projected])
    error_px: NDArray[np.float64] = np.linalg.norm(np.array([(u, v) for u, v, _ in projected]) - uv_px, axis=1)
    return np.where(seen, error_px, np.inf)
