"""Images in forms that frames do not have: NV12, NV21, deep colours, WebP and TIFF, in messages."""

from __future__ import annotations

import struct
from typing import Any

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
from coec.io.images import decode_bgr, decode_grey, is_order_swapped
from coec.io.ros import message_decoding, messages
from coec.io.ros.message_decoding import from_file
from support.ros import compressed_image
from support.ros import raw_image as raw_message

LIMITS = LimitsConfig(max_image_pixels=1_000_000)
WIDTH, HEIGHT = 64, 48


def a_picture() -> NDArray[np.uint8]:
    """(HEIGHT, WIDTH, 3) smooth colours with edges, in OpenCV's order."""
    rng = np.random.default_rng(5)
    small = rng.integers(30, 220, (6, 8, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def image_of(type_name: str, payload: bytes) -> EncodedImage:
    frame = message_decoding.decode(type_name, payload, LIMITS)
    assert isinstance(frame, CameraFrame)
    return frame.image


def semiplanar(encoding: str, padding: int = 0) -> bytes:
    """The picture by OpenCV's own planes of YUV 4:2:0."""
    planes = cv2.cvtColor(a_picture(), cv2.COLOR_BGR2YUV_I420)
    y, u, v = planes[:HEIGHT], planes[HEIGHT : HEIGHT * 5 // 4].ravel(), planes[HEIGHT * 5 // 4 :].ravel()
    pairs = np.stack([u, v] if encoding == "nv12" else [v, u], axis=1).reshape(HEIGHT // 2, WIDTH)
    rows = np.pad(np.concatenate([y, pairs]), ((0, 0), (0, padding)))
    return raw_message(encoding, WIDTH, HEIGHT, WIDTH + padding, rows.astype(np.uint8).tobytes())


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
@pytest.mark.parametrize("padding", [0, 16])
def test_semiplanar_images_are_what_opencv_makes_of_them(encoding: str, padding: int) -> None:
    image = image_of(messages.IMAGE, semiplanar(encoding, padding))
    planes = cv2.cvtColor(a_picture(), cv2.COLOR_BGR2YUV_I420)
    expected = cv2.cvtColor(planes, cv2.COLOR_YUV2BGR_I420)
    assert np.abs(decode_bgr(image, LIMITS).astype(int) - expected).max() <= 1
    # The brightness is that of the same picture as yuyv, to the bit.
    y = planes[:HEIGHT]
    yuyv = np.stack([y, np.full_like(y, 128)], axis=2).tobytes()
    grey = decode_grey(raw_image(ImageFormat.YUV422_YUY2, WIDTH, HEIGHT, yuyv, LIMITS), LIMITS)
    assert np.array_equal(decode_grey(image, LIMITS), grey)


@pytest.mark.parametrize(("encoding", "order"), [("rgb16", [2, 1, 0]), ("bgr16", [0, 1, 2]), ("16UC3", [0, 1, 2])])
@pytest.mark.parametrize("big", [False, True])
def test_deep_colours_keep_their_eight_significant_bits(encoding: str, order: list[int], big: bool) -> None:
    picture = a_picture()
    picture[0, 0] = 255
    deep = (picture[:, :, order].astype(np.uint16) << 8).astype(">u2" if big else "<u2")
    image = image_of(messages.IMAGE, raw_message(encoding, WIDTH, HEIGHT, 6 * WIDTH, deep.tobytes(), big=big))
    assert np.array_equal(decode_bgr(image, LIMITS), picture)


@pytest.mark.parametrize(("suffix", "options"), [(".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]), (".tiff", [])])
def test_webp_and_tiff_in_a_message(suffix: str, options: list[int]) -> None:
    ok, data = cv2.imencode(suffix, a_picture(), options)
    assert ok
    image = image_of(messages.COMPRESSED_IMAGE, compressed_image(data.tobytes(), suffix[1:]))
    assert np.array_equal(decode_bgr(image, LIMITS), a_picture())


def test_a_deep_grey_tiff() -> None:
    ok, data = cv2.imencode(".tiff", np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000)
    assert ok
    image = from_file(data.tobytes(), LIMITS)
    assert image is not None
    assert image.format is ImageFormat.MONO8
    assert decode_grey(image, LIMITS)[2, 3] == 55_000 >> 8


def tiff(width: int, height: int, *more: tuple[int, int, int]) -> bytes:
    entries = [(256, 4, width), (257, 4, height), *more]
    body = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4)


WEBP_X = b"RIFF\x16\0\0\0WEBPVP8X\x0a\0\0\0"


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (tiff(2**31, 2**31), "image_too_large"),
        (tiff(0, 5), "image_corrupt"),
        (tiff(8, 8), "image_corrupt"),
        (tiff(8, 8, (277, 3, 100)), "image_unknown_format"),
        (tiff(8, 8, (258, 3, 64)), "image_unknown_format"),
        (tiff(8, 8, (339, 3, 3)), "image_unknown_format"),
        (tiff(8, 8, (322, 3, 4096)), "image_unknown_format"),
        (b"II*\0\xff\xff\xff\xff", "image_truncated"),
        (b"II*\0\x08\0\0\0\xff\xff", "image_corrupt"),
        (b"MM\0*", "image_truncated"),
        (b"RIFF\0\0\0\0WEBP", "image_corrupt"),
        (b"RIFF\xff\0\0\0WEBPVP8 ", "image_truncated"),
        (WEBP_X + b"\0\0\0\0" + b"\xff" * 6, "image_too_large"),
        (WEBP_X + b"\2\0\0\0" + b"\7\0\0" * 2, "image_unknown_format"),
        (WEBP_X + b"\0\0\0\0" + b"\7\0\0" * 2, "image_corrupt"),
    ],
)
def test_files_that_lie_are_refused_by_reason(data: bytes, reason: str) -> None:
    with pytest.raises(DecodeError) as refused:
        from_file(data, LIMITS)
    assert refused.value.reason == reason


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (raw_message("nv12", 3, 2, 4, bytes(12)), "image_size_mismatch"),
        (raw_message("nv12", 4, 4, 4, bytes(23)), "image_size_mismatch"),
        (raw_message("nv21", 2**31, 2**31, 2**31, bytes(8)), "image_too_large"),
        (raw_message("rgb16", 4, 4, 12, bytes(96)), "image_size_mismatch"),
        (raw_message("bgr16", 0, 4, 0, bytes(96)), "image_corrupt"),
    ],
)
def test_raw_images_that_lie_are_refused_by_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(DecodeError) as refused:
        message_decoding.decode(messages.IMAGE, payload, LIMITS)
    assert refused.value.reason == reason


@given(st.sampled_from([".webp", ".tiff"]), st.data())
def test_no_mutation_of_a_file_raises_anything_else(suffix: str, data: st.DataObject) -> None:
    mutated = bytearray(cv2.imencode(suffix, np.full((8, 8, 3), 90, np.uint8))[1].tobytes())
    for _ in range(data.draw(st.integers(1, 4))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        from_file(bytes(mutated[: data.draw(st.integers(0, len(mutated)))]), LIMITS)
    except DecodeError:
        return


@pytest.mark.parametrize(("stated", "swapped"), [("yuv422_yuy2", False), ("yuv422", True)])
def test_the_other_order_of_yuv_is_recognised(stated: str, swapped: bool) -> None:
    yuyv: Any = cv2.cvtColor(a_picture(), cv2.COLOR_BGR2YUV_YUY2)
    rng = np.random.default_rng(2)
    yuyv[:, :, 0] = rng.integers(16, 235, yuyv.shape[:2])
    yuyv[:, :, 1] = 128 + rng.integers(-3, 4, yuyv.shape[:2])
    assert is_order_swapped(raw_image(ImageFormat(stated), WIDTH, HEIGHT, yuyv.tobytes(), LIMITS)) is swapped


def test_pictures_without_contrast_have_no_order() -> None:
    for form in (ImageFormat.YUV422, ImageFormat.YUV422_YUY2):
        assert not is_order_swapped(raw_image(form, WIDTH, HEIGHT, bytes([128]) * (2 * WIDTH * HEIGHT), LIMITS))
    assert not is_order_swapped(raw_image(ImageFormat.MONO8, WIDTH, HEIGHT, bytes(WIDTH * HEIGHT), LIMITS))
