"""From a window to an estimate: the pipeline of the paper on one page (Borer et al. 2023, METHOD section 1)."""

from collections import Counter

import numpy as np

from coec.calibration import verdict
from coec.calibration.frames.motion_compensation import compensation
from coec.calibration.search.change_point import change_point, moved_within
from coec.calibration.solver import EstimatorResult, WindowData, prepare_window_data, solve
from coec.calibration.types import (
    MOVED,
    Compensation,
    DepthModel,
    Estimate,
    ImageReader,
    Optimum,
    Progress,
    Window,
)
from coec.calibration.uncertainty.covariance import assess_optimum
from coec.config import CalibrationConfig, config_hash
from coec.geometry import se3


def calibrate(
    window: Window, depth: DepthModel, images: ImageReader, config: CalibrationConfig, progress: Progress
) -> Estimate:
    """Re-estimates the extrinsic from one window.

    Deterministic: the same window, network and configuration give the same estimate, bit for bit.

    Raises:
        CalibrationError: the window has no pairs, a frame has no usable depth, or no point can come into view.
    """
    # P_i and D_i, the objective of equation (1) and its maximum.
    data = prepare_window_data(window, depth, images, config, progress)
    return estimate_of(solve(data, config), data, config)


def estimate_of(result: EstimatorResult, data: WindowData, config: CalibrationConfig) -> Estimate:
    """The estimate from what an estimator found in a window, with its uncertainty and verdict."""
    window, progress = data.window, data.progress
    # How certain the window is of it, and along which axes.
    optimum = assess_optimum(result, data, config)
    # Self-diagnosis, equation (2).
    pose, curvature = optimum.search.T_camera_lidar, optimum.curvature
    evaluation = result.objective.evaluate(pose)
    change = None if result.edges is None else change_point(result.edges, pose)
    metrics = verdict.optimum_metrics(
        result.metrics, evaluation, result.edge_scale, optimum, change, len(window.pairs), config
    )
    moved = None
    if result.edges is not None and change is not None and any(m.name == MOVED and not m.passed for m in metrics):
        moved = moved_within(change, result.edges, data)
    details = verdict.reason_details(optimum.posterior, moved, window)
    independent_samples, pairs = optimum.uncertainty.independent_samples, len(window.pairs)
    judged = verdict.judge(metrics, optimum.search.stop_reason, independent_samples, pairs, details, optimum.sigma)
    progress.step("diagnosis", 1, 1)

    dof, axes = config.search.dof, np.arange(6)
    outcomes = Counter(compensation(pair, window.rig, enabled=config.motion_compensation) for pair in window.pairs)
    return Estimate(
        window_id=window.window_id,
        data_stamp_ns=window.stamp_ns,
        pairs=pairs,
        optimum=Optimum(
            T_camera_lidar=pose,
            score=evaluation.score,
            score_at_start=result.objective.evaluate(window.T_camera_lidar_start).score,
            mi=evaluation.mi,
            overlap=evaluation.overlap,
            points_in_view=evaluation.points_in_view,
            evaluations=optimum.search.evaluations,
            stop_reason=optimum.search.stop_reason,
            first_derivative=curvature.first_derivative,
            second_derivative=curvature.second_derivative,
        ),
        verdict=judged,
        correction=se3.difference(pose, window.rig.T_camera_lidar_nominal),
        uncertainty=optimum.uncertainty,
        solved=(axes < dof) & ~np.isin(axes, optimum.unobservable),
        unobservable=np.isin(axes, optimum.unobservable),
        compensation={outcome.value: outcomes[outcome] for outcome in Compensation},
        depth_identity=data.depth.identity,
        config_hash=config_hash(
            config.objective, config.search, config.verdict, str(config.motion_compensation), data.depth.identity
        ),
        moved=moved,
        lens=verdict.estimate_lens(optimum.posterior, window.rig.camera),
        cues=result.cues,
    )
