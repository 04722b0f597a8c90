"""Decodes and encodes images with OpenCV, but only after reading the header and accepting the size.

`cv2.imdecode` allocates whatever a header asks for (a 48 kB PNG can take 2.3 GB), and libjpeg fills the missing part of
a truncated file with grey and says so only on stderr. Therefore size and completeness are checked here, on the bytes.
"""

from __future__ import annotations

import hashlib

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.adapters.frames.incoming import Refusal
from coec.adapters.images.headers import check_body, read_header
from coec.adapters.images.raw import BYTES_PER_PIXEL, MOSAICS, SUBSAMPLED, bgr_of, eight_bits, grey_of
from coec.calibration.types import CameraFrame, EncodedImage, ImageFormat, ImageQuality
from coec.config import LimitsConfig
from coec.errors import DecodeError

_MOSAIC_PX = 4
"""Least side of a mosaic: two pixels of each colour, so that colours can be interpolated between them."""

_REDUCE_FROM_PX = 64
"""Smaller images are judged at full size, because at half size too few gradients would be left for a mean."""


# --- before pixels -----------------------------------------------------------------------------------------


def probe(data: bytes, limits: LimitsConfig) -> EncodedImage:
    """Reads format and size from the header of a JPEG or PNG and checks that the file is complete. Decodes nothing.

    Raises:
        DecodeError: `image_unknown_format`, `image_truncated`, `image_too_large` or `image_corrupt`.
    """
    header = read_header(data)
    _check_size(header.width, header.height, limits)
    check_body(header, data)
    return EncodedImage(format=header.format, width=header.width, height=header.height, data=data)


def raw_image(form: ImageFormat, width: int, height: int, data: bytes, limits: LimitsConfig) -> EncodedImage:
    """Rows of raw pixels without padding, `height × width × BYTES_PER_PIXEL` bytes.

    Raises:
        DecodeError: `image_too_large` or `image_size_mismatch`.
    """
    _check_size(width, height, limits)
    if (form in SUBSAMPLED and width % 2) or (form in MOSAICS and min(width, height) < _MOSAIC_PX):
        raise DecodeError(Refusal.IMAGE_SIZE_MISMATCH, f"{form} pixels come in pairs, not as {width}×{height}")
    expected = width * height * BYTES_PER_PIXEL[form]
    if len(data) != expected:
        raise DecodeError(
            Refusal.IMAGE_SIZE_MISMATCH,
            f"{width}×{height} {form} pixels are {expected} bytes, not {len(data)}",
        )
    return EncodedImage(format=form, width=width, height=height, data=data)


def _check_size(width: int, height: int, limits: LimitsConfig) -> None:
    if width < 1 or height < 1:
        raise DecodeError(Refusal.IMAGE_CORRUPT, f"the image claims to be {width}×{height} pixels")
    if width * height > limits.max_image_pixels:
        raise DecodeError(
            Refusal.IMAGE_TOO_LARGE,
            f"the image claims {width}×{height} pixels; limits.max_image_pixels is {limits.max_image_pixels}",
        )


# --- pixels -------------------------------------------------------------------------------------------------


def decode_bgr(image: EncodedImage, limits: LimitsConfig) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 in OpenCV's order. An EXIF orientation is ignored, because the camera model describes
    the pixels as the sensor read them out.

    Raises:
        DecodeError: the reasons of `probe` and `raw_image`.
    """
    if image.format in BYTES_PER_PIXEL:
        return bgr_of(_checked(image, limits))
    pixels = eight_bits(_imdecode(image, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH, limits))
    return _expect(pixels, (image.height, image.width, 3))


def decode_grey(image: EncodedImage, limits: LimitsConfig) -> NDArray[np.uint8]:
    """(height, width) uint8 grey.

    Raises:
        DecodeError: the reasons of `probe` and `raw_image`.
    """
    if image.format in BYTES_PER_PIXEL:
        return grey_of(_checked(image, limits))
    pixels = eight_bits(_imdecode(image, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH, limits))
    return _expect(pixels, (image.height, image.width))


def decode_grey_reduced(image: EncodedImage, limits: LimitsConfig) -> NDArray[np.uint8]:
    """(about height/2, about width/2) uint8 grey; images with a side below 64 px keep their size.

    Raises:
        DecodeError: the reasons of `probe` and `raw_image`.
    """
    if min(image.width, image.height) < _REDUCE_FROM_PX:
        return decode_grey(image, limits)
    if image.format is ImageFormat.JPEG:
        return _imdecode(image, cv2.IMREAD_REDUCED_GRAYSCALE_2, limits)
    size = ((image.width + 1) // 2, (image.height + 1) // 2)
    return np.asarray(cv2.resize(decode_grey(image, limits), size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def decode_depth(image: EncodedImage, limits: LimitsConfig) -> NDArray[np.float32]:
    """(height, width) float32: the codes of an 8- or 16-bit grey PNG unchanged, NaN for 0 (no value).

    Raises:
        DecodeError: `depth_not_grey`, or the reasons of `probe`.
    """
    # Byte 25 of a PNG is its colour type; 0 is grey without palette and alpha.
    if image.format is not ImageFormat.PNG or image.data[25:26] != b"\0":
        raise DecodeError(Refusal.DEPTH_NOT_GREY, "a depth map must be a PNG with one grey channel of 8 or 16 bits")
    codes = _imdecode(image, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH, limits)
    values = _expect(codes, (image.height, image.width)).astype(np.float32)
    values[values == 0] = np.nan
    return values


def encode_depth_png(codes: NDArray[np.uint16]) -> bytes:
    """A 16-bit grey PNG of (h, w) codes, 0 = no value."""
    ok, data = cv2.imencode(".png", codes)
    if not ok or codes.dtype != np.uint16 or codes.ndim != 2:
        raise ValueError(f"a depth map must be (h, w) uint16, not {codes.shape} {codes.dtype}")
    return data.tobytes()


def encode_jpeg(bgr: NDArray[np.uint8], quality: int = 90) -> bytes:
    """A baseline JPEG of (h, w, 3) or (h, w) uint8 pixels; `quality` from 1 to 100."""
    ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"cannot encode {bgr.shape} {bgr.dtype} as JPEG")
    return data.tobytes()


def encode_png(pixels: NDArray[np.uint8]) -> bytes:
    """A PNG of (h, w, 3) BGR or (h, w) grey uint8 pixels."""
    ok, data = cv2.imencode(".png", pixels)
    if not ok:
        raise ValueError(f"cannot encode {pixels.shape} {pixels.dtype} as PNG")
    return data.tobytes()


def _imdecode(image: EncodedImage, mode: int, limits: LimitsConfig) -> NDArray[np.uint8]:
    # The header is read again here, so that no caller can pass bytes whose size was not checked.
    header = probe(image.data, limits)
    if (header.format, header.width, header.height) != (image.format, image.width, image.height):
        raise DecodeError(Refusal.IMAGE_SIZE_MISMATCH, "the image is not what its description says")
    try:
        pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), mode | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise DecodeError(Refusal.IMAGE_CORRUPT, f"the {image.format} cannot be decoded") from error
    if pixels is None:
        raise DecodeError(Refusal.IMAGE_CORRUPT, f"the {image.format} cannot be decoded")
    return pixels  # type: ignore[return-value]  # annotated as any of OpenCV's pixel types


def _expect(pixels: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    if pixels.shape != shape:
        raise DecodeError(Refusal.IMAGE_CORRUPT, f"decoded to {pixels.shape}, the header says {shape}")
    return pixels


def _checked(image: EncodedImage, limits: LimitsConfig) -> EncodedImage:
    return raw_image(image.format, image.width, image.height, image.data, limits)


# --- quality ------------------------------------------------------------------------------------------------


class GreyImages:
    """Implements `ports.ImageReader`."""

    def __init__(self, limits: LimitsConfig) -> None:
        self._limits = limits

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values.

        Raises:
            DecodeError: the reasons of `probe` and `raw_image`.
        """
        return decode_grey(frame.image, self._limits)


class CompressingReducer:
    """Implements `ports.ImageReducer`. Compressed images stay as they are. Raw pixels become a grey JPEG with a tenth
    to a thirtieth of their bytes, which takes 10 ms of a core per megapixel."""

    def __init__(self, limits: LimitsConfig) -> None:
        self._limits = limits

    def reduced(self, frame: CameraFrame) -> CameraFrame:
        """The frame without its depth map and with its image compressed.

        Raises:
            DecodeError: the reasons of `raw_image`.
        """
        image = frame.image
        if image.format in BYTES_PER_PIXEL:
            data = encode_jpeg(decode_grey(image, self._limits))
            image = EncodedImage(ImageFormat.JPEG, image.width, image.height, data)
        return CameraFrame(frame.stamp_ns, frame.frame_id, image, frame.sequence)


class CachedGreys:
    """Keeps the grey images of the last frames, for solving one window many times. Implements `ports.ImageReader`."""

    def __init__(self, reader: GreyImages, entries: int) -> None:
        self._reader = reader
        self._entries = entries
        self._greys: dict[bytes, NDArray[np.uint8]] = {}

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values.

        Raises:
            DecodeError: the reasons of `probe` and `raw_image`.
        """
        digest = hashlib.sha256(frame.image.data).digest()
        if digest not in self._greys:
            if len(self._greys) == self._entries:
                del self._greys[next(iter(self._greys))]
            self._greys[digest] = self._reader.grey(frame)
        return self._greys[digest]


class Inspector:
    """Implements `ports.ImageInspector`.

    Sharpness is the mean squared difference between neighbours, over both directions, divided by twice the variance of
    the grey values, on the image at half size: 0 for a uniform image, 1 for white noise. It does not change with
    brightness or contrast, falls with blur, and varies with the scene by a factor of about five. On real exposures
    (KITTI-360, KITTI, a garage, a raw 180° fisheye with its black rim) it is 0.011 to 0.057 as recorded, and 0.002 to
    0.0055 after a Gaussian blur of 4 px, which removes the finest edges. At an eighth of the size the two ranges
    overlap (0.07 to 0.21 against 0.02 to 0.07), which is why the image is not reduced further.
    """

    def __init__(self, limits: LimitsConfig) -> None:
        self._limits = limits

    def inspect(self, frame: CameraFrame) -> ImageQuality:
        """Sharpness and exposure of the frame; reads every pixel once and keeps none.

        Raises:
            DecodeError: the reasons of `probe` and `raw_image`.
        """
        grey = decode_grey_reduced(frame.image, self._limits)
        digest = hashlib.blake2b(grey.tobytes(), digest_size=8).digest()
        return ImageQuality(
            sharpness=_sharpness(grey),
            mean_level=float(grey.mean()),
            clipped=float(((grey <= 2) | (grey >= 253)).mean()),
            digest=int.from_bytes(digest, "little"),
        )


def _sharpness(grey: NDArray[np.uint8]) -> float:
    variance = float(grey.var(dtype=np.float64))
    if variance == 0.0 or min(grey.shape) < 2:
        return 0.0
    levels = grey.astype(np.int32)
    across = float(np.square(np.diff(levels, axis=1)).mean())
    down = float(np.square(np.diff(levels, axis=0)).mean())
    return (across + down) / (4.0 * variance)
