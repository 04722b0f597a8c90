"""KITTI-360 in its official folder layout (Liao, Xie, Geiger 2022).

Time. The sweep carries the stamp of the *camera*. The HDL-64 triggers the cameras when its beam looks forward, so the
exposure is the instant at which azimuth 0 is measured, and `SweepTiming(sign=-1, stamp_azimuth_rad=0)` counts from it.
The recording agrees: over the 11,518 frames of drive 0000 the two `timestamps.txt` differ by -0.2 to 0.9 ms, a slow
drift of two clocks with only 0.05 ms of noise within 20 frames, and their frame periods correlate at 0.88. So there is
one trigger, which is stamped twice. The camera's stamp is the one that the image and the poses share.

Extrinsics. `calib_cam_to_velo.txt` maps the unrectified camera 0 to the Velodyne, `calib_cam_to_pose.txt` every
unrectified camera to the pose frame (GPS/IMU). With R_rect of the perspective pair:
T_camera_lidar = R_rect_k · T_pose_camk⁻¹ · T_pose_cam0 · T_velo_cam0⁻¹ (as the official development kit). The fourth
column of P_rect_01 is *not* added: it refers to camera 0, and the baseline is in T_pose_cam1 already.
"""

from bisect import bisect_left, bisect_right
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion, Matrix4, Rig, SweepTiming
from coec.config import parse_yaml
from coec.errors import ConfigError, SourceError
from coec.geometry import cameras, se3
from coec.io.recordings import kitti
from coec.io.recordings.cloud_files import XYZI, CloudLayout, load_cloud
from coec.io.recordings.recording_source import FramewiseRecording, RecordedFrame, SourceSpec

PERSPECTIVE = {"image_00": "00", "image_01": "01"}
FISHEYE = ("image_02", "image_03")
LIDAR_FRAME = "velodyne"

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
    drive = kitti.select_one(
        sorted(p.name for p in images_root.iterdir() if p.is_dir()), query.get("drive"), "drive", root
    )
    camera = query.get("camera", "image_00")
    if camera not in (*PERSPECTIVE, *FISHEYE):
        raise SourceError(f"KITTI-360 has no camera {camera}; there are {', '.join((*PERSPECTIVE, *FISHEYE))}")
    rectified = camera in PERSPECTIVE
    images = kitti.numbered_files(images_root / drive / camera / ("data_rect" if rectified else "data_rgb"), ".png")
    velodyne = root / "data_3d_raw" / drive / "velodyne_points"
    clouds = kitti.numbered_files(velodyne / "data", ".bin")
    indices = sorted(images.keys() & clouds.keys())
    if not indices:
        raise SourceError(f"{root}: no frame of {drive} has both an image of {camera} and a Velodyne scan")
    stamps_path = _stamps_path(images_root / drive, camera, velodyne)
    stamps_ns = kitti.read_stamps(stamps_path)
    depths = _depth_maps(root, camera, query.get("depth"))
    frames = []
    for index in indices:
        stamp_ns = kitti.stamp_of(stamps_ns, index, stamps_path)
        frames.append(
            RecordedFrame(
                stamp_ns,
                partial(kitti.load_camera, stamp_ns, camera, images[index], depths.get(index)),
                stamp_ns,
                partial(load_cloud, stamp_ns, LIDAR_FRAME, clouds[index], CloudLayout(XYZI)),
            )
        )
    calibration = root / "calibration"
    T_pose_cam, T_velo_cam0 = _camera_poses(calibration), _velo_from_cam0(calibration)
    T_lidar_pose = T_velo_cam0 @ se3.inverse(T_pose_cam["image_00"])
    T_camera_lidar = se3.inverse(T_lidar_pose @ T_pose_cam[camera])
    if rectified:
        T_camera_lidar = _rectification(calibration, PERSPECTIVE[camera]) @ T_camera_lidar
    T_camera_lidar = kitti.rigid(T_camera_lidar)
    image = kitti.load_image(images[indices[0]])
    rig = Rig(
        pair=camera,
        camera=_perspective(calibration, PERSPECTIVE[camera], image.width, image.height)
        if rectified
        else _fisheye(calibration / f"{camera}.yaml"),
        camera_frame=camera,
        lidar_frame=LIDAR_FRAME,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4),
        sweep=SweepTiming(kitti.median_period_s(stamps_ns, NOMINAL_PERIOD_S), sign=-1, stamp_azimuth_rad=0.0),
    )
    motions = _motions(root / "data_poses" / drive / "poses.txt", indices, stamps_ns, kitti.rigid(T_lidar_pose))
    return FramewiseRecording(f"kitti360/{drive}/{camera}", rig, T_camera_lidar, tuple(frames), motions)


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
    return kitti.numbered_files(folder, ".png")


def _camera_poses(calibration: Path) -> dict[str, Matrix4]:
    """T_pose_camera of the four unrectified cameras."""
    path = calibration / "calib_cam_to_pose.txt"
    numbers = kitti.read_numbers(path)
    return {name: kitti.homogeneous(kitti.numbers_of(path, numbers, name, 12)) for name in (*PERSPECTIVE, *FISHEYE)}


def _velo_from_cam0(calibration: Path) -> Matrix4:
    path = calibration / "calib_cam_to_velo.txt"
    try:
        rows = np.array([float(value) for value in kitti.read_text(path).split()])
    except ValueError as error:
        raise SourceError(f"{path}: expected 12 numbers ({error})") from error
    if rows.size != 12:
        raise SourceError(f"{path}: expected 12 numbers, found {rows.size}")
    return kitti.homogeneous(rows)


def _rectification(calibration: Path, number: str) -> Matrix4:
    path = calibration / "perspective.txt"
    return kitti.homogeneous(kitti.numbers_of(path, kitti.read_numbers(path), f"R_rect_{number}", 9))


def _perspective(calibration: Path, number: str, width: int, height: int) -> cameras.Camera:
    path = calibration / "perspective.txt"
    P = kitti.numbers_of(path, kitti.read_numbers(path), f"P_rect_{number}", 12).reshape(3, 4)
    return cameras.build("pinhole", width=width, height=height, fx=P[0, 0], fy=P[1, 1], cx=P[0, 2], cy=P[1, 2])


def _fisheye(path: Path) -> cameras.Camera:
    """MEI intrinsics as OpenCV's FileStorage writes them: YAML after a separate line `%YAML:1.0`."""
    text = kitti.read_text(path)
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


def _motions(path: Path, indices: list[int], stamps_ns: list[int], T_lidar_pose: Matrix4) -> tuple[EgoMotion, ...]:
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
    for line_number, line in enumerate(kitti.read_text(path).splitlines(), start=1):
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
        seconds = (stamps_ns[numbers[b]] - stamps_ns[numbers[a]]) / kitti.NS_PER_S
        return se3.log(kitti.rigid(se3.inverse(poses[a]) @ poses[b])) / seconds, seconds

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
