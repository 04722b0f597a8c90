"""Mutual information between LiDAR ranges and depth maps over all frames of a window: equation (1) of Borer et al.
2023, and the conversion of values to the numbers of their bins.

MI = H(f^P) + H(f^D) - H(f^P, f^D)

per frame, from the joint histogram of the points that fall on a pixel with a value. Both features arrive here as bin
indices that stay the same for a whole search: the range of a point does not depend on the pose, and depth maps are
looked up without interpolation. So the inner loop is: transform, project, one 8-bit look-up, one increment.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera
from coec.geometry.compiler import PRANGE, njit, prange, prefetch
from coec.geometry.projection import (
    BUNDLE,
    NEVER_OUT,
    NOT_IN_IMAGE,
    UNSURE,
    Bundles,
    Certainty,
    certain_pixels,
    exact_pixel,
    filter_of,
)

TASK = 32 * BUNDLE
"""Points per parallel task: small enough to balance two to sixteen threads over a handful of frames, and large enough
to make the cost of zeroing and adding up a task's histograms (8 kB each at 32 bins) negligible."""

MOST_COUNTS = 2_000_000
"""Most histogram counts held for several poses at once: 8 MB."""

NEIGHBOURS = 8
"""Neighbouring points of a sweep for which one cache line of a depth map is prefetched: they lie within five pixels on
a map of 512, and a cache line holds 64."""


@dataclass(frozen=True, slots=True, eq=False)
class BinnedFrames:
    """Input of the kernel: a structure of arrays over the points of all frames.

    Attributes:
        camera: intrinsics scaled to the resolution of the depth maps.
        xyz_m: (3, N) float32, LiDAR frame, frames one after the other.
        range_bin: (N,) uint8 or uint16, bin of the point's range.
        first_point: (F + 1,) int64, frame f holds the points first_point[f] to first_point[f + 1].
        depth_bin: (F, h·w + 1) uint8 or uint16, bin of the depth at each pixel, row by row; `depth_bins` at pixels
            without one (masked, no value). The last entry stands for "not in the image" and is `depth_bins`, too.
        depth_bins, range_bins: numbers of bins.
        bundles: runs of points that can be culled at a pose; None = no culling.
    """

    camera: Camera
    xyz_m: NDArray[np.float32]
    range_bin: NDArray[np.unsignedinteger]
    first_point: NDArray[np.int64]
    depth_bin: NDArray[np.unsignedinteger]
    depth_bins: int
    range_bins: int
    bundles: Bundles | None = None

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.first_point) - 1


@dataclass(frozen=True, slots=True, eq=False)
class FrameInformation:
    """Per frame: `mi` (F,) in nats (0 if nothing is in view), and `points` (F,), how many fell on a pixel with a
    value."""

    mi: NDArray[np.float64]
    points: NDArray[np.int64]


def mutual_information(frames: BinnedFrames, T_camera_lidar: NDArray[np.float64]) -> FrameInformation:
    """Equation (1) for every frame at one pose.

    Args:
        frames: the window, binned.
        T_camera_lidar: (4, 4) float64, LiDAR to camera.
    """
    return information_of_each(frames, T_camera_lidar[None])[0]


def information_of_each(frames: BinnedFrames, poses: NDArray[np.float64]) -> list[FrameInformation]:
    """The same at each of many poses (K, 4, 4) in one call: one pose is too short to share among threads, many are
    not."""
    if len(poses) == 1:
        counts, first_task = _histograms_of_tasks(frames, poses)
        return [FrameInformation(*_information(counts[0], first_task))]
    tasks = max(len(_tasks(frames.first_point)[1]), 1)
    results, at_once = [], max(1, MOST_COUNTS // (tasks * (frames.depth_bins + 1) * frames.range_bins))
    for begin in range(0, len(poses), at_once):
        mi, points = _informations(*_histograms_of_tasks(frames, poses[begin : begin + at_once]))
        results += [FrameInformation(*of_pose) for of_pose in zip(mi, points, strict=True)]
    return results


def joint_histograms(frames: BinnedFrames, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.int64]:
    """(F, depth_bins, range_bins) int64: counts of points by the depth bin at their pixel and by their range bin."""
    (counts,), first_task = _histograms_of_tasks(frames, T_camera_lidar[None])
    summed = [counts[a:b, :-1].sum(axis=0, dtype=np.int64) for a, b in pairwise(first_task)]
    return np.stack(summed)


def _histograms_of_tasks(
    frames: BinnedFrames, poses: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The joint histogram of each task at each of K poses, with an extra row for points on a pixel without a value, and
    the first task of each frame."""
    poses = np.ascontiguousarray(poses, np.float64)
    bundles = _of_every_bundle(frames.first_point) if frames.bundles is None else frames.bundles
    least_cosine = np.stack([bundles.least_cosine_at(T) for T in poses])
    single = filter_of(frames.camera)
    limits = [single.at(T) for T in poses]
    return _count(
        frames.camera, single.camera, limits[0], np.array([limit.near_m for limit in limits]), poses, frames.xyz_m,
        frames.range_bin, frames.first_point, frames.depth_bin, bundles.axis, least_cosine, frames.depth_bins,
        frames.range_bins,
    )  # fmt: skip


def _of_every_bundle(first_point: NDArray[np.int64]) -> Bundles:
    """Bundles that are never left out."""
    count = int((-(-np.diff(first_point) // BUNDLE)).sum())
    return Bundles(np.zeros((count, 3)), np.full(count, NEVER_OUT), math.inf)


@njit(cache=True, parallel=PRANGE)
def _count(
    camera: Camera, single: Camera, limits: Certainty, near_m: NDArray[np.float32], poses: NDArray[np.float64],
    xyz: NDArray[np.float32], range_bin: NDArray[np.unsignedinteger], first_point: NDArray[np.int64],
    depth_bin: NDArray[np.unsignedinteger], axis: NDArray[np.float64], least_cosine: NDArray[np.float64],
    depth_bins: int, range_bins: int,
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:  # fmt: skip
    """Joint histogram of each task at each of K poses (K, 4, 4), and the first task of each frame, with the number of
    tasks at the end. Counts are integers, so that their sum does not depend on the number of threads.

    `near_m` (K,) replaces `near_m` of `limits`; `axis` (B, 3) and `least_cosine` (K, B) are those of `Bundles`.
    """
    first_task, task_frame, task_start, task_stop, task_bundle = _tasks(first_point)
    tasks = task_frame.shape[0]
    # One row more than there are depth bins: it counts the points on pixels without a value, without a branch.
    counts = np.zeros((poses.shape[0], tasks, depth_bins + 1, range_bins), np.int32)
    for job in prange(poses.shape[0] * tasks):
        k, task = job // tasks, job % tasks
        start, stop = task_start[task], task_stop[task]
        bundles = slice(task_bundle[task], task_bundle[task + 1])
        _count_points(
            camera, single, Certainty(limits.reach_px, limits.edge_cosine, near_m[k]), poses[k],
            poses[k].astype(np.float32), xyz[0, start:stop], xyz[1, start:stop], xyz[2, start:stop],
            range_bin[start:stop], axis[bundles], least_cosine[k][bundles], depth_bin[task_frame[task]],
            counts[k, task],
        )  # fmt: skip
    return counts, first_task


@njit(cache=True)
def _tasks(
    first_point: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Five arrays: the first task of each frame, with the number of tasks at the end; then of each task its frame, its
    first point, the end of its points, and its first bundle, with the number of bundles at the end."""
    frames = first_point.shape[0] - 1
    first_task = np.zeros(frames + 1, np.int64)
    for f in range(frames):
        first_task[f + 1] = first_task[f] + -(-(first_point[f + 1] - first_point[f]) // TASK)
    tasks = first_task[frames]
    frame, start, stop = np.empty(tasks, np.int64), np.empty(tasks, np.int64), np.empty(tasks, np.int64)
    first_bundle = np.zeros(tasks + 1, np.int64)
    for f in range(frames):
        for task in range(first_task[f], first_task[f + 1]):
            frame[task] = f
            start[task] = first_point[f] + (task - first_task[f]) * TASK
            stop[task] = min(start[task] + TASK, first_point[f + 1])
            first_bundle[task + 1] = first_bundle[task] + -(-(stop[task] - start[task]) // BUNDLE)
    return first_task, frame, start, stop, first_bundle


@njit(cache=True, error_model="numpy")
def _count_points(
    camera: Camera, single: Camera, limits: Certainty, T: NDArray[np.float64], T_single: NDArray[np.float32],
    x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32], range_bin: NDArray[np.unsignedinteger],
    axis: NDArray[np.float64], least_cosine: NDArray[np.float64], depth_bin: NDArray[np.unsignedinteger],
    counts: NDArray[np.int32],
) -> None:  # fmt: skip
    """Adds the points of one task that lie in bundles in view to its joint histogram (depth_bins + 1, range_bins)."""
    pixel = np.empty(BUNDLE, np.int32)
    columns, one = np.uint64(counts.shape[1]), np.int32(1)
    # Two histograms, used in turn: neighbouring points often share a cell, and an increment has to wait for the one
    # before it on the same address.
    even, odd = counts.ravel(), np.zeros(counts.size, np.int32)
    for index in range(axis.shape[0]):
        cosine = axis[index, 0] * T[2, 0] + axis[index, 1] * T[2, 1] + axis[index, 2] * T[2, 2]
        if not cosine >= least_cosine[index]:
            continue
        begin = index * BUNDLE
        end = min(begin + BUNDLE, x.shape[0])
        xs, ys, zs, bins, pixels = x[begin:end], y[begin:end], z[begin:end], range_bin[begin:end], pixel[: end - begin]
        # Pass 1, in vector registers: project.
        if certain_pixels(single, limits, T_single, xs, ys, zs, pixels) == NOT_IN_IMAGE:
            continue
        # In between, prefetch: a map is read at scattered places, and the maps of fifty frames have left the caches
        # since the last pose. Cache lines requested together arrive together (200 frames: 62, not 78 µs each).
        for group in range(np.uint64(pixels.shape[0] // NEIGHBOURS)):
            first = pixels[group * np.uint64(NEIGHBOURS)]
            if first >= 0:
                prefetch(depth_bin, np.uint64(first))
        # Pass 2: look up and count. A sweep enters and leaves the view in long runs, so that the branches cost next to
        # nothing. The indices are unsigned because numba would test signed ones for being negative.
        for pair in range(np.uint64(pixels.shape[0] // 2)):
            i = pair * np.uint64(2)
            j = i + np.uint64(1)
            p, q = pixels[i], pixels[j]
            if p >= 0:
                even[np.uint64(depth_bin[np.uint64(p)]) * columns + np.uint64(bins[i])] += one
            elif p == UNSURE:
                _count_exactly(camera, T, xs[i], ys[i], zs[i], bins[i], depth_bin, columns, even)
            if q >= 0:
                odd[np.uint64(depth_bin[np.uint64(q)]) * columns + np.uint64(bins[j])] += one
            elif q == UNSURE:
                _count_exactly(camera, T, xs[j], ys[j], zs[j], bins[j], depth_bin, columns, odd)
        if pixels.shape[0] % 2 == 1:
            _count_exactly(camera, T, xs[-1], ys[-1], zs[-1], bins[-1], depth_bin, columns, even)
    even += odd


@njit(cache=True, error_model="numpy")
def _count_exactly(
    camera: Camera, T: NDArray[np.float64], x: np.float32, y: np.float32, z: np.float32,
    range_bin: np.unsignedinteger, depth_bin: NDArray[np.unsignedinteger], columns: np.uint64,
    counts: NDArray[np.int32],
) -> None:  # fmt: skip
    """Adds one point, projected in double precision."""
    pixel = exact_pixel(camera, T, np.float64(x), np.float64(y), np.float64(z))
    if pixel >= 0:
        counts[np.uint64(depth_bin[np.uint64(pixel)]) * columns + np.uint64(range_bin)] += np.int32(1)


_TIMES_LOG = np.array([0.0, *(count * math.log(count) for count in range(1, 4096))])
"""Table of c·log c, nats, for the counts that nearly all cells have. Without it the logarithms are half of the cost of
a frame of some thousand points after counting."""


@njit(cache=True, inline="always")
def _times_log(count: np.int64) -> float:
    return _TIMES_LOG[count] if count < _TIMES_LOG.shape[0] else count * math.log(count)


@njit(cache=True)
def _information(
    counts: NDArray[np.int32], first_task: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """MI in nats and number of points of each frame, with H = log n - (1/n) Σ c·log c over the counts c.

    On one thread: it takes a microsecond per frame, and 25 frames take less time than waking another thread.
    """
    frames, depth_bins, range_bins = len(first_task) - 1, counts.shape[1] - 1, counts.shape[2]
    mi = np.zeros(frames)
    points = np.zeros(frames, np.int64)
    joint = np.empty((depth_bins, range_bins), np.int64)
    of_depth, of_range = np.empty(depth_bins, np.int64), np.empty(range_bins, np.int64)
    for f in range(frames):
        joint[:] = 0
        of_depth[:] = 0
        of_range[:] = 0
        for task in range(first_task[f], first_task[f + 1]):
            joint += counts[task, :depth_bins]
        cells = 0.0
        for d in range(depth_bins):
            for r in range(range_bins):
                count = joint[d, r]
                of_depth[d] += count
                of_range[r] += count
                cells += _times_log(count)
        n = of_depth.sum()
        if n > 0:
            margins = 0.0
            for count in of_depth:
                margins += _times_log(count)
            for count in of_range:
                margins += _times_log(count)
            mi[f] = math.log(n) + (cells - margins) / n
            points[f] = n
    return mi, points


@njit(cache=True, parallel=PRANGE)
def _informations(
    counts: NDArray[np.int32], first_task: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """As `_information`, for the counts of K poses: (K, F) each."""
    shape = (counts.shape[0], len(first_task) - 1)
    mi, points = np.empty(shape), np.empty(shape, np.int64)
    for k in prange(counts.shape[0]):
        mi_of_pose, points_of_pose = _information(counts[k], first_task)
        for f in range(shape[1]):
            mi[k, f], points[k, f] = mi_of_pose[f], points_of_pose[f]
    return mi, points


def share_of_pixels(
    values: NDArray[np.float32], usable: NDArray[np.bool_], edges: NDArray[np.float32]
) -> NDArray[np.unsignedinteger]:
    """(h·w + 1,): for each pixel, row by row, how many of the ascending edges (n,) its value reaches, 0 to n. It is n +
    1 for a pixel that is not `usable`, and in the last entry, which stands for points outside of the map (h, w).

    The type is the narrowest that holds n + 1, because look-ups are bound by the cache.
    """
    none = len(edges) + 1
    share: NDArray[np.unsignedinteger] = np.empty(values.size + 1, np.uint8 if none < 256 else np.uint16)
    share.fill(none)
    _count_reached(values, usable, edges, share)
    return share


@njit(cache=True, parallel=PRANGE)
def _count_reached(
    values: NDArray[np.float32],
    usable: NDArray[np.bool_],
    edges: NDArray[np.float32],
    share: NDArray[np.unsignedinteger],
) -> None:
    """Fills `share` (h·w + 1,) at the usable pixels."""
    h, w = values.shape
    for y in prange(h):
        row, reached = values[y], np.zeros(w, np.uint16)
        # The loop over the pixels is the inner one, so that it runs in vector registers.
        for edge in edges:
            for x in range(w):
                reached[x] += np.uint16(row[x] >= edge)
        for x in range(w):
            if usable[y, x]:
                share[y * w + x] = reached[x]
