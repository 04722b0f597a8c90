"""Checks that both encodings of frames share, made before a message becomes a value."""

import math
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EncodedImage, ImageFormat, LidarFrame
from coec.config import LimitsConfig
from coec.errors import DecodeError

MAX_FRAME_ID = 128
"""Most characters of a frame id, as in config.CameraConfig.frame_id."""

MAX_TIME_OFFSET_S = 10.0
"""Most time between a point and the stamp of its sweep, the longest period of config.SweepConfig. A point beyond it was
timed by another clock."""

MAX_SPEED = 1000.0
"""Largest velocity, m/s and rad/s, beyond every vehicle and gyroscope (as in coec.schemas.frames)."""


SUBSAMPLED: Final = (ImageFormat.YUV422, ImageFormat.YUV422_YUY2)
"""Formats in which two pixels of a row share their colour."""

MOSAICS: Final = tuple(form for form in ImageFormat if form.startswith("bayer_"))
"""Formats in which each pixel has one colour."""

_MOSAIC_PX = 4
"""Least side of a mosaic: two pixels of each colour, so that colours can be interpolated between them."""

BYTES_PER_PIXEL: Final = {
    ImageFormat.MONO8: 1,
    ImageFormat.MONO16: 2,
    ImageFormat.RGB8: 3,
    ImageFormat.BGR8: 3,
    ImageFormat.RGBA8: 4,
    ImageFormat.BGRA8: 4,
    **{form: 2 if form.endswith("16") else 1 for form in MOSAICS},
    **dict.fromkeys(SUBSAMPLED, 2),
}
"""Bytes per pixel of every raw format; 16-bit values are little-endian."""


class Refusal(StrEnum):
    """Every reason for refusing a frame; also the label under which the loss is counted."""

    MESSAGE_TOO_LARGE = "message_too_large"
    MESSAGE_MALFORMED = "message_malformed"
    MESSAGE_FIELDS = "message_fields"
    MESSAGE_TYPE = "message_type"
    STAMP_INVALID = "stamp_invalid"
    FRAME_ID_INVALID = "frame_id_invalid"
    IMAGE_UNKNOWN_FORMAT = "image_unknown_format"
    IMAGE_TRUNCATED = "image_truncated"
    IMAGE_TOO_LARGE = "image_too_large"
    IMAGE_CORRUPT = "image_corrupt"
    IMAGE_SIZE_MISMATCH = "image_size_mismatch"
    DEPTH_MISSING = "depth_missing"
    DEPTH_NOT_GREY = "depth_not_grey"
    CLOUD_EMPTY = "cloud_empty"
    CLOUD_TOO_LARGE = "cloud_too_large"
    CLOUD_SHAPE = "cloud_shape"
    CLOUD_FIELDS = "cloud_fields"
    CLOUD_TIME = "cloud_time"
    CLOUD_TIME_AMBIGUOUS = "cloud_time_ambiguous"
    CLOUD_CONCATENATED = "cloud_concatenated"
    MOTION_INVALID = "motion_invalid"
    TRANSFORM_INVALID = "transform_invalid"
    TRANSFORMS_TOO_MANY = "transforms_too_many"


def check_size(payload: bytes, limits: LimitsConfig) -> None:
    """Raises:
    DecodeError: `message_too_large`.
    """
    if len(payload) > limits.max_message_bytes:
        raise DecodeError(
            Refusal.MESSAGE_TOO_LARGE,
            f"{len(payload)} bytes; limits.max_message_bytes is {limits.max_message_bytes}",
        )


def raw_image(form: ImageFormat, width: int, height: int, data: bytes, limits: LimitsConfig) -> EncodedImage:
    """Rows of raw pixels without padding, `height × width × BYTES_PER_PIXEL` bytes.

    Raises:
        DecodeError: `image_too_large` or `image_size_mismatch`.
    """
    check_image_size(width, height, limits)
    if (form in SUBSAMPLED and width % 2) or (form in MOSAICS and min(width, height) < _MOSAIC_PX):
        raise DecodeError(Refusal.IMAGE_SIZE_MISMATCH, f"{form} pixels come in pairs, not as {width}×{height}")
    expected = width * height * BYTES_PER_PIXEL[form]
    if len(data) != expected:
        raise DecodeError(
            Refusal.IMAGE_SIZE_MISMATCH,
            f"{width}×{height} {form} pixels are {expected} bytes, not {len(data)}",
        )
    return EncodedImage(format=form, width=width, height=height, data=data)


def check_image_size(width: int, height: int, limits: LimitsConfig) -> None:
    """Checks the size of an image before anything of it is allocated.

    Raises:
        DecodeError: `image_corrupt` without pixels, `image_too_large`.
    """
    if width < 1 or height < 1:
        raise DecodeError(Refusal.IMAGE_CORRUPT, f"the image claims to be {width}×{height} pixels")
    if width * height > limits.max_image_pixels:
        raise DecodeError(
            Refusal.IMAGE_TOO_LARGE,
            f"the image claims {width}×{height} pixels; limits.max_image_pixels is {limits.max_image_pixels}",
        )


def finite_rows(
    xyz_m: NDArray[np.float32], time_offset_s: NDArray[np.float32] | None = None
) -> NDArray[np.bool_] | None:
    """(N,) mask of the points whose position and time are finite; None if all are (the usual case)."""
    # First check whole arrays by their sum, which any non-finite value spoils: ten times as fast as by column.
    with np.errstate(over="ignore", invalid="ignore"):
        if all(math.isfinite(column.sum()) for column in (xyz_m, time_offset_s) if column is not None):
            return None
    finite: NDArray[np.bool_] = np.isfinite(xyz_m)
    keep: NDArray[np.bool_] = finite[:, 0] & finite[:, 1] & finite[:, 2]
    if time_offset_s is not None:
        keep &= np.isfinite(time_offset_s)
    return keep


def lidar_frame(
    stamp_ns: int,
    frame_id: str,
    xyz_m: NDArray[np.float32],
    intensity: NDArray[np.float32] | None,
    ring: NDArray[np.uint16] | None,
    time_offset_s: NDArray[np.float32] | None,
    sequence: int | None = None,
    timed_by: str = "",
) -> LidarFrame:
    """A sweep without its non-finite points; every column loses the same rows. Copies only if there are such points.

    Args:
        xyz_m: (N, 3).
        intensity, ring, time_offset_s: (N,) each, or None.
        timed_by: see `LidarFrame`.

    Raises:
        DecodeError: `cloud_empty` if no finite point is left, `cloud_time` if a point is too far from the stamp.
    """
    keep = finite_rows(xyz_m, time_offset_s)
    if keep is not None:
        xyz_m = xyz_m[keep]
        intensity = None if intensity is None else intensity[keep]
        ring = None if ring is None else ring[keep]
        time_offset_s = None if time_offset_s is None else time_offset_s[keep]
    if len(xyz_m) == 0:
        raise DecodeError(Refusal.CLOUD_EMPTY, "the cloud has no finite point: see to its driver or filter")
    if time_offset_s is not None and np.abs(time_offset_s).max() > MAX_TIME_OFFSET_S:
        raise DecodeError(
            Refusal.CLOUD_TIME,
            f"points more than {MAX_TIME_OFFSET_S:g} s from the stamp of their sweep: do both come from one clock?",
        )
    return LidarFrame(
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        xyz_m=xyz_m,
        intensity=intensity,
        ring=ring,
        time_offset_s=time_offset_s,
        sequence=sequence,
        timed_by=timed_by,
        not_finite=0 if keep is None else int(len(keep) - len(xyz_m)),
    )
