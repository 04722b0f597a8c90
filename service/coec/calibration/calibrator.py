"""From a window to an estimate: the pipeline of the paper on one page (Borer et al. 2023, METHOD section 1)."""

from __future__ import annotations

from collections import Counter

import numpy as np

from coec.calibration.confidence.uncertainty import measure_uncertainty
from coec.calibration.estimators import ESTIMATORS, sight_of
from coec.calibration.frames.motion_compensation import compensation
from coec.calibration.objective.curvature import measure_curvature
from coec.calibration.ports import DepthModel, ImageReader, Progress
from coec.calibration.search.observability import unobservable, without
from coec.calibration.types import Compensation, Estimate, Optimum, Window
from coec.calibration.verdict import counted_once, judge, shape_metrics
from coec.config import CalibrationConfig, config_hash
from coec.errors import CalibrationError
from coec.geometry import se3


def calibrate(
    window: Window, depth: DepthModel, images: ImageReader, config: CalibrationConfig, progress: Progress
) -> Estimate:
    """Re-estimates the extrinsic from one window.

    Deterministic: the same window, network and configuration give the same estimate, bit for bit.

    Raises:
        CalibrationError: the window has no pairs, a frame has no usable depth, or no point can come into view.
    """
    if not window.pairs:
        raise CalibrationError("the window holds no pairs of a camera frame and a sweep: check the stamps of both")
    dof = config.search.dof

    # P_i and D_i, the objective and its maximum.
    sight = sight_of(window, depth, images, config, progress)
    found = ESTIMATORS[config.objective.kind](sight, config)
    objective, search, every = found.objective, found.search, tuple(range(dof))
    curvature = measure_curvature(objective, search.T_camera_lidar, dof)
    uncertainty = measure_uncertainty(objective, search.T_camera_lidar, every, found.rivals, sight.window)
    blind = unobservable(curvature, uncertainty.sigma, dof, config.verdict)
    if blind:
        search = without(blind, search, objective, window.T_camera_lidar_start, config.search, progress)
        curvature = measure_curvature(objective, search.T_camera_lidar, dof, blind)
        told = tuple(axis for axis in every if axis not in blind)
        uncertainty = measure_uncertainty(objective, search.T_camera_lidar, told, found.rivals, sight.window)
    pose = search.T_camera_lidar
    # Self-diagnosis, equation (2).
    at_optimum = objective.evaluate(pose)
    looks, pairs = uncertainty.looks, len(window.pairs)
    of_objective = counted_once(found.metrics, looks, pairs)
    metrics = (*of_objective, *shape_metrics(at_optimum, curvature, uncertainty.sigma, config.verdict))
    verdict = judge(metrics, search.stop_reason, looks, pairs)
    progress.step("diagnosis", 1, 1)

    outcomes = Counter(compensation(pair, window.rig, enabled=config.motion_compensation) for pair in window.pairs)
    return Estimate(
        window_id=window.window_id,
        data_stamp_ns=window.stamp_ns,
        pairs=pairs,
        optimum=Optimum(
            T_camera_lidar=pose,
            score=at_optimum.score,
            score_at_start=objective.evaluate(window.T_camera_lidar_start).score,
            mi=at_optimum.mi,
            overlap=at_optimum.overlap,
            points_in_view=at_optimum.points_in_view,
            evaluations=search.evaluations,
            stop_reason=search.stop_reason,
            first_derivative=curvature.first_derivative,
            second_derivative=curvature.second_derivative,
        ),
        verdict=verdict,
        correction=se3.difference(pose, window.rig.T_camera_lidar_nominal),
        uncertainty=uncertainty,
        solved=(np.arange(6) < dof) & ~np.isin(np.arange(6), blind),
        unobservable=np.isin(np.arange(6), blind),
        compensation={outcome.value: outcomes[outcome] for outcome in Compensation},
        depth_identity=depth.identity,
        config_hash=config_hash(
            config.objective, config.search, config.verdict, str(config.motion_compensation), depth.identity
        ),
    )
