"""Estimates to wire models and back."""

import dataclasses
import json
import math
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.calibration.types import (
    Decision,
    Estimate,
    LensEstimate,
    Metric,
    MovedWithin,
    Optimum,
    Reason,
    Rig,
    StopReason,
    Uncertainty,
    Verdict,
)
from coec.errors import DecodeError
from coec.geometry.cameras import build
from coec.geometry.se3 import perturbation
from coec.io.serialise import comparable, estimate_of, intrinsics_of, matrix_of, result_of, transform_of
from coec.schemas.message import from_json, from_msgpack, to_json, to_msgpack
from coec.schemas.replies import CalibrationResult
from coec.schemas.replies import StopReason as TheirReason

NAN = math.nan
RIG = Rig(
    pair="front",
    camera=build("pinhole", width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5),
    camera_frame="camera",
    lidar_frame="lidar",
    T_camera_lidar_nominal=np.eye(4),
    T_lidar_ego=np.eye(4),
)


def estimate(seed: int = 0, **changes: Any) -> Estimate:
    """A failed result with every kind of number in it."""
    rng = np.random.default_rng(seed)
    optimum = Optimum(
        T_camera_lidar=perturbation(rng.normal(size=6)),
        score=float(rng.normal()),
        score_at_start=NAN,
        mi=1 / 3,
        overlap=0.9,
        points_in_view=123_456,
        evaluations=57,
        stop_reason=StopReason.AT_BOUND,
        first_derivative=np.array([*rng.normal(size=3), NAN, NAN, NAN]),
        second_derivative=np.array([*rng.normal(size=3) * 1e9, NAN, NAN, NAN]),
    )
    metrics = (
        Metric("overlap", 0.9, 0.5, True),
        Metric("f1", NAN, 0.25, False),
        Metric("mi", math.inf, 3.0, True),
    )
    built = Estimate(
        window_id="front-12",
        data_stamp_ns=2**62 + 1,
        pairs=25,
        optimum=optimum,
        verdict=Verdict(Decision.FAILED, metrics, (Reason("at_bound", "The optimum lies at the bound."),)),
        correction=rng.normal(size=6) * 0.05,
        uncertainty=Uncertainty(
            noise=np.pad(1e-6 * np.cov(rng.normal(size=(3, 9))), (0, 3), constant_values=NAN),
            systematic={name: 1e-3 * rng.normal(size=6) for name in ("stamps", "columns")},
            independent_samples=float(rng.uniform(1.0, 25.0)),
        ),
        solved=np.array([True, True, True, False, False, False]),
        unobservable=np.array([False, False, False, False, True, False]),
        compensation={"done": 24, "no_ego_motion": 1},
        depth_identity="precomputed",
        config_hash="0123456789abcdef",
    )
    return dataclasses.replace(built, **changes)


def test_a_move_within_the_window_travels_with_the_result() -> None:
    rng = np.random.default_rng(3)
    moved = MovedWithin(11, 12, 5, perturbation(rng.normal(size=6)), perturbation(rng.normal(size=6)))
    sent = estimate(moved=moved)
    read = from_json(CalibrationResult, to_json(result_of(sent, RIG, "truck-7")))
    assert same(estimate_of(read).moved, moved)
    assert estimate_of(result_of(estimate(), RIG, "truck-7")).moved is None


def test_the_lens_travels_with_the_result() -> None:
    values = np.random.default_rng(4).normal(size=(4, 4))
    lens = LensEstimate(values[0], values[1], values[2], values[3], np.array([True, False, True, False]), 0.25)
    reply = result_of(estimate(lens=lens), RIG, "truck-7")
    assert reply.lens is not None
    assert reply.lens.estimated["cx"] == 319.5 + values[0, 0]
    assert reply.lens.estimated["fx"] == 500.0 * (1.0 + values[0, 2])
    assert (reply.lens.focal_length.unit, reply.lens.focal_length.free_sigma) == ("share", values[3, 2])
    assert (reply.lens.principal_point_y.determined, reply.lens.radial.difference) == (False, values[0, 3])
    read = estimate_of(from_json(CalibrationResult, to_json(reply)))
    assert same(read.lens, lens)
    assert to_json(result_of(read, RIG, "truck-7")) == to_json(reply)


def test_a_result_of_an_earlier_version_has_no_lens_and_no_hash_which_is_no_difference() -> None:
    one = np.ones(4)
    lens = LensEstimate(one, one, one, one, np.ones(4, np.bool_), 0.25)
    reached = result_of(estimate(lens=lens), RIG, "truck-7")
    document = json.loads(to_json(reached))
    del document["lens"], document["intrinsics"]["sha256"]
    recorded = from_json(CalibrationResult, json.dumps(document).encode())
    assert estimate_of(recorded).lens is None
    assert to_json(comparable(reached, recorded)) == to_json(recorded)


def test_the_hash_of_intrinsics_names_them() -> None:
    same_again = build("pinhole", width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
    assert intrinsics_of(RIG.camera).sha256 == intrinsics_of(same_again).sha256
    assert intrinsics_of(RIG.camera).sha256 != intrinsics_of(RIG.camera._replace(cx=319.0)).sha256


def test_a_result_of_an_earlier_version_is_the_same_decision_without_intrinsics() -> None:
    """What it lacks is no difference; other intrinsics in it are one."""
    reached = result_of(estimate(), RIG, "truck-7")
    assert reached.intrinsics is not None
    recorded = from_json(
        CalibrationResult, to_json(reached.model_copy(update={"schema_version": 6, "intrinsics": None}))
    )
    assert to_json(comparable(reached, recorded)) == to_json(recorded)
    other = reached.model_copy(update={"intrinsics": reached.intrinsics.model_copy(update={"model": "mei"})})
    assert to_json(comparable(reached, other)) != to_json(other)


def same(one: Any, other: Any) -> bool:
    """Equality down to the bits of every number, NaN included; metrics in any order."""
    if isinstance(one, np.ndarray):
        return bool(one.dtype == other.dtype and one.tobytes() == other.tobytes())
    if dataclasses.is_dataclass(one):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in dataclasses.fields(one))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple) and one and isinstance(one[0], Metric):
        return len(one) == len(other) and all(
            same(a, b) for a, b in zip(sorted(one, key=str), sorted(other, key=str), strict=True)
        )
    return bool(one == other or (one != one and other != other))


@given(st.integers(0, 2**32))
def test_there_and_back_keeps_every_bit(seed: int) -> None:
    metrics = (
        Metric("overlap", 0.9, 0.5, True),
        Metric("f1", NAN, 0.25, False),
        Metric("unlimited", 7.0, math.inf, False),
        Metric("unlimited_too", 7.0, -math.inf, True),
    )
    sent = estimate(seed, verdict=Verdict(Decision.ACCEPTED, metrics, ()))
    result = result_of(sent, RIG, "truck-7")

    for read in (
        result,
        from_json(CalibrationResult, to_json(result)),
        from_msgpack(CalibrationResult, to_msgpack(result)),
    ):
        assert same(estimate_of(read), sent)
        again = result_of(estimate_of(read), RIG, "truck-7")
        assert to_json(again) == to_json(result)
        assert to_msgpack(again) == to_msgpack(result)


def test_what_people_read_is_in_degrees_and_metres() -> None:
    result = result_of(estimate(correction=np.array([math.pi / 180, 0, 0, 0.25, 0, 0])), RIG, "truck-7")

    assert result.correction == pytest.approx((1, 0, 0, 0.25, 0, 0))
    assert result.correction_rad_m[0] == math.pi / 180
    assert result.status == "failed"
    assert (result.vehicle, result.pair, result.camera_frame) == ("truck-7", "front", "camera")
    assert result.verdict.reasons[0].code == "at_bound"


def test_what_could_not_be_computed_is_null_and_the_rest_is_json() -> None:
    result = result_of(estimate(), RIG, "truck-7")
    document = json.loads(to_json(result), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))

    assert document["score_at_start"] is None
    assert document["sigma"][3:] == [None, None, None]
    assert document["first_derivative"][3:] == [None, None, None]
    assert document["metrics"]["f1"] == {"value": None, "limit": 0.25, "at_least": False, "passed": False}


def test_infinity_stays_on_its_side_of_the_limit() -> None:
    result = result_of(estimate(), RIG, "truck-7")
    (metric,) = (metric for metric in estimate_of(result).verdict.metrics if metric.name == "mi")

    assert result.metrics["mi"].passed
    assert metric.passed


def test_a_transform_has_one_matrix_in_three_forms() -> None:
    T = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]], dtype=np.float64)
    transform = transform_of(T)

    assert transform.matrix[0] == (0, -1, 0, 0.1)
    assert transform.translation_m == (0.1, 0.2, 0.3)
    assert transform.quaternion_xyzw == pytest.approx((0.5, -0.5, 0.5, 0.5))
    assert matrix_of(transform).tobytes() == T.tobytes()


def test_the_wire_knows_every_end_of_a_search_and_no_other() -> None:
    """What a forged window or history says beyond them is not its form, and no fault of whoever reads it."""
    assert set(get_args(TheirReason)) == {reason.value for reason in StopReason}
    forged = json.loads(to_json(result_of(estimate(), RIG, "test"))) | {"stop_reason": "toleqance_reached"}
    with pytest.raises(DecodeError, match="stop_reason"):
        from_json(CalibrationResult, json.dumps(forged).encode())
