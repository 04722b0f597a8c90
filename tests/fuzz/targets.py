"""What is fuzzed: every reader of bytes that somebody else may have written, as the service and the commands use it."""

from __future__ import annotations

import json
import logging
import shutil
import socket
import struct
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import msgpack
import numpy as np
import zenoh
from mcap.opcode import Opcode
from rosbags.rosbag1 import Writer as Rosbag1
from rosbags.typesys import Stores, get_typestore

from coec.calibration.rig.lidar_sampling import RangeBias
from coec.calibration.state import PairRules, after_estimate, initial_state, restored
from coec.calibration.types import CameraFrame, LidarFrame
from coec.config import (
    CalibrationConfig,
    Config,
    LimitsConfig,
    MonitorConfig,
    PairConfig,
    PointTimeConfig,
    PolicyConfig,
    StateConfig,
    TrackerConfig,
    ZenohConfig,
    load_config,
)
from coec.errors import DecodeError, SourceError, UsageError
from coec.geometry.cameras import build, project_point
from coec.io.depth.model_cards import CARDS, read_card
from coec.io.images import Inspector, decode_bgr, decode_depth, encode_depth_png, encode_png
from coec.io.logs import LossCounter
from coec.io.mcap.reader import McapMessage, read_records
from coec.io.mcap.windows import is_window, read_result, read_window, salvage
from coec.io.mcap.writer import PART_SUFFIX, salvage_snippet
from coec.io.msgpack_frames import decode_camera, decode_ego, decode_lidar
from coec.io.recordings.cloud_files import load_cloud
from coec.io.recordings.kitti import read_numbers, read_stamps
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import RecordingSource
from coec.io.rig_files import baseline_to_json, camera_of, load_baseline, rig_of, rig_to_json
from coec.io.ros import message_decoding, message_encoding, messages
from coec.io.ros.camera_info import decode_info, intrinsics_of_info
from coec.io.ros.message_decoding import ENCODINGS
from coec.io.ros.packet_streams import PacketAssembler, PacketStream
from coec.io.ros.transforms import MovingFrame, OdometryMotion, StaticTransforms, decode_static_transforms, frames_in
from coec.io.ros.translations import TRANSLATIONS, translation_of
from coec.io.serialise import estimate_of, result_of
from coec.io.video import VideoReader, VideoTrack
from coec.io.zenoh.session import mode_of, settings_of
from coec.schemas import keys
from coec.schemas.commands import COMMAND_NAMES
from coec.schemas.message import to_json
from coec.schemas.replies import CalibrationResult
from coec.service.api import authorization
from coec.service.api.reply_builders import extrinsic_of
from coec.service.discovery import NOMINAL_FILE, DiscoveredPair, DiscoveryStore
from coec.service.recording.window_store import WindowStore
from coec.service.records.pair_store import PairStore
from coec.service.records.state_store import Clocks, StateStore
from coec.service.timing import Clock
from coec.service.worker.child_process import Link, MalformedMessageError
from coec.service.worker.worker_jobs import (
    Kind,
    MalformedAnswerError,
    Registered,
    RenderedImage,
    Solved,
    number_of,
    pack_answer,
    read_answer,
)
from fuzz.formats import (
    attachment,
    behind,
    book,
    canonical,
    chained,
    checksummed,
    chunk,
    in_archive,
    in_json,
    in_lines,
    in_msgpack,
    in_records,
    in_yaml,
    mcap_file,
    packed_records,
    with_checksum,
)
from fuzz.loop import Target
from support.encodings import of_cloudini, of_draco, of_zlib, of_zstd, packed_message
from support.estimates import ESTIMATE_RIG, a_baseline, estimate
from support.packets import (
    HESAI,
    HESAIS,
    OUSTER,
    PIXELS,
    ROBOSENSE,
    Ouster,
    correction_file,
    hesai_message,
    hesai_message_of_ros_1,
    ouster_message,
)
from support.recordings import npy, npz, pcd
from support.ros import (
    JPEG,
    STAMP_NS,
    Columns,
    Packer,
    cloud,
    compressed_image,
    imu,
    odometry,
    packed_cloud,
    raw_image,
    transforms,
    twist,
    twist_with_covariance,
    velodyne_scan,
)
from support.vehicles import InstantDiskWriter
from support.video import encoded, parameters, pictures, slice_of

LOG = logging.getLogger(__name__)
LIMITS = LimitsConfig()
INSPECTOR = Inspector(LIMITS)
VEHICLE = "vehicle"
GREY = encode_png(np.zeros((8, 8), np.uint8))
DEPTH = encode_depth_png(np.arange(1, 193, dtype=np.uint16).reshape(12, 16))


# --- frames -----------------------------------------------------------------------------------------------------------


def _inspected(frame: object) -> None:
    """A frame that was taken is looked at by the thread that took it."""
    if isinstance(frame, CameraFrame):
        INSPECTOR.inspect(frame)
        decode_bgr(frame.image, LIMITS)
        if frame.depth is not None:
            decode_depth(frame.depth, LIMITS)
    if isinstance(frame, LidarFrame):
        assert len(frame.xyz_m)
        assert np.isfinite(frame.xyz_m).all()
        assert frame.time_offset_s is None or np.isfinite(frame.time_offset_s).all()


def _camera_seeds() -> list[bytes]:
    head = {"stamp_ns": 12, "frame_id": "camera", "sequence": 3, "schema_version": 1}
    raw = {"format": "mono8", "data": bytes(range(12)), "width": 4, "height": 3}
    images = ({"format": "jpeg", "data": JPEG}, {"format": "png", "data": GREY, "width": 8, "height": 8}, raw)
    mosaic = {"format": "bayer_grbg16", "data": bytes(range(40)), "width": 5, "height": 4}
    messages: list[dict[str, Any]] = [{**head, "image": image} for image in (*images, mosaic)]
    messages.append({**messages[0], "depth": {"format": "png", "data": DEPTH}})
    return [msgpack.packb(message) for message in messages]


def _lidar_seeds() -> list[bytes]:
    points = struct.pack("<6f", 1, 2, 3, -4, 5, 0.5)
    columns = {
        "intensity": struct.pack("<2f", 9, 8),
        "ring": struct.pack("<2H", 63, 65535),
        "time_offset_s": struct.pack("<2f", -0.05, 0.05),
    }
    head = {"stamp_ns": 5, "frame_id": "lidar", "points": points}
    return [msgpack.packb(head), msgpack.packb({**head, **columns, "sequence": 2**63 - 1})]


def _ego_seeds() -> list[bytes]:
    motion = {"stamp_ns": 12, "frame_id": "base", "linear_mps": [1.5, 0.0, 0.0], "angular_radps": [0.0, 0.0, 0.1]}
    return [msgpack.packb(motion)]


MESSAGES: Final = (
    messages.COMPRESSED_IMAGE,
    messages.IMAGE,
    messages.POINT_CLOUD,
    messages.ODOMETRY,
    messages.TWIST,
    "other/msg/Type",
    messages.TWIST_WITH_COVARIANCE,
    messages.IMU,
    "livox_ros_driver2/msg/CustomMsg",
    messages.VELODYNE_SCAN,
)


def _cdr(data: bytes, folder: Path) -> None:
    """The first byte chooses the type of the message, and whether the times of points are said."""
    del folder
    kind = data[0] if data else 0
    reported = TIME_REPORTED if kind >= 2**7 else None
    _inspected(message_decoding.decode(MESSAGES[kind % 2**7 % len(MESSAGES)], data[1:], LIMITS, point_time=reported))


def _transforms(data: bytes, folder: Path) -> None:
    """As a vehicle sends them: again and again."""
    del folder
    moving = MovingFrame("odom", "base_link")
    for _ in range(2):
        motion = moving.motion(data)
        assert motion is None or np.isfinite([*(motion.linear_mps or ()), *motion.angular_radps]).all()
    frames_in(data)


def _transforms_seeds() -> list[bytes]:
    begin, end = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (0.2, 0.0, 0.0, 0.0, 0.0, 0.1, 1.0)
    vehicle = [("odom", "base_link", STAMP_NS + k * 20_000_000, pose) for k, pose in enumerate((begin, end))]
    wheel = ("base_link", "wheel", STAMP_NS, end)
    return [transforms(), transforms(*vehicle), transforms(vehicle[0], wheel, vehicle[1])]


def _odometry(data: bytes, folder: Path) -> None:
    """The message again and again, by its velocity and by its pose."""
    del folder
    for reader in (OdometryMotion(None), OdometryMotion("pose")):
        for second in range(3):
            motion = reader.motion(data[:4] + struct.pack("<I", second) + data[8:])
            assert motion is None or np.isfinite([*(motion.linear_mps or ()), *motion.angular_radps]).all()


PACKED_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2"), ("t", "<u4")])
PACKERS = {"zlib": of_zlib, "zstd": of_zstd, "draco": of_draco, "cloudini": of_cloudini}


def _packed(data: bytes, folder: Path) -> None:
    """The first byte chooses the type."""
    del folder
    types = (messages.COMPRESSED_CLOUD, messages.FOXGLOVE_CLOUD)
    _inspected(message_decoding.decode(types[(data[0] if data else 0) % 2], data[1:], LIMITS))


def _packed_seeds() -> list[bytes]:
    """A message in each form whose library is installed."""
    rows = np.zeros(6, PACKED_POINT)
    rows["x"], rows["ring"], rows["t"] = np.arange(6) + 1.0, np.arange(6) % 2, np.arange(6) * 10_000_000
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 12, 4), ("t", 14, 6)]
    libraries = {"draco": "DracoPy", "cloudini": "pureini"}
    forms = {form: pack(rows) for form, pack in PACKERS.items() if form not in libraries or find_spec(libraries[form])}
    seeds = [
        b"\0" + packed_message(Packer().header("lidar"), form, packed, len(rows), PACKED_POINT.itemsize, fields)
        for form, packed in forms.items()
    ]
    pose = Packer().header("lidar").put("d", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    return [*seeds, *([b"\1" + pose.octets(forms["draco"]).text("draco").done()] if "draco" in forms else [])]


TIME_REPORTED = PointTimeConfig(field="t", unit="us", base="clock")
XYZ: Columns = [("x", "<f4", [1, 4]), ("y", "<f4", [2, 5]), ("z", "<f4", [3, 6])]


LIVOX = (
    Packer().header("livox").put("Q", STAMP_NS).put("I", 1).put("B", 1, 0, 0, 0).put("I", 1, 0)
    .put("f", 1, 2, 3).put("B", 9, 16, 0).done()
)  # fmt: skip


def _cdr_seeds() -> list[bytes]:
    doubles: Columns = [(name, "<f8", values) for name, _, values in XYZ]
    messages = [
        (0, compressed_image()),
        (0, compressed_image(GREY, "png")),
        (1, raw_image("rgb8", 2, 2, 8, bytes(16))),
        (1, raw_image("mono8", 4, 3, 4, bytes(12))),
        *((1, raw_image(name, 8, 8, 64, bytes(range(256)) * 2, big=True)) for name in ENCODINGS),
        (2, packed_cloud([*XYZ, ("intensity", "<f4", [7, 8]), ("t", "<u4", [0, 99_000_000])])),
        (2, packed_cloud([*XYZ, ("intensity", "u1", [7, 8]), ("t", "<i4", [-99_000, 0])], big=True)),
        (2 + 2**7, packed_cloud([*XYZ, ("t", "<f8", [STAMP_NS * 1e-3, STAMP_NS * 1e-3 + 9])])),
        (2, packed_cloud([*doubles, ("ring", "<u2", [1, 2]), ("timestamp", "<f8", [1.7e9, 1.7e9 + 0.1])])),
        (2, cloud([("x", 0, 7), ("y", 4, 7), ("z", 8, 7)], bytes(96), 2, 16, height=2, row_step=48)),
        (3, odometry()),
        (4, twist()),
        (6, twist_with_covariance()),
        (7, imu()),
        (8, LIVOX),
        (9, velodyne_scan(2)),
    ]
    return [bytes([kind]) + message for kind, message in messages]


# --- recordings -------------------------------------------------------------------------------------------------------


def _cloud_file(data: bytes, folder: Path, suffix: str) -> None:
    path = folder / f"cloud.{suffix}"
    path.write_bytes(data)
    _inspected(load_cloud(0, "lidar", path))


POINTS = struct.pack("<12f", *range(12))


def _pcd_seeds() -> list[bytes]:
    xyz = ("x y z", "4 4 4", "F F F")
    more = ("x y z intensity ring t", "4 4 4 4 2 4", "F F F F U U")
    rows = b"".join(struct.pack("<4fHI", i, i, i, i, i, i * 50_000_000) for i in range(3))
    columns = struct.pack("<6f", 1, 2, 3, 4, 5, 6)
    return [
        pcd(*xyz, 4, "ascii", b"1 2 3\n" * 4),
        pcd(*xyz, 4, "binary", POINTS, counts="1 1 1"),
        pcd(*xyz, 2, "binary_compressed", struct.pack("<II", 25, 24) + bytes([23]) + columns),
        pcd(*xyz, 20, "binary_compressed", struct.pack("<II", 5, 240) + bytes([0, 0, 0xE0, 230, 0])),
        pcd(*more, 3, "binary", rows),
        pcd("_ x y z time", "1 8 8 8 4", "U F F F F", 1, "ascii", b"1 1 1 2 3 0\n", counts="2 1 1 1 1"),
    ]


def _ply_seeds() -> list[bytes]:
    head = "ply\nformat {} 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n{}end_header\n"
    more = "property uchar scalar_ring\nproperty double time\nelement face 1\nproperty list uchar int i\n"
    return [
        head.format("ascii", "").encode() + b"1 2 3\n4 5 6\n",
        head.format("binary_little_endian", more).encode() + (POINTS[:12] + bytes(9)) * 2,
        head.format("binary_big_endian", "").encode() + POINTS[:24],
    ]


def _bin_seeds() -> list[bytes]:
    five = np.random.default_rng(0).normal(size=(400, 5)).astype("<f4")
    five[:, 3:] = np.abs(five[:, 3:])
    return [POINTS, five.tobytes()]


def _las_seeds() -> list[bytes]:
    """A point each of formats 1 and 6."""
    seeds = []
    for minor, form, step, at in ((2, 1, 28, 20), (4, 6, 30, 22)):
        head = struct.pack("<4s20xBB68xHIIBHI20x6d", b"LASF", 1, minor, 375, 375, 0, form, step, 1, *[0.01] * 6)
        point = struct.pack("<iiiH", 100, 200, 300, 7).ljust(at, b"\0") + struct.pack("<d", 1e9)
        seeds.append((head.ljust(247, b"\0") + struct.pack("<Q", 1)).ljust(375, b"\0") + point.ljust(step, b"\0"))
    return seeds


def _npy_seeds() -> list[bytes]:
    arrays = (
        np.ones((4, 3)),
        np.ones((4, 4), np.float32),
        np.asfortranarray(np.ones((2, 3), ">f8")),
        np.ones((3, 4), "f2"),
        np.arange(48.0).reshape(8, 6) // 3,
        np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u1"), ("t", "u4")]),
    )
    return [npy(array) for array in arrays]


def _npz_seeds() -> list[bytes]:
    columns = {
        "intensity": npy(np.arange(4)),
        "ring": npy(np.arange(4, dtype=np.uint16)),
        "time_offset_s": npy(np.zeros(4)),
    }
    return [npz(xyz=npy(np.ones((4, 3)))), npz(xyz=npy(np.ones((4, 3), np.float32)), **columns)]


def _manifest(data: bytes, folder: Path) -> None:
    if not (folder / "a.png").exists():
        (folder / "a.png").write_bytes(GREY)
        (folder / "a.ppm").write_bytes(b"P6 8 8 255\n" + bytes(192))
        (folder / "a.bin").write_bytes(POINTS[:16])
        (folder / "depth.png").write_bytes(DEPTH)
        (folder / "depth.npy").write_bytes(npy(np.ones((4, 3), np.float32)))
    path = folder / "dataset.yaml"
    path.write_bytes(data)
    _played(open_source(str(path)))


def _played(recording: RecordingSource) -> None:
    for message in recording.messages():
        _inspected(message)


CAMERA = "{model: pinhole, width: 8, height: 8, fx: 4, fy: 4, cx: 3.5, cy: 3.5}"
FISHEYE = (
    "{model: kannala_brandt, width: 8, height: 8, fx: 4, fy: 4, cx: 3.5, cy: 3.5, k1: -0.1, k2: 0.1, k3: 0.1, k4: 0}"
)
IDENTITY = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"


def _manifest_seeds() -> list[bytes]:
    twist = "twist: {linear_mps: [1, 0, 0], angular_radps: [0, 0, 0.1]}"
    texts = [
        f"pair: front\ncamera: {CAMERA}\nT_camera_lidar: {IDENTITY}\n"
        f"frames: [{{image: a.png, cloud: a.bin, stamp_ns: 1, {twist}}}]\n",
        f"pair: front\nmask: a.png\ncamera: {FISHEYE}\nT_camera_lidar: {IDENTITY}\nframes:\n"
        "  - {image: a.ppm, cloud: a.bin, stamp_ns: 1, depth: depth.npy}\n"
        "  - {image: a.png, cloud: a.bin, stamp_ns: 100000000, cloud_stamp_ns: 90000000, depth: depth.png}\n",
        f"pair: front\ncamera: {{image_width: 64, image_height: 48, distortion_model: plumb_bob, camera_matrix: "
        f"{{data: [50, 0, 31, 0, 50, 23, 0, 0, 1]}}, distortion_coefficients: {{data: [0, 0, 0, 0, 0]}}}}\n"
        f"T_camera_lidar: {IDENTITY}\nframes: [{{image: a.png, cloud: a.bin, stamp_ns: 1}}]\n",
        f"pair: front\ncamera: {{cam0: {{camera_model: ds, intrinsics: [0.1, 0.5, 4, 4, 3.5, 3.5], distortion_model: "
        f"none, resolution: [8, 8]}}}}\nT_camera_lidar: {IDENTITY}\n"
        "frames: [{image: a.png, cloud: a.bin, stamp_ns: 1}]\n",
        "pair: front\ncamera: {value0: {intrinsics: [{camera_type: kb4, intrinsics: {fx: 4, fy: 4, cx: 3, cy: 3, "
        f"k1: 0, k2: 0, k3: 0, k4: 0}}}}], resolution: [[8, 8]]}}}}\nT_camera_lidar: {IDENTITY}\n"
        "frames: [{image: a.png, cloud: a.bin, stamp_ns: 1}]\n",
        f"pair: front\ncamera: {CAMERA}\nT_camera_lidar: {IDENTITY}\ncloud_columns: [x, y, z, _]\n"
        "cloud_time: {field: t, unit: us}\nframes: [{image: a.png, cloud: a.bin, stamp_ns: 1}]\n",
    ]
    return [text.encode() for text in texts]


def _kitti(data: bytes, folder: Path) -> None:
    path = folder / "kitti.txt"
    path.write_bytes(data)
    for read in (read_numbers, read_stamps):
        with suppress(SourceError):
            read(path)


def _bag(data: bytes, folder: Path) -> None:
    path = folder / "bag.mcap"
    path.write_bytes(data)
    recording = open_source(str(path))
    assert np.isfinite(recording.rig.T_camera_lidar_nominal).all()
    _played(recording)


def _ros1(data: bytes, folder: Path) -> None:
    path = folder / "drive.bag"
    path.write_bytes(data)
    _played(open_source(str(path)))


def _ros1_seeds() -> list[bytes]:
    store = get_typestore(Stores.ROS2_HUMBLE)
    topics = [
        ("/image", messages.COMPRESSED_IMAGE, compressed_image()),
        ("/points", messages.POINT_CLOUD, SWEEP),
        ("/odom", messages.ODOMETRY, odometry()),
        ("/info", messages.CAMERA_INFO, _camera_info()),
        ("/tf_static", messages.TF, _tf()),
    ]
    seeds = []
    for compression in (None, *Rosbag1.CompressionFormat):
        with TemporaryDirectory() as folder:
            writer = Rosbag1(Path(folder) / "drive.bag")
            if compression is not None:
                writer.set_compression(compression)
            with writer:
                for time, (topic, name, cdr) in enumerate(topics):
                    md5 = "0" * 32
                    connection = writer.add_connection(topic, name, msgdef="uint8 a\n", md5sum=md5)
                    writer.write(connection, time, store.cdr_to_ros1(cdr, name))
            seeds.append((Path(folder) / "drive.bag").read_bytes())
    return seeds


def _video(data: bytes, folder: Path) -> None:
    """The first byte chooses the codec; packets stand behind their lengths."""
    del folder
    packets, at = [], 1
    while at + 2 <= len(data):
        (length,) = struct.unpack_from("<H", data, at)
        packets.append(data[at + 2 : at + 2 + length])
        at += 2 + length
    track = VideoTrack("hevc" if data[:1] == b"\1" else "h264")
    decodable = [number for number, packet in enumerate(packets) if track.add(packet, (number,))]
    reader = VideoReader(track, lambda place: packets[place[0]], LIMITS)
    for number in decodable:
        image = reader.picture((number,))
        assert image is None or len(image.data) == 3 * image.width * image.height


def _video_seeds() -> list[bytes]:
    by_hand = [parameters(order=1), slice_of(0, key=True), slice_of(1), slice_of(3)]
    streams = [
        (b"\0", by_hand),
        (b"\0", [packet.data for packet in encoded("libx264", pictures(5, 32, 16), gop=3, between=1)]),
        (b"\1", [packet.data for packet in encoded("libx265", pictures(3, 32, 32), gop=2)]),
    ]
    return [
        codec + b"".join(struct.pack("<H", len(packet)) + packet for packet in packets) for codec, packets in streams
    ]


def _packets(data: bytes, folder: Path) -> None:
    """The first byte chooses the maker. What describes the sensor stands behind its length, and messages behind
    theirs. They are read as they come, and as those of a recording."""
    del folder
    texts, at = [], 1
    while at + 4 <= len(data):
        (length,) = struct.unpack_from("<I", data, at)
        texts.append(data[at + 4 : at + 4 + length])
        at += 4 + length
    type_name = PACKETS[(data[0] if data else 0) % len(PACKETS)]
    live = PacketAssembler(type_name)
    for text in texts[:1]:
        live.describe(text)
    for number, message in enumerate(texts[1:]):
        with suppress(DecodeError):
            frame = live.add(message, 1000 * number)
            if frame is not None:
                _inspected(frame)
    stream = PacketStream("/packets", type_name)
    for number, message in enumerate(texts[1:]):
        stream.add(message, (number,), 1000 * number)
    sensor = stream.sensor({}, (texts[0] or None) if texts else None)
    for sweep in stream.sweeps(sensor)[0]:
        _inspected(sweep.load(lambda place: texts[1 + place[0]]))


PACKETS = (OUSTER, HESAI, ROBOSENSE)


def _packets_seeds() -> list[bytes]:
    seeds = []
    for profile in PIXELS:
        sensor = Ouster(profile, columns=32)
        ranges = np.full((32, 4), 5000)
        packets = [one for frame in range(4) for one in sensor.packets(ranges, ranges, frame * 10**8, frame, 10**6)]
        seeds.append((0, [sensor.metadata(), *map(ouster_message, packets)]))
    for hesai in HESAIS.values():
        ranges = np.full((2 * hesai.blocks, hesai.lasers), 1000)
        correction = correction_file([1.0] * hesai.lasers, [0.5] * hesai.lasers)
        message = hesai_message(hesai.packets(ranges, ranges % 251, STAMP_NS, 10**6))
        seeds.append((1, [correction, message, message, message]))
    return [bytes([maker]) + b"".join(struct.pack("<I", len(text)) + text for text in texts) for maker, texts in seeds]


SCHEMAS = (
    *(("protobuf", f"foxglove.{name}") for name in ("CompressedImage", "PointCloud", "FrameTransforms", "RawImage")),
    *(("json", f"foxglove.{name}") for name in ("CompressedImage", "PointCloud", "FrameTransforms", "RawImage")),
    ("protobuf", "foxglove.CameraCalibration"),
    ("json", "foxglove.CameraCalibration"),
    ("ros1", "livox_ros_driver/CustomMsg"),
    ("ros1", "sensor_msgs/PointCloud2"),
    ("ros1", "pandar_msgs/PandarScan"),
)


def _translated(data: bytes, folder: Path) -> None:
    """The first byte chooses the encoding and the schema of the message."""
    del folder
    number = translation_of(*SCHEMAS[(data[0] if data else 0) % len(SCHEMAS)])
    assert number is not None
    assert TRANSLATIONS[number].convert(data[1:])[:2] == b"\0\1"


def _translated_seeds() -> list[bytes]:
    double, stamp = struct.pack("<d", 0.5), b"\x0a\x04\x08\x01\x10\x02"
    turn = b"\x2a\x09\x21" + double
    transform = stamp + b"\x12\x01a\x1a\x01b" + b"\x22\x09\x09" + double + turn
    field = b"\x0a\x01x\x15\0\0\0\0\x18\x07"
    point_cloud = stamp + b"\x12\x01l\x25\x04\0\0\0\x2a" + bytes([len(field)]) + field + b"\x32\x04abcd"
    calibration = b"\x15\x04\0\0\0\x1d\x04\0\0\0\x22\x01m\x32\x48" + double * 9
    stamped = {"timestamp": {"sec": 1, "nsec": 2}, "frame_id": "a", "data": "YWJj"}
    documents = {
        4: {**stamped, "format": "jpeg"},
        5: {**stamped, "point_stride": 3, "fields": [{"name": "x", "offset": 0, "type": 7}]},
        6: {"transforms": [{"translation": {"x": 1}, "rotation": {"w": 1}, "child_frame_id": "b"}]},
        7: {**stamped, "width": 1, "height": 1, "step": 3, "encoding": "rgb8"},
        9: {"width": 8, "height": 8, "K": [1.0] * 9, "D": [0.0] * 5},
    }
    livox = struct.pack("<IiII", 1, 5, 0, 1) + b"l" + struct.pack("<QI4xI", 5, 1, 1)
    return [
        b"\0" + stamp + b"\x12\x03abc\x1a\x04jpeg",
        b"\1" + point_cloud,
        b"\2\x0a" + bytes([len(transform)]) + transform,
        b"\3" + stamp + b"\x15\x01\0\0\0\x1d\x01\0\0\0\x22\x05mono8\x2d\x01\0\0\0\x32\x01a",
        b"\x08" + calibration,
        *(bytes([kind]) + json.dumps(document).encode() for kind, document in documents.items()),
        b"\x0c" + hesai_message_of_ros_1([b"\xee\xff" * 20]),
        b"\x0a" + livox + struct.pack("<IfffBBB", 0, 1, 2, 3, 4, 5, 6),
    ]


def _nominal(data: bytes, folder: Path) -> None:
    """What a vehicle of ROS says of its calibration: by the first byte `CameraInfo`, `/tf_static`, or what is kept."""
    kind, body = data[:1], data[1:]
    if kind == b"i":
        info = decode_info(body)
        for rectified in (False, True):
            with suppress(SourceError):
                camera = camera_of(intrinsics_of_info(info, rectified=rectified).intrinsics)
                assert np.isfinite(project_point(camera, 0.1, -0.1, 1.0)[:2]).all()
    elif kind == b"t":
        transforms = StaticTransforms()
        decoded = decode_static_transforms(body)
        transforms.refuse(decoded.refused)
        transforms.add(decoded.joints)
        transforms.add(decoded.joints)
        transforms.changes("camera", "lidar")
        detected = transforms.transform("camera", "lidar")
        transforms.doubts("camera", "lidar")
        assert detected is None or np.isfinite(detected).all()
    else:
        (folder / NOMINAL_FILE).write_bytes(body)
        for retained in DiscoveryStore(folder).load(AWAITING).values():
            rig_of(retained.pair)


AWAITING = Config.model_validate(
    {"middleware": "rmw_zenoh", "pairs": [{"name": "front", "camera": "/c/image", "points": "/points"}]}
)


def _nominal_seeds() -> list[bytes]:
    intrinsics = {"model": "pinhole", "width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5}
    lidar = {"topic": "/points", "frame_id": "lidar"}
    camera = {"topic": "/c/image", "frame_id": "camera", "intrinsics": intrinsics}
    pair = PairConfig.model_validate(
        {"name": "front", "camera": camera, "lidar": lidar, "T_camera_lidar": np.eye(4).tolist()}
    )
    with tempfile.TemporaryDirectory() as folder:
        retained = DiscoveryStore(Path(folder))
        retained.update(DiscoveredPair(pair, {"T_camera_lidar": "/tf_static"}), AWAITING.awaited[0], AWAITING, 5)
        retained.flush()
        state = (Path(folder) / NOMINAL_FILE).read_bytes()
    return [b"i" + _camera_info(), b"t" + _tf(), b"k" + state]


def _camera_info() -> bytes:
    packer = Packer().header("camera").put("I", 48, 64).text("plumb_bob").put("I", 5).put("d", *[0.1] * 5)
    packer.put("d", 50, 0, 31.5, 0, 50, 23.5, 0, 0, 1, *np.eye(3).ravel(), *[0.0] * 12)
    return packer.put("I", 0, 0, 0, 0, 0, 0).put("?", False).done()


def _tf() -> bytes:
    packer = Packer().put("I", 2)
    for parent, child in (("base", "camera"), ("base", "lidar")):
        packer.header(parent).text(child).put("d", 0.1, 0.2, 0.3, 0, 0, 0, 1)
    return packer.done()


SWEEP = packed_cloud([*XYZ, ("time", "<f4", [0, 0.01])])


def _recorded(topics: Sequence[tuple[str, str, bytes]], sequence: int = 0) -> list[tuple[int, bytes]]:
    """Schema, channel and message for each."""

    def text(*texts: str) -> bytes:
        return b"".join(struct.pack("<I", len(text)) + text.encode() for text in texts)

    records: list[tuple[int, bytes]] = []
    for number, (topic, kind, data) in enumerate(topics, start=1):
        records += [
            (Opcode.SCHEMA, struct.pack("<H", number) + text(kind, "ros2msg", "")),
            (Opcode.CHANNEL, struct.pack("<HH", number, number) + text(topic, "cdr") + bytes(4)),
            (Opcode.MESSAGE, struct.pack("<HIQQ", number, sequence, 1, 1) + data),
        ]
    return records


def _bag_seeds() -> list[bytes]:
    topics = [
        ("/image", messages.COMPRESSED_IMAGE, compressed_image()),
        ("/points", messages.POINT_CLOUD, SWEEP),
        ("/odom", messages.ODOMETRY, odometry()),
        ("/info", messages.CAMERA_INFO, _camera_info()),
        ("/tf_static", messages.TF, _tf()),
    ]
    header = (Opcode.HEADER, struct.pack("<I", 5) + b"ros2\0" + bytes(4))
    records = _recorded(topics)
    twisted = _recorded([topics[0], topics[1], ("/twist", messages.TWIST, twist()), *topics[3:]])
    poses = [
        ("odom", "base_link", STAMP_NS + k * 50_000_000, (0.2 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) for k in range(2)
    ]
    moved = _recorded(
        [*topics[:2], ("/tf", messages.TF, transforms(*poses)), ("/imu", messages.IMU, imu()), *topics[3:]]
    )
    return [
        mcap_file([header, *records]),
        mcap_file([(Opcode.CHUNK, chunk(packed_records(twisted)))]),
        mcap_file([(Opcode.CHUNK, chunk(packed_records(moved)))]),
    ]


def _window(data: bytes, folder: Path) -> None:
    """Read as the worker reads it; and salvaged, as it is found after a power cut, be it a window or a snippet."""
    path, part = folder / "front-1.mcap", folder / f"front-2.mcap{PART_SUFFIX}"
    path.write_bytes(data)
    part.write_bytes(data)
    (folder / "front-2.mcap").unlink(missing_ok=True)
    snippet = folder / f"front-3.snippet.mcap{PART_SUFFIX}"
    snippet.write_bytes(data)
    (folder / "front-3.snippet.mcap").unlink(missing_ok=True)
    finished = salvage_snippet(snippet, lambda: None)
    if finished is not None:
        with finished.path.open("rb") as stream:
            assert any(isinstance(record, McapMessage) for record in read_records(stream))
    salvaged = salvage(part, lambda: None)
    if salvaged is not None:
        read_window(salvaged.path)
    result = read_result(path)
    if result is not None:
        estimate_of(result)
    is_window(path)
    window, _ = read_window(path)
    assert np.isfinite(window.T_camera_lidar_start).all()
    for pair in window.pairs:
        _inspected(pair.camera)
        _inspected(pair.lidar)


def _window_seeds() -> list[bytes]:
    camera = build("pinhole", width=64, height=48, fx=30.0, fy=30.0, cx=31.5, cy=23.5)
    rig = replace(ESTIMATE_RIG, camera=camera)
    start = rig.T_camera_lidar_nominal.tolist()
    head = {"window_id": "front-1", "T_camera_lidar_start": start, "rig": rig_to_json(rig)}
    metadata = struct.pack("<I", 4) + b"coec" + struct.pack("<I", 0)
    result = to_json(result_of(estimate(1), ESTIMATE_RIG, VEHICLE))
    mask = encode_png(np.full((48, 64), 255, np.uint8))
    topics = [
        ("/coec/front/lidar/points", messages.POINT_CLOUD, SWEEP),
        ("/coec/front/odometry", messages.ODOMETRY, odometry()),
        (
            "/coec/front/camera/depth/compressed",
            messages.COMPRESSED_IMAGE,
            compressed_image(DEPTH, message_encoding.DEPTH_FORMAT),
        ),
        ("/coec/front/camera/image/compressed", messages.COMPRESSED_IMAGE, compressed_image()),
    ]
    attachments = [("rig.json", canonical(head)), ("configuration.json", to_json(CalibrationConfig()))]
    first = [(int(Opcode.ATTACHMENT), attachment(name, data)) for name, data in attachments]
    more = [
        (int(Opcode.ATTACHMENT), attachment(name, data)) for name, data in (("mask.png", mask), ("result.json", result))
    ]
    whole = [*first, *more, (int(Opcode.METADATA), metadata), *_recorded(topics)]
    chunked = [*first, (int(Opcode.CHUNK), chunk(packed_records(_recorded(topics, 7))))]
    return [mcap_file(whole), mcap_file(chunked)]


# --- requests ---------------------------------------------------------------------------------------------------------

KEYS = keys.Keys("coec", VEHICLE)
SELECTORS: Final = (
    keys.parse_selector,
    keys.parse_command_selector,
    keys.parse_history_selector,
    keys.parse_range_selector,
    keys.parse_overlay_selector,
    keys.parse_evidence_selector,
)


def _selector(data: bytes, folder: Path) -> None:
    """A key, `?`, and parameters that are given to every resource's own reader."""
    del folder
    key, _, parameters = data.decode("utf-8", errors="replace").partition("?")
    refused: list[UsageError] = []
    for parse in (KEYS.parse, KEYS.parse_claim):
        try:
            parse(key)
        except UsageError as error:
            refused.append(error)
    for read in SELECTORS:
        try:
            read(parameters)
        except UsageError as error:
            refused.append(error)
    assert all(len(str(error)) < 1000 for error in refused)


def _selector_seeds() -> list[bytes]:
    texts = [
        f"{KEYS.history('front')}?since=1;until=2;limit=3;format=json",
        f"{KEYS.window('front', 'front-1')}?offset=0;length=5",
        f"{KEYS.command('front', 'hold')}?timeout_ms=100;_time=1",
        f"{KEYS.overlay('front')}?at=nominal;window=front-1",
        f"{KEYS.evidence_of('front', 'front-1')}?overlay=before;format=msgpack",
        f"{KEYS.root}/alive/serving/0a1b/1700000000000000000",
        KEYS.status,
    ]
    return [text.encode() for text in texts]


def _command(data: bytes, folder: Path) -> None:
    """The first byte chooses the command, the second says how much of the rest is the sender's attachment."""
    del folder
    name = (*COMMAND_NAMES, "other")[data[0] % (len(COMMAND_NAMES) + 1) if data else 0]
    cut = 2 + data[1] if len(data) > 1 else 2
    sender = authorization.sender_of(data[2:cut])
    assert sender.isascii()
    assert sender.isprintable()
    assert len(sender) <= authorization.MAX_SENDER
    for report in authorization.parse_payload(name, data[cut:]).values():
        to_json_of(report)


def to_json_of(value: object) -> bytes:
    """What a command was told goes into the log and the history."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode()


def _command_seeds() -> list[bytes]:
    sender = b"\x05alice"
    return [
        bytes([5]) + sender + msgpack.packb({"release": True}),
        bytes([2]) + sender + msgpack.packb({"to": "0123456789abcdef"}),
        bytes([2]) + sender + b'{"to": "front-1"}',
        bytes([0, 0]),
    ]


# --- what lies on the disk --------------------------------------------------------------------------------------------

RULES = PairRules(PolicyConfig(apply="always"), TrackerConfig(), MonitorConfig())


def _state(data: bytes, folder: Path) -> None:
    """A start of the service on it: what is remembered is served, and put on the disk again."""
    shutil.rmtree(folder / "state", ignore_errors=True)
    (folder / "state").mkdir()
    (folder / "state" / "state.json").write_bytes(data)
    _started(folder / "state")


def _started(folder: Path) -> None:
    config = StateConfig(directory=folder)
    store = PairStore(
        ESTIMATE_RIG,
        VEHICLE,
        config,
        StateStore(folder, VEHICLE),
        InstantDiskWriter(folder),
        WindowStore(folder / "windows", config),
        LossCounter(LOG, "front"),
        Clock(),
    )
    state = store.state
    accepted = None if state.accepted is None else result_of(state.accepted, ESTIMATE_RIG, VEHICLE)
    to_json(extrinsic_of(VEHICLE, ESTIMATE_RIG, state, accepted, 0.0, "0"))
    for retained in store.publishable_records().entries:
        to_json(retained.chained)
    for check in store.publishable_records().checks:
        to_json(check)
    for result in store.publishable_records().results:
        to_json(result_of(estimate_of(result), ESTIMATE_RIG, VEHICLE))
    store.save()


def _state_seeds() -> list[bytes]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        state = initial_state(ESTIMATE_RIG)
        for window in (1, 2):
            state = after_estimate(state, estimate(window), 0, RULES)
        store = StateStore(folder, VEHICLE)
        store.update(ESTIMATE_RIG, restored(state), Clocks(77, 88, 99), lambda: {"results": f"3 {'a' * 64}"})
        store.flush()
        return [(folder / "state.json").read_bytes(), with_checksum(b'{"pairs":{}}')]


BOOKS: Final = (
    "history-front.jsonl",
    "states-front.jsonl",
    "commands-front.jsonl",
    "checks-front.jsonl",
    "windows.jsonl",
)


def _books(data: bytes, folder: Path) -> None:
    """The first byte chooses which of the files of lines it is."""
    shutil.rmtree(folder / "state", ignore_errors=True)
    (folder / "state").mkdir()
    (folder / "state" / BOOKS[data[0] % len(BOOKS) if data else 0]).write_bytes(data[1:])
    _started(folder / "state")


def _books_seeds() -> list[bytes]:
    result = json.loads(to_json(result_of(estimate(1), ESTIMATE_RIG, VEHICLE)))
    entry = {
        "sequence": 0,
        "previous_sha256": "",
        "kind": "estimate",
        "code": "accepted",
        "text": "A window",
        "wall_ns": 1,
        "stamp_ns": 1,
        "window_id": "front-1",
    }
    served = {**entry, "sequence": 1, "kind": "extrinsic", "camera_from_lidar": result["camera_from_lidar"]}
    version = {"size_bytes": 1, "modified_ns": 1, "sha256": "0" * 64, "pairs": 3, "decision": "accepted"}
    return [
        b"\x00" + book([(entry, result), (served, None)]),
        b"\x01" + book([({**entry, "kind": "state", "code": "healthy"}, None)]),
        b"\x02" + book([({**entry, "kind": "command", "code": "hold"}, None)]),
        b"\x04" + canonical({"window_id": "front-1", "order": 1, "version": version}) + b"\n",
    ]


def _baseline(data: bytes, folder: Path) -> None:
    path = folder / "rig.json"
    path.write_bytes(data)
    load_baseline(path, "front")


def _baseline_seeds() -> list[bytes]:
    return [with_checksum(canonical({"pairs": {"front": baseline_to_json(a_baseline())}}))]


# --- configuration ----------------------------------------------------------------------------------------------------


def _configuration(data: bytes, folder: Path) -> None:
    """As `coec check-config` and the service look at it."""
    if not (folder / "mask.png").exists():
        (folder / "mask.png").write_bytes(GREY)
        (folder / "zenoh.json5").write_bytes(b'{mode: "peer"}')
    path = folder / "coec.yaml"
    path.write_bytes(data)
    config = load_config(path)
    for pair in config.pairs:
        rig_of(pair)
    settings_of(config.zenoh, config.limits)


def _configuration_seeds() -> list[bytes]:
    pair = (
        f"{{name: front, camera: {{key: sensors/camera, intrinsics: {CAMERA}, mask: mask.png}}, "
        f"lidar: {{key: sensors/lidar, sweep: {{period_s: 0.1, sign: -1}}}}, ego: {{key: sensors/ego}}, "
        f"T_camera_lidar: {IDENTITY}}}"
    )
    return [
        f"pairs: [{pair}]\n".encode(),
        f"vehicle: car\nzenoh: {{file: zenoh.json5, connect: [tcp/127.0.0.1:7447]}}\npairs:\n  - {pair}\n".encode(),
        f"zenoh: {{embedded_router: true, listen: ['tls/[::1]:7447#enable_mtls=true']}}\npairs: [{pair}]\n".encode(),
        f"state: {{directory: s, history: 5}}\nlimits: {{max_points: 2048}}\npairs: [{pair}]".encode(),
    ]


def _zenoh(data: bytes, folder: Path) -> None:
    path = folder / "zenoh.json5"
    path.write_bytes(data)
    settings: zenoh.Config = settings_of(ZenohConfig(file=path), LIMITS)
    assert mode_of(settings) in ("router", "peer", "client")


def _zenoh_seeds() -> list[bytes]:
    texts = [
        '{mode: "peer"}',
        '{mode: "router", listen: {endpoints: ["tcp/127.0.0.1:7447"]}} // a router',
        '{mode: "client", connect: {endpoints: {client: ["tls/[::1]:7447#a=b"]}}, scouting: {delay: 3}}',
        '{"listen": {"endpoints": ["tcp/127.0.0.1:7447"], "exit_on_failure": true}, "id": "ab", "namespace": "a/b"}',
        '{listen: {endpoints: {peer: ["tls/0.0.0.0:7447"]}}, transport: {link: {tls: {enable_mtls: true, '
        'root_ca_certificate: "/ca.pem"}}}, access_control: {enabled: true, default_permission: "deny", rules: []}}',
        '{"mode": "peer", "transport": {"unicast": {"max_sessions": 64}, "shared_memory": {"enabled": false}}}',
    ]
    return [text.encode() for text in texts]


def _model_card(data: bytes, folder: Path) -> None:
    path = folder / "network.yaml"
    path.write_bytes(data)
    card = read_card(path)
    for height, width in ((376, 1408), (1400, 1400), (1, 16384)):
        assert min(card.input.size.size_for(height, width)) >= 1


def _model_card_seeds() -> list[bytes]:
    cards = [path.read_bytes() for path in sorted(CARDS.glob("*.yaml"))]
    return [*cards, b"card: midas_small\n"]


# --- the worker -------------------------------------------------------------------------------------------------------

KINDS: Final = (Kind.SOLVE, Kind.CHECK, Kind.OVERLAY, Kind.COMMISSION, None, Kind.REGISTER)
"""A picture is answered as an overlay is."""


def _worker(data: bytes, folder: Path) -> None:
    """An answer over the wire: the first byte chooses the question, and at how many bytes the message is parted."""
    del folder
    kind, parts = KINDS[data[0] % len(KINDS) if data else 0], 1 + (data[0] >> 4 if data else 0)
    ours, theirs = socket.socketpair()
    link = Link(ours.detach())
    try:
        with theirs:
            body = data[1 : 2**14]  # nobody reads while it is sent: it has to fit into the socket
            size = max(1, len(body) // parts)
            theirs.settimeout(1)
            for part in (*(body[at : at + size] for at in range(0, len(body), size)), b""):
                theirs.sendall(struct.pack("!i", len(part)) + part)
        message = link.receive(2**20)
        number_of(message)
        read_answer(message, kind)
    finally:
        link.close()


def _worker_seeds() -> list[bytes]:
    result: CalibrationResult = result_of(estimate(1), ESTIMATE_RIG, VEHICLE)
    answers = [(0, pack_answer(3, Solved(result, None))), (2, pack_answer(4, RenderedImage(b"jpeg")))]
    refused: dict[str, Any] = {"id": 5, "refused": {"code": "bad_window", "text": "damaged"}}
    pose = msgpack.ExtType(1, msgpack.packb([[4, 4], np.eye(4).tobytes()]))
    learned = {"id": 1, "result": {"pose": pose, "baseline_hash": "a", "windows": 2, "pairs": 40}}
    observation = {
        "textured": 4, "stamp_ns": 7, "pair_stamps_ns": [5, 7],
        "flagged": True, "weak": False, "flagged_by_paper": None,
        "metrics": [{"name": "mi", "value": 0.3, "limit": 1.0, "at_least": True}],
        "causes": [{"code": "dark", "text": "It is dark.", "advice": "Wait."}],
        "distance2": 0.1, "drift": None, "dirty": [3],
        "dispersion": 1.5,
        **{name: msgpack.ExtType(1, msgpack.packb([[6], bytes(48)])) for name in
           ("offset", "sigma", "noise", "place", "first_derivative", "second_derivative")},
    }  # fmt: skip
    checked = {"id": 2, "result": {"observation": observation, "baseline_not_used": None}}
    registered = Registered(np.eye(4), np.eye(6), RangeBias(0.01, 0.002), 0.02, 900, 0.4, 2, ())
    answers.append((5, pack_answer(6, registered)))
    messages = [*answers, (0, refused), (3, learned), (1, checked), (4, {"id": 1, "result": None})]
    return [bytes([kind]) + msgpack.packb(message) for kind, message in messages]


# --- all --------------------------------------------------------------------------------------------------------------

YAML_TEXT = (
    b"!!python/object:os.system ",
    b"&a [*a]",
    b"*a",
    b"<<: ",
    b"? ",
    b"- ",
    b"!!timestamp ",
    b".inf",
    b"0x",
    b"\t",
)
JSON_TEXT = (b'"', b"null", b"NaN", b"{}", b"[]", b"\\ud800")

TARGETS: Final = {
    target.name: target
    for target in (
        Target("camera", lambda data, _: _inspected(decode_camera(data, LIMITS)), _camera_seeds, (in_msgpack,)),
        Target("lidar", lambda data, _: _inspected(decode_lidar(data, LIMITS)), _lidar_seeds, (in_msgpack,)),
        Target("ego", lambda data, _: _inspected(decode_ego(data, LIMITS)), _ego_seeds, (in_msgpack,)),
        Target(
            "cdr", _cdr, _cdr_seeds, labels=(*(name.encode() for name in ENCODINGS), b"timestamp", b"time_offset_ns")
        ),
        Target("packed", _packed, _packed_seeds, labels=(b"draco", b"zlib", b"zstd", b"cloudini")),
        Target("odometry", _odometry, lambda: [odometry()], labels=(b"odom\0", b"base_link\0")),
        Target("transforms", _transforms, _transforms_seeds, labels=(b"odom\0", b"base_link\0")),
        Target(
            "pcd", lambda data, folder: _cloud_file(data, folder, "pcd"), _pcd_seeds, labels=(b"FIELDS", b"_", b"ring")
        ),
        Target(
            "npy", lambda data, folder: _cloud_file(data, folder, "npy"), _npy_seeds, labels=(b"'<f8'", b"True", b"(")
        ),
        Target(
            "ply", lambda data, folder: _cloud_file(data, folder, "ply"), _ply_seeds, labels=(b"element", b"property")
        ),
        Target("las", lambda data, folder: _cloud_file(data, folder, "las"), _las_seeds),
        Target("bin", lambda data, folder: _cloud_file(data, folder, "bin"), _bin_seeds),
        Target("npz", lambda data, folder: _cloud_file(data, folder, "npz"), _npz_seeds, (in_archive,)),
        Target("manifest", _manifest, _manifest_seeds, (in_yaml,), (*YAML_TEXT, b"depth", b"double_sphere", b"mei")),
        Target("kitti", _kitti, lambda: [b"R: 1 0 0\nT: 1 2 3\n", b"2013-05-28 08:46:02.904483072\n"]),
        Target("bag", _bag, _bag_seeds, (in_records,), (b"lz4", b"zstd", b"equidistant")),
        Target("ros1", _ros1, _ros1_seeds, labels=(b"op=", b"conn=", b"compression=", b"bz2", b"lz4")),
        Target("translated", _translated, _translated_seeds, labels=(b"timestamp", b"frame_id")),
        Target("video", _video, _video_seeds, labels=(b"\0\0\1\x67", b"\0\0\1\x65", b"\0\0\1\x40\1")),
        Target(
            "packets",
            _packets,
            _packets_seeds,
            labels=(*(profile.encode() for profile in PIXELS), b"\xee\xff", b",1.0"),
        ),
        Target("nominal", _nominal, _nominal_seeds, (behind(1, checksummed),), (b"equidistant", b"camera", *JSON_TEXT)),
        Target("window", _window, _window_seeds, (in_records,), (b"lz4", b"zstd")),
        Target("selector", _selector, _selector_seeds, labels=(b";", b"=", b"/", b"@v1", b"*", b"?", b"_")),
        Target("command", _command, _command_seeds, (behind(7, in_msgpack), behind(7, in_json)), JSON_TEXT),
        Target("state", _state, _state_seeds, (checksummed, checksummed, in_json), JSON_TEXT),
        Target("books", _books, _books_seeds, (behind(1, chained), behind(1, chained), behind(1, in_lines)), JSON_TEXT),
        Target("baseline", _baseline, _baseline_seeds, (checksummed,), JSON_TEXT),
        Target("configuration", _configuration, _configuration_seeds, (in_yaml,), YAML_TEXT),
        Target("zenoh", _zenoh, _zenoh_seeds, (in_json,), (b"endpoints", b"peer:", b"//", b"/*", *JSON_TEXT)),
        Target("model_card", _model_card, _model_card_seeds, (in_yaml,), YAML_TEXT),
        Target(
            "worker",
            _worker,
            _worker_seeds,
            (behind(1, in_msgpack),),
            refusals=(MalformedAnswerError, MalformedMessageError),
        ),
    )
}
