"""Where range edges would lie better: the shift that was put in is the one that is told, in its place."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.types import LidarFrame, Matrix4, Window
from coec.config import LimitsConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera, build
from coec.io.images import GreyImages
from coec.reports.pictures import LocalShifts, local_shifts
from support import scenes

POSTS_DEG = tuple(np.arange(-36.0, 37.0, 4.0).tolist())
"""Range edges in every part of the image."""


def _shifts(window: Window, T_camera_lidar: Matrix4) -> LocalShifts:
    return local_shifts(window, GreyImages(LimitsConfig()), T_camera_lidar, compensated=True)


def _several(window: Window, pairs: int = 4) -> Window:
    return replace(window, pairs=window.pairs * pairs)


def test_at_the_truth_range_edges_lie_where_they_belong() -> None:
    window = _several(scenes.post_window(POSTS_DEG))
    shifts = _shifts(window, window.T_camera_lidar_start)
    assert shifts.known.sum() >= 4
    assert np.abs(shifts.shift_px[shifts.known][:, 0]).max() < 0.8
    assert shifts.frames == 4
    # Each pair of a post's 45 lines has a range edge on either side.
    assert shifts.edges.sum() == pytest.approx(4 * 2 * 45 * len(POSTS_DEG), rel=0.05)


@pytest.mark.parametrize("yaw_deg", [-0.5, 0.4])
def test_a_turn_shifts_all_parts_alike(yaw_deg: float) -> None:
    window = _several(scenes.post_window(POSTS_DEG))
    moved = se3.perturb(window.T_camera_lidar_start, np.array([0, radians(yaw_deg), 0, 0, 0, 0]))
    shifts = _shifts(window, moved)
    right = shifts.shift_px[shifts.known][:, 0]
    assert shifts.known.sum() >= 4
    # The focal length is 400 px; to the side a turn is more pixels.
    assert np.median(right) == pytest.approx(-400.0 * np.tan(radians(yaw_deg)), abs=1.0)
    assert (np.sign(right) == -np.sign(yaw_deg)).all()


def test_a_wrong_lens_shifts_the_rim_and_not_the_middle() -> None:
    window = _several(scenes.post_window(POSTS_DEG))
    stretched = window.rig.camera._replace(fx=405.0)
    shifts = _shifts(replace(window, rig=replace(window.rig, camera=stretched)), window.T_camera_lidar_start)
    rows, columns = np.nonzero(shifts.known)
    right = shifts.shift_px[rows, columns, 0]
    assert len(set(columns.tolist())) >= 4
    # An eightieth of the way from the middle: 4 px at the rim.
    assert np.corrcoef(columns, right)[0, 1] < -0.9


def test_beyond_what_is_tried_nothing_is_reported() -> None:
    window = _several(scenes.post_window((-20.0, 20.0)))
    moved = se3.perturb(window.T_camera_lidar_start, np.array([0, radians(3.0), 0, 0, 0, 0]))
    assert not _shifts(window, moved).known.any()


def test_few_range_edges_are_uninformative_and_none_are_no_error() -> None:
    window = scenes.post_window((0.0,))
    assert not _shifts(window, window.T_camera_lidar_start).known.any()
    (pair,) = window.pairs
    empty = LidarFrame(0, "lidar", np.zeros((0, 3), np.float32))
    shifts = _shifts(replace(window, pairs=(replace(pair, lidar=empty),)), window.T_camera_lidar_start)
    assert shifts.edges.sum() == 0
    assert not shifts.known.any()


def test_an_image_of_another_size_is_refused() -> None:
    window = scenes.post_window((0.0,))
    camera: Camera = build("pinhole", width=640, height=300, fx=400.0, fy=400.0, cx=319.5, cy=149.5)
    with pytest.raises(CalibrationError, match="640 x 360 px, the camera model 640 x 300 px"):
        _shifts(replace(window, rig=replace(window.rig, camera=camera)), window.T_camera_lidar_start)
