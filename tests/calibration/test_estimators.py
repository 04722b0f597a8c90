"""What an estimator sees of a window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.solver import WindowData, depth_features, runner_up
from coec.calibration.types import CameraFrame, DepthMap, Metric, Silence, Window
from coec.config import LimitsConfig
from coec.geometry.points import lengths
from coec.io.images import GreyImages

BEAMS, FIRINGS = 16, 1_800
ELEVATION_DEG = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], np.float64)
"""Of a VLP-16, in the order in which its beams fire."""


class Flat:
    """The same depth everywhere."""

    identity = "flat"

    def infer(self, frame: CameraFrame) -> DepthMap:
        del frame
        return DepthMap(np.ones((4, 8), np.float32))


def sixteen_beams(window: Window) -> Window:
    """Every sweep of the window as a VLP-16 gives it: beam by beam, firing by firing, 10 m all around."""
    azimuth = np.repeat(np.linspace(-np.pi, np.pi, FIRINGS, endpoint=False), BEAMS)
    elevation = np.tile(np.radians(ELEVATION_DEG), FIRINGS)
    flat = np.cos(elevation)
    xyz_m = 10.0 * np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    pairs = (
        replace(
            pair,
            lidar=replace(pair.lidar, xyz_m=xyz_m.astype(np.float32), intensity=None, ring=None, time_offset_s=None),
        )
        for pair in window.pairs
    )
    return replace(window, pairs=tuple(pairs))


def test_all_beams_carry_the_depth_cue_in_equal_shares(street: Window) -> None:
    window = sixteen_beams(street)
    window_data = WindowData(window, False, Flat(), GreyImages(LimitsConfig()), Silence())
    at_most = len(window.pairs) * BEAMS * FIRINGS // 2
    frames = depth_features(window_data, window.T_camera_lidar_start, at_most)
    assert sum(len(frame.xyz_m) for frame in frames) == at_most
    for frame in frames:
        sines = frame.xyz_m[:, 2] / lengths(frame.xyz_m)
        beam = np.rint((np.degrees(np.arcsin(sines)) + 15.0) / 2.0).astype(np.int64)
        left = np.bincount(beam, minlength=BEAMS)
        assert np.abs(left - FIRINGS / 2).max() < 4.0 * np.sqrt(FIRINGS / 4)


@pytest.mark.parametrize(
    ("contrast", "rivals", "share"),
    [(8.0, [2.0, 4.0], 0.5), (8.0, [], 0.0), (8.0, [-3.0], 0.0), (2.0, [3.0], 1.5)],
)
def test_the_runner_up_is_a_share_of_the_best(contrast: float, rivals: list[float], share: float) -> None:
    assert runner_up(contrast, rivals) == pytest.approx(share)


@pytest.mark.parametrize("contrast", [0.0, -1.0])
@pytest.mark.parametrize("rivals", [[], [-2.0], [3.0]])
def test_a_pose_that_does_not_stand_out_has_no_runner_up_that_passes(contrast: float, rivals: list[float]) -> None:
    assert not Metric("runner_up", runner_up(contrast, rivals), 0.85, at_least=False).passed
