"""Poor stretches of a drive: what camera and LiDAR see of them, and that they change nothing elsewhere."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("embreex", reason="needs embreex")

from coec.calibration.types import EgoMotion, FramePair, LidarFrame
from coec_lab.simulation.faults import parse_fault
from coec_lab.simulation.passages import CLEAR_M, HIGH_M, VERGE_M, Passages, RoadSpan, passages
from coec_lab.simulation.scene import Town
from coec_lab.simulation.street import sample_style
from coec_lab.simulation.vehicle_motion import P_EGO_LIDAR_M, Pace
from lab.simulation.test_drive import fingerprint, pictures, pixels, share_consistent, small, sweeps

pytestmark = pytest.mark.usefixtures("streets")


@cache
def at_20_s(*faults: str) -> tuple[NDArray[np.int64], LidarFrame]:
    """Picture and sweep at the 20th second of a drive."""
    drive = small(*faults, seconds=40.0, lidar="32", camera_hz=1.0, lidar_hz=1.0)
    messages = list(drive.messages([20]))
    return pixels(pictures(messages)[0]).astype(int), sweeps(messages)[0]


def test_a_span_lies_where_the_vehicle_then_is() -> None:
    pace = Pace(100.0, 0.5, 8.5)
    result = passages((parse_fault("tunnel:5-9"), parse_fault("open_road:20")), pace, 30.0)
    ((tunnel,), (bare,)) = result.tunnels, result.open
    at_5, at_9, at_20, at_30 = pace.progress(np.array([5.0, 9.0, 20.0, 30.0]))
    assert (tunnel.begin_m, tunnel.end_m) == (at_5, at_9)
    assert bare.begin_m == at_20
    assert bare.end_m > at_30
    assert result.cleared() == (bare.widened(CLEAR_M),)
    assert tunnel.part(at_5 - 10, at_5 + 1) == RoadSpan(at_5, at_5 + 1)
    assert tunnel.part(at_9, at_9 + 1) is None


def test_a_tunnel_is_near_dim_and_bare() -> None:
    street, _ = at_20_s("dirt:0-1")
    picture, sweep = at_20_s("tunnel:10-30")
    style = sample_style(4)
    neighbour = np.abs(sweep.xyz_m[np.abs(sweep.xyz_m[:, 0]) < 8.0][:, 1])
    assert neighbour.max() < 2 * style.lane_m + VERGE_M
    above = sweep.xyz_m[:, 2][np.linalg.norm(sweep.xyz_m, axis=1) < 20.0]
    assert HIGH_M - P_EGO_LIDAR_M[2] - 0.4 < above.max() < HIGH_M - P_EGO_LIDAR_M[2] + 0.4
    assert picture.mean() < 0.7 * street.mean()


@pytest.mark.parametrize("fault", ["tunnel:0-20", "open_road:0-20", "night:0-20"])
def test_camera_and_lidar_see_the_same_place(fault: str) -> None:
    drive = small(fault, depth=True, camera="pinhole600x300", seconds=6.0, lidar="32", camera_hz=1.0, lidar_hz=1.0)
    messages = list(drive.messages([4]))
    exposed, turn = pictures(messages)[0], sweeps(messages)[0]
    motion = min((m for m in messages if isinstance(m, EgoMotion)), key=lambda m: abs(m.stamp_ns - exposed.stamp_ns))
    assert share_consistent(drive, FramePair(exposed, turn, motion), compensated=True) > 0.9


def test_an_open_road_has_nothing_but_ground() -> None:
    def steep(sweep: LidarFrame) -> float:
        """Share of the points that stand above the road by a person's knee, within 60 m."""
        flat_m = np.hypot(sweep.xyz_m[:, 0], sweep.xyz_m[:, 1])
        near = flat_m < 60.0
        return float((sweep.xyz_m[near, 2] + P_EGO_LIDAR_M[2] > 0.5 + 0.03 * flat_m[near]).mean())

    assert steep(at_20_s("dirt:0-1")[1]) > 0.3
    assert steep(at_20_s("open_road:10-30")[1]) == 0.0


def test_a_night_is_dark_and_noisy_for_the_camera_alone() -> None:
    day, by_day = at_20_s("dirt:0-1")
    night, by_night = at_20_s("night:10-30")
    np.testing.assert_array_equal(by_night.xyz_m, by_day.xyz_m)
    assert night.mean() < 0.5 * day.mean()
    upper, lower = night[20:50, 34:94], night[70:90, 44:84]
    assert lower.mean() > upper.mean(), "the headlights light the road, not the sky"


def test_what_is_far_away_stays_as_it_is() -> None:
    away = small("tunnel:60-70", "open_road:70-80", "night:60-80", seconds=0.3)
    assert fingerprint(away.messages()) == fingerprint(small(seconds=0.3).messages())


def test_a_poor_stretch_has_less_to_cast_rays_at() -> None:
    plain = len(Town(5, 300.0).scene(200.0).colour)
    whole = (RoadSpan(150.0, 300.0),)
    assert len(Town(5, 300.0, Passages(tunnels=whole)).scene(200.0).colour) < plain
    bare = Town(5, 300.0, Passages(open=whole))
    assert len(bare.scene(200.0).colour) < plain / 2
    assert bare.scene(225.0).movers == ()
