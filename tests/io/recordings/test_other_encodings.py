"""Bags in other encodings and folders hold the same recording as the bag of ROS 2: ROS 1, written by `rosbags`, and
Foxglove's schemas, written by Foxglove's SDK and as JSON."""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Rosbag1

from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import CalibrationConfig, LimitsConfig, PairingConfig
from coec.errors import DecodeError, SourceError
from coec.io.mcap.windows import WindowWriter
from coec.io.recordings.bag import open_topics
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import RecordingSource, parse_spec
from coec.io.ros import messages
from coec.io.ros.message_decoding import decode
from coec.io.ros.translations import TRANSLATIONS, translation_of
from support.encodings import foxglove_values, json_of, of_ros_1, protobuf_of
from support.recordings import STORE, Bag, drive_messages
from support.ros import Packer

DRIVE = drive_messages()
Entry = tuple[str, str, bytes]
"""Topic, schema and data of a message."""


def frames(recording: RecordingSource) -> list[tuple[object, ...]]:
    def values(message: object) -> tuple[object, ...]:
        match message:
            case CameraFrame():
                return message.stamp_ns, message.frame_id, message.image.data
            case LidarFrame():
                return message.stamp_ns, message.frame_id, message.xyz_m.tobytes()
            case EgoMotion():
                return message.stamp_ns, message.frame_id, message.linear_mps
        raise AssertionError

    return [values(message) for message in recording.messages()]


def require_same(result: RecordingSource, expected: RecordingSource) -> None:
    assert frames(result) == frames(expected)
    assert result.rig.camera == expected.rig.camera
    np.testing.assert_array_equal(result.rig.T_camera_lidar_nominal, expected.rig.T_camera_lidar_nominal)


@pytest.fixture
def native(tmp_path: Path) -> RecordingSource:
    return open_source(str(Bag(DRIVE).write(tmp_path / "native.mcap")))


def ros_1_bag(path: Path, compression: Rosbag1.CompressionFormat | None = None) -> Path:
    writer = Rosbag1(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for time, (topic, message) in enumerate(DRIVE):
            name, data = of_ros_1(message)
            if topic not in connections:
                definition, md5 = STORE.generate_msgdef(name, ros_version=1)
                connections[topic] = writer.add_connection(topic, name, msgdef=definition, md5sum=md5)
            writer.write(connections[topic], time, data)
    return path


def mcap(path: Path, encoding: str, messages: list[Entry], profile: str = "") -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000)
        writer.start(profile)
        channels: dict[str, int] = {}
        for time, (topic, schema, data) in enumerate(messages):
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, encoding, writer.register_schema(schema, encoding, b"")
                )
            writer.add_message(channels[topic], time, data, time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize("compression", [None, Rosbag1.CompressionFormat.BZ2, Rosbag1.CompressionFormat.LZ4])
def test_a_bag_of_ros_1(tmp_path: Path, native: RecordingSource, compression: Rosbag1.CompressionFormat | None) -> None:
    require_same(open_source(str(ros_1_bag(tmp_path / "drive.bag", compression))), native)


def test_ros_1_in_mcap(tmp_path: Path, native: RecordingSource) -> None:
    messages = [(topic, *of_ros_1(message)) for topic, message in DRIVE]
    named = [(topic, name.replace("/msg/", "/"), data) for topic, name, data in messages]
    require_same(open_source(str(mcap(tmp_path / "ros1.mcap", "ros1", named, "ros1"))), native)


def test_the_tf_of_ros_1s_first_years(tmp_path: Path, native: RecordingSource) -> None:
    messages = [(topic, *of_ros_1(message)) for topic, message in DRIVE]
    named = [(topic, name.replace("/msg/", "/"), data) for topic, name, data in messages]
    old = [(t, "tf/tfMessage" if t == "/tf_static" else name, data) for t, name, data in named]
    require_same(open_source(str(mcap(tmp_path / "old.mcap", "ros1", old))), native)


def test_a_message_of_somebody_else_that_is_cut_off_ends_nothing(tmp_path: Path, native: RecordingSource) -> None:
    messages = [(topic, *of_ros_1(message)) for topic, message in DRIVE]
    named = [(topic, name.replace("/msg/", "/"), data) for topic, name, data in messages]
    others = [("/rosout", "std_msgs/String", b"\xff" * 4), ("/own", "my_package/Thing", b"1")]
    require_same(open_source(str(mcap(tmp_path / "a.mcap", "ros1", [*others, *named]))), native)
    cut = [(topic, name, data[:-3] if topic == "/points" else data) for topic, name, data in named]
    with pytest.raises(SourceError, match="on /points is refused: not a sensor_msgs/msg/PointCloud2 of ROS 1"):
        open_source(str(mcap(tmp_path / "b.mcap", "ros1", cut)))


@pytest.mark.parametrize("size", [0, 5, 13, 14, 40, 4000])
def test_a_bag_of_ros_1_that_is_cut_off_is_refused(tmp_path: Path, size: int) -> None:
    path = ros_1_bag(tmp_path / "drive.bag")
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(SourceError, match=r"is damaged|no message of type|is no bag"):
        open_source(str(path))


def test_damaged_bags_of_ros_1_raise_nothing_else(tmp_path: Path) -> None:
    path = ros_1_bag(tmp_path / "drive.bag", Rosbag1.CompressionFormat.LZ4)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), 6).tolist():
            damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            list(open_source(str(path)).messages())
        except SourceError:
            refused += 1
    assert refused > 20


def test_a_chunk_of_ros_1_that_would_unpack_to_gigabytes_is_not_unpacked(tmp_path: Path) -> None:
    def record(body: bytes, **fields: bytes) -> bytes:
        parts = [name.encode() + b"=" + value for name, value in fields.items()]
        header = b"".join(struct.pack("<I", len(part)) + part for part in parts)
        return struct.pack("<I", len(header)) + header + struct.pack("<I", len(body)) + body

    path = tmp_path / "bomb.bag"
    chunk = record(b"x", op=b"\x05", compression=b"bz2", size=struct.pack("<I", 2**32 - 1))
    path.write_bytes(b"#ROSBAG V2.0\n" + chunk)
    with pytest.raises(SourceError, match="would unpack to 4294967295 bytes"):
        open_source(str(path))


# --- folders --------------------------------------------------------------------------------------------------------


def split(folder: Path, count: int = 11) -> Path:
    folder.mkdir()
    for number in range(count):
        Bag(DRIVE[number::count]).write(folder / f"split_{number}.mcap")
    return folder


METADATA = "rosbag2_bagfile_information: {storage_identifier: '%s', relative_file_paths: [%s]}"


def test_a_folder_without_metadata(tmp_path: Path, native: RecordingSource) -> None:
    require_same(open_source(str(split(tmp_path / "split"))), native)


def test_a_folder_whose_metadata_names_no_storage(tmp_path: Path, native: RecordingSource) -> None:
    folder = split(tmp_path / "split", 2)
    (folder / "metadata.yaml").write_text(METADATA % ("", "split_0.mcap, split_1.mcap"))
    require_same(open_source(str(folder)), native)


def test_a_folder_whose_files_were_renamed(tmp_path: Path, native: RecordingSource) -> None:
    folder = split(tmp_path / "split", 2)
    (folder / "metadata.yaml").write_text(METADATA % ("mcap", "rosbag2_0.mcap, rosbag2_1.mcap"))
    require_same(open_source(str(folder)), native)


def test_one_file_of_a_split_bag_names_the_folder(tmp_path: Path) -> None:
    folder = split(tmp_path / "split", 2)
    (folder / "metadata.yaml").write_text(METADATA % ("mcap", "split_0.mcap, split_1.mcap"))
    with pytest.raises(SourceError, match=r"it is one file of the bag .*split: open that"):
        open_source(str(folder / "split_1.mcap"))


def test_a_folder_of_recorded_windows_is_no_bag(tmp_path: Path, native: RecordingSource) -> None:
    folder = tmp_path / "windows"
    folder.mkdir()
    writer = WindowWriter(
        folder / "a.mcap", native.rig, native.rig.T_camera_lidar_nominal, "a", CalibrationConfig(), {}
    )
    pairer = Pairer(PairingConfig(), expects_motion=True)
    for pair in [one for message in native.messages() for one in pairer.push(message)]:
        writer.add(pair)
    writer.finish()
    with pytest.raises(SourceError, match=r"holds recorded windows, .*give one, as .*a\.mcap"):
        open_source(str(folder))


# --- Foxglove -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxgloves_schemas(tmp_path: Path, native: RecordingSource, encoding: str) -> None:
    encode = protobuf_of if encoding == "protobuf" else json_of
    known = [(topic, foxglove_values(message)) for topic, message in DRIVE]
    messages = [(topic, f"foxglove.{schema}", encode(schema, values)) for topic, (schema, values) in known]
    require_same(open_source(str(mcap(tmp_path / "foxglove.mcap", encoding, messages))), native)


def convert(encoding: str, schema: str, data: bytes) -> bytes:
    number = translation_of(encoding, schema)
    assert number is not None
    return TRANSLATIONS[number].convert(data)


def test_a_raw_image_of_foxglove() -> None:
    values = {"timestamp": {"sec": 1, "nsec": 2}, "frame_id": "camera", "width": 2, "height": 1, "step": 6}
    values |= {"encoding": "rgb8", "data": b"123456"}
    for encoding, encode in (("protobuf", protobuf_of), ("json", json_of)):
        cdr = convert(encoding, "foxglove.RawImage", encode("RawImage", values))
        image: Any = STORE.deserialize_cdr(cdr, "sensor_msgs/msg/Image")
        assert (image.header.stamp.nanosec, image.header.frame_id, image.encoding) == (2, "camera", "rgb8")
        assert (image.width, image.height, image.step, image.data.tobytes()) == (2, 1, 6, b"123456")


@pytest.mark.parametrize(
    ("encoding", "schema", "data"),
    [
        ("protobuf", "foxglove.CompressedImage", b"\x12\xff\xff\xff\xff\x0fabc"),
        ("protobuf", "foxglove.CompressedImage", b"\x80" * 20),
        ("protobuf", "foxglove.CompressedImage", b"\x13"),
        ("protobuf", "foxglove.CompressedImage", b"\x10\x01"),
        ("protobuf", "foxglove.FrameTransforms", b"\x0a\x00" * 5000),
        ("protobuf", "foxglove.CameraCalibration", b"\x31" + bytes(8)),
        ("protobuf", "foxglove.Odometry", b"\x2a\x09\x09\0\0"),
        ("json", "foxglove.Odometry", b'{"linear_velocity": {"x": "fast"}}'),
        ("protobuf", "foxglove.CompressedPointCloud", b"\x22\x7f"),
        ("protobuf", "foxglove.PointCloud", b"\x25\x00\x00\x00\x00"),
        ("json", "foxglove.CompressedImage", b"{"),
        ("json", "foxglove.CompressedImage", b"[]"),
        ("json", "foxglove.CompressedImage", b'{"data": "*"}'),
        ("json", "foxglove.CompressedImage", b'{"data": "", "timestamp": {"sec": -1}}'),
        ("json", "foxglove.CompressedImage", b'{"data": "", "timestamp": 5}'),
        ("json", "foxglove.FrameTransforms", b"[" * 100_000),
        ("json", "foxglove.FrameTransforms", b'{"transforms": [{"rotation": {"x": "a"}}]}'),
        ("json", "foxglove.RawImage", b'{"width": 1e300}'),
        ("json", "foxglove.PointCloud", b'{"data": "", "point_stride": 4, "pose": {"position": {"x": 1}}}'),
        ("ros1", "sensor_msgs/Image", b"\xff" * 12),
        ("ros1", "tf2_msgs/TFMessage", b"\xff\xff\xff\xff"),
    ],
)
def test_what_is_no_message_is_refused(encoding: str, schema: str, data: bytes) -> None:
    with pytest.raises(DecodeError):
        convert(encoding, schema, data)


@cache
def seeds() -> list[tuple[str, bytes]]:
    known = dict(values for _, message in DRIVE if (values := foxglove_values(message)) is not None)
    return [(schema, protobuf_of(schema, values)) for schema, values in known.items()]


@given(st.integers(0, 3), st.data())
def test_no_mutation_of_protobuf_raises_anything_else(which: int, data: st.DataObject) -> None:
    schema, sound = seeds()[which]
    mutated = bytearray(sound)
    for _ in range(data.draw(st.integers(1, 4))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        convert("protobuf", f"foxglove.{schema}", bytes(mutated))
    except DecodeError:
        return


# --- types that hold frames in another form -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoding", "schema", "advice"),
    [
        ("cdr", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket", r"/other has a damaged ffmpeg_.*: not this message"),
        ("cdr", "theora_image_transport/msg/Packet", r"/other has theora.*: packets of video are no pictures"),
    ],
)
def test_a_bag_of_packed_frames_is_refused_with_what_to_do(
    tmp_path: Path, encoding: str, schema: str, advice: str
) -> None:
    path = mcap(tmp_path / "packed.mcap", encoding, [("/other", schema, b"\0\1\0\0" + bytes(20))])
    with pytest.raises(SourceError, match=advice):
        open_source(str(path))
    assert "/other" in open_topics(parse_spec(str(path))).infos or encoding != "cdr"


POINTS = [(0, 1.0, 2.0, 3.0, 10, 16, 0), (50_000_000, 4.0, 5.0, 6.0, 20, 0, 1), (100_000_000, 7.0, 8.0, 9.0, 30, 0, 3)]


def livox_cdr(stamp_s: int = 5, frame: str = "livox_frame", points: list[tuple[Any, ...]] = POINTS) -> bytes:
    """A `CustomMsg`, by hand."""
    packer = Packer().put("i", stamp_s).put("I", 0).text(frame).put("Q", stamp_s * 10**9).put("I", len(points))
    packer.put("B", 1, 0, 0, 0).put("I", len(points))
    for offset, x, y, z, reflectivity, tag, line in points:
        packer.put("I", offset).put("f", x, y, z).put("B", reflectivity, tag, line)
    return packer.done()


def livox_ros_1(frame: bytes = b"livox_frame") -> bytes:
    head = struct.pack("<IiII", 7, 5, 0, len(frame)) + frame + struct.pack("<QIBBBBI", 5 * 10**9, 3, 1, 0, 0, 0, 3)
    return head + b"".join(struct.pack("<IfffBBB", *point) for point in POINTS)


def test_livoxs_own_message_is_read_as_the_cloud_that_it_holds() -> None:
    limits = LimitsConfig()
    sweep = decode("livox_ros_driver2/msg/CustomMsg", livox_cdr(), limits)
    again = decode(messages.POINT_CLOUD, convert("ros1", "livox_ros_driver/CustomMsg", livox_ros_1()), limits)
    for frame in (sweep, again):
        assert isinstance(frame, LidarFrame)
        assert (frame.stamp_ns, frame.frame_id) == (5 * 10**9, "livox_frame")
        assert frame.xyz_m.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
        assert frame.intensity is not None
        assert frame.intensity.tolist() == [10, 20, 30]
        assert frame.time_offset_s is not None
        np.testing.assert_allclose(frame.time_offset_s, [0.0, 0.05, 0.1], atol=1e-7)
    for length in (0, 1, 3, 11):
        other = decode("livox_ros_driver/msg/CustomMsg", livox_cdr(frame="x" * length), limits)
        assert isinstance(other, LidarFrame)
        assert len(other.xyz_m) == 3


@pytest.mark.parametrize("size", range(0, 120, 7))
def test_a_message_of_livox_that_is_cut_off_is_refused(size: int) -> None:
    assert len(livox_cdr()) > 100
    with pytest.raises(DecodeError):
        decode("livox_ros_driver2/msg/CustomMsg", livox_cdr()[: min(size, len(livox_cdr()) - 1)], LimitsConfig())
    with pytest.raises(DecodeError):
        convert("ros1", "livox_ros_driver2/CustomMsg", livox_ros_1()[: min(size, len(livox_ros_1()) - 1)])


def test_a_bag_of_livox(tmp_path: Path, native: RecordingSource) -> None:
    entries = []
    for topic, message in DRIVE:
        name, data = message.__msgtype__, bytes(STORE.serialize_cdr(message, message.__msgtype__))
        if topic == "/points":
            xyz = np.frombuffer(message.data.tobytes(), "<f4").reshape(-1, 3)
            points = [(0, *row, 0, 0, 0) for row in xyz.tolist()]
            name, data = "livox_ros_driver2/msg/CustomMsg", livox_cdr(0, "lidar", points)
            data = data[:4] + struct.pack("<iI", message.header.stamp.sec, message.header.stamp.nanosec) + data[12:]
        entries.append((topic, name, data))
    require_same(open_source(str(mcap(tmp_path / "livox.mcap", "cdr", entries))), native)
