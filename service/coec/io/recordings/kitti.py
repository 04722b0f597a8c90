"""KITTI raw (Geiger, Lenz, Stiller, Urtasun 2013), in the official layout or one drive with its calibration, and what
the KITTI layouts share: number files, time stamps, Velodyne scans, image files.

As in KITTI-360 the sweep carries the stamp of the camera, because the Velodyne triggers the cameras when it looks
forward (Geiger et al. 2013, section III: "the cameras are triggered at 10 frames per second by the laser scanner, when
facing forward"). Without `timestamps.txt`, consecutive frame numbers count as 0.1 s apart.

Extrinsics: T_camera_lidar = [I | K⁻¹ p] · R_rect_00 · Tr_velo_to_cam, with P_rect_k = [K | p] (development kit).
"""

import re
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, Matrix4, Rig, SweepTiming
from coec.config import LimitsConfig
from coec.errors import DecodeError, SourceError
from coec.geometry import cameras
from coec.io.images import probe
from coec.io.recordings.cloud_files import XYZI, CloudLayout, load_cloud
from coec.io.recordings.recording_source import FramewiseRecording, RecordedFrame, SourceSpec
from coec.io.user_files import read_bytes

NS_PER_S = 1_000_000_000

MAX_TEXT_BYTES = 32 * 2**20
"""Largest text file, bytes. The poses of the longest drive of KITTI-360, 19,240 frames, have 4 MB."""

_STAMP = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(?:\.(\d{1,9}))?")


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        SourceError: it is absent or not text.
    """
    try:
        return read_bytes(path, MAX_TEXT_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not a text file (byte {error.start})") from error


def read_numbers(path: Path) -> dict[str, NDArray[np.float64]]:
    """Lines `key: number number ...` by key; lines whose values are not numbers (dates) are left out.

    Raises:
        SourceError: the file is absent or not text.
    """
    result: dict[str, NDArray[np.float64]] = {}
    for line in read_text(path).splitlines():
        key, colon, values = line.partition(":")
        if not colon:
            continue
        try:
            result[key.strip()] = np.array([float(value) for value in values.split()])
        except ValueError:
            continue
    return result


def numbers_of(path: Path, numbers: dict[str, NDArray[np.float64]], key: str, count: int) -> NDArray[np.float64]:
    """The `count` finite numbers of a key.

    Raises:
        SourceError: the key is absent, has another count, or holds NaN; names file and key.
    """
    values = numbers.get(key)
    if values is None:
        raise SourceError(f"{path} has no entry {key}")
    if values.size != count or not np.isfinite(values).all():
        raise SourceError(f"{path}: {key} must hold {count} finite numbers, found {values.size}")
    return values


def homogeneous(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) from the 12 numbers of a 3 by 4 matrix, or the 9 numbers of a rotation."""
    T = np.eye(4)
    block = rows.reshape(3, -1)
    T[:3, : block.shape[1]] = block
    return T


def rigid(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """T with its rotation made orthonormal. The files print six digits, so products of their matrices are off by 1e-6.

    Takes the nearest rotation in the Frobenius norm, by singular value decomposition.
    """
    u, _, vt = np.linalg.svd(T[:3, :3])
    result = T.copy()
    result[:3, :3] = u @ vt
    return result


def read_stamps(path: Path) -> list[int]:
    """Stamps of `timestamps.txt` (`2013-05-28 08:46:02.904483072`, taken as UTC), nanoseconds since 1970.

    Raises:
        SourceError: the file is absent, or a line is no stamp; names the line.
    """
    stamps = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        match = _STAMP.fullmatch(line.strip())
        try:
            if match is None:
                raise ValueError
            seconds = datetime.strptime(match[1], "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        except ValueError as error:
            raise SourceError(f"{path}, line {number}: not a time stamp like 2013-05-28 08:46:02.904483072") from error
        stamps.append(int(seconds.timestamp()) * NS_PER_S + int((match[2] or "0").ljust(9, "0")))
    return stamps


def numbered_files(folder: Path, suffix: str) -> dict[int, Path]:
    """Files of a folder whose name is a frame number, by that number.

    Raises:
        SourceError: there is no such folder.
    """
    if not folder.is_dir():
        raise SourceError(f"there is no folder {folder}")
    return {int(path.stem): path for path in sorted(folder.glob(f"*{suffix}")) if path.stem.isdecimal()}


def select_one(candidates: list[str], requested: str | None, what: str, root: Path) -> str:
    """The candidate that was asked for, or the only one there.

    Raises:
        SourceError: there is none, there are several and none was asked for, or the one asked for is absent; lists what
            is there.
    """
    there = ", ".join(candidates[:12]) or "none"
    if requested is not None:
        if requested not in candidates:
            raise SourceError(f"{root} has no {what} {requested}; there: {there}")
        return requested
    if not candidates:
        raise SourceError(f"{root} has no {what}: give the folder that holds the {what}s as they were unpacked")
    if len(candidates) != 1:
        raise SourceError(f"{root} has {len(candidates)} {what}s, choose one with ?{what}=...; there: {there}")
    return candidates[0]


def stamp_of(stamps_ns: list[int], index: int, path: Path) -> int:
    """Stamp of frame `index`.

    Raises:
        SourceError: the file has fewer lines.
    """
    if index >= len(stamps_ns):
        raise SourceError(f"{path} ends before frame {index}: it has {len(stamps_ns)} stamps")
    return stamps_ns[index]


def median_period_s(stamps_ns: list[int], default_s: float) -> float:
    """Median distance of consecutive stamps in seconds; the default if there are fewer than two."""
    if len(stamps_ns) < 2:
        return default_s
    return float(np.median(np.diff(np.array(stamps_ns, dtype=np.int64)))) / NS_PER_S


def load_image(path: Path) -> EncodedImage:
    """A JPEG or PNG file as it is, its size read from its header.

    Raises:
        SourceError: the file is absent or not an image; names it.
    """
    try:
        return probe(read_bytes(path), LimitsConfig())
    except DecodeError as error:
        raise SourceError(f"{path}: {error}") from error


def load_camera(stamp_ns: int, frame_id: str, image: Path, depth: Path | None) -> CameraFrame:
    """A camera frame from its image file and, where there is one, its depth map (16-bit PNG).

    Raises:
        SourceError: a file cannot be read; names it.
    """
    return CameraFrame(stamp_ns, frame_id, load_image(image), depth=None if depth is None else load_image(depth))


CAMERAS = ("image_00", "image_01", "image_02", "image_03")
LIDAR_FRAME = "velodyne"
EGO_FRAME = "imu"

FRAME_PERIOD_NS = 100_000_000
"""The HDL-64 turns at 10 Hz."""

OXTS_FIELDS = 30
"""Numbers in a line of oxts/data (dataformat.txt of the development kit)."""

_LINEAR = (8, 9, 10)
"""vf, vl, vu: forward, leftward, upward velocity, m/s. vf and vl are parallel to the ground and vu is perpendicular to
it. On a road these axes agree with the vehicle's own within slope and roll, some degrees."""

_ANGULAR = (20, 21, 22)
"""wf, wl, wu: angular rates about the forward, leftward, upward axis, rad/s."""


def open_kitti_raw(spec: SourceSpec) -> FramewiseRecording:
    """`kitti-raw:ROOT?drive=2011_09_26_drive_0005_sync&camera=image_02`.

    ROOT is the folder of the date folders, a date folder, or a single drive that holds the `calib_*.txt` itself (then
    there is no drive to choose). The drive defaults to the only one there is.

    Raises:
        UsageError: unknown query key.
        SourceError: something is missing or malformed; names the file.
    """
    query = spec.only("drive", "camera")
    drive, calibration = _locate(spec.path, query.get("drive"))
    camera = query.get("camera", "image_02")
    if camera not in CAMERAS:
        raise SourceError(f"KITTI raw has no camera {camera}; there are {', '.join(CAMERAS)}")
    images = numbered_files(drive / camera / "data", ".png")
    clouds = numbered_files(drive / "velodyne_points" / "data", ".bin")
    indices = sorted(images.keys() & clouds.keys())
    if not indices:
        raise SourceError(f"{drive}: no frame has both an image of {camera} and a Velodyne scan")
    stamps_ns = _stamps(drive / camera / "timestamps.txt", indices[-1])
    frames = [
        RecordedFrame(
            stamps_ns[index],
            partial(load_camera, stamps_ns[index], camera, images[index], None),
            stamps_ns[index],
            partial(load_cloud, stamps_ns[index], LIDAR_FRAME, clouds[index], CloudLayout(XYZI)),
        )
        for index in indices
    ]
    image = load_image(images[indices[0]])
    T_camera_lidar, model = _calibration(calibration, camera.removeprefix("image_"), image.width, image.height)
    rig = Rig(
        pair=camera,
        camera=model,
        camera_frame=camera,
        lidar_frame=LIDAR_FRAME,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=_imu_to_velo(calibration / "calib_imu_to_velo.txt"),
        sweep=SweepTiming(median_period_s(stamps_ns, 0.1), sign=-1, stamp_azimuth_rad=0.0),
    )
    name = f"kitti-raw/{drive.name}/{camera}"
    return FramewiseRecording(name, rig, T_camera_lidar, tuple(frames), _motions(drive / "oxts", stamps_ns))


def _locate(root: Path, requested: str | None) -> tuple[Path, Path]:
    """The folder of the drive and the folder of its calibration."""
    if not root.is_dir():
        raise SourceError(f"there is no folder {root}")
    if (root / "velodyne_points").is_dir():
        if requested is not None and requested != root.name:
            raise SourceError(f"{root} is a single drive: leave ?drive= out")
        has_calibration = (root / "calib_velo_to_cam.txt").is_file()
        return root, root if has_calibration else root.resolve().parent
    if (root / "calib.txt").is_file() and (root / "velodyne").is_dir():
        raise SourceError(f"{root} is a sequence of KITTI's odometry benchmark: write kitti-odometry:{root}")
    drives = {path.parent.name: path.parent for depth in ("*", "*/*") for path in root.glob(f"{depth}/velodyne_points")}
    drive = drives[select_one(sorted(drives), requested, "drive", root)]
    return drive, drive.parent


def _stamps(path: Path, last: int) -> list[int]:
    """Stamps of at least the frames 0 ... last, nanoseconds."""
    if not path.is_file():
        return [index * FRAME_PERIOD_NS for index in range(last + 1)]
    stamps_ns = read_stamps(path)
    stamp_of(stamps_ns, last, path)
    return stamps_ns


def _calibration(folder: Path, number: str, width: int, height: int) -> tuple[Matrix4, cameras.Camera]:
    cam_path, velo_path = folder / "calib_cam_to_cam.txt", folder / "calib_velo_to_cam.txt"
    cam, velo = read_numbers(cam_path), read_numbers(velo_path)
    P = numbers_of(cam_path, cam, f"P_rect_{number}", 12).reshape(3, 4)
    baseline = np.eye(4)
    baseline[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    T_cam0_velo = homogeneous(numbers_of(velo_path, velo, "R", 9))
    T_cam0_velo[:3, 3] = numbers_of(velo_path, velo, "T", 3)
    T_camera_lidar = rigid(baseline @ homogeneous(numbers_of(cam_path, cam, "R_rect_00", 9)) @ T_cam0_velo)
    model = cameras.build("pinhole", width=width, height=height, fx=P[0, 0], fy=P[1, 1], cx=P[0, 2], cy=P[1, 2])
    return T_camera_lidar, model


def _imu_to_velo(path: Path) -> Matrix4:
    """T_lidar_ego; the identity if the file is absent (the sensors are less than a metre apart)."""
    if not path.is_file():
        return np.eye(4)
    numbers = read_numbers(path)
    T = homogeneous(numbers_of(path, numbers, "R", 9))
    T[:3, 3] = numbers_of(path, numbers, "T", 3)
    return rigid(T)


def _motions(folder: Path, camera_stamps_ns: list[int]) -> tuple[EgoMotion, ...]:
    """One sample per file of oxts/data, at its own stamp, else at that of the camera frame of the same number."""
    if not (folder / "data").is_dir():
        return ()
    stamps_path = folder / "timestamps.txt"
    stamps_ns = read_stamps(stamps_path) if stamps_path.is_file() else camera_stamps_ns
    motions = []
    for index, path in sorted(numbered_files(folder / "data", ".txt").items()):
        try:
            values = np.array([float(value) for value in read_text(path).split()])
        except ValueError as error:
            raise SourceError(f"{path}: {error}") from error
        if values.size != OXTS_FIELDS or not np.isfinite(values).all():
            raise SourceError(f"{path}: expected {OXTS_FIELDS} finite numbers, found {values.size}")
        if stamps_ns is camera_stamps_ns and index >= len(stamps_ns):
            continue  # beyond the last frame, so nothing gives its time
        motions.append(
            EgoMotion(
                stamp_of(stamps_ns, index, stamps_path),
                EGO_FRAME,
                _vector(values, _LINEAR),
                _vector(values, _ANGULAR),
            )
        )
    return tuple(sorted(motions, key=lambda motion: motion.stamp_ns))


def _vector(values: NDArray[np.float64], places: tuple[int, int, int]) -> tuple[float, float, float]:
    x, y, z = (float(values[place]) for place in places)
    return x, y, z
