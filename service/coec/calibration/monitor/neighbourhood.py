"""Where the edges of a check are most significant near a pose.

Straight up from the pose on the sharpest edges, and from coarse to fine: by the finest band from there, and from where
a cover of all rotations within reach on the coarsest band has another hill. What is found next to the pose is believed
unless another place is clearly better, and stands out. Nothing is drawn at random.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.laid_edges import LaidEdges, LaidLevel
from coec.calibration.search.bounded import Box, maximum_in
from coec.calibration.steps import POLISH_METRES_PER_RADIAN, of_both
from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.geometry.cover import moved_by, unit_ball
from coec.geometry.edges.alignment import EdgeFrames, significances, smooth_significances
from coec.geometry.edges.charts import keep_apart
from coec.geometry.thinning import thinned

REACH_RAD = radians(4.0)
"""How far about the pose a check searches. A pose further off leaves the local optimum at the rim, or nowhere: both are
far beyond any limit."""

COVER_SPACING = 0.9
"""Distance between the poses of the cover, in blurs of the coarsest band."""

MOST_POSES = 1_500
"""Of the cover: what the finest spacing that `COARSEST_BLUR_RAD` allows has."""

COVER_POINTS = 2_000
"""Range edges that the cover visits, at most; significance falls with the root of their number only."""

BEGINNINGS, APART = 2, 1.5
"""So many of the best poses of the cover are climbed from, so many blurs apart."""

FAIR_SHARE = 0.8
"""Of the best of the cover, what a beginning has at least."""

OTHER_POSES, OTHER_POSES_RAD = 32, (radians(3.0), radians(28.0))
"""Poses either way, turned about the axis of the LiDAR by so much, from which the mean and the standard deviation of a
significance are taken. So turned, range edges stay on the strip of the image that was prepared, and in its layout: they
lie as high as before, and on other things."""

MIN_CONTRAST = 4.0
"""Standard deviations by which an optimum stands out from other poses, below which its edges count as faint, and no
other place is believed for them. Of 90 checks of 15 simulated drives those of streets and garages are at 11 to 38, of
highways at 4.2 to 12; through a lens of 75° on a highway, and up to 1.4° off, at 0.7 to 1.2; in the dark up to 4.6,
where significance itself is too small."""

SAME = 0.25
"""Of the finest band's blur: ends of two climbs that are nearer are one."""

NEAR_SHARE = 0.9
"""Of the significance of the best maximum within reach on the sharpest edges, from which the one next to the pose is
believed instead: a mount that is as it was is far likelier than one that moved to a place which fits hardly better.
Between guard rails, lane markings and a horizon, all of which run to one point, edges fit nearly as well a degree
beside. Of 180 checks of right mounts on simulated drives 27 with clear edges ended more than 0.45° off, most of them on
highways; with this 15, of which 14 have few edges in view. From 0.8 to 0.95 it is 14 to 16."""

HOPELESS_SHARE = 0.7
"""Of what the optimum next to the pose has on the finest band: a climb that has less there is not followed to the
sharpest edges."""

CLIMB_STEPS = 4.0
"""Half-width of the box of a climb, in blurs."""

TOLERANCE, LEADING_TOLERANCE = 0.01, 0.1
"""Last trust region of a climb, in blurs of its level: of one that settles a pose, and of one that leads to a finer
level."""

MAX_EVALUATIONS = 400
"""Of a climb: an end, whatever the edges are like."""

ROTATION_DOF, POSE_DOF = 3, 6
"""Axes of ξ that the two optima of a check are searched over: rotations, and all."""


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """What there is about a pose.

    Attributes:
        T_rotation: (4, 4) local optimum over rotations, the camera's centre being that of the pose.
        T_pose: (4, 4) local optimum over all six degrees of freedom.
        contrast: how far the edges of the finest band there stand above other poses, standard deviations.
    """

    T_rotation: Matrix4
    T_pose: Matrix4
    contrast: float


@dataclass(frozen=True, slots=True, eq=False)
class _End:
    pose: Matrix4
    significance: float


def search(edges: LaidEdges, pose: Matrix4) -> Neighbourhood:
    """The neighbourhood of a pose (4, 4)."""
    pose = np.ascontiguousarray(pose)
    coarsest, finest, sharp = edges.bands[-1], edges.bands[0], edges.sharp
    settled = of_both(finest.blur_rad, POLISH_METRES_PER_RADIAN)
    near = _climb(sharp.frames, pose, settled[:ROTATION_DOF], TOLERANCE)
    fair = HOPELESS_SHARE * float(smooth_significances(finest.frames, near.pose[None])[0])
    cover = _cover(pose, coarsest.blur_rad)
    thin = coarsest.frames.of_points(thinned(len(coarsest.frames.weight), COVER_POINTS))
    z = significances(thin, cover)
    z_best = float(z.max())
    # What the sharpest edges have next to the pose may be a ripple of a hill that the finest band has whole.
    ends = [_climb(finest.frames, near.pose, settled[:ROTATION_DOF], LEADING_TOLERANCE)]
    apart = APART * coarsest.blur_rad
    z_near = float(significances(thin, near.pose[None])[0])
    for number in keep_apart(cover, np.argsort(-z, kind="stable"), BEGINNINGS, _trace_of(apart)):
        # Nearer than that it is on the same hill, unless that goes up from what is next to the pose: that is a ripple
        # on its slope, and the finest band, whose reach is a few tenths of a degree, may not lead off it.
        if z[number] >= FAIR_SHARE * z_best and (_apart(cover[number], near.pose) > apart or z[number] > z_near):
            ends.append(_led(edges.bands, cover[number]))
    best = near
    for end in ends:
        if end.significance >= fair and _apart(end.pose, near.pose) >= SAME * finest.blur_rad:
            end = _climb(sharp.frames, end.pose, settled[:ROTATION_DOF], TOLERANCE)
            best = max(best, end, key=lambda one: one.significance)
    there = _contrast(finest, best.pose)
    if best is not near and (there < MIN_CONTRAST or near.significance >= NEAR_SHARE * best.significance):
        best, there = near, _contrast(finest, near.pose)
    return Neighbourhood(best.pose, _pose_of(edges, best), there)


def _contrast(band: LaidLevel, pose: Matrix4) -> float:
    """How far a pose stands above others, from which the same sweeps lie on other parts of the images; standard
    deviations."""
    turned = np.tile(np.eye(4), (2 * OTHER_POSES, 1, 1))
    one_way = np.linspace(*OTHER_POSES_RAD, OTHER_POSES)
    angle_rad = np.concatenate([one_way, -one_way])
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angle_rad)
    turned[:, 1, 0] = np.sin(angle_rad)
    turned[:, 0, 1] = -turned[:, 1, 0]
    z = significances(band.frames, np.concatenate([pose[None], pose @ turned]))
    return float((z[0] - z[1:].mean()) / max(float(z[1:].std()), 1e-9))


def _pose_of(edges: LaidEdges, rotation: _End) -> Matrix4:
    """The optimum over six degrees of freedom next to that over three: straight up, or by way of the finest band."""
    finest = edges.bands[0]
    settled = of_both(finest.blur_rad, POLISH_METRES_PER_RADIAN)
    near = _climb(edges.sharp.frames, rotation.pose, settled, TOLERANCE)
    led = _climb(finest.frames, rotation.pose, settled, LEADING_TOLERANCE)
    if float(np.abs(se3.difference(led.pose, near.pose) / settled).max()) < SAME:
        return near.pose  # from there the way leads to the same end
    far = _climb(edges.sharp.frames, led.pose, settled, TOLERANCE)
    return near.pose if near.significance >= NEAR_SHARE * far.significance else far.pose


def _led(bands: tuple[LaidLevel, ...], pose: Matrix4) -> _End:
    """Up the hills of the bands, from coarse to fine."""
    end = _End(pose, 0.0)
    for band in reversed(bands):
        end = _climb(
            band.frames, end.pose, of_both(band.blur_rad, POLISH_METRES_PER_RADIAN)[:ROTATION_DOF], LEADING_TOLERANCE
        )
    return end


def _climb(frames: EdgeFrames, start: Matrix4, step: NDArray[np.float64], tolerance: float) -> _End:
    """The maximum next to a pose, along as many axes as there are steps."""
    dof = len(step)

    def at(points: NDArray[np.float64]) -> NDArray[np.float64]:
        xi = np.zeros((len(points), 6))
        xi[:, :dof] = points
        return moved_by(start, np.ascontiguousarray(xi[:, :3]), np.ascontiguousarray(xi[:, 3:]))

    def scores(points: NDArray[np.float64]) -> list[float]:
        found: list[float] = smooth_significances(frames, at(points)).tolist()
        return found

    reach = CLIMB_STEPS * step
    found, _ = maximum_in(Box(-reach, reach, step, tolerance * step), scores, np.zeros(dof), MAX_EVALUATIONS)
    end = at(found[None])
    return _End(end[0], float(smooth_significances(frames, end)[0]))


def _cover(pose: Matrix4, blur_rad: float) -> NDArray[np.float64]:
    """(K, 4, 4) poses that cover all rotations within reach."""
    volume = 4.0 / 3.0 * pi * (REACH_RAD / (COVER_SPACING * blur_rad)) ** 3
    ball = unit_ball(min(max(round(volume), 64), MOST_POSES))
    return moved_by(pose, REACH_RAD * ball, np.zeros_like(ball))


def _trace_of(angle_rad: float) -> float:
    return 1.0 + 2.0 * cos(angle_rad)


def _apart(one: Matrix4, other: Matrix4) -> float:
    return se3.rotation_angle_rad(one @ se3.inverse(other))
