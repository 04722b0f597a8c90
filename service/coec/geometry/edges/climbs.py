"""Climbs of the alignment of range edges from many poses at once, each over its own frames.

Each frame scores z = Σ w·e / √Σ w² by itself, and a pose scores the sum over the frames of its climb. A step of one
climb takes a twentieth of a millisecond, too little to share among threads. So each thread makes whole climbs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, in_single_precision
from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.edges.alignment import LEAST_SQUARE, EdgeFrames, smooth_sums_of_frame

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
        climbs: where they begin.
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
