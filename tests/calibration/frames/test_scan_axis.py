"""The axis of the scan lines of clouds, whatever the axes of their frame."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.scan_axis import scan_axis, upright_turn, with_turned_clouds
from coec.calibration.types import LidarFrame, Window
from coec.geometry import se3

RINGS, COLUMNS = 16, 360


def sweep(turn: NDArray[np.float64], *, rings: bool) -> LidarFrame:
    """A sweep of a turning LiDAR over a rough scene, with its frame turned."""
    rng = np.random.default_rng(2)
    elevation = np.repeat(np.radians(np.linspace(-20.0, 10.0, RINGS)), COLUMNS)
    azimuth = np.tile(np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False), RINGS)
    range_m = rng.uniform(4.0, 30.0, len(azimuth))
    level = np.cos(elevation)
    xyz_m = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1) * range_m[:, None]
    ring = np.repeat(np.arange(RINGS), COLUMNS).astype(np.uint16) if rings else None
    return LidarFrame(0, "lidar", (xyz_m @ turn.T).astype(np.float32), ring=ring)


@pytest.mark.parametrize("rings", [True, False])
@pytest.mark.parametrize("turned_deg", [(0.0, 0.0, 0.0), (90.0, 0.0, 0.0), (25.0, -40.0, 70.0), (0.0, 80.0, 10.0)])
def test_the_axis_of_a_turning_lidar_is_recovered_in_any_frame(
    turned_deg: tuple[float, float, float], rings: bool
) -> None:
    turn = se3.rotation_exp(np.radians(np.array(turned_deg)))
    axis = scan_axis([sweep(turn, rings=rings)])
    assert axis is not None
    assert abs(float(axis @ turn[:, 2])) > np.cos(np.radians(0.1))
    assert axis[2] >= 0.0


@pytest.mark.parametrize("width", [0.05, 0.4])
def test_clouds_of_a_narrow_view_or_without_an_order_have_no_axis(width: float) -> None:
    ahead = np.random.default_rng(2).normal(size=(20_000, 3)) * width + np.array([1.0, 0.0, 0.0])
    assert scan_axis([LidarFrame(0, "lidar", (10.0 * ahead).astype(np.float32))]) is None
    assert scan_axis([LidarFrame(0, "lidar", ahead[:1].astype(np.float32))]) is None


def test_a_window_keeps_its_frame_if_its_axis_is_z_and_its_truth_if_it_is_turned(street: Window) -> None:
    assert np.array_equal(upright_turn(street), np.eye(4))
    by = se3.transform_from(se3.rotation_exp(np.array([0.9, -0.5, 0.3])), np.zeros(3))
    turned = with_turned_clouds(street, by)
    back = with_turned_clouds(turned, upright_turn(turned))
    for before, after in ((street, turned), (turned, back)):
        seen = [window.pairs[0].lidar.xyz_m @ window.rig.T_camera_lidar_nominal[:3, :3].T for window in (before, after)]
        assert np.allclose(seen[0], seen[1], atol=1e-3)
    up = upright_turn(turned)[:3, :3] @ by[:3, :3] @ np.array([0.0, 0.0, 1.0])
    assert abs(float(up[2])) > np.cos(np.radians(0.5))
