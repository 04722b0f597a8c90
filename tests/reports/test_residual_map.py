"""What is left at an extrinsic, and of a lens that was fitted: figures in words, and that there is a picture."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig
from coec.geometry import se3
from coec.geometry.cameras.double_sphere_fit import fit_double_sphere
from coec.io.images import GreyImages
from coec.reports.close_ups import angles_deg
from coec.reports.pictures import lens_residual, lens_sentences, local_shifts, residual_map, residuals_px, sentences
from support import scenes


def test_the_text_report_what_all_parts_have_in_common() -> None:
    window = scenes.post_window(tuple(np.arange(-36.0, 37.0, 4.0).tolist()))
    window = replace(window, pairs=window.pairs * 4)
    moved = se3.perturb(window.T_camera_lidar_start, np.array([0, radians(0.5), 0, 0, 0, 0]))
    shifts = local_shifts(window, GreyImages(LimitsConfig()), moved, compensated=True)
    lines = sentences(window, shifts, "start")
    when = "2020-09-13 12:26:40.123Z"
    assert lines[0] == f"front, {when} to {when}: range edges on edges of the image at start"
    assert "from 4 pairs" in lines[1]
    assert "a pixel is 0.143° on the axis" in lines[1]
    right_deg, right_px = (
        float(lines[2].split(before)[1].split(after)[0].replace("−", "-"))
        for before, after in (("to all: ", "° right"), ("right (", " px)"))
    )
    assert right_px == pytest.approx(-400.0 * np.tan(radians(0.5)), abs=1.0)
    assert right_deg == pytest.approx(-0.5, abs=0.15)


def test_what_all_parts_have_in_common_is_compared_with_sigma() -> None:
    window = scenes.post_window(tuple(np.arange(-36.0, 37.0, 4.0).tolist()))
    window = replace(window, pairs=window.pairs * 4)
    moved = se3.perturb(window.T_camera_lidar_start, np.array([0, radians(0.5), 0, 0, 0, 0]))
    shifts = local_shifts(window, GreyImages(LimitsConfig()), moved, compensated=True)
    line = sentences(window, shifts, "result", np.radians([0.2, 0.1, 0.1, np.nan, np.nan, np.nan]))[2]
    assert float(line.split(" σ of yaw")[0].split(", ")[-1]) == pytest.approx(5.0, abs=1.5)
    assert "σ of pitch" in line


def test_a_shift_is_an_angle_at_its_place_in_the_image() -> None:
    """A pixel at the rim of a pinhole's image covers a smaller angle than one in its middle."""
    pinhole = scenes.POST_LENSES["pinhole"]
    from_px = np.array([[pinhole.cx, pinhole.cy], [pinhole.cx + pinhole.fx, pinhole.cy], [np.nan, 0.0]])
    middle, rim, unknown = angles_deg(pinhole, from_px, from_px + np.array([1.0, 0.0]))
    assert middle == pytest.approx(np.degrees(1.0 / pinhole.fx), rel=1e-3)
    assert rim == pytest.approx(0.5 * middle, rel=5e-3)
    assert np.isnan(unknown)


def test_a_picture_without_a_range_edge_reports_that_nothing_is_reported() -> None:
    window = scenes.post_window((0.0,))
    (pair,) = window.pairs
    empty = LidarFrame(0, "lidar", np.zeros((0, 3), np.float32))
    window = replace(window, pairs=(replace(pair, lidar=empty),))
    shifts = local_shifts(window, GreyImages(LimitsConfig()), window.T_camera_lidar_start, compensated=True)
    assert "No part of the image tells" in sentences(window, shifts, "")[1]
    picture = residual_map(window, window.T_camera_lidar_start)
    assert picture.dtype == np.uint8
    assert (picture[:4] == 255).all()  # light ground


def test_an_exact_fit_leaves_nothing_and_another_what_the_fit_says() -> None:
    exact = scenes.POST_LENSES["double_sphere"]
    assert "0 px" in lens_sentences(exact, exact, np.zeros(4))[0]
    fisheye = scenes.POST_LENSES["kannala_brandt"]
    fit = fit_double_sphere(fisheye)
    cells = (np.arange(64) + 0.5) / 64  # as the fit compares them
    u, v = np.meshgrid(640 * cells - 0.5, 360 * cells - 0.5)
    separation = residuals_px(fisheye, fit.camera, np.column_stack([u.ravel(), v.ravel()]))
    size = np.linalg.norm(separation, axis=1)
    assert np.sqrt((size**2).mean()) == pytest.approx(fit.residual_rms_px, rel=1e-6)
    assert 0.5 * fit.residual_max_px < size.max() <= fit.residual_max_px
    reported = f"{fit.residual_rms_px:.3g} px rms, {fit.residual_max_px:.3g} px at most"
    assert reported in lens_sentences(fisheye, fit.camera, size)[0]
    picture = lens_residual(fisheye, fit.camera)
    assert picture.shape[2] == 3
    assert (picture[:4] == 255).all()


def test_where_one_has_no_pixel_nothing_is_reported() -> None:
    wide, narrow = scenes.POST_LENSES["double_sphere"], scenes.POST_LENSES["mei"]
    corner = np.array([[-5000.0, -5000.0], [320.0, 180.0]])
    separation = residuals_px(narrow, wide, corner)
    assert np.isnan(separation[0]).all()
    assert np.isfinite(separation[1]).all()
