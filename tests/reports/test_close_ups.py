"""Two extrinsics side by side: what is said of them, and that there is a picture for every camera."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.types import LidarFrame, Matrix4, Window
from coec.config import LimitsConfig
from coec.geometry import se3
from coec.geometry.edges.image_edges import Rectangle
from coec.io.images import GreyImages
from coec.reports.close_ups import (
    COLOURS,
    Caption,
    close_ups,
    difference_regions,
    outlines_of,
    sentences,
    shift_px,
    spread_px,
)
from support import scenes

TURN = np.array([0.0, radians(0.5), 0.0, 0.0, 0.0, 0.0])
COVARIANCE = np.diag(np.square([radians(0.02), radians(0.03), radians(0.04), np.nan, np.nan, np.nan]))


def _reported(window: Window, T_before: Matrix4, T_after: Matrix4, caption: Caption) -> list[str]:
    images = GreyImages(LimitsConfig())
    telling = difference_regions(window, images, T_before, T_after, (80, 60), 3, compensated=True)
    shift = shift_px(window, T_before, T_after, compensated=True)
    return sentences(window, telling, shift, T_before, T_after, caption)


def _share_of(picture: np.ndarray, colour: tuple[int, int, int]) -> float:
    return float((np.abs(picture.astype(np.int64) - colour).max(axis=2) < 8).mean())


def test_the_text_report_time_difference_spread_and_network() -> None:
    window = scenes.post_window((-8.0, 8.0))
    truth = window.T_camera_lidar_start
    moved = se3.perturb(truth, TURN)
    lines = _reported(window, moved, truth, Caption("start", "accepted", COVARIANCE, "tiny.onnx"))
    assert lines[0].startswith("front, 2020-09-13 12:26:40.123Z: start and accepted are 0.50° and 0.0 cm apart")
    assert lines[1] == "accepted − start: pitch +0.00 ± 0.02°, yaw −0.50 ± 0.03°, roll +0.00 ± 0.04°"
    assert lines[2] == "depth network: tiny.onnx"
    assert any(line.startswith("σ: standard deviation of accepted") for line in lines)


def test_the_spread_of_a_part_is_that_of_its_range_edges() -> None:
    window = scenes.post_window((-8.0, 8.0))
    truth, camera = window.T_camera_lidar_start, window.rig.camera
    outlines, whole = (
        outlines_of(window.pairs[0], window.rig, compensated=True),
        Rectangle(0, 0, camera.width, camera.height),
    )
    yaw = np.diag([0.0, radians(0.03) ** 2, 0.0, np.nan, np.nan, np.nan])
    # A turn moves what is seen near the axis by the focal length times the angle.
    assert spread_px(outlines, window.rig, truth, yaw, whole) == pytest.approx(camera.fx * radians(0.03), rel=0.05)
    cancelling = np.full((6, 6), np.nan)
    cancelling[:2, :2] = 0.0
    assert spread_px(outlines, window.rig, truth, cancelling, whole) == 0.0
    assert np.isnan(spread_px(outlines, window.rig, truth, yaw, Rectangle(0, 0, 1, 1)))


def test_a_stamp_that_is_no_date_is_reported_in_seconds() -> None:
    window = scenes.post_window((0.0,), stamp_ns=20_000_000_000)
    truth = window.T_camera_lidar_start
    assert _reported(window, se3.perturb(truth, TURN), truth, Caption())[0].startswith("front, 20.000 s:")


def test_equal_extrinsics_are_reported_to_be_equal() -> None:
    window = scenes.post_window((0.0,))
    truth = window.T_camera_lidar_start
    assert "no difference between before and after" in _reported(window, truth, truth, Caption())[0]
    assert close_ups(window, truth, truth).shape[2] == 3


def test_a_cloud_without_points_is_a_picture_with_text() -> None:
    window = scenes.post_window((0.0,))
    (pair,) = window.pairs
    empty = LidarFrame(pair.lidar.stamp_ns, "lidar", np.zeros((0, 3), np.float32))
    window = replace(window, pairs=(replace(pair, lidar=empty),))
    truth = window.T_camera_lidar_start
    moved = se3.perturb(truth, TURN)
    lines = _reported(window, moved, truth, Caption())
    assert "0.50°" in lines[0]
    assert "nothing to enlarge" in lines[-1]
    picture = close_ups(window, moved, truth)
    assert all(_share_of(picture, colour) == 0.0 for colour in COLOURS)


@pytest.mark.parametrize("model", scenes.POST_LENSES)
def test_outlines_are_detected_through_every_camera(model: str) -> None:
    window = scenes.post_window((-14.0, 10.0), scenes.POST_LENSES[model])
    truth = window.T_camera_lidar_start
    before, after = _reported(window, se3.perturb(truth, TURN), truth, Caption())[-1].split("image: ")[1].split(", ")
    before_edges, after_edges = (float(text.split()[1].strip(".").replace("−", "-")) for text in (before, after))
    assert before_edges < 0.7 < 1.5 < after_edges


@pytest.mark.parametrize("model", ["pinhole", "double_sphere"])
def test_each_extrinsic_is_rendered_in_its_colour_on_its_side(model: str) -> None:
    window = scenes.post_window((-14.0, 10.0), scenes.POST_LENSES[model])
    truth = window.T_camera_lidar_start
    picture = close_ups(window, se3.perturb(truth, TURN), truth)
    assert picture.dtype == np.uint8
    assert 900 < picture.shape[1] < 1200
    assert (picture[:4] == 255).all()  # light ground
    left, right = picture[:, : picture.shape[1] // 2], picture[:, picture.shape[1] // 2 :]
    before, after = COLOURS
    assert _share_of(left, before) > 5e-4
    assert _share_of(right, after) > 5e-4
    assert _share_of(left, after) == _share_of(right, before) == 0.0
