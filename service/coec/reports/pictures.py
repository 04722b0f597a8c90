"""Overlays for people: points on the image, before and after."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
    return [
        write(folder / f"{name}.png", encode_png(overlay(window, T_camera_lidar, title, compensated)))
        for name, (T_camera_lidar, title) in poses.items()
    ]


def overlay(window: Window, T_camera_lidar: Matrix4, title: str, compensated: bool) -> NDArray[np.uint8]:
    """(height, width, 3) BGR: points at the pose (4, 4) on the image of the middle pair, with a title.

    Raises:
        DecodeError: the image cannot be decoded.
    """
    pair, rig = middle(window), window.rig
    image = decode_bgr(pair.camera.image, LimitsConfig())
    cloud = compensate(pair, rig, enabled=compensated)
    return draw(image, rig.camera, T_camera_lidar, cloud, rig.mask, title)
