"""Windows on disk: exact round trip, readable by others, and nothing half-written under any kind of failure."""

import hashlib
import os
import struct
import subprocess
import sys
import textwrap
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from coec.calibration.types import (
    EgoMotion,
    EncodedImage,
    FramePair,
    ImageFormat,
    LidarFrame,
    Rig,
)
from coec.errors import RecordingError, WindowError
from coec.geometry import se3
from coec.io.mcap.reader import McapDamagedError, read_records
from coec.io.mcap.windows import (
    RecordedWindow,
    WindowWriter,
    is_window,
    pairs_since,
    read_result,
    read_window,
    salvage,
    write_result,
)
from coec.io.mcap.writer import PART_SUFFIX
from coec.schemas.replies import MovedWithin, Reason
from support.readers import read_recording
from support.windows import BLACK, CONFIGURATION, HEIGHT, WIDTH, a_pair, a_result, a_rig, a_window


def assert_same_pair(got: FramePair, expected: FramePair) -> None:
    assert got.camera == expected.camera
    assert got.motion == expected.motion
    assert (got.lidar.stamp_ns, got.lidar.frame_id) == (expected.lidar.stamp_ns, expected.lidar.frame_id)
    for column in ("xyz_m", "intensity", "ring", "time_offset_s"):
        a, b = getattr(got.lidar, column), getattr(expected.lidar, column)
        assert (a is None) == (b is None)
        if a is not None:
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes()


def assert_same_rig(got: Rig, expected: Rig) -> None:
    assert got.camera == expected.camera
    assert (got.pair, got.camera_frame, got.lidar_frame, got.sweep) == (
        expected.pair,
        expected.camera_frame,
        expected.lidar_frame,
        expected.sweep,
    )
    assert got.T_camera_lidar_nominal.tobytes() == expected.T_camera_lidar_nominal.tobytes()
    assert got.T_lidar_ego.tobytes() == expected.T_lidar_ego.tobytes()
    assert (got.mask is None) == (expected.mask is None)
    if got.mask is not None and expected.mask is not None:
        assert np.array_equal(got.mask, expected.mask)


# --- round trip -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mask", [True, False])
@pytest.mark.parametrize("raw", [True, False])
def test_reads_back_to_the_same_bits(tmp_path: Path, mask: bool, raw: bool) -> None:
    rig = a_rig(mask=mask)
    pairs = [a_pair(i, raw=raw, motion=i != 1) for i in range(4)]
    start = se3.perturb(rig.T_camera_lidar_nominal, np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
    writer = WindowWriter(tmp_path / "w.mcap", rig, start, "w", CONFIGURATION, {})
    for pair in pairs:
        writer.add(pair)
    recorded = writer.finish()

    window, configuration = read_window(tmp_path / "w.mcap")

    assert configuration == CONFIGURATION
    assert window.window_id == recorded.window_id == "w"
    assert window.T_camera_lidar_start.tobytes() == start.tobytes()
    assert_same_rig(window.rig, rig)
    assert len(window.pairs) == recorded.pairs == 4
    for got, expected in zip(window.pairs, pairs, strict=True):
        assert_same_pair(got, expected)


def test_a_mosaic_and_a_turn_are_recorded_as_they_arrived(tmp_path: Path) -> None:
    """And times of points that in another's cloud would leave their unit open."""
    mosaic = EncodedImage(ImageFormat.BAYER_GRBG16, WIDTH, HEIGHT, np.random.default_rng(8).bytes(2 * WIDTH * HEIGHT))
    whole = a_pair(0)
    turning = EgoMotion(whole.stamp_ns, "imu", None, (1 / 3, -2 / 3, 1e-300))
    times_s = np.linspace(-4.0, 4.0, len(whole.lidar.xyz_m), dtype=np.float32)
    pair = FramePair(replace(whole.camera, image=mosaic), replace(whole.lidar, time_offset_s=times_s), turning)

    window, _ = read_window(a_window(tmp_path / "front-1.mcap", [pair]).path)

    (back,) = window.pairs
    assert back.camera == pair.camera
    assert back.motion == turning
    assert back.lidar.time_offset_s is not None
    assert back.lidar.time_offset_s.tobytes() == times_s.tobytes()


def test_a_sweep_without_optional_columns_comes_back_without_them(tmp_path: Path) -> None:
    pair = a_pair(0)
    bare = replace(pair, lidar=LidarFrame(pair.lidar.stamp_ns, "lidar", pair.lidar.xyz_m))
    a_window(tmp_path / "w.mcap", [bare])
    assert_same_pair(read_window(tmp_path / "w.mcap")[0].pairs[0], bare)


def retained_window(path: Path, from_pair: int, points: int = 300) -> WindowWriter:
    """Pairs 2 and 3, and behind them those of an earlier window from a pair on."""
    earlier = a_window(path.with_name("front-0.mcap"), [a_pair(i, points=points) for i in range(2)])
    rig = a_rig()
    writer = WindowWriter(path, rig, rig.T_camera_lidar_nominal, path.stem, CONFIGURATION, {"vehicle": "car"})
    for index in (2, 3):
        writer.add(a_pair(index, points=points))
    since_ns = a_pair(from_pair).stamp_ns
    writer.note_carried_over(earlier.window_id, since_ns)
    for pair in pairs_since(earlier.path, since_ns):
        writer.add(pair)
    return writer


def notes(path: Path) -> dict[str, str]:
    with path.open("rb") as stream:
        (note,) = (record.metadata for record in make_reader(stream).iter_metadata() if record.name == "coec_kept")
    return note


@pytest.mark.parametrize(("from_pair", "pairs"), [(0, [0, 1, 2, 3]), (1, [1, 2, 3])])
def test_pairs_of_another_window_are_read_in_the_order_of_time_and_the_file_says_whose_they_are(
    tmp_path: Path, from_pair: int, pairs: list[int]
) -> None:
    path = tmp_path / "front-2.mcap"
    retained_window(path, from_pair).finish()
    window, _ = read_window(path)
    for got, index in zip(window.pairs, pairs, strict=True):
        assert_same_pair(got, a_pair(index))
    assert window.stamp_ns == a_pair(3).stamp_ns
    write_result(path, a_result("front-2"))
    assert notes(path) == {"from_window": "front-0", "since_ns": str(a_pair(from_pair).stamp_ns)}
    assert len(read_window(path)[0].pairs) == len(pairs)


def test_a_salvaged_window_says_which_pairs_are_of_another(tmp_path: Path) -> None:
    path = tmp_path / "front-2.mcap"
    part = path.with_name(path.name + PART_SUFFIX)
    writer = retained_window(path, 0, points=5_000)
    killed_here = part.read_bytes()
    writer.abandon()
    part.write_bytes(killed_here)
    recorded = salvage(part, lambda: None)
    assert recorded is not None
    assert recorded.pairs == 4
    assert notes(path)["from_window"] == "front-0"


def with_between(path: Path, name: str = "front") -> RecordedWindow:
    """Two pairs, and three thinned ones between them."""
    rig = replace(a_rig(), pair=name)
    writer = WindowWriter(path, rig, rig.T_camera_lidar_nominal, path.stem, CONFIGURATION, {})
    writer.add(a_pair(0))
    for index in (1, 2, 3):
        writer.add_between(thinned(index))
    writer.add(a_pair(4))
    return writer.finish()


def thinned(index: int) -> FramePair:
    pair = a_pair(index, motion=index != 2)
    return replace(pair, camera=replace(pair.camera, depth=None), lidar=replace(pair.lidar, intensity=None))


@pytest.mark.parametrize("name", ["front", "between"])
def test_pairs_between_those_of_a_window_are_distinguished_from_them(tmp_path: Path, name: str) -> None:
    recorded = with_between(tmp_path / "w.mcap", name)
    window, _ = read_window(recorded.path)
    assert len(window.pairs) == recorded.pairs == 2
    for got, index in zip(window.pairs, (0, 4), strict=True):
        assert_same_pair(got, a_pair(index))
    assert len(window.between) == 3
    for got, index in zip(window.between, (1, 2, 3), strict=True):
        assert_same_pair(got, thinned(index))
    retained = list(pairs_since(recorded.path, a_pair(1).stamp_ns))
    assert [pair.stamp_ns for pair in retained] == [a_pair(4).stamp_ns], "the next window takes whole pairs only"


def test_pairs_between_stay_where_the_result_says_that_the_camera_moved(tmp_path: Path) -> None:
    path = tmp_path / "front-1.mcap"
    whole = with_between(path)
    pose = a_result().camera_from_lidar
    moved = MovedWithin(last_before_ns=1, first_after_ns=2, pairs_after=1, before=pose, after=pose)
    with_result = write_result(path, a_result().model_copy(update={"moved": moved}))
    assert with_result.pairs == 2
    assert len(read_window(path)[0].between) == 3
    without = write_result(path, a_result())
    assert without.pairs == 2
    assert read_window(path)[0].between == ()
    assert without.bytes < whole.bytes
    for got, index in zip(read_window(path)[0].pairs, (0, 4), strict=True):
        assert_same_pair(got, a_pair(index))


def test_a_salvaged_window_has_the_pairs_between(tmp_path: Path) -> None:
    recorded = with_between(tmp_path / "w.mcap")
    whole = recorded.path.read_bytes()
    part = tmp_path / ("w.mcap" + PART_SUFFIX)
    recorded.path.rename(part)
    salvaged = salvage(part, lambda: None)
    assert salvaged is not None
    assert salvaged.path.read_bytes() == whole


def test_senders_sequence_numbers_are_not_retained(tmp_path: Path) -> None:
    pair = a_pair(0)
    numbered = replace(pair, camera=replace(pair.camera, sequence=77))
    a_window(tmp_path / "w.mcap", [numbered])
    assert_same_pair(read_window(tmp_path / "w.mcap")[0].pairs[0], pair)


def test_equal_pairs_give_equal_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    a, b = a_window(tmp_path / "a" / "w.mcap"), a_window(tmp_path / "b" / "w.mcap")
    assert a.sha256 == b.sha256
    assert a.path.read_bytes() == b.path.read_bytes()
    assert write_result(a.path, a_result()).sha256 == write_result(b.path, a_result()).sha256


def test_the_record_describes_the_file(tmp_path: Path) -> None:
    recorded = a_window(tmp_path / "w.mcap")
    data = recorded.path.read_bytes()
    assert (recorded.bytes, recorded.sha256) == (len(data), hashlib.sha256(data).hexdigest())
    assert recorded.modified_ns == recorded.path.stat().st_mtime_ns
    assert [p.name for p in tmp_path.iterdir()] == ["w.mcap"]


def test_while_it_is_recorded_the_final_name_does_not_exist(tmp_path: Path) -> None:
    rig = a_rig()
    writer = WindowWriter(tmp_path / "w.mcap", rig, rig.T_camera_lidar_nominal, "w", CONFIGURATION, {})
    writer.add(a_pair(0))
    assert [p.name for p in tmp_path.iterdir()] == ["w.mcap" + PART_SUFFIX]
    writer.abandon()
    writer.abandon()
    assert not list(tmp_path.iterdir())


# --- the result -----------------------------------------------------------------------------------------------


def test_the_result_is_written_into_the_window_and_replaced_by_a_later_one(tmp_path: Path) -> None:
    path = tmp_path / "w.mcap"
    a_window(path)
    before, _ = read_window(path)
    assert read_result(path) is None

    first = write_result(path, a_result(reasons=(Reason(code="mi_low", text="too little information"),)))
    second = write_result(path, a_result())

    assert read_result(path) == a_result()
    assert first.pairs == second.pairs == 3
    assert second.window_id == "w"
    after, configuration = read_window(path)
    assert configuration == CONFIGURATION
    for got, expected in zip(after.pairs, before.pairs, strict=True):
        assert_same_pair(got, expected)
    assert topics(path).count("/coec/front/result") == topics(path).count("/diagnostics") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["w.mcap"]


def topics(path: Path) -> list[str]:
    with path.open("rb") as stream:
        return [channel.topic for _, channel, _ in make_reader(stream, validate_crcs=True).iter_messages()]


@pytest.mark.fault("a result for a window that was damaged meanwhile", "the window is left as it is")
def test_a_result_for_a_damaged_window_leaves_it_alone(tmp_path: Path) -> None:
    path = tmp_path / "w.mcap"
    a_window(path)
    data = path.read_bytes()[:-100]
    path.write_bytes(data)
    with pytest.raises(WindowError, match="cut off"):
        write_result(path, a_result())
    assert path.read_bytes() == data
    assert [p.name for p in tmp_path.iterdir()] == ["w.mcap"]


# --- other readers --------------------------------------------------------------------------------------------

EXPECTED_TYPES = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/coec/front/lidar/points": "sensor_msgs/msg/PointCloud2",
    "/coec/front/odometry": "nav_msgs/msg/Odometry",
    "/coec/front/camera/depth/compressed": "sensor_msgs/msg/CompressedImage",
    "/coec/front/camera/camera_info": "sensor_msgs/msg/CameraInfo",
    "/coec/front/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
    "/coec/front/overlay": "sensor_msgs/msg/CompressedImage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


@pytest.mark.parametrize("raw", [True, False])
def test_every_channel_opens_in_rosbags_and_mcap_ros2(tmp_path: Path, raw: bool) -> None:
    path = tmp_path / "w.mcap"
    pairs = [a_pair(index, raw=raw) for index in range(3)]
    a_window(path, pairs, packed=True)
    overlay = cv2.imencode(".jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8))[1].tobytes()
    write_result(path, a_result(), overlay)
    window = read_recording(path)
    image = "/coec/front/camera/image" if raw else "/coec/front/camera/image/compressed"
    expected = {topic: kind for topic, kind in EXPECTED_TYPES.items() if "camera/image" not in topic}
    assert window.types == {**expected, image: f"sensor_msgs/msg/{'Image' if raw else 'CompressedImage'}"}
    assert window.counts[image] == window.counts["/coec/front/lidar/points"] == 3
    assert window.latched == {"/tf_static"}
    (document,) = window.documents["/coec/front/result"]
    assert document["window_id"] == "front-1"
    cloud = window.first["/coec/front/lidar/points"]
    assert (cloud.header.stamp.sec, cloud.width * cloud.height) == (pairs[0].lidar.stamp_ns // 10**9, 300)
    assert window.first[image].data.tobytes() == pairs[0].camera.image.data
    assert window.first["/coec/front/overlay"].data.tobytes() == overlay
    assert window.first["/coec/front/odometry"].child_frame_id == "base"
    assert window.first["/tf_static"].transforms[0].child_frame_id == "lidar"
    (status,) = window.first["/diagnostics"].status
    assert (status.name, status.hardware_id) == ("coec: front_calibration", "car/front")
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().library.startswith("coec")
        names = [attachment.name for attachment in reader.iter_attachments()]
    assert names == ["rig.json", "configuration.json", "mask.png", "result.json"]


def test_clouds_and_raw_images_are_packed_where_it_is_requested_and_nothing_else(tmp_path: Path) -> None:
    flat = [replace(pair, lidar=replace(pair.lidar, xyz_m=np.ones((300, 3), np.float32))) for pair in (a_pair(0),)]
    plain = a_window(tmp_path / "plain.mcap", flat)
    packed = a_window(tmp_path / "packed.mcap", flat, packed=True)
    assert read_recording(plain.path).packed == set()
    assert read_recording(packed.path).packed == {"/coec/front/lidar/points"}
    assert packed.bytes < plain.bytes
    assert_same_pair(read_window(packed.path)[0].pairs[0], flat[0])
    write_result(packed.path, a_result())
    assert "/coec/front/lidar/points" in read_recording(packed.path).packed, "with its result it is packed as before"
    raw = a_window(tmp_path / "raw.mcap", [replace(flat[0], camera=replace(flat[0].camera, image=BLACK))], packed=True)
    assert read_recording(raw.path).packed == {"/coec/front/lidar/points", "/coec/front/camera/image"}


def test_the_picture_of_a_result_is_no_image_of_the_camera(tmp_path: Path) -> None:
    path = a_window(tmp_path / "w.mcap").path
    before, _ = read_window(path)
    write_result(path, a_result(), b"first")
    write_result(path, a_result(), b"second")
    after, _ = read_window(path)
    for got, expected in zip(after.pairs, before.pairs, strict=True):
        assert_same_pair(got, expected)
    assert read_recording(path).counts["/coec/front/overlay"] == 1


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE])
def test_a_window_that_another_tool_recompressed_and_sorted_is_still_the_window(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "w.mcap"
    a_window(path)
    original, _ = read_window(path)
    with path.open("rb") as source, (tmp_path / "z.mcap").open("wb") as sink:
        reader, writer = make_reader(source), Writer(sink, compression=compression, chunk_size=10_000)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in sorted(reader.iter_messages(), key=lambda item: -item[2].log_time):
            if channel.id not in channels:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schema_id)
            writer.add_message(channels[channel.id], message.log_time, message.data, 0, message.sequence)
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        writer.finish()  # type: ignore[no-untyped-call]
    window, _ = read_window(tmp_path / "z.mcap")
    for got, expected in zip(window.pairs, original.pairs, strict=True):
        assert_same_pair(got, expected)


# --- damage ---------------------------------------------------------------------------------------------------


@pytest.mark.fault("any bit of a recorded window flipped", "it is noticed")
def test_every_flipped_bit_is_noticed(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    path = tmp_path / "w.mcap"
    a_window(path, [a_pair(0, points=5)])
    write_result(path, a_result())
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    places = sorted({*range(60), *range(len(whole) - 400, len(whole)), *rng.integers(0, len(whole), 400).tolist()})
    record_property("figure", f"{len(places)} of {len(places)} bits")
    for at in places:
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(WindowError):
            read_window(path)


@pytest.mark.fault("a recorded window cut off at any byte", "the damage is noticed, with its place")
def test_every_cut_is_noticed_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "w.mcap"
    a_window(path, [a_pair(0, points=5)])
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    for size in sorted({0, 1, 7, 8, 20, len(whole) - 1, *rng.integers(0, len(whole), 60).tolist()}):
        path.write_bytes(whole[:size])
        with pytest.raises(WindowError, match=r"cut off|not an MCAP"):
            read_window(path)
        with pytest.raises(WindowError):
            read_result(path)


def test_bytes_behind_the_end_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "w.mcap"
    a_window(path)
    path.write_bytes(path.read_bytes() + b"more")
    with pytest.raises(WindowError):
        read_window(path)


def chunk_record(compression: str, promised: int, packed: bytes, crc: int = 0) -> bytes:
    """A chunk, packed by hand (MCAP specification, "Chunk (op=0x06)")."""
    name = compression.encode()
    body = struct.pack("<QQQI", 0, 0, promised, crc) + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 0x06, len(body)) + body


def mcap_of(*records: bytes) -> bytes:
    """Magic, header, records, data end, footer without summary, magic."""
    magic = b"\x89MCAP0\r\n"
    header = struct.pack("<BQII", 0x01, 8, 0, 0)
    data_end = struct.pack("<BQI", 0x0F, 4, 0)
    footer = struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)
    return magic + header + b"".join(records) + data_end + footer + magic


def one_record(size: int) -> Iterator[bytes]:
    """A record of an opcode that is left to applications, `size` bytes in all, zero behind its length; in pieces."""
    yield struct.pack("<BQ", 0x80, size - 9)
    for at in range(9, size, 1_000_000):
        yield bytes(min(1_000_000, size - at))


def lz4_bomb(size: int) -> bytes:
    compressor = lz4.frame.LZ4FrameCompressor()
    packed = compressor.begin() + b"".join(compressor.compress(piece) for piece in one_record(size))
    return bytes(packed + compressor.flush())


def zstd_bomb(size: int) -> bytes:
    """Its frame states its size, which `zstandard.decompress` would trust."""
    compressor = zstandard.ZstdCompressor().compressobj(size=size)
    return b"".join(compressor.compress(piece) for piece in one_record(size)) + compressor.flush()


@pytest.mark.fault("a window of 10 kB that unpacks to 600 MB", "it is refused before it is unpacked")
@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("honest", [True, False])
def test_a_chunk_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, compression: str, honest: bool) -> None:
    size = 300_000_000
    packed = {"lz4": lz4_bomb, "zstd": zstd_bomb}[compression](size)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(mcap_of(chunk_record(compression, size if honest else 1000, packed)))
    tracemalloc.start()
    try:
        with pytest.raises(WindowError, match="would unpack" if honest else "size or CRC"):
            read_window(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20_000_000


@pytest.mark.fault("a window of many small bombs", "they are bounded together")
def test_many_chunks_that_are_small_by_themselves_are_refused_together(tmp_path: Path) -> None:
    packed = lz4_bomb(20_000_000)
    path = tmp_path / "bombs.mcap"
    path.write_bytes(mcap_of(*[chunk_record("lz4", 20_000_000, packed)] * 50))
    with pytest.raises(WindowError, match="unpacks to more than"):
        read_window(path)


@pytest.mark.parametrize(
    ("record", "complaint"),
    [
        (struct.pack("<BQ", 0x06, 2**62), "cut off"),
        (chunk_record("lz4", 100, b"not lz4"), "cannot be unpacked"),
        (chunk_record("zstd", 100, b"not zstd"), "cannot be unpacked"),
        (chunk_record("rar", 100, b""), "compression"),
        (chunk_record("", 4, b"abcd", crc=zlib.crc32(b"abce")), "CRC"),
        (chunk_record("", 9, struct.pack("<BQ", 0x05, 1000)), "cut"),
        (struct.pack("<BQHI", 0x04, 6, 1, 2**31), "passes its end"),
        (struct.pack("<BQI", 0x09, 4, 0), "passes its end"),
    ],
)
def test_lengths_that_lie_are_refused(tmp_path: Path, record: bytes, complaint: str) -> None:
    path = tmp_path / "lie.mcap"
    path.write_bytes(mcap_of(record))
    with path.open("rb") as stream, pytest.raises(McapDamagedError, match=complaint):
        list(read_records(stream))


def test_an_mcap_that_is_no_window_is_distinguished(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    path.write_bytes(mcap_of())
    assert not is_window(path)
    with pytest.raises(WindowError, match=r"no attachment rig\.json"):
        read_window(path)
    with pytest.raises(WindowError, match="cannot read"):
        read_window(tmp_path / "absent.mcap")


def test_a_window_without_a_pair_is_refused(tmp_path: Path) -> None:
    a_window(tmp_path / "w.mcap", [])
    with pytest.raises(WindowError, match="no camera-LiDAR pair"):
        read_window(tmp_path / "w.mcap")


# --- salvage --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def part_file(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[int]]:
    """A `.part` file as a killed recorder leaves it, and its size after each pair."""
    path = tmp_path_factory.mktemp("part") / "w.mcap"
    rig = a_rig()
    writer = WindowWriter(path, rig, rig.T_camera_lidar_nominal, "w", CONFIGURATION, {"vehicle": "car"})
    part = path.with_name(path.name + PART_SUFFIX)
    sizes = [part.stat().st_size]
    for index in range(4):
        writer.add(a_pair(index, points=5000))
        sizes.append(part.stat().st_size)
    data = part.read_bytes()
    writer.abandon()
    return data, sizes


@pytest.mark.fault(
    "the power goes while a window is recorded", "every pair that was written whole is saved at the next start"
)
def test_salvage_saves_every_whole_pair_of_a_part_cut_anywhere(
    tmp_path: Path, part_file: tuple[bytes, list[int]], record_property: Callable[[str, object], None]
) -> None:
    data, sizes = part_file
    part = tmp_path / ("w.mcap" + PART_SUFFIX)
    saved_at: list[tuple[int, int]] = []
    rng = np.random.default_rng(2)
    for size in sorted({0, 5, *sizes, len(data), *rng.integers(0, len(data), 60).tolist()}):
        part.write_bytes(data[:size])
        recorded = salvage(part, lambda: None)
        assert not part.exists()
        saved_at.append((size, 0 if recorded is None else recorded.pairs))
        if recorded is None:
            assert not list(tmp_path.iterdir())
            continue
        window, configuration = read_window(recorded.path)
        assert (window.window_id, configuration) == ("w", CONFIGURATION)
        assert_same_rig(window.rig, a_rig())
        for index, got in enumerate(window.pairs):
            assert_same_pair(got, a_pair(index, points=5000))
        recorded.path.unlink()
    counts = [pairs for _, pairs in saved_at]
    record_property("figure", f"{len(counts)} cuts")
    assert counts == sorted(counts)
    for written, size in enumerate(sizes[1:], start=1):
        assert dict(saved_at)[size] == written


@pytest.mark.parametrize("packed", [True, False])
def test_salvaging_a_whole_part_gives_the_bytes_that_finish_would_have(tmp_path: Path, packed: bool) -> None:
    flat = [replace(a_pair(i), camera=replace(a_pair(i).camera, image=BLACK)) for i in range(3)]
    recorded = a_window(tmp_path / "w.mcap", flat, packed=packed)
    whole = recorded.path.read_bytes()
    part = tmp_path / ("w.mcap" + PART_SUFFIX)
    recorded.path.rename(part)
    reported: list[int] = []
    salvaged = salvage(part, lambda: reported.append(1))
    assert len(reported) == recorded.pairs
    assert salvaged == replace(recorded, modified_ns=recorded.path.stat().st_mtime_ns)
    assert recorded.path.read_bytes() == whole


def test_salvage_stops_at_a_flipped_bit(tmp_path: Path, part_file: tuple[bytes, list[int]]) -> None:
    data, sizes = part_file
    damaged = bytearray(data)
    damaged[sizes[2] + 30_000] ^= 4
    part = tmp_path / ("w.mcap" + PART_SUFFIX)
    part.write_bytes(damaged)
    recorded = salvage(part, lambda: None)
    assert recorded is not None
    assert 1 <= recorded.pairs <= 2


def test_salvage_leaves_a_finished_window_alone(tmp_path: Path) -> None:
    recorded = a_window(tmp_path / "w.mcap")
    whole = recorded.path.read_bytes()
    part = tmp_path / ("w.mcap" + PART_SUFFIX)
    part.write_bytes(whole[:2000])
    assert salvage(part, lambda: None) is None
    assert not part.exists()
    assert recorded.path.read_bytes() == whole


# --- a disk that is full --------------------------------------------------------------------------------------

FULL_DISK = """
import resource, signal, sys
sys.path[:0] = {paths!r}
from pathlib import Path
from support.windows import CONFIGURATION, a_pair, a_result, a_rig, a_window
from coec.io.mcap.windows import WindowWriter, write_result
from coec.errors import RecordingError
folder, limit = Path(sys.argv[1]), int(sys.argv[2])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # the write then fails with EFBIG, as with ENOSPC on a full disk
kept = a_window(folder / "kept.mcap")
pairs = [a_pair(index) for index in range(5)]
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
outcomes = []
try:
    rig = a_rig()
    writer = WindowWriter(folder / "w.mcap", rig, rig.T_camera_lidar_nominal, "w", CONFIGURATION, {{}})
    for pair in pairs:
        writer.add(pair)
    writer.finish()
except RecordingError as error:
    outcomes.append("refused" if "w.mcap" in str(error) else str(error))
try:
    write_result(kept.path, a_result())
except RecordingError:
    outcomes.append("refused")
print(*outcomes, *sorted(path.name for path in folder.iterdir()))
"""


@pytest.mark.fault("a disk that becomes full at any point of a window", "a clear error, and no half file is left")
@pytest.mark.parametrize("limit", [100, 3_000, 20_000])
def test_a_full_disk_is_a_recording_error_and_leaves_nothing_behind(tmp_path: Path, limit: int) -> None:
    here = Path(__file__).resolve()
    program = textwrap.dedent(FULL_DISK).format(paths=[str(here.parents[2]), str(here.parents[3] / "service")])
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program, str(tmp_path), str(limit)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout.split(), done.returncode, done.stderr) == (["refused", "refused", "kept.mcap"], 0, "")
    assert read_window(tmp_path / "kept.mcap")[0].pairs


def test_a_folder_that_is_not_there_is_a_recording_error(tmp_path: Path) -> None:
    rig = a_rig()
    with pytest.raises(RecordingError, match="cannot write"):
        WindowWriter(tmp_path / "no" / "w.mcap", rig, rig.T_camera_lidar_nominal, "w", CONFIGURATION, {})


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_a_stamp_that_ros_cannot_hold_is_a_recording_error(tmp_path: Path, stamp_ns: int) -> None:
    pair = a_pair(0)
    with pytest.raises(RecordingError, match="stamp"):
        a_window(tmp_path / "w.mcap", [replace(pair, camera=replace(pair.camera, stamp_ns=stamp_ns))])
    assert not list(tmp_path.iterdir())


@pytest.mark.fault("a link under the name of a window that is being recorded", "what lies behind it is not overwritten")
@pytest.mark.parametrize("suffix", [".part", ".rewrite"])
def test_a_window_is_not_written_through_a_link(tmp_path: Path, suffix: str) -> None:
    other, path = tmp_path / "other", tmp_path / "front-1.mcap"
    other.write_bytes(b"not yours")
    if suffix != PART_SUFFIX:
        a_window(path)
    path.with_name(path.name + suffix).symlink_to(other)
    if suffix == PART_SUFFIX:
        a_window(path)
    else:
        write_result(path, a_result())
    assert other.read_bytes() == b"not yours"
    assert is_window(path)
    assert not path.is_symlink()


def test_a_window_is_closed_to_other_users_while_it_is_written_and_afterwards(tmp_path: Path) -> None:
    before, modes, rig = os.umask(0), [], a_rig()
    try:
        path = tmp_path / "front-1.mcap"
        writer = WindowWriter(path, rig, rig.T_camera_lidar_nominal, path.stem, CONFIGURATION, {})
        modes.append(path.with_name(path.name + PART_SUFFIX).stat().st_mode & 0o777)
        writer.add(a_pair(0))
        writer.finish()
        modes.append(path.stat().st_mode & 0o777)
        write_result(path, a_result())
        modes.append(path.stat().st_mode & 0o777)
    finally:
        os.umask(before)
    assert modes == [0o640] * 3
