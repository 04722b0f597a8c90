"""Estimates the offset between the clocks of camera and LiDAR from the data; it is observable while the vehicle turns.

An offset dt moves every sweep by the ego-motion during dt: in a turn at the rate w it looks like a yaw of w·dt. One
frame cannot tell that from a bent mount, but frames of different turn rates can, because the mount is the part that
stays the same (cf. Rehder, Siegwart, Furgale, "A general approach to spatiotemporal calibration in multisensor
systems", 2016: the offset is one more parameter of the estimate). So rotation and offset are fitted together, to the
edge cue.

In straight driving at a steady speed, dt looks like a shift of the mount along the road, which no other frame
contradicts. Therefore the uncertainty of the mount's position is carried into that of the offset, and a straight drive
does not count as an observation at all.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import fsum, hypot, isnan, nan, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate, sensor_twist
from coec.calibration.objective.edges import EdgeCue, build_edges
from coec.calibration.objective.landscape import FrameScores, across, along
from coec.calibration.search.local_search import Box, maximum_in
from coec.calibration.types import ImageReader, Matrix4, Window
from coec.config import CalibrationConfig, TimeOffsetConfig
from coec.geometry import se3
from coec.geometry.edges.alignment import EdgeFrames, frame_alignment
from coec.geometry.edges.charts import pattern_search
from coec.geometry.linalg import solved
from coec.geometry.sweep_kernels import deskew

OFFSET = 6
"""Place of the offset, after the six axes of the perturbation."""

FITTED = (0, 1, 2, OFFSET)
"""Places of the unknowns that are fitted: the rotation and the offset."""

SHIFTS = (3, 4, 5)
"""Places of the camera's position, which is not fitted."""

STEPS = np.array([*se3.axis_steps(radians(0.3)), 0.01])
"""Difference steps, radians, metres and seconds: each moves edges by about the blur of the sharpest edges."""

PROFILE_STEP_S = 0.02
"""Step of the grid of offsets on the coarse chart: a fifth of the hill, which is some 0.1 s wide in a turn."""

TURN_RAD = radians(4.0)
"""Reach of the rotation about the given pose: an offset of 0.1 s in a sharp turn changes it by that much."""

TOLERANCE = 1e-3
"""Last trust region of the fit, as a share of the difference steps."""

MAX_EVALUATIONS = 1000
"""Bound on the fit, which takes 50 to 100."""

AT_BOUND = 0.95
"""Share of the reach beyond which an offset counts as lying on the bound."""


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """How much later than its stamp the camera was exposed, by the clock of the LiDAR.

    Attributes:
        offset_s: seconds, to be added to the stamps of the camera; NaN if it could not be fitted.
        sigma_s: standard deviation of the offset, seconds; NaN likewise.
        turn_spread_radps: standard deviation of the turn rate over the frames.
        observable: whether the offset may be believed.
        reason: one sentence.
    """

    offset_s: float
    sigma_s: float
    turn_spread_radps: float
    observable: bool
    reason: str


def estimate_time_offset(window: Window, images: ImageReader, pose: Matrix4, config: CalibrationConfig) -> TimeOffset:
    """The offset that lays the range edges of the window onto its image edges, together with the rotation.

    Args:
        window: pairs with ego-motion.
        images: decodes them.
        pose: (4, 4) T_camera_lidar that was found for the window; its camera centre is kept.
        config: `time_offset` and whether sweeps are motion-compensated.

    Raises:
        CalibrationError: no sweep has a jump in range.
        DecodeError: an image cannot be decoded.
    """
    limits = config.time_offset
    if not config.motion_compensation:
        return _unobservable("motion compensation is switched off", nan)
    moving = tuple(p for p in window.pairs if p.motion is not None and p.motion.linear_mps is not None)
    if len(moving) <= len(FITTED):
        return _unobservable(
            f"{len(moving)} pairs have ego-motion with a velocity; more than {len(FITTED)} are needed", nan
        )
    rig = window.rig
    twists = [sensor_twist(pair.motion, rig.T_lidar_ego) for pair in moving if pair.motion is not None]
    spread = _spread(np.array([angular for angular, _ in twists]))

    def points(frame: int, selection: NDArray[np.int64]) -> NDArray[np.float32]:
        return compensate(moving[frame], rig, enabled=True, selection=selection)

    edges = build_edges(moving, points, (images.grey(pair.camera) for pair in moving), rig)
    rotated, offset_s = _coarse(edges, twists, pose, limits)
    scores = _scores(edges.whole, twists, rotated)
    optimum = _maximum(lambda x: float(scores(x[None])[0].mean()), offset_s, limits)
    sigma_s = _sigma(scores, optimum, limits)
    return _judged(float(optimum[OFFSET]), sigma_s, spread, limits)


def _judged(offset_s: float, sigma_s: float, spread: float, limits: TimeOffsetConfig) -> TimeOffset:
    least, known_s = radians(limits.min_turn_spread_deg_per_s), sigma_s if np.isfinite(sigma_s) else nan
    if spread < least:
        text = f"the turn rate varies by {np.degrees(spread):.1f} deg/s only; {np.degrees(least):.1f} are needed"
        return TimeOffset(offset_s, known_s, spread, False, f"{text}: a straight drive looks like a shifted mount")
    if abs(offset_s) > AT_BOUND * limits.reach_s:
        return TimeOffset(offset_s, nan, spread, False, "the best offset lies at the bound of the search")
    if isnan(known_s):
        return TimeOffset(offset_s, nan, spread, False, "the offset rests on too few frames, or has no maximum")
    if sigma_s > limits.max_sigma_s:
        text = f"the offset is known to {1e3 * sigma_s:.1f} ms only, limit {1e3 * limits.max_sigma_s:.1f} ms"
        return TimeOffset(offset_s, sigma_s, spread, False, text)
    return TimeOffset(offset_s, sigma_s, spread, True, f"seen in turns of {np.degrees(spread):.1f} deg/s spread")


def _unobservable(reason: str, spread: float) -> TimeOffset:
    return TimeOffset(nan, nan, spread, False, reason)


def _spread(angular_radps: NDArray[np.float64]) -> float:
    """Standard deviation of the angular velocities (F, 3) about their mean, over all directions."""
    away = angular_radps - angular_radps.mean(axis=0)
    return sqrt(float((away**2).sum(axis=1).mean()))


Twist = tuple[NDArray[np.float64], NDArray[np.float64]]


def _moved(
    xyz_m: NDArray[np.float32], frame: NDArray[np.int64], twists: list[Twist], offset_s: float
) -> NDArray[np.float32]:
    """The edges (3, E), in the frames (E,), as the LiDAR would have seen them `offset_s` later:
    exp(ξ·(t - dt)) = exp(-ξ·dt)·exp(ξ·t)."""
    moved = np.empty_like(xyz_m)
    # Points come frame by frame.
    ends = np.searchsorted(frame, np.arange(len(twists) + 1))
    for f, (angular, linear) in enumerate(twists):
        of_frame = slice(ends[f], ends[f + 1])
        points = np.ascontiguousarray(xyz_m[:, of_frame].T)
        moved[:, of_frame] = deskew(points, np.full(len(points), -offset_s), angular, linear).T
    return moved


def _coarse(edges: EdgeCue, twists: list[Twist], pose: Matrix4, limits: TimeOffsetConfig) -> tuple[Matrix4, float]:
    """The pose, only turned, and the offset with the highest significance on a grid of offsets."""
    turns = np.array([radians(0.5)] * 3 + [0.0] * 3)
    steps = round(limits.reach_s / PROFILE_STEP_S)
    offsets_s = PROFILE_STEP_S * np.arange(-steps, steps + 1)
    charts = edges.charts[0]
    ends = []
    for offset_s in offsets_s.tolist():
        moved = replace(charts, xyz_m=_moved(charts.xyz_m, charts.frame, twists, offset_s))
        ends.append(pattern_search(moved, pose[None], turns, 3, pose, np.array([TURN_RAD, 0.0])))
    best = int(np.argmax([z[0] for _, z in ends]))
    return ends[best][0][0], float(offsets_s[best])


def _scores(frames: EdgeFrames, twists: list[Twist], pose: Matrix4) -> FrameScores:
    """Significance of each frame (K, F), as a function of K perturbations of `pose` and offsets (K, 7)."""
    frame = np.repeat(np.arange(len(twists)), np.diff(frames.first_point))

    def of_one(x: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = replace(frames, xyz_m=_moved(frames.xyz_m, frame, twists, float(x[OFFSET])))
        return frame_alignment(moved, se3.perturb(pose, x[:OFFSET])).of_frames

    return lambda xs: np.array([of_one(x) for x in xs])


def _maximum(
    score: Callable[[NDArray[np.float64]], float], offset_s: float, limits: TimeOffsetConfig
) -> NDArray[np.float64]:
    """The best rotation and offset (7,), translation zero."""
    fitted = list(FITTED)

    def full(coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        x = np.zeros(OFFSET + 1)
        x[fitted] = coordinates
        return x

    reach, steps = np.array([TURN_RAD] * 3 + [limits.reach_s]), STEPS[fitted]
    start = np.array([0.0, 0.0, 0.0, offset_s])
    box = Box(-reach, reach, steps, TOLERANCE * steps)
    best, _ = maximum_in(box, lambda points: [score(full(point)) for point in points], start, MAX_EVALUATIONS)
    return full(best)


def _sigma(scores: FrameScores, optimum: NDArray[np.float64], limits: TimeOffsetConfig) -> float:
    """Standard deviation of the offset, seconds; infinite if the score has no maximum or rests on a single frame.

    It comes from leaving out one frame at a time (Efron 1982), each by its Newton step, because a frame in a sharp turn
    has so much leverage on the offset that its residual says nothing about its error. Added to it is the error that the
    position of the mount, taken as known, causes in the offset: ∂dt/∂t = -(H⁻¹·H_t).
    """
    of_frames, of_shifts, gradients = _derivatives(scores, optimum)
    count = len(of_frames)
    whole = of_frames.sum(axis=0)
    centred = gradients - gradients.mean(axis=0)
    try:
        without = [solved((whole - of_frames[f]).tolist(), centred[f].tolist())[-1] for f in range(count)]
        carried = [solved(whole.tolist(), column)[-1] for column in of_shifts.sum(axis=0).T.tolist()]
    except ValueError:
        return float("inf")
    mean = fsum(without) / count
    noise = sqrt(fsum((step - mean) ** 2 for step in without) * (count - 1) / count)
    position = sqrt(fsum(c * c for c in carried)) * limits.translation_sigma_m
    return hypot(noise, position, limits.floor_s)


def _derivatives(
    scores: FrameScores, optimum: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Central differences of each frame's score: negative Hessians over the fitted axes (F, 4, 4) and of the fitted
    axes with the translation (F, 4, 3), and gradients (F, 4)."""

    def at(shifts: NDArray[np.float64]) -> NDArray[np.float64]:
        return scores(optimum + shifts)

    gradients, second = along(at, STEPS, FITTED)
    hessians = np.zeros((gradients.shape[1], len(FITTED), len(FITTED)))
    for a, i in enumerate(FITTED):
        hessians[:, a, a] = -second[a]
        for b, j in enumerate(FITTED[:a]):
            hessians[:, a, b] = hessians[:, b, a] = -across(at, STEPS, [(i, j)])[0]
    shifts = np.array([-across(at, STEPS, [(i, j) for j in SHIFTS]) for i in FITTED])
    return hessians, np.moveaxis(shifts, 2, 0), gradients.T
