"""Outlines of near things, and where two extrinsics put them differently."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.types import Matrix4, Window
from coec.config import LimitsConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import build
from coec.geometry.projection import project
from coec.io.images import GreyImages
from coec.reports.close_ups import DifferenceRegions, difference_regions, outlines_of, shift_px
from support import scenes

SIZE_PX = (90, 60)


def _turned(T: Matrix4, axis: tuple[float, float, float], angle_deg: float) -> Matrix4:
    unit = np.array(axis) / np.linalg.norm(axis)
    return se3.perturb(T, np.concatenate([radians(angle_deg) * unit, np.zeros(3)]))


def _places(window: Window, T_one: Matrix4, T_other: Matrix4) -> DifferenceRegions:
    return difference_regions(window, GreyImages(LimitsConfig()), T_one, T_other, SIZE_PX, 3, compensated=True)


def _column_of(azimuth_deg: float) -> float:
    """Of a post, in the true picture."""
    angle = radians(azimuth_deg)
    uv_px, _ = project(scenes.POST_CAMERA, np.array([[-np.sin(angle), 0.0, np.cos(angle)]]))
    return float(uv_px[0, 0])


def test_a_post_has_an_outline_on_each_side() -> None:
    window = scenes.post_window((8.0,))
    outlines = outlines_of(window.pairs[0], window.rig, compensated=True)
    azimuth_deg = np.degrees(np.arctan2(outlines.xyz_m[:, 1], outlines.xyz_m[:, 0]))
    sides = [
        {round(float(azimuth_deg[edge]), 1) for edge in outlines.pieces[outlines.outline == which].ravel()}
        for which in np.unique(outlines.outline)
    ]
    assert len(sides) == 2
    assert all(max(side) - min(side) < 0.2 for side in sides)
    assert sorted(np.mean(list(side)) for side in sides) == pytest.approx([6.8, 9.2], abs=0.15)


def test_the_place_is_where_the_two_differ() -> None:
    """A step ahead moves what is aside, and not what is ahead."""
    window = scenes.post_window((0.0, 25.0))
    moved = se3.perturb(window.T_camera_lidar_start, np.array([0.0, 0.0, 0.0, 0.0, 0.0, -0.3]))
    part = _places(window, moved, window.T_camera_lidar_start).regions[0].part
    assert part.left <= _column_of(25.0) < part.left + part.width
    assert not part.left <= _column_of(0.0) < part.left + part.width


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_image_reports_which_is_right(sign: float) -> None:
    window = scenes.post_window((-10.0, 0.0, 12.0))
    truth = window.T_camera_lidar_start
    wrong = _turned(truth, (0.0, 1.0, 0.0), 0.5 * sign)
    seen, turned = _places(window, wrong, truth), _places(window, truth, wrong)
    assert all(place.strength[1] > place.strength[0] + 1.0 for place in seen.regions)
    assert seen.strength[1] > seen.strength[0] + 1.0
    assert turned.strength == pytest.approx(seen.strength[::-1])


def test_places_lie_in_the_image_and_separate() -> None:
    window = scenes.post_window((-36.0, -20.0, -18.0, 0.0, 3.0, 37.0))
    result = _places(
        window, _turned(window.T_camera_lidar_start, (0.0, 1.0, 0.0), 0.3), window.T_camera_lidar_start
    ).regions
    assert len(result) == 3
    for place in result:
        part = place.part
        assert part.left >= 0
        assert part.top >= 0
        assert part.left + part.width <= scenes.POST_CAMERA.width
        assert part.top + part.height <= scenes.POST_CAMERA.height
        separation = [
            max(abs(part.left - other.part.left) / 90, abs(part.top - other.part.top) / 60) for other in result
        ]
        assert (
            sorted(separation)[1] > 0.4
        )  # their outlines are others; the rectangles are moved to the middle of theirs


def test_masked_outlines_are_no_place() -> None:
    mask = np.ones((360, 640), np.bool_)
    mask[:, 320:] = False  # the post on the right
    window = scenes.post_window((-18.0, 18.0), mask=mask)
    result = _places(
        window, _turned(window.T_camera_lidar_start, (0.0, 1.0, 0.0), 0.3), window.T_camera_lidar_start
    ).regions
    assert result
    assert all(place.part.left < 320 for place in result)


def test_without_a_range_edge_there_is_no_place() -> None:
    window = scenes.post_window(())
    result = _places(window, _turned(window.T_camera_lidar_start, (0.0, 1.0, 0.0), 0.3), window.T_camera_lidar_start)
    assert result.regions == ()
    assert np.isnan(result.strength).all()
    assert shift_px(window, window.T_camera_lidar_start, window.T_camera_lidar_start, compensated=True) is None


def test_the_shift_of_a_turn_is_its_angle_in_pixels() -> None:
    window = scenes.post_window((0.0,))
    one = window.T_camera_lidar_start
    reported = shift_px(window, one, _turned(one, (0.0, 1.0, 0.0), 1.0), compensated=True)
    assert reported is not None
    assert reported.median_px == pytest.approx(400.0 * np.tan(radians(1.0)), rel=0.02)
    assert reported.largest_px < 1.1 * reported.median_px


def test_an_image_of_another_size_is_refused() -> None:
    window = scenes.post_window((0.0,))
    camera = build("pinhole", width=600, height=360, fx=400.0, fy=400.0, cx=299.5, cy=179.5)
    other = replace(window, rig=replace(window.rig, camera=camera))
    with pytest.raises(CalibrationError, match="640 x 360 px, the camera model 600 x 360 px"):
        _places(other, other.T_camera_lidar_start, other.T_camera_lidar_start)
