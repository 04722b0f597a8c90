"""Reads the header of a JPEG or PNG with bounds, before a decoder trusts it."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from coec.adapters.frames.incoming import Refusal
from coec.calibration.types import ImageFormat
from coec.errors import DecodeError

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
