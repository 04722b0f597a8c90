"""Projection of arrays by any camera model. The formulas are those of `coec.geometry.cameras`, compiled into a loop."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, project_point, unproject_point


@njit(cache=True, error_model="numpy")
def _project(camera: Camera, p_camera: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    count = p_camera.shape[0]
    uv_px = np.empty((count, 2))
    valid = np.empty(count, np.bool_)
    for i in range(count):
        uv_px[i, 0], uv_px[i, 1], valid[i] = project_point(camera, p_camera[i, 0], p_camera[i, 1], p_camera[i, 2])
    return uv_px, valid


@njit(cache=True, error_model="numpy")
def _unproject(camera: Camera, uv_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    count = uv_px.shape[0]
    rays = np.empty((count, 3))
    valid = np.empty(count, np.bool_)
    for i in range(count):
        rays[i, 0], rays[i, 1], rays[i, 2], valid[i] = unproject_point(camera, uv_px[i, 0], uv_px[i, 1])
    return rays, valid


def _rows(name: str, array: NDArray[np.floating], columns: int) -> NDArray[np.float64]:
    rows = np.ascontiguousarray(array, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ValueError(f"{name} must have the shape (N, {columns}), got {rows.shape}")
    return rows


def project(camera: Camera, p_camera: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels of points.

    p_camera: (N, 3), metres, camera frame. Returns uv_px (N, 2) and valid (N,); uv_px is finite throughout. A valid
    point need not lie in the image: see `in_image`. Raises ValueError for any other shape.
    """
    uv_px, valid = _project(camera, _rows("p_camera", p_camera, 3))
    return uv_px, valid


def unproject(camera: Camera, uv_px: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Rays of pixels.

    uv_px: (N, 2). Returns unit vectors (N, 3) in the camera frame and valid (N,). Raises ValueError for any other
    shape.
    """
    rays, valid = _unproject(camera, _rows("uv_px", uv_px, 2))
    return rays, valid


def in_image(camera: Camera, uv_px: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(N,): true where the nearest pixel exists: -0.5 <= u < width - 0.5, and v likewise. uv_px: (N, 2)."""
    u, v = _rows("uv_px", uv_px, 2).T
    inside: NDArray[np.bool_] = (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
    return inside


def domain_angle_rad(camera: Camera) -> float:
    """The angle from the optical axis, in (0, π], up to which a point has a pixel. In every model the domain is a cone
    about the axis."""
    low, high = 0.0, math.pi
    for angle in np.linspace(0.0, math.pi, 257)[1:].tolist():
        if not project_point(camera, math.sin(angle), 0.0, math.cos(angle))[2]:
            high = angle
            break
        low = angle
    while low < (middle := 0.5 * (low + high)) < high:  # bisection down to the last bit
        if project_point(camera, math.sin(middle), 0.0, math.cos(middle))[2]:
            low = middle
        else:
            high = middle
    return low
