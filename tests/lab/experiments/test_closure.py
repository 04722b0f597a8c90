"""Closure of two calibrations, on poses whose error is known by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.types import Matrix4, Rig
from coec.errors import UsageError
from coec.geometry import se3
from coec.geometry.cameras import build
from coec_lab.experiments.closure import Between, FrameChoice, Relation, Solve, between, close
from coec_lab.experiments.solve_statistics import SolveOutcome, Trial, score
from lab.experiments.test_statistics import _estimate, _xi

T_A = se3.exp(np.array([1.2, -1.2, 1.2, 0.1, -0.3, 0.8]))
T_B_A = se3.exp(np.array([0.1, 0.5, -0.2, -0.6, 0.05, 0.1]))


def _outcome(T_camera_lidar: Matrix4, sigma: float = 1e-3, accepted: bool = True) -> SolveOutcome:
    estimate = _estimate(np.zeros(6), accepted, sigma)
    estimate = replace(estimate, optimum=replace(estimate.optimum, T_camera_lidar=T_camera_lidar))
    return score(Trial(T_camera_lidar, estimate, 1.0), T_camera_lidar, 6)


def _rig(T_camera_lidar: Matrix4, camera: str = "a", lidar: str = "top") -> Rig:
    view = build("pinhole", width=10, height=10, fx=5.0, fy=5.0, cx=4.5, cy=4.5)
    return Rig("pair", view, camera, lidar, T_camera_lidar, np.eye(4))


Requested = tuple[str, int, Sequence[int] | None]
"""Of whom, in which trial, on which frames."""

XI = _xi(0.02, -0.01, 0.03, 0.004, 0.002, -0.003)


@pytest.mark.parametrize("relation", list(Relation))
def test_true_calibrations_close_and_an_error_of_b_shows_as_it_is(relation: Relation) -> None:
    known = Between(relation, T_B_A)
    T_b = known.predicted(T_A)
    for moved in (np.zeros(6), XI):
        result = known.error(_outcome(T_A), _outcome(se3.perturb(T_b, moved)))
        assert result is not None
        np.testing.assert_allclose(result[0], moved, atol=1e-9)


@pytest.mark.parametrize("relation", list(Relation))
def test_errors_of_a_show_as_the_jacobian_reports(relation: Relation) -> None:
    known = Between(relation, T_B_A)
    result = known.error(_outcome(se3.perturb(T_A, XI)), _outcome(known.predicted(T_A)))
    assert result is not None
    np.testing.assert_allclose(result[0], -known.jacobian @ XI, atol=5e-6)


def test_what_is_between_follows_from_both_calibrations() -> None:
    T_B = T_B_A @ T_A
    cameras = between(_rig(T_A, "a"), _rig(T_B, "b"), None)
    assert cameras.relation is Relation.CAMERAS
    np.testing.assert_allclose(cameras.T_b_a, T_B_A, atol=1e-12)
    lidars = between(_rig(T_A, lidar="top"), _rig(T_A @ se3.inverse(T_B_A), lidar="front"), None)
    assert lidars.relation is Relation.LIDARS
    np.testing.assert_allclose(lidars.T_b_a, T_B_A, atol=1e-12)
    np.testing.assert_allclose(lidars.predicted(T_A), T_A @ se3.inverse(T_B_A), atol=1e-12)


def test_what_is_given_is_taken() -> None:
    assert between(_rig(T_A, "a"), _rig(T_A, "b"), T_B_A).T_b_a is T_B_A


def test_sensors_that_share_nothing_cannot_close() -> None:
    with pytest.raises(UsageError, match="share neither LiDAR"):
        between(_rig(T_A, "a", "top"), _rig(T_A, "b", "front"), None)


def _close(
    pairs: tuple[int, int], dof: int = 6, accepted: bool = True
) -> tuple[list[Requested], dict[FrameChoice, float]]:
    """The frames that were asked of A and B, and the median rotation (rad) of the closure on each kind of frames."""
    known = Between(Relation.CAMERAS, T_B_A)
    requested: list[Requested] = []

    def solve(name: str, T: Matrix4) -> Solve:
        def of(trial: int, frames: Sequence[int] | None) -> SolveOutcome:
            requested.append((name, trial, frames))
            return _outcome(T, accepted=accepted)

        return of

    off = se3.perturb(known.predicted(T_A), _xi(0.5))
    closures = close(known, solve("a", T_A), solve("b", off), pairs, 2, dof, lambda *_: None)
    assert all(np.isnan(closure.translation_m.median) == (dof == 3 or not accepted) for closure in closures)
    return requested, {closure.frames: closure.rotation_rad.median for closure in closures}


def test_all_frames_the_same_half_and_other_halves() -> None:
    requested, medians = _close((6, 7))
    assert list(medians) == list(FrameChoice)
    assert list(medians.values()) == pytest.approx([radians(0.5)] * 3)
    of_first = [frames for _, trial, frames in requested if trial == 0]
    assert of_first[:2] == [None, None]
    a, b_shared, b_other = ([] if frames is None else list(frames) for frames in of_first[2:])
    assert a == b_shared
    assert not set(a) & set(b_other)
    assert sorted(a + b_other) == list(range(6))


def test_one_pair_has_no_halves_and_three_degrees_no_translation() -> None:
    _, medians = _close((1, 1), dof=3)
    assert list(medians) == [FrameChoice.ALL]


def test_refused_calibrations_do_not_close() -> None:
    _, medians = _close((4, 4), accepted=False)
    assert np.isnan(list(medians.values())).all()
