"""Converts `sensor_msgs/Image` and `CompressedImage` to images."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__CompressedImage as CompressedImage
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__Image as Image

from coec.adapters.frames.incoming import Refusal
from coec.adapters.images.codec import probe, raw_image
from coec.adapters.images.raw import BYTES_PER_PIXEL
from coec.calibration.types import EncodedImage, ImageFormat
from coec.config import LimitsConfig
from coec.errors import DecodeError

ENCODINGS: Final[dict[str, ImageFormat]] = {
    **{form.value: form for form in BYTES_PER_PIXEL},
    "8UC1": ImageFormat.MONO8,
    "8UC3": ImageFormat.BGR8,
    "8UC4": ImageFormat.BGRA8,
    "16UC1": ImageFormat.MONO16,
    "uyvy": ImageFormat.YUV422,
    "yuyv": ImageFormat.YUV422_YUY2,
}
"""`Image.encoding`: the names of sensor_msgs/image_encodings.hpp, and OpenCV's types. The latter do not say what the
channels mean, so that OpenCV's order is assumed."""

_DEEP: Final = tuple(name for name, form in ENCODINGS.items() if form.endswith("16"))
"""Encodings with two bytes per value."""

_VIDEO_FORMATS: Final = ("h264", "h265", "hevc", "av1", "vp8", "vp9")
"""Video codecs of ffmpeg_image_transport and others; a packet alone is no picture, as it needs those before it."""

_START_CODES: Final = (b"\0\0\0\1", b"\0\0\1")
"""Beginnings of a packet of H.264 or H.265 (ITU-T H.264, annex B)."""


def compressed_image(message: CompressedImage, limits: LimitsConfig) -> EncodedImage:
    """The image of a message. `format` is free text ("jpeg", "bgr8; jpeg compressed bgr8", "rgb8; png compressed "), so
    that the first bytes of the data decide. `format` only serves to refuse depth images and video with a clear message.

    Raises:
        DecodeError: `image_unknown_format`, or the reasons of `probe`.
    """
    text = message.format.lower()
    data = message.data.tobytes()
    if "compresseddepth" in text:
        raise DecodeError(
            Refusal.IMAGE_UNKNOWN_FORMAT,
            "a depth image (compressedDepth) is no camera's picture: take the topic that ends with /compressed",
        )
    if any(codec in text for codec in _VIDEO_FORMATS) or data.startswith(_START_CODES):
        raise DecodeError(
            Refusal.IMAGE_UNKNOWN_FORMAT,
            "packets of video (h264 and the like) are not read: take the camera's topic of JPEG or of raw pixels",
        )
    return probe(data, limits)


def raw_pixels(message: Image, limits: LimitsConfig) -> EncodedImage:
    """The image of a message, without row padding and with little-endian 16-bit values.

    Raises:
        DecodeError: `image_unknown_format`, `image_size_mismatch`, or the reasons of `raw_image`.
    """
    form = ENCODINGS.get(message.encoding)
    if form is None:
        raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, f"raw images must be one of {', '.join(ENCODINGS)}")
    row = message.width * BYTES_PER_PIXEL[form]
    if message.step < row or message.data.size < (message.height - 1) * message.step + row:
        raise DecodeError(
            Refusal.IMAGE_SIZE_MISMATCH,
            f"{message.height} rows of {row} bytes, {message.step} apart, do not fit into {message.data.size}",
        )
    pixels: NDArray[np.uint8] = message.data
    if message.step != row:
        pixels = np.lib.stride_tricks.as_strided(pixels, (message.height, row), (message.step, 1), writeable=False)
    else:
        pixels = pixels[: message.height * row]
    data = pixels.tobytes()
    if message.is_bigendian and message.encoding in _DEEP:
        data = np.frombuffer(data, np.uint16).byteswap().tobytes()
    return raw_image(form, message.width, message.height, data, limits)
