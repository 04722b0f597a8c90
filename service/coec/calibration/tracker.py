"""Combines successive windows into one extrinsic: a slow track averages noise away, a fast one notices a step at once.

The slow track is an information filter on SE(3). Its state is a pose and the covariance of the perturbation on its left
(Barfoot, Furgale, "Associating uncertainty with three-dimensional poses", 2014); its update is the Kalman update of
that perturbation. Between windows the covariance grows with time, so that the track follows a mount that creeps. Errors
that windows have in common do not average away: they are carried beside the noise and reported with it.

A mount may drift faster than configured. Then each window is somewhat ahead of the slow track, always to the same side,
though no single one is improbable. An exponentially weighted mean of the innovations (EWMA control chart: Roberts 1959)
tells such a lag from noise. If the lag is improbable, or if a window is while the monitor doubts what is served, the
covariance of the slow track grows until its noise explains the distance (adaptive fading: Xia, Rao, Ying, Shen 1994),
so that the track follows a drift instead of averaging it away.

Each window is first tested for whether it can come from the same mount: the squared Mahalanobis distance of its
innovation is chi-square distributed if it does (Bar-Shalom, Li, Kirubarajan 2001, section 5.4). A window that fails the
test opens a fast track and moves nothing. If the next window agrees with the fast track and not with the slow one, the
mount has moved, and the slow track starts again from those two windows.

All arithmetic is in plain floats (`linear`), so that the track survives restarts and replays to the byte.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from math import erfc, exp, fsum, pi, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Estimate, Matrix4, Uncertainty
from coec.config import TrackerConfig
from coec.geometry import se3
from coec.geometry.linalg import congruent, solved

Matrix6 = NDArray[np.float64]

NS_PER_H = 3_600_000_000_000
"""Nanoseconds in an hour."""

IMPROBABLE = 0.01
"""Chance of a window below which it does not vouch for what is served."""

LAG_WEIGHT, LAGGING = 0.25, 0.001
"""Weight of the last window in the mean of the innovations, so that about seven windows count; and the chance of such a
mean below which the mount drifts faster than configured. See docs/measured.md."""

DOUBTFUL, EXPLAINED = 0.1, 0.5
"""Chance of a single window below which the mount drifts faster than configured, if the monitor doubts what is served;
and the chance that the distance has once the covariance has grown."""

GROWTH = 1.5
"""Factor by which the covariance grows at a time."""


class StepState(StrEnum):
    """What the last window said about a step of the mount. `confirmed` lasts for the one window that confirms."""

    NONE = "none"
    SUSPECTED = "suspected"
    CONFIRMED = "confirmed"


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """What one accepted window says.

    Attributes:
        T_camera_lidar: (4, 4).
        uncertainty: of the perturbation about the camera axes; the noise is NaN on axes that were not solved or could
            not be observed.
        stamp_ns: sensor time of its last pair.
    """

    T_camera_lidar: Matrix4
    uncertainty: Uncertainty
    stamp_ns: int

    @classmethod
    def from_estimate(cls, estimate: Estimate) -> Measurement:
        """What an estimate tells about the axes that it solved."""
        determined, noise = estimate.solved, estimate.uncertainty.noise
        uncertainty = replace(estimate.uncertainty, noise=np.where(determined[:, None] & determined, noise, np.nan))
        return cls(estimate.optimum.T_camera_lidar, uncertainty, estimate.data_stamp_ns)

    def determined_axes(self) -> list[int]:
        """Axes with a finite variance above zero."""
        variances = self.uncertainty.noise.diagonal()
        return [axis for axis in range(6) if np.isfinite(variances[axis]) and variances[axis] > 0.0]


@dataclass(frozen=True, slots=True, eq=False)
class PosePosterior:
    """A pose and what is known of it.

    Attributes:
        T_camera_lidar: (4, 4).
        covariance: (6, 6) of the perturbation on the left of the pose: noise, which averages away.
        systematic: by the name of each error that its windows have in common, which does not average away: (6,) the
            shift of the pose by one standard deviation.
        observed: (6,) axes that at least one window determined.
        windows: number of windows in it.
    """

    T_camera_lidar: Matrix4
    covariance: Matrix6
    systematic: Mapping[str, NDArray[np.float64]]
    observed: NDArray[np.bool_]
    windows: int

    @property
    def uncertainty(self) -> Uncertainty:
        """Noise and systematic errors together."""
        return Uncertainty(self.covariance, self.systematic, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The combined extrinsic of a pair.

    Attributes:
        slow: what is served.
        prior_sigma: (6,) spread of the first pose, radians and metres; after a step, axes fall back to it.
        stamp_ns: sensor time of the newest window.
        step: what the last window said.
        candidate: the fast track while a step is suspected.
        innovation: squared Mahalanobis distance of the last window from the slow track; 0 before the first.
        chance: how probable a distance at least as large is without a step; 1 before the first window.
        lag: (6,) how far the last windows were from the slow track on average, exponentially weighted.
    """

    slow: PosePosterior
    prior_sigma: NDArray[np.float64]
    stamp_ns: int
    step: StepState = StepState.NONE
    candidate: PosePosterior | None = None
    innovation: float = 0.0
    chance: float = 1.0
    lag: NDArray[np.float64] = field(default_factory=partial(np.zeros, 6))

    @classmethod
    def initial(cls, T_camera_lidar: Matrix4, prior_sigma: NDArray[np.float64], stamp_ns: int = 0) -> Track:
        """A track without windows, at a pose (4, 4) whose standard deviations are `prior_sigma` (6,).

        Raises:
            ValueError: the pose is not rigid, or a standard deviation is not a positive number.
        """
        sigma = np.asarray(prior_sigma, np.float64)
        if not se3.is_rigid(T_camera_lidar):
            raise ValueError("T_camera_lidar of a track must be a rigid transform (4, 4)")
        if sigma.shape != (6,) or not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
            raise ValueError(f"prior_sigma of a track must be six positive numbers, got {sigma.tolist()}")
        return cls(PosePosterior(T_camera_lidar, np.diag(sigma**2), {}, np.zeros(6, np.bool_), 0), sigma, stamp_ns)

    @property
    def T_camera_lidar(self) -> Matrix4:
        """(4, 4) of the slow track."""
        return self.slow.T_camera_lidar

    @property
    def covariance(self) -> Matrix6:
        """(6, 6) of the slow track: noise alone, without the errors that all windows have in common."""
        return self.slow.covariance

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(6,) axes that at least one window of the slow track determined; the others keep their first value."""
        return self.slow.observed

    @property
    def windows(self) -> int:
        """Windows in the slow track since it started or started again."""
        return self.slow.windows

    @property
    def uncertainty(self) -> Uncertainty:
        """The uncertainty to report: noise, and the errors that averaging cannot remove."""
        return self.slow.uncertainty


def prior_sigma(config: TrackerConfig) -> NDArray[np.float64]:
    """(6,) how far the nominal calibration may be off, radians and metres."""
    return np.array([radians(config.prior_deg)] * 3 + [config.prior_m] * 3)


def creep_sigma(config: TrackerConfig) -> NDArray[np.float64]:
    """(6,) how far a mount creeps in an hour, on every axis (rad, m). Creep is a random walk: its variance grows with
    time."""
    return np.array([radians(config.drift_deg_per_sqrt_h)] * 3 + [config.drift_m_per_sqrt_h] * 3)


def update_track(track: Track, measurement: Measurement, config: TrackerConfig, *, doubted: bool = False) -> Track:
    """The track after another accepted window; a window that determines no axis leaves the track unchanged. `doubted`:
    whether the monitor doubts what is served."""
    axes = measurement.determined_axes()
    if not axes:
        return track
    elapsed_h = max(0, measurement.stamp_ns - track.stamp_ns) / NS_PER_H
    slow = _drifted(track.slow, elapsed_h, config)
    away, distance, chance = _innovation(slow, measurement, axes)
    stamp_ns = max(track.stamp_ns, measurement.stamp_ns)
    still = np.zeros(6)
    updated = replace(track, stamp_ns=stamp_ns, slow=slow, innovation=distance, chance=chance)
    if chance >= config.step_false_alarm:
        lag = np.where(_determined(axes), track.lag + LAG_WEIGHT * (away - track.lag), track.lag)
        if _is_improbable(lag, slow, measurement, axes):
            slow, lag = _grown(slow, lag, measurement, axes), still
        elif doubted and chance < DOUBTFUL:
            slow, lag = _grown(slow, away, measurement, axes), still
        slow = _updated(slow, measurement, axes)
        return replace(updated, slow=slow, step=StepState.NONE, candidate=None, lag=lag)
    alone = _restarted(track, measurement, axes)
    if chance < config.overwhelming_false_alarm:
        return replace(updated, slow=alone, step=StepState.CONFIRMED, candidate=None, lag=still)
    if track.candidate is not None:
        fast = _drifted(track.candidate, elapsed_h, config)
        _, _, chance_of_fast = _innovation(fast, measurement, axes)
        if chance_of_fast >= config.step_false_alarm:
            slow = _updated(fast, measurement, axes)
            return replace(updated, slow=slow, step=StepState.CONFIRMED, candidate=None, lag=still)
    return replace(updated, step=StepState.SUSPECTED, candidate=alone)


def fits(T_camera_lidar: Matrix4, measurement: Measurement) -> bool:
    """Whether a window vouches for a pose (4, 4): the pose is not improbable if the window is right."""
    axes = measurement.determined_axes()
    if not axes:
        return True
    away = se3.difference(measurement.T_camera_lidar, T_camera_lidar)
    return _disagreement(away, measurement.uncertainty.covariance, axes)[1] >= IMPROBABLE


def _restarted(track: Track, measurement: Measurement, axes: list[int]) -> PosePosterior:
    """A belief from one window alone. Axes that the window does not determine keep their values, but with the spread of
    the prior, because after a step nothing else vouches for them."""
    away = se3.difference(measurement.T_camera_lidar, track.T_camera_lidar)
    covariance = np.diag(track.prior_sigma**2)
    covariance[np.ix_(axes, axes)] = measurement.uncertainty.noise[np.ix_(axes, axes)]
    determined = _determined(axes)
    systematic = {name: np.where(determined, shift, 0.0) for name, shift in measurement.uncertainty.systematic.items()}
    pose = se3.perturb(track.T_camera_lidar, np.where(determined, away, 0.0))
    return PosePosterior(pose, covariance, systematic, determined, 1)


def _drifted(posterior: PosePosterior, elapsed_h: float, config: TrackerConfig) -> PosePosterior:
    """The belief after `elapsed_h` hours in which the mount may have crept."""
    return replace(posterior, covariance=posterior.covariance + np.diag(elapsed_h * creep_sigma(config) ** 2))


def _determined(axes: list[int]) -> NDArray[np.bool_]:
    """(6,) whether an axis is among these."""
    return np.isin(np.arange(6), axes)


def _innovation(
    posterior: PosePosterior, measurement: Measurement, axes: list[int]
) -> tuple[NDArray[np.float64], float, float]:
    """(6,) from a belief to a window, its squared Mahalanobis distance on some axes, and the chance of one as large."""
    away = se3.difference(measurement.T_camera_lidar, posterior.T_camera_lidar)
    return away, *_disagreement(away, posterior.covariance + measurement.uncertainty.covariance, axes)


def _is_improbable(lag: NDArray[np.float64], slow: PosePosterior, measurement: Measurement, axes: list[int]) -> bool:
    """Whether the mean of the innovations is one that a mount at rest hardly gives: if they are independent, it has
    w / (2 - w) of their variance."""
    spread = LAG_WEIGHT / (2.0 - LAG_WEIGHT) * (slow.covariance + measurement.uncertainty.covariance)
    return _disagreement(lag, spread, axes)[1] < LAGGING


def _grown(slow: PosePosterior, away: NDArray[np.float64], measurement: Measurement, axes: list[int]) -> PosePosterior:
    """The slow track with a covariance that explains a distance (6,) by the noise of a window: the next update then
    goes most of that way. On axes that the window does not determine the covariance stays."""
    covariance = slow.covariance
    scale = np.where(_determined(axes), sqrt(GROWTH), 1.0)
    # Ends: the distance falls to nothing as the covariance grows.
    while _disagreement(away, covariance + measurement.uncertainty.noise, axes)[1] < EXPLAINED:
        covariance = scale[:, None] * covariance * scale
    return replace(slow, covariance=covariance)


def _disagreement(away: NDArray[np.float64], covariance: Matrix6, axes: list[int]) -> tuple[float, float]:
    """Squared Mahalanobis distance of a difference (6,) on some axes, and the chance of one as large. Errors that
    windows of one scene have in common differ between scenes, so systematic errors of a window count as noise in
    `covariance` (6, 6)."""
    s, y = covariance[np.ix_(axes, axes)].tolist(), away[axes].tolist()
    distance = fsum(a * b for a, b in zip(y, solved(s, y), strict=True))
    return distance, chi_square_tail(distance, len(axes))


def _updated(posterior: PosePosterior, measurement: Measurement, axes: list[int]) -> PosePosterior:
    """The Kalman update with the window's perturbation from the belief, on the axes that the window determines.

    K = P Hᵀ (H P Hᵀ + R)⁻¹, ξ = K y, P ← (1 - K H) P (1 - K H)ᵀ + K R Kᵀ (Joseph's form: stays positive definite).
    A systematic error is the same in every window and shifts the belief as it shifts the window, b ← (1 - K H) b + K s.
    It is considered, not estimated (Schmidt 1966), because no number of windows can determine it.
    """
    p, r = posterior.covariance.tolist(), measurement.uncertainty.noise.tolist()
    away = se3.difference(measurement.T_camera_lidar, posterior.T_camera_lidar).tolist()
    s = [[p[i][j] + r[i][j] for j in axes] for i in axes]
    gain = [solved(s, [p[row][j] for j in axes]) for row in range(6)]  # S is symmetric: K's rows solve S·k = P's
    xi = np.array([fsum(k * away[j] for k, j in zip(row, axes, strict=True)) for row in gain])
    column = {axis: place for place, axis in enumerate(axes)}
    keep = [[float(i == j) - (gain[i][column[j]] if j in column else 0.0) for j in range(6)] for i in range(6)]
    noise = [[r[i][j] for j in axes] for i in axes]
    covariance = np.array(congruent(keep, p)) + np.array(congruent(gain, noise))
    before, of_window, none = posterior.systematic, measurement.uncertainty.systematic, np.zeros(6)
    systematic = {}
    for name in sorted({*before, *of_window}):
        old, new = before.get(name, none).tolist(), of_window.get(name, none).tolist()
        shift = [
            fsum(k * b for k, b in zip(keep[i], old, strict=True))
            + fsum(k * new[j] for k, j in zip(gain[i], axes, strict=True))
            for i in range(6)
        ]
        systematic[name] = np.array(shift)
    return PosePosterior(
        se3.perturb(posterior.T_camera_lidar, xi),
        0.5 * (covariance + covariance.T),
        systematic,
        posterior.observed | _determined(axes),
        posterior.windows + 1,
    )


def chi_square_tail(x: float, degrees_of_freedom: int) -> float:
    """Probability that a chi-square variable exceeds `x` (Abramowitz, Stegun 1964, 26.4.4 and 26.4.5)."""
    if x <= 0.0:
        return 1.0
    half = 0.5 * x
    odd = degrees_of_freedom % 2 == 1
    total = erfc(sqrt(half)) if odd else 0.0
    # Terms half^a / Γ(a + 1): a runs in steps of one from 0, or from a half.
    power = 0.5 if odd else 0.0
    term = exp(-half) * (2.0 * sqrt(half / pi) if odd else 1.0)
    for _ in range(degrees_of_freedom // 2):
        total += term
        power += 1.0
        term *= half / power
    return total
