"""Learns the limits of equation (2) for full calibrations of one rig, from calibrations that find the right pose and
calibrations that cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import degrees, inf, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.calibrator import calibrate
from coec.calibration.ports import DepthModel, ImageReader, Silence, Step, Steps
from coec.calibration.types import Estimate, Matrix4, Window
from coec.config import CalibrationConfig, VerdictConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.vectors import random_direction

SOLVES = 6
"""Number of calibrations of each kind, each on a random half of the pairs. Limits lie between the worst right and the
best wrong one."""

MIN_HALF = 5
"""Least pairs of such a half: it takes more pairs than axes to have an uncertainty (three degrees of freedom)."""

NEAR_RAD, LOST_RAD, LOST_REACH_RAD = radians(5.0), radians(20.0), radians(8.0)
"""Distance of the start from the right pose, for calibrations that find it (well inside any search) and for lost ones,
and the reach of a lost one. The last is less than half the second, so that a lost one cannot find the right pose."""

RIGHT_RAD = radians(0.5)
"""A calibration is right if it ends nearer than this to where the estimator puts the rig."""

OF_NOISE = ("sigma", "newton_step")
"""Figures that show how precise a result is, not whether it is the right one. Their limits depend on the use of the
result, and stay as configured."""

VERDICT_SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""


def verdict_limits(
    window: Window,
    right: Matrix4,
    expected: Matrix4,
    depth: DepthModel,
    images: ImageReader,
    config: CalibrationConfig,
) -> Steps[dict[str, float]]:
    """Learned limits, by the names of `VerdictConfig`; those about which nothing was learned are absent. A step is one
    calibration.

    Args:
        window: all pairs.
        right: (4, 4) the right extrinsic, around which the starts lie.
        expected: (4, 4) where the estimator puts it.
    """
    rng = np.random.default_rng(VERDICT_SEED)
    near: list[Estimate] = []
    lost: list[Estimate] = []
    count = len(window.pairs)
    for number in range(1, 2 * SOLVES + 1):
        astray = number % 2 == 0
        indices = sorted(rng.permutation(count)[: max(count // 2, min(MIN_HALF, count))].tolist())
        xi = np.zeros(6)
        xi[:3] = (LOST_RAD if astray else NEAR_RAD) * random_direction(rng)
        tried = replace(
            window, T_camera_lidar_start=se3.perturb(right, xi), pairs=tuple(window.pairs[i] for i in indices)
        )
        try:
            estimate = calibrate(tried, depth, images, _astray(config) if astray else config, Silence())
        except CalibrationError:
            pass
        else:
            error_rad = se3.rotation_angle_rad(estimate.optimum.T_camera_lidar @ se3.inverse(expected))
            (near if error_rad < RIGHT_RAD else lost).append(estimate)
        yield Step("verdicts", number, 2 * SOLVES)
    return learned(near, lost) if near and lost else {}


def learned(near: Sequence[Estimate], lost: Sequence[Estimate]) -> dict[str, float]:
    """Limits half-way, in ratio, between the right and the wrong calibrations, for every figure that separates all of
    them."""
    limits = {}
    for metric in near[0].verdict.metrics:
        name = f"{'min' if metric.at_least else 'max'}_{metric.name}"
        if name not in VerdictConfig.model_fields or metric.name.startswith(OF_NOISE):
            continue
        sign = 1.0 if metric.at_least else -1.0
        # Logarithms, signed so that more is better.
        worst = float((sign * _log(near, metric.name)).min(initial=inf))
        best = float((sign * _log(lost, metric.name)).max(initial=-inf))
        if np.isfinite(worst) and np.isfinite(best) and worst > best:
            limits[name] = float(np.exp(sign * 0.5 * (worst + best)))
    return limits


def _astray(config: CalibrationConfig) -> CalibrationConfig:
    """The configuration of a search that cannot reach the right pose."""
    reach_deg = degrees(LOST_REACH_RAD)
    reach = {"reach_deg": reach_deg, "rotation_deg": min(reach_deg, config.search.rotation_deg)}
    return config.model_copy(update={"search": config.search.model_copy(update=reach)})


def _log(estimates: Sequence[Estimate], name: str) -> NDArray[np.float64]:
    """Logarithms of one metric over the estimates, where it is positive."""
    values = [m.value for estimate in estimates for m in estimate.verdict.metrics if m.name == name and m.value > 0.0]
    return np.log(np.array(values, dtype=np.float64))
