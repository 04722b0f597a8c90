"""Images in forms that frames do not have, converted without loss of what is used: NV12 and NV21 to YUV 4:2:2, colours
of 16 bits to eight, WebP and TIFF to raw pixels. Sizes are read from the headers and checked before OpenCV decodes.
"""

import struct
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EncodedImage, ImageFormat
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal
from coec.io.images import check_size, eight_bits, raw_image

SEMIPLANAR: Final = {"nv12": (0, 1), "nv21": (1, 0)}
"""Where U and V stand in the pairs of the second plane, by `Image.encoding`."""

DEEP_COLOURS: Final = {
    "rgb16": (3, ImageFormat.RGB8),
    "bgr16": (3, ImageFormat.BGR8),
    "16UC3": (3, ImageFormat.BGR8),
    "rgba16": (4, ImageFormat.RGBA8),
    "bgra16": (4, ImageFormat.BGRA8),
    "16UC4": (4, ImageFormat.BGRA8),
}
"""Channels of 16 bits, and the format with eight, by `Image.encoding`."""

_MAX_TIFF_ENTRIES: Final = 512
"""Most entries of the first directory of a TIFF; cameras write some twenty."""

_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _FORMAT = 256, 257, 258, 277, 322, 339
"""Tags of a TIFF."""


def rows_of(data: NDArray[np.uint8], height: int, row: int, step: int) -> NDArray[np.uint8]:
    """(height, row) bytes of rows `step` bytes apart.

    Raises:
        DecodeError: `image_size_mismatch`: they do not fit into the data.
    """
    if step < row or data.size < (height - 1) * step + row:
        raise DecodeError(
            Refusal.IMAGE_SIZE_MISMATCH,
            f"{height} rows of {row} bytes, {step} apart, do not fit into {data.size}",
        )
    return np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)


def from_semiplanar(
    encoding: str, width: int, height: int, step: int, data: NDArray[np.uint8], limits: LimitsConfig
) -> EncodedImage:
    """An image of NV12 or NV21 as YUV 4:2:2: a plane of brightness, and one of half the height with pairs of U and V,
    each of which holds for two rows.

    Raises:
        DecodeError: `image_too_large`, `image_size_mismatch`.
    """
    check_size(width, height, limits)
    if width % 2 or height % 2:
        raise DecodeError(Refusal.IMAGE_SIZE_MISMATCH, f"{encoding} has even sides, not {width}×{height}")
    planes = rows_of(data, height + height // 2, width, step)
    colour = np.repeat(planes[height:].reshape(height // 2, width // 2, 2), 2, axis=0)
    pixels = np.empty((height, width, 2), np.uint8)
    pixels[:, :, 1] = planes[:height]
    u, v = SEMIPLANAR[encoding]
    pixels[:, ::2, 0], pixels[:, 1::2, 0] = colour[:, :, u], colour[:, :, v]
    return raw_image(ImageFormat.YUV422, width, height, pixels.tobytes(), limits)


def from_deep_colours(
    encoding: str, width: int, height: int, step: int, data: NDArray[np.uint8], big: bool, limits: LimitsConfig
) -> EncodedImage:
    """An image with colours of 16 bits as one of eight.

    Raises:
        DecodeError: `image_too_large`, `image_size_mismatch`.
    """
    check_size(width, height, limits)
    channels, form = DEEP_COLOURS[encoding]
    rows = np.ascontiguousarray(rows_of(data, height, 2 * channels * width, step))
    return raw_image(form, width, height, eight_bits(rows.view(">u2" if big else "<u2")).tobytes(), limits)


def from_file(data: bytes, limits: LimitsConfig) -> EncodedImage | None:
    """A WebP or TIFF as raw pixels; None if the data is neither.

    Raises:
        DecodeError: `image_truncated`, `image_corrupt`, `image_too_large`.
    """
    size = _size_of(data)
    if size is None:
        return None
    check_size(*size, limits)
    try:
        mode = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        decoded: Any = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error as error:
        raise DecodeError(Refusal.IMAGE_CORRUPT, "the image cannot be decoded") from error
    if decoded is None or decoded.dtype not in (np.uint8, np.uint16) or decoded.shape[:2] != (size[1], size[0]):
        raise DecodeError(Refusal.IMAGE_CORRUPT, "the image cannot be decoded")
    pixels = eight_bits(decoded)
    form = ImageFormat.MONO8 if pixels.ndim == 2 else ImageFormat.BGR8
    return raw_image(form, size[0], size[1], pixels.tobytes(), limits)


def _size_of(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a WebP or TIFF; None for other data."""
    try:
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp_size(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff_size(data, "<" if data[:2] == b"II" else ">")
    except (struct.error, IndexError) as error:
        raise DecodeError(Refusal.IMAGE_TRUNCATED, f"the image ends after {len(data)} bytes") from error
    return None


def _webp_size(data: bytes) -> tuple[int, int]:
    """From the first chunk (RFC 9649)."""
    (length,) = struct.unpack_from("<I", data, 4)
    if length + 8 > len(data) + 1:
        raise DecodeError(Refusal.IMAGE_TRUNCATED, "the WebP is cut off")
    match data[12:16]:
        case b"VP8 ":
            width, height = struct.unpack_from("<HH", data, 26)
            return width & 0x3FFF, height & 0x3FFF
        case b"VP8L":
            (bits,) = struct.unpack_from("<I", data, 21)
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        case b"VP8X":
            if data[20] & 0b10:
                raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, "animated WebPs are not read")
            return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
        case _:
            raise DecodeError(Refusal.IMAGE_CORRUPT, "the WebP has no image")


def _tiff_size(data: bytes, order: str) -> tuple[int, int]:
    """From the first directory (TIFF 6.0, section 2)."""
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, at)
    if count > _MAX_TIFF_ENTRIES:
        raise DecodeError(Refusal.IMAGE_CORRUPT, f"the TIFF has more than {_MAX_TIFF_ENTRIES} entries")
    values: dict[int, int] = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind, number = struct.unpack_from(f"{order}HHI", data, entry)
        if kind not in (3, 4) or number < 1:
            continue
        form = f"{order}{'H' if kind == 3 else 'I'}"
        # What does not fit into the entry stands elsewhere. Of several values, one for each channel, the first counts.
        is_inside = number * struct.calcsize(form) <= 4
        place = entry + 8 if is_inside else struct.unpack_from(f"{order}I", data, entry + 8)[0]
        (values[tag],) = struct.unpack_from(form, data, place)
    plain = values.get(_SAMPLES, 1) <= 4 and values.get(_BITS, 1) <= 16 and values.get(_FORMAT, 1) == 1
    if not plain or _TILE_WIDTH in values:
        what = "a TIFF of tiles, of floats, or with more than four channels of 16 bits is no camera's picture"
        raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, what)
    return values.get(_WIDTH, 0), values.get(_HEIGHT, 0)
