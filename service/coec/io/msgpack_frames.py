"""Decodes and encodes frames in the native encoding. Anybody may be the sender, so that sizes are bounded before
anything is built from them."""

from typing import Any, TypeVar

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, Frame, ImageFormat, LidarFrame
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal, check_size, lidar_frame, raw_image
from coec.io.images import probe
from coec.schemas import frames
from coec.schemas.message import Message, to_msgpack

MAX_ITEMS = 64
"""Most entries of one map or array, and most containers in one message. Messages of this version have at most 8 and 4;
the rest is room for fields of newer senders. Together with msgpack's own limit of nesting, this bounds what a malicious
message can allocate to some hundred kB."""

MAX_TEXT = 4096
"""Most bytes of one string; frame ids have at most 128 characters."""

_REASONS = {
    "stamp_ns": Refusal.STAMP_INVALID,
    "frame_id": Refusal.FRAME_ID_INVALID,
    "linear_mps": Refusal.MOTION_INVALID,
    "angular_radps": Refusal.MOTION_INVALID,
}
"""Reason by the field that was wrong; for any other field it is `message_fields`."""

W = TypeVar("W", bound=Message)


def decode_camera(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    """Decodes a `coec.schemas.frames.CameraFrame` in msgpack. Of compressed images only the header is read.

    Raises:
        DecodeError: not a valid message; with a reason of `Refusal`.
    """
    return _camera(_read(frames.CameraFrame, payload, limits), limits)


def decode_lidar(payload: bytes, limits: LimitsConfig) -> LidarFrame:
    """Decodes a `coec.schemas.frames.LidarFrame` in msgpack. Points with a non-finite coordinate or time are dropped,
    with their row in every column. The columns are read-only views of the message unless points are dropped.

    Raises:
        DecodeError: not a valid message; with a reason of `Refusal`.
    """
    wire = _read(frames.LidarFrame, payload, limits)
    count, rest = divmod(len(wire.points), 12)
    if rest:
        raise DecodeError(Refusal.CLOUD_SHAPE, "`points` is not a multiple of 12 bytes (x y z as float32)")
    if count > limits.max_points:
        raise DecodeError(Refusal.CLOUD_TOO_LARGE, f"{count} points; limits.max_points is {limits.max_points}")
    return lidar_frame(
        wire.stamp_ns,
        wire.frame_id,
        np.frombuffer(wire.points, "<f4").reshape(count, 3),
        _column("intensity", wire.intensity, np.dtype("<f4"), count),
        _column("ring", wire.ring, np.dtype("<u2"), count),
        _column("time_offset_s", wire.time_offset_s, np.dtype("<f4"), count),
        wire.sequence,
    )


def decode_ego(payload: bytes, limits: LimitsConfig) -> EgoMotion:
    """Decodes a `coec.schemas.frames.EgoMotion` in msgpack.

    Raises:
        DecodeError: not a valid message; with a reason of `Refusal`.
    """
    return _ego(_read(frames.EgoMotion, payload, limits))


def as_decoded(frame: Frame, limits: LimitsConfig) -> Frame:
    """The frame that would be decoded from the message of a frame, which is not packed for it.

    Raises:
        DecodeError: the message would be refused; with a reason of `Refusal`.
    """
    match frame:
        case CameraFrame():
            depth = b"" if frame.depth is None else frame.depth.data
            if len(frame.image.data) + len(depth) + MAX_TEXT > limits.max_message_bytes:
                return decode_camera(encode_camera(frame), limits)
            return _camera(_wire_camera(frame), limits)
        case LidarFrame():
            columns = (frame.xyz_m, frame.intensity, frame.ring, frame.time_offset_s)
            size = sum(column.nbytes for column in columns if column is not None)
            if size + MAX_TEXT > limits.max_message_bytes or len(frame.xyz_m) > limits.max_points:
                return decode_lidar(encode_lidar(frame), limits)
            wire = frames.LidarFrame(
                stamp_ns=frame.stamp_ns, frame_id=frame.frame_id, sequence=frame.sequence, points=b""
            )
            xyz_m, intensity, ring, time_offset_s = (
                None if column is None else np.ascontiguousarray(column, dtype)
                for column, dtype in zip(columns, ("<f4", "<f4", "<u2", "<f4"), strict=True)
            )
            assert xyz_m is not None
            return lidar_frame(wire.stamp_ns, wire.frame_id, xyz_m, intensity, ring, time_offset_s, wire.sequence)
        case EgoMotion():
            return _ego(_wire_ego(frame))


def encode(frame: Frame) -> bytes:
    """The message of a frame of any sensor."""
    match frame:
        case CameraFrame():
            return encode_camera(frame)
        case LidarFrame():
            return encode_lidar(frame)
        case EgoMotion():
            return encode_ego(frame)


def encode_camera(frame: CameraFrame) -> bytes:
    """The message that `decode_camera` reads back to an equal frame."""
    return to_msgpack(_wire_camera(frame))


def encode_lidar(frame: LidarFrame) -> bytes:
    """The message that `decode_lidar` reads back to an equal frame."""
    return to_msgpack(
        frames.LidarFrame(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            sequence=frame.sequence,
            points=frame.xyz_m.astype("<f4", copy=False).tobytes(),
            intensity=None if frame.intensity is None else frame.intensity.astype("<f4", copy=False).tobytes(),
            ring=None if frame.ring is None else frame.ring.astype("<u2", copy=False).tobytes(),
            time_offset_s=(
                None if frame.time_offset_s is None else frame.time_offset_s.astype("<f4", copy=False).tobytes()
            ),
        )
    )


def encode_ego(motion: EgoMotion) -> bytes:
    """The message that `decode_ego` reads back to an equal value."""
    return to_msgpack(_wire_ego(motion))


def _wire_camera(frame: CameraFrame) -> frames.CameraFrame:
    image = frame.image
    return frames.CameraFrame(
        stamp_ns=frame.stamp_ns,
        frame_id=frame.frame_id,
        sequence=frame.sequence,
        image=frames.Image(format=image.format.value, data=image.data, width=image.width, height=image.height),
        depth=None if frame.depth is None else frames.Depth(format="png", data=frame.depth.data),
    )


def _wire_ego(motion: EgoMotion) -> frames.EgoMotion:
    return frames.EgoMotion(
        stamp_ns=motion.stamp_ns,
        frame_id=motion.frame_id,
        sequence=motion.sequence,
        linear_mps=motion.linear_mps,
        angular_radps=motion.angular_radps,
    )


def _camera(wire: frames.CameraFrame, limits: LimitsConfig) -> CameraFrame:
    return CameraFrame(
        stamp_ns=wire.stamp_ns,
        frame_id=wire.frame_id,
        image=_image(wire.image, limits),
        sequence=wire.sequence,
        depth=None if wire.depth is None else _depth(wire.depth, limits),
    )


def _ego(wire: frames.EgoMotion) -> EgoMotion:
    return EgoMotion(wire.stamp_ns, wire.frame_id, wire.linear_mps, wire.angular_radps, wire.sequence)


def _read(model: type[W], payload: bytes, limits: LimitsConfig) -> W:
    check_size(payload, limits)
    containers = 0

    def count(container: Any) -> Any:
        nonlocal containers
        containers += 1
        if containers > MAX_ITEMS:
            raise ValueError("too many containers")
        return container

    try:
        fields = msgpack.unpackb(
            payload,
            raw=False,
            use_list=False,
            strict_map_key=True,
            object_hook=count,
            list_hook=count,
            max_str_len=MAX_TEXT,
            max_bin_len=limits.max_message_bytes,
            max_array_len=MAX_ITEMS,
            max_map_len=MAX_ITEMS,
            max_ext_len=MAX_TEXT,
        )
    except (ValueError, TypeError, msgpack.UnpackException, RecursionError, OverflowError) as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "not msgpack, or larger than a frame can be") from error
    try:
        return model.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        where = str(first["loc"][0]) if first["loc"] else "message"
        reason = _REASONS.get(where, Refusal.MESSAGE_FIELDS)
        # Only the kind of the error, never text from the sender.
        raise DecodeError(reason, f"{model.__name__}: {where}: {first['type']}") from None


def _image(wire: frames.Image, limits: LimitsConfig) -> EncodedImage:
    form = ImageFormat(wire.format)
    if form not in (ImageFormat.JPEG, ImageFormat.PNG):
        if wire.width is None or wire.height is None:
            raise DecodeError(Refusal.MESSAGE_FIELDS, "raw pixels need width and height")
        return raw_image(form, wire.width, wire.height, wire.data, limits)
    image = probe(wire.data, limits)
    if image.format is not form or wire.width not in (None, image.width) or wire.height not in (None, image.height):
        raise DecodeError(Refusal.IMAGE_SIZE_MISMATCH, "the image does not match the message's description")
    return image


def _depth(wire: frames.Depth, limits: LimitsConfig) -> EncodedImage:
    image = probe(wire.data, limits)
    if image.format is not ImageFormat.PNG:
        raise DecodeError(Refusal.DEPTH_NOT_GREY, "a depth map must be a PNG")
    return image


def _column(name: str, data: bytes | None, dtype: np.dtype[Any], count: int) -> NDArray[Any] | None:
    if data is None:
        return None
    if len(data) != count * dtype.itemsize:
        raise DecodeError(Refusal.CLOUD_SHAPE, f"`{name}` does not have one value for each of the {count} points")
    return np.frombuffer(data, dtype)
