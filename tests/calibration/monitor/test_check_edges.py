"""A look: what it asks of whom, and that sensors prepared once serve every pair of a rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.monitor.check import check_at, gather, join, seen_part
from coec.calibration.monitor.check_edges import OUTLINE_RAD, REACH_RAD, outline, prepare_images, prepare_sweep, union
from coec.calibration.monitor.check_verdict import diagnose, observe
from coec.calibration.solver import WindowData, prepare_window_data
from coec.calibration.types import CameraFrame, DepthMap, DepthModel, Silence, Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry import se3
from coec.geometry.edges.image_edges import Rectangle
from coec.io.images import GreyImages

CONFIG = CalibrationConfig()
IMAGES = GreyImages(LimitsConfig())


class Counted:
    """Counts what is inferred."""

    def __init__(self, model: DepthModel) -> None:
        self.identity, self.requested, self._model = model.identity, 0, model

    def infer(self, frame: CameraFrame) -> DepthMap:
        self.requested += 1
        return self._model.infer(frame)


@pytest.fixture(scope="module")
def six(sharp_street: Window) -> Window:
    return replace(sharp_street, pairs=sharp_street.pairs[:6])


def moved(window: Window, xi: list[float]) -> Window:
    return replace(window, T_camera_lidar_start=se3.perturb(window.T_camera_lidar_start, np.array(xi)))


def window_data(window: Window, depth: DepthModel) -> WindowData:
    return prepare_window_data(window, depth, IMAGES, CONFIG, Silence())


class TestDepth:
    def test_is_not_requested_where_the_edges_are_clear_and_at_home(self, six: Window, stereo: DepthModel) -> None:
        depth = Counted(stereo)
        reported = observe(six, depth, IMAGES, CONFIG, None)
        assert (reported.flagged, reported.weak, reported.causes, depth.requested) == (False, False, (), 0)
        assert "mi" not in {metric.name for metric in reported.metrics}

    def test_is_requested_where_they_accuse(self, six: Window, stereo: DepthModel) -> None:
        depth = Counted(stereo)
        reported = observe(moved(six, [0.0, np.radians(1.5), 0, 0, 0, 0]), depth, IMAGES, CONFIG, None)
        assert (reported.flagged, depth.requested) == (True, 6)
        assert {"mi", "f1", "f2", "agreement_deg"} < {metric.name for metric in reported.metrics}
        assert np.isfinite(reported.first_derivative).all()

    def test_changes_no_verdict(self, six: Window, stereo: DepthModel) -> None:
        short, full = observe(six, stereo, IMAGES, CONFIG, None), diagnose(six, stereo, IMAGES, CONFIG, None)
        np.testing.assert_array_equal(short.offset, full.offset)
        assert (short.flagged, short.weak, short.distance2) == (full.flagged, full.weak, full.distance2)


@pytest.mark.parametrize("xi", [[0, 0, 0, 0, 0, 0], [0.02, -0.02, 0.01, 0, 0, 0], [0, 0.052, 0, 0, 0, 0]])
def test_the_optimum_over_rotations_is_detected_from_degrees_away(
    six: Window, stereo: DepthModel, xi: list[float]
) -> None:
    start = moved(six, xi)
    seen = check_at(gather(window_data(start, stereo)), start.T_camera_lidar_start)
    off = se3.difference(seen.T_rotation, six.rig.T_camera_lidar_nominal)
    assert np.degrees(np.abs(off[:3])).max() < 0.3


def test_sensors_that_were_prepared_once_serve_every_pair(six: Window, stereo: DepthModel) -> None:
    """Two pairs of one rig, of one camera and one LiDAR, that differ in the pose they serve."""
    other = moved(six, [0.004, -0.003, 0.0, 0, 0, 0])
    rig = six.rig
    sweeps = [prepare_sweep(pair.lidar) for pair in six.pairs]
    part = union([seen_part(rig, sweeps, w.T_camera_lidar_start, OUTLINE_RAD) for w in (six, other)])
    upright = rig.T_camera_lidar_nominal[:2, 2]
    greys = (IMAGES.grey(pair.camera) for pair in six.pairs)
    images = prepare_images(greys, len(six.pairs), rig.camera, rig.mask, upright, part, part)
    for window in (six, other):
        shared = check_at(join(window_data(window, stereo), sweeps, images, REACH_RAD), window.T_camera_lidar_start)
        alone = check_at(gather(window_data(window, stereo)), window.T_camera_lidar_start)
        # The strip is somewhat larger, and so are the figures that it is counted in.
        assert np.degrees(se3.rotation_angle_rad(shared.T_rotation @ se3.inverse(alone.T_rotation))) < 0.05
        assert shared.edges_at_best == pytest.approx(alone.edges_at_best, rel=0.05)


def test_only_a_strip_of_the_images_is_prepared(six: Window, stereo: DepthModel) -> None:
    camera = six.rig.camera
    evidence = gather(window_data(six, stereo))
    _, height, width = evidence.edges.sharp.frames.maps.shape
    assert height * width < 0.5 * camera.height * camera.width
    assert evidence.edges.of([1, 3]).sharp.frames.maps.shape == (2, height, width)


def test_edges_behind_the_camera_have_no_outline(six: Window) -> None:
    behind = se3.perturb(six.T_camera_lidar_start, np.array([0.0, 0.0, 0.0, 0.0, 0.0, -500.0]))
    sweeps = [prepare_sweep(pair.lidar).edges for pair in six.pairs]
    whole = outline(six.rig.camera, sweeps, six.T_camera_lidar_start, OUTLINE_RAD)
    assert whole is not None
    assert outline(six.rig.camera, sweeps, behind, OUTLINE_RAD) is None


def test_the_least_part_that_holds_others() -> None:
    assert union([Rectangle(4, 9, 10, 5), Rectangle(2, 11, 6, 8)]) == Rectangle(2, 9, 12, 10)
