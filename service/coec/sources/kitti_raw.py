"""KITTI raw (Geiger, Lenz, Stiller, Urtasun 2013): the official layout, or one drive with its calibration beside it.

As in KITTI-360 the sweep carries the stamp of the camera, because the Velodyne triggers the cameras when it looks
forward (Geiger et al. 2013, section III: "the cameras are triggered at 10 frames per second by the laser scanner, when
facing forward"). Without `timestamps.txt`, consecutive frame numbers count as 0.1 s apart.

Extrinsics: T_camera_lidar = [I | K⁻¹ p] · R_rect_00 · Tr_velo_to_cam, with P_rect_k = [K | p] (development kit).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion, Matrix4, Rig, SweepTiming
from coec.errors import SourceError
from coec.geometry import cameras
from coec.sources.clouds import load_cloud
from coec.sources.kitti_files import (
    homogeneous,
    load_camera,
    load_image,
    median_period_s,
    numbered_files,
    numbers_of,
    read_numbers,
    read_stamps,
    read_text,
    rigid,
    select_one,
    stamp_of,
)
from coec.sources.recording import FramewiseRecording, RecordedFrame
from coec.sources.spec import SourceSpec

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
            partial(load_cloud, stamps_ns[index], LIDAR_FRAME, clouds[index]),
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
