"""A wall, a board before it, and a camera that looks at both: where the sweep jumps is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.adapters.images.codec import encode_jpeg
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Rig
from coec.geometry import se3
from coec.geometry.cameras import Camera, build

BOARD_WALL_M, BOARD_M = 20.0, 6.0
HALF_WIDTH_M = 1.0
"""Of the board, which stands straight ahead and is higher than the sweep."""

BOARD_COLUMNS, BOARD_RINGS = 1800, 32

BOARD_NOMINAL = np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.3], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 0.0, 1.0]])
BOARD_MOVED = se3.perturb(BOARD_NOMINAL, np.radians([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
BOARD_IMAGE_SIZE = {"width": 640, "height": 400}

BOARD_LENSES: dict[str, Camera] = {
    "pinhole": build("pinhole", **BOARD_IMAGE_SIZE, fx=320.0, fy=321.0, cx=319.5, cy=199.5),
    "radtan": build(
        "radtan",
        **BOARD_IMAGE_SIZE,
        fx=320.0,
        fy=321.0,
        cx=319.5,
        cy=199.5,
        k1=-0.1,
        k2=0.02,
        p1=1e-3,
        p2=-1e-3,
        k3=-1e-3,
    ),
    "kannala_brandt": build(
        "kannala_brandt",
        **BOARD_IMAGE_SIZE,
        fx=300.0,
        fy=301.0,
        cx=320.5,
        cy=200.5,
        k1=-0.05,
        k2=0.01,
        k3=-0.004,
        k4=5e-4,
    ),
    "double_sphere": build(
        "double_sphere", **BOARD_IMAGE_SIZE, fx=180.0, fy=181.0, cx=320.5, cy=200.5, xi=-0.2, alpha=0.6
    ),
}


def board_rig(camera: Camera, mask: NDArray[np.bool_] | None = None) -> Rig:
    return Rig("front", camera, "cam", "velo", BOARD_NOMINAL, np.eye(4), mask)


def board_sweep() -> LidarFrame:
    """The forward third of a turn, in rows."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi / 3, np.pi / 3, BOARD_COLUMNS), np.radians(np.linspace(-10.0, 10.0, BOARD_RINGS))
    )
    slope = np.tan(azimuth)
    ahead_m = np.where(np.abs(BOARD_M * slope) <= HALF_WIDTH_M, BOARD_M, BOARD_WALL_M)
    side_m = ahead_m * slope
    up_m = np.hypot(ahead_m, side_m) * np.tan(elevation)
    xyz_m = np.stack([ahead_m, side_m, up_m], axis=-1).reshape(-1, 3).astype(np.float32)
    return LidarFrame(10**18, "velo", xyz_m, ring=np.repeat(np.arange(BOARD_RINGS), BOARD_COLUMNS).astype(np.uint16))


def board_frame_pair(camera: Camera, stamp_ns: int = 10**18) -> FramePair:
    """With a grey picture."""
    grey = np.full((camera.height, camera.width, 3), 90, np.uint8)
    image = EncodedImage(ImageFormat.JPEG, camera.width, camera.height, encode_jpeg(grey))
    return FramePair(CameraFrame(stamp_ns, "cam", image), board_sweep())
