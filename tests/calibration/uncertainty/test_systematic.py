"""What sensors are off by, and what a pose makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.objective.mutual_information import PointsInView
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Window
from coec.calibration.uncertainty.systematic import (
    COLUMN_SHARE,
    EDGE_PX,
    HELD,
    LENS_PX,
    STAMP_S,
    TERMS,
    SensorResolution,
    column_rad,
    sensor_resolution,
    systematic_shifts,
)
from support.estimates import ESTIMATE_RIG
from support.scenes import Array

FRAMES = 4
UP_OF_LIDAR = np.array([0.0, -1.0, 0.0])
RESOLUTION = SensorResolution(
    pixel_rad=1e-3,
    lens_px=0.05,
    column_rad=3e-3,
    velocity_mps=np.tile([0.0, 0.0, 10.0], (FRAMES, 1)),
    turn_radps=np.zeros((FRAMES, 3)),
    held_m=0.01,
)


def street(rng: np.random.Generator, farthest_m: float = 40.0) -> PointsInView:
    """Points ahead, as many to the left as to the right, at many ranges."""
    direction = np.column_stack([rng.uniform(-0.8, 0.8, 3000), rng.uniform(-0.3, 0.3, 3000), np.ones(3000)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    range_m = rng.uniform(5.0, farthest_m, 3000)
    return PointsInView(direction * range_m[:, None], np.ones(3000), rng.integers(0, FRAMES, 3000))


def shifts(window_data: PointsInView, dof: int, resolution: SensorResolution = RESOLUTION) -> dict[str, Array]:
    return systematic_shifts(window_data, resolution, tuple(range(dof)), UP_OF_LIDAR)


def test_every_term_answers_on_the_axes_that_were_searched_and_on_no_other(rng: np.random.Generator) -> None:
    assert list(shifts(street(rng), 6)) == list(TERMS)
    result = shifts(street(rng), 3)
    assert list(result) == [*TERMS, *HELD.values()]
    for shift in result.values():
        assert np.isfinite(shift).all()
        np.testing.assert_array_equal(shift[3:], 0.0)


def test_a_principal_point_offset_is_a_turn_of_the_camera(rng: np.random.Generator) -> None:
    off = RESOLUTION.lens_px * RESOLUTION.pixel_rad
    result = shifts(street(rng), 3)
    assert result["lens_across"][1] == pytest.approx(off, rel=0.15)
    assert result["lens_down"][0] == pytest.approx(-off, rel=0.15)
    assert np.abs(result["lens_across"][[0, 2]]).max() < 0.1 * off


def test_a_centre_that_is_held_next_to_is_a_turn_by_its_angle_at_the_range_of_things(rng: np.random.Generator) -> None:
    """Everything 4 m ahead: a centimetre to the side is 2.5 mrad, and forward it is none."""
    window_data = street(rng)
    ahead = replace(window_data, p_camera=4.0 * window_data.p_camera / window_data.p_camera[:, 2:])
    result = shifts(ahead, 3)
    assert abs(result["held_across"][1]) == pytest.approx(RESOLUTION.held_m / 4.0, rel=0.2)
    assert abs(result["held_down"][0]) == pytest.approx(RESOLUTION.held_m / 4.0, rel=0.2)
    assert np.abs(result["held_forward"]).max() < 0.1 * RESOLUTION.held_m / 4.0
    only_forward = systematic_shifts(ahead, RESOLUTION, (0, 1, 2, 3, 4), UP_OF_LIDAR)
    assert [name for name in only_forward if name not in TERMS] == ["held_forward"]


def test_a_stamp_that_is_late_is_a_shift_along_the_way(rng: np.random.Generator) -> None:
    result = shifts(street(rng), 6)["stamps"]
    assert abs(result[5]) == pytest.approx(10.0 * STAMP_S, rel=1e-6)
    np.testing.assert_allclose(result[:5], 0.0, atol=1e-9)
    still = replace(RESOLUTION, velocity_mps=np.zeros((FRAMES, 3)))
    np.testing.assert_allclose(shifts(street(rng), 6, still)["stamps"], 0.0, atol=1e-12)


def test_what_moves_near_edges_alone_is_a_shift_to_the_side(rng: np.random.Generator) -> None:
    """With six degrees of freedom far edges hold the turn, and near ones the place."""
    result = shifts(street(rng), 6)
    for name, size_rad in (
        ("near_edges_across", EDGE_PX * RESOLUTION.pixel_rad),
        ("columns", COLUMN_SHARE * RESOLUTION.column_rad),
    ):
        assert 5.0 * size_rad < abs(result[name][3]) < 40.0 * size_rad
        assert abs(result[name][1]) < size_rad


def test_a_lens_that_misses_its_camera_is_reported_in_proportion(rng: np.random.Generator) -> None:
    window_data = street(rng)
    good, poor = shifts(window_data, 3), shifts(window_data, 3, replace(RESOLUTION, lens_px=10.0))
    np.testing.assert_allclose(poor["lens_across"], 200.0 * good["lens_across"], rtol=1e-9)


def test_what_a_fitted_camera_misses_is_in_the_budget() -> None:
    sweep = LidarFrame(0, "lidar", np.zeros((0, 3), np.float32))
    image = EncodedImage(ImageFormat.MONO8, 4, 3, bytes(12))
    pair = FramePair(CameraFrame(0, "camera", image), sweep)
    window = Window("w", ESTIMATE_RIG, ESTIMATE_RIG.T_camera_lidar_nominal, (pair,))
    missing = replace(window, rig=replace(ESTIMATE_RIG, camera_residual_px=33.7))
    good, poor = (sensor_resolution(one, ESTIMATE_RIG.T_camera_lidar_nominal, 0.01) for one in (window, missing))
    assert good.lens_px == LENS_PX
    assert poor.lens_px == pytest.approx(33.7 / np.sqrt(3.0), rel=1e-3)
    np.testing.assert_array_equal(good.velocity_mps, np.zeros((1, 3)))


def test_nothing_in_view_determines_nothing() -> None:
    nothing = PointsInView(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    assert shifts(nothing, 6) == {}


@pytest.mark.parametrize("with_rings", [True, False])
def test_the_columns_of_a_sweep_are_measured(with_rings: bool, rng: np.random.Generator) -> None:
    azimuth, beam = (grid.ravel() for grid in np.meshgrid(np.radians(np.arange(0.0, 360.0, 0.4)), np.arange(16)))
    elevation = np.radians(2.0 * beam - 15.0)
    range_m = rng.uniform(5.0, 30.0, len(azimuth))
    xyz_m = range_m[:, None] * np.column_stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    order = rng.permutation(len(xyz_m))
    ring = beam[order].astype(np.uint16) if with_rings else None
    sweep = LidarFrame(0, "lidar", xyz_m[order].astype(np.float32), ring=ring)
    assert column_rad(sweep) == pytest.approx(np.radians(0.4), rel=1e-3)


def test_a_ring_of_one_number_is_none() -> None:
    """Two beams whose firings lie in between each other's: taken for one line they would be twice as fine."""
    azimuth = np.concatenate([np.arange(0.0, 1.0, 4e-3), np.arange(2e-3, 1.0, 4e-3)])
    elevation = np.repeat([0.0, 0.1], len(azimuth) // 2)
    xyz_m = 10.0 * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    unnumbered = LidarFrame(0, "lidar", xyz_m.astype(np.float32))
    constant = replace(unnumbered, ring=np.full(len(xyz_m), 3, np.uint16))
    assert column_rad(constant) == column_rad(unnumbered) == pytest.approx(4e-3, rel=1e-3)
