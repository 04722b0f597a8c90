"""From windows to a baseline, on a simulated street whose truth is known, and from its limits to detection."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import radians
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration import commissioning
from coec.calibration.baseline import PRIOR_SPREAD_POSE, Baseline, distance2_quantile, learned_hash
from coec.calibration.commissioning import commission, learn_accuracy, learned
from coec.calibration.monitor.check import CheckInput, gather
from coec.calibration.monitor.check_verdict import FALSE_ALARM_RATE, diagnose, observe
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import Decision, DepthModel, Estimate, ImageReader, Metric, Rig, Silence, Verdict, Window
from coec.config import CalibrationConfig, LimitsConfig, SearchConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.io.images import CachedGreys, GreyImages
from coec.io.rig_files import baseline_hash
from coec_lab.experiments.detection import MIN_RECORDED, interval, table, try_detection
from support.estimates import estimate

CONFIG = CalibrationConfig(search=SearchConfig(reach_deg=8.0))
"""The starts are 5 degrees away: looking no further keeps the solves short."""


@pytest.fixture(scope="module", autouse=True)
def few_checks() -> Iterator[None]:
    """What is learned from few checks is less precise, and learned in the same way."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commissioning, "CHECKS", 4)
        patch.setattr(commissioning, "FAR_CHECKS", 2)
        patch.setattr(commissioning, "SOLVES", 1)
        yield


@pytest.fixture(scope="module")
def images() -> ImageReader:
    return CachedGreys(GreyImages(LimitsConfig()), 16)


@pytest.fixture(scope="module")
def baseline(sharp_street: Window, stereo: DepthModel, images: ImageReader) -> Baseline:
    return commission([sharp_street], stereo, images, CONFIG, sensors={"camera_serial": "C1"})


class TestCommission:
    def test_learns_that_the_estimator_is_right_on_this_rig(self, baseline: Baseline, sharp_street: Window) -> None:
        np.testing.assert_array_equal(baseline.T_camera_lidar, sharp_street.rig.T_camera_lidar_nominal)
        assert np.degrees(np.abs(baseline.bias[:3])).max() < 0.3
        assert baseline.pairs == len(sharp_street.pairs)
        assert baseline.sensors["camera_serial"] == "C1"
        assert baseline.config_hash == learned_hash(CONFIG)

    def test_its_limits_see_what_they_have_to(self, baseline: Baseline) -> None:
        assert baseline.detected["1 deg"] == 1.0
        assert baseline.detected["3 deg"] == 1.0

    def test_a_check_at_the_commissioned_pose_is_clear_and_at_a_moved_one_is_not(
        self, baseline: Baseline, sharp_street: Window, stereo: DepthModel, images: ImageReader
    ) -> None:
        right = diagnose(sharp_street, stereo, images, CONFIG, baseline)
        assert not right.flagged
        assert right.flagged_by_paper is not None
        moved = se3.perturb(sharp_street.T_camera_lidar_start, np.radians([0.6, -0.6, 0.5, 0, 0, 0]))
        wrong = observe(replace(sharp_street, T_camera_lidar_start=moved), stereo, images, CONFIG, baseline)
        assert wrong.flagged

    def test_refuses_a_reference_that_the_windows_do_not_show(
        self, sharp_street: Window, stereo: DepthModel, images: ImageReader
    ) -> None:
        wrong = se3.perturb(sharp_street.rig.T_camera_lidar_nominal, np.radians([0, 2.0, 0, 0, 0, 0]))
        with pytest.raises(CalibrationError, match="away from the reference: calibrate first"):
            commission([sharp_street], stereo, images, CONFIG, sensors={}, reference=wrong)

    def test_refuses_too_few_pairs(self, sharp_street: Window, stereo: DepthModel, images: ImageReader) -> None:
        few = replace(sharp_street, pairs=sharp_street.pairs[:4])
        with pytest.raises(CalibrationError, match="more than 4 pairs"):
            commission([few], stereo, images, CONFIG, sensors={})

    def test_refuses_windows_of_several_rigs(
        self, sharp_street: Window, stereo: DepthModel, images: ImageReader
    ) -> None:
        other = replace(sharp_street, rig=replace(sharp_street.rig, pair="other"))
        with pytest.raises(CalibrationError, match="several camera-LiDAR pairs"):
            commission([sharp_street, other], stereo, images, CONFIG, sensors={})

    @pytest.mark.slow
    def test_same_windows_same_baseline(
        self, baseline: Baseline, sharp_street: Window, stereo: DepthModel, images: ImageReader
    ) -> None:
        again = commission([sharp_street], stereo, images, CONFIG, sensors={"camera_serial": "C1"})
        assert baseline_hash(again) == baseline_hash(baseline)


class _Scripted:
    """Pairs whose looks put the optimum at the mean of what each pair says (n, 6)."""

    def __init__(self, says: NDArray[np.float64], rig: Rig) -> None:
        self.says, self.rig, self.pairs = says, rig, range(len(says))

    def of(self, indices: Sequence[int]) -> _Scripted:
        return _Scripted(self.says[list(indices)], self.rig)


def test_spread_of_a_pair_is_detected_from_checks_at_halves(
    sharp_street: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without bias: on the average of drives the variance is the true one and that of the prior, by their weights."""
    true = np.array([np.radians(0.3)] * 3 + [0.1] * 3)

    def check_of(evidence: _Scripted, *_: object) -> SimpleNamespace:
        mean = evidence.says.mean(axis=0)
        return SimpleNamespace(offset_rotation=np.where(np.arange(6) < 3, mean, 0.0), offset_pose=mean)

    monkeypatch.setattr(commissioning, "check_at", check_of)
    drives = true * np.random.default_rng(1).normal(size=(100, 48, 6))
    learned_from = [learn_accuracy(cast(CheckInput, _Scripted(says, sharp_street.rig)), np.eye(4)) for says in drives]
    variance = np.mean([pose.spread**2 for _, pose in learned_from], axis=0)
    free = commissioning.BLOCKS - 1
    expected = commissioning.PRIOR_BLOCKS * PRIOR_SPREAD_POSE**2 + free * true**2
    np.testing.assert_allclose(variance * (commissioning.PRIOR_BLOCKS + free), expected, rtol=0.15)
    for says, (rotation, pose) in zip(drives, learned_from, strict=True):
        np.testing.assert_allclose(pose.bias, says.mean(axis=0))
        assert np.isfinite(rotation.spread[:3]).all()
        assert np.isnan(rotation.bias[3:]).all()


def test_detection_learns_on_some_pairs_and_tries_others(
    sharp_street: Window, stereo: DepthModel, images: ImageReader
) -> None:
    evidence = gather(prepare_window_data(sharp_street, stereo, images, CONFIG, Silence()), commissioning.FAR_RAD)
    received: list[tuple[int, int]] = []
    tried = try_detection(
        evidence, sharp_street.T_camera_lidar_start, CONFIG, 1, 2, lambda *step: received.append(step)
    )
    rows = {row.name: row for row in table(tried)}
    assert received == [(1, 1)]
    assert {"right", "0.5 deg", "1 deg", "3 deg"} <= set(rows)
    assert rows["3 deg"].flagged == 1.0
    assert all(row.checks == 2 for row in rows.values())


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"),
    # Wilson 1927, by hand: all or none of n leave n / (n + z²) and z² / (n + z²).
    [(0, 100, 0.0, 0.03699), (100, 100, 0.96301, 1.0), (50, 100, 0.40383, 0.59617), (1, 2, 0.09453, 0.90547)],
)
def test_a_share_has_an_interval(hits: int, of: int, low: float, high: float) -> None:
    assert interval(hits, of) == pytest.approx((low, high), abs=1e-4)


def test_detection_refuses_checks_that_the_monitor_would_not_take(
    sharp_street: Window, stereo: DepthModel, images: ImageReader
) -> None:
    few = replace(sharp_street, pairs=sharp_street.pairs[: MIN_RECORDED - 1])
    evidence = gather(prepare_window_data(few, stereo, images, CONFIG, Silence()))
    with pytest.raises(CalibrationError, match=f"needs {MIN_RECORDED} pairs, there are {MIN_RECORDED - 1}"):
        try_detection(evidence, few.T_camera_lidar_start, CONFIG, 1, 3, lambda *_: None)


def limits_of(says: NDArray[np.float64], rig: Rig, monkeypatch: pytest.MonkeyPatch) -> tuple[float, float]:
    """The limits that are learned where a check at a pose says the mean of what its pairs say (n, 6)."""

    def check_of(evidence: _Scripted, pose: NDArray[np.float64], *_: object) -> SimpleNamespace:
        offset = evidence.says.mean(axis=0) - se3.difference(pose, np.eye(4))
        return SimpleNamespace(
            pairs=len(evidence.pairs), offset_rotation=np.where(np.arange(6) < 3, offset, 0.0), offset_pose=offset,
            edges_at_best=20.0, overlap=1.0,
        )  # fmt: skip

    def depth_of(*_: object) -> SimpleNamespace:
        return SimpleNamespace(agreement_rad=0.0, mi=1.0, f1=1.0, f2=1.0)

    monkeypatch.setattr(commissioning, "check_at", check_of)
    monkeypatch.setattr(commissioning, "depth_cue", depth_of)
    monkeypatch.setattr(commissioning, "CHECKS", 12)
    evidence = cast(CheckInput, _Scripted(says, rig))
    limits = commissioning.learn_limits(
        evidence, np.eye(4), CONFIG, learn_accuracy(evidence, np.eye(4)), FALSE_ALARM_RATE
    )
    return limits.max_distance2_rotation, limits.max_farthest2_pose


def test_limits_are_those_of_blocks_of_time_that_were_left_out(
    sharp_street: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks that lie apart by more than pairs vary within them tell that other streets will lie apart, too."""
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(48, 6)) * np.array([radians(0.1)] * 3 + [0.02] * 3)
    separation = np.repeat(rng.normal(size=(4, 6)), 12, axis=0) * np.array([radians(0.5)] * 3 + [0.1] * 3)
    same = limits_of(noise, sharp_street.rig, monkeypatch)
    other = limits_of(noise + separation, sharp_street.rig, monkeypatch)
    mixed = limits_of(noise + separation[rng.permutation(48)], sharp_street.rig, monkeypatch)
    known_by = commissioning.PRIOR_BLOCKS + commissioning.BLOCKS - 1
    least = distance2_quantile(1.0 - FALSE_ALARM_RATE / 2.0, 3, known_by)
    assert same[0] >= least
    assert other[0] > 1.5 * mixed[0] or other[1] > 1.5 * mixed[1]


def with_metrics(contrast: float, runner_up: float, sigma_deg: float) -> Estimate:
    metrics = (
        Metric("edge_contrast", contrast, 4.0, at_least=True),
        Metric("runner_up", runner_up, 0.9, at_least=False),
        Metric("sigma_deg", sigma_deg, 0.25, at_least=False),
    )
    return replace(estimate(0), verdict=Verdict(Decision.ACCEPTED, metrics, ()))


class TestVerdictLimits:
    def test_lie_half_way_between_right_and_wrong(self) -> None:
        limits = learned([with_metrics(16.0, 0.4, 0.1)], [with_metrics(4.0, 0.9, 0.2)])
        assert limits == {"min_edge_contrast": pytest.approx(8.0), "max_runner_up": pytest.approx(0.6)}

    def test_a_figure_that_does_not_distinguish_them_has_none(self) -> None:
        near = [with_metrics(16.0, 0.4, 0.1), with_metrics(3.0, 0.5, 0.1)]
        assert set(learned(near, [with_metrics(4.0, 0.9, 0.2)])) == {"max_runner_up"}
