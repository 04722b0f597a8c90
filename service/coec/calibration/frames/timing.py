"""Whether another clock or another ego-motion explains what looks like a bent mount.

A bent mount moves every point the same way in every frame; a clock that is off moves each sweep along the motion of
the vehicle at that instant, and a wrong ego-motion tears each sweep apart in proportion to it. So the sweeps are
compensated anew under each hypothesis, the extrinsic left as it was: one that fits the images as well with a single
number as a moved extrinsic does with six is the simpler explanation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import radians

import numpy as np

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.monitor.sensor_faults import EGO_MOTION_WRONG, TIME_OFFSET, Cause
from coec.calibration.types import EgoMotion, FramePair, Matrix4, Rig
from coec.geometry.cameras import pixel_rad
from coec.geometry.edges.alignment import EdgeFrames, frame_alignment

OFFSETS_S = (-0.2, -0.15, -0.1, -0.075, -0.05, -0.03, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2)
"""Clock errors that are tried: up to two periods of a 10 Hz sensor."""

SCALES = (-1.0, 0.0, 0.33, 0.5, 2.0, 3.0)
"""Factors on the ego-motion that are tried: a wrong sign, a missing signal, wrong units and gains."""

AS_GOOD, BETTER = 0.97, 1.08
"""Of a flagged check: the share of the significance of the moved extrinsic that a hypothesis must reach without moving
it (its grid is coarser than the peak), and by which it must exceed that of the extrinsic as it was."""

GAIN, FRAMES_AGREE = 0.01, 0.6
"""Of any check: what a hypothesis must gain at the local optimum, and the share of pairs that must gain. On real drives
a right clock and ego-motion lose 2 % by each of them; a wrong sign or a factor of three leaves 2 to 7 % to gain."""

FINE_PIXEL_RAD = radians(0.15)
"""Pixel up to which these gains hold; with coarser ones the edges sway by more between one pose and the next."""

MIN_SPEED_MPS = 1.0
"""Slower, neither a clock nor an ego-motion moves anything."""


def explained_by_motion(
    edges: Sequence[FramePair], rig: Rig, level: EdgeFrames, expected: Matrix4, found: Matrix4, min_significance: float
) -> Cause | None:
    """The clock or ego-motion that explains the images better than the extrinsic alone; None if none does, or none can
    be tried for want of motion.

    Args:
        edges: the pairs of a check with nothing of their sweeps but the range edges of `level`, as measured.
        level: these, placed, and edge maps, on one level.
        expected: (4, 4) where the local optimum should be.
        found: (4, 4) where it is.
        min_significance: below this nothing is explained.
    """
    moving = [pair for pair in edges if pair.motion is not None and pair.motion.reaches(MIN_SPEED_MPS)]
    if 2 * len(moving) < len(edges):
        return None
    null, at_found = frame_alignment(level, expected).significance, frame_alignment(level, found)
    to_beat = at_found.significance
    least_gain = 1.0 + GAIN * max(1.0, pixel_rad(rig.camera) / FINE_PIXEL_RAD)
    best, explanation = 0.0, None
    for changed, cause in _hypotheses(edges):
        xyz_m = np.concatenate([compensate(pair, rig, enabled=True) for pair in changed])
        again = replace(level, xyz_m=np.ascontiguousarray(xyz_m.T))
        unmoved, moved = frame_alignment(again, expected).significance, frame_alignment(again, found)
        agree = float((moved.strength > at_found.strength).mean()) >= FRAMES_AGREE
        gains = agree and moved.significance >= least_gain * to_beat
        enough = unmoved >= max(AS_GOOD * to_beat, BETTER * null)
        reached = max(unmoved if enough else 0.0, moved.significance if gains else 0.0)
        if reached > max(best, min_significance):
            best, explanation = reached, cause
    return explanation


def _hypotheses(edges: Sequence[FramePair]) -> Iterator[tuple[list[FramePair], Cause]]:
    for seconds in OFFSETS_S:
        yield [_shifted(pair, seconds) for pair in edges], TIME_OFFSET
    for factor in SCALES:
        yield [_scaled(pair, factor) for pair in edges], EGO_MOTION_WRONG


def _shifted(pair: FramePair, seconds: float) -> FramePair:
    """As if the sweep had been taken so much later."""
    return replace(pair, lidar=replace(pair.lidar, stamp_ns=pair.lidar.stamp_ns + round(seconds * 1e9)))


def _scaled(pair: FramePair, factor: float) -> FramePair:
    """As if the vehicle had moved so many times as fast."""
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
