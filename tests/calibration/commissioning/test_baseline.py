"""Distances in standard deviations, drift, and to what rig a baseline belongs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.baseline import PIXEL_SHARE, Accuracy, drift, mismatch, uncommissioned
from coec.calibration.types import Window
from coec.config import VerdictConfig
from coec.geometry import se3
from coec.geometry.cameras import Camera, build
from support.estimates import a_baseline


class TestAccuracy:
    accuracy = Accuracy(
        bias=np.array([0.01, 0.0, 0.0, np.nan, np.nan, np.nan]),
        bias_sigma=np.full(6, 0.001),
        spread=np.full(6, 0.004),
    )

    def test_no_distance_at_the_bias(self) -> None:
        assert self.accuracy.distance2(self.accuracy.bias, 5) == 0.0

    def test_counts_the_axes_that_were_searched(self) -> None:
        offset = self.accuracy.bias + 3.0 * self.accuracy.sigma(4)
        assert self.accuracy.distance2(offset, 4) == pytest.approx(27.0)
        assert self.accuracy.farthest2(offset, 4) == pytest.approx(9.0)

    def test_more_pairs_determine_more_but_not_more_than_the_bias(self) -> None:
        assert self.accuracy.sigma(16)[0] < self.accuracy.sigma(4)[0]
        assert self.accuracy.sigma(10**9)[0] > 0.001


class TestBaseline:
    def test_unbiased_takes_the_bias_off_an_estimate(self) -> None:
        baseline = a_baseline()
        estimate = se3.perturb(baseline.T_camera_lidar, baseline.bias)
        np.testing.assert_allclose(baseline.unbiased(estimate), baseline.T_camera_lidar, atol=1e-12)

    def test_drift_of_the_commissioned_pose_is_nothing(self) -> None:
        baseline = a_baseline()
        sigma = np.full(6, 0.002)
        result = drift(se3.perturb(baseline.T_camera_lidar, baseline.bias), sigma, baseline)
        np.testing.assert_allclose(result.value, 0.0, atol=1e-12)
        assert (result.sigma[:3] > 0.002).all()

    def test_learned_limits_replace_configured_ones(self) -> None:
        limits = a_baseline().verdict(VerdictConfig())
        assert limits.min_edge_contrast == 6.5
        assert limits.max_sigma_deg == VerdictConfig().max_sigma_deg

    def test_belongs_to_its_rig_and_configuration(self, street: Window) -> None:
        baseline = replace(a_baseline(), pair=street.rig.pair, depth_identity="d", config_hash="c")
        assert mismatch(baseline, street.rig, "d", "c") is None
        assert "another depth network" in (mismatch(baseline, street.rig, "e", "c") or "")
        assert "another configuration" in (mismatch(baseline, street.rig, "d", "x") or "")
        assert "the pair" in (mismatch(replace(baseline, pair="rear"), street.rig, "d", "c") or "")
        assert "min_mood, no_such" in (
            mismatch(replace(baseline, limits={"no_such": 1.0, "min_mood": 2.0}), street.rig, "d", "c") or ""
        )
        other = replace(baseline, sensors={"camera_frame": "other"})
        assert "the camera other" in (mismatch(other, street.rig, "d", "c") or "")


class TestUncommissioned:
    @staticmethod
    def camera(focal_px: float) -> Camera:
        return build("pinhole", width=640, height=480, fx=focal_px, fy=focal_px, cx=320.0, cy=240.0)

    def test_no_check_claims_much_less_than_a_pixel(self) -> None:
        coarse, fine = (uncommissioned(self.camera(focal_px)) for focal_px in (80.0, 700.0))
        for accuracy in coarse:
            assert accuracy.sigma(1000)[:3].min() > PIXEL_SHARE / 80.0
        assert coarse[1].sigma(6)[3:].min() > 1.2 * fine[1].sigma(6)[3:].min()
        assert np.isnan(coarse[0].sigma(6)[3:]).all()
