"""From a window to an estimate: the pipeline of the paper on one page (Borer et al. 2023, METHOD section 1)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from math import degrees

import numpy as np

from coec.calibration.frames.motion_compensation import compensation
from coec.calibration.objective.derivatives import measure_curvature
from coec.calibration.ports import DepthModel, ImageReader, Progress
from coec.calibration.search.change_point import change_point, move_text, moved_within
from coec.calibration.search.local_search import TRANSLATIONS, unobservable, without
from coec.calibration.solver import ESTIMATORS, EstimatorResult, prepare_window_data
from coec.calibration.types import (
    INTRINSICS_OFF,
    MOVED,
    Compensation,
    Estimate,
    Matrix4,
    Optimum,
    Uncertainty,
    Window,
)
from coec.calibration.uncertainty.covariance import measure_uncertainty
from coec.calibration.uncertainty.modes import Rivals, mode_next_to_prior, translation_profile
from coec.calibration.uncertainty.nuisance_parameters import (
    CLOCKS_FREE,
    HELD_FREE,
    LENS,
    LENS_FREE,
    RelaxedAssumption,
    relax_assumptions,
)
from coec.calibration.uncertainty.scatter import IndependentSamples, independent_samples_at
from coec.calibration.verdict import (
    change_metric,
    counted_once,
    intrinsics_metric,
    judge,
    repetition_metric,
    shape_metrics,
)
from coec.config import CalibrationConfig, config_hash
from coec.errors import CalibrationError
from coec.geometry import se3

CONTRADICTED = {HELD_FREE: "with the held centre", CLOCKS_FREE: "with the clocks"}
"""For people: with what a window disagrees if setting this assumption free turns the camera."""


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
    data = prepare_window_data(window, depth, images, config, progress)
    result = ESTIMATORS[config.objective.kind](data, config)
    objective, search, every = result.objective, result.search, tuple(range(dof))
    curvature = measure_curvature(objective, search.T_camera_lidar, dof)
    held = tuple(axis for axis in TRANSLATIONS if axis not in every)
    held_m = config.verdict.held_translation_sigma_m
    rivals = (*result.rivals, *_prior_mode(result, data.window, dof))
    relaxed = _relaxed_assumptions(result, data.window, search.T_camera_lidar, held, held_m)
    seen = _independent_samples(result, search.T_camera_lidar)
    uncertainty = _uncertainty(result, data.window, search.T_camera_lidar, every, rivals, relaxed, seen, config)
    blind = unobservable(curvature, uncertainty.sigma, dof, config.verdict)
    if blind:
        search = without(blind, search, objective, window.T_camera_lidar_start, config.search, progress)
        curvature = measure_curvature(objective, search.T_camera_lidar, dof, blind)
        determined = tuple(axis for axis in every if axis not in blind)
        relaxed = _relaxed_assumptions(result, data.window, search.T_camera_lidar, blind, config.verdict.max_sigma_m)
        seen = _independent_samples(result, search.T_camera_lidar)
        uncertainty = _uncertainty(
            result, data.window, search.T_camera_lidar, determined, rivals, relaxed, seen, config
        )
    pose = search.T_camera_lidar
    # Self-diagnosis, equation (2).
    at_optimum = objective.evaluate(pose)
    change = None if result.edges is None else change_point(result.edges, pose)
    independent_samples, pairs = uncertainty.independent_samples, len(window.pairs)
    changed = change_metric(change, config.verdict)
    metrics = (
        *counted_once(result.metrics, independent_samples, pairs),
        *shape_metrics(at_optimum, curvature, uncertainty.sigma, config.verdict),
        *repetition_metric(seen, window.pairs, config.verdict),
        *intrinsics_metric(relaxed, config.verdict),
        *changed,
    )
    moved = None
    if result.edges is not None and change is not None and not all(metric.passed for metric in changed):
        moved = moved_within(change, result.edges, data)
    details = {
        "sigma_deg": _contradictions_text(relaxed),
        INTRINSICS_OFF: _lens_text(relaxed, window),
        MOVED: "" if moved is None else move_text(moved, window),
    }
    verdict = judge(metrics, search.stop_reason, independent_samples, pairs, details)
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
        moved=moved,
    )


def _independent_samples(result: EstimatorResult, pose: Matrix4) -> IndependentSamples | None:
    """How many independent looks the frames are worth at a pose (4, 4); None if the estimator used no edges."""
    return None if result.edges is None else independent_samples_at(result.edges.sharp, pose)


def _uncertainty(
    result: EstimatorResult,
    window: Window,
    pose: Matrix4,
    moved: tuple[int, ...],
    rivals: Sequence[Rivals],
    relaxed: Sequence[RelaxedAssumption],
    seen: IndependentSamples | None,
    config: CalibrationConfig,
) -> Uncertainty:
    """The uncertainty of `pose` (4, 4), found by a search along the axes `moved`.

    Frames that are worth fewer looks than there are axes leave dents in every ridge of the objective. Only then the
    ridges are followed (`shifted`).
    """
    if seen is not None and seen.count < len(moved):
        rivals = (*rivals, translation_profile(result.objective, pose, moved, config))
    held_m = config.verdict.held_translation_sigma_m
    uncertainty = measure_uncertainty(result.objective, pose, moved, rivals, relaxed, window, held_m)
    return uncertainty if seen is None else replace(uncertainty, independent_samples=seen.count)


def _relaxed_assumptions(
    result: EstimatorResult, window: Window, pose: Matrix4, held: tuple[int, ...], known_m: float
) -> tuple[RelaxedAssumption, ...]:
    """What changes when the assumptions of the window (held centre, clocks, lens) are set free one by one.

    It runs from bands that still feel a lens which is off by pixels to the sharpest edges; empty without edges.
    """
    return () if result.edges is None else relax_assumptions(result.edges.to_the_sharpest, window, pose, held, known_m)


def _prior_mode(result: EstimatorResult, window: Window, dof: int) -> tuple[Rivals, ...]:
    """The summit next to the camera's place before the search, as a rival of the pose found.

    Empty without edges, without searched translations, or without such a summit.
    """
    if result.edges is None or dof <= TRANSLATIONS.start:
        return ()
    pose = result.search.T_camera_lidar
    summit = mode_next_to_prior(result.edges.to_the_sharpest, window, pose)
    return () if summit is None else (Rivals(result.objective, pose, (summit,)),)


def _contradictions_text(relaxed: Sequence[RelaxedAssumption]) -> str:
    """For people: which assumptions the window contradicts, and by how much the camera turns without each."""
    turns = [
        f"{CONTRADICTED[one.name]} set free, it turns by {degrees(float(np.linalg.norm(one.shift[:3]))):.1f}°"
        for one in relaxed
        if one.contradicts and one.name in CONTRADICTED
    ]
    return f" ({'; '.join(turns)})" if turns else ""


def _lens_text(relaxed: Sequence[RelaxedAssumption], window: Window) -> str:
    lens = [one.deviation[LENS] for one in relaxed if one.name == LENS_FREE]
    if not lens:
        return ""
    (right, down, longer), camera = lens[0].tolist(), window.rig.camera
    return (
        f", a focal length {100.0 * longer:+.1f} % and a principal point {right * camera.fx:+.1f} px across and "
        f"{down * camera.fy:+.1f} px down from it"
    )
