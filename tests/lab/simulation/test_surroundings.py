"""Garages, rooms, highways; a standing vehicle; weather; cameras that are told wrongly or take row after row."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("embreex", reason="needs embreex")

from coec.calibration.types import EgoMotion, FramePair
from coec_lab.simulation.drive import SimulatedDrive
from coec_lab.simulation.faults import OffsetDrift, late_s
from coec_lab.simulation.vehicle_motion import P_EGO_LIDAR_M
from lab.simulation.test_drive import pictures, pixels, share_consistent, small, sweeps

pytestmark = pytest.mark.usefixtures("streets")


@pytest.mark.parametrize(
    ("scene", "half_m", "high_m"), [("garage", 8.6, 2.9), ("room", 6.0, 3.3), ("highway", None, None)]
)
def test_camera_and_lidar_see_the_same_place(scene: str, half_m: float | None, high_m: float | None) -> None:
    rates = {"camera_hz": 1.0, "lidar_hz": 1.0}
    drive = small(depth=True, scene=scene, camera="pinhole400x200", seconds=3.0, lidar="32", **rates)
    messages = list(drive.messages([2]))
    exposed, turn = pictures(messages)[0], sweeps(messages)[0]
    motion = min((m for m in messages if isinstance(m, EgoMotion)), key=lambda m: abs(m.stamp_ns - exposed.stamp_ns))
    assert share_consistent(drive, FramePair(exposed, turn, motion), compensated=True) > 0.85
    assert pixels(exposed).mean() > 15
    if half_m is not None and high_m is not None:  # walls and a ceiling
        neighbour = np.abs(turn.xyz_m[np.abs(turn.xyz_m[:, 0]) < 4.0][:, 1])
        assert neighbour.max() < half_m + 1.5
        assert turn.xyz_m[:, 2].max() + P_EGO_LIDAR_M[2] == pytest.approx(high_m, abs=0.35)


def changed(drive: SimulatedDrive) -> float:
    """By how many grey levels the third picture differs from the first, in blocks that average the noise out."""
    frames = pictures(drive.messages([0, 2]))
    first, last = (cv2.resize(pixels(frame), (16, 16), interpolation=cv2.INTER_AREA).astype(float) for frame in frames)
    return float(np.abs(first - last).mean())


def test_a_standing_vehicle_sees_the_same_again_where_nothing_else_moves() -> None:
    still = small(scene="room", speed_mps=0.0, traffic=False, seconds=3.0, camera_hz=1.0)
    peopled = small(scene="room", speed_mps=0.0, seconds=3.0, camera_hz=1.0)
    driven = small(scene="room", speed_mps=2.0, traffic=False, seconds=3.0, camera_hz=1.0)
    assert changed(still) < 1.3
    assert changed(peopled) > changed(still) + 0.2
    assert changed(driven) > 4.0
    reported = [message.speed_mps for message in still.messages([0]) if isinstance(message, EgoMotion)]
    assert all(speed_mps is not None and speed_mps < 0.2 for speed_mps in reported)


def test_a_rolling_shutter_shears_the_picture_of_a_moving_camera_alone() -> None:
    def seen(rolling_shutter_s: float, speed_mps: float) -> NDArray[np.int_]:
        drive = small(
            seed=2, scene="highway", seconds=0.2, traffic=False, camera="pinhole200x100", speed_mps=speed_mps,
            rolling_shutter_s=rolling_shutter_s,
        )  # fmt: skip
        return pixels(pictures(drive.messages([0]))[0]).astype(int)

    moved = np.abs(seen(0.1, 25.0) - seen(0.0, 25.0)).mean(axis=(1, 2))
    assert moved[[0, -1]].mean() > 1.5 * moved[48:52].mean()  # the stamp is that of the middle row
    np.testing.assert_array_equal(seen(0.1, 0.0), seen(0.0, 0.0))


def test_wrong_intrinsics_are_reported_and_not_seen() -> None:
    right, wrong = (small(scene="highway", seconds=0.2, intrinsics_off=off) for off in ((0.0,) * 3, (2.0, 1.0, -1.0)))
    assert pictures(right.messages([0]))[0] == pictures(wrong.messages([0]))[0]
    ours, theirs = right.rig.camera, wrong.rig.camera
    assert (theirs.fx / ours.fx, theirs.fy / ours.fy) == pytest.approx((1.02, 1.02))
    assert (theirs.cx - ours.cx, theirs.cy - ours.cy) == pytest.approx((1.28, -1.28))


def test_a_narrow_lens_sees_less() -> None:
    narrow, wide = (
        small(scene="highway", seconds=0.2, camera=name).camera for name in ("pinhole200x100@40", "pinhole200x100")
    )
    assert np.degrees(2 * np.arctan(100 / narrow.fx)) == pytest.approx(40.0)
    assert wide.fx == 100.0


def test_rain_and_a_low_sun_change_the_picture() -> None:
    weather = ("rain:1-2:mmph=40", "low_sun:2-3")
    drive = small(*weather, seed=7, speed_mps=0.0, traffic=False, camera="fisheye160", camera_hz=1.0, seconds=3.0)
    dry, wet, sunny = (pixels(frame).astype(float) for frame in pictures(drive.messages()))
    assert np.ptp(wet, axis=2).mean() < 0.7 * np.ptp(dry, axis=2).mean()  # grey
    ahead = [picture[66:80, 70:90].mean(axis=(0, 1)) for picture in (dry, sunny)]
    assert ahead[0][2] < ahead[0][0]  # by day the sky before the vehicle is blue,
    assert ahead[1][2] > ahead[1][0]  # with the sun low in it red
    assert ahead[1].mean() > ahead[0].mean()


def test_a_clock_creeps_and_then_stays_late() -> None:
    fault = (OffsetDrift(1.0, 3.0, 0.04),)
    assert [late_s(fault, time_s) for time_s in (0.5, 2.0, 5.0)] == pytest.approx([0.0, 0.02, 0.04])
    stamps = np.array(small("offset_drift:0-1:seconds=0.1").camera_stamps_ns)
    assert np.diff(stamps) == pytest.approx(0.22e9)
