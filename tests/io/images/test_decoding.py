"""Images: what is refused by its bytes, what is decoded, and what sharpness says of real exposures."""

import contextlib
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, EncodedImage, ImageFormat
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.frame_validation import raw_image
from coec.io.images import (
    Inspector,
    decode_bgr,
    decode_depth,
    decode_grey_reduced,
    encode_depth_png,
    encode_jpeg,
    encode_png,
    probe,
)

LIMITS = LimitsConfig()
Encoder = Callable[[NDArray[np.uint8]], bytes]
SIGNATURE = b"\x89PNG\r\n\x1a\n"


def scene(height: int = 120, width: int = 160) -> NDArray[np.uint8]:
    """Smooth colours with a few rectangles, (height, width, 3)."""
    rng = np.random.default_rng(3)
    pixels = np.linspace(40, 200, height * width * 3).reshape(height, width, 3).astype(np.uint8)
    for _ in range(12):
        y, x = int(rng.integers(0, height - 20)), int(rng.integers(0, width - 20))
        pixels[y : y + 18, x : x + 14] = rng.integers(0, 256, 3)
    return pixels


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, rows: bytes, depth: int = 8, colour: int = 0) -> bytes:
    """A PNG packed by hand; `rows` are the uncompressed filtered rows."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return SIGNATURE + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")


def frame(image: EncodedImage) -> CameraFrame:
    return CameraFrame(stamp_ns=0, frame_id="camera", image=image)


def reason_of(data: bytes) -> str:
    with pytest.raises(DecodeError) as refused:
        probe(data, LIMITS)
    return refused.value.reason


# --- headers ------------------------------------------------------------------------------------------------


def test_a_png_packed_by_hand_is_read() -> None:
    image = probe(png(3, 2, b"\0\x01\x02\x03\0\x04\x05\x06"), LIMITS)

    assert (image.format, image.width, image.height) == (ImageFormat.PNG, 3, 2)
    assert decode_bgr(image, LIMITS)[:, :, 1].tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_is_read(progressive: int) -> None:
    ok, data = cv2.imencode(".jpg", scene(), [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])
    assert ok
    image = probe(data.tobytes(), LIMITS)

    assert (image.format, image.width, image.height) == (ImageFormat.JPEG, 160, 120)
    assert np.abs(decode_bgr(image, LIMITS).astype(int) - scene()).mean() < 5


def test_segments_before_the_frame_header_and_fill_bytes_are_walked() -> None:
    data = encode_jpeg(scene())
    # An EXIF segment whose thumbnail has a frame header and an end of its own, then fill bytes.
    thumbnail = b"Exif\0\0" + encode_jpeg(scene(40, 40))
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + b"\xff\xff" + data[2:]

    assert (probe(data, LIMITS).width, probe(data, LIMITS).height) == (160, 120)
    assert reason_of(data[: len(data) // 2 + len(thumbnail) // 2]) == "image_truncated"


@pytest.mark.fault("an image that was cut off on its way", "it is refused, never filled with grey")
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("encode", [encode_jpeg, encode_png])
def test_a_truncated_image_is_refused(encode: Encoder, share: float) -> None:
    data: bytes = encode(scene())

    assert reason_of(data[: int(share * len(data))]) == "image_truncated"
    # A buffer of fixed size whose rest was never written.
    assert reason_of(data[: int(share * len(data))] + b"\0" * 4096) == "image_truncated"


@pytest.mark.parametrize("encode", [encode_jpeg, encode_png])
def test_padding_behind_the_end_is_tolerated(encode: Encoder) -> None:
    image = probe(encode(scene()) + b"\0" * 1000, LIMITS)

    assert decode_bgr(image, LIMITS).shape == (120, 160, 3)


@pytest.mark.fault("a PNG of 48 kB that inflates to gigabytes", "it is refused by its header")
def test_a_small_png_that_would_inflate_to_gigabytes_is_refused_by_its_header(
    record_property: Callable[[str, object], None],
) -> None:
    bomb = SIGNATURE + chunk(b"IHDR", struct.pack(">IIBBBBB", 20_000, 20_000, 16, 6, 0, 0, 0))
    bomb += chunk(b"IDAT", zlib.compress(bytes(48_000_000), 9)) + chunk(b"IEND", b"")
    record_property("figure", f"{len(bomb)} bytes that claim {20_000 * 20_000 * 8 / 1e9:.1f} GB")
    assert len(bomb) < 50_000

    assert reason_of(bomb) == "image_too_large"
    with pytest.raises(DecodeError) as refused:  # also where a caller invented the description
        decode_bgr(EncodedImage(ImageFormat.PNG, 10, 10, bomb), LIMITS)
    assert refused.value.reason == "image_too_large"


def test_a_jpeg_that_claims_a_huge_size_is_refused() -> None:
    data = bytearray(encode_jpeg(scene()))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 65_500, 65_500)

    assert reason_of(bytes(data)) == "image_too_large"


@pytest.mark.fault(
    "a small JPEG of thousands of scans that keeps a decoder busy for hours", "it is refused before it is decoded"
)
@pytest.mark.parametrize("components", [2, 3])
def test_a_jpeg_of_many_scans_is_refused(components: int) -> None:
    """A progressive one, and one whose first scan does not hold all components."""
    data = with_many_scans(progressive=components == 3, components=components)

    assert reason_of(data) == "image_corrupt"


@pytest.mark.parametrize("appended", [b"", b"\xff\xda\x00\x02" * 200])
def test_of_a_jpeg_of_one_scan_no_other_is_read(appended: bytes) -> None:
    data = encode_jpeg(scene())

    image = probe(data[:-2] + appended + data[-2:], LIMITS)
    assert np.array_equal(decode_bgr(image, LIMITS), decode_bgr(probe(data, LIMITS), LIMITS))


def with_many_scans(*, progressive: bool, components: int) -> bytes:
    """A JPEG of three components, of which the first scan says that it holds so many."""
    parameters = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    data = bytearray(cv2.imencode(".jpg", scene(), parameters)[1].tobytes())
    data[data.index(b"\xff\xda") + 4] = components
    return bytes(data[:-2] + b"\xff\xda\x00\x02" * 200 + data[-2:])


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "image_truncated"),
        (b"\xff", "image_truncated"),
        (b"\xff\xd8", "image_truncated"),
        (b"\xff\xd8\xff", "image_truncated"),
        (SIGNATURE[:5], "image_truncated"),
        (SIGNATURE, "image_truncated"),
        (b"GIF89a" + bytes(50), "image_unknown_format"),
        (b"\xff\xd8" + b"\xff\xc3" + bytes(60), "image_unknown_format"),  # lossless
        (b"\xff\xd8" + b"\xff\xda" + bytes(60), "image_corrupt"),  # a scan without a frame
        (b"\xff\xd8" + b"\xff\xe0\x00\x00" * 9, "image_corrupt"),  # a segment of length 0
        (b"\xff\xd8" + b"\xff\xe0\x00\x02" * 600, "image_corrupt"),  # segments without end
        (b"\xff\xd8" + b"\xff" * 600, "image_corrupt"),
        (b"\xff\xd8" + bytes(60), "image_corrupt"),
        (SIGNATURE + chunk(b"IDAT", bytes(13)) + chunk(b"IEND", b""), "image_corrupt"),
        (png(0, 5, b""), "image_corrupt"),
        (b"\xff\xd8\xff\xc0\x00\x0b\x08\x00\x00\x00\x10\x01\x01\x11\x00\xff\xd9", "image_corrupt"),  # height 0
    ],
)
def test_broken_headers_are_refused_by_reason(data: bytes, reason: str) -> None:
    assert reason_of(data) == reason


def test_a_png_chunk_that_claims_more_than_there_is_costs_nothing() -> None:
    data = encode_png(scene())
    claim = struct.pack(">I", 2**31 - 1) + b"tEXt"

    assert reason_of(data[:33] + claim + data[33:]) == "image_truncated"


def test_a_png_of_very_many_chunks_and_an_animated_one_are_refused() -> None:
    data = encode_png(scene())

    assert reason_of(data[:33] + chunk(b"tEXt", b"") * 20_000 + data[33:]) == "image_corrupt"
    assert reason_of(data[:33] + chunk(b"acTL", bytes(8)) + data[33:]) == "image_unknown_format"


@pytest.mark.parametrize("damage", ["zeroed", "checksum"])
def test_a_png_with_damaged_rows_is_refused(damage: str) -> None:
    data = bytearray(encode_png(scene()))
    if damage == "zeroed":
        data[60:200] = bytes(140)
    else:
        data[-20] ^= 0xFF
    image = probe(bytes(data), LIMITS)

    with pytest.raises(DecodeError) as refused:
        decode_bgr(image, LIMITS)
    assert refused.value.reason == "image_corrupt"


@given(st.binary(max_size=200), st.sampled_from([b"", b"\xff\xd8", b"\xff\xd8\xff\xe0\x00\x04", SIGNATURE]))
def test_no_bytes_raise_anything_else(tail: bytes, head: bytes) -> None:
    with contextlib.suppress(DecodeError):
        probe(head + tail, LIMITS)


@pytest.mark.fault("flipped bits in an image", "a picture or a refusal with its reason")
@given(st.data())
def test_flipped_bits_raise_nothing_else(data: st.DataObject) -> None:
    whole = st.sampled_from([encode_jpeg(scene(24, 32)), encode_png(scene(24, 32))])
    flipped = bytearray(data.draw(whole))
    for at in data.draw(st.lists(st.integers(0, 8 * len(flipped) - 1), min_size=1, max_size=3)):
        flipped[at // 8] ^= 1 << at % 8
    with contextlib.suppress(DecodeError):
        image = probe(bytes(flipped), LimitsConfig(max_image_pixels=100_000))
        assert decode_bgr(image, LIMITS).shape == (image.height, image.width, 3)


# --- pixels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", [ImageFormat.BGR8, ImageFormat.RGB8, ImageFormat.MONO8])
def test_raw_pixels_come_out_in_opencv_order(form: ImageFormat) -> None:
    bgr = scene(25, 31)
    stored = {ImageFormat.BGR8: bgr, ImageFormat.RGB8: bgr[:, :, ::-1], ImageFormat.MONO8: bgr[:, :, 0]}[form]
    expected = np.repeat(bgr[:, :, :1], 3, axis=2) if form is ImageFormat.MONO8 else bgr

    assert np.array_equal(decode_bgr(raw_image(form, 31, 25, stored.tobytes(), LIMITS), LIMITS), expected)


@pytest.mark.parametrize("size", [34, 36, 0])
def test_raw_pixels_of_another_size_are_refused(size: int) -> None:
    with pytest.raises(DecodeError) as refused:
        raw_image(ImageFormat.MONO8, 7, 5, bytes(size), LIMITS)
    assert refused.value.reason == "image_size_mismatch"


def test_raw_pixels_beyond_the_limit_are_refused_whatever_they_hold() -> None:
    with pytest.raises(DecodeError) as refused:
        raw_image(ImageFormat.MONO8, 2**31, 2**31, b"", LIMITS)
    assert refused.value.reason == "image_too_large"


def test_an_orientation_in_exif_is_ignored() -> None:
    tiff = b"II*\0\x08\0\0\0" + struct.pack("<HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)  # rotate by 90 degrees
    body = b"Exif\0\0" + tiff
    data = encode_jpeg(scene())
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (160, 120, 3)  # type: ignore[union-attr]

    assert decode_bgr(probe(data, LIMITS), LIMITS).shape == (120, 160, 3)


@pytest.mark.parametrize("form", [ImageFormat.JPEG, ImageFormat.PNG, ImageFormat.BGR8, ImageFormat.MONO8])
def test_the_reduced_picture_is_half_as_wide_and_shows_the_same(form: ImageFormat) -> None:
    bgr = scene(121, 161)
    grey = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    image = {
        ImageFormat.JPEG: lambda: probe(encode_jpeg(bgr, 98), LIMITS),
        ImageFormat.PNG: lambda: probe(encode_png(bgr), LIMITS),
        ImageFormat.BGR8: lambda: raw_image(form, 161, 121, bgr.tobytes(), LIMITS),
        ImageFormat.MONO8: lambda: raw_image(form, 161, 121, grey.tobytes(), LIMITS),
    }[form]()

    reduced = decode_grey_reduced(image, LIMITS)

    assert abs(reduced.shape[0] - 60.5) <= 0.5
    assert abs(reduced.shape[1] - 80.5) <= 0.5
    assert abs(float(reduced.mean()) - float(grey.mean())) < 2


def test_depth_codes_come_back_exactly_and_zero_is_no_value() -> None:
    codes = np.array([[0, 1, 2], [257, 40_000, 65_535]], np.uint16)

    values = decode_depth(probe(encode_depth_png(codes), LIMITS), LIMITS)

    assert values.dtype == np.float32
    assert np.isnan(values[0, 0])
    assert values[~np.isnan(values)].tolist() == [1, 2, 257, 40_000, 65_535]


def test_depth_of_8_bits_packed_by_hand() -> None:
    values = decode_depth(probe(png(2, 1, b"\0\x07\x00"), LIMITS), LIMITS)

    assert values[0, 0] == 7
    assert np.isnan(values[0, 1])


@pytest.mark.parametrize("data", [encode_jpeg(scene()), encode_png(scene())])
def test_a_coloured_depth_map_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError) as refused:
        decode_depth(probe(data, LIMITS), LIMITS)
    assert refused.value.reason == "depth_not_grey"


# --- quality ------------------------------------------------------------------------------------------------


def test_exposure_and_digest() -> None:
    inspector = Inspector(LIMITS)
    black = raw_image(ImageFormat.MONO8, 100, 80, bytes(8000), LIMITS)
    half = raw_image(ImageFormat.MONO8, 100, 80, bytes(4000) + b"\x64" * 4000, LIMITS)

    dark, mixed = inspector.inspect(frame(black)), inspector.inspect(frame(half))

    assert (dark.sharpness, dark.mean_level, dark.clipped) == (0.0, 0.0, 1.0)
    assert (mixed.mean_level, mixed.clipped) == (50.0, 0.5)
    assert dark.digest != mixed.digest
    assert inspector.inspect(frame(half)).digest == mixed.digest


def test_sharpness_of_noise_is_one_and_a_blur_lowers_it() -> None:
    noise = np.random.default_rng(0).normal(128, 20, (60, 90)).astype(np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0)

    def sharpness(pixels: object) -> float:
        grey = np.asarray(pixels, np.uint8)
        height, width = grey.shape
        image = raw_image(ImageFormat.MONO8, width, height, grey.tobytes(), LIMITS)
        return Inspector(LIMITS).inspect(frame(image)).sharpness

    assert sharpness(noise) == pytest.approx(1.0, abs=0.05)
    assert sharpness(blurred) < 0.15
    assert sharpness(noise // 2 + 20) == pytest.approx(1.0, abs=0.06)  # contrast and brightness do not count


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (2, 2)])
def test_a_tiny_image_has_a_sharpness(shape: tuple[int, int]) -> None:
    pixels = np.arange(shape[0] * shape[1], dtype=np.uint8)
    image = raw_image(ImageFormat.MONO8, shape[1], shape[0], pixels.tobytes(), LIMITS)

    assert 0.0 <= Inspector(LIMITS).inspect(frame(image)).sharpness <= 2.0


REAL = [
    "kitti360/data_2d_raw/2013_05_28_drive_0000_sync/image_00/data_rect",
    "kitti_raw_2011_09_26/image_02/data",
    "fisheye_garage/images",
    "kitti360_fisheye",
]


@pytest.mark.parametrize("folder", REAL)
def test_real_exposures_are_sharp_until_they_are_blurred(sample_data: Path, folder: str) -> None:
    limit = 0.008  # the geometric middle of the dullest sharp exposure and the busiest blurred one
    inspector = Inspector(LIMITS)
    names = sorted((sample_data / folder).iterdir())
    exposures = [
        path for path in names if path.suffix in {".png", ".jpg"} and not path.stem.startswith(("mask", "range"))
    ]
    assert exposures

    for path in exposures[::3]:
        image = probe(path.read_bytes(), LIMITS)
        blurred = np.asarray(cv2.GaussianBlur(decode_bgr(image, LIMITS), (0, 0), 4.0), np.uint8)

        assert inspector.inspect(frame(image)).sharpness > limit, path.name
        assert inspector.inspect(frame(probe(encode_jpeg(blurred), LIMITS))).sharpness < limit, path.name
