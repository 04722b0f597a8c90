"""Point-to-plane registration: lays the points of one LiDAR on the surfaces of another (Chen, Medioni 1992; weights of
Geman, McClure 1985), over several pairs of sweeps at once, with the range bias of each as a nuisance.

A step solves for eight unknowns: ξ (6,) about the axes of a, and the range biases of a and b (how much they measure too
long). The priors are no stronger than the knowledge of a workshop and of a data sheet, so an axis that nothing
determines stays where it was, with a wide covariance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coec.calibration.lidar_to_lidar.spread import covariance_of
from coec.calibration.lidar_to_lidar.sweeps import Cloud, clouds_of
from coec.calibration.lidar_to_lidar.types import (
    KNOWN_BEFORE,
    LEAST_SHARE,
    LidarEdge,
    LidarRig,
    Met,
    RangeBias,
    SweepPair,
)
from coec.calibration.ports import Neighbourhood, NeighbourSearch
from coec.calibration.types import Matrix4, Reason
from coec.geometry import se3
from coec.geometry.linear import solved
from coec.geometry.planes import planes_through
from coec.geometry.vectors import lengths

Doubles = NDArray[np.float64]

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
PRIOR = np.concatenate([KNOWN_BEFORE, [0.03] * 2])
"""Prior standard deviations of the mount (rad, m), and of the range biases, from data sheets (m)."""
NOISE_M = 0.02
"""Standard deviation of a residual for weighing it against the priors; the covariance is computed from the residuals
themselves."""
LEAST_POINTS = 500
"""An edge needs at least this many points on surfaces, and at least `LEAST_SHARE` of those tried."""


def register(rig: LidarRig, pairs: Sequence[SweepPair], search: NeighbourSearch) -> LidarEdge:
    """The pose of b in a that brings the points of b onto the surfaces of a.

    Raises:
        ValueError: no pair of sweeps.
    """
    if not pairs:
        raise ValueError(f"{rig.a} and {rig.b}: no sweep of the one near a sweep of the other")
    clouds = [clouds_of(rig, pair) for pair in pairs]
    indexed = [(cloud, search.over(cloud.a_m)) for cloud in clouds if len(cloud.a_m) >= NEIGHBOURS]
    T_a_b, bias = rig.T_a_b_nominal, np.zeros(2)
    for number in range(STEPS):
        reach_m = REACHES_M[min(number, len(REACHES_M) - 1)]
        met = _meet(indexed, T_a_b, bias, reach_m)
        weight = _weights(met.residual, max(SCALE_SHARE * reach_m, LEAST_SCALE_M))
        known = np.concatenate([se3.difference(T_a_b, rig.T_a_b_nominal), bias])
        step = _step(met, weight, known)
        T_a_b, bias = se3.perturb(T_a_b, step[:6]), bias + step[6:]
        rests = float(np.abs(step[:3]).max()) < RESTS_RAD and float(np.abs(step[3:]).max()) < RESTS_M
        if number >= len(REACHES_M) and (rests or len(met.residual) < HOPELESS * LEAST_SHARE * met.tried):
            break
    met = _meet(indexed, T_a_b, bias, REACHES_M[-1])
    weight = _weights(met.residual, max(SCALE_SHARE * REACHES_M[-1], LEAST_SCALE_M))
    covariance = covariance_of(met, weight, PRIOR, NOISE_M, clouds)
    share = len(met.residual) / max(met.tried, 1)
    total = float(weight.sum())
    rms_m = float(np.sqrt((weight * met.residual**2).sum() / total)) if total > 0.0 else float("nan")
    longer = np.array([-1.0, 1.0])
    return LidarEdge(
        rig=rig,
        T_a_b=T_a_b,
        correction=se3.difference(T_a_b, rig.T_a_b_nominal),
        covariance=covariance[:6, :6],
        range_bias=RangeBias(float(longer @ bias), float(np.sqrt(longer @ covariance[6:, 6:] @ longer))),
        rms_m=rms_m,
        points=len(met.residual),
        share=share,
        pairs=len(pairs),
        reasons=_reasons(rig, len(met.residual), share),
    )


def _reasons(rig: LidarRig, points: int, share: float) -> tuple[Reason, ...]:
    if points >= LEAST_POINTS and share >= LEAST_SHARE:
        return ()
    return (
        Reason(
            "lidar_overlap",
            f"{rig.a} and {rig.b} have too little in view in common: {points} points of {rig.b} lie on surfaces of "
            f"{rig.a}, {100.0 * share:.1f} %; {LEAST_POINTS} and {100.0 * LEAST_SHARE:g} % are needed.",
        ),
    )


def _weights(residual: Doubles, scale_m: float) -> Doubles:
    return np.asarray(1.0 / (1.0 + (residual / scale_m) ** 2) ** 2)


def _step(met: Met, weight: Doubles, known: Doubles) -> Doubles:
    """The change (8,) of the unknowns; `known` (8,) is their distance from their priors."""
    weighted = met.jacobian * weight[:, None]
    # einsum without BLAS gives the same bits whatever the number of threads.
    information = np.einsum("ni,nj->ij", weighted, met.jacobian) / NOISE_M**2 + np.diag(PRIOR**-2.0)
    score = -np.einsum("ni,n->i", weighted, met.residual) / NOISE_M**2 - known / PRIOR**2
    return np.array(solved(information.tolist(), score.tolist()))


def _meet(indexed: Sequence[tuple[Cloud, Neighbourhood]], T_a_b: Matrix4, bias: Doubles, reach_m: float) -> Met:
    """The points of b that lie within reach of a surface of a, at a pose and at the range biases of a and b."""
    parts = []
    tried = 0
    for number, (cloud, a) in enumerate(indexed):
        tried += len(cloud.raw_b_m)
        parts.append(_meet_one(number, cloud, a, T_a_b, bias, reach_m))
    if not parts:
        return Met(np.empty(0), np.empty((0, 8)), np.empty((0, 2, 6)), np.empty(0, np.int64), np.empty((0, 3)), tried)
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Met(columns[0], columns[1], columns[2], columns[3].astype(np.int64), columns[4], tried)


def _meet_one(
    number: int, cloud: Cloud, a: Neighbourhood, T_a_b: Matrix4, bias: Doubles, reach_m: float
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
