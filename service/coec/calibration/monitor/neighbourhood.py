"""Finds where the edges of a check are most significant near a pose.

One climb goes straight up from the pose on the sharpest edges. Others go from coarse to fine: by the finest band from
the end of that climb, and from every other hill of the coarsest band that a cover of all rotations within reach shows.
The optimum next to the pose is believed unless another place is clearly better and stands out. Nothing is random.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.laid_edges import ProjectedEdges, ProjectedLevel
from coec.calibration.search.bounded import Box, maximum_in
from coec.calibration.steps import POLISH_METRES_PER_RADIAN, of_both
from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.geometry.cover import moved_by, unit_ball
from coec.geometry.edges.alignment import EdgeFrames, significances, smooth_significances
from coec.geometry.edges.charts import select_separated
from coec.geometry.thinning import thinned

REACH_RAD = radians(4.0)
"""How far about the pose a check searches. If the truth is farther off, the local optimum is at the rim or anywhere,
and either is far beyond any limit."""

COVER_SPACING = 0.9
"""Distance between the poses of the cover, in blurs of the coarsest band."""

MOST_POSES = 1_500
"""Most poses of the cover: as many as with the finest spacing that `COARSEST_BLUR_RAD` allows."""

COVER_POINTS = 2_000
"""Most range edges that score the cover; significance falls only with the root of their number."""

BEGINNINGS, MIN_SEPARATION = 2, 1.5
"""How many of the best poses of the cover begin a climb, and how many blurs they are apart."""

FAIR_SHARE = 0.8
"""Share of the best score of the cover that a beginning must have."""

OTHER_POSES, OTHER_POSES_RAD = 32, (radians(3.0), radians(28.0))
"""Number of poses either way, and the range of their turns about the LiDAR's axis, that give the mean and the standard
deviation of a significance. After such turns range edges stay on the prepared strip of the image and in its layout:
they lie as high as before, but on other things."""

MIN_CONTRAST = 4.0
"""If an optimum stands out from other poses by fewer standard deviations, its edges count as faint, and no place other
than the one next to the pose is believed. Of 90 checks of 15 simulated drives those of streets and garages are at 11 to
38, of highways at 4.2 to 12; through a lens of 75° on a highway, and up to 1.4° off, at 0.7 to 1.2; in the dark up to
4.6, where significance itself is too small."""

SAME = 0.25
"""Two climbs whose ends are nearer than this share of the finest band's blur have the same end."""

NEAR_SHARE = 0.9
"""The maximum next to the pose is believed if it has at least this share of the significance of the best maximum within
reach, on the sharpest edges: a mount that did not move is far likelier than one that moved to a place which fits hardly
better. Between guard rails, lane markings and a horizon, which all run to one point, edges fit nearly as well a degree
beside. Of 180 checks of right mounts on simulated drives 27 with clear edges ended more than 0.45° off, most of them on
highways; with this rule 15 did, of which 14 have few edges in view. From 0.8 to 0.95 it is 14 to 16."""

HOPELESS_SHARE = 0.7
"""A climb is not followed to the sharpest edges if on the finest band it has less than this share of the significance
of the optimum next to the pose."""

ASCENT_STEPS = 4.0
"""Half-width of the box of a climb, in blurs."""

TOLERANCE, LEADING_TOLERANCE = 0.01, 0.1
"""Last trust region of a climb, in blurs of its level: for a climb that settles a pose, and for one that leads to a
finer level."""

MAX_EVALUATIONS = 400
"""Most evaluations of a climb, so that it ends whatever the edges are like."""

ROTATION_DOF, POSE_DOF = 3, 6
"""Number of axes of ξ over which the two optima of a check are searched: rotations, and all."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalOptima:
    """What was found near a pose.

    Attributes:
        T_rotation: (4, 4) local optimum over rotations, with the camera's centre of the pose.
        T_pose: (4, 4) local optimum over all six degrees of freedom.
        contrast: how far the finest band at `T_rotation` stands above other poses, standard deviations.
    """

    T_rotation: Matrix4
    T_pose: Matrix4
    contrast: float


@dataclass(frozen=True, slots=True, eq=False)
class _End:
    pose: Matrix4
    significance: float


def search_local_optima(edges: ProjectedEdges, pose: Matrix4) -> LocalOptima:
    """The neighbourhood of a pose (4, 4)."""
    pose = np.ascontiguousarray(pose)
    coarsest, finest, sharp = edges.bands[-1], edges.bands[0], edges.sharp
    settled = of_both(finest.blur_rad, POLISH_METRES_PER_RADIAN)
    near = _ascend(sharp.frames, pose, settled[:ROTATION_DOF], TOLERANCE)
    fair = HOPELESS_SHARE * float(smooth_significances(finest.frames, near.pose[None])[0])
    cover = _cover(pose, coarsest.blur_rad)
    thin = coarsest.frames.of_points(thinned(len(coarsest.frames.weight), COVER_POINTS))
    z = significances(thin, cover)
    z_best = float(z.max())
    # The maximum of the sharpest edges next to the pose may be a ripple on a hill that is whole on the finest band.
    ends = [_ascend(finest.frames, near.pose, settled[:ROTATION_DOF], LEADING_TOLERANCE)]
    separation = MIN_SEPARATION * coarsest.blur_rad
    z_near = float(significances(thin, near.pose[None])[0])
    for number in select_separated(cover, np.argsort(-z, kind="stable"), BEGINNINGS, _trace_of(separation)):
        # A nearer beginning is on the same hill, unless it is higher than the maximum next to the pose. That maximum is
        # then a ripple on the slope, and the finest band, whose reach is a few tenths of a degree, may not lead off it.
        if z[number] >= FAIR_SHARE * z_best and (
            _angle_between(cover[number], near.pose) > separation or z[number] > z_near
        ):
            ends.append(_led(edges.bands, cover[number]))
    best = near
    for end in ends:
        if end.significance >= fair and _angle_between(end.pose, near.pose) >= SAME * finest.blur_rad:
            end = _ascend(sharp.frames, end.pose, settled[:ROTATION_DOF], TOLERANCE)
            best = max(best, end, key=lambda one: one.significance)
    there = _contrast(finest, best.pose)
    if best is not near and (there < MIN_CONTRAST or near.significance >= NEAR_SHARE * best.significance):
        best, there = near, _contrast(finest, near.pose)
    return LocalOptima(best.pose, _pose_of(edges, best), there)


def _contrast(band: ProjectedLevel, pose: Matrix4) -> float:
    """How far a pose stands above others at which the same sweeps lie on other parts of the images; standard
    deviations."""
    turned = np.tile(np.eye(4), (2 * OTHER_POSES, 1, 1))
    one_way = np.linspace(*OTHER_POSES_RAD, OTHER_POSES)
    angle_rad = np.concatenate([one_way, -one_way])
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angle_rad)
    turned[:, 1, 0] = np.sin(angle_rad)
    turned[:, 0, 1] = -turned[:, 1, 0]
    z = significances(band.frames, np.concatenate([pose[None], pose @ turned]))
    return float((z[0] - z[1:].mean()) / max(float(z[1:].std()), 1e-9))


def _pose_of(edges: ProjectedEdges, rotation: _End) -> Matrix4:
    """The optimum over six degrees of freedom next to the one over three, climbed to directly or by way of the finest
    band."""
    finest = edges.bands[0]
    settled = of_both(finest.blur_rad, POLISH_METRES_PER_RADIAN)
    near = _ascend(edges.sharp.frames, rotation.pose, settled, TOLERANCE)
    led = _ascend(finest.frames, rotation.pose, settled, LEADING_TOLERANCE)
    if float(np.abs(se3.difference(led.pose, near.pose) / settled).max()) < SAME:
        return near.pose  # the way by the finest band leads to the same end
    far = _ascend(edges.sharp.frames, led.pose, settled, TOLERANCE)
    return near.pose if near.significance >= NEAR_SHARE * far.significance else far.pose


def _led(bands: tuple[ProjectedLevel, ...], pose: Matrix4) -> _End:
    """The end of a climb on the bands, from coarse to fine."""
    end = _End(pose, 0.0)
    for band in reversed(bands):
        end = _ascend(
            band.frames, end.pose, of_both(band.blur_rad, POLISH_METRES_PER_RADIAN)[:ROTATION_DOF], LEADING_TOLERANCE
        )
    return end


def _ascend(frames: EdgeFrames, start: Matrix4, step: NDArray[np.float64], tolerance: float) -> _End:
    """The maximum next to a pose, along the first `len(step)` axes of ξ."""
    dof = len(step)

    def at(points: NDArray[np.float64]) -> NDArray[np.float64]:
        xi = np.zeros((len(points), 6))
        xi[:, :dof] = points
        return moved_by(start, np.ascontiguousarray(xi[:, :3]), np.ascontiguousarray(xi[:, 3:]))

    def scores(points: NDArray[np.float64]) -> list[float]:
        values: list[float] = smooth_significances(frames, at(points)).tolist()
        return values

    reach = ASCENT_STEPS * step
    best, _ = maximum_in(Box(-reach, reach, step, tolerance * step), scores, np.zeros(dof), MAX_EVALUATIONS)
    end = at(best[None])
    return _End(end[0], float(smooth_significances(frames, end)[0]))


def _cover(pose: Matrix4, blur_rad: float) -> NDArray[np.float64]:
    """(K, 4, 4) poses that cover all rotations within reach."""
    volume = 4.0 / 3.0 * pi * (REACH_RAD / (COVER_SPACING * blur_rad)) ** 3
    ball = unit_ball(min(max(round(volume), 64), MOST_POSES))
    return moved_by(pose, REACH_RAD * ball, np.zeros_like(ball))


def _trace_of(angle_rad: float) -> float:
    return 1.0 + 2.0 * cos(angle_rad)


def _angle_between(one: Matrix4, other: Matrix4) -> float:
    return se3.rotation_angle_rad(one @ se3.inverse(other))
