"""The figures of a check: the paper's derivatives on every axis, and the edges that a pose keeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.baseline import Accuracy, MonitorLimits
from coec.calibration.monitor.check import (
    MIN_EDGES_IN_VIEW,
    MIN_INDEPENDENT_SAMPLES,
    Check,
    CheckInput,
    Expected,
    Support,
    check_at,
    gather,
    support,
)
from coec.calibration.monitor.check_edges import MIN_CONTRAST
from coec.calibration.monitor.check_verdict import TELLING_CONTRAST, Opinion, judge_check, opinion, over_limits
from coec.calibration.objective.landscape import axis_derivatives, measure_curvature
from coec.calibration.objective.mutual_information import Evaluation
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import DepthModel, Matrix4, Silence, Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry import se3
from coec.io.images import GreyImages

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

    def evaluate_each(self, poses: NDArray[np.float64]) -> list[Evaluation]:
        return [self.evaluate(pose) for pose in poses]


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
    return gather(
        prepare_window_data(sharp_street, stereo, GreyImages(LimitsConfig()), CONFIG, Silence()), np.radians(1.0)
    )


class TestSupport:
    def test_edges_insist_next_to_a_wrong_pose_and_not_at_the_right_one(
        self, evidence: CheckInput, sharp_street: Window
    ) -> None:
        right, xi = sharp_street.rig.T_camera_lidar_nominal, np.array([0, np.radians(1.0), 0, 0, 0, 0])
        assert not check_at(evidence, right).of_rotation.insists
        neighbour = check_at(evidence, se3.perturb(right, xi))
        assert neighbour.of_rotation.insists
        assert neighbour.of_pose.insists

    def test_nothing_is_gained_where_the_bias_puts_the_optimum(
        self, evidence: CheckInput, sharp_street: Window
    ) -> None:
        right, xi = sharp_street.rig.T_camera_lidar_nominal, np.array([0, np.radians(1.0), 0, 0, 0, 0])
        reported = check_at(evidence, se3.perturb(right, xi), Expected(-xi, -xi))
        assert not reported.of_rotation.insists
        assert not reported.of_pose.insists

    @pytest.mark.fault("one thing in the image pulls the optimum aside", "the look does not accuse the mount")
    def test_what_all_cells_gain_is_certain_and_what_a_few_gain_is_not(
        self, record_property: Callable[[str, object], None]
    ) -> None:
        there = np.full((6, 16), 1.0)
        everywhere = support(there, there - 0.3 + np.random.default_rng(1).normal(0.0, 0.05, (6, 16)))
        one_thing = np.zeros((6, 16))
        one_thing[:, 3] = 16 * 0.3
        assert everywhere.insists
        offset = support(there, there - one_thing)
        assert offset.retained == pytest.approx(everywhere.retained, abs=0.02)
        assert not offset.gained
        record_property("figure", f"gained by {offset.certainty:.1f} σ; by all alike {everywhere.certainty:.0f} σ")

    def test_an_optimum_without_edges_gained_nothing(self) -> None:
        reported = support(np.zeros((6, 16)), np.zeros((6, 16)))
        assert (reported.retained, reported.certainty, reported.insists) == (1.0, 0.0, False)


NOTHING = Support(retained=1.0, certainty=0.0)
INSISTS = Support(retained=0.6, certainty=4.0)

A_CHECK = Check(
    pairs=1,
    T_rotation=np.eye(4),
    T_pose=np.eye(4),
    offset_rotation=np.zeros(6),
    offset_pose=np.zeros(6),
    edges=10.0,
    edges_at_best=10.0,
    edges_in_view=100_000,
    independent_samples=6.0,
    scatter_rad=np.zeros(3),
    of_rotation=NOTHING,
    of_pose=NOTHING,
    contrast=TELLING_CONTRAST,
    overlap=1.0,
)


class TestOpinion:
    """At one, two and four times half the limit of the distance."""

    LIMITS = MonitorLimits(12.0, 12.0, 4.0, insisted_share=0.25)
    ACCURACY = Accuracy(np.zeros(6), np.full(6, 0.001), np.zeros(6))

    def message(self, seen: Check, off: float, limits: MonitorLimits = LIMITS) -> Opinion:
        sigma = self.ACCURACY.sigma(1)[0]
        seen = replace(seen, offset_rotation=np.array([off * sigma * np.sqrt(3.0), 0, 0, 0, 0, 0]))
        over, _ = over_limits(seen, self.ACCURACY, self.ACCURACY, limits)
        assert over == pytest.approx(0.25 * off**2)
        return opinion(seen, self.ACCURACY, self.ACCURACY, limits)

    @pytest.mark.parametrize(
        ("support_there", "opinions"),
        [
            (NOTHING, (Opinion.CLEAR, Opinion.CLEAR, Opinion.UNDECIDED)),
            (Support(0.95, 4.0), (Opinion.CLEAR, Opinion.UNDECIDED, Opinion.UNDECIDED)),
            (Support(0.5, 1.0), (Opinion.CLEAR, Opinion.CLEAR, Opinion.UNDECIDED)),
            (INSISTS, (Opinion.CLEAR, Opinion.FLAGGED, Opinion.FLAGGED)),
        ],
    )
    def test_far_off_is_wrong_where_the_edges_insist_and_open_where_they_do_not(
        self, support_there: Support, opinions: tuple[Opinion, ...]
    ) -> None:
        seen = replace(A_CHECK, of_rotation=support_there)
        assert tuple(self.message(seen, off) for off in (0.9, 1.1, 2.1)) == opinions

    def test_the_share_is_of_rigs_whose_bias_is_known(self) -> None:
        limits = MonitorLimits(12.0, 12.0, 4.0)
        seen = replace(A_CHECK, of_rotation=INSISTS)
        assert [self.message(seen, off, limits) for off in (1.1, 2.1)] == [Opinion.CLEAR, Opinion.FLAGGED]

    @pytest.mark.fault("a scene in which everything runs to one point, as on a highway", "one look accuses nobody")
    def test_a_scene_where_optima_scatter_accuses_nobody(self) -> None:
        seen = replace(A_CHECK, of_rotation=INSISTS, contrast=TELLING_CONTRAST - 0.1)
        assert [self.message(seen, off) for off in (0.9, 1.1, 2.1)] == [Opinion.CLEAR, *[Opinion.UNDECIDED] * 2]

    def test_but_where_most_edges_are_lost_any_scene_reports(self) -> None:
        seen = replace(A_CHECK, of_rotation=replace(INSISTS, retained=0.4), contrast=TELLING_CONTRAST - 0.1)
        assert self.message(seen, 2.1) is Opinion.FLAGGED

    def test_what_one_optimum_insists_on_the_other_does_not_say(self) -> None:
        assert self.message(replace(A_CHECK, of_pose=INSISTS), 2.1) is Opinion.UNDECIDED


@pytest.mark.parametrize(
    ("contrast", "edges", "weak"),
    [(MIN_CONTRAST + 0.5, 10.0, False), (MIN_CONTRAST - 0.5, 10.0, True), (9.0, 1.0, True)],
)
def test_an_optimum_that_stands_out_by_chance_only_is_weak(
    evidence: CheckInput, sharp_street: Window, contrast: float, edges: float, weak: bool
) -> None:
    pairs = len(evidence.pairs)
    seen = replace(A_CHECK, pairs=pairs, contrast=contrast, edges_at_best=edges * float(np.sqrt(pairs)))
    reported = judge_check(evidence, seen, sharp_street.T_camera_lidar_start, None)
    assert reported.weak is weak
    assert not reported.flagged


@pytest.mark.parametrize(
    ("in_view", "observations", "weak"),
    [
        (MIN_EDGES_IN_VIEW + 1, 6.0, False),
        (MIN_EDGES_IN_VIEW - 1, 6.0, True),
        (1000.0, MIN_INDEPENDENT_SAMPLES + 0.1, False),
        (1000.0, MIN_INDEPENDENT_SAMPLES - 0.1, True),
    ],
)
def test_few_edges_and_frames_that_say_the_same_decide_nothing_however_well_they_fit(
    evidence: CheckInput, sharp_street: Window, in_view: float, observations: float, weak: bool
) -> None:
    pairs = len(evidence.pairs)
    moved = np.array([0.0, np.radians(1.0), 0, 0, 0, 0])
    seen = replace(
        A_CHECK, pairs=pairs, edges_in_view=int(in_view * pairs), independent_samples=observations, edges_at_best=100.0,
        offset_rotation=moved, of_rotation=INSISTS,
    )  # fmt: skip
    reported = judge_check(evidence, seen, sharp_street.T_camera_lidar_start, None)
    assert (reported.flagged, reported.weak) == (True, weak)
