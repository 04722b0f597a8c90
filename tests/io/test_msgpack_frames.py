"""Native frames: packed by hand, hostile, and there and back."""

import contextlib
import math
import struct
import tracemalloc
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, Frame, ImageFormat, LidarFrame
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal
from coec.io.images import encode_depth_png, encode_jpeg, probe
from coec.io.msgpack_frames import (
    as_decoded,
    decode_camera,
    decode_ego,
    decode_lidar,
    encode,
    encode_camera,
    encode_ego,
    encode_lidar,
)

LIMITS = LimitsConfig()
JPEG = encode_jpeg(np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8))
DEPTH = encode_depth_png(np.full((12, 16), 7, np.uint16))
NAN = math.nan

CAMERA: dict[str, Any] = {"stamp_ns": 12, "frame_id": "camera", "image": {"format": "jpeg", "data": JPEG}}
LIDAR: dict[str, Any] = {"stamp_ns": 12, "frame_id": "lidar", "points": struct.pack("<6f", 1, 2, 3, 4, 5, 6)}
EGO: dict[str, Any] = {
    "stamp_ns": 12,
    "frame_id": "base_link",
    "linear_mps": [1.5, 0.0, 0.0],
    "angular_radps": [0.0, 0.0, 0.1],
}
DECODERS: list[tuple[Callable[..., object], dict[str, Any]]] = [
    (decode_camera, CAMERA),
    (decode_lidar, LIDAR),
    (decode_ego, EGO),
]


def reason_of(decode: Callable[..., object], fields: object, limits: LimitsConfig = LIMITS) -> str:
    with pytest.raises(DecodeError) as refused:
        decode(fields if isinstance(fields, bytes) else msgpack.packb(fields), limits)
    assert refused.value.reason in set(Refusal)
    return refused.value.reason


# --- by hand ------------------------------------------------------------------------------------------------


def test_an_ego_motion_packed_by_hand() -> None:
    def double(value: float) -> bytes:
        return b"\xcb" + struct.pack(">d", value)

    payload = (
        b"\x84"
        + b"\xa8stamp_ns\xcf" + struct.pack(">Q", 1_700_000_000_123_456_789)
        + b"\xa8frame_id\xa3ego"
        + b"\xaalinear_mps\x93" + double(1.5) + double(-2.0) + b"\x03"
        + b"\xadangular_radps\x93" + double(0.0) + double(0.25) + double(1e-3)
    )  # fmt: skip

    assert decode_ego(payload, LIMITS) == EgoMotion(
        1_700_000_000_123_456_789, "ego", (1.5, -2.0, 3.0), (0.0, 0.25, 1e-3), None
    )


def test_a_sweep_packed_by_hand() -> None:
    payload = (
        b"\x86"
        + b"\xa8stamp_ns\x05"
        + b"\xa8frame_id\xa1l"
        + b"\xa6points\xc4\x18" + struct.pack("<6f", 1, 2, 3, -4, 5, 0.5)
        + b"\xa9intensity\xc4\x08" + struct.pack("<2f", 9, 8)
        + b"\xa4ring\xc4\x04" + struct.pack("<2H", 63, 65535)
        + b"\xadtime_offset_s\xc4\x08" + struct.pack("<2f", -0.05, 0.05)
    )  # fmt: skip

    frame = decode_lidar(payload, LIMITS)

    assert (frame.stamp_ns, frame.frame_id, frame.sequence) == (5, "l", None)
    assert frame.xyz_m.tolist() == [[1, 2, 3], [-4, 5, 0.5]]
    assert frame.intensity is not None
    assert frame.intensity.tolist() == [9, 8]
    assert frame.ring is not None
    assert frame.ring.tolist() == [63, 65535]
    assert frame.time_offset_s is not None
    assert frame.time_offset_s.tolist() == pytest.approx([-0.05, 0.05])


def test_fields_of_a_newer_sender_are_ignored() -> None:
    newer = EGO | {"schema_version": 3, "covariance": [0.0] * 36, "notes": {"nested": {"deeper": [1, "x"]}}}

    assert decode_ego(msgpack.packb(newer), LIMITS).linear_mps == (1.5, 0.0, 0.0)


# --- there and back -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "frame",
    [
        CameraFrame(5, "camera", probe(JPEG, LIMITS), 3, probe(DEPTH, LIMITS)),
        CameraFrame(5, "camera", probe(DEPTH, LIMITS)),
        CameraFrame(5, "camera", EncodedImage(ImageFormat.RGB8, 2, 1, bytes(range(6))), 2**40),
        CameraFrame(5, "camera", EncodedImage(ImageFormat.BAYER_RGGB16, 4, 4, bytes(range(32)))),
    ],
)
def test_a_camera_frame_there_and_back(frame: CameraFrame) -> None:
    assert decode_camera(encode_camera(frame), LIMITS) == frame
    assert as_decoded(frame, LIMITS) == frame


@pytest.mark.parametrize("columns", [(), ("intensity",), ("intensity", "ring", "time_offset_s")])
def test_a_sweep_there_and_back(columns: tuple[str, ...]) -> None:
    rng = np.random.default_rng(1)
    given: dict[str, Any] = {
        "intensity": rng.random(50, np.float32),
        "ring": rng.integers(0, 128, 50).astype(np.uint16),
        "time_offset_s": rng.random(50, np.float32),
    }
    frame = LidarFrame(
        7, "lidar", rng.normal(size=(50, 3)).astype(np.float32), **{c: given[c] for c in columns}, sequence=9
    )

    for back in (decode_lidar(encode_lidar(frame), LIMITS), as_decoded(frame, LIMITS)):
        assert isinstance(back, LidarFrame)
        assert (back.stamp_ns, back.frame_id, back.sequence) == (7, "lidar", 9)
        assert back.xyz_m.tobytes() == frame.xyz_m.tobytes()
        for name, values in given.items():
            column = getattr(back, name)
            assert (column is None) if name not in columns else (column.tobytes() == values.tobytes())


def test_an_ego_motion_there_and_back() -> None:
    motion = EgoMotion(2**60, "base_link", (1 / 3, -0.0, 1e-300), (math.pi, 2.0, -3.0), 4)

    assert decode_ego(encode_ego(motion), LIMITS) == motion
    assert as_decoded(motion, LIMITS) == motion


SHORT = LimitsConfig(max_message_bytes=2**16, max_points=1024, max_image_pixels=2**12)


@pytest.mark.parametrize(
    "frame",
    [
        LidarFrame(7, "lidar", np.zeros((6000, 3), np.float32)),
        LidarFrame(7, "lidar", np.zeros((1025, 3), np.float32)),
        LidarFrame(7, "lidar", np.zeros((0, 3), np.float32)),
        LidarFrame(7, "lidar", np.full((2, 3), NAN, np.float32)),
        LidarFrame(7, "lidar", np.zeros((2, 3), np.float32), time_offset_s=np.full(2, 11.0, np.float32)),
        CameraFrame(7, "camera", EncodedImage(ImageFormat.RGB8, 256, 128, bytes(2**16 + 2**15))),
        CameraFrame(7, "camera", EncodedImage(ImageFormat.MONO8, 128, 64, bytes(2**13))),
        CameraFrame(7, "camera", EncodedImage(ImageFormat.JPEG, 64, 48, JPEG[:-2])),
        CameraFrame(7, "camera", EncodedImage(ImageFormat.JPEG, 32, 48, JPEG)),
    ],
)
def test_a_frame_of_a_recording_is_refused_as_its_message_would_be(frame: Frame) -> None:
    decode = decode_lidar if isinstance(frame, LidarFrame) else decode_camera
    with pytest.raises(DecodeError) as of_message:
        decode(encode(frame), SHORT)
    with pytest.raises(DecodeError) as of_frame:
        as_decoded(frame, SHORT)
    assert of_frame.value.reason == of_message.value.reason


def test_columns_are_views_of_the_message() -> None:
    frame = decode_lidar(msgpack.packb(LIDAR), LIMITS)

    assert not frame.xyz_m.flags.writeable
    assert not frame.xyz_m.flags.owndata


# --- points that are none -----------------------------------------------------------------------------------


def test_a_point_that_is_none_goes_with_its_row_in_every_column() -> None:
    points = [[1, 2, 3], [NAN, 5, 6], [7, math.inf, 9], [10, 11, 12], [13, 14, 15]]
    sweep = LIDAR | {
        "points": np.array(points, "<f4").tobytes(),
        "intensity": np.array([1, 2, 3, 4, 5], "<f4").tobytes(),
        "ring": np.array([1, 2, 3, 4, 5], "<u2").tobytes(),
        "time_offset_s": np.array([0.1, 0.2, 0.3, 0.4, NAN], "<f4").tobytes(),
    }

    frame = decode_lidar(msgpack.packb(sweep), LIMITS)

    assert frame.xyz_m.tolist() == [[1, 2, 3], [10, 11, 12]]
    for column, expected in ((frame.intensity, [1, 4]), (frame.ring, [1, 4]), (frame.time_offset_s, [0.1, 0.4])):
        assert column is not None
        assert column.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("points", [b"", np.full(9, NAN, "<f4").tobytes()])
def test_a_cloud_without_a_finite_point_is_empty(points: bytes) -> None:
    assert reason_of(decode_lidar, LIDAR | {"points": points}) == "cloud_empty"


# --- refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"stamp_ns": -1}, "stamp_invalid"),
        ({"stamp_ns": NAN}, "stamp_invalid"),
        ({"stamp_ns": math.inf}, "stamp_invalid"),
        ({"stamp_ns": 1.0}, "stamp_invalid"),
        ({"stamp_ns": "12"}, "stamp_invalid"),
        ({"stamp_ns": True}, "stamp_invalid"),
        ({"stamp_ns": None}, "stamp_invalid"),
        ({"stamp_ns": 2**63}, "stamp_invalid"),
        ({"stamp_ns": 2**31 * 10**9}, "stamp_invalid"),  # beyond the header of a ROS message
        ({"stamp_ns": [[[1]]]}, "stamp_invalid"),
        ({"frame_id": "x" * 129}, "frame_id_invalid"),
        ({"frame_id": 4}, "frame_id_invalid"),
        ({"frame_id": b"camera"}, "frame_id_invalid"),
        ({"sequence": -1}, "message_fields"),
        ({"schema_version": 0}, "message_fields"),
    ],
)
@pytest.mark.parametrize(("decode", "fields"), DECODERS)
def test_a_wrong_field_is_refused_by_reason(
    decode: Callable[..., object], fields: dict[str, Any], change: dict[str, Any], reason: str
) -> None:
    assert reason_of(decode, fields | change) == reason


@pytest.mark.parametrize(("decode", "fields"), DECODERS)
def test_a_missing_field_is_refused(decode: Callable[..., object], fields: dict[str, Any]) -> None:
    for name in fields:
        assert reason_of(decode, {key: value for key, value in fields.items() if key != name}) != ""


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"points": bytes(13)}, "cloud_shape"),
        ({"points": [1.0, 2.0, 3.0]}, "message_fields"),
        ({"intensity": bytes(4)}, "cloud_shape"),
        ({"ring": bytes(8)}, "cloud_shape"),
        ({"time_offset_s": bytes(12)}, "cloud_shape"),
        ({"time_offset_s": struct.pack("<2f", 0.0, 1.7e9)}, "cloud_time"),
    ],
)
def test_a_wrong_cloud_is_refused_by_reason(change: dict[str, Any], reason: str) -> None:
    assert reason_of(decode_lidar, LIDAR | change) == reason


def test_a_cloud_beyond_the_limit_is_refused() -> None:
    cloud = LIDAR | {"points": bytes(12 * 1025)}

    assert reason_of(decode_lidar, cloud, LimitsConfig(max_points=1024)) == "cloud_too_large"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"image": {"format": "jpeg", "data": JPEG[:-50]}}, "image_truncated"),
        ({"image": {"format": "jpeg", "data": "text"}}, "message_fields"),
        ({"image": {"format": "gif", "data": b"GIF89a"}}, "message_fields"),
        ({"image": {"format": "png", "data": JPEG}}, "image_size_mismatch"),
        ({"image": {"format": "jpeg", "data": JPEG, "width": 65, "height": 48}}, "image_size_mismatch"),
        ({"image": {"format": "rgb8", "data": bytes(12)}}, "message_fields"),
        ({"image": {"format": "rgb8", "data": bytes(12), "width": 3, "height": 1}}, "image_size_mismatch"),
        ({"image": {"format": "mono8", "data": b"x", "width": 10**9, "height": 10**9}}, "image_too_large"),
        ({"image": None}, "message_fields"),
        ({"depth": {"format": "png", "data": JPEG}}, "depth_not_grey"),
        ({"depth": {"format": "png", "data": DEPTH[:30]}}, "image_truncated"),
    ],
)
def test_a_wrong_image_is_refused_by_reason(change: dict[str, Any], reason: str) -> None:
    assert reason_of(decode_camera, CAMERA | change) == reason


@pytest.mark.parametrize("value", [NAN, math.inf, 1e300, "1", None])
def test_a_velocity_that_is_none_is_refused(value: object) -> None:
    assert reason_of(decode_ego, EGO | {"linear_mps": [0.0, value, 0.0]}) == "motion_invalid"


def test_a_velocity_that_is_not_known_is_reported_to_be_so() -> None:
    turning = EgoMotion(5, "imu", None, (0.0, 0.0, 0.5), 7)
    assert decode_ego(encode_ego(turning), LIMITS) == turning
    silent = {name: value for name, value in EGO.items() if name != "linear_mps"}
    assert reason_of(decode_ego, silent) == "motion_invalid", "to leave it out is no way to say so"


def test_a_velocity_of_two_numbers_is_refused() -> None:
    assert reason_of(decode_ego, EGO | {"angular_radps": [0.0, 0.0]}) == "motion_invalid"


@pytest.mark.fault("an attacker's text in a frame", "it is never quoted in a log or a reply")
def test_the_sender_is_never_quoted() -> None:
    with pytest.raises(DecodeError) as refused:
        decode_ego(msgpack.packb(EGO | {"frame_id": "\x1b[31m evil " * 30, "stamp_ns": "evil"}), LIMITS)

    assert "evil" not in str(refused.value)


# --- bombs --------------------------------------------------------------------------------------------------

MEGABYTE = 2**20


@pytest.mark.fault("a msgpack bomb as a frame", "it is refused without the memory that it asks for")
@pytest.mark.parametrize(
    "payload",
    [
        b"\x91" * (4 * MEGABYTE),  # arrays in arrays
        b"\x81\xa1a" * MEGABYTE,  # maps in maps
        b"\xdd" + struct.pack(">I", 2**32 - 1) + bytes(100),  # an array that claims 4 Gi items
        b"\xdf" + struct.pack(">I", 2**32 - 1) + bytes(100),  # a map likewise
        b"\xc6" + struct.pack(">I", 2**32 - 1) + bytes(100),  # bytes likewise
        b"\xdb" + struct.pack(">I", 2**32 - 1) + bytes(100),  # text likewise
        b"\xc9" + struct.pack(">I", 2**32 - 1) + bytes(100),  # an extension likewise
        b"\x81\xa1a\xdd" + struct.pack(">I", 4 * MEGABYTE) + b"\x90" * (4 * MEGABYTE),  # many small containers
        b"\x81\xa1a" + (b"\xdc\x00\x40" + b"\x90" * 63) * 20_000,  # in legal portions
        b"\x81\xa1a\xdb" + struct.pack(">I", 4 * MEGABYTE) + b"x" * 4 * MEGABYTE,  # a long text
        b"\xc1",
        b"",
        b"\xc0",
        b"\x05",
        msgpack.packb(EGO) + b"\x00",
        msgpack.packb({1: 2}),
        b"\x81\xa1\xff\x00",  # text that is not UTF-8
        b"\x81\xd7\xff" + bytes(8) + b"\x00",  # a timestamp as a key
    ],
    ids=lambda payload: f"{payload[:8].hex()}-{len(payload)}",
)
@pytest.mark.parametrize(("decode", "_fields"), DECODERS)
def test_a_bomb_is_refused_without_the_memory_it_requests(
    decode: Callable[..., object], _fields: object, payload: bytes
) -> None:
    tracemalloc.start()
    try:
        assert reason_of(decode, payload) in {"message_malformed", "message_fields", "stamp_invalid"}
        assert tracemalloc.get_traced_memory()[1] < 2 * MEGABYTE
    finally:
        tracemalloc.stop()


def test_a_message_beyond_the_limit_is_not_even_checked() -> None:
    assert reason_of(decode_lidar, bytes(2**16 + 1), LimitsConfig(max_message_bytes=2**16)) == "message_too_large"


@given(st.binary(max_size=300))
def test_no_bytes_raise_anything_else(payload: bytes) -> None:
    for decode, _ in DECODERS:
        with pytest.raises(DecodeError):
            decode(payload, LIMITS)


@given(st.data())
def test_cut_and_flipped_messages_raise_nothing_else(data: st.DataObject) -> None:
    decode, fields = data.draw(st.sampled_from(DECODERS))
    message = bytearray(msgpack.packb(fields))
    for at in data.draw(st.lists(st.integers(0, 8 * len(message) - 1), max_size=3)):
        message[at // 8] ^= 1 << at % 8
    cut = data.draw(st.integers(0, len(message)) | st.just(len(message)))
    with contextlib.suppress(DecodeError):
        decode(bytes(message[:cut]), LIMITS)
