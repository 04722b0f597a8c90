"""Pictures of a window for people: points on the image before and after, close-ups, residuals at the result."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import FramePair, Matrix4, Window
from coec.calibration.verdict import saw_one_scene
from coec.config import LimitsConfig
from coec.geometry.cameras import Camera
from coec.geometry.projection import points_in_view
from coec.io.images import NEAREST_M, decode_bgr, encode_jpeg, encode_png, scale_of
from coec.io.user_files import write_output
from coec.reports.close_ups import Caption, close_ups, difference_text
from coec.reports.formatting import instant
from coec.reports.overlay import render_points, titled
from coec.reports.page import Block, Compare, Picture, Pictures, Text
from coec.reports.page_parts import file_picture
from coec.reports.residual_map import lens_residual, residual_map

PAGE_JPEG_QUALITY = 95
"""JPEG quality of pictures for a page, which shrinks large ones again."""

SLID_ALTS = ("LiDAR points on the camera image, before", "The same LiDAR points on the same image, after")
"""Alternative texts of two pictures that a slider compares."""


def middle(window: Window) -> FramePair:
    """The pair that overlays show."""
    return window.pairs[len(window.pairs) // 2]


def write_overlay(folder: Path, name: str, picture: NDArray[np.uint8], title: str) -> Path:
    """Writes `<name>.png`: a picture of `overlays` with a title.

    Raises:
        OutputError: the folder or the file cannot be written.
    """
    return write_output(folder / f"{name}.png", encode_png(titled(picture, title)))


def overlays(window: Window, poses: Sequence[Matrix4], compensated: bool) -> list[NDArray[np.uint8]]:
    """(height, width, 3) BGR for each pose (4, 4): points on the image of the middle pair. The points in view at the
    first pose set the colour scale of all pictures.

    Raises:
        DecodeError: the image cannot be decoded.
    """
    pair, rig = middle(window), window.rig
    image = decode_bgr(pair.camera.image, LimitsConfig())
    cloud = compensate(pair, rig, enabled=compensated)
    scale = scale_of(points_in_view(rig.camera, poses[0], cloud, rig.mask, NEAREST_M).range_m)
    return [render_points(image, rig.camera, T_camera_lidar, cloud, rig.mask, scale) for T_camera_lidar in poses]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Pictures of two extrinsics: the files, the blocks of a page that show them, and what was left out, one sentence
    each."""

    files: tuple[Path, ...]
    blocks: tuple[Block, ...]
    left_out: tuple[str, ...]


def write_comparison(
    folder: Path,
    window: Window,
    T_before: Matrix4,
    T_after: Matrix4,
    caption: Caption,
    compensated: bool,
    independent_samples: float | None,
) -> Comparison:
    """Draws two extrinsics (4, 4) of a window: overlay_before.png, overlay_after.png, close_ups.png, and residuals.png
    at the second. The residuals are left out if they could not be trusted, because the pairs are worth too few
    independent `looks` (None: not known).

    Raises:
        OutputError: the folder or a file cannot be written.
        DecodeError: an image cannot be decoded.
        CalibrationError: an image is not of the camera's size.
    """
    where = f"{window.rig.pair}  {instant(middle(window).stamp_ns)}"
    difference = difference_text(T_before, T_after)
    before, after = overlays(window, (T_before, T_after), compensated)
    near = close_ups(window, T_before, T_after, compensated=compensated, caption=caption)
    files = [
        write_overlay(
            folder, "overlay_before", before, f"{where}  {caption.before}\n{difference} from {caption.after}"
        ),
        write_overlay(folder, "overlay_after", after, f"{where}  {caption.after}\n{difference} from {caption.before}"),
        write_output(folder / "close_ups.png", encode_png(near)),
    ]
    captions = (
        f"Before: {caption.before}, {difference} from the other. LiDAR points, coloured by range.",
        f"After: {caption.after}.",
    )
    slid = slid_pictures((before, after), captions)
    one_scene = independent_samples is not None and saw_one_scene(independent_samples, len(window.pairs))
    if one_scene:
        why = (
            f"No map of residuals: {len(window.pairs)} pairs that are worth {independent_samples:.1f} independent "
            "looks show the same edges again and again, as those of a vehicle that stands do, and a part of the image "
            "would look right or wrong by chance."
        )
        return Comparison(tuple(files), (slid, Pictures((file_picture(files[-1]),)), Text((why,), quiet=True)), (why,))
    left = residual_map(window, T_after, compensated=compensated, name=caption.after, sigma=caption.sigma)
    files.append(write_output(folder / "residuals.png", encode_png(left)))
    return Comparison(tuple(files), (slid, Pictures(tuple(map(file_picture, files[2:])))), ())


def slid_pictures(pictures: tuple[NDArray[np.uint8], NDArray[np.uint8]], captions: tuple[str, str]) -> Compare:
    """Two pictures (height, width, 3) BGR of one size for a slider. The words stand beside them, so that the slider
    moves over no text."""
    before, after = (
        Picture(encode_jpeg(picture, PAGE_JPEG_QUALITY), alt, caption)
        for picture, alt, caption in zip(pictures, SLID_ALTS, captions, strict=True)
    )
    return Compare(before, after, "Before and after")


def write_lens(folder: Path, camera: Camera, fitted: Camera) -> Path:
    """Writes lens_residual.png: how far a fitted camera model is from the one that it stands for.

    Raises:
        OutputError: the folder or the file cannot be written.
    """
    return write_output(folder / "lens_residual.png", encode_png(lens_residual(camera, fitted)))


def network_text(model: str, identity: str) -> str:
    """A depth network for people: its name without the folder, and the beginning of its `identity`."""
    return f"{Path(model).name} ({identity[:12]})"
