"""Images of ROS: every encoding and layout is kept as it came, what is no picture is refused by name."""

import numpy as np
import pytest

from coec.calibration.types import CameraFrame, EncodedImage, ImageFormat
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.frame_validation import BYTES_PER_PIXEL
from coec.io.images import encode_png
from coec.io.ros import message_decoding, message_encoding, messages
from coec.io.ros.message_decoding import ENCODINGS
from coec.schemas import frames
from support.ros import JPEG, compressed_image, raw_image

LIMITS = LimitsConfig()
WIDTH, HEIGHT = 6, 4


def decoded(type_name: str, payload: bytes) -> EncodedImage:
    frame = message_decoding.decode(type_name, payload, LIMITS)
    assert isinstance(frame, CameraFrame)
    return frame.image


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 1, 7])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_with_any_step_in_either_byte_order(encoding: str, padding: int, big: bool) -> None:
    form = ENCODINGS[encoding]
    row = WIDTH * BYTES_PER_PIXEL[form]
    pixels = np.random.default_rng(4).integers(0, 256, (HEIGHT, row)).astype(np.uint8)
    deep = form.endswith("16")
    sent = pixels.view(np.uint16).byteswap().view(np.uint8) if big and deep else pixels
    data = b"".join(line.tobytes() + b"\xaa" * padding for line in sent)

    got = decoded(messages.IMAGE, raw_image(encoding, WIDTH, HEIGHT, row + padding, data, big=big))

    assert got == EncodedImage(form, WIDTH, HEIGHT, pixels.tobytes())
    frame = CameraFrame(0, "camera", got)
    assert message_decoding.decode(*message_encoding.encode_image(frame), LIMITS) == frame, (
        "a window records it as it came"
    )


@pytest.mark.parametrize("encoding", ["32FC1", "nv24", "RGB8", "", "x" * 4000])
def test_other_encodings_are_refused_and_reported_what_is_read(encoding: str) -> None:
    with pytest.raises(DecodeError, match="must be one of mono8, ") as refused:
        decoded(messages.IMAGE, raw_image(encoding, 2, 2, 8, bytes(16)))

    assert refused.value.reason == "image_unknown_format"
    assert len(encoding) < 100 or encoding not in str(refused.value)


@pytest.mark.parametrize(
    "form",
    ["jpeg", "", "rgb8; jpeg compressed bgr8", "bgr8; jpeg compressed ", "mono8; jpeg compressed mono8", "JPEG", "png"],
)
def test_a_jpeg_is_one_whatever_it_is_called(form: str) -> None:
    assert decoded(messages.COMPRESSED_IMAGE, compressed_image(form=form)) == EncodedImage(
        ImageFormat.JPEG, 64, 48, JPEG
    )


@pytest.mark.parametrize("form", ["rgb8; png compressed bgr8", "png", "mono16; png compressed "])
def test_a_png_is_one_whatever_it_is_called(form: str) -> None:
    data = encode_png(np.zeros((5, 7), np.uint8))

    assert decoded(messages.COMPRESSED_IMAGE, compressed_image(data, form)) == EncodedImage(ImageFormat.PNG, 7, 5, data)


@pytest.mark.parametrize(
    ("data", "form", "named"),
    [
        (bytes(12) + encode_png(np.zeros((5, 7), np.uint8)), "16UC1; compressedDepth png", "compressedDepth"),
        (bytes(12), "32FC1; compressedDepth rvl", "compressedDepth"),
        (b"\0\0\0\1\x67\x42", "h264", r"H\.264"),
        (b"\0\0\1\x67\x42", "", r"H\.264"),
        (b"\x1a\x45\xdf\xa3", "hevc", r"H\.264"),
    ],
)
def test_what_is_no_picture_is_refused_by_name(data: bytes, form: str, named: str) -> None:
    with pytest.raises(DecodeError, match=named) as refused:
        decoded(messages.COMPRESSED_IMAGE, compressed_image(data, form))

    assert refused.value.reason == "image_unknown_format"


def test_native_frames_may_hold_every_format() -> None:
    assert set(frames.Image.model_json_schema()["properties"]["format"]["enum"]) == {form.value for form in ImageFormat}
