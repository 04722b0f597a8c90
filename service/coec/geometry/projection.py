"""Projection of arrays with any camera model, by the formulas of `coec.geometry.cameras` compiled into a loop."""

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, project_point, unproject_point
from coec.geometry.compiler import njit
from coec.geometry.vectors import rows_of


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


def project(camera: Camera, p_camera: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels of points.

    p_camera: (N, 3), metres, camera frame. Returns uv_px (N, 2) and valid (N,); uv_px is finite throughout. A valid
    point need not lie in the image: see `in_image`. Raises ValueError for any other shape.
    """
    uv_px, valid = _project(camera, rows_of("p_camera", p_camera, 3))
    return uv_px, valid


def unproject(camera: Camera, uv_px: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Rays of pixels.

    uv_px: (N, 2). Returns unit vectors (N, 3) in the camera frame and valid (N,). Raises ValueError for any other
    shape.
    """
    rays, valid = _unproject(camera, rows_of("uv_px", uv_px, 2))
    return rays, valid
