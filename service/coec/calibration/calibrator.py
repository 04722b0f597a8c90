"""From a window to an estimate: the pipeline of the paper on one page (Borer et al. 2023, METHOD section 1)."""

from __future__ import annotations

from collections import Counter

import numpy as np

from coec.calibration.confidence import measure_curvature
from coec.calibration.motion import compensate
from coec.calibration.objective import build_objective
from coec.calibration.ports import DepthModel, Progress
from coec.calibration.search import box_of, maximise
from coec.calibration.values import Compensation, Estimate, Optimum, Window
from coec.calibration.verdict import judge
from coec.config import CalibrationConfig, config_hash
from coec.errors import CalibrationError, DecodeError
from coec.geometry import se3


def calibrate(window: Window, depth: DepthModel, config: CalibrationConfig, progress: Progress) -> Estimate:
    """Re-estimates the extrinsic from one window.

    Deterministic: the same window, network and configuration give the same estimate, bit for bit.

    Raises:
        CalibrationError: the window has no pairs, a frame has no usable depth, or no point can come into view.
    """
    if not window.pairs:
        raise CalibrationError("the window holds no pairs of a camera frame and a sweep: check the stamps of both")
    dof = config.search.dof

    # P_i: the clouds at the instants of the exposures.
    compensated = [compensate(pair, window.rig, enabled=config.motion_compensation) for pair in window.pairs]
    # D_i: the virtual depth sensor.
    depths = []
    for done, pair in enumerate(window.pairs, start=1):
        try:
            depths.append(depth.infer(pair.camera))
        except DecodeError as error:
            raise CalibrationError(f"no depth for the camera frame at {pair.stamp_ns} ns: {error}") from error
        progress.step("depth", done, len(window.pairs))
    # Equation (1), everything frozen but the pose.
    clouds = [cloud.xyz_m for cloud in compensated]
    start = window.T_camera_lidar_start
    objective = build_objective(clouds, depths, window.rig, start, box_of(config.search), config.objective)
    # BOBYQA.
    found = maximise(
        objective, start, config.search, lambda count: progress.step("search", count, config.search.max_evaluations)
    )
    # Self-diagnosis, equation (2).
    at_optimum = objective.evaluate(found.T_camera_lidar)
    curvature = measure_curvature(objective, found.T_camera_lidar, dof)
    unrelated = objective.mi_of_unrelated(found.T_camera_lidar)
    verdict = judge(at_optimum, unrelated, curvature, found.stop_reason, config.verdict)
    progress.step("diagnosis", 1, 1)

    outcomes = Counter(cloud.outcome for cloud in compensated)
    return Estimate(
        window_id=window.window_id,
        data_stamp_ns=window.stamp_ns,
        pairs=len(window.pairs),
        optimum=Optimum(
            T_camera_lidar=found.T_camera_lidar,
            score=at_optimum.score,
            score_at_start=found.score_at_start,
            mi=at_optimum.mi,
            overlap=at_optimum.overlap,
            points_in_view=at_optimum.points_in_view,
            evaluations=found.evaluations,
            stop_reason=found.stop_reason,
            first_derivative=curvature.first_derivative,
            second_derivative=curvature.second_derivative,
        ),
        verdict=verdict,
        correction=se3.difference(found.T_camera_lidar, window.rig.T_camera_lidar_nominal),
        sigma=curvature.sigma,
        solved=np.arange(6) < dof,
        compensation={outcome.value: outcomes[outcome] for outcome in Compensation},
        depth_identity=depth.identity,
        config_hash=config_hash(
            config.objective, config.search, config.verdict, str(config.motion_compensation), depth.identity
        ),
    )
