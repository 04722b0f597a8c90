"""Whether another clock, ego-motion or focal length explains what looks like a bent mount.

A bent mount moves every point the same way in every frame. A clock that is off moves each sweep along the motion of the
vehicle at that instant, a wrong ego-motion tears each sweep apart in proportion to the motion, and another focal length
moves every edge outwards wherever the vehicle goes. So the edges are placed anew under each hypothesis, with the
extrinsic unchanged. A hypothesis that fits the images with a single number as well as a moved extrinsic does with six
is the simpler explanation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate, sensor_twist
from coec.calibration.monitor.sensor_faults import EGO_MOTION_WRONG, INTRINSICS_WRONG, TIME_OFFSET, Cause
from coec.calibration.types import EgoMotion, FramePair, Matrix4, Rig
from coec.geometry import se3
from coec.geometry.cameras import pixel_rad
from coec.geometry.edges.alignment import EdgeFrames, alignment_of_each, frame_alignment

OFFSETS_S = (-0.2, -0.15, -0.1, -0.075, -0.05, -0.03, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2)
"""Clock errors that are tried: up to two periods of a 10 Hz sensor."""

SCALES = (-1.0, 0.0, 0.33, 0.5, 2.0, 3.0)
"""Factors on the ego-motion that are tried: a wrong sign, a missing signal, wrong units and gains."""

ZOOMS = (0.9, 0.95, 0.98, 1.02, 1.05, 1.1)
"""Factors on the focal length that are tried."""

AS_GOOD, BETTER = 0.97, 1.08
"""For a flagged check: a hypothesis must reach this share of the significance of the moved extrinsic without moving the
extrinsic (a share, because its grid is coarser than the peak), and exceed the significance of the unmoved extrinsic by
this factor."""

GAIN, FRAMES_AGREE = 0.01, 0.6
"""For any check: the share that a hypothesis must gain at the local optimum, and the share of pairs that must gain. On
real drives with the right clock and ego-motion every hypothesis loses 2 %; with a wrong sign or a factor of three 2 to
7 % can be gained."""

FINE_PIXEL_RAD = radians(0.15)
"""Size of pixel up to which these gains hold; with coarser pixels the edges vary more from one pose to the next."""

MIN_SPEED_MPS = 1.0
"""Below this speed neither a clock nor an ego-motion moves anything."""


def explained_by_nuisance(
    edges: Sequence[FramePair],
    rig: Rig,
    level: EdgeFrames,
    expected: Matrix4,
    rotation_optimum: Matrix4,
    pose_optimum: Matrix4,
    min_significance: float,
    zooms: Sequence[float] = ZOOMS,
) -> Cause | None:
    """The clock, ego-motion or focal length that explains the images better than the extrinsic alone; None if none
    does. Clock and ego-motion are tried only if there is enough motion.

    Args:
        edges: the pairs of a check, their sweeps reduced to the range edges of `level`, as measured.
        level: the same range edges, placed, and the edge maps of one level.
        expected: (4, 4) where the local optimum should be.
        found: (4, 4) where it is, over rotations.
        pose_optimum: (4, 4) where it is over all six degrees of freedom: a shifted mount is an explanation, too.
        min_significance: below this nothing is explained.
        zooms: factors on the focal length to try.
    """
    null, at_optimum = frame_alignment(level, expected).significance, frame_alignment(level, rotation_optimum)
    turned, shifted = at_optimum.significance, frame_alignment(level, pose_optimum).significance
    least_gain = 1.0 + GAIN * max(1.0, pixel_rad(rig.camera) / FINE_PIXEL_RAD)
    best, explanation = 0.0, None
    for again, motions, cause in _hypotheses(edges, rig, level, zooms):
        unmoved = alignment_of_each(again, expected @ motions).significance
        moved = alignment_of_each(again, rotation_optimum @ motions)
        agree = float((moved.strength > at_optimum.strength).mean()) >= FRAMES_AGREE
        gains = agree and moved.significance >= least_gain * turned
        enough = unmoved >= max(AS_GOOD * max(turned, shifted), BETTER * null)
        reached = max(unmoved if enough else 0.0, moved.significance if gains else 0.0)
        if reached > max(best, min_significance):
            best, explanation = reached, cause
    return explanation


def _hypotheses(
    edges: Sequence[FramePair], rig: Rig, level: EdgeFrames, zooms: Sequence[float]
) -> Iterator[tuple[EdgeFrames, NDArray[np.float64], Cause]]:
    """For each hypothesis the range edges as it places them, the motions (F, 4, 4) that then move the edges of each
    pair, and the cause that it stands for."""
    still = np.tile(np.eye(4), (len(edges), 1, 1))
    for zoom in zooms:
        camera = level.camera._replace(fx=zoom * level.camera.fx, fy=zoom * level.camera.fy)
        yield replace(level, camera=camera), still, INTRINSICS_WRONG
    moving = [pair for pair in edges if pair.motion is not None and pair.motion.reaches(MIN_SPEED_MPS)]
    if 2 * len(moving) < len(edges):
        return
    xi = np.array([_twist(pair, rig) for pair in edges])
    placed = _placed(edges, rig, level)
    for seconds in OFFSETS_S:
        # Under a constant twist, a later time is one more motion, the same for all points of a sweep.
        yield placed, np.array([se3.exp(seconds * of_pair) for of_pair in xi]), TIME_OFFSET
    for factor in SCALES:
        yield _placed([_scaled(pair, factor) for pair in edges], rig, level), still, EGO_MOTION_WRONG


def _twist(pair: FramePair, rig: Rig) -> NDArray[np.float64]:
    """(6,) twist of the LiDAR by which `compensate` moves a sweep of the pair: rad/s and m/s."""
    return np.zeros(6) if pair.motion is None else np.concatenate(sensor_twist(pair.motion, rig.T_lidar_ego))


def _placed(edges: Sequence[FramePair], rig: Rig, level: EdgeFrames) -> EdgeFrames:
    xyz_m = np.concatenate([compensate(pair, rig, enabled=True) for pair in edges])
    return replace(level, xyz_m=np.ascontiguousarray(xyz_m.T))


def _scaled(pair: FramePair, factor: float) -> FramePair:
    """The pair as if the vehicle had moved so many times as fast."""
    motion = pair.motion
    if motion is None or motion.linear_mps is None:
        return pair
    vx, vy, vz = motion.linear_mps
    wx, wy, wz = motion.angular_radps
    twist = EgoMotion(
        motion.stamp_ns,
        motion.frame_id,
        (factor * vx, factor * vy, factor * vz),
        (factor * wx, factor * wy, factor * wz),
    )
    return replace(pair, motion=twist)
