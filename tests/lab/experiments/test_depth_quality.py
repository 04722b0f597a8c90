"""What is told of a depth network, on maps whose worth is known."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import DepthMap, Rig
from coec.config import ObjectiveConfig
from coec.geometry.cameras import build
from coec_lab.experiments.depth_quality import (
    GOOD_RANK,
    USABLE_BIAS_RAD,
    DepthQuality,
    Pairing,
    Suitability,
    half_width,
    joint_histogram,
    pair_up,
    ranks,
    spearman,
    suitability,
)
from coec_lab.experiments.objective_scans import Scan

RIG = Rig(
    pair="front",
    camera=build("pinhole", width=40, height=20, fx=20.0, fy=20.0, cx=19.5, cy=9.5),
    camera_frame="camera",
    lidar_frame="lidar",
    T_camera_lidar_nominal=np.eye(4),
    T_lidar_ego=np.eye(4),
)
"""Camera and LiDAR in one place with equal axes: a point's range is its distance from the camera."""


def _slow_ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """By the definition: how many are below, and half of the others that are equal."""
    return np.array([(values < v).sum() + ((values == v).sum() - 1) / 2.0 for v in values])


def test_ranks_share_the_mean_of_equal_values() -> None:
    assert ranks(np.array([30.0, 10.0, 20.0, 10.0])).tolist() == [3.0, 0.5, 2.0, 0.5]
    values = np.random.default_rng(0).integers(0, 9, 60).astype(np.float64)
    np.testing.assert_array_equal(ranks(values), _slow_ranks(values))


def test_spearman_sees_order_alone() -> None:
    a = np.random.default_rng(1).normal(size=50)
    assert spearman(a, np.exp(a)) == pytest.approx(1.0)
    assert spearman(a, -(a**3)) == pytest.approx(-1.0)
    # 1 - 6 Σd² / n(n² - 1), by hand: d = (0, 1, -1, 0).
    assert spearman(np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, 3.0, 2.0, 4.0])) == pytest.approx(0.8)


@pytest.mark.parametrize("values", [[], [1.0], [2.0, 2.0, 2.0]])
def test_nothing_to_order_has_no_correlation(values: list[float]) -> None:
    assert np.isnan(spearman(np.array(values), np.arange(len(values), dtype=np.float64)))


def test_points_meet_the_cell_they_fall_on() -> None:
    depth = DepthMap(np.arange(8, dtype=np.float32).reshape(2, 4))  # cells of 10 by 10 pixels
    at_px = np.array([[0.0, 0.0], [9.4, 9.4], [9.6, 9.6], [39.4, 19.4], [41.0, 5.0]])
    xyz_m = np.column_stack([(at_px - [19.5, 9.5]) / 20.0, np.ones(5)]) * 10.0
    pairing = pair_up(xyz_m.astype(np.float32), depth, RIG, np.eye(4), ObjectiveConfig())
    assert pairing.value.tolist() == [0.0, 0.0, 5.0, 7.0]
    np.testing.assert_allclose(pairing.uv_px, at_px[:4], atol=1e-4)
    np.testing.assert_allclose(pairing.range_m, np.linalg.norm(xyz_m[:4], axis=1), rtol=1e-6)
    assert pairing.covered == 1.0


def test_masked_pixels_are_not_in_view_and_cells_without_value_not_covered() -> None:
    mask = np.ones((20, 40), np.bool_)
    mask[:, :10] = False
    values = np.ones((2, 4), np.float32)
    values[:, 3] = np.nan
    across = (np.arange(0.0, 40.0, 1.0) - 19.5) / 20.0
    xyz_m = np.column_stack([across, np.zeros(40), np.ones(40)]).astype(np.float32) * 5.0
    pairing = pair_up(xyz_m, DepthMap(values), replace(RIG, mask=mask), np.eye(4), ObjectiveConfig())
    assert len(pairing.value) == 20
    assert pairing.covered == pytest.approx(20 / 30)


def test_nothing_in_view() -> None:
    behind = np.array([[0.0, 0.0, -9.0]], np.float32)
    pairing = pair_up(behind, DepthMap(np.ones((2, 4), np.float32)), RIG, np.eye(4), ObjectiveConfig())
    assert (len(pairing.value), pairing.covered) == (0, 0.0)
    assert np.isnan(pairing.rank_correlation)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_residuals_say_what_the_network_takes_for_nearer(sign: float) -> None:
    range_m = np.linspace(5.0, 50.0, 11)
    value = sign / range_m
    value[10] = sign / 4.0  # the furthest point looks like the nearest
    residuals = Pairing(np.zeros((11, 2)), range_m, value, 1.0).residuals()
    assert residuals[10] == pytest.approx(1.0)
    np.testing.assert_allclose(residuals[:10], -0.1)


def test_a_perfect_network_fills_the_diagonal() -> None:
    range_m = np.linspace(5.0, 50.0, 400)
    for value in (1.0 / range_m, range_m):
        counts = joint_histogram([Pairing(np.zeros((400, 2)), range_m, value, 1.0)] * 2, 8)
        np.testing.assert_array_equal(counts, np.diag([100] * 8))


def test_half_width_is_taken_half_way_to_the_floor() -> None:
    offsets = np.linspace(-10.0, 10.0, 2001)
    scan = Scan(0, offsets, 1.0 + np.maximum(0.0, 4.0 - np.abs(offsets)) / 4.0)
    assert half_width(scan, 1.0) == pytest.approx(2.0, abs=0.02)
    assert half_width(scan, 0.0) == pytest.approx(10.0)  # never falls so far
    assert np.isnan(half_width(scan, 2.5))


def _quality(rank: float, bias_deg: float) -> DepthQuality:
    range_m = np.random.default_rng(5).uniform(2, 80, 4000)
    noise = np.random.default_rng(6).normal(size=4000)
    # A Gaussian mixture of the rank of the truth and of noise: the weight steers the correlation.
    truth = ranks(1.0 / range_m) / 4000
    noisy = ranks(noise) / 4000
    weights = np.linspace(0.0, 1.0, 201)
    value = min(
        (weight * truth + (1 - weight) * noisy for weight in weights),
        key=lambda mixed: abs(spearman(mixed, truth) - rank),
    )
    nothing = np.full(3, np.nan)
    pairing = Pairing(np.zeros((4000, 2)), range_m, value, 1.0)
    return DepthQuality(
        (pairing,), 1.2, 1.0, np.array([radians(bias_deg), 0, 0]), nothing, nothing, (), np.eye(2, dtype=int)
    )


@pytest.mark.parametrize(
    ("rank", "bias_deg", "expected"),
    [
        (0.95, 0.3, Suitability.GOOD),
        (0.95, 2.0, Suitability.FUSED),
        (GOOD_RANK - 0.05, 0.3, Suitability.FUSED),
        (0.95, np.degrees(USABLE_BIAS_RAD) + 1.0, Suitability.UNSUITED),
        (0.2, 0.3, Suitability.UNSUITED),
    ],
)
def test_suitability(rank: float, bias_deg: float, expected: Suitability) -> None:
    quality = _quality(rank, bias_deg)
    judged, sentence = suitability(quality)
    assert judged is expected
    assert f"{bias_deg:.2f} deg off" in sentence
    assert quality.mi_over_unrelated == pytest.approx(1.2)


def test_a_network_that_gives_depth_is_as_good_as_one_that_gives_its_inverse() -> None:
    inverse = _quality(0.95, 0.3)
    metric = replace(inverse, pairings=tuple(replace(one, value=-one.value) for one in inverse.pairings))
    assert metric.rank_correlation == pytest.approx(-inverse.rank_correlation)
    assert suitability(metric)[0] is Suitability.GOOD


def test_without_any_point_nothing_is_good() -> None:
    empty = Pairing(np.zeros((0, 2)), np.zeros(0), np.zeros(0), 0.0)
    quality = replace(_quality(0.95, 0.3), pairings=(empty,))
    assert suitability(quality)[0] is Suitability.UNSUITED
