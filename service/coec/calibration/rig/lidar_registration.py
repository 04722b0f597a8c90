"""Point-to-plane registration: fits the points of one LiDAR to the surfaces of another (Chen, Medioni 1992; weights of
Geman, McClure 1985), over several pairs of sweeps, each motion-compensated to one instant, with the covariance of
the pose.

It is the sandwich of maximum-likelihood theory (Huber 1967), with the scatter of the score between pairs of sweeps and
between sectors of the surroundings, as for a window of a camera (`measure_noise`): a standing vehicle sees the same
again, and points of one wall agree with each other. Two errors reduce what the points seem to determine: normals are
measured (a long wall whose normals scatter seems to hold the direction along it), and clocks are not exact.

A step solves for eight unknowns: ξ (6,) about the axes of a, and the range biases of a and b (how much they measure too
long). The priors are no stronger than the knowledge of a workshop and of a data sheet, so an axis that nothing
determines stays where it was, with a wide covariance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.frames.pairing import azimuth_offsets_s
from coec.calibration.objective.landscape import scatter
from coec.calibration.rig import lidar_sampling
from coec.calibration.rig.nearest_neighbours import KdTree
from coec.calibration.types import EgoMotion, LidarFrame, Matrix4, Reason, SweepTiming
from coec.geometry import se3
from coec.geometry.linalg import congruent, eigen, inverted, solved
from coec.geometry.points import lengths
from coec.geometry.sweep_kernels import deskew, planes_through

Doubles = NDArray[np.float64]


THINNED_M = 0.3
"""One point of b is kept in every cube of this size; otherwise near things would count for everything."""
NEAREST_M, FURTHEST_M = 0.5, 60.0
"""Ranges of the points of b that are used; further ones have no surfaces of a around them."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points of both sweeps.

    Attributes:
        a_m: (N, 3) points of a in the frame of a, at the instant.
        raw_b_m: (M, 3) float32 points of b in the frame of b, each at its own instant; thinned.
        after_s: (M,) how much later than the instant each point of b was measured.
        motion: ego-motion at the instant; None if unknown.
        T_a_ego: (4, 4) maps ego coordinates to those of a.
    """

    a_m: Doubles
    raw_b_m: NDArray[np.float32]
    after_s: Doubles
    motion: EgoMotion | None
    T_a_ego: Matrix4

    def b_m(self, T_a_b: Matrix4) -> Doubles:
        """(M, 3) the points of b in the frame of b at the instant, if b has the pose T_a_b (4, 4) in a. They depend on
        that pose, because a turned LiDAR moves another way in its own frame: 1.4 cm aside in 90 ms at 8 m/s and 1°."""
        return _at(self.raw_b_m, self.after_s, self.motion, se3.inverse(T_a_b) @ self.T_a_ego)

    @property
    def twist(self) -> Doubles:
        """(6,) twist of a in its own frame, rad/s and m/s; zero if unknown."""
        if self.motion is None:
            return np.zeros(6)
        return np.concatenate(sensor_twist(self.motion, self.T_a_ego))


def clouds_of(rig: lidar_sampling.LidarRig, pair: lidar_sampling.SweepPair) -> Cloud:
    """The points of a pair of sweeps, motion-compensated by the time of each point. Without such times all points of a
    sweep have its stamp; without ego-motion nothing is moved."""
    a, b = pair.a, pair.b
    a_m = _at(np.ascontiguousarray(a.xyz_m), _offsets_s(a, rig.sweep_a), pair.motion, rig.T_a_ego)
    range_m = lengths(b.xyz_m)
    used = np.flatnonzero((range_m > NEAREST_M) & (range_m < FURTHEST_M))
    indices = used[_first_of_each_cube(b.xyz_m[used])]
    after_s = _offsets_s(b, rig.sweep_b)[indices] + (b.stamp_ns - a.stamp_ns) * 1e-9
    return Cloud(a_m, np.ascontiguousarray(b.xyz_m[indices]), after_s, pair.motion, rig.T_a_ego)


def _offsets_s(sweep: LidarFrame, timing: SweepTiming | None) -> Doubles:
    if sweep.time_offset_s is not None:
        return sweep.time_offset_s.astype(np.float64)
    return np.zeros(len(sweep.xyz_m)) if timing is None else azimuth_offsets_s(sweep.xyz_m, timing)


def _at(xyz_m: NDArray[np.float32], after_s: Doubles, motion: EgoMotion | None, T_lidar_ego: Matrix4) -> Doubles:
    if motion is None:
        return xyz_m.astype(np.float64)
    angular, linear = sensor_twist(motion, T_lidar_ego)
    return deskew(xyz_m, after_s, angular, linear).astype(np.float64)


def _first_of_each_cube(points_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices of the first point in each cube, ascending."""
    cubes = np.floor(points_m / THINNED_M).astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    return np.sort(first)


AZIMUTHS, ELEVATIONS = 8, 2
"""Sectors of the surroundings of a: by azimuth, and above or below its horizon."""
CLOCK_S = 0.001
"""By how much the clocks of two synchronised LiDARs (PTP, or a pulse per second) may differ, s."""
RESOLUTION_RAD, RESOLUTION_M = radians(0.01), 0.002
"""Error of angle and place that all points of a LiDAR may have in common: the steps of azimuth and range in the packets
of common sensors (VLP-16, HDL-64E: 0.01° and 2 mm)."""
LEANING = 2.0
"""Factor on the information that leaning normals only pretend to give, before it is subtracted: it is itself estimated
no better than a variance of a dozen neighbours."""


def covariance_of(
    met: lidar_sampling.Met, weight: Doubles, prior: Doubles, noise_m: float, clouds: Sequence[Cloud]
) -> Doubles:
    """The covariance (8, 8) of ξ and of the range biases of a and b.

    Args:
        met: the points that met a surface.
        weight: (N,) their weights.
        prior: (8,) prior standard deviations.
        noise_m: standard deviation of a residual by which it was weighed against the priors.
        clouds: their mean motion turns an error of the clocks into one of the pose.
    """
    known = np.diag(prior**-2.0)
    weighted = met.jacobian * weight[:, None]
    measured = np.einsum("ni,nj->ij", weighted, met.jacobian) / noise_m**2
    pretended = np.zeros((8, 8))
    pretended[:6, :6] = np.einsum("n,nki,nkj->ij", weight, met.tilt, met.tilt) / noise_m**2
    information = _held(measured - LEANING * pretended, prior) + known
    scattered = np.array(scatter(_cells(met, weighted * met.residual[:, None]))) / noise_m**4 + known
    covariance = np.array(congruent(inverted(information.tolist()), scattered.tolist()))
    # An error of the clocks is a shift and a turn along the way, alike in all pairs.
    moved = np.zeros(8)
    moved[:6] = CLOCK_S * np.mean([cloud.twist for cloud in clouds], axis=0)
    resolution = np.diag(2.0 * np.array([RESOLUTION_RAD] * 3 + [RESOLUTION_M] * 3 + [0.0] * 2) ** 2)  # of either LiDAR
    return _no_wider(covariance, prior) + np.outer(moved, moved) + resolution


def _held(information: Doubles, prior: Doubles) -> Doubles:
    """The matrix without its negative eigenvalues, with each unknown in units of its prior."""
    unit = prior[:, None] * prior
    return _reshaped(information * unit, lambda value: max(value, 0.0)) / unit


def _no_wider(covariance: Doubles, prior: Doubles) -> Doubles:
    """The covariance combined with the prior, because a scatter that few points hold may be wider than the prior."""
    unit = prior[:, None] * prior
    return _reshaped(covariance / unit, lambda value: max(value, 0.0) / (1.0 + max(value, 0.0))) * unit


def _reshaped(symmetric: Doubles, of: Callable[[float], float]) -> Doubles:
    """The matrix (8, 8) with its eigenvalues replaced by a function of them."""
    result = np.zeros((8, 8))
    for value, vector in eigen(symmetric.tolist()):
        result += of(value) * np.outer(vector, vector)
    return result


def _cells(met: lidar_sampling.Met, score: Doubles) -> Doubles:
    """(8, pairs, sectors) sums of the score (N, 8) over each pair and sector."""
    azimuth = np.arctan2(met.place[:, 1], met.place[:, 0])
    around = np.minimum(((azimuth / (2 * np.pi) + 0.5) * AZIMUTHS).astype(np.int64), AZIMUTHS - 1)
    sector = around * ELEVATIONS + (met.place[:, 2] > 0.0)
    pairs = int(met.pair.max()) + 1 if len(met.pair) else 1
    cells = np.zeros((score.shape[1], pairs, AZIMUTHS * ELEVATIONS))
    for column in range(score.shape[1]):
        np.add.at(cells[column], (met.pair, sector), score[:, column])
    return cells


REACHES_M = (2.0, 1.0, 0.6, 0.4, 0.3)
"""How far a point may lie from its surface, step by step: 5° at 20 m is 1.7 m. The last reach is repeated until the
pose rests."""
STEPS = 30
"""Most steps; most registrations rest after ten."""
HOPELESS = 0.5
"""If less than this share of `LEAST_SHARE` meets a surface, further steps are useless."""
RESTS_RAD, RESTS_M = 1e-5, 1e-4
"""The pose rests if a step is shorter than this: a thousandth of a degree and a tenth of a millimetre are far below the
error by chance."""
SCALE_SHARE = 0.25
"""Share of the reach at which the weight of a residual has fallen to a quarter."""
LEAST_SCALE_M = 0.05
"""Least residual at which the weight is a quarter: a little over two standard deviations of the range noise of either
LiDAR."""
NEIGHBOURS = 16
"""Number of points that make a surface: at 10 m and 0.2° two to three rings of a LiDAR of 64 beams."""
SURFACE_REACH_M = 0.6
"""Neighbours further away belong to something else, or to a road so far that its rings are lines."""
LEAST_NEIGHBOURS = 8
THICKEST_M = 0.04
"""Two standard deviations of range noise: a thicker surface is no plane."""
NARROWEST, NARROWEST_M = 0.15, 0.04
"""A surface is only a strip, from one ring, if the narrower of its two extents is less than this share of the wider
one, less than this many metres, or no wider than the surface is thick."""
PRIOR = np.concatenate([lidar_sampling.KNOWN_BEFORE, [0.03] * 2])
"""Prior standard deviations of the mount (rad, m), and of the range biases, from data sheets (m)."""
NOISE_M = 0.02
"""Standard deviation of a residual for weighing it against the priors; the covariance is computed from the residuals
themselves."""
LEAST_POINTS = 500
"""An edge needs at least this many points on surfaces, and at least `LEAST_SHARE` of those tried."""


def register(rig: lidar_sampling.LidarRig, pairs: Sequence[lidar_sampling.SweepPair]) -> lidar_sampling.LidarEdge:
    """The pose of b in a that brings the points of b onto the surfaces of a.

    Raises:
        ValueError: no pair of sweeps.
        SourceError: the optional extra `lidars` is not installed.
    """
    if not pairs:
        raise ValueError(f"{rig.a} and {rig.b}: no sweep of the one near a sweep of the other")
    clouds = [clouds_of(rig, pair) for pair in pairs]
    indexed = [(cloud, KdTree(cloud.a_m)) for cloud in clouds if len(cloud.a_m) >= NEIGHBOURS]
    T_a_b, bias = rig.T_a_b_nominal, np.zeros(2)
    for number in range(STEPS):
        reach_m = REACHES_M[min(number, len(REACHES_M) - 1)]
        met = _meet(indexed, T_a_b, bias, reach_m)
        weight = _weights(met.residual, max(SCALE_SHARE * reach_m, LEAST_SCALE_M))
        known = np.concatenate([se3.difference(T_a_b, rig.T_a_b_nominal), bias])
        step = _step(met, weight, known)
        T_a_b, bias = se3.perturb(T_a_b, step[:6]), bias + step[6:]
        rests = float(np.abs(step[:3]).max()) < RESTS_RAD and float(np.abs(step[3:]).max()) < RESTS_M
        if number >= len(REACHES_M) and (
            rests or len(met.residual) < HOPELESS * lidar_sampling.LEAST_SHARE * met.tried
        ):
            break
    met = _meet(indexed, T_a_b, bias, REACHES_M[-1])
    weight = _weights(met.residual, max(SCALE_SHARE * REACHES_M[-1], LEAST_SCALE_M))
    covariance = covariance_of(met, weight, PRIOR, NOISE_M, clouds)
    share = len(met.residual) / max(met.tried, 1)
    total = float(weight.sum())
    rms_m = float(np.sqrt((weight * met.residual**2).sum() / total)) if total > 0.0 else float("nan")
    longer = np.array([-1.0, 1.0])
    return lidar_sampling.LidarEdge(
        rig=rig,
        T_a_b=T_a_b,
        correction=se3.difference(T_a_b, rig.T_a_b_nominal),
        covariance=covariance[:6, :6],
        range_bias=lidar_sampling.RangeBias(float(longer @ bias), float(np.sqrt(longer @ covariance[6:, 6:] @ longer))),
        rms_m=rms_m,
        points=len(met.residual),
        share=share,
        pairs=len(pairs),
        reasons=_reasons(rig, len(met.residual), share),
    )


def _reasons(rig: lidar_sampling.LidarRig, points: int, share: float) -> tuple[Reason, ...]:
    if points >= LEAST_POINTS and share >= lidar_sampling.LEAST_SHARE:
        return ()
    return (
        Reason(
            "lidar_overlap",
            f"{rig.a} and {rig.b} overlap too little: {points} points of {rig.b} lie on surfaces of {rig.a}, "
            f"{100.0 * share:.1f} %; {LEAST_POINTS} and {100.0 * lidar_sampling.LEAST_SHARE:g} % are needed.",
        ),
    )


def _weights(residual: Doubles, scale_m: float) -> Doubles:
    return np.asarray(1.0 / (1.0 + (residual / scale_m) ** 2) ** 2)


def _step(met: lidar_sampling.Met, weight: Doubles, known: Doubles) -> Doubles:
    """The change (8,) of the unknowns; `known` (8,) is their distance from their priors."""
    weighted = met.jacobian * weight[:, None]
    # einsum without BLAS gives the same bits whatever the number of threads.
    information = np.einsum("ni,nj->ij", weighted, met.jacobian) / NOISE_M**2 + np.diag(PRIOR**-2.0)
    score = -np.einsum("ni,n->i", weighted, met.residual) / NOISE_M**2 - known / PRIOR**2
    return np.array(solved(information.tolist(), score.tolist()))


def _meet(indexed: Sequence[tuple[Cloud, KdTree]], T_a_b: Matrix4, bias: Doubles, reach_m: float) -> lidar_sampling.Met:
    """The points of b that lie within reach of a surface of a, at a pose and at the range biases of a and b."""
    parts = []
    tried = 0
    for number, (cloud, a) in enumerate(indexed):
        tried += len(cloud.raw_b_m)
        parts.append(_meet_one(number, cloud, a, T_a_b, bias, reach_m))
    if not parts:
        return lidar_sampling.Met(
            np.empty(0), np.empty((0, 8)), np.empty((0, 2, 6)), np.empty(0, np.int64), np.empty((0, 3)), tried
        )
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return lidar_sampling.Met(columns[0], columns[1], columns[2], columns[3].astype(np.int64), columns[4], tried)


def _meet_one(
    number: int, cloud: Cloud, a: KdTree, T_a_b: Matrix4, bias: Doubles, reach_m: float
) -> tuple[Doubles, Doubles, Doubles, NDArray[np.int64], Doubles]:
    b_m = cloud.b_m(T_a_b)
    ray_b = np.einsum("ij,nj->ni", T_a_b[:3, :3], b_m / lengths(b_m)[:, None])
    point = np.einsum("ij,nj->ni", T_a_b[:3, :3], b_m) + T_a_b[:3, 3] - bias[1] * ray_b
    neighbours, squared = a.nearest(point, NEIGHBOURS)
    plane = planes_through(cloud.a_m, neighbours, squared, max(reach_m, SURFACE_REACH_M))
    thickness, narrow, wide = plane.spread.T
    ray_a = plane.centre / np.maximum(lengths(plane.centre), 1e-9)[:, None]
    residual = np.einsum("ni,ni->n", plane.normal, point - plane.centre + bias[0] * ray_a)
    with np.errstate(invalid="ignore"):
        flat = (thickness < THICKEST_M) & (narrow > NARROWEST * wide) & (narrow > np.maximum(thickness, NARROWEST_M))
        valid = flat & (plane.used >= LEAST_NEIGHBOURS) & (np.abs(residual) < reach_m)
    point, normal = point[valid], plane.normal[valid]
    by_bias = np.column_stack(
        [np.einsum("ni,ni->n", normal, ray_a[valid]), -np.einsum("ni,ni->n", normal, ray_b[valid])]
    )
    jacobian = np.column_stack([np.cross(point, normal), normal, by_bias])
    # How far a normal may lean: the noise along it over the extent of its points (least squares of a plane).
    leans = thickness[valid, None] / (np.sqrt(plane.used[valid, None]) * plane.spread[valid, 1:])
    leaning = leans[:, :, None] * plane.axes[valid]
    tilt = np.concatenate([np.cross(point[:, None, :], leaning), leaning], axis=2)
    return residual[valid], jacobian, tilt, np.full(int(valid.sum()), number, np.int64), point
