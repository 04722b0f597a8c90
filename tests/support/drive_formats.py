"""One simulated drive in each format that is read, as functions that write it to a folder and return its SOURCE."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Rosbag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys.stores import ros2_humble as ros
from ruamel.yaml import YAML

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.frames.pairing import motion_at
from coec.calibration.types import CameraFrame, EgoMotion, Frame, LidarFrame
from coec.config import LimitsConfig
from coec.geometry import cameras
from coec.io.images import decode_bgr
from coec.io.mcap.writer import write_messages
from coec.io.recordings.recording_source import MOTION_REACH_NS
from coec.io.ros import messages
from coec.io.ros.topics import FrameTopics, PairTopics, TopicMessage
from coec_lab.simulation.drive import DriveConfig, SimulatedDrive
from coec_lab.simulation.lidar_model import Fired, LidarModel
from support.encodings import (
    foxglove_values,
    json_of,
    of_cloudini,
    of_draco,
    of_ros_1,
    of_zlib,
    of_zstd,
    packed_cloud_of,
    protobuf_of,
)
from support.packets import write_entries
from support.recordings import STORE, converted, npy, npz, pcd
from support.ros import Packer
from support.simulated_drives import cached_messages, rendered_source

SIM = "sim:seed=3&seconds=30&camera_hz=0.5&lidar_hz=0.5&camera=pinhole640x400@90&lidar=32"
LIMITS = LimitsConfig()
BEGIN_S, BEGIN_NS = -0.04, -40_000_000
"""From the simulator's stamp, in the middle of a sweep, to that of formats which count from the begin: images come
10 ms after the middle, and have a sweep within 50 ms. Earlier points, at the rear, are left out of these."""

Message = TopicMessage


@cache
def native_messages() -> list[Message]:
    drive = rendered_source(SIM)
    topics = FrameTopics(drive.rig, drive.T_camera_lidar_start, PairTopics.default("front"))
    return [message for frame in drive.messages() for message in topics.of(frame)]


def read(message: Message) -> Any:
    return STORE.deserialize_cdr(message.data, message.type_name)


def written(message: Message, content: Any) -> Message:
    name = content.__msgtype__
    return replace(message, type_name=name, data=bytes(STORE.serialize_cdr(content, name)))


def changed(type_name: str, change: Callable[[Message], Message]) -> list[Message]:
    return [change(one) if one.type_name == type_name else one for one in native_messages()]


def bag(folder: Path, content: list[Message]) -> str:
    entries = [(one.stamp_ns, one.topic, one.type_name, one.data) for one in content]
    return str(write_entries(folder / "drive.mcap", entries))


# --- bags -------------------------------------------------------------------------------------------------------------


def sqlite(folder: Path) -> str:
    return str(converted(Path(bag(folder, native_messages())), folder / "drive", StoragePlugin.SQLITE3))


def split(folder: Path, metadata: str = "") -> str:
    parts = folder / "drive"
    parts.mkdir()
    third = len(native_messages()) // 3
    for number in range(3):
        end = None if number == 2 else (number + 1) * third
        write_messages(parts / f"drive_{number}.mcap", native_messages()[number * third : end])
    if metadata:
        (parts / "metadata.yaml").write_text(metadata)
    return str(parts)


def reindexed(folder: Path) -> str:
    files = "drive_0.mcap, drive_1.mcap, drive_2.mcap"
    return split(folder, f"rosbag2_bagfile_information: {{storage_identifier: '', relative_file_paths: [{files}]}}")


def ros_1_bag(folder: Path) -> str:
    path = folder / "drive.bag"
    with Rosbag1(path) as writer:
        connections: dict[str, Any] = {}
        for one in native_messages():
            name, data = of_ros_1(read(one))
            if one.topic not in connections:
                definition, md5 = STORE.generate_msgdef(name, ros_version=1)
                connections[one.topic] = writer.add_connection(one.topic, name, msgdef=definition, md5sum=md5)
            writer.write(connections[one.topic], one.stamp_ns, data)
    return str(path)


def encoded(folder: Path, encoding: str, of_message: Callable[[Any], tuple[str, bytes]]) -> str:
    path = folder / "drive.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels: dict[str, int] = {}
        for one in native_messages():
            schema, data = of_message(read(one))
            if one.topic not in channels:
                number = writer.register_schema(schema, encoding, b"")
                channels[one.topic] = writer.register_channel(one.topic, encoding, number)
            writer.add_message(channels[one.topic], one.stamp_ns, data, one.stamp_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return str(path)


def foxglove(encode: Callable[[str, dict[str, Any]], bytes]) -> Callable[[Any], tuple[str, bytes]]:
    def of_message(content: Any) -> tuple[str, bytes]:
        schema, values = foxglove_values(content)
        return f"foxglove.{schema}", encode(schema, values)

    return of_message


def ros_1(content: Any) -> tuple[str, bytes]:
    name, data = of_ros_1(content)
    return name.replace("/msg/", "/"), data


# --- images -----------------------------------------------------------------------------------------------------------


def imaged(form: str) -> Callable[[Path], str]:
    return lambda folder: bag(folder, changed(messages.COMPRESSED_IMAGE, lambda one: as_image(one, form)))


def as_image(message: Message, form: str) -> Message:
    content = read(message)
    frame = next(f for f in rendered_source(SIM).messages() if isinstance(f, CameraFrame))
    bgr = decode_bgr(replace(frame.image, data=content.data.tobytes()), LIMITS)
    height, width = bgr.shape[:2]
    if form in ("webp", "tiff"):
        options = [cv2.IMWRITE_WEBP_QUALITY, 101] if form == "webp" else []
        data = cv2.imencode(f".{form}", bgr, options)[1].ravel()
        return written(message, ros.sensor_msgs__msg__CompressedImage(content.header, form, data))
    step = width
    pixels: NDArray[Any]
    match form:
        case "bgr8":
            pixels, step = bgr, 3 * width
        case "rgb16":
            pixels, step = bgr[:, :, ::-1].astype("<u2") << 8, 6 * width
        case _:
            planes = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420)
            u, v = planes[height:].reshape(2, -1)
            pairs = np.stack([u, v] if form == "nv12" else [v, u], axis=1)
            pixels = np.concatenate([planes[:height].ravel(), pairs.ravel()])
    data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
    return written(message, ros.sensor_msgs__msg__Image(content.header, height, width, form, 0, step, data))


# --- clouds in messages -----------------------------------------------------------------------------------------------


def clouded(change: Callable[[Message], Message]) -> Callable[[Path], str]:
    return lambda folder: bag(folder, changed(messages.POINT_CLOUD, change))


def packed(form: str, pack: Callable[[NDArray[Any]], bytes]) -> Callable[[Path], str]:
    return clouded(
        lambda one: replace(one, type_name=messages.COMPRESSED_CLOUD, data=packed_cloud_of(read(one), form, pack))
    )


LIVOX = np.dtype(
    {
        "names": ["offset_time", "x", "y", "z", "intensity", "tag", "line"],
        "formats": ["<u4", "<f4", "<f4", "<f4", "u1", "u1", "u1"],
    }
)


def livox_points(content: Any) -> NDArray[Any]:
    """The points as a Livox numbers and times them: six lasers, from the begin of the sweep."""
    point = np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
    rows = np.frombuffer(content.data.tobytes(), point)
    rows = rows[rows["time"] >= BEGIN_S]
    points = np.zeros(len(rows), LIVOX)
    for axis, name in enumerate("xyz"):
        points[name] = rows["xyz"][:, axis]
    points["offset_time"] = np.rint((rows["time"].astype(float) - BEGIN_S) * 1e9)
    points["intensity"], points["line"] = rows["intensity"], np.arange(len(rows)) % 6
    return points


def as_livox(message: Message, *, custom: bool) -> Message:
    content = read(message)
    points = livox_points(content)
    sec, nsec = divmod(content.header.stamp.sec * 10**9 + content.header.stamp.nanosec + BEGIN_NS, 10**9)
    frame = content.header.frame_id
    if custom:
        packer = Packer().header(frame, sec, nsec).put("Q", sec * 10**9 + nsec).put("I", len(points))
        packer.put("B", 1, 0, 0, 0).put("I", len(points))
        # A point has 19 bytes, and its first field is aligned to four.
        padded = np.zeros(len(points), np.dtype([("point", LIVOX), ("padding", "u1")]))
        padded["point"] = points
        packer.body += bytes(-len(packer.body) % 4) + padded.tobytes()[:-1]
        return replace(message, type_name="livox_ros_driver2/msg/CustomMsg", data=packer.done())
    head = ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(sec, nsec), frame)
    kinds = {"<u4": 6, "<f4": 7, "|u1": 2}
    assert LIVOX.fields is not None
    fields = [
        ros.sensor_msgs__msg__PointField(name, place[1], kinds[place[0].str], 1) for name, place in LIVOX.fields.items()
    ]
    data, step = np.frombuffer(points.tobytes(), np.uint8), LIVOX.itemsize
    cloud = ros.sensor_msgs__msg__PointCloud2(head, 1, len(points), fields, False, step, len(data), data, True)
    return written(message, cloud)


# --- packets of Velodyne ----------------------------------------------------------------------------------------------

FIRING_S, LASER_S, FIRINGS = 46.08e-6, 1.152e-6, 2172
"""Of an HDL-32E (manual 63-9113): time between firings, and between the lasers of one; firings in a turn of 0.1 s."""


class Hdl32:
    """The lasers fire one after the other while the head turns clockwise from the rear."""

    beams, ringed = 32, True
    elevations: NDArray[np.float64] = np.radians(-92 / 3 + 4 / 3 * np.arange(32))

    def fired(self, time_s: float, period_s: float) -> Fired:  # noqa: ARG002 - the same at any time
        later = laser_of(np.arange(32)) * LASER_S / FIRING_S
        azimuth: NDArray[np.float64] = np.pi - 2 * np.pi * (np.arange(FIRINGS)[:, None] + later) / FIRINGS
        rays: list[NDArray[np.float64]] = [
            np.cos(azimuth) * np.cos(self.elevations),
            np.sin(azimuth) * np.cos(self.elevations),
        ]
        rays.append(np.broadcast_to(np.sin(self.elevations), azimuth.shape))
        offset_s = FIRING_S * (np.arange(FIRINGS) - FIRINGS / 2).astype(np.float64)
        return Fired(np.stack(rays, axis=-1), offset_s)


def laser_of(ring: NDArray[Any]) -> NDArray[Any]:
    """The place in a firing of the beam of this number from below."""
    return np.where(ring < 16, 2 * ring, 2 * ring - 31)


def velodyne_drive() -> tuple[SimulatedDrive, list[Frame]]:
    lidar = LidarModel(Hdl32(), period_s=FIRINGS * FIRING_S)
    config = DriveConfig(
        seed=3, seconds=30.0, camera_hz=0.5, lidar_hz=0.5, camera="pinhole640x400@90", half_view_deg=45.0, lidar=lidar
    )
    drive = SimulatedDrive(config)
    return drive, cached_messages("HDL-32E", lambda: list(drive.messages(None)))


def velodyne_scan(sweep: LidarFrame) -> bytes:
    assert sweep.ring is not None
    assert sweep.time_offset_s is not None
    assert sweep.intensity is not None
    units = np.zeros((FIRINGS, 32, 2), int)
    firing = np.rint(sweep.time_offset_s.astype(float) / FIRING_S + FIRINGS / 2).astype(int)
    laser = laser_of(sweep.ring.astype(int))
    units[firing, laser, 0] = np.rint(np.linalg.norm(sweep.xyz_m.astype(float), axis=1) / 0.002)
    units[firing, laser, 1] = np.clip(sweep.intensity, 0, 255)
    begin_ns = sweep.stamp_ns - round(FIRINGS / 2 * FIRING_S * 1e9)
    last_ns = begin_ns + round((FIRINGS - 12) * FIRING_S * 1e9)
    packer = Packer().header(sweep.frame_id, *divmod(last_ns, 10**9)).put("I", FIRINGS // 12)
    for first in range(0, FIRINGS, 12):
        at_ns = begin_ns + round(first * FIRING_S * 1e9)
        sec, nsec = divmod(at_ns, 10**9)
        packer.put("i", sec).put("I", nsec)
        for each in range(first, first + 12):
            packer.body += struct.pack("<HH", 0xEEFF, round(18_000 + 36_000 * each / FIRINGS) % 36_000)
            packer.body += b"".join(struct.pack("<HB", *one) for one in units[each].tolist())
        packer.body += struct.pack("<IBB", at_ns // 1000 % 3_600_000_000, 0x37, 0x21)
    return packer.done()


def velodyne(folder: Path, *, in_packets: bool) -> str:
    drive, frames = velodyne_drive()
    topics = FrameTopics(drive.rig, drive.T_camera_lidar_start, PairTopics.default("front"))
    content: list[Message] = []
    for frame in frames:
        for one in topics.of(frame):
            if in_packets and isinstance(frame, LidarFrame) and one.type_name == messages.POINT_CLOUD:
                one = replace(one, type_name=messages.VELODYNE_SCAN, data=velodyne_scan(frame))
            content.append(one)
    return bag(folder, content)


# --- files ------------------------------------------------------------------------------------------------------------

CloudFile = Callable[[LidarFrame], bytes]


def in_files(
    suffix: str, of_sweep: CloudFile, *, from_begin: bool = False, columns: Sequence[str] = ()
) -> Callable[[Path], str]:
    """The drive as a manifest with clouds in files, stamped at `BEGIN_NS` if their times count from there."""

    def write(folder: Path) -> str:
        drive = rendered_source(SIM)
        motions = [one for one in drive.messages() if isinstance(one, EgoMotion)]
        pictures = [one for one in drive.messages() if isinstance(one, CameraFrame)]
        sweeps = [one for one in drive.messages() if isinstance(one, LidarFrame)]
        frames = []
        for number, (picture, sweep) in enumerate(zip(pictures, sweeps, strict=True)):
            (folder / f"{number}.jpg").write_bytes(picture.image.data)
            (folder / f"{number}.{suffix}").write_bytes(of_sweep(sweep))
            motion = motion_at(motions, sweep.stamp_ns, MOTION_REACH_NS)
            assert motion is not None
            angular, linear = sensor_twist(motion, drive.rig.T_lidar_ego)
            frame = {"image": f"{number}.jpg", "cloud": f"{number}.{suffix}", "stamp_ns": picture.stamp_ns}
            twist = {"linear_mps": linear.tolist(), "angular_radps": angular.tolist()}
            stamp_ns = sweep.stamp_ns + (BEGIN_NS if from_begin else 0)
            frames.append({**frame, "cloud_stamp_ns": stamp_ns, "twist": twist})
        camera = drive.rig.camera
        lens = {"model": cameras.name_of(camera), "width": camera.width, "height": camera.height}
        document = {
            "pair": "drive",
            "camera": {**lens, **cameras.intrinsics_of(camera)},
            "T_camera_lidar": drive.T_camera_lidar_start.tolist(),
            **({"cloud_columns": list(columns)} if columns else {}),
            "frames": frames,
        }
        with (folder / "dataset.yaml").open("w") as stream:
            YAML().dump(document, stream)
        return str(folder)

    return write


def table(sweep: LidarFrame, *names: str) -> list[NDArray[Any]]:
    x, y, z = sweep.xyz_m.T
    assert sweep.time_offset_s is not None
    begin = sweep.time_offset_s.astype(float) - BEGIN_S
    columns = {
        "x": x, "y": y, "z": z, "intensity": sweep.intensity, "ring": sweep.ring, "time": sweep.time_offset_s,
        "offset_time": np.rint(begin * 1e9).clip(0).astype("<u4"), "t": np.rint(begin * 1e6).clip(0).astype("<u4"),
        "time_ms": (1e3 * sweep.time_offset_s.astype(float)).astype("<f4"),
        "timestamp": sweep.stamp_ns * 1e-9 + sweep.time_offset_s.astype(float),
    }  # fmt: skip
    return [np.asarray(columns[name]) for name in names]


def rows_of(sweep: LidarFrame, *names: str) -> NDArray[Any]:
    values = table(sweep, *names)
    rows = np.zeros(len(sweep.xyz_m), [(name, one.dtype) for name, one in zip(names, values, strict=True)])
    for name, one in zip(names, values, strict=True):
        rows[name] = one
    return rows


ALL = ("x", "y", "z", "intensity", "ring", "time")


def floats(*names: str) -> CloudFile:
    return lambda sweep: np.column_stack(table(sweep, *names)).astype("<f4").tobytes()


def of_npz(*left_out: str) -> CloudFile:
    def write(sweep: LidarFrame) -> bytes:
        members = {
            "xyz": sweep.xyz_m,
            "intensity": sweep.intensity,
            "ring": sweep.ring,
            "time_offset_s": sweep.time_offset_s,
        }
        return npz(**{name: npy(np.asarray(one)) for name, one in members.items() if name not in left_out})

    return write


def of_pcd(encoding: str, time: str = "time", padding: bool = False, viewpoint: bool = False) -> CloudFile:
    def write(sweep: LidarFrame) -> bytes:
        names = (*ALL[:5], time)
        rows = rows_of(sweep, *names)
        if time in ("t", "offset_time"):
            rows = rows[rows[time] > 0]
        kinds = [rows.dtype[name] for name in names]
        if encoding == "ascii":
            body = "\n".join(" ".join(map(repr, row)) for row in rows.tolist()).encode()
        elif encoding == "binary":
            body = rows.tobytes()
        else:
            columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in names)
            literal = b"".join(
                bytes([len(part) - 1]) + part
                for part in (columns[first : first + 32] for first in range(0, len(columns), 32))
            )
            body = struct.pack("<II", len(literal), len(columns)) + literal
        fields = [name.removesuffix("_ms") for name in names]
        sizes, types = [str(kind.itemsize) for kind in kinds], [kind.kind.upper() for kind in kinds]
        counts = ["1"] * len(fields)
        if padding:
            fields.insert(3, "_")
            sizes.insert(3, "1")
            types.insert(3, "U")
            counts.insert(3, "0")
        data = pcd(" ".join(fields), " ".join(sizes), " ".join(types), len(rows), encoding, body, " ".join(counts))
        return data.replace(b"POINTS", b"VIEWPOINT 1 0.5 0.2 1 0 0 0\nPOINTS", 1) if viewpoint else data

    return write


def of_ply(form: str) -> CloudFile:
    def write(sweep: LidarFrame) -> bytes:
        rows = rows_of(sweep, *ALL)
        properties = "".join(f"property {'ushort' if name == 'ring' else 'float'} {name}\n" for name in ALL)
        head = f"ply\nformat {form} 1.0\nelement vertex {len(rows)}\n{properties}end_header\n".encode()
        if form == "ascii":
            return head + "\n".join(" ".join(map(repr, row)) for row in rows.tolist()).encode()
        big = rows.astype(rows.dtype.newbyteorder(">"))
        return head + (big if form == "binary_big_endian" else rows).tobytes()

    return write


def of_las(sweep: LidarFrame) -> bytes:
    laspy = pytest.importorskip("laspy")
    file = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    file.header.scales = np.full(3, 0.001)
    file.x, file.y, file.z = sweep.xyz_m.T.astype(float)
    file.intensity = np.asarray(sweep.intensity).astype(np.uint16)
    (file.gps_time,) = table(sweep, "timestamp")
    stream = io.BytesIO()
    file.write(stream)
    return stream.getvalue()


NATIVE: dict[str, Callable[[Path], str]] = {
    "bag": lambda folder: bag(folder, native_messages()),
    "bgr8": imaged("bgr8"),
    "no rings": lambda folder: f"{bag(folder, native_messages())}?rings=none",
    "Livox as points": clouded(lambda one: as_livox(one, custom=False)),
    "Velodyne as points": lambda folder: velodyne(folder, in_packets=False),
    "npz": in_files("npz", of_npz()),
    "npz without times": in_files("npz", of_npz("time_offset_s")),
    "npz without rings": in_files("npz", of_npz("ring")),
}

LOSSLESS: dict[str, tuple[str, Callable[[Path], str]]] = {
    "SQLite": ("bag", sqlite),
    "folder without metadata": ("bag", split),
    "re-indexed folder": ("bag", reindexed),
    "ROS 1 bag": ("bag", ros_1_bag),
    "ROS 1 in MCAP": ("bag", lambda folder: encoded(folder, "ros1", ros_1)),
    "Foxglove in protobuf": ("bag", lambda folder: encoded(folder, "protobuf", foxglove(protobuf_of))),
    "Foxglove in JSON": ("bag", lambda folder: encoded(folder, "json", foxglove(json_of))),
    "TIFF": ("bgr8", imaged("tiff")),
    "WebP": ("bgr8", imaged("webp")),
    "rgb16": ("bgr8", imaged("rgb16")),
    "zlib": ("bag", packed("zlib", of_zlib)),
    "zstd": ("bag", packed("zstd", of_zstd)),
    "Cloudini, lossless": ("bag", packed("cloudini", of_cloudini)),
    "Livox's CustomMsg": ("Livox as points", clouded(lambda one: as_livox(one, custom=True))),
    "npy, named fields": ("npz", in_files("npy", lambda sweep: npy(rows_of(sweep, *ALL)))),
    "npy, N x 6": ("npz", in_files("npy", lambda sweep: npy(np.column_stack(table(sweep, *ALL))), columns=ALL)),
    "bin, six floats": ("npz", in_files("bin", floats(*ALL), columns=ALL)),
    "nuScenes": ("npz without times", in_files("bin", floats(*ALL[:5]))),
    "ply": ("npz", in_files("ply", of_ply("binary_little_endian"))),
    "ply, big endian": ("npz", in_files("ply", of_ply("binary_big_endian"))),
    "ply, text": ("npz", in_files("ply", of_ply("ascii"))),
    "pcd, text": ("npz", in_files("pcd", of_pcd("ascii"))),
    "pcd": ("npz", in_files("pcd", of_pcd("binary"))),
    "pcd, compressed": ("npz", in_files("pcd", of_pcd("binary_compressed"))),
    "pcd, COUNT 0": ("npz", in_files("pcd", of_pcd("binary", padding=True))),
    "pcd, VIEWPOINT": ("npz", in_files("pcd", of_pcd("binary", viewpoint=True))),
}

LOSSY: dict[str, tuple[str, Callable[[Path], str]]] = {
    "nv12": ("bgr8", imaged("nv12")),
    "nv21": ("bgr8", imaged("nv21")),
    "Cloudini, 1 mm": ("bag", packed("cloudini", lambda rows: of_cloudini(rows, 0.001))),
    "Draco, 14 bits": ("bag", packed("draco", lambda rows: of_draco(rows, bits=14))),
    "Velodyne's packets": ("Velodyne as points", lambda folder: velodyne(folder, in_packets=True)),
    "files": ("bag", in_files("npz", of_npz())),
    "pcd, ms": ("npz", in_files("pcd", of_pcd("binary", "time_ms"))),
    "pcd, us": ("npz", in_files("pcd", of_pcd("binary", "t"), from_begin=True)),
    "pcd, ns": ("npz", in_files("pcd", of_pcd("binary", "offset_time"), from_begin=True)),
    "pcd, absolute": ("npz", in_files("pcd", of_pcd("binary", "timestamp"))),
    "las": ("npz without rings", in_files("las", of_las)),
}
