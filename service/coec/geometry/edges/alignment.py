"""How significantly range edges fall on image edges at a pose: the cue beside mutual information; and local ascents of
this alignment from many poses at once, each over its own frames.

z = Σ w·e / √Σ w²

over the range edges in view, with e the standardised edge strength at their pixel and w their weight. For edges at
random places z has mean 0 and standard deviation about 1, however many are in view, so that a pose does not gain by
looking away (METHOD, section 3, "significance").

Each frame scores z = Σ w·e / √Σ w² by itself, and a pose scores the sum over the frames of its climb. A step of one
climb takes a twentieth of a millisecond, too little to share among threads. So each thread makes whole climbs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, image_point, in_single_precision
from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID
from coec.geometry.projection import moved

BLOCK = 256
"""Points that are projected at a time: their pixels and what is looked up there (8 kB) stay in the first-level
cache."""

LEAST_RANGE2_M2, MOST_RANGE2_M2 = np.float32(1e-18), np.float32(1e18)
"""Limits of the squared distance of a valid point from the camera, as in `cameras.base`."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFrames:
    """Range edges and edge maps of the frames of a window, at one level.

    Attributes:
        camera: intrinsics at the resolution of the maps.
        xyz_m: (3, E) float32 LiDAR frame, frames one after the other, motion-compensated.
        weight: (E,) float32.
        first_point: (F + 1,) int64.
        maps: (F, h, w) int8, as in `EdgePyramid`.
    """

    camera: Camera
    xyz_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    first_point: NDArray[np.int64]
    maps: NDArray[np.int8]

    def of_points(self, indices: NDArray[np.int64]) -> EdgeFrames:
        """The range edges with the given indices, ascending, on the same maps."""
        return replace(
            self,
            xyz_m=np.ascontiguousarray(self.xyz_m[:, indices]),
            weight=self.weight[indices],
            first_point=np.searchsorted(indices, self.first_point).astype(np.int64),
        )


LEAST_SQUARE = 1e-9
"""Least Σ w² that a significance divides by, so that it is 0, not 0 / 0, if nothing is in view. A single range edge has
more than 0.5."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Sums over the range edges in view at one pose, per frame: `strength` (F,) Σ w·e, `square` (F,) Σ w²."""

    strength: NDArray[np.float64]
    square: NDArray[np.float64]

    @property
    def significance(self) -> float:
        """z of all frames together; 0 if nothing is in view."""
        return float(self.strength.sum() / self._scale)

    @property
    def of_frames(self) -> NDArray[np.float64]:
        """(F,) F times what each frame adds to z, so that their mean is `significance`."""
        return np.asarray(len(self.strength) * self.strength / self._scale)

    @property
    def _scale(self) -> float:
        return math.sqrt(max(float(self.square.sum()), LEAST_SQUARE))


@dataclass(frozen=True, slots=True, eq=False)
class PartedAlignments:
    """As `Alignments`, per frame and part: `strength` (K, F, P) Σ w·e, `square` (K, F, P) Σ w²."""

    strength: NDArray[np.float64]
    square: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Alignments:
    """As `Alignment`, at each of K poses: `strength` (K, F) Σ w·e, `square` (K, F) Σ w²."""

    strength: NDArray[np.float64]
    square: NDArray[np.float64]

    @property
    def of_single_frames(self) -> NDArray[np.float64]:
        """(K, F) z of each frame by itself; 0 if nothing is in view."""
        return np.asarray(self.strength / np.sqrt(np.maximum(self.square, LEAST_SQUARE)))

    def at(self, index: int) -> Alignment:
        """The alignment at one of the poses."""
        return Alignment(self.strength[index], self.square[index])


def frame_alignment(frames: EdgeFrames, T_camera_lidar: NDArray[np.float64]) -> Alignment:
    """The alignment at one pose (4, 4), with e interpolated between pixels: smooth in the pose."""
    return alignments(frames, T_camera_lidar[None]).at(0)


def alignments(frames: EdgeFrames, poses: NDArray[np.float64]) -> Alignments:
    """As `frame_alignment`, at many poses (K, 4, 4) in one call: one pose is too short to share among threads, many are
    not."""
    sums = _smooth_sums(*_arguments(frames), poses.astype(np.float32, order="C")[:, None])
    return Alignments(sums[:, :, 0], sums[:, :, 1])


def alignment_of_each(frames: EdgeFrames, poses: NDArray[np.float64]) -> Alignment:
    """As `frame_alignment`, with a pose for each frame (F, 4, 4), or with one (1, 4, 4) for all."""
    sums = _smooth_sums(*_arguments(frames), poses.astype(np.float32, order="C")[None])
    return Alignment(sums[0, :, 0], sums[0, :, 1])


def alignment_of_parts(
    frames: EdgeFrames, part: NDArray[np.uint8], parts: int, poses: NDArray[np.float64]
) -> PartedAlignments:
    """As `alignments`, at many poses (K, 4, 4), but separately for each of `parts` parts of the range edges; `part`
    (E,) is the part that each edge belongs to."""
    sums = _smooth_sums_of_parts(*_arguments(frames), poses.astype(np.float32, order="C"), part, parts)
    return PartedAlignments(sums[:, :, :, 0], sums[:, :, :, 1])


def strengths_on_each_map(frames: EdgeFrames, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """(F, F) Σ w·e of the range edges of each frame (rows) on the edge map of each frame (columns), at one pose (4, 4).
    The diagonal holds the strengths of `frame_alignment`."""
    return np.asarray(_sums_on_each_map(*_arguments(frames), T_camera_lidar.astype(np.float32, order="C")))


def significances(frames: EdgeFrames, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """z at many poses (K, 4, 4), with e at the nearest pixel: (K,)."""
    return np.asarray(_nearest_pixel_z(*_arguments(frames), poses.astype(np.float32)))


def smooth_significances(frames: EdgeFrames, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """z at many poses (K, 4, 4), with e interpolated between pixels: (K,), except for the last bits that of
    `frame_alignment`."""
    at = alignments(frames, poses)
    # Add one frame after the other, in the same order for any number of frames.
    strength, square = np.cumsum(at.strength, axis=1)[:, -1], np.cumsum(at.square, axis=1)[:, -1]
    return np.asarray(strength / np.sqrt(np.maximum(square, LEAST_SQUARE)))


_Arguments = tuple[Camera, NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], NDArray[np.int8]]


def _arguments(frames: EdgeFrames) -> _Arguments:
    """Arguments of the kernels, with a camera in single precision: it projects to a thousandth of a pixel, in half the
    time of double precision."""
    return in_single_precision(frames.camera), frames.xyz_m, frames.weight, frames.first_point, frames.maps


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _smooth_sums(
    camera: Camera,
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    poses: NDArray[np.float32],
) -> NDArray[np.float64]:
    """(K, F, 2): Σ w·e and Σ w² at poses (K, F, 4, 4), or at poses (K, 1, 4, 4) that hold for all frames."""
    frames = first_point.shape[0] - 1
    sums = np.empty((poses.shape[0], frames, 2))
    for task in prange(poses.shape[0] * frames):
        k, f = task // frames, task % frames
        pose = poses[k, min(np.int64(f), poses.shape[1] - 1)]
        strength, square = smooth_sums_of_frame(camera, pose, xyz, weight, first_point[f], first_point[f + 1], maps[f])
        sums[k, f, 0], sums[k, f, 1] = strength, square
    return sums


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _sums_on_each_map(
    camera: Camera,
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    pose: NDArray[np.float32],
) -> NDArray[np.float64]:
    frames = first_point.shape[0] - 1
    sums = np.empty((frames, frames))
    for task in prange(frames * frames):
        f, g = task // frames, task % frames
        sums[f, g], _ = smooth_sums_of_frame(camera, pose, xyz, weight, first_point[f], first_point[f + 1], maps[g])
    return sums


@njit(cache=True, error_model="numpy")
def smooth_sums_of_frame(
    camera: Camera,
    T: NDArray[np.float32],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first: int,
    last: int,
    edge_map: NDArray[np.int8],
) -> tuple[float, float]:
    """Σ w·e and Σ w² over the range edges of one frame, from `first` to before `last`."""
    # One sum for each place in a block, so that they are added in vector registers.
    strength, square = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    edges, block = edge_map.ravel(), _block()
    for begin in range(first, last, BLOCK):
        end = min(begin + BLOCK, last)
        x, y, z = xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end]
        _add(strength, square, *_between(camera, T, x, y, z, weight[begin:end], edges, block))
    return _total(strength) / STRENGTH_STEPS, _total(square)


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _smooth_sums_of_parts(
    camera: Camera,
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    poses: NDArray[np.float32],
    part: NDArray[np.uint8],
    parts: int,
) -> NDArray[np.float64]:
    frames = first_point.shape[0] - 1
    sums = np.zeros((poses.shape[0], frames, parts, 2))
    for task in prange(poses.shape[0] * frames):
        n, f = task // frames, task % frames
        edges, of_frame, block = maps[f].ravel(), sums[n, f], _block()
        for begin in range(first_point[f], first_point[f + 1], BLOCK):
            end = min(begin + BLOCK, first_point[f + 1])
            x, y, z = xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end]
            strength, square = _between(camera, poses[n], x, y, z, weight[begin:end], edges, block)
            for i in range(end - begin):
                k = part[begin + i]
                of_frame[k, 0] += strength[i]
                of_frame[k, 1] += square[i]
        for k in range(parts):
            of_frame[k, 0] /= STRENGTH_STEPS
    return sums


_Block = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int8]]


@njit(cache=True)
def _block() -> _Block:
    """Scratch memory for a block of points: (4, BLOCK) and (BLOCK,) numbers, and (4, BLOCK) strengths."""
    return np.empty((4, BLOCK), np.float32), np.empty(BLOCK, np.int32), np.empty((4, BLOCK), np.int8)


@njit(cache=True, error_model="numpy")
def _between(
    camera: Camera,
    T: NDArray[np.float32],
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    weight: NDArray[np.float32],
    edges: NDArray[np.int8],
    block: _Block,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """w·e, in steps, and w² of range edges (n,), LiDAR frame, on a map (h·w,), with e interpolated between pixels: (n,)
    each, zero if one of the four pixels around does not count. Runs in passes: look-ups go point by point, calculations
    run in vector registers."""
    n, width = x_m.shape[0], np.uint64(camera.width)
    numbers, places, strengths = block
    u, v, place = numbers[0, :n], numbers[1, :n], places[:n]
    _pixels(camera, T, x_m, y_m, z_m, u, v)
    split_pixels(camera.width, camera.height, u, v, place)
    p, q, r, s = strengths[0, :n], strengths[1, :n], strengths[2, :n], strengths[3, :n]
    for i in range(n):
        here = np.uint64(max(place[i], 0))
        below = here + width
        p[i], q[i], r[i], s[i] = edges[here], edges[here + np.uint64(1)], edges[below], edges[below + np.uint64(1)]
    strength, square = numbers[2, :n], numbers[3, :n]
    _mix(u, v, place, p, q, r, s, weight, strength, square)
    return strength, square


@njit(cache=True)
def split_pixels(
    width: int, height: int, u: NDArray[np.float32], v: NDArray[np.float32], place: NDArray[np.int32]
) -> None:
    """Splits pixel coordinates (n,): writes the pixel above and to the left (row · width + column) into `place`, -1 if
    there is none, and leaves the fractions in `u` and `v`. Without a branch, as `_pixels`."""
    right, bottom, zero = np.float32(width - 1), np.float32(height - 1), np.float32(0.0)
    stride = np.int32(width)
    for i in range(u.shape[0]):
        inside = (u[i] >= zero) & (v[i] >= zero) & (u[i] < right) & (v[i] < bottom)
        across, down = (u[i] if inside else zero), (v[i] if inside else zero)
        column, row = np.floor(across), np.floor(down)
        u[i], v[i] = across - column, down - row
        place[i] = np.int32(row) * stride + np.int32(column) if inside else np.int32(-1)


@njit(cache=True)
def _mix(
    right: NDArray[np.float32],
    down: NDArray[np.float32],
    place: NDArray[np.int32],
    p: NDArray[np.int8],
    q: NDArray[np.int8],
    r: NDArray[np.int8],
    s: NDArray[np.int8],
    weight: NDArray[np.float32],
    strength: NDArray[np.float32],
    square: NDArray[np.float32],
) -> None:
    """Interpolates the strengths of points (n,) and weighs them into `strength`, with the squared weights in `square`.
    A point lies `right` and `down` of a pixel of strength p; q is to the right of p, r below p, and s below q. Zero if
    there is no place or if one of the four is void."""
    for i in range(strength.shape[0]):
        seen = (place[i] >= 0) & (p[i] != VOID) & (q[i] != VOID) & (r[i] != VOID) & (s[i] != VOID)
        upper = np.float32(p[i]) + right[i] * (np.float32(q[i]) - np.float32(p[i]))
        lower = np.float32(r[i]) + right[i] * (np.float32(s[i]) - np.float32(r[i]))
        w = weight[i] if seen else np.float32(0.0)
        strength[i] = w * (upper + down[i] * (lower - upper))
        square[i] = w * w


@njit(cache=True)
def _add(
    strength: NDArray[np.float32], square: NDArray[np.float32], more: NDArray[np.float32], squares: NDArray[np.float32]
) -> None:
    for i in range(more.shape[0]):
        strength[i] += more[i]
        square[i] += squares[i]


@njit(cache=True)
def _total(values: NDArray[np.float32]) -> float:
    total = 0.0
    for value in values:
        total += value
    return total


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _nearest_pixel_z(
    camera: Camera,
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    poses: NDArray[np.float32],
) -> NDArray[np.float64]:
    z = np.empty(poses.shape[0])
    for k in prange(poses.shape[0]):
        z[k] = _nearest_pixel_z_at(camera, xyz, weight, first_point, maps, poses[k])
    return z


@njit(cache=True, error_model="numpy")
def _nearest_pixel_z_at(
    camera: Camera,
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    T: NDArray[np.float32],
) -> float:
    strength, square = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    block = _block()
    for f in range(first_point.shape[0] - 1):
        edges = maps[f].ravel()
        for begin in range(first_point[f], first_point[f + 1], BLOCK):
            end = min(begin + BLOCK, first_point[f + 1])
            x, y, z = xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end]
            _add(strength, square, *_nearest(camera, T, x, y, z, weight[begin:end], edges, block))
    return _total(strength) / (STRENGTH_STEPS * math.sqrt(max(_total(square), LEAST_SQUARE)))


@njit(cache=True, error_model="numpy")
def _nearest(
    camera: Camera,
    T: NDArray[np.float32],
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    weight: NDArray[np.float32],
    edges: NDArray[np.int8],
    block: _Block,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """As `_between`, with e at the nearest pixel."""
    n, half, stride = x_m.shape[0], np.float32(0.5), np.int32(camera.width)
    numbers, places, strengths = block
    u, v, place = numbers[0, :n], numbers[1, :n], places[:n]
    _pixels(camera, T, x_m, y_m, z_m, u, v)
    right, bottom = np.float32(camera.width) - half, np.float32(camera.height) - half
    for i in range(n):
        inside = (u[i] >= -half) & (v[i] >= -half) & (u[i] < right) & (v[i] < bottom)
        across, down = (u[i] if inside else half), (v[i] if inside else half)
        place[i] = np.int32(down + half) * stride + np.int32(across + half) if inside else np.int32(-1)
    e, strength, square = strengths[0, :n], numbers[2, :n], numbers[3, :n]
    for i in range(n):
        e[i] = edges[np.uint64(max(place[i], 0))]
    for i in range(n):
        w = weight[i] if (place[i] >= 0) & (e[i] != VOID) else np.float32(0.0)
        strength[i], square[i] = w * np.float32(e[i]), w * w
    return strength, square


@njit(cache=True, error_model="numpy")
def _pixels(
    camera: Camera,
    T: NDArray[np.float32],
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
) -> None:
    """Writes the pixel coordinates of points (n,), LiDAR frame, into `u` and `v` (n,); -1 if there is none. The loop is
    separate, without a branch, and nothing in it is wider than 32 bits, so that it runs in vector registers."""
    nowhere = np.float32(-1.0)
    for i in range(x_m.shape[0]):
        x, y, z = moved(T, x_m[i], y_m[i], z_m[i])
        across, down, in_domain = image_point(camera, x, y, z)
        range2 = x * x + y * y + z * z
        valid = in_domain & (range2 > LEAST_RANGE2_M2) & (range2 < MOST_RANGE2_M2)  # false for NaN
        u[i], v[i] = (across if valid else nowhere), (down if valid else nowhere)


MAX_SWEEPS = 8
"""Most sweeps of a climb over its moves; it begins within two steps of its end."""


@dataclass(frozen=True, slots=True, eq=False)
class AscentStart:
    """The start of a climb: a pose (4, 4), and its frames, from `first` to before `last`."""

    pose: NDArray[np.float64]
    first: int
    last: int


@dataclass(frozen=True, slots=True, eq=False)
class Summit:
    """The end of a climb: a pose (4, 4), and the score of its frames there."""

    pose: NDArray[np.float64]
    score: float


def ascend(frames: EdgeFrames, starts: list[AscentStart], moves: NDArray[np.float64]) -> list[Summit]:
    """The end of each climb. A climb tries every move in turn, on the left of the pose, and keeps those that help. When
    none helps it goes on with the finer moves, and after the finest it ends.

    Args:
        frames: the frames of all climbs.
        starts: where they begin.
        moves: (L, M, 4, 4) M moves for each of L levels, from coarse to fine.
    """
    spans = np.array([(start.first, start.last) for start in starts], np.int64)
    poses = np.array([start.pose for start in starts])
    scores = _ascend(
        in_single_precision(frames.camera), frames.xyz_m, frames.weight, frames.first_point, frames.maps, spans, moves,
        poses,
    )  # fmt: skip
    return [Summit(pose, score) for pose, score in zip(poses, scores.tolist(), strict=True)]


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _ascend(
    camera: Camera,
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    spans: NDArray[np.int64],
    moves: NDArray[np.float64],
    poses: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(K,) the scores at the ends of the climbs over the frames `spans` (K, 2). `poses` (K, 4, 4) holds their starts
    and receives their ends."""
    scores = np.empty(poses.shape[0])
    for k in prange(poses.shape[0]):
        first, last = spans[k, 0], spans[k, 1]
        pose, fineness = poses[k].copy(), 0
        best = _score(camera, xyz, weight, first_point, maps, first, last, pose)
        for _ in range(MAX_SWEEPS):
            improved = False
            for move in range(moves.shape[1]):
                trial = _on_the_left(moves[fineness, move], pose)
                score = _score(camera, xyz, weight, first_point, maps, first, last, trial)
                if score > best:
                    pose, best, improved = trial, score, True
            if not improved:
                fineness += 1
                if fineness == moves.shape[0]:
                    break
        scores[k] = best
        for i in range(4):
            for j in range(4):
                poses[k, i, j] = pose[i, j]
    return scores


@njit(cache=True, error_model="numpy")
def _score(
    camera: Camera,
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    first: int,
    last: int,
    pose: NDArray[np.float64],
) -> float:
    T, total = pose.astype(np.float32), 0.0
    for f in range(first, last):
        strength, square = smooth_sums_of_frame(camera, T, xyz, weight, first_point[f], first_point[f + 1], maps[f])
        total += strength / math.sqrt(max(square, LEAST_SQUARE))
    return total


@njit(cache=True)
def _on_the_left(move: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """move · pose, added up in the order of `se3.perturb`."""
    out = pose.copy()
    for i in range(3):
        for j in range(4):
            out[i, j] = move[i, 0] * pose[0, j] + move[i, 1] * pose[1, j] + move[i, 2] * pose[2, j]
            out[i, j] += move[i, 3] * pose[3, j]
    return out
