"""What one look at an edge says, whatever made it: a window (strong, minutes apart) or a check (quick, seconds
apart)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.baseline import STREET, UNCOMMISSIONED_BIAS
from coec.calibration.monitor.change_detector import Observation, measurement_on_axes
from coec.calibration.monitor.likelihood import (
    BAD_AFTER_BAD,
    BAD_SHARE,
    BAD_SHARE_WEAK,
    SAME_AGAIN,
    SAME_AGAIN_WEAK,
)
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4
from coec.geometry import dense, se3

BIAS_TIMES = 2.0
"""The first looks of a rig, and a window beside them, are trusted only to this multiple of the usual bias of looks: the
next rig may have a larger bias than the few that are known, and a bias must not pass for a move."""

LEAST_SIGMA, MOST_SIGMA = 1e-6, 10.0
"""Limits of the standard deviation of a look, rad or m. Below the lower one its numbers are no evidence but a fault of
the sender; from the upper one on an axis counts as not determined."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeObservation:
    """Where one look at an edge puts it.

    Attributes:
        edge: its name.
        stamp_ns: sensor time of the last pair of frames.
        T_a_b: (4, 4).
        information: (6, 6) inverse of the covariance of the error that is new at every look, about the axes of a; zero
            on axes that are not determined.
        place: (6,) standard deviation of the error that neighbouring looks share and looks elsewhere do not.
        rig: (6,) standard deviation of the error that is the same everywhere: the unknown bias of the estimator.
        share: how much it counts, 0 to 1: the part of its frames that no earlier look held.
        weak: whether it has little evidence, and may lie anywhere.
        stepped_ns: stamp of the first frame since which the pair by itself suspects a step; None if it suspects none.
            It adds a time at which a step is looked for, and a sensor with one pair is named by looks only if it is
            set.
        window: (6, 6) if the look is an accepted window, the covariance of its error without the bias of the estimator,
            which windows have in common; NaN on axes that it does not determine.
    """

    edge: str
    stamp_ns: int
    T_a_b: Matrix4
    information: NDArray[np.float64]
    place: NDArray[np.float64]
    rig: NDArray[np.float64]
    share: float = 1.0
    weak: bool = False
    stepped_ns: int | None = None
    window: NDArray[np.float64] | None = None

    @property
    def log_bad(self) -> float:
        """Logarithm of the share of bad looks among looks such as this."""
        return log(BAD_SHARE_WEAK if self.weak else BAD_SHARE)

    @property
    def log_bad_again(self) -> float:
        """Logarithm of the chance that it is bad in the same place as the look before it, if that one was bad."""
        return log(BAD_SHARE_WEAK * SAME_AGAIN_WEAK if self.weak else BAD_AFTER_BAD * SAME_AGAIN)


def information_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 6) inverse of a covariance (6, 6) over the axes that it determines (finite, below `MOST_SIGMA`), zero
    elsewhere.

    Raises:
        ValueError: it has another shape, determines no axis, is not symmetric and positive definite on those axes, or
            is absurdly small there.
    """
    if covariance.shape != (6, 6):
        raise ValueError(f"a covariance must have the shape (6, 6), got {covariance.shape}")
    variances = covariance.diagonal()
    with np.errstate(invalid="ignore"):
        determined = np.flatnonzero(np.isfinite(variances) & (variances < MOST_SIGMA**2))
    if not len(determined):
        raise ValueError("a covariance says nothing about any axis: every variance is missing or beyond all use")
    block = covariance[np.ix_(determined, determined)]
    if not np.isfinite(block).all() or (variances[determined] < LEAST_SIGMA**2).any():
        raise ValueError("a covariance is not finite, or smaller than anything can be known to")
    if np.abs(block - block.T).max() > 1e-6 * np.abs(block).max():
        raise ValueError("a covariance is not symmetric")
    # Scaled to a unit diagonal: radians and metres differ by powers of ten.
    scale = 1.0 / np.sqrt(variances[determined])
    inner = dense.inverse(0.5 * (block + block.T) * scale[:, None] * scale)
    information = np.zeros((6, 6))
    information[np.ix_(determined, determined)] = inner * scale[:, None] * scale
    return information


def observation_of_check(
    edge: str, T_served: Matrix4, observation: Observation, share: float = 1.0, stepped_ns: int | None = None
) -> EdgeObservation | None:
    """The look that a check of the pose `T_served` (4, 4) is; None if the check says nothing of the mount, because the
    data were at fault, it holds no new frame, or it determines no axis. For `stepped_ns` see `Look`.

    Raises:
        ValueError: the pose is not rigid, or the offset is not six numbers.
    """
    _rigid(edge, T_served)
    if observation.causes or not share > 0.0:
        return None
    offset, variance = np.zeros(6), np.full(6, np.inf)
    place, rig = np.zeros(6), np.zeros(6)
    # Here looks at poor scenes count among the bad ones: their share was learned with the scatter of a street for all.
    observation = replace(observation, dispersion=1.0)
    for axes in (slice(0, 3), slice(3, 6)):
        measurement = measurement_on_axes(observation, axes, None)
        if measurement is not None:
            offset[axes], variance[axes] = measurement.offset, measurement.noise
            place[axes], rig[axes] = np.sqrt(measurement.place), np.sqrt(measurement.rig)
    if not np.isfinite(variance).any():
        return None
    return EdgeObservation(
        edge=edge,
        stamp_ns=observation.stamp_ns,
        T_a_b=se3.perturb(T_served, offset),
        information=information_of(np.diag(variance)),
        place=place,
        rig=rig,
        share=min(share, 1.0),
        weak=observation.weak,
        stepped_ns=stepped_ns,
    )


def observation_of_window(edge: str, window: Measurement) -> EdgeObservation | None:
    """The look that an accepted window is; None if the window determines no axis.

    Its frames share a street, so the errors that they have in common count as noise here. So does the bias of the
    estimator in `information`: checks have another bias, and the difference would look like a step.

    Raises:
        ValueError: the pose is not rigid, or the covariance is invalid.
    """
    _rigid(edge, window.T_camera_lidar)
    if not window.determined_axes():
        return None
    covariance = window.uncertainty.covariance
    relative_to_checks = covariance + np.diag((BIAS_TIMES * UNCOMMISSIONED_BIAS) ** 2)
    return EdgeObservation(
        edge=edge,
        stamp_ns=window.stamp_ns,
        T_a_b=window.T_camera_lidar,
        information=information_of(relative_to_checks),
        place=STREET,
        rig=UNCOMMISSIONED_BIAS,
        window=covariance,
    )


def _rigid(edge: str, pose: Matrix4) -> None:
    if not se3.is_rigid(pose):
        raise ValueError(f"{edge}: a pose must be a rigid transform (4, 4) of finite numbers")
