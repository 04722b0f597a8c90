"""Converts raw pixels, as cameras send them, to 8 bits of grey or colour.

Frames keep the pixels as they came, because most are never used and a window records what the camera sent.

Of 16-bit pixels the eight significant bits are taken. A camera of 10, 12 or 14 bits puts its bits into 16 either at the
bottom or at the top, and does not say where. So the image is taken to have the smallest depth of 8, 10, 12, 14 and 16
bits that holds its largest value, and its highest bit becomes the highest of eight; a saturated pixel is white either
way. A dark image of 12 bits is read as one of 10 bits, four times as bright, which matters neither for edges nor for
depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EncodedImage, ImageFormat

_DEPTHS: Final = (8, 10, 12, 14, 16)
"""Bits per pixel of image sensors."""

_BLACK, _WHITE = 16, 235
"""Luma of black and white in YUV (ITU-R BT.601), as in OpenCV's conversions to colour."""

_LUMA: Final = np.clip(np.rint((np.arange(256) - _BLACK) * (255 / (_WHITE - _BLACK))), 0, 255).astype(np.uint8)


@dataclass(frozen=True, slots=True)
class _Layout:
    """Layout of one format: `channels` of `dtype` per pixel; OpenCV's conversions, None if nothing is to convert."""

    dtype: np.dtype[Any]
    channels: int
    to_bgr: int | None
    to_grey: int | None


_U8, _U16 = np.dtype("u1"), np.dtype("<u2")

_LAYOUTS: Final[dict[ImageFormat, _Layout]] = {
    ImageFormat.MONO8: _Layout(_U8, 1, cv2.COLOR_GRAY2BGR, None),
    ImageFormat.MONO16: _Layout(_U16, 1, cv2.COLOR_GRAY2BGR, None),
    ImageFormat.RGB8: _Layout(_U8, 3, cv2.COLOR_RGB2BGR, cv2.COLOR_RGB2GRAY),
    ImageFormat.BGR8: _Layout(_U8, 3, None, cv2.COLOR_BGR2GRAY),
    ImageFormat.RGBA8: _Layout(_U8, 4, cv2.COLOR_RGBA2BGR, cv2.COLOR_RGBA2GRAY),
    ImageFormat.BGRA8: _Layout(_U8, 4, cv2.COLOR_BGRA2BGR, cv2.COLOR_BGRA2GRAY),
    # Named by the first four pixels, as ROS does; OpenCV's older names (BayerBG for RGGB) begin elsewhere.
    ImageFormat.BAYER_RGGB8: _Layout(_U8, 1, cv2.COLOR_BayerRGGB2BGR, cv2.COLOR_BayerRGGB2GRAY),
    ImageFormat.BAYER_BGGR8: _Layout(_U8, 1, cv2.COLOR_BayerBGGR2BGR, cv2.COLOR_BayerBGGR2GRAY),
    ImageFormat.BAYER_GBRG8: _Layout(_U8, 1, cv2.COLOR_BayerGBRG2BGR, cv2.COLOR_BayerGBRG2GRAY),
    ImageFormat.BAYER_GRBG8: _Layout(_U8, 1, cv2.COLOR_BayerGRBG2BGR, cv2.COLOR_BayerGRBG2GRAY),
    ImageFormat.BAYER_RGGB16: _Layout(_U16, 1, cv2.COLOR_BayerRGGB2BGR, cv2.COLOR_BayerRGGB2GRAY),
    ImageFormat.BAYER_BGGR16: _Layout(_U16, 1, cv2.COLOR_BayerBGGR2BGR, cv2.COLOR_BayerBGGR2GRAY),
    ImageFormat.BAYER_GBRG16: _Layout(_U16, 1, cv2.COLOR_BayerGBRG2BGR, cv2.COLOR_BayerGBRG2GRAY),
    ImageFormat.BAYER_GRBG16: _Layout(_U16, 1, cv2.COLOR_BayerGRBG2BGR, cv2.COLOR_BayerGRBG2GRAY),
    ImageFormat.YUV422: _Layout(_U8, 2, cv2.COLOR_YUV2BGR_UYVY, cv2.COLOR_YUV2GRAY_UYVY),
    ImageFormat.YUV422_YUY2: _Layout(_U8, 2, cv2.COLOR_YUV2BGR_YUY2, cv2.COLOR_YUV2GRAY_YUY2),
}

SUBSAMPLED: Final = (ImageFormat.YUV422, ImageFormat.YUV422_YUY2)
"""Formats in which two pixels of a row share their colour."""

MOSAICS: Final = tuple(form for form in ImageFormat if form.startswith("bayer_"))
"""Formats in which each pixel has one colour."""

BYTES_PER_PIXEL: Final = {form: layout.channels * layout.dtype.itemsize for form, layout in _LAYOUTS.items()}
"""Bytes per pixel of every raw format; 16-bit values are little-endian."""


def bgr_of(image: EncodedImage) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 of a raw image whose size is checked, in OpenCV's order."""
    layout, pixels = _LAYOUTS[image.format], _pixels(image)
    return pixels if layout.to_bgr is None else np.asarray(cv2.cvtColor(pixels, layout.to_bgr), dtype=np.uint8)


def grey_of(image: EncodedImage) -> NDArray[np.uint8]:
    """(height, width) uint8 of a raw image whose size is checked; may be written to."""
    layout, pixels = _LAYOUTS[image.format], _pixels(image)
    if layout.to_grey is None:
        # Copy a read-only view of the message, because kernels would be compiled once more for read-only arrays.
        return pixels if pixels.flags.writeable else pixels.copy()
    grey = np.asarray(cv2.cvtColor(pixels, layout.to_grey), dtype=np.uint8)
    return np.asarray(cv2.LUT(grey, _LUMA), dtype=np.uint8) if image.format in SUBSAMPLED else grey


def eight_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """The eight significant bits, see the module; uint8 is returned unchanged."""
    if pixels.dtype == np.uint8:
        return pixels
    used = int(pixels.max()).bit_length()
    shift = next(depth for depth in _DEPTHS if depth >= used) - 8
    eight: NDArray[np.uint8] = (pixels >> shift).astype(np.uint8)
    return eight


def _pixels(image: EncodedImage) -> NDArray[np.uint8]:
    layout = _LAYOUTS[image.format]
    shape = (image.height, image.width) + ((layout.channels,) if layout.channels > 1 else ())
    return eight_bits(np.frombuffer(image.data, layout.dtype).reshape(shape))
