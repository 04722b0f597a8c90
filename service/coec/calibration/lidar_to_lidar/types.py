"""The input and the result of the registration of two LiDARs."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion, LidarFrame, Matrix4, Reason, SweepTiming

KNOWN_BEFORE = np.array([radians(10.0)] * 3 + [1.0] * 3)
"""(6,) standard deviation of a mount before any look (rad, m): at worst, mounts are built to that."""

LEAST_SHARE = 0.05
"""Least share of the points of b that must meet a surface of a: with fewer the fields of view hardly overlap."""


@dataclass(frozen=True, slots=True, eq=False)
class LidarRig:
    """Two LiDARs of one vehicle as they were mounted.

    Attributes:
        a, b: names; b is brought to a. The denser one should be a: its points make the surfaces.
        T_a_b_nominal: (4, 4) maps coordinates of b to those of a.
        T_a_ego: (4, 4) maps ego coordinates to those of a; carries ego-motion to both.
        sweep_a, sweep_b: how the time of points follows from azimuth if the sweep carries no times; None if unknown.
    """

    a: str
    b: str
    T_a_b_nominal: Matrix4
    T_a_ego: Matrix4
    sweep_a: SweepTiming | None = None
    sweep_b: SweepTiming | None = None


@dataclass(frozen=True, slots=True)
class SweepPair:
    """A sweep of each LiDAR, near each other in time, and the ego-motion then; None if unknown."""

    a: LidarFrame
    b: LidarFrame
    motion: EgoMotion | None


@dataclass(frozen=True, slots=True, eq=False)
class Met:
    """Points of b on surfaces of a, over all pairs.

    Attributes:
        residual: (N,) distance from the surface along its normal, metres.
        jacobian: (N, 8) its derivative by the unknowns.
        tilt: (N, 2, 6) the same for the error of the normal: its two standard deviations, as derivatives by ξ.
        pair: (N,) number of the pair of sweeps.
        place: (N, 3) the points in the frame of a.
        tried: number of points that were tried.
    """

    residual: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    tilt: NDArray[np.float64]
    pair: NDArray[np.int64]
    place: NDArray[np.float64]
    tried: int


@dataclass(frozen=True, slots=True, eq=False)
class RangeBias:
    """By how much b measures longer than a, metres, with its standard deviation."""

    longer_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class LidarEdge:
    """The pose of b in a.

    Attributes:
        rig: the two LiDARs.
        T_a_b: (4, 4) the pose found.
        correction: (6,) ξ with T_a_b = perturb(T_a_b_nominal, ξ): about the axes of a, rad and m.
        covariance: (6, 6) of ξ; as wide as the prior on axes that the surroundings do not determine.
        range_bias: a nuisance that is estimated along with the pose.
        rms_m: root mean square distance of the points of b from the surfaces of a that they met.
        points: number of points of b that met a surface of a, over all pairs.
        share: their share of the points of b that were tried.
        pairs: number of pairs of sweeps.
        reasons: why the result is not to be used; empty if it may be.
    """

    rig: LidarRig
    T_a_b: Matrix4
    correction: NDArray[np.float64]
    covariance: NDArray[np.float64]
    range_bias: RangeBias
    rms_m: float
    points: int
    share: float
    pairs: int
    reasons: tuple[Reason, ...]

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviations of the correction."""
        return np.sqrt(self.covariance.diagonal())

    @property
    def chi2(self) -> float:
        """Squared length of the correction in its standard deviations, 6 degrees of freedom: shows whether one of the
        two has moved. NaN if the covariance is singular."""
        try:
            return float(self.correction @ np.linalg.solve(self.covariance, self.correction))
        except np.linalg.LinAlgError:
            return float("nan")
