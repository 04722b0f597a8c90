"""Two plain forms of equation (1). `coec bench` compares the kernel of `mutual_information` with them, in the same run
and on the same machine."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, project_point
from coec.geometry.cameras.double_sphere import DoubleSphere
from coec.geometry.compiler import njit
from coec.geometry.mutual_information import BinnedFrames


def by_numpy(frames: BinnedFrames, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """MI of every frame (F,), nats, by NumPy on whole arrays. Double sphere only (Usenko 2018, equations (40) to (43)).

    Raises:
        TypeError: the camera is of another model.
    """
    camera = frames.camera
    if not isinstance(camera, DoubleSphere):
        raise TypeError(f"the plain form projects by the double sphere model only, not {type(camera).__name__}")
    mi = np.zeros(frames.frames)
    for f, (begin, end) in enumerate(pairwise(frames.first_point)):
        x, y, z = T_camera_lidar[:3, :3] @ frames.xyz_m[:, begin:end] + T_camera_lidar[:3, 3:]
        d1 = np.sqrt(x**2 + y**2 + z**2)
        shifted_z = camera.xi * d1 + z
        depth = camera.alpha * np.sqrt(x**2 + y**2 + shifted_z**2) + (1.0 - camera.alpha) * shifted_z
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        seen = (z > camera.min_cosine * d1) & (depth > 0.0)
        seen &= (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
        pixel = np.floor(v[seen] + 0.5).astype(np.int64) * camera.width + np.floor(u[seen] + 0.5).astype(np.int64)
        of_depth, of_range = frames.depth_bin[f][pixel], frames.range_bin[begin:end][seen]
        joint, _, _ = np.histogram2d(
            of_depth, of_range, bins=(frames.depth_bins, frames.range_bins),
            range=((-0.5, frames.depth_bins - 0.5), (-0.5, frames.range_bins - 0.5)),
        )  # fmt: skip
        mi[f] = _information(joint)
    return mi


def by_scalar_loop(frames: BinnedFrames, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """MI of every frame (F,), nats, by a simple compiled loop, point by point, on one core."""
    pose = np.ascontiguousarray(T_camera_lidar, np.float64)
    joint = np.zeros((frames.frames, frames.depth_bins, frames.range_bins))
    _count(frames.camera, pose, frames.xyz_m, frames.range_bin, frames.first_point, frames.depth_bin, joint)
    return np.array([_information(of_frame) for of_frame in joint])


@njit(cache=True)
def _count(
    camera: Camera, T: NDArray[np.float64], xyz: NDArray[np.float32], range_bin: NDArray[np.unsignedinteger],
    first_point: NDArray[np.int64], depth_bin: NDArray[np.unsignedinteger], joint: NDArray[np.float64],
) -> None:  # fmt: skip
    for f in range(joint.shape[0]):
        for i in range(first_point[f], first_point[f + 1]):
            x, y, z = float(xyz[0, i]), float(xyz[1, i]), float(xyz[2, i])
            u, v, valid = project_point(
                camera,
                T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
                T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
                T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
            )
            if valid and u >= -0.5 and v >= -0.5 and u < camera.width - 0.5 and v < camera.height - 0.5:
                d = depth_bin[f, int(v + 0.5) * camera.width + int(u + 0.5)]
                if d < joint.shape[1]:
                    joint[f, d, range_bin[i]] += 1.0


def _information(joint: NDArray[np.float64]) -> float:
    """H(f^P) + H(f^D) - H(f^P, f^D) of a joint histogram, nats; 0 if it is empty."""
    if not joint.any():
        return 0.0
    p = joint / joint.sum()
    return _entropy(p.sum(axis=0)) + _entropy(p.sum(axis=1)) - _entropy(p.ravel())


def _entropy(p: NDArray[np.float64]) -> float:
    positive = p[p > 0.0]
    return float(-(positive * np.log(positive)).sum())
