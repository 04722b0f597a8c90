"""KITTI's odometry benchmark (Geiger, Lenz, Urtasun 2012): one sequence in its official folders, `image_0` to
`image_3`, `velodyne`, `calib.txt` and `times.txt`.

T_camera_lidar = [I | K⁻¹ p] · Tr, with P_k = [K | p] (development kit). The scans were compensated for the vehicle's
motion when the benchmark was made, and the images are rectified.
"""

from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from coec.calibration.types import Recognition, Rig
from coec.errors import SourceError
from coec.geometry import cameras
from coec.io.recordings import kitti
from coec.io.recordings.cloud_files import XYZI, CloudLayout, load_cloud
from coec.io.recordings.recording_source import FramewiseRecording, RecordedFrame, SourceSpec

CAMERAS = ("image_0", "image_1", "image_2", "image_3")

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
    there = [name for name in CAMERAS if (folder / name).is_dir()]
    camera = kitti.select_one(there, query.get("camera", "image_2" if "image_2" in there else None), "camera", folder)
    images = kitti.numbered_files(folder / camera, ".png") or kitti.numbered_files(folder / camera, ".jpg")
    clouds = kitti.numbered_files(folder / "velodyne", ".bin")
    indices = sorted(images.keys() & clouds.keys())
    if not indices:
        raise SourceError(f"{folder}: no frame has both an image of {camera} and a Velodyne scan")
    stamps_ns = _stamps(folder / "times.txt", indices[-1])
    image, path = kitti.load_image(images[indices[0]]), folder / "calib.txt"
    numbers = kitti.read_numbers(path)
    P = kitti.numbers_of(path, numbers, f"P{camera[-1]}", 12).reshape(3, 4)
    if not P[0, 0] > 0.0 or not P[1, 1] > 0.0:
        raise SourceError(f"{path}: P{camera[-1]} has no focal length")
    T_camera_cam0 = np.eye(4)
    T_camera_cam0[:3, 3] = np.linalg.solve(np.array([[P[0, 0], 0, P[0, 2]], [0, P[1, 1], P[1, 2]], [0, 0, 1]]), P[:, 3])
    T_cam0_velo = kitti.homogeneous(kitti.numbers_of(path, numbers, "Tr", 12))
    T_camera_lidar = kitti.rigid(T_camera_cam0 @ T_cam0_velo)
    rig = Rig(
        pair=camera,
        camera=cameras.build(
            "pinhole", width=image.width, height=image.height, fx=P[0, 0], fy=P[1, 1], cx=P[0, 2], cy=P[1, 2]
        ),
        camera_frame=camera,
        lidar_frame=kitti.LIDAR_FRAME,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4),
    )
    frames = [
        RecordedFrame(
            stamps_ns[index],
            partial(kitti.load_camera, stamps_ns[index], camera, images[index], None),
            stamps_ns[index],
            partial(load_cloud, stamps_ns[index], kitti.LIDAR_FRAME, clouds[index], CloudLayout(XYZI)),
        )
        for index in indices
    ]
    name = f"kitti-odometry/{folder.resolve().name}/{camera}"
    return FramewiseRecording(name, rig, T_camera_lidar, tuple(frames), recognitions=(COMPENSATED,))


def _stamps(path: Path, last: int) -> list[int]:
    """Stamps of the frames 0 ... last from `times.txt`, seconds since the first one; at 10 Hz without it."""
    if not path.is_file():
        return [index * kitti.FRAME_PERIOD_NS for index in range(last + 1)]
    try:
        seconds = [float(line) for line in kitti.read_text(path).split()]
        stamps_ns = [round(value * kitti.NS_PER_S) for value in seconds]
    except (ValueError, OverflowError) as error:
        raise SourceError(f"{path}: a line is no time in seconds") from error
    kitti.stamp_of(stamps_ns, last, path)
    if any(later <= earlier for earlier, later in pairwise(stamps_ns)) or stamps_ns[0] < 0:
        raise SourceError(f"{path}: the times do not ascend from 0")
    return stamps_ns
