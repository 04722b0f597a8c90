"""ROS 2 messages: packed by hand with struct, hostile, and what the recorder writes."""

import math
import struct
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2.decoder import DecoderFactory

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame, Rig
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.geometry.cameras import Camera, build
from coec.io.frame_validation import Refusal
from coec.io.images import encode_depth_png, probe
from coec.io.ros import message_decoding, message_encoding, messages
from coec.io.ros.message_encoding import DiagnosticLevel, DiagnosticStatus
from coec.io.ros.point_clouds import WRITTEN_TIME
from support.ros import (
    JPEG,
    STAMP_NS,
    STAMP_REST_NS,
    STAMP_S,
    Columns,
    cloud,
    compressed_image,
    imu,
    odometry,
    packed_cloud,
    raw_image,
    twist,
    twist_with_covariance,
)

LIMITS = LimitsConfig()
NAN = math.nan


XYZ: Columns = [("x", "<f4", [1, 4]), ("y", "<f4", [2, 5]), ("z", "<f4", [3, 6])]
REASONS_OR_NONE = {None, *Refusal}
MESSAGES = [
    (messages.COMPRESSED_IMAGE, compressed_image()),
    (messages.IMAGE, raw_image("rgb8", 2, 2, 8, bytes(16))),
    (messages.POINT_CLOUD, packed_cloud([*XYZ, ("intensity", "<f4", [7, 8]), ("t", "<u4", [0, 99_000_000])])),
    (messages.ODOMETRY, odometry()),
    (messages.TWIST, twist()),
    (messages.TWIST_WITH_COVARIANCE, twist_with_covariance()),
    (messages.IMU, imu()),
]


def sweep(payload: bytes) -> LidarFrame:
    frame = message_decoding.decode(messages.POINT_CLOUD, payload, LIMITS)
    assert isinstance(frame, LidarFrame)
    return frame


def reason_of(type_name: str, payload: bytes, limits: LimitsConfig = LIMITS) -> str:
    with pytest.raises(DecodeError) as refused:
        message_decoding.decode(type_name, payload, limits)
    assert refused.value.reason in set(Refusal)
    return refused.value.reason


def refusal_or_none(type_name: str, payload: bytes) -> str | None:
    """The reason, or None for what was read; any other exception fails the test."""
    try:
        message_decoding.decode(type_name, payload, LIMITS)
    except DecodeError as error:
        return error.reason
    return None


# --- images -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["jpeg", "", "bgr8; jpeg compressed bgr8", "rgb8; png compressed "])
def test_a_compressed_image_is_known_by_its_bytes(form: str) -> None:
    frame = message_decoding.decode(messages.COMPRESSED_IMAGE, compressed_image(form=form), LIMITS)

    assert frame == CameraFrame(STAMP_NS, "camera", EncodedImage(ImageFormat.JPEG, 64, 48, JPEG))


def test_the_padding_of_rows_is_removed() -> None:
    data = bytes(range(6)) + b"\xaa\xaa" + bytes(range(6, 12)) + b"\xaa\xaa"
    for sent in (data, data[:-2]):  # some drivers leave out the padding of the last row
        frame = message_decoding.decode(messages.IMAGE, raw_image("bgr8", 2, 2, 8, sent), LIMITS)

        assert isinstance(frame, CameraFrame)
        assert frame.image == EncodedImage(ImageFormat.BGR8, 2, 2, bytes(range(12)))


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (raw_image("32FC1", 2, 2, 8, bytes(16)), "image_unknown_format"),
        (raw_image("yuv422", 3, 2, 6, bytes(12)), "image_size_mismatch"),
        (raw_image("bayer_rggb8", 2, 2, 2, bytes(4)), "image_size_mismatch"),
        (raw_image("mono16", 4, 2, 4, bytes(16)), "image_size_mismatch"),
        (raw_image("jpeg", 2, 2, 2, bytes(4)), "image_unknown_format"),
        (raw_image("mono8", 4, 2, 3, bytes(8)), "image_size_mismatch"),
        (raw_image("mono8", 4, 2, 4, bytes(7)), "image_size_mismatch"),
        (raw_image("mono8", 2**32 - 1, 2**32 - 1, 2**32 - 1, bytes(8)), "image_size_mismatch"),
        (raw_image("mono8", 0, 2, 0, b""), "image_corrupt"),
        (raw_image("mono8", 4, 0, 4, b""), "image_corrupt"),
    ],
)
def test_a_wrong_raw_image_is_refused_by_reason(payload: bytes, reason: str) -> None:
    assert reason_of(messages.IMAGE, payload) == reason


def test_a_truncated_jpeg_is_refused() -> None:
    assert reason_of(messages.COMPRESSED_IMAGE, compressed_image(JPEG[:-9])) == "image_truncated"


# --- clouds -------------------------------------------------------------------------------------------------


def test_fields_in_any_order_with_padding_between_and_rows_separate() -> None:
    # Points of 24 bytes, 2 rows of 2, 56 bytes apart: z f64 at 0, x f32 at 12, ring u8 at 17, y f32 at 20.
    data = bytearray(2 * 56)
    for i in range(4):
        at = (i // 2) * 56 + (i % 2) * 24
        struct.pack_into("<d", data, at, 10.5 + i)
        struct.pack_into("<f", data, at + 12, 1 + i)
        data[at + 17] = i
        struct.pack_into("<f", data, at + 20, -1 - i)
    fields = [("z", 0, 8), ("x", 12, 7), ("ring", 17, 2), ("y", 20, 7), ("rgb", 4, 7)]

    frame = sweep(cloud(fields, bytes(data), 2, 24, height=2, row_step=56))

    assert (frame.stamp_ns, frame.frame_id) == (STAMP_NS, "lidar")
    assert frame.xyz_m.tolist() == [[1 + i, -1 - i, 10.5 + i] for i in range(4)]
    assert frame.ring is not None
    assert frame.ring.tolist() == [0, 1, 2, 3]
    assert frame.intensity is None
    assert frame.time_offset_s is None


@pytest.mark.parametrize("form", ["<f4", "<f8", "u1", "<u2"])
def test_intensity_of_any_type(form: str) -> None:
    frame = sweep(packed_cloud([*XYZ, ("intensity", form, [7, 200])]))

    assert frame.intensity is not None
    assert frame.intensity.dtype == np.float32
    assert frame.intensity.tolist() == [7, 200]


@pytest.mark.parametrize("name", ["reflectivity", "reflectance"])
def test_reflectance_by_another_name_is_intensity_if_there_is_none(name: str) -> None:
    frame = sweep(packed_cloud([*XYZ, (name, "<u2", [7, 200])]))
    assert frame.intensity is not None
    assert frame.intensity.tolist() == [7, 200]
    both = sweep(packed_cloud([*XYZ, (name, "<u2", [7, 200]), ("intensity", "<f4", [1, 2])]))
    assert both.intensity is not None
    assert both.intensity.tolist() == [1, 2]


@pytest.mark.parametrize(("name", "form"), [("ring", "u1"), ("ring", "<u2"), ("ring", "<u4"), ("channel", "<u2")])
def test_ring_of_any_unsigned_type(name: str, form: str) -> None:
    frame = sweep(packed_cloud([*XYZ, (name, form, [7, 63])]))

    assert frame.ring is not None
    assert frame.ring.dtype == np.uint16
    assert frame.ring.tolist() == [7, 63]


def test_points_that_are_none_go_with_their_row_whatever_their_other_columns_hold() -> None:
    payload = packed_cloud(
        [
            ("x", "<f8", [NAN, 1, 1e300, 4]),
            ("y", "<f4", [0, 2, 0, 5]),
            ("z", "<f4", [0, 3, 0, 6]),
            ("ring", "<u2", [0, 1, 2, 3]),
            ("timestamp", "<f8", [0.0, STAMP_S + STAMP_REST_NS * 1e-9, NAN, STAMP_S + STAMP_REST_NS * 1e-9 + 0.1]),
        ]
    )

    frame = sweep(payload)

    assert frame.xyz_m.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert frame.ring is not None
    assert frame.ring.tolist() == [1, 3]
    assert frame.time_offset_s is not None
    assert frame.time_offset_s.tolist() == pytest.approx([0.0, 0.1], abs=1e-6)


SHORT = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
MAX = 2**32 - 1


@pytest.mark.parametrize("row_step", [0, 12, 24, 48, MAX])
@pytest.mark.parametrize("height", [1, 2])
def test_rows_whose_distance_a_driver_states_wrong_follow_one_another(row_step: int, height: int) -> None:
    data = np.arange(12, dtype="<f4")
    frame = sweep(cloud(SHORT, data.tobytes(), 4 // height, 12, height=height, row_step=row_step))
    assert np.array_equal(frame.xyz_m, data.reshape(4, 3))


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (packed_cloud([("x", "<f4", [NAN]), ("y", "<f4", [0]), ("z", "<f4", [0])]), "cloud_empty"),
        (cloud(SHORT, b"", 0, 12), "cloud_empty"),
        (cloud(SHORT, b"", 5, 12, height=0), "cloud_empty"),
        (packed_cloud(XYZ[:2]), "cloud_fields"),
        (packed_cloud([("x", "<i4", [1]), ("y", "<f4", [1]), ("z", "<f4", [1])]), "cloud_fields"),
        (packed_cloud([*XYZ, ("ring", "<u4", [1, 70_000])]), "cloud_fields"),
        (cloud([*SHORT, ("q", 0, 99)], bytes(12), 1, 12), ""),
        (cloud([("x", 9, 7), *SHORT[1:]], bytes(12), 1, 12), "cloud_shape"),
        (cloud([("x", 4, 7), ("y", 8, 7), ("z", 12, 7)], bytes(12), 1, 12), "cloud_shape"),
        (cloud(SHORT, bytes(36), 1, 36, counts=3), "cloud_fields"),
        (cloud([*SHORT, ("n" * 300, 0, 99)], bytes(12), 1, 12), "cloud_fields"),
        (cloud([("x", MAX, 7), *SHORT[1:]], bytes(12), 1, 12), "cloud_shape"),
        (cloud(SHORT, bytes(24), 2, 0), "cloud_shape"),
        (cloud(SHORT, bytes(24), 3, 12), "cloud_shape"),
        (cloud(SHORT, bytes(23), 2, 12, row_step=12), "cloud_shape"),
        (cloud(SHORT, bytes(25), 1, 12, height=2, row_step=MAX), "cloud_shape"),
        (cloud(SHORT, bytes(25), 1, 12, height=2, row_step=0), "cloud_shape"),
        (cloud(SHORT, bytes(24), 2, MAX, row_step=MAX), "cloud_shape"),
        (cloud(SHORT, bytes(24), MAX, MAX, height=MAX, row_step=MAX), "cloud_too_large"),
        (cloud(SHORT, bytes(24), 2**16, 12, height=2**16, row_step=0), "cloud_too_large"),  # 0 in 32 bits
        (cloud(SHORT, bytes(24), 2, 12, claimed=MAX), "message_malformed"),
        (cloud(SHORT, bytes(24), 2, 12, claimed=25 + 4000), "message_malformed"),
        (cloud(SHORT, bytes(24), 2, 12, claimed_fields=MAX), "cloud_fields"),
        (cloud(SHORT * 30, bytes(24), 2, 12), "cloud_fields"),
    ],
)
def test_a_wrong_cloud_is_refused_by_reason(payload: bytes, reason: str) -> None:
    if reason:
        assert reason_of(messages.POINT_CLOUD, payload) == reason
    else:  # a field of an unknown type that nobody asked for
        assert len(sweep(payload).xyz_m) == 1


# --- ego-motion ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("type_name", "payload", "frame_id"),
    [
        (messages.ODOMETRY, odometry(), "base_link"),  # the twist is expressed in the child frame
        (messages.ODOMETRY, odometry(""), "odom"),
        (messages.TWIST, twist(), "base_link"),
        (messages.TWIST_WITH_COVARIANCE, twist_with_covariance(), "base_link"),
    ],
)
def test_ego_motion(type_name: str, payload: bytes, frame_id: str) -> None:
    motion = EgoMotion(STAMP_NS, frame_id, (1.5, 0.0, -0.25), (0.0, 0.5, 0.125))

    assert message_decoding.decode(type_name, payload, LIMITS) == motion


def test_an_imu_measures_rotation_only() -> None:
    assert message_decoding.decode(messages.IMU, imu(), LIMITS) == EgoMotion(
        STAMP_NS, "imu_link", None, (0.0, 0.5, 0.125)
    )


def test_an_imu_that_has_no_turn_rates_says_so_and_is_refused() -> None:
    assert reason_of(messages.IMU, imu(known=-1.0)) == "motion_invalid"


@pytest.mark.parametrize("value", [NAN, math.inf, -1e30])
def test_a_velocity_that_is_none_is_refused(value: float) -> None:
    assert reason_of(messages.TWIST, twist(angular=(0.0, value, 0.0))) == "motion_invalid"
    assert reason_of(messages.IMU, imu(angular=(0.0, value, 0.0))) == "motion_invalid"


def test_a_message_of_motion_with_a_name_of_a_megabyte_is_not_even_checked() -> None:
    assert reason_of(messages.IMU, imu(frame_id="x" * 2**20)) == "message_too_large"
    assert reason_of(messages.ODOMETRY, odometry("x" * 2**20)) == "message_too_large"


# --- headers and hostility ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ({"sec": -1}, "stamp_invalid"),
        ({"nsec": 10**9}, "stamp_invalid"),
        ({"frame_id": "x" * 129}, "frame_id_invalid"),
    ],
)
def test_a_wrong_header_is_refused_by_reason(header: dict[str, Any], reason: str) -> None:
    assert reason_of(messages.COMPRESSED_IMAGE, compressed_image(**header)) == reason


def test_a_type_that_is_not_read_is_refused() -> None:
    assert reason_of("std_msgs/msg/String", b"\0\1\0\0") == "message_type"


@pytest.mark.parametrize(
    ("type_name", "advice"),
    [
        ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "JPEG"),
        ("ouster_sensor_msgs/msg/PacketMsg", "lidar.type: ouster_sensor_msgs/msg/PacketMsg"),
        ("rslidar_msgs/msg/rslidarScan", "msg_source: 2"),
    ],
)
def test_a_type_that_people_take_for_the_right_one_is_refused_with_what_to_do(type_name: str, advice: str) -> None:
    with pytest.raises(DecodeError, match=advice):
        message_decoding.decode(type_name, b"\0\1\0\0", LIMITS)


def test_a_message_beyond_the_limit_is_not_even_checked() -> None:
    limits = LimitsConfig(max_message_bytes=2**16)

    assert reason_of(messages.POINT_CLOUD, bytes(2**16 + 1), limits) == "message_too_large"


@pytest.mark.fault("a ROS message cut off at any byte", "it is refused with a reason")
@pytest.mark.parametrize(("type_name", "payload"), MESSAGES)
def test_a_message_cut_at_any_byte_is_refused(type_name: str, payload: bytes) -> None:
    message_decoding.decode(type_name, payload, LIMITS)
    for size in range(0, len(payload) - 1, max(1, len(payload) // 400)):
        assert reason_of(type_name, payload[:size])


@pytest.mark.fault("a length of 4 GB anywhere in a ROS message", "nothing is allocated for it")
@pytest.mark.parametrize(("type_name", "payload"), MESSAGES)
def test_a_huge_length_anywhere_allocates_nothing(type_name: str, payload: bytes) -> None:
    message_decoding.decode(type_name, payload, LIMITS)  # builds the decoder, which is not the sender's memory
    tracemalloc.start()
    try:
        for at in range(4, min(len(payload) - 4, 300)):
            for value in (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x01"):
                hostile = payload[:at] + value + payload[at + 4 :]
                assert refusal_or_none(type_name, hostile) in REASONS_OR_NONE
        assert tracemalloc.get_traced_memory()[1] < 4 * 2**20
    finally:
        tracemalloc.stop()


@given(st.sampled_from(MESSAGES), st.binary(max_size=300))
def test_no_bytes_raise_anything_else(message: tuple[str, bytes], payload: bytes) -> None:
    for head in (b"", b"\0\1\0\0", b"\0\0\0\0"):
        assert refusal_or_none(message[0], head + payload) in REASONS_OR_NONE


@given(st.data())
def test_flipped_bits_raise_nothing_else(data: st.DataObject) -> None:
    type_name, payload = data.draw(st.sampled_from(MESSAGES))
    flipped = bytearray(payload)
    # Mostly in the first bytes, where the lengths are.
    places = st.integers(0, 8 * min(len(flipped), 160) - 1) | st.integers(0, 8 * len(flipped) - 1)
    for at in data.draw(st.lists(places, min_size=1, max_size=4)):
        flipped[at // 8] ^= 1 << at % 8
    assert refusal_or_none(type_name, bytes(flipped)) in REASONS_OR_NONE


# --- what the recorder writes -------------------------------------------------------------------------------

T_CAMERA_LIDAR = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]], dtype=np.float64)
CAMERAS: dict[str, tuple[Camera, str, list[float]]] = {
    "pinhole": (
        build("pinhole", width=640, height=480, fx=500.0, fy=501.0, cx=319.5, cy=239.5),
        "plumb_bob",
        [0.0] * 5,
    ),
    "radtan": (
        build(
            "radtan", width=640, height=480, fx=500.0, fy=501.0, cx=319.5, cy=239.5,
            k1=-0.1, k2=0.02, p1=1e-3, p2=2e-3, k3=3e-3,
        ),
        "plumb_bob",
        [-0.1, 0.02, 1e-3, 2e-3, 3e-3],
    ),
    "kannala_brandt": (
        build(
            "kannala_brandt", width=640, height=480, fx=300.0, fy=301.0, cx=319.5, cy=239.5,
            k1=0.1, k2=-0.01, k3=1e-3, k4=2e-4,
        ),
        "equidistant",
        [0.1, -0.01, 1e-3, 2e-4],
    ),
    "double_sphere": (
        build(
            "double_sphere", width=640, height=480, fx=300.0, fy=301.0, cx=319.5, cy=239.5, xi=-0.2, alpha=0.6
        ),
        "double_sphere",
        [-0.2, 0.6],
    ),
}  # fmt: skip


def rig(camera: Camera) -> Rig:
    return Rig("front", camera, "camera", "lidar", T_CAMERA_LIDAR, np.eye(4))


def read_by_others(type_name: str, payload: bytes) -> Any:
    """Decoded by mcap_ros2, which shares nothing with our decoder but the definition."""
    from mcap.records import Schema

    schema = Schema(id=1, name=type_name, encoding="ros2msg", data=messages.definition(type_name).encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    return decode(payload)


@pytest.mark.parametrize(
    "encoded",
    [
        EncodedImage(ImageFormat.JPEG, 64, 48, JPEG),
        EncodedImage(ImageFormat.RGB8, 2, 3, bytes(range(18))),
        EncodedImage(ImageFormat.MONO8, 2, 3, bytes(range(6))),
    ],
)
def test_an_image_there_and_back(encoded: EncodedImage) -> None:
    frame = CameraFrame(STAMP_NS, "camera", encoded)

    type_name, payload = message_encoding.encode_image(frame)

    assert message_decoding.decode(type_name, payload, LIMITS) == frame
    assert bytes(read_by_others(type_name, payload).data) == encoded.data


def test_a_depth_map_there_and_back() -> None:
    depth = probe(encode_depth_png(np.full((12, 16), 7, np.uint16)), LIMITS)

    payload = message_encoding.encode_depth(STAMP_NS, "camera", depth)

    frame = message_decoding.decode(messages.COMPRESSED_IMAGE, payload, LIMITS)
    assert isinstance(frame, CameraFrame)
    assert frame.image == depth
    assert read_by_others(messages.COMPRESSED_IMAGE, payload).format == "16UC1; png"


@pytest.mark.parametrize("names", [(), ("time_offset_s",), ("intensity", "ring", "time_offset_s")])
def test_a_sweep_there_and_back(names: tuple[str, ...]) -> None:
    rng = np.random.default_rng(1)
    columns: dict[str, Any] = {
        "intensity": rng.random(500, np.float32),
        "ring": rng.integers(0, 128, 500).astype(np.uint16),
        "time_offset_s": rng.uniform(-5, 5, 500).astype(np.float32),
    }
    xyz_m = rng.normal(size=(500, 3)).astype(np.float32)
    frame = LidarFrame(STAMP_NS, "lidar", xyz_m, **{name: columns[name] for name in names})

    back = message_decoding.decode(
        messages.POINT_CLOUD, message_encoding.encode_cloud(frame), LIMITS, point_time=WRITTEN_TIME
    )

    assert isinstance(back, LidarFrame)
    assert (back.stamp_ns, back.frame_id) == (STAMP_NS, "lidar")
    assert back.xyz_m.tobytes() == xyz_m.tobytes()
    for name, values in columns.items():
        column = getattr(back, name)
        assert (column is None) if name not in names else (column.tobytes() == values.tobytes())


def test_an_odometry_there_and_back() -> None:
    motion = EgoMotion(STAMP_NS, "base_link", (1 / 3, 0.0, -2.0), (1e-9, 0.5, 3.0))

    type_name, payload = message_encoding.encode_motion(motion)

    assert type_name == messages.ODOMETRY
    assert message_decoding.decode(messages.ODOMETRY, payload, LIMITS) == motion
    assert read_by_others(messages.ODOMETRY, payload).child_frame_id == "base_link"


def test_a_rotation_there_and_back() -> None:
    motion = EgoMotion(STAMP_NS, "imu_link", None, (1e-9, 0.5, -3.0))

    type_name, payload = message_encoding.encode_motion(motion)

    assert type_name == messages.IMU
    assert message_decoding.decode(type_name, payload, LIMITS) == motion
    read = read_by_others(type_name, payload)
    assert (read.orientation_covariance[0], read.linear_acceleration_covariance[0]) == (-1, -1)
    assert read.angular_velocity_covariance[0] == 0


@pytest.mark.parametrize("model", CAMERAS)
def test_camera_info(model: str) -> None:
    camera, distortion_model, d = CAMERAS[model]

    message = read_by_others(messages.CAMERA_INFO, message_encoding.encode_camera_info(rig(camera), STAMP_NS))

    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (STAMP_S, STAMP_REST_NS)
    assert (message.width, message.height, message.header.frame_id) == (640, 480, "camera")
    assert message.distortion_model == distortion_model
    assert list(message.d) == d
    assert list(message.k) == [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]


def test_every_camera_model_has_a_distortion_model() -> None:
    from coec.geometry.cameras import MODELS

    assert set(message_encoding.DISTORTION) == set(MODELS)
    for name, (_, parameters) in message_encoding.DISTORTION.items():
        assert set(parameters) == set(MODELS[name].parameters) - {"width", "height", "fx", "fy", "cx", "cy"}


def test_tf_maps_the_child_to_the_parent() -> None:
    payload = message_encoding.encode_tf_static(rig(CAMERAS["pinhole"][0]), T_CAMERA_LIDAR, STAMP_NS)

    (transform,) = read_by_others(messages.TF, payload).transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("camera", "lidar")
    moved, turned = transform.transform.translation, transform.transform.rotation
    assert (moved.x, moved.y, moved.z) == (0.1, 0.2, 0.3)
    assert (turned.x, turned.y, turned.z, turned.w) == pytest.approx((0.5, -0.5, 0.5, 0.5))


def test_several_frames_lie_in_one_message() -> None:
    lidar, radar = np.eye(4), T_CAMERA_LIDAR
    frames = [
        message_encoding.PlacedFrame("base", "lidar", lidar),
        message_encoding.PlacedFrame("lidar", "camera_calibrated", radar),
    ]

    reported = read_by_others(messages.TF, message_encoding.encode_transforms(frames, STAMP_NS)).transforms

    assert [(one.header.frame_id, one.child_frame_id) for one in reported] == [
        ("base", "lidar"),
        ("lidar", "camera_calibrated"),
    ]
    assert {(one.header.stamp.sec, one.header.stamp.nanosec) for one in reported} == {(STAMP_S, STAMP_REST_NS)}
    assert reported[1].transform.translation.z == 0.3


def test_diagnostics() -> None:
    stale = DiagnosticStatus(
        DiagnosticLevel.STALE, "coec: front_calibration", "not looked yet", "truck-7", {"mi": "0.5"}
    )
    fine = DiagnosticStatus(DiagnosticLevel.OK, "coec: rear_calibration", "healthy", "truck-7/rear", {})

    statuses = read_by_others(messages.DIAGNOSTICS, message_encoding.encode_diagnostics(STAMP_NS, [stale, fine])).status

    assert [(one.name, one.message, one.hardware_id) for one in statuses] == [
        ("coec: front_calibration", "not looked yet", "truck-7"),
        ("coec: rear_calibration", "healthy", "truck-7/rear"),
    ]
    assert [ord(one.level) if isinstance(one.level, bytes) else one.level for one in statuses] == [3, 0]
    assert [(item.key, item.value) for item in statuses[0].values] == [("mi", "0.5")]


@pytest.mark.parametrize("model", ["pinhole", "radtan", "kannala_brandt"])
def test_what_ros_knows_is_reported_as_it_is(model: str) -> None:
    camera = CAMERAS[model][0]
    assert message_encoding.ros_camera(camera) == (camera, 0.0)


def test_a_double_sphere_is_reported_as_equidistant() -> None:
    camera = build("double_sphere", width=640, height=480, fx=300.0, fy=310.0, cx=320.0, cy=235.0, xi=-0.2, alpha=0.59)

    stated, residual_px = message_encoding.ros_camera(camera)

    assert 0.0 < residual_px < 0.01
    info = read_by_others(messages.CAMERA_INFO, message_encoding.encode_camera_info(rig(stated), STAMP_NS))
    assert info.distortion_model == "equidistant"
    assert len(info.d) == 4
    assert info.k[0] == stated.fx != 300.0


def test_a_lens_that_ros_has_no_text_for_is_not_reported() -> None:
    size = {"width": 640, "height": 480, "fx": 700.0, "fy": 700.0, "cx": 320.0, "cy": 235.0}
    camera = build("mei", **size, xi=2.2, k1=0.0168, k2=1.6549, p1=0.05, p2=0.0004)

    with pytest.raises(message_encoding.UnsupportedCameraError, match=r"more than 0\.5 px"):
        message_encoding.ros_camera(camera)
