"""Overlays for people: points on the image, before and after."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from coec.adapters.files.output import write
from coec.adapters.images.codec import decode_bgr, encode_png
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import FramePair, Matrix4, Window
from coec.config import LimitsConfig
from coec.reports.overlay import draw


def middle(window: Window) -> FramePair:
    """The pair that overlays show."""
    return window.pairs[len(window.pairs) // 2]


def write_overlays(
    folder: Path, window: Window, poses: Mapping[str, tuple[Matrix4, str]], compensated: bool
) -> list[Path]:
    """`<name>.png` for each name: points at the pose (4, 4) on the image of the middle pair, with its title.

    Raises:
        OutputError: the folder or a file cannot be written.
        DecodeError: the image cannot be decoded.
    """
    pair, rig = middle(window), window.rig
    image = decode_bgr(pair.camera.image, LimitsConfig())
    cloud = compensate(pair, rig, enabled=compensated)
    written = []
    for name, (T_camera_lidar, title) in poses.items():
        picture = draw(image, rig.camera, T_camera_lidar, cloud, rig.mask, title)
        written.append(write(folder / f"{name}.png", encode_png(picture)))
    return written
