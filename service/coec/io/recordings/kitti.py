"""The layouts of KITTI: raw drives in the official layout or one drive with its calibration (Geiger, Lenz, Stiller,
Urtasun 2013), the odometry benchmark (Geiger, Lenz, Urtasun 2012) and KITTI-360 (Liao, Xie, Geiger 2022).

Raw drives. The sweep carries the stamp of the *camera*, because the Velodyne triggers the cameras when it looks forward
(Geiger et al. 2013, section III: "the cameras are triggered at 10 frames per second by the laser scanner, when facing
forward"). Without `timestamps.txt`, consecutive frame numbers count as 0.1 s apart.
T_camera_lidar = [I | K⁻¹ p] · R_rect_00 · Tr_velo_to_cam, with P_rect_k = [K | p] (development kit).

Odometry benchmark. One sequence in its official folders, `image_0` to `image_3`, `velodyne`, `calib.txt` and
`times.txt`. The scans were compensated for the vehicle's motion when the benchmark was made, and the images are
rectified. T_camera_lidar = [I | K⁻¹ p] · Tr, with P_k = [K | p] (development kit).

KITTI-360. The exposure is the instant at which the HDL-64 measures azimuth 0, and
`SweepTiming(sign=-1, stamp_azimuth_rad=0)` counts from it. The recording agrees: over the 11,518 frames of drive 0000
the two `timestamps.txt` differ by -0.2 to 0.9 ms, a slow drift of two clocks with only 0.05 ms of noise within 20
frames, and their frame periods correlate at 0.88. So there is one trigger, which is stamped twice. The camera's stamp
is the one that the image and the poses share. `calib_cam_to_velo.txt` maps the unrectified camera 0 to the Velodyne,
`calib_cam_to_pose.txt` every unrectified camera to the pose frame (GPS/IMU). With R_rect of the perspective pair:
T_camera_lidar = R_rect_k · T_pose_camk⁻¹ · T_pose_cam0 · T_velo_cam0⁻¹ (as the official development kit). The fourth
column of P_rect_01 is *not* added: it refers to camera 0, and the baseline is in T_pose_cam1 already.
"""

import re
from bisect import bisect_left, bisect_right
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import (
    NS_PER_S,
    CameraFrame,
    EgoMotion,
    EncodedImage,
    Matrix4,
    Recognition,
    Rig,
    SweepTiming,
)
from coec.config import LimitsConfig, parse_yaml
from coec.errors import ConfigError, DecodeError, SourceError
from coec.geometry import cameras, se3
from coec.io.images import probe
from coec.io.recordings.cloud_files import XYZI, CloudLayout, load_cloud
from coec.io.recordings.recording_source import FramewiseRecording, RecordedFrame, SourceSpec
from coec.io.user_files import read_bytes

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


def _indices(images: dict[int, Path], clouds: dict[int, Path], none: str) -> list[int]:
    """The numbers of frames with an image and a scan, in order. Raises SourceError with the text `none` if there are
    none."""
    indices = sorted(images.keys() & clouds.keys())
    if not indices:
        raise SourceError(none)
    return indices


def _frame(stamp_ns: int, camera: str, image: Path, cloud: Path, depth: Path | None = None) -> RecordedFrame:
    """An image and the scan with its number. The scan carries the stamp of the camera, which it triggers."""
    load_picture = partial(load_camera, stamp_ns, camera, image, depth)
    load_scan = partial(load_cloud, stamp_ns, LIDAR_FRAME, cloud, CloudLayout(XYZI))
    return RecordedFrame(stamp_ns, load_picture, stamp_ns, load_scan)


# --- raw drives -------------------------------------------------------------------------------------------------------

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
    indices = _indices(images, clouds, f"{drive}: no frame has both an image of {camera} and a Velodyne scan")
    stamps_ns = _stamps(drive / camera / "timestamps.txt", indices[-1])
    frames = tuple(_frame(stamps_ns[index], camera, images[index], clouds[index]) for index in indices)
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
    return FramewiseRecording(name, rig, T_camera_lidar, frames, _motions(drive / "oxts", stamps_ns))


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
    cam = read_numbers(cam_path)
    P = numbers_of(cam_path, cam, f"P_rect_{number}", 12).reshape(3, 4)
    baseline = np.eye(4)
    baseline[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    R_rect = homogeneous(numbers_of(cam_path, cam, "R_rect_00", 9))
    return rigid(baseline @ R_rect @ _rotation_and_translation(velo_path)), _pinhole(P, width, height)


def _pinhole(P: NDArray[np.float64], width: int, height: int) -> cameras.Camera:
    """The camera of a projection matrix (3, 4)."""
    return cameras.build("pinhole", width=width, height=height, fx=P[0, 0], fy=P[1, 1], cx=P[0, 2], cy=P[1, 2])


def _rotation_and_translation(path: Path) -> NDArray[np.float64]:
    """(4, 4) from the entries R and T of a file."""
    numbers = read_numbers(path)
    T = homogeneous(numbers_of(path, numbers, "R", 9))
    T[:3, 3] = numbers_of(path, numbers, "T", 3)
    return T


def _imu_to_velo(path: Path) -> Matrix4:
    """T_lidar_ego; the identity if the file is absent (the sensors are less than a metre apart)."""
    return rigid(_rotation_and_translation(path)) if path.is_file() else np.eye(4)


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


# --- the odometry benchmark -------------------------------------------------------------------------------------------

ODOMETRY_CAMERAS = ("image_0", "image_1", "image_2", "image_3")

COMPENSATED = Recognition(
    "already_compensated",
    "The scans of KITTI's odometry benchmark are compensated for motion already: they are taken as they are.",
)


def is_kitti_odometry(path: Path) -> bool:
    """Whether a folder is a sequence of the benchmark."""
    return path.is_dir() and (path / "calib.txt").is_file() and (path / "velodyne").is_dir()


def open_kitti_odometry(spec: SourceSpec) -> FramewiseRecording:
    """`kitti-odometry:SEQUENCE?camera=image_2`. The camera defaults to the colour camera on the left, else to the only
    one there is.

    Raises:
        UsageError: unknown query key.
        SourceError: something is missing or malformed; names the file.
    """
    query = spec.only("camera")
    folder = spec.path
    if not is_kitti_odometry(folder):
        raise SourceError(f"{folder} is no sequence of KITTI's odometry benchmark: it lacks calib.txt or velodyne")
    there = [name for name in ODOMETRY_CAMERAS if (folder / name).is_dir()]
    camera = select_one(there, query.get("camera", "image_2" if "image_2" in there else None), "camera", folder)
    images = numbered_files(folder / camera, ".png") or numbered_files(folder / camera, ".jpg")
    clouds = numbered_files(folder / "velodyne", ".bin")
    indices = _indices(images, clouds, f"{folder}: no frame has both an image of {camera} and a Velodyne scan")
    stamps_ns = _odometry_stamps(folder / "times.txt", indices[-1])
    image, path = load_image(images[indices[0]]), folder / "calib.txt"
    numbers = read_numbers(path)
    P = numbers_of(path, numbers, f"P{camera[-1]}", 12).reshape(3, 4)
    if not P[0, 0] > 0.0 or not P[1, 1] > 0.0:
        raise SourceError(f"{path}: P{camera[-1]} has no focal length")
    T_camera_cam0 = np.eye(4)
    T_camera_cam0[:3, 3] = np.linalg.solve(np.array([[P[0, 0], 0, P[0, 2]], [0, P[1, 1], P[1, 2]], [0, 0, 1]]), P[:, 3])
    T_cam0_velo = homogeneous(numbers_of(path, numbers, "Tr", 12))
    T_camera_lidar = rigid(T_camera_cam0 @ T_cam0_velo)
    rig = Rig(
        pair=camera,
        camera=_pinhole(P, image.width, image.height),
        camera_frame=camera,
        lidar_frame=LIDAR_FRAME,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4),
    )
    frames = tuple(_frame(stamps_ns[index], camera, images[index], clouds[index]) for index in indices)
    name = f"kitti-odometry/{folder.resolve().name}/{camera}"
    return FramewiseRecording(name, rig, T_camera_lidar, frames, recognitions=(COMPENSATED,))


def _odometry_stamps(path: Path, last: int) -> list[int]:
    """Stamps of the frames 0 ... last from `times.txt`, seconds since the first one; at 10 Hz without it."""
    if not path.is_file():
        return [index * FRAME_PERIOD_NS for index in range(last + 1)]
    try:
        seconds = [float(line) for line in read_text(path).split()]
        stamps_ns = [round(value * NS_PER_S) for value in seconds]
    except (ValueError, OverflowError) as error:
        raise SourceError(f"{path}: a line is no time in seconds") from error
    stamp_of(stamps_ns, last, path)
    if any(later <= earlier for earlier, later in pairwise(stamps_ns)) or stamps_ns[0] < 0:
        raise SourceError(f"{path}: the times do not ascend from 0")
    return stamps_ns


# --- KITTI-360 --------------------------------------------------------------------------------------------------------

PERSPECTIVE = {"image_00": "00", "image_01": "01"}
FISHEYE = ("image_02", "image_03")

NOMINAL_PERIOD_S = 0.1
"""Time of one revolution of the HDL-64 at 10 Hz, seconds; used for a drive of one frame."""

MAX_POSE_GAP_S = 1.0
MAX_GAP_MOTION_M = 0.5
"""Poses are recorded every 0.2 to 1.4 m of travel. A gap longer than a second in which the vehicle moved less than half
a metre is a halt, and the mean over it is accurate enough. A gap with more motion is an outage: no ego-motion is
given."""


def open_kitti360(spec: SourceSpec) -> FramewiseRecording:
    """`kitti360:ROOT?drive=…&camera=image_00[&depth=FOLDER]`.

    The drive defaults to the only one there is, `depth` to `stereo_disparity_<camera number>` if ROOT has it. There is
    a frame wherever both image and scan exist.

    Raises:
        UsageError: unknown query key.
        SourceError: something is missing or malformed; names the file.
    """
    query, root = spec.only("drive", "camera", "depth"), spec.path
    images_root = root / "data_2d_raw"
    if not images_root.is_dir():
        raise SourceError(f"{root} is not a KITTI-360 root: it has no folder data_2d_raw")
    drive = select_one(sorted(p.name for p in images_root.iterdir() if p.is_dir()), query.get("drive"), "drive", root)
    camera = query.get("camera", "image_00")
    if camera not in (*PERSPECTIVE, *FISHEYE):
        raise SourceError(f"KITTI-360 has no camera {camera}; there are {', '.join((*PERSPECTIVE, *FISHEYE))}")
    rectified = camera in PERSPECTIVE
    images = numbered_files(images_root / drive / camera / ("data_rect" if rectified else "data_rgb"), ".png")
    velodyne = root / "data_3d_raw" / drive / "velodyne_points"
    clouds = numbered_files(velodyne / "data", ".bin")
    indices = _indices(images, clouds, f"{root}: no frame of {drive} has both an image of {camera} and a Velodyne scan")
    stamps_path = _stamps_path(images_root / drive, camera, velodyne)
    stamps_ns = read_stamps(stamps_path)
    depths = _depth_maps(root, camera, query.get("depth"))
    frames = tuple(
        _frame(stamp_of(stamps_ns, index, stamps_path), camera, images[index], clouds[index], depths.get(index))
        for index in indices
    )
    calibration = root / "calibration"
    T_pose_cam, T_velo_cam0 = _camera_poses(calibration), _velo_from_cam0(calibration)
    T_lidar_pose = T_velo_cam0 @ se3.inverse(T_pose_cam["image_00"])
    T_camera_lidar = se3.inverse(T_lidar_pose @ T_pose_cam[camera])
    if rectified:
        T_camera_lidar = _rectification(calibration, PERSPECTIVE[camera]) @ T_camera_lidar
    T_camera_lidar = rigid(T_camera_lidar)
    image = load_image(images[indices[0]])
    rig = Rig(
        pair=camera,
        camera=_perspective(calibration, PERSPECTIVE[camera], image.width, image.height)
        if rectified
        else _fisheye(calibration / f"{camera}.yaml"),
        camera_frame=camera,
        lidar_frame=LIDAR_FRAME,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4),
        sweep=SweepTiming(median_period_s(stamps_ns, NOMINAL_PERIOD_S), sign=-1, stamp_azimuth_rad=0.0),
    )
    motions = _pose_motions(root / "data_poses" / drive / "poses.txt", indices, stamps_ns, rigid(T_lidar_pose))
    return FramewiseRecording(f"kitti360/{drive}/{camera}", rig, T_camera_lidar, frames, motions)


def _stamps_path(images: Path, camera: str, velodyne: Path) -> Path:
    """Stamps of the camera, else of another camera (all share one trigger), else of the Velodyne (within 1.2 ms)."""
    candidates = [images / name / "timestamps.txt" for name in (camera, *PERSPECTIVE, *FISHEYE)]
    candidates.append(velodyne / "timestamps.txt")
    for path in candidates:
        if path.is_file():
            return path
    raise SourceError(f"there is no timestamps.txt, looked for {candidates[0]} and those of the other sensors")


def _depth_maps(root: Path, camera: str, requested: str | None) -> dict[int, Path]:
    folder = root / (requested or f"stereo_disparity_{camera.removeprefix('image_')}")
    if requested is None and not folder.is_dir():
        return {}
    return numbered_files(folder, ".png")


def _camera_poses(calibration: Path) -> dict[str, Matrix4]:
    """T_pose_camera of the four unrectified cameras."""
    path = calibration / "calib_cam_to_pose.txt"
    numbers = read_numbers(path)
    return {name: homogeneous(numbers_of(path, numbers, name, 12)) for name in (*PERSPECTIVE, *FISHEYE)}


def _velo_from_cam0(calibration: Path) -> Matrix4:
    path = calibration / "calib_cam_to_velo.txt"
    try:
        rows = np.array([float(value) for value in read_text(path).split()])
    except ValueError as error:
        raise SourceError(f"{path}: expected 12 numbers ({error})") from error
    if rows.size != 12:
        raise SourceError(f"{path}: expected 12 numbers, found {rows.size}")
    return homogeneous(rows)


def _rectification(calibration: Path, number: str) -> Matrix4:
    path = calibration / "perspective.txt"
    return homogeneous(numbers_of(path, read_numbers(path), f"R_rect_{number}", 9))


def _perspective(calibration: Path, number: str, width: int, height: int) -> cameras.Camera:
    path = calibration / "perspective.txt"
    return _pinhole(numbers_of(path, read_numbers(path), f"P_rect_{number}", 12).reshape(3, 4), width, height)


def _fisheye(path: Path) -> cameras.Camera:
    """MEI intrinsics as OpenCV's FileStorage writes them: YAML after a separate line `%YAML:1.0`."""
    text = read_text(path)
    if text.startswith("%YAML"):
        text = text.partition("\n")[2]
    try:
        document = parse_yaml(text)
        mirror, distortion = document["mirror_parameters"], document["distortion_parameters"]
        projection = document["projection_parameters"]
        return cameras.build(
            "mei",
            width=int(document["image_width"]),
            height=int(document["image_height"]),
            fx=float(projection["gamma1"]),
            fy=float(projection["gamma2"]),
            cx=float(projection["u0"]),
            cy=float(projection["v0"]),
            xi=float(mirror["xi"]),
            **{name: float(distortion[name]) for name in ("k1", "k2", "p1", "p2")},
        )
    except (ConfigError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise SourceError(f"{path} does not hold MEI intrinsics: {error}") from error


def _pose_motions(path: Path, indices: list[int], stamps_ns: list[int], T_lidar_pose: Matrix4) -> tuple[EgoMotion, ...]:
    """Ego-motion at the stamp of every frame, in the LiDAR frame; empty without `poses.txt`."""
    if not path.is_file():
        return ()
    numbers, poses = _read_poses(path, len(stamps_ns))
    motions = []
    for index in indices:
        twist = _twist_at(index, numbers, poses, stamps_ns)
        if twist is not None:
            angular, linear = _carry(twist, T_lidar_pose)
            motions.append(EgoMotion(stamps_ns[index], LIDAR_FRAME, linear, angular))
    return tuple(motions)


def _read_poses(path: Path, frames: int) -> tuple[list[int], NDArray[np.float64]]:
    """Frame numbers (ascending) and T_world_pose (M, 4, 4)."""
    numbers: list[int] = []
    rows: list[list[float]] = []
    for line_number, line in enumerate(read_text(path).splitlines(), start=1):
        fields = line.split()
        if not fields:
            continue
        try:
            number, row = int(fields[0]), [float(value) for value in fields[1:]]
        except ValueError as error:
            raise SourceError(f"{path}, line {line_number}: {error}") from error
        if len(row) != 12 or not np.isfinite(row).all():
            raise SourceError(f"{path}, line {line_number}: expected a frame number and 12 finite numbers")
        if not (numbers[-1] if numbers else -1) < number < frames:
            raise SourceError(f"{path}, line {line_number}: frame {number} is out of order or has no time stamp")
        numbers.append(number)
        rows.append(row)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows:
        poses[:, :3, :] = np.array(rows).reshape(-1, 3, 4)
    return numbers, poses


def _twist_at(
    index: int, numbers: list[int], poses: NDArray[np.float64], stamps_ns: list[int]
) -> NDArray[np.float64] | None:
    """(6,) twist (ω rad/s, v m/s) of the pose frame in itself at frame `index`; None if poses are too far away.

    ξ(a→b) = log(T_a⁻¹ T_b) / (t_b - t_a) is the mean body twist between two poses. If the frame has a pose, the means
    before and after it are weighted by the *other* interval, which is exact for constant acceleration. If it has none,
    the result is the mean over the gap around it.
    """
    before, after = bisect_left(numbers, index) - 1, bisect_right(numbers, index)
    if before < 0 or after >= len(numbers):
        return None

    def mean_twist(a: int, b: int) -> tuple[NDArray[np.float64], float]:
        seconds = (stamps_ns[numbers[b]] - stamps_ns[numbers[a]]) / NS_PER_S
        return se3.log(rigid(se3.inverse(poses[a]) @ poses[b])) / seconds, seconds

    chord, gap_s = mean_twist(before, after)
    if gap_s > MAX_POSE_GAP_S and float(np.linalg.norm(chord[3:])) * gap_s > MAX_GAP_MOTION_M:
        return None
    if after - before == 1:
        return chord
    (earlier, earlier_s), (later, later_s) = mean_twist(before, before + 1), mean_twist(before + 1, after)
    return (later_s * earlier + earlier_s * later) / (earlier_s + later_s)


def _carry(twist: NDArray[np.float64], T_lidar_pose: Matrix4) -> tuple[tuple[float, float, float], ...]:
    """Angular and linear velocity of the LiDAR in its own frame: the adjoint of T_lidar_pose applied to the twist."""
    R, t = T_lidar_pose[:3, :3], T_lidar_pose[:3, 3]
    angular = R @ twist[:3]
    linear = R @ twist[3:] + np.cross(t, angular)
    return tuple((float(v[0]), float(v[1]), float(v[2])) for v in (angular, linear))
