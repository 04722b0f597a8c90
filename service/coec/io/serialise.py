"""Converts estimates to wire models and back. A round trip gives the same bytes, so that the result that one process
solves is exactly the one that another serves, stores or replays."""

import hashlib
import json
import math
import sys
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from coec.calibration import types
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.state import PairState
from coec.calibration.state_machine import step_between
from coec.geometry import cameras
from coec.geometry.se3 import quaternion_xyzw_from_rotation
from coec.schemas import replies


def transform_of(T: types.Matrix4) -> replies.Transform:
    """The wire form of a rigid (4, 4) transform; its matrix holds the same doubles."""
    rows = tuple(tuple(float(v) for v in row) for row in T)
    return replies.Transform(
        matrix=cast("tuple[replies.Row4, replies.Row4, replies.Row4, replies.Row4]", rows),
        translation_m=cast("replies.Vector3", tuple(float(v) for v in T[:3, 3])),
        quaternion_xyzw=cast("replies.Row4", tuple(float(v) for v in quaternion_xyzw_from_rotation(T[:3, :3]))),
    )


def matrix_of(transform: replies.Transform) -> types.Matrix4:
    """(4, 4) float64, the same doubles."""
    return np.array(transform.matrix, dtype=np.float64)


REMEMBERED = 128
"""Estimates, and cameras, whose wire form is remembered: the pairs of a vehicle serve and save the same ones again with
every check."""


@lru_cache(REMEMBERED)
def intrinsics_of(camera: cameras.Camera) -> replies.Intrinsics:
    """The wire form of a camera; its numbers are the same doubles."""
    parameters = cameras.intrinsics_of(camera)
    width, height = int(parameters.pop("width")), int(parameters.pop("height"))
    document: dict[str, Any] = {
        "model": cameras.name_of(camera),
        "width": width,
        "height": height,
        "parameters": {name: float(value) for name, value in parameters.items()},
    }
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return replies.Intrinsics(**document, sha256=hashlib.sha256(canonical.encode()).hexdigest())


_LENS_TERMS: Mapping[str, Literal["px", "share"]] = {
    "principal_point_x": "px",
    "principal_point_y": "px",
    "focal_length": "share",
    "radial": "px",
}
"""Unit of each term of the wire form of a `LensEstimate`, in its order."""


def lens_of(lens: types.LensEstimate, camera: cameras.Camera) -> replies.Lens:
    """The wire form of what a window says of the lens of a camera; its differences are the same doubles."""
    terms = {
        name: replies.LensTerm(
            unit=unit,
            difference=float(lens.difference[place]),
            sigma=float(lens.sigma[place]),
            free_difference=float(lens.free_difference[place]),
            free_sigma=float(lens.free_sigma[place]),
            determined=bool(lens.determined[place]),
        )
        for place, (name, unit) in enumerate(_LENS_TERMS.items())
    }
    estimated = lens.corrected(camera)
    return replies.Lens(
        **terms,
        probability=lens.probability,
        estimated={name: float(getattr(estimated, name)) for name in ("fx", "fy", "cx", "cy")},
    )


def _lens_estimate(lens: replies.Lens) -> types.LensEstimate:
    terms: list[replies.LensTerm] = [getattr(lens, name) for name in _LENS_TERMS]
    return types.LensEstimate(
        difference=np.array([term.difference for term in terms]),
        sigma=np.array([term.sigma for term in terms]),
        free_difference=np.array([term.free_difference for term in terms]),
        free_sigma=np.array([term.free_sigma for term in terms]),
        determined=np.array([term.determined for term in terms]),
        probability=lens.probability,
    )


@lru_cache(REMEMBERED)
def result_of(estimate: types.Estimate, rig: types.Rig, vehicle: str) -> replies.CalibrationResult:
    """The wire form of an estimate, complete. NaN becomes null, infinity the largest double."""
    optimum, uncertainty = estimate.optimum, estimate.uncertainty
    return replies.CalibrationResult(
        vehicle=vehicle,
        pair=rig.pair,
        camera_frame=rig.camera_frame,
        lidar_frame=rig.lidar_frame,
        window_id=estimate.window_id,
        data_stamp_ns=estimate.data_stamp_ns,
        pairs=estimate.pairs,
        camera_from_lidar=transform_of(optimum.T_camera_lidar),
        correction=cast("replies.Vector6", tuple(float(v) for v in in_degrees(estimate.correction))),
        sigma=degrees_or_null(estimate.sigma),
        correction_rad_m=cast("replies.Vector6", tuple(float(v) for v in estimate.correction)),
        noise=cast("replies.Maybe6x6", tuple(_maybe6(row) for row in uncertainty.noise)),
        systematic={
            name: cast("replies.Vector6", tuple(float(v) for v in shift))
            for name, shift in uncertainty.systematic.items()
        },
        correlation_pitch_height=number_or_null(uncertainty.pitch_height),
        correlation_yaw_side=number_or_null(uncertainty.yaw_side),
        independent_looks=number_or_null(uncertainty.independent_samples),
        solved=cast("replies.Flags6", tuple(bool(v) for v in estimate.solved)),
        unobservable=cast("replies.Flags6", tuple(bool(v) for v in estimate.unobservable)),
        status="accepted" if estimate.verdict.decision is types.Decision.ACCEPTED else "failed",
        verdict=replies.Verdict(
            decision=estimate.verdict.decision.value,
            reasons=tuple(replies.Reason(code=r.code, text=r.text) for r in estimate.verdict.reasons),
        ),
        metrics={metric.name: metric_of(metric) for metric in estimate.verdict.metrics},
        score=number_or_null(optimum.score),
        score_at_start=number_or_null(optimum.score_at_start),
        mi=number_or_null(optimum.mi),
        overlap=number_or_null(optimum.overlap),
        points_in_view=optimum.points_in_view,
        evaluations=optimum.evaluations,
        stop_reason=optimum.stop_reason.value,
        first_derivative=_maybe6(optimum.first_derivative),
        second_derivative=_maybe6(optimum.second_derivative),
        compensation=dict(estimate.compensation),
        depth_identity=estimate.depth_identity,
        config_hash=estimate.config_hash,
        moved=None if estimate.moved is None else _moved_of(estimate.moved),
        intrinsics=intrinsics_of(rig.camera),
        lens=None if estimate.lens is None else lens_of(estimate.lens, rig.camera),
        cues={cue.name: _cue_of(cue) for cue in estimate.cues} or None,
    )


def _cue_of(cue: types.CueShare) -> replies.Cue:
    return replies.Cue(
        samples=cue.samples, weight=cue.weight, significance=number_or_null(cue.significance), share=_maybe6(cue.share)
    )


def mistake_of(mistake: types.Mistake) -> replies.ProbableMistake:
    """The wire form of a mistake in the inputs."""
    return replies.ProbableMistake(
        code=mistake.code,
        text=mistake.text,
        significance=number_or_null(mistake.significance),
        significance_as_given=number_or_null(mistake.significance_as_given),
    )


def comparable(reached: replies.CalibrationResult, recorded: replies.CalibrationResult) -> replies.CalibrationResult:
    """`reached` with the schema version of `recorded`, for a comparison byte by byte: a recording by an earlier version
    of the program holds that version, and may lack intrinsics, their hash, the lens or the cues, which is no difference
    in the decision."""
    intrinsics = None if recorded.intrinsics is None else reached.intrinsics
    if recorded.intrinsics is not None and recorded.intrinsics.sha256 is None and intrinsics is not None:
        intrinsics = intrinsics.model_copy(update={"sha256": None})
    lens = None if recorded.lens is None else reached.lens
    cues = None if recorded.cues is None else reached.cues
    changes = {"schema_version": recorded.schema_version, "intrinsics": intrinsics, "lens": lens, "cues": cues}
    return reached.model_copy(update=changes)


def _moved_of(moved: types.MovedWithin) -> replies.MovedWithin:
    return replies.MovedWithin(
        last_before_ns=moved.last_before_ns,
        first_after_ns=moved.first_after_ns,
        pairs_after=moved.pairs_after,
        before=transform_of(moved.T_before),
        after=transform_of(moved.T_after),
    )


def estimate_of(result: replies.CalibrationResult) -> types.Estimate:
    """The estimate that `result_of` wrote, with the same doubles; metrics are sorted by name."""
    return types.Estimate(
        window_id=result.window_id,
        data_stamp_ns=result.data_stamp_ns,
        pairs=result.pairs,
        optimum=types.Optimum(
            T_camera_lidar=matrix_of(result.camera_from_lidar),
            score=_or_nan(result.score),
            score_at_start=_or_nan(result.score_at_start),
            mi=_or_nan(result.mi),
            overlap=_or_nan(result.overlap),
            points_in_view=result.points_in_view,
            evaluations=result.evaluations,
            stop_reason=types.StopReason(result.stop_reason),
            first_derivative=_array(result.first_derivative),
            second_derivative=_array(result.second_derivative),
        ),
        verdict=types.Verdict(
            decision=types.Decision(result.verdict.decision),
            metrics=tuple(
                types.Metric(name, _or_nan(metric.value), _limit_of(metric), metric.at_least)
                for name, metric in sorted(result.metrics.items())
            ),
            reasons=tuple(types.Reason(reason.code, reason.text) for reason in result.verdict.reasons),
        ),
        correction=_array(result.correction_rad_m),
        uncertainty=types.Uncertainty(
            noise=np.array([_array(row) for row in result.noise]),
            systematic={name: np.array(shift) for name, shift in result.systematic.items()},
            independent_samples=_or_nan(result.independent_looks),
        ),
        solved=np.array(result.solved, dtype=np.bool_),
        unobservable=np.array(result.unobservable, dtype=np.bool_),
        compensation=dict(result.compensation),
        depth_identity=result.depth_identity,
        config_hash=result.config_hash,
        moved=None if result.moved is None else _moved_within(result.moved),
        lens=None if result.lens is None else _lens_estimate(result.lens),
        cues=tuple(
            types.CueShare(name, cue.samples, cue.weight, _or_nan(cue.significance), _array(cue.share))
            for name, cue in (result.cues or {}).items()
        ),
    )


def _moved_within(moved: replies.MovedWithin) -> types.MovedWithin:
    return types.MovedWithin(
        moved.last_before_ns,
        moved.first_after_ns,
        moved.pairs_after,
        matrix_of(moved.before),
        matrix_of(moved.after),
    )


def reasons_of(reasons: tuple[types.Reason, ...]) -> tuple[replies.Reason, ...]:
    """Reasons in their wire form."""
    return tuple(replies.Reason(code=reason.code, text=reason.text) for reason in reasons)


def metric_of(metric: types.Metric) -> replies.MetricReply:
    """A figure with its limit."""
    return replies.MetricReply(
        value=number_or_null(metric.value),
        limit=None if math.isinf(metric.limit) else number_or_null(metric.limit),
        at_least=metric.at_least,
        passed=bool(metric.passed),
    )


def check_of(observation: Observation, after: PairState) -> replies.CheckReply:
    """A check, and the state of the pair after it."""
    drift = observation.drift
    return replies.CheckReply(
        stamp_ns=observation.stamp_ns,
        pair_stamps_ns=observation.pair_stamps_ns,
        flagged=observation.flagged,
        undecided=observation.undecided,
        weak=observation.weak,
        flagged_by_paper=observation.flagged_by_paper,
        causes=tuple(replies.Reason(code=cause.code, text=cause.text) for cause in observation.causes),
        metrics={metric.name: metric_of(metric) for metric in observation.metrics},
        first_derivative=_maybe6(observation.first_derivative),
        second_derivative=_maybe6(observation.second_derivative),
        offset=degrees_or_null(observation.offset),
        sigma=degrees_or_null(observation.sigma),
        drift=None if drift is None else degrees_or_null(drift.value),
        drift_sigma=None if drift is None else degrees_or_null(drift.sigma),
        outcome=after.monitor.outcome.value,
        evidence=after.monitor.evidence,
        state=after.health.value,
    )


def candidate_of(state: PairState) -> replies.Candidate | None:
    """The candidate that waits for `apply`; None if there is none."""
    if state.pending is None:
        return None
    pending = state.pending
    window_id = pending.estimate.window_id
    content = f"{window_id}\n".encode() + pending.T_camera_lidar.astype("<f8").tobytes()
    return replies.Candidate(
        window_id=window_id,
        sha256=hashlib.sha256(content).hexdigest(),
        data_stamp_ns=pending.estimate.data_stamp_ns,
        camera_from_lidar=transform_of(pending.T_camera_lidar),
        step=degrees_and_metres(step_between(state.T_camera_lidar, pending.T_camera_lidar)),
        waits=replies.Reason(code=pending.waits.code, text=pending.waits.text),
    )


def degrees_and_metres(rad_m: NDArray[np.float64]) -> replies.Vector6:
    """(6,) radians and metres in the units of the wire, degrees and metres."""
    a, b, c, x, y, z = (float(value) for value in rad_m)
    return math.degrees(a), math.degrees(b), math.degrees(c), x, y, z


def _limit_of(metric: replies.MetricReply) -> float:
    """The limit; if there is none, an infinite one that every figure keeps."""
    if metric.limit is not None:
        return metric.limit
    return -math.inf if metric.at_least else math.inf


def degrees_or_null(rad_m: NDArray[np.float64]) -> replies.Maybe6:
    """(6,) in the units of the wire; NaN becomes null."""
    return _maybe6(in_degrees(rad_m))


def in_degrees(rad_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) radians and metres in degrees and metres."""
    return np.concatenate([np.rad2deg(rad_m[:3]), rad_m[3:]])


def number_or_null(value: float) -> float | None:
    """The value for JSON, which has neither NaN nor infinity: null for NaN, the largest double for infinity, which is
    on the same side of every limit."""
    if math.isnan(value):
        return None
    return float(min(max(value, -sys.float_info.max), sys.float_info.max))


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _maybe6(values: Iterable[float]) -> replies.Maybe6:
    return cast("replies.Maybe6", tuple(number_or_null(float(value)) for value in values))


def _array(values: Iterable[float | None]) -> NDArray[np.float64]:
    return np.array([_or_nan(value) for value in values], dtype=np.float64)
