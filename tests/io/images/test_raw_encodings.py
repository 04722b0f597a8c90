"""Raw pixels of cameras, to grey and colour: held to plain loops over the pixels."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, EncodedImage, ImageFormat
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.frame_validation import BYTES_PER_PIXEL, MOSAICS, raw_image
from coec.io.images import (
    CompressingReducer,
    Inspector,
    decode_bgr,
    decode_grey_reduced,
    eight_bits,
    encode_depth_png,
    encode_jpeg,
    probe,
)
from coec.io.images import decode_grey as grey_of

LIMITS = LimitsConfig()
H, W = 26, 38
RED, GREEN, BLUE = 0.299, 0.587, 0.114
"""Of grey (ITU-R BT.601)."""


def colours(seed: int = 2) -> NDArray[np.uint8]:
    """(H, W, 3) RGB."""
    return np.random.default_rng(seed).integers(0, 256, (H, W, 3)).astype(np.uint8)


def smooth() -> NDArray[np.float64]:
    """(H, W, 3) RGB that changes evenly over the picture, 0 to 255."""
    y, x = np.mgrid[0:H, 0:W]
    return np.stack([4 * x + 2 * y, 200 - 3 * x + y, 40 + x + 5 * y], axis=2).astype(np.float64)


def an_image(form: ImageFormat, pixels: NDArray[np.generic]) -> EncodedImage:
    return raw_image(form, W, H, pixels.tobytes(), LIMITS)


def mosaic_of(pattern: str, rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a sensor behind this pattern measures: plain loops."""
    raw = np.zeros((H, W))
    for y in range(H):
        for x in range(W):
            raw[y, x] = rgb[y, x, "rgb".index(pattern[2 * (y % 2) + x % 2])]
    return raw


def grey_by_hand(rgb: NDArray[np.generic]) -> NDArray[np.float64]:
    values = rgb.astype(np.float64)
    grey: NDArray[np.float64] = RED * values[:, :, 0] + GREEN * values[:, :, 1] + BLUE * values[:, :, 2]
    return grey


@pytest.mark.parametrize(
    ("form", "order"),
    [
        (ImageFormat.RGB8, [0, 1, 2]),
        (ImageFormat.BGR8, [2, 1, 0]),
        (ImageFormat.RGBA8, [0, 1, 2, 3]),
        (ImageFormat.BGRA8, [2, 1, 0, 3]),
    ],
)
def test_colour_in_any_order(form: ImageFormat, order: list[int]) -> None:
    rgb = colours()
    rgba = np.concatenate([rgb, np.full((H, W, 1), 7, np.uint8)], axis=2)

    image = an_image(form, rgba[:, :, order])

    assert np.array_equal(decode_bgr(image, LIMITS), rgb[:, :, ::-1])
    assert np.abs(grey_of(image, LIMITS) - grey_by_hand(rgb)).max() <= 1.0


@pytest.mark.parametrize("form", MOSAICS)
def test_in_a_mosaic_each_colour_is_what_its_own_pixels_measured(form: ImageFormat) -> None:
    """At its own sites a channel is the raw value; elsewhere it lies between its neighbours. Not at the rim."""
    pattern, deep = form.value[6:10], form.value.endswith("16")
    raw = np.random.default_rng(5).integers(0, 256, (H, W))
    sent = (raw.astype(np.uint16) << 8 | 0x5A).astype("<u2") if deep else raw.astype(np.uint8)

    bgr = decode_bgr(an_image(form, sent), LIMITS)

    for y in range(1, H - 1):
        for x in range(1, W - 1):
            own = "bgr".index(pattern[2 * (y % 2) + x % 2])
            assert bgr[y, x, own] == raw[y, x]


@pytest.mark.parametrize("form", MOSAICS)
def test_a_mosaic_of_an_even_picture_is_that_picture(form: ImageFormat) -> None:
    rgb, pattern = smooth(), form.value[6:10]
    raw = mosaic_of(pattern, rgb)
    image = an_image(form, (raw * 256).astype("<u2") if form.value.endswith("16") else raw.astype(np.uint8))

    inner = (slice(2, -2), slice(2, -2))
    assert np.abs(decode_bgr(image, LIMITS)[:, :, ::-1][inner] - rgb[inner]).max() <= 1.0
    assert np.abs(grey_of(image, LIMITS)[inner] - grey_by_hand(rgb)[inner]).max() <= 2.0


@pytest.mark.parametrize(("form", "luma_first"), [(ImageFormat.YUV422, False), (ImageFormat.YUV422_YUY2, True)])
def test_yuv_of_two_pixels_that_share_their_colour(form: ImageFormat, luma_first: bool) -> None:
    """By the formulas of ITU-R BT.601, pixel by pixel; OpenCV's have twelve bits."""
    rng = np.random.default_rng(9)
    luma, chroma = rng.integers(16, 236, (H, W)), rng.integers(90, 166, (H, W // 2, 2))
    sent = np.zeros((H, W, 2), np.uint8)
    expected = np.zeros((H, W, 3))
    for y in range(H):
        for x in range(W):
            sent[y, x] = (luma[y, x], chroma[y, x // 2, x % 2])[:: 1 if luma_first else -1]
            u, v = (float(value) - 128.0 for value in chroma[y, x // 2])
            level = (float(luma[y, x]) - 16) * 255 / 219
            expected[y, x] = level + 2.018 * u, level - 0.391 * u - 0.813 * v, level + 1.596 * v
    image = an_image(form, sent)

    assert np.abs(decode_bgr(image, LIMITS) - np.clip(expected, 0, 255)).max() <= 1.5
    assert np.abs(grey_of(image, LIMITS) - (luma - 16) * 255 / 219).max() <= 0.5


def test_black_and_white_of_yuv_are_black_and_white() -> None:
    """So a blinded camera is told as one: its level is 235."""
    white = np.full((H, W, 2), 128, np.uint8)
    white[:, :, 1] = 235

    quality = Inspector(LIMITS).inspect(CameraFrame(0, "camera", an_image(ImageFormat.YUV422, white)))

    assert (quality.mean_level, quality.clipped) == (255.0, 1.0)


@pytest.mark.parametrize(
    ("most", "at_top", "eight"),
    [(255, 0, 255), (1023, 0, 255), (4095, 0, 255), (4095, 4, 255), (16383, 0, 255), (65535, 0, 255), (700, 0, 175)],
)
def test_of_sixteen_bits_the_eight_that_count_are_taken(most: int, at_top: int, eight: int) -> None:
    """A camera of 10, 12 or 14 bits puts them at the bottom or at the top of the 16."""
    pixels = (np.linspace(0, most, H * W).astype("<u2") << at_top).reshape(H, W)

    grey = grey_of(an_image(ImageFormat.MONO16, pixels), LIMITS)

    assert int(grey.max()) == eight
    assert np.abs(grey - pixels / (2**at_top) * eight / most).max() <= 1.0
    assert np.array_equal(decode_bgr(an_image(ImageFormat.MONO16, pixels), LIMITS)[:, :, 1], grey)


def test_a_png_of_twelve_bits_in_sixteen_is_not_black() -> None:
    pixels = np.linspace(0, 4095, H * W).astype(np.uint16).reshape(H, W)
    image = probe(encode_depth_png(pixels), LIMITS)

    assert np.array_equal(grey_of(image, LIMITS), eight_bits(pixels))
    assert np.array_equal(decode_bgr(image, LIMITS)[:, :, 0], eight_bits(pixels))
    assert int(decode_grey_reduced(image, LIMITS).max()) >= 250


@pytest.mark.parametrize("form", BYTES_PER_PIXEL)
def test_every_raw_format_is_checked_in_half_and_in_full(form: ImageFormat) -> None:
    data = np.random.default_rng(1).bytes(100 * 80 * BYTES_PER_PIXEL[form])
    image = raw_image(form, 100, 80, data, LIMITS)

    grey, bgr, half = grey_of(image, LIMITS), decode_bgr(image, LIMITS), decode_grey_reduced(image, LIMITS)

    assert (grey.shape, bgr.shape, half.shape) == ((80, 100), (80, 100, 3), (40, 50))
    assert {grey.dtype, bgr.dtype, half.dtype} == {np.dtype(np.uint8)}
    assert grey.flags.writeable
    with pytest.raises(DecodeError):
        raw_image(form, 100, 80, data + b"\0", LIMITS)
    assert raw_image(form, 100, 80, data, LIMITS).data is data, "kept as it came"


@pytest.mark.parametrize("form", [ImageFormat.MONO8, ImageFormat.RGB8, ImageFormat.YUV422])
def test_raw_pixels_become_grey_jpeg_of_the_same_size(form: ImageFormat) -> None:
    flat = np.full(W * H * BYTES_PER_PIXEL[form], 90, np.uint8)
    some_depth = EncodedImage(ImageFormat.PNG, 1, 1, b"not looked at")
    frame = CameraFrame(7, "camera", raw_image(form, W, H, flat.tobytes(), LIMITS), 3, some_depth)
    small = CompressingReducer(LIMITS).reduced(frame)
    assert (small.stamp_ns, small.frame_id, small.sequence, small.depth) == (7, "camera", 3, None)
    assert small.image == probe(small.image.data, LIMITS)
    np.testing.assert_allclose(grey_of(small.image, LIMITS), grey_of(frame.image, LIMITS), atol=2)


def test_what_arrived_compressed_stays_to_the_byte() -> None:
    image = probe(encode_jpeg(colours()), LIMITS)
    assert CompressingReducer(LIMITS).reduced(CameraFrame(7, "camera", image, depth=image)) == CameraFrame(
        7, "camera", image
    )


def test_raw_pixels_of_another_size_cannot_be_compressed() -> None:
    image = EncodedImage(ImageFormat.MONO8, W, H, bytes(W * H - 1))
    with pytest.raises(DecodeError, match="pixels are"):
        CompressingReducer(LIMITS).reduced(CameraFrame(7, "camera", image))
