"""Images: headers of JPEG and PNG are checked with bounds before OpenCV decodes them; raw pixels as cameras send them;
encoding; and the colours of ranges in pictures.

Frames keep the pixels as they came, because most are never used and a window records what the camera sent.

Of 16-bit pixels the eight significant bits are taken. A camera of 10, 12 or 14 bits puts its bits into 16 either at the
bottom or at the top, and does not say where. So the image is taken to have the smallest depth of 8, 10, 12, 14 and 16
bits that holds its largest value, and its highest bit becomes the highest of eight; a saturated pixel is white either
way. A dark image of 12 bits is read as one of 10 bits, four times as bright, which matters neither for edges nor for
depth.

`cv2.imdecode` allocates whatever a header asks for (a 48 kB PNG can take 2.3 GB), and libjpeg fills the missing part of
a truncated file with grey and says so only on stderr. Therefore size and completeness are checked here, on the bytes.

With the perceptual colour map plasma, ranges a quarter of the scale apart differ by at least 18 in CIELAB for every
kind of colour vision (Machado, Oliveira, Fernandes 2009: protanopia, deuteranopia, tritanopia). With turbo they differ
by 10, because a deuteranope cannot distinguish its red from its green. Viridis is as good as plasma, but its greens are
lost on trees.
"""

import hashlib
import struct
from dataclasses import dataclass
from math import floor, log10
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, EncodedImage, ImageFormat, ImageQuality
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.frame_validation import BYTES_PER_PIXEL, SUBSAMPLED, Refusal, check_image_size, raw_image

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = 33  # bytes: signature and IHDR
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_JPEG_SCAN = b"\xff\xda"
# Markers of ITU-T T.81, table B.1.
_SOF = (0xC0, 0xC1, 0xC2)  # baseline, extended, progressive; Huffman
_PROGRESSIVE = 0xC2
_TABLES = (0xC4, 0xDB, 0xDD, *range(0xE0, 0xF0), 0xFE)  # DHT, DQT, DRI, APPn, COM: may come before a scan
_OTHER_SOF = (0xC3, *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0))  # lossless, differential, arithmetic
_STANDALONE = (0x01, *range(0xD0, 0xD9))  # TEM, RST0-7, SOI: markers without a length

_MAX_SEGMENTS = 512
"""Most segments before the frame header of a JPEG. Cameras write about ten; EXIF and a colour profile may take 64."""

_MAX_SCANS = 100
"""Most scans of a progressive JPEG. Encoders write about ten. Each scan costs a pass over the whole image, however few
bytes it has, so that a small file with many scans can occupy a decoder for hours."""

_MAX_CHUNKS = 16_384
"""Most chunks of a PNG. Encoders write one for each 8 KiB of data: 4,096 in the largest message (32 MiB)."""


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """Format and size in pixels; `body` is the offset of the first byte behind the header.

    Attributes:
        components: number of components of a JPEG that is not progressive; 0 for all other images.
    """

    format: ImageFormat
    width: int
    height: int
    body: int
    components: int = 0


def read_header(data: bytes) -> ImageHeader:
    """Format and size of a JPEG or PNG.

    Raises:
        DecodeError: `image_unknown_format`, `image_truncated` or `image_corrupt`.
    """
    if data.startswith(_JPEG_START):
        return _jpeg_header(data)
    if data.startswith(_PNG_SIGNATURE):
        return _png_header(data)
    if _PNG_SIGNATURE.startswith(data[:8]) or _JPEG_START.startswith(data[:2]):
        raise DecodeError(Refusal.IMAGE_TRUNCATED, f"the image ends after {len(data)} bytes")
    raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, "the image is neither JPEG nor PNG")


def check_body(header: ImageHeader, data: bytes) -> None:
    """Checks that the file is complete and does not make the decoder work for more than the file holds.

    Bytes that a driver appends behind the end, such as padding to the size of its buffer, do no harm.

    Raises:
        DecodeError: `image_truncated`, `image_corrupt` or `image_unknown_format`.
    """
    if header.format is ImageFormat.PNG:
        _check_png_chunks(data, header.body)
        return
    if not _is_one_scan(header, data) and _count_scans(data) > _MAX_SCANS:
        raise DecodeError(Refusal.IMAGE_CORRUPT, f"the JPEG has more than {_MAX_SCANS} scans")
    # Entropy-coded data cannot contain the end marker, and that of a thumbnail comes before the frame header.
    if data.rfind(_JPEG_END, header.body) < 0:
        raise DecodeError(Refusal.IMAGE_TRUNCATED, "the JPEG has no end marker: it was cut off")


def _is_one_scan(header: ImageHeader, data: bytes) -> bool:
    """Whether the first scan of a JPEG holds all components; then a decoder reads no other (libjpeg, jdinput.c). This
    is so for nearly every camera, and saves counting the scans."""
    at = header.body
    for _ in range(_MAX_SEGMENTS if header.components else 0):
        if at + 5 > len(data) or data[at] != 0xFF:
            return False
        if data[at + 1] == _JPEG_SCAN[1]:
            return data[at + 4] == header.components
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] not in _TABLES or length < 2:
            return False
        at += 2 + length
    return False


def _count_scans(data: bytes) -> int:
    """Number of scan markers, as `data.count` gives it, in a tenth of its time: it compares 16-bit words, once from
    even and once from odd offsets."""
    marker = np.frombuffer(_JPEG_SCAN, np.uint16)
    halves = (np.frombuffer(data, np.uint16, (len(data) - odd) // 2, odd) for odd in (0, 1))
    return sum(int(np.count_nonzero(half == marker)) for half in halves)


def _png_header(data: bytes) -> ImageHeader:
    """IHDR, which the specification puts first (PNG, 3rd edition, 5.6)."""
    if len(data) < _PNG_HEADER:
        raise DecodeError(Refusal.IMAGE_TRUNCATED, "the PNG ends within its header")
    length, kind, width, height = struct.unpack_from(">I4sII", data, 8)
    if length != 13 or kind != b"IHDR":
        raise DecodeError(Refusal.IMAGE_CORRUPT, "the PNG does not start with IHDR")
    return ImageHeader(ImageFormat.PNG, width, height, _PNG_HEADER)


def _check_png_chunks(data: bytes, at: int) -> None:
    """Checks the chunk lengths, because OpenCV's reader allocates what a chunk claims (up to 2 GiB) before it reads."""
    for _ in range(_MAX_CHUNKS):
        if at + 12 > len(data):
            raise DecodeError(Refusal.IMAGE_TRUNCATED, "the PNG has no end: it was cut off")
        length, kind = struct.unpack_from(">I4s", data, at)
        at += 12 + length
        if kind == bytes(4) or at > len(data):
            raise DecodeError(Refusal.IMAGE_TRUNCATED, "the PNG has no end: it was cut off")
        if kind == b"IEND":
            return
        if kind == b"acTL":
            raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, "animated PNGs are not read")
    raise DecodeError(Refusal.IMAGE_CORRUPT, f"the PNG has more than {_MAX_CHUNKS} chunks")


def _jpeg_header(data: bytes) -> ImageHeader:
    """The frame header, behind the segments before it (ITU-T T.81, B.1.1 and B.2.2)."""
    at = 2
    for _ in range(_MAX_SEGMENTS):
        if at + 4 > len(data):
            raise DecodeError(Refusal.IMAGE_TRUNCATED, "the JPEG ends before its frame header")
        if data[at] != 0xFF:
            raise DecodeError(Refusal.IMAGE_CORRUPT, "the JPEG has bytes between its segments")
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in _STANDALONE:
            at += 2
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if marker in _SOF:
            if at + 10 > len(data):
                raise DecodeError(Refusal.IMAGE_TRUNCATED, "the JPEG ends within its frame header")
            height, width = struct.unpack_from(">HH", data, at + 5)
            components = 0 if marker == _PROGRESSIVE else data[at + 9]
            return ImageHeader(ImageFormat.JPEG, width, height, at + 2 + length, components)
        if marker in _OTHER_SOF:
            raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, "of JPEGs, only baseline and progressive ones are read")
        if length < 2 or marker in (0x00, 0xD9, 0xDA):  # end of image or a scan without a frame
            raise DecodeError(Refusal.IMAGE_CORRUPT, "the JPEG has no frame header")
        at += 2 + length
    raise DecodeError(Refusal.IMAGE_CORRUPT, f"the JPEG has no frame header within {_MAX_SEGMENTS} segments")


_DEPTHS: Final = (8, 10, 12, 14, 16)
"""Bits per pixel of image sensors."""

_BLACK, _WHITE = 16, 235
"""Luma of black and white in YUV (ITU-R BT.601), as in OpenCV's conversions to colour."""

_LUMA: Final = np.clip(np.rint((np.arange(256) - _BLACK) * (255 / (_WHITE - _BLACK))), 0, 255).astype(np.uint8)


@dataclass(frozen=True, slots=True)
class _Layout:
    """Layout of one format: type of a channel; OpenCV's conversions, None if nothing is to convert."""

    dtype: np.dtype[Any]
    to_bgr: int | None
    to_grey: int | None


_U8, _U16 = np.dtype("u1"), np.dtype("<u2")

_LAYOUTS: Final[dict[ImageFormat, _Layout]] = {
    ImageFormat.MONO8: _Layout(_U8, cv2.COLOR_GRAY2BGR, None),
    ImageFormat.MONO16: _Layout(_U16, cv2.COLOR_GRAY2BGR, None),
    ImageFormat.RGB8: _Layout(_U8, cv2.COLOR_RGB2BGR, cv2.COLOR_RGB2GRAY),
    ImageFormat.BGR8: _Layout(_U8, None, cv2.COLOR_BGR2GRAY),
    ImageFormat.RGBA8: _Layout(_U8, cv2.COLOR_RGBA2BGR, cv2.COLOR_RGBA2GRAY),
    ImageFormat.BGRA8: _Layout(_U8, cv2.COLOR_BGRA2BGR, cv2.COLOR_BGRA2GRAY),
    # Named by the first four pixels, as ROS does; OpenCV's older names (BayerBG for RGGB) begin elsewhere.
    ImageFormat.BAYER_RGGB8: _Layout(_U8, cv2.COLOR_BayerRGGB2BGR, cv2.COLOR_BayerRGGB2GRAY),
    ImageFormat.BAYER_BGGR8: _Layout(_U8, cv2.COLOR_BayerBGGR2BGR, cv2.COLOR_BayerBGGR2GRAY),
    ImageFormat.BAYER_GBRG8: _Layout(_U8, cv2.COLOR_BayerGBRG2BGR, cv2.COLOR_BayerGBRG2GRAY),
    ImageFormat.BAYER_GRBG8: _Layout(_U8, cv2.COLOR_BayerGRBG2BGR, cv2.COLOR_BayerGRBG2GRAY),
    ImageFormat.BAYER_RGGB16: _Layout(_U16, cv2.COLOR_BayerRGGB2BGR, cv2.COLOR_BayerRGGB2GRAY),
    ImageFormat.BAYER_BGGR16: _Layout(_U16, cv2.COLOR_BayerBGGR2BGR, cv2.COLOR_BayerBGGR2GRAY),
    ImageFormat.BAYER_GBRG16: _Layout(_U16, cv2.COLOR_BayerGBRG2BGR, cv2.COLOR_BayerGBRG2GRAY),
    ImageFormat.BAYER_GRBG16: _Layout(_U16, cv2.COLOR_BayerGRBG2BGR, cv2.COLOR_BayerGRBG2GRAY),
    ImageFormat.YUV422: _Layout(_U8, cv2.COLOR_YUV2BGR_UYVY, cv2.COLOR_YUV2GRAY_UYVY),
    ImageFormat.YUV422_YUY2: _Layout(_U8, cv2.COLOR_YUV2BGR_YUY2, cv2.COLOR_YUV2GRAY_YUY2),
}


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


SWAPPED = 2.0
"""How many times the bytes that count as colour have to change more from pixel to pixel than those that count as
brightness. In pictures they change less, because eyes and cameras resolve colour less."""


def is_order_swapped(image: EncodedImage) -> bool:
    """Whether the bytes of YUV 4:2:2 stand in the other order than the format says: what counts as colour carries the
    picture. False for other formats, and for pictures without contrast."""
    if image.format not in SUBSAMPLED:
        return False
    pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 2).astype(np.int16)
    luma = 1 if image.format is ImageFormat.YUV422 else 0
    brightness, colour = pixels[:, :, luma], pixels[:, :, 1 - luma]
    # Colours alternate between U and V, so that every second one is compared.
    changes = [float(np.abs(np.diff(plane[:, ::2], axis=1)).mean()) for plane in (brightness, colour)]
    return changes[1] > max(SWAPPED * changes[0], 1.0)


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
    channels = BYTES_PER_PIXEL[image.format] // layout.dtype.itemsize
    shape = (image.height, image.width) + ((channels,) if channels > 1 else ())
    return eight_bits(np.frombuffer(image.data, layout.dtype).reshape(shape))


_REDUCE_FROM_PX = 64
"""Smaller images are judged at full size, because at half size too few gradients would be left for a mean."""


# --- before pixels -----------------------------------------------------------------------------------------


def probe(data: bytes, limits: LimitsConfig) -> EncodedImage:
    """Reads format and size from the header of a JPEG or PNG and checks that the file is complete. Decodes nothing.

    Raises:
        DecodeError: `image_unknown_format`, `image_truncated`, `image_too_large` or `image_corrupt`.
    """
    header = read_header(data)
    check_image_size(header.width, header.height, limits)
    check_body(header, data)
    return EncodedImage(format=header.format, width=header.width, height=header.height, data=data)


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
        raise DecodeError(Refusal.IMAGE_SIZE_MISMATCH, "the image does not match its description")
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
    """Implements `ImageReader`."""

    def __init__(self, limits: LimitsConfig) -> None:
        self._limits = limits

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values.

        Raises:
            DecodeError: the reasons of `probe` and `raw_image`.
        """
        return decode_grey(frame.image, self._limits)


class CompressingReducer:
    """Implements `ImageReducer`. Compressed images stay as they are. Raw pixels become a grey JPEG with a tenth
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
    """Keeps the grey images of the last frames, for solving one window many times. Implements `ImageReader`."""

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
    """Implements `ImageInspector`.

    Sharpness is the mean squared difference between neighbours, over both directions, divided by twice the variance of
    the grey values, on the image at half size: 0 for a uniform image, 1 for white noise. It does not change with
    brightness or contrast, falls with blur, and varies with the scene by a factor of about five. The image is not
    reduced further, because at an eighth of the size sharp and blurred exposures overlap. See docs/measured.md.
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


NEAREST_M, FURTHEST_M = 2.0, 80.0
"""Ranges that the objective uses, metres."""

DARKEST = 0.1
"""Place in the colour map where far ranges end; below it colours are nearly black."""

ROBUST = (0.02, 0.98)
"""Quantiles of the ranges in view between which the colours change, so that a bird or a church tower uses up no
colours."""

LEAST_RATIO = 4.0
"""Least ratio of the far end to the near end, so that a wall has one colour instead of a rainbow of its noise."""

SCALE_SAMPLES = 4096
"""Approximate number of ranges from which the quantiles are taken."""

SCALE_STEPS = (1.0, 2.0, 5.0)
"""Ends and labels of scales are these numbers, times powers of ten."""

TURNED_STEPS = 2
"""A scale changes only if an end of the fitting scale is at least this many steps away; with one step it would
flicker."""


@dataclass(frozen=True, slots=True)
class RangeScale:
    """A logarithmic scale of ranges between two ends, metres."""

    nearest_m: float
    furthest_m: float

    def share_of(self, range_m: NDArray[np.floating] | float) -> NDArray[np.float64]:
        """Place on the scale, 0 at the near end and 1 at the far one, of ranges in metres."""
        clipped = np.clip(range_m, self.nearest_m, self.furthest_m)
        return np.asarray(np.log(clipped / self.nearest_m) / np.log(self.furthest_m / self.nearest_m), dtype=np.float64)

    def range_at(self, share: NDArray[np.floating]) -> NDArray[np.float64]:
        """Ranges (N,) at places (N,) on the scale, metres."""
        return np.asarray(self.nearest_m * (self.furthest_m / self.nearest_m) ** share, dtype=np.float64)

    def colours_bgr(self, range_m: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Colours (N, 3) of ranges (N,), metres."""
        level = np.rint(255 * (1.0 - (1.0 - DARKEST) * self.share_of(range_m))).astype(np.uint8)
        return np.asarray(_PLASMA[level], dtype=np.uint8)

    def ticks_m(self) -> tuple[float, ...]:
        """Round ranges from end to end."""
        first, last = _step(self.nearest_m), _step(self.furthest_m)
        return tuple(_of_step(step) for step in range(first, last + 1))


WHOLE_SCALE = RangeScale(NEAREST_M, FURTHEST_M)
"""The scale over all ranges that the objective uses."""


def scale_of(range_m: NDArray[np.floating]) -> RangeScale:
    """The scale of a scene: from the nearest to the furthest of its ranges (N,), without a few outliers, at round
    steps; `WHOLE` if there are no ranges. Points nearer than `NEAREST_M` are on the vehicle itself and not drawn."""
    # Some thousand points give good enough quantiles in a tenth of the time.
    thinned = np.asarray(range_m[:: max(1, len(range_m) // SCALE_SAMPLES)], dtype=np.float64)
    thinned = thinned[thinned >= NEAREST_M]
    if len(thinned) == 0:
        return WHOLE_SCALE
    near_m, far_m = np.quantile(thinned, ROBUST).tolist()
    nearest = furthest = _step(near_m)
    while _of_step(furthest) < far_m or _of_step(furthest) < LEAST_RATIO * _of_step(nearest):
        furthest += 1
    return RangeScale(_of_step(nearest), _of_step(furthest))


def stable_scale(latest: RangeScale | None, fitting: RangeScale) -> RangeScale:
    """The scale of the latest picture if it is still good enough, else the one that fits this picture, so that the
    pictures of a drive keep their colours."""
    if latest is None:
        return fitting
    ends = ((latest.nearest_m, fitting.nearest_m), (latest.furthest_m, fitting.furthest_m))
    return fitting if any(abs(_step(a) - _step(b)) >= TURNED_STEPS for a, b in ends) else latest


def _step(range_m: float) -> int:
    """The number of the largest step that is not above a range: 0 is 1 m, 3 is 10 m."""
    decade = floor(log10(range_m) + 1e-9)
    return 3 * decade + sum(10.0**decade * step <= range_m * (1 + 1e-9) for step in SCALE_STEPS) - 1


def _of_step(number: int) -> float:
    decade, which = divmod(number, len(SCALE_STEPS))
    return float(SCALE_STEPS[which] * 10.0**decade)


_PLASMA = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_PLASMA)).reshape(
    -1, 3
)
