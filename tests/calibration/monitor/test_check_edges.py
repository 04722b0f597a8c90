"""A look: what it asks of whom, that sensors prepared once serve every pair of a rig, and what reflectance adds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.conftest import window_of
from coec.calibration.monitor.check import Check, check_at, gather, join, seen_part
from coec.calibration.monitor.check_edges import OUTLINE_RAD, REACH_RAD, outline, prepare_images, prepare_sweep, union
from coec.calibration.monitor.check_verdict import diagnose, observe
from coec.calibration.solver import WindowData, prepare_window_data
from coec.calibration.types import CameraFrame, DepthMap, DepthModel, Silence, Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry import se3
from coec.geometry.edges.image_edges import Rectangle
from coec.io.images import GreyImages
from support.simulated_drives import rendered_source

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


MOTORWAY = "sim:scene=highway&seed=71&seconds=5.4&camera_hz=1.2&lidar_hz=1.2&ego_hz=20&lidar=64&camera=pinhole600x300"
"""Six pairs: lane markings, guard rails and little else."""


@pytest.fixture(scope="module")
def motorway() -> Window:
    return window_of(rendered_source(MOTORWAY))


def with_reflectance(window: Window, changed: Callable[[NDArray[np.float32]], NDArray[np.float32] | None]) -> Window:
    """The window with other values of reflectance in every sweep."""
    pairs = []
    for pair in window.pairs:
        assert pair.lidar.intensity is not None
        pairs.append(replace(pair, lidar=replace(pair.lidar, intensity=changed(pair.lidar.intensity))))
    return replace(window, pairs=tuple(pairs))


def checked(window: Window, depth: DepthModel) -> Check:
    return check_at(gather(window_data(window, depth)), window.T_camera_lidar_start)


def off_deg(seen: Check, window: Window) -> float:
    return float(np.degrees(np.linalg.norm(se3.difference(seen.T_rotation, window.rig.T_camera_lidar_nominal)[:3])))


class TestReflectance:
    def test_is_not_read_where_range_edges_are_clear(self, six: Window, stereo: DepthModel) -> None:
        without = checked(with_reflectance(six, lambda _: None), stereo)
        seen = checked(six, stereo)
        assert seen.by_range is None
        np.testing.assert_array_equal(seen.T_pose, without.T_pose)

    def test_paint_determines_the_pose_on_a_motorway(self, motorway: Window, stereo: DepthModel) -> None:
        without = checked(with_reflectance(motorway, lambda _: None), stereo)
        seen = checked(motorway, stereo)
        assert seen.by_range is not None
        assert seen.contrast > without.contrast
        assert seen.balance[1] > 0.0
        assert off_deg(seen, motorway) < 0.15

    def test_edges_of_both_kinds_find_the_mount_again(self, motorway: Window, stereo: DepthModel) -> None:
        for axis in range(3):
            start = moved(motorway, [*np.eye(3)[axis] * np.radians(1.0), 0.0, 0.0, 0.0])
            seen = checked(start, stereo)
            assert off_deg(seen, motorway) < 0.3
            assert seen.of_rotation.insists

    @pytest.mark.fault("reflectance is absent, constant, noise, or shuffled", "the look is that by range alone")
    def test_useless_values_change_nothing(
        self, motorway: Window, stereo: DepthModel, record_property: Callable[[str, object], None]
    ) -> None:
        rng = np.random.default_rng(3)
        useless: dict[str, Callable[[NDArray[np.float32]], NDArray[np.float32] | None]] = {
            "absent": lambda _: None,
            "constant": lambda values: np.full_like(values, 7.0),
            "unknown": lambda values: np.full_like(values, np.nan),
            "noise": lambda values: rng.uniform(0.0, 255.0, len(values)).astype(np.float32),
            "other beams": lambda values: rng.permutation(values),
        }
        seen = {name: checked(with_reflectance(motorway, changed), stereo) for name, changed in useless.items()}
        for one in seen.values():
            np.testing.assert_array_equal(one.T_pose, seen["absent"].T_pose)
            assert one.contrast == seen["absent"].contrast
        record_property("figure", f"{len(seen)} of {len(seen)} looks equal to the byte")
