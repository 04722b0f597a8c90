"""Decodes ROS 2 messages in CDR to frames: images, clouds, and ego-motion from messages with a velocity. Images in
forms that frames do not have are converted without loss of what is used: NV12 and NV21 to YUV 4:2:2, colours of 16
bits to eight, WebP and TIFF to raw pixels.

Every length in a message is only a claim of the sender, so that it is checked before a decoder builds anything from
it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_humble as ros
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__CompressedImage as CompressedImage
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__Image as Image

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, Frame, ImageFormat, LidarFrame
from coec.config import LimitsConfig, PointTimeConfig
from coec.errors import DecodeError
from coec.io.frame_validation import BYTES_PER_PIXEL, MAX_SPEED, Refusal, check_image_size, check_size, raw_image
from coec.io.images import eight_bits, probe
from coec.io.ros import messages, packed_clouds, point_clouds
from coec.io.ros.messages import check_cloud_fields, check_header, deserialized, frame_id, stamp_ns

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
    check_image_size(width, height, limits)
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
    check_image_size(width, height, limits)
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
    check_image_size(*size, limits)
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


# --- messages ---------------------------------------------------------------------------------------------------------

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
        raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, _VIDEO)
    converted = from_file(data, limits)
    return probe(data, limits) if converted is None else converted


def raw_pixels(message: Image, limits: LimitsConfig) -> EncodedImage:
    """The image of a message, without row padding and with little-endian 16-bit values.

    Raises:
        DecodeError: `image_unknown_format`, `image_size_mismatch`, or the reasons of `raw_image`.
    """
    size = (message.width, message.height, message.step, message.data)
    if message.encoding in SEMIPLANAR:
        return from_semiplanar(message.encoding, *size, limits)
    if message.encoding in DEEP_COLOURS:
        return from_deep_colours(message.encoding, *size, bool(message.is_bigendian), limits)
    form = ENCODINGS.get(message.encoding)
    if form is None:
        known = ", ".join((*ENCODINGS, *SEMIPLANAR, *DEEP_COLOURS))
        raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, f"raw images must be one of {known}")
    row = message.width * BYTES_PER_PIXEL[form]
    pixels = rows_of(message.data, message.height, row, message.step)
    data = pixels.tobytes()
    if message.is_bigendian and message.encoding in _DEEP:
        data = np.frombuffer(data, np.uint16).byteswap().tobytes()
    return raw_image(form, message.width, message.height, data, limits)


MAX_MOTION_BYTES: Final = 4096
"""Largest message. An odometry has 724 bytes and its two frame ids."""

Vector = tuple[float, float, float]


def odometry(payload: bytes) -> EgoMotion:
    """The twist of an `Odometry`, which is expressed in its child frame.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    check_motion(payload)
    message = deserialized(ros.nav_msgs__msg__Odometry, payload)
    return _twisted(message.header, message.child_frame_id or message.header.frame_id, message.twist.twist)


def twist(payload: bytes) -> EgoMotion:
    """The twist of a `TwistStamped`, expressed in the frame of its header.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    check_motion(payload)
    message = deserialized(ros.geometry_msgs__msg__TwistStamped, payload)
    return _twisted(message.header, message.header.frame_id, message.twist)


def twist_with_covariance(payload: bytes) -> EgoMotion:
    """The same for a `TwistWithCovarianceStamped`; its covariance is not used.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    check_motion(payload)
    message = deserialized(ros.geometry_msgs__msg__TwistWithCovarianceStamped, payload)
    return _twisted(message.header, message.header.frame_id, message.twist.twist)


def imu(payload: bytes) -> EgoMotion:
    """The turn rates of an `Imu`, about the axes of its own frame; the linear velocity is not known.

    Raises:
        DecodeError: the reasons of `checked`, not this message, or the IMU says that it does not measure turn rates.
    """
    check_motion(payload)
    message = deserialized(ros.sensor_msgs__msg__Imu, payload)
    if message.angular_velocity_covariance[0] == -1.0:  # sensor_msgs/Imu: "does not produce" it
        raise DecodeError(Refusal.MOTION_INVALID, "the IMU says that it does not measure turn rates")
    rates = message.angular_velocity
    stamp, frame = stamp_ns(message.header), frame_id(message.header.frame_id)
    return checked(stamp, frame, None, (rates.x, rates.y, rates.z))


def checked(stamp: int, frame: str, linear_mps: Vector | None, angular_radps: Vector) -> EgoMotion:
    """The motion, checked to be possible for a vehicle.

    Raises:
        DecodeError: `motion_invalid`.
    """
    if not all(math.isfinite(v) and abs(v) <= MAX_SPEED for v in (*(linear_mps or ()), *angular_radps)):
        raise DecodeError(Refusal.MOTION_INVALID, "a velocity is not finite or beyond every vehicle")
    return EgoMotion(stamp, frame, linear_mps, angular_radps)


def _twisted(header: ros.std_msgs__msg__Header, frame: str, twist: ros.geometry_msgs__msg__Twist) -> EgoMotion:
    linear, angular = twist.linear, twist.angular
    return checked(stamp_ns(header), frame_id(frame), (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z))


def check_motion(payload: bytes) -> None:
    """Raises DecodeError if the payload is too long for a message of motion, or does not begin with a header."""
    if len(payload) > MAX_MOTION_BYTES:
        raise DecodeError(Refusal.MESSAGE_TOO_LARGE, f"a message of motion has at most {MAX_MOTION_BYTES} bytes")
    check_header(payload)


_VIDEO: Final = (
    "packets of video are no pictures (H.264 and H.265 are read from recordings): take the camera's topic of JPEG "
    "(image_transport) or of raw pixels, or unpack them with `ros2 run image_transport republish`"
)
_PACKED: Final = f"packed clouds are read from recordings only: {packed_clouds.UNPACK}"
_PACKETS: Final = (
    "packets of the LiDAR are no points: take the topic of PointCloud2 of its driver, or convert them with "
)

REFUSED: Final = {
    messages.FFMPEG_PACKET: _VIDEO,
    messages.COMPRESSED_VIDEO: _VIDEO,
    messages.FOXGLOVE_CLOUD: _PACKED,
    "theora_image_transport/msg/Packet": _VIDEO,
    **{
        name: f"packets of a LiDAR are read if the configuration says so: lidar.type: {name}"
        for name in (messages.VELODYNE_SCAN, *messages.OUSTER_PACKETS, *messages.HESAI, messages.ROBOSENSE_PACKET)
    },
    "rslidar_msgs/msg/rslidarScan": f"{_PACKETS}rslidar_sdk, `msg_source: 2` in its config.yaml (packets from ROS)",
    messages.COMPRESSED_CLOUD: _PACKED,
    "sensor_msgs/msg/PointCloud": "PointCloud has been replaced by PointCloud2: convert it (point_cloud_converter)",
    messages.TF: "a transform tells where a frame is, not what it sees; it counts as motion if `ego.type` is this one",
}
"""Types that people configure by mistake, and what to do instead."""


def decode(
    type_name: str,
    payload: bytes,
    limits: LimitsConfig,
    *,
    point_time: PointTimeConfig | None = None,
    source: int | None = None,
) -> Frame:
    """The frame in a message of one of the types in `KNOWN`.

    Stamp and frame id are those of the header, except for an odometry, whose frame id is that of the child frame, in
    which its twist is expressed. CDR has no sequence number. `point_time` says how points are timed if their values do
    not show it; `source` is the requested LiDAR in a cloud of several (see `point_clouds.points_of_source`).

    Raises:
        DecodeError: any other message, with a reason of `Refusal`.
    """
    if type_name in _MOTIONS:
        return _MOTIONS[type_name](payload)
    check_size(payload, limits)
    match type_name:
        case messages.COMPRESSED_IMAGE:
            return _compressed_image(payload, limits)
        case messages.IMAGE:
            return _image(payload, limits)
        case messages.POINT_CLOUD:
            check_cloud_fields(payload)
            message = deserialized(ros.sensor_msgs__msg__PointCloud2, payload)
            return _point_cloud(message, limits, point_time, source)
        case _ if type_name in packed_clouds.TYPES:
            return _point_cloud(packed_clouds.cloud_of(type_name, payload, limits), limits, point_time, source)
        case _ if type_name in point_clouds.TYPES:
            return _point_cloud(point_clouds.cloud_of_cdr(payload), limits, point_time, source)
        case _:
            instead = REFUSED.get(type_name, f"messages of this type are not read; known: {', '.join(KNOWN)}")
            raise DecodeError(Refusal.MESSAGE_TYPE, instead)


_MOTIONS: Final[dict[str, Callable[[bytes], EgoMotion]]] = {
    messages.ODOMETRY: odometry,
    messages.TWIST: twist,
    messages.TWIST_WITH_COVARIANCE: twist_with_covariance,
    messages.IMU: imu,
}

KNOWN: Final = (messages.COMPRESSED_IMAGE, messages.IMAGE, messages.POINT_CLOUD, *_MOTIONS, *point_clouds.TYPES)
"""Types of messages that hold a frame."""


def video_data(type_name: str, payload: bytes) -> tuple[str, bytes] | None:
    """The format of a packet of video, as its sender names it, and its data; None for a picture of another format.

    Raises:
        DecodeError: the payload is not this message.
    """
    check_header(payload)
    message = messages.deserialized_by_name(type_name, payload)
    form = str(message.encoding if type_name == messages.FFMPEG_PACKET else message.format)
    if type_name == messages.COMPRESSED_IMAGE and not any(codec in form.lower() for codec in _VIDEO_FORMATS):
        return None
    return form, message.data.tobytes()


def _compressed_image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    check_header(payload)
    message = deserialized(ros.sensor_msgs__msg__CompressedImage, payload)
    image = compressed_image(message, limits)
    return CameraFrame(stamp_ns(message.header), frame_id(message.header.frame_id), image)


def _image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    check_header(payload)
    message = deserialized(ros.sensor_msgs__msg__Image, payload)
    image = raw_pixels(message, limits)
    return CameraFrame(stamp_ns(message.header), frame_id(message.header.frame_id), image)


def _point_cloud(
    message: ros.sensor_msgs__msg__PointCloud2,
    limits: LimitsConfig,
    point_time: PointTimeConfig | None,
    source: int | None,
) -> LidarFrame:
    frame_id(message.header.frame_id)
    return point_clouds.frame_of(message, stamp_ns(message.header), limits, point_time=point_time, source=source)
