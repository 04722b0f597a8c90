"""How far the pose of one LiDAR in another may be off.

It is the sandwich of maximum-likelihood theory (Huber 1967), with the scatter of the score between pairs of sweeps and
between sectors of the surroundings, as for a window of a camera (`confidence.noise`): a standing vehicle sees the same
again, and points of one wall agree with each other. Two errors reduce what the points seem to determine: normals are
measured (a long wall whose normals scatter seems to hold the direction along it), and clocks are not exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.landscape import scatter
from coec.calibration.lidar_to_lidar.sweeps import Cloud
from coec.calibration.lidar_to_lidar.types import Met
from coec.geometry.linear import congruent, eigen, inverted

DoublesOfSpread = NDArray[np.float64]

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
    met: Met, weight: DoublesOfSpread, prior: DoublesOfSpread, noise_m: float, clouds: Sequence[Cloud]
) -> DoublesOfSpread:
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


def _held(information: DoublesOfSpread, prior: DoublesOfSpread) -> DoublesOfSpread:
    """The matrix without its negative eigenvalues, with each unknown in units of its prior."""
    unit = prior[:, None] * prior
    return _reshaped(information * unit, lambda value: max(value, 0.0)) / unit


def _no_wider(covariance: DoublesOfSpread, prior: DoublesOfSpread) -> DoublesOfSpread:
    """The covariance combined with the prior, because a scatter that few points hold may be wider than the prior."""
    unit = prior[:, None] * prior
    return _reshaped(covariance / unit, lambda value: max(value, 0.0) / (1.0 + max(value, 0.0))) * unit


def _reshaped(symmetric: DoublesOfSpread, of: Callable[[float], float]) -> DoublesOfSpread:
    """The matrix (8, 8) with its eigenvalues replaced by a function of them."""
    result = np.zeros((8, 8))
    for value, vector in eigen(symmetric.tolist()):
        result += of(value) * np.outer(vector, vector)
    return result


def _cells(met: Met, score: DoublesOfSpread) -> DoublesOfSpread:
    """(8, pairs, sectors) sums of the score (N, 8) over each pair and sector."""
    azimuth = np.arctan2(met.place[:, 1], met.place[:, 0])
    around = np.minimum(((azimuth / (2 * np.pi) + 0.5) * AZIMUTHS).astype(np.int64), AZIMUTHS - 1)
    sector = around * ELEVATIONS + (met.place[:, 2] > 0.0)
    pairs = int(met.pair.max()) + 1 if len(met.pair) else 1
    cells = np.zeros((score.shape[1], pairs, AZIMUTHS * ELEVATIONS))
    for column in range(score.shape[1]):
        np.add.at(cells[column], (met.pair, sector), score[:, column])
    return cells
