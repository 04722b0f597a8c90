"""LiDAR points drawn on the image they were taken with: what a person looks at to judge an extrinsic."""

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.cameras import Camera
from coec.geometry.projection import points_in_view
from coec.io.images import NEAREST_M, RangeScale, scale_of
from coec.reports.drawing import Pixels, write

MIN_WIDTH_PX = 960
"""Narrower images are enlarged by a whole factor, so that the title is legible."""

LINES = 2
"""Most lines of a title."""

POINT_SHARE = 1 / 1200
"""Radius of a point as a share of the width: 1.2 px on 1408, so that neighbouring rings stay apart."""

LINE_SHARE, BAR_SHARE = 1 / 44, 1 / 36
"""Height of a line of the title, and of the bar of ranges, as shares of the width."""

INK, PAPER = (24, 24, 24), (250, 250, 250)
TYPE_SHARE = 0.85
"""Size of type as a share of the height of its line."""


def render_points(
    image_bgr: Pixels,
    camera: Camera,
    T_camera_lidar: Matrix4,
    xyz_m: NDArray[np.floating],
    mask: NDArray[np.bool_] | None,
    scale: RangeScale | None = None,
) -> Pixels:
    """The image with the points of a sweep on it, coloured by range, near ones on top of far ones.

    Args:
        image_bgr: (height, width, 3) uint8, the size of `camera`. It is not changed.
        T_camera_lidar: (4, 4).
        xyz_m: (N, 3) LiDAR frame, compensated to the instant of the image.
        mask: (height, width) or None; points on pixels that are False are left out.
        scale: of the colours; None: that of the points in view.

    Returns:
        (height', width', 3) uint8: the picture above a bar of ranges. Small images are enlarged by a whole factor.
    """
    factor = max(1, -(-MIN_WIDTH_PX // image_bgr.shape[1]))
    picture = np.asarray(np.repeat(np.repeat(image_bgr, factor, axis=0), factor, axis=1), dtype=np.uint8)
    uv_px, range_m, _ = points_in_view(camera, T_camera_lidar, xyz_m, mask, NEAREST_M)
    # Pixel centres are integers: the middle of an enlarged pixel is not at factor · u.
    centres = np.rint((uv_px + 0.5) * factor - 0.5).astype(np.int64)
    shown = scale_of(range_m) if scale is None else scale
    _stamp(picture, centres, range_m, shown, radius_px=picture.shape[1] * POINT_SHARE)
    return np.vstack([picture, _bar(picture.shape[1], shown)])


def titled(picture: Pixels, title: str) -> Pixels:
    """The picture with one or two title lines above it, cut off where they are too long. For a picture that stands
    alone; on a page its caption says the same."""
    return np.vstack([_title(picture.shape[1], title), picture])


def _stamp(
    picture: Pixels,
    centres: NDArray[np.int64],
    range_m: NDArray[np.float64],
    scale: RangeScale,
    radius_px: float,
) -> None:
    """Draws a coloured disc for every point. All pixels of all discs are written at once, far to near."""
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
    # Where indices are equal, NumPy keeps the last value assigned.
    order = np.argsort(-range_m[point], kind="stable")
    picture[at[order, 1], at[order, 0]] = scale.colours_bgr(range_m)[point[order]]


def _title(width: int, title: str) -> Pixels:
    height = round(width * LINE_SHARE)
    lines = title.split("\n")[:LINES]
    strip = np.full((height * len(lines) + height // 4, width, 3), PAPER, dtype=np.uint8)
    for number, line in enumerate(lines):
        place = (0.01 * width, (number + 0.8) * height)
        write(strip, line, place, round(TYPE_SHARE * height), colour=INK)
    return strip


def _bar(width: int, scale: RangeScale) -> Pixels:
    """A bar of the colours of ranges, labelled at round ranges. What lies beyond an end has the end's colour."""
    height, left, right = round(width * BAR_SHARE), round(0.02 * width), round(0.96 * width)
    strip = np.full((height, width, 3), PAPER, dtype=np.uint8)
    ramp = scale.colours_bgr(scale.range_at(np.linspace(0.0, 1.0, right - left)))
    strip[height // 8 : height // 2 - 1, left:right] = ramp
    for tick_m in scale.ticks_m():
        place = left + float(scale.share_of(tick_m)) * (right - left - 1)
        strip[height // 8 : height // 2 + 2, round(place)] = INK
        write(strip, f"{tick_m:g} m", (place - 0.012 * width, 0.9 * height), round(TYPE_SHARE * height / 2), colour=INK)
    return strip
