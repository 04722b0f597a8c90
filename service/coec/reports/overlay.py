"""LiDAR points drawn on the image they were taken with: what a person looks at to judge an extrinsic."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.adapters.images.range_colours import FURTHEST_M, NEAREST_M, colours_bgr, share_of
from coec.calibration.types import Matrix4
from coec.geometry.cameras import Camera
from coec.geometry.in_view import points_in_view

TICKS_M = (2, 5, 10, 20, 40, 80)

MIN_WIDTH_PX = 960
"""Narrower images are enlarged by a whole factor, so that the title is legible."""

POINT_SHARE = 1 / 1200
"""Radius of a point as a share of the width: 1.2 px on 1408, so that neighbouring rings stay apart."""

TITLE_SHARE, BAR_SHARE = 1 / 34, 1 / 40
"""Height of the title, and of the bar of ranges, as shares of the width."""

INK, PAPER = (235, 235, 235), (24, 24, 24)

Pixels = NDArray[np.uint8]


def draw(
    image_bgr: Pixels,
    camera: Camera,
    T_camera_lidar: Matrix4,
    xyz_m: NDArray[np.floating],
    mask: NDArray[np.bool_] | None,
    title: str,
) -> Pixels:
    """The image with the points of a sweep on it, coloured by range, near ones on top of far ones.

    Args:
        image_bgr: (height, width, 3) uint8, the size of `camera`. It is not changed.
        T_camera_lidar: (4, 4).
        xyz_m: (N, 3) LiDAR frame, compensated to the instant of the image.
        mask: (height, width) or None; points on pixels that are False are left out.
        title: one line of ASCII above the image; cut off where it is too long.

    Returns:
        (height', width', 3) uint8: title, picture, bar of ranges. Small images are enlarged by a whole factor.
    """
    factor = max(1, -(-MIN_WIDTH_PX // image_bgr.shape[1]))
    picture = np.asarray(np.repeat(np.repeat(image_bgr, factor, axis=0), factor, axis=1), dtype=np.uint8)
    uv_px, range_m, _ = points_in_view(camera, T_camera_lidar, xyz_m, mask, NEAREST_M)
    # Pixel centres are integers: the middle of an enlarged pixel is not at factor · u.
    centres = np.rint((uv_px + 0.5) * factor - 0.5).astype(np.int64)
    _stamp(picture, centres, range_m, radius_px=picture.shape[1] * POINT_SHARE)
    return np.vstack([_title(picture.shape[1], title), picture, _bar(picture.shape[1])])


def _stamp(picture: Pixels, centres: NDArray[np.int64], range_m: NDArray[np.float64], radius_px: float) -> None:
    """A disc of its colour for every point. All pixels of all discs are written at once, far to near."""
    reach = int(radius_px)
    offsets = [
        (u, v)
        for v in range(-reach, reach + 1)
        for u in range(-reach, reach + 1)
        if u * u + v * v <= radius_px * radius_px
    ]
    height, width = picture.shape[:2]
    at = (centres[:, None, :] + np.array(offsets, dtype=np.int64)[None]).reshape(-1, 2)
    inside = (at[:, 0] >= 0) & (at[:, 0] < width) & (at[:, 1] >= 0) & (at[:, 1] < height)
    point = np.repeat(np.arange(len(centres)), len(offsets))[inside]
    at = at[inside]
    # Of equal indices NumPy keeps the last value assigned.
    order = np.argsort(-range_m[point], kind="stable")
    picture[at[order, 1], at[order, 0]] = colours_bgr(range_m)[point[order]]


def _title(width: int, title: str) -> Pixels:
    strip = np.full((round(width * TITLE_SHARE), width, 3), PAPER, dtype=np.uint8)
    _write(strip, title, 0.01 * width, strip.shape[0])
    return strip


def _bar(width: int) -> Pixels:
    """The colours of the ranges, with a figure where each of `TICKS_M` is."""
    height = round(width * BAR_SHARE)
    range_m = NEAREST_M * (FURTHEST_M / NEAREST_M) ** np.linspace(0.0, 1.0, width)
    ramp = np.repeat(colours_bgr(range_m)[None], max(2, height // 4), axis=0)
    scale = np.full((height - len(ramp), width, 3), PAPER, dtype=np.uint8)
    for tick_m in TICKS_M:
        place = min(max(float(share_of(tick_m)) - 0.01, 0.005), 0.965)
        _write(scale, f"{tick_m} m", place * width, scale.shape[0])
    return np.vstack([ramp, scale])


def _write(strip: Pixels, text: str, x_px: float, height_px: int) -> None:
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, height_px / 40
    cv2.putText(strip, text, (round(x_px), round(0.72 * height_px)), font, scale, INK, 1, cv2.LINE_AA)
