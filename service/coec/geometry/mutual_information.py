"""Mutual information between LiDAR ranges and depth maps over all frames of a window: equation (1) of Borer et al.
2023.

    MI = H(f^P) + H(f^D) - H(f^P, f^D)

per frame, from the joint histogram of the points that fall on a pixel with a value. Both features arrive here as bin
indices, frozen for a whole search: the range of a point does not depend on the pose, and a depth map is looked up,
never interpolated. So the inner loop is: transform, project, one 8-bit look-up, one increment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, project_point

BLOCK = 1024
"""Points per block: the index buffer of a block (4 kB) stays in the first-level cache between its two passes."""

TASK = 16_384
"""Points per parallel task: small enough to balance two to sixteen threads over a handful of frames, large enough
that zeroing and adding up a task's histograms (8 kB each at 32 bins) does not count."""


@dataclass(frozen=True, slots=True, eq=False)
class BinnedFrames:
    """What the kernel visits, as structure of arrays over the points of all frames.

    Attributes:
        camera: intrinsics scaled to the resolution of the depth maps.
        xyz_m: (3, N) float32, LiDAR frame, frames one after the other.
        range_bin: (N,) uint8 or uint16, bin of the point's range.
        first_point: (F + 1,) int64, frame f holds the points first_point[f] to first_point[f + 1].
        depth_bin: (F, h·w + 1) uint8 or uint16, bin of the depth at each pixel, row by row; `depth_bins` where there is
            none (masked, no value). The last entry stands for "not in the image" and is `depth_bins`, too.
        depth_bins, range_bins: numbers of bins.
    """

    camera: Camera
    xyz_m: NDArray[np.float32]
    range_bin: NDArray[np.unsignedinteger]
    first_point: NDArray[np.int64]
    depth_bin: NDArray[np.unsignedinteger]
    depth_bins: int
    range_bins: int

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.first_point) - 1


@dataclass(frozen=True, slots=True, eq=False)
class FrameInformation:
    """Per frame: `mi` (F,) in nats (0 where nothing is in view) and `points` (F,) that fell on a pixel with a value."""

    mi: NDArray[np.float64]
    points: NDArray[np.int64]


def mutual_information(frames: BinnedFrames, T_camera_lidar: NDArray[np.float64]) -> FrameInformation:
    """Equation (1) for every frame at one pose.

    Args:
        frames: the window, binned.
        T_camera_lidar: (4, 4) float64, LiDAR to camera.
    """
    joint = joint_histograms(frames, T_camera_lidar)
    mi, points = _information(joint)
    return FrameInformation(mi, points)


def joint_histograms(frames: BinnedFrames, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.int64]:
    """(F, depth_bins, range_bins) int64 counts of points by depth bin at their pixel and by range bin."""
    task_frame, task_start, task_stop = _tasks(frames.first_point)
    counts = _count(
        frames.camera, np.ascontiguousarray(T_camera_lidar, np.float64), frames.xyz_m, frames.range_bin,
        frames.depth_bin, task_frame, task_start, task_stop, frames.depth_bins, frames.range_bins,
    )  # fmt: skip
    return _merge(counts, np.searchsorted(task_frame, np.arange(frames.frames + 1)))


def _tasks(
    first_point: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Frame, first and last-but-one point of each task, in order of the frames."""
    per_frame = -(-np.diff(first_point) // TASK)
    frame = np.repeat(np.arange(len(per_frame)), per_frame)
    within = np.arange(len(frame)) - np.repeat(np.cumsum(per_frame) - per_frame, per_frame)
    start = first_point[frame] + within * TASK
    return frame, start, np.minimum(start + TASK, first_point[frame + 1])


@njit(cache=True, parallel=True)
def _count(
    camera: Camera, T: NDArray[np.float64], xyz: NDArray[np.float32], range_bin: NDArray[np.unsignedinteger],
    depth_bin: NDArray[np.unsignedinteger], task_frame: NDArray[np.int64], task_start: NDArray[np.int64],
    task_stop: NDArray[np.int64], depth_bins: int, range_bins: int,
) -> NDArray[np.int32]:  # fmt: skip
    """Joint histogram of each task. Integer counts: the sum does not depend on the number of threads."""
    tasks = task_frame.shape[0]
    # One row more than there are depth bins: points that fall on no value are counted there, so that the loop over the
    # points has no branch.
    counts = np.zeros((tasks, depth_bins, range_bins), np.int32)
    width, height = camera.width, camera.height
    width_limit, height_limit = width - 0.5, height - 0.5
    stride, outside, columns = np.int32(width), np.int32(width * height), np.uint32(range_bins)
    for task in prange(tasks):
        r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
        r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
        r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
        lookup = depth_bin[task_frame[task]]
        pixel = np.empty(BLOCK, np.uint32)
        # Two histograms, used in turn: neighbouring points often share a cell, and an increment that follows another
        # on the same address has to wait for it.
        even = np.zeros((depth_bins + 1) * range_bins, np.int32)
        odd = np.zeros((depth_bins + 1) * range_bins, np.int32)
        for block in range(task_start[task], task_stop[task], BLOCK):
            n = min(BLOCK, task_stop[task] - block)
            # Slices and unsigned indices: numba would otherwise test every index for being negative, and the loads
            # below would become gathers.
            xs, ys, zs = xyz[0, block : block + n], xyz[1, block : block + n], xyz[2, block : block + n]
            bins = range_bin[block : block + n]
            # Pass 1, no branch and no look-up, so that it runs in vector registers.
            for i in range(n):
                x, y, z = float(xs[i]), float(ys[i]), float(zs[i])
                u, v, valid = project_point(
                    camera,
                    r00 * x + r01 * y + r02 * z + t0,
                    r10 * x + r11 * y + r12 * z + t1,
                    r20 * x + r21 * y + r22 * z + t2,
                )
                seen = valid & (u >= -0.5) & (v >= -0.5) & (u < width_limit) & (v < height_limit)
                column = np.int32(u + 0.5 if seen else 0.0)
                row = np.int32(v + 0.5 if seen else 0.0)
                pixel[i] = row * stride + column if seen else outside
            # Pass 2: look up and count.
            for i in range(0, n - 1, 2):
                even[np.uint32(lookup[pixel[i]]) * columns + np.uint32(bins[i])] += 1
                odd[np.uint32(lookup[pixel[i + 1]]) * columns + np.uint32(bins[i + 1])] += 1
            if n % 2:
                even[np.uint32(lookup[pixel[n - 1]]) * columns + np.uint32(bins[n - 1])] += 1
        for d in range(depth_bins):
            for r in range(range_bins):
                counts[task, d, r] = even[d * range_bins + r] + odd[d * range_bins + r]
    return counts


@njit(cache=True, parallel=True)
def _merge(counts: NDArray[np.int32], first_task: NDArray[np.int64]) -> NDArray[np.int64]:
    """Adds up the histograms of each frame's tasks."""
    frames = first_task.shape[0] - 1
    joint = np.zeros((frames, counts.shape[1], counts.shape[2]), np.int64)
    for f in prange(frames):
        for task in range(first_task[f], first_task[f + 1]):
            for d in range(counts.shape[1]):
                for r in range(counts.shape[2]):
                    joint[f, d, r] += counts[task, d, r]
    return joint


@njit(cache=True, parallel=True)
def _information(joint: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """MI in nats and number of points of each frame, with H = log n - (1/n) Σ c·log c over the counts c."""
    frames, depth_bins, range_bins = joint.shape
    mi = np.zeros(frames)
    points = np.zeros(frames, np.int64)
    for f in prange(frames):
        of_depth = np.zeros(depth_bins)
        of_range = np.zeros(range_bins)
        cells = 0.0
        for d in range(depth_bins):
            for r in range(range_bins):
                count = float(joint[f, d, r])
                if count > 0.0:
                    of_depth[d] += count
                    of_range[r] += count
                    cells += count * np.log(count)
        n = of_depth.sum()
        if n > 0.0:
            margins = 0.0
            for count in of_depth:
                if count > 0.0:
                    margins += count * np.log(count)
            for count in of_range:
                if count > 0.0:
                    margins += count * np.log(count)
            mi[f] = np.log(n) + (cells - margins) / n
            points[f] = np.int64(n)
    return mi, points
