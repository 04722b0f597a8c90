"""The figures of a check: the paper's derivatives on every axis, and the edges that a pose keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coec.adapters.images.codec import GreyImages
from coec.calibration.commissioning.baseline import Accuracy, MonitorLimits
from coec.calibration.estimators import sight_of
from coec.calibration.monitor.check import Check, CheckInput, check_at, gather
from coec.calibration.monitor.check_verdict import MIN_EDGES_IN_VIEW, MIN_LOOKS, judge_check, over_limits
from coec.calibration.monitor.neighbourhood import MIN_CONTRAST
from coec.calibration.objective.curvature import axis_derivatives, measure_curvature
from coec.calibration.objective.mutual_information import Evaluation
from coec.calibration.ports import DepthModel, Silence
from coec.calibration.types import Matrix4, Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry import se3

CONFIG = CalibrationConfig()

CENTRE = np.array([0.01, -0.02, 0.005, 0.02, 0.01, -0.03])
PEAKEDNESS = np.array([3.0, 2.0, 1.0, 0.5, 0.4, 0.3])


class Hill:
    """-½ Σ p (ξ - c)² in two frames."""

    step_rad = 1e-3

    def evaluate(self, T_camera_lidar: Matrix4) -> Evaluation:
        off = se3.difference(T_camera_lidar, np.eye(4)) - CENTRE
        score = float(-0.5 * (PEAKEDNESS * off**2).sum())
        frames = np.array([score - 1.0, score + 1.0])
        return Evaluation(score, frames, mi=score, overlap=1.0, points_in_view=1)


def test_are_those_of_the_hill() -> None:
    first, second = axis_derivatives(Hill(), np.eye(4))
    np.testing.assert_allclose(first, PEAKEDNESS * CENTRE, rtol=1e-6)
    np.testing.assert_allclose(second, PEAKEDNESS, rtol=1e-6)


def test_are_those_of_the_curvature() -> None:
    first, second = axis_derivatives(Hill(), np.eye(4))
    curvature = measure_curvature(Hill(), np.eye(4), 6)
    np.testing.assert_array_equal(first, curvature.first_derivative)
    np.testing.assert_array_equal(second, curvature.second_derivative)


@pytest.fixture(scope="module")
def evidence(sharp_street: Window, stereo: DepthModel) -> CheckInput:
    return gather(sight_of(sharp_street, stereo, GreyImages(LimitsConfig()), CONFIG, Silence()), np.radians(1.0))


class TestEdgesKept:
    def test_are_kept_at_the_right_pose_and_lost_to_its_left(self, evidence: CheckInput, sharp_street: Window) -> None:
        right, xi = sharp_street.rig.T_camera_lidar_nominal, np.array([0, np.radians(1.0), 0, 0, 0, 0])
        kept = check_at(evidence, right).edges_kept
        beside = check_at(evidence, se3.perturb(right, xi)).edges_kept
        assert kept > 0.9
        assert beside < 0.7 * kept

    def test_are_looked_for_where_the_bias_puts_them(self, evidence: CheckInput, sharp_street: Window) -> None:
        right, xi = sharp_street.rig.T_camera_lidar_nominal, np.array([0, np.radians(1.0), 0, 0, 0, 0])
        assert check_at(evidence, se3.perturb(right, xi), -xi).edges_kept > 0.9


A_CHECK = Check(
    pairs=1,
    T_rotation=np.eye(4),
    T_pose=np.eye(4),
    offset_rotation=np.zeros(6),
    offset_pose=np.zeros(6),
    edges=10.0,
    edges_at_best=10.0,
    edges_in_view=100_000,
    looks=6.0,
    edges_kept=1.0,
    contrast=10.0,
    overlap=1.0,
)


class TestOverLimits:
    LIMITS = MonitorLimits(12.0, 12.0, 4.0, min_edges_kept=0.8)
    ACCURACY = Accuracy(np.zeros(6), np.full(6, 0.001), np.zeros(6))

    @pytest.mark.parametrize(("kept", "flagged"), [(0.9, False), (0.7, True)])
    def test_a_quarter_of_the_distance_is_too_far_where_the_edges_are_lost(self, kept: float, flagged: bool) -> None:
        seen = replace(A_CHECK, offset_rotation=np.array([0.002, 0, 0, 0, 0, 0]), edges_kept=kept)
        of_rotation, of_pose = over_limits(seen, self.ACCURACY, self.ACCURACY, self.LIMITS)
        assert (of_rotation > 1.0) is flagged
        assert of_pose == 0.0

    def test_lost_edges_alone_flag_nothing(self) -> None:
        of_rotation, _ = over_limits(replace(A_CHECK, edges_kept=0.1), self.ACCURACY, self.ACCURACY, self.LIMITS)
        assert of_rotation == 0.0


@pytest.mark.parametrize(
    ("contrast", "edges", "weak"),
    [(MIN_CONTRAST + 0.5, 10.0, False), (MIN_CONTRAST - 0.5, 10.0, True), (9.0, 1.0, True)],
)
def test_an_optimum_that_stands_out_by_chance_only_is_weak(
    evidence: CheckInput, sharp_street: Window, contrast: float, edges: float, weak: bool
) -> None:
    pairs = len(evidence.pairs)
    seen = replace(A_CHECK, pairs=pairs, contrast=contrast, edges_at_best=edges * float(np.sqrt(pairs)))
    told = judge_check(evidence, seen, sharp_street.T_camera_lidar_start, None)
    assert told.weak is weak
    assert not told.flagged


@pytest.mark.parametrize(
    ("in_view", "looks", "weak"),
    [
        (MIN_EDGES_IN_VIEW + 1, 6.0, False),
        (MIN_EDGES_IN_VIEW - 1, 6.0, True),
        (1000.0, MIN_LOOKS + 0.1, False),
        (1000.0, MIN_LOOKS - 0.1, True),
    ],
)
def test_few_edges_and_frames_that_say_the_same_decide_nothing_however_well_they_fit(
    evidence: CheckInput, sharp_street: Window, in_view: float, looks: float, weak: bool
) -> None:
    pairs = len(evidence.pairs)
    moved = np.array([0.0, np.radians(1.0), 0, 0, 0, 0])
    seen = replace(
        A_CHECK, pairs=pairs, edges_in_view=int(in_view * pairs), looks=looks, edges_at_best=100.0,
        offset_rotation=moved,
    )  # fmt: skip
    told = judge_check(evidence, seen, sharp_street.T_camera_lidar_start, None)
    assert (told.flagged, told.weak) == (True, weak)
