"""Pictures of a window for people: points on the image before and after, close-ups, what is left at the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.adapters.files.output import write
from coec.adapters.images.codec import decode_bgr, encode_png
from coec.adapters.images.range_colours import NEAREST_M, scale_of
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import FramePair, Matrix4, Window
from coec.config import LimitsConfig
from coec.geometry.cameras import Camera
from coec.geometry.in_view import points_in_view
from coec.reports.close_ups import Caption, close_ups, difference_text
from coec.reports.instants import instant
from coec.reports.lens_residual import lens_residual
from coec.reports.overlay import draw
from coec.reports.residual_map import residual_map


def middle(window: Window) -> FramePair:
    """The pair that overlays show."""
    return window.pairs[len(window.pairs) // 2]


def write_overlays(
    folder: Path, window: Window, poses: Mapping[str, tuple[Matrix4, str]], compensated: bool
) -> list[Path]:
    """`<name>.png` for each name: points at the pose (4, 4) on the image of the middle pair, with its title; all in the
    same colours.

    Raises:
        OutputError: the folder or a file cannot be written.
        DecodeError: the image cannot be decoded.
    """
    drawn = overlays(window, tuple(poses.values()), compensated)
    return [write(folder / f"{name}.png", encode_png(picture)) for name, picture in zip(poses, drawn, strict=True)]


def overlays(window: Window, poses: Sequence[tuple[Matrix4, str]], compensated: bool) -> list[NDArray[np.uint8]]:
    """(height, width, 3) BGR for each pose (4, 4): points on the image of the middle pair, with a title; all in the
    colours of what is seen at the first.

    Raises:
        DecodeError: the image cannot be decoded.
    """
    pair, rig = middle(window), window.rig
    image = decode_bgr(pair.camera.image, LimitsConfig())
    cloud = compensate(pair, rig, enabled=compensated)
    scale = scale_of(points_in_view(rig.camera, poses[0][0], cloud, rig.mask, NEAREST_M).range_m)
    return [draw(image, rig.camera, T_camera_lidar, cloud, rig.mask, title, scale) for T_camera_lidar, title in poses]


def write_comparison(
    folder: Path, window: Window, T_before: Matrix4, T_after: Matrix4, caption: Caption, compensated: bool
) -> list[Path]:
    """Two extrinsics (4, 4) of a window: overlay_before.png, overlay_after.png, close_ups.png, and residuals.png at the
    second one.

    Raises:
        OutputError: the folder or a file cannot be written.
        DecodeError: an image cannot be decoded.
        CalibrationError: an image is not of the camera's size.
    """
    where = f"{window.rig.pair}  {instant(middle(window).stamp_ns)}"
    # Overlays are lettered in ASCII.
    apart = difference_text(T_before, T_after).replace("\u00b0", " deg")
    poses = {
        "overlay_before": (T_before, f"{where}  {caption.before}\n{apart} from {caption.after}"),
        "overlay_after": (T_after, f"{where}  {caption.after}\n{apart} from {caption.before}"),
    }
    near = close_ups(window, T_before, T_after, compensated=compensated, caption=caption)
    left = residual_map(window, T_after, compensated=compensated, name=caption.after)
    return [
        *write_overlays(folder, window, poses, compensated),
        write(folder / "close_ups.png", encode_png(near)),
        write(folder / "residuals.png", encode_png(left)),
    ]


def write_lens(folder: Path, camera: Camera, fitted: Camera) -> Path:
    """lens_residual.png: what a fitted camera model misses of the one that it stands for.

    Raises:
        OutputError: the folder or the file cannot be written.
    """
    return write(folder / "lens_residual.png", encode_png(lens_residual(camera, fitted)))


def network_text(model: str, identity: str) -> str:
    """A depth network for people: its name without the folder, and the beginning of its identity; `identity` is what an
    estimate says of it."""
    return f"{Path(model).name} ({identity[:12]})"
