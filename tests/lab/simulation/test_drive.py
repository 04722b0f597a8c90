"""The drive as a recording: bytes, order, truth, faults."""

import multiprocessing
from collections.abc import Iterable
from functools import lru_cache
from itertools import islice

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("embreex", reason="needs embreex")

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import CameraFrame, EgoMotion, Frame, FramePair, LidarFrame
from coec.config import LimitsConfig
from coec.errors import UsageError
from coec.geometry import cameras
from coec.geometry.cameras import in_image
from coec.geometry.projection import project
from coec.geometry.se3 import difference, exp
from coec.io.images import decode_depth
from coec_lab.simulation import parallel
from coec_lab.simulation.drive import DriveConfig, SimulatedDrive
from coec_lab.simulation.faults import parse_fault
from coec_lab.simulation.journey import START_NS
from coec_lab.simulation.parallel import messages_by
from coec_lab.simulation.simulated_sensors import NEAREST_M
from lab.conftest import Streets

pytestmark = pytest.mark.usefixtures("streets")


def small(*faults: str, seconds: float = 1.0, depth: bool = False, **more: object) -> SimulatedDrive:
    config = {"seed": 4, "camera": "fisheye128", "lidar": "16", "camera_hz": 5.0, "lidar_hz": 5.0} | more
    selected = tuple(parse_fault(text) for text in faults)
    return SimulatedDrive(DriveConfig(seconds=seconds, faults=selected, depth=depth, **config))  # type: ignore[arg-type]


@lru_cache(maxsize=1)
def plain() -> tuple[Frame, ...]:
    """The drive without any fault."""
    return tuple(small().messages())


def fingerprint(messages: Iterable[Frame]) -> list[object]:
    def of(message: Frame) -> object:
        match message:
            case CameraFrame():
                return message.stamp_ns, message.sequence, message.image.data, message.depth and message.depth.data
            case LidarFrame():
                arrays = (message.xyz_m, message.intensity, message.ring, message.time_offset_s)
                return message.stamp_ns, message.sequence, *(b"" if a is None else a.tobytes() for a in arrays)
        return message

    return [of(message) for message in messages]


def pictures(messages: Iterable[Frame]) -> list[CameraFrame]:
    return [message for message in messages if isinstance(message, CameraFrame)]


def sweeps(messages: Iterable[Frame]) -> list[LidarFrame]:
    return [message for message in messages if isinstance(message, LidarFrame)]


def pixels(frame: CameraFrame) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(frame.image.data, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(streets: Streets) -> None:
    whole = fingerprint(plain())
    streets.clear()
    again, other = (fingerprint(small(seed=seed).messages([0, 3])) for seed in (4, 5))
    assert len(again) > 4
    assert all(entry in whole for entry in again)
    assert not [entry for entry in other if entry in whole]


def test_another_lens_sees_the_same_drive_as_one_rendered_for_it_alone() -> None:
    first, alone = small(seconds=0.3), small(seconds=0.3, camera="pinhole160x120@60", half_view_deg=50.0)
    through = first.through("pinhole160x120@60", 50.0)
    rendered = [(message, through.part(number, number + 1)[0]) for number, message in enumerate(first.messages())]
    seen = [other if isinstance(one, CameraFrame) else one for one, other in rendered]
    assert fingerprint(seen) == fingerprint(alone.messages())
    assert first.rig.camera.width == 128
    assert through.rig.camera == alone.rig.camera
    np.testing.assert_array_equal(through.rig.mask, alone.rig.mask)


def test_several_processes_give_the_same_bytes_in_the_same_order() -> None:
    faults = ("tunnel:0.4", "open_road:0-0.3", "night:0.6")
    config = small(*faults, camera_hz=3.0, lidar_hz=3.0, ego_hz=200.0).config
    assert fingerprint(messages_by(config, 2)) == fingerprint(SimulatedDrive(config).messages())


def test_nothing_more_is_rendered_when_nobody_waits_for_it() -> None:
    config, left = small(seconds=0.3).config, multiprocessing.get_context("spawn").Event()
    parallel._open(config, left)
    whole = SimulatedDrive(config).messages()
    assert fingerprint(parallel._part(0)) == fingerprint(islice(whole, parallel.PART))
    left.set()
    assert parallel._part(0) == []


def test_selected_frames_are_those_of_the_whole_drive() -> None:
    whole = fingerprint(plain())
    part = list(small().messages([2]))
    assert [frame.sequence for frame in pictures(part)] == [2]
    assert [frame.sequence for frame in sweeps(part)] == [2]
    assert all(entry in whole for entry in fingerprint(part))
    with pytest.raises(UsageError, match="no camera frame 5"):
        list(small().messages([5]))


def test_messages_come_in_the_order_of_their_stamps() -> None:
    drive, messages = small(), plain()
    stamps = [message.stamp_ns for message in messages]
    assert stamps == sorted(stamps)
    assert tuple(frame.stamp_ns for frame in pictures(messages)) == drive.camera_stamps_ns
    assert [len(pictures(messages)), len(sweeps(messages)), len(messages)] == [5, 5, 60]
    assert drive.camera_stamps_ns[0] == START_NS + 10_000_000


def share_consistent(drive: SimulatedDrive, pair: FramePair, *, compensated: bool) -> float:
    """Share of the points in view whose range is that of the depth map at their pixel."""
    xyz = compensate(pair, drive.rig, enabled=compensated).astype(np.float64)
    T = drive.truth(pair.camera.stamp_ns)
    p_camera = xyz @ T[:3, :3].T + T[:3, 3]
    uv, valid = project(drive.camera, p_camera)
    retained = valid & in_image(drive.camera, uv)
    u, v = np.rint(uv[retained]).astype(int).T
    assert pair.camera.depth is not None
    assert drive.rig.mask is not None
    code = decode_depth(pair.camera.depth, LimitsConfig())[v, u].astype(np.float64)
    used = (code > 1) & drive.rig.mask[v, u]
    error = np.linalg.norm(p_camera[retained][used], axis=1) - 65535 * NEAREST_M / code[used]
    assert used.sum() > 1000
    return float((np.abs(error) < 0.1 + 0.02 * np.abs(65535 * NEAREST_M / code[used])).mean())


@pytest.mark.parametrize("camera", ["fisheye500", "pinhole600x300"])
def test_points_project_onto_their_depth_once_motion_is_compensated(camera: str) -> None:
    drive = small(depth=True, camera=camera, seconds=0.3, lidar="32", camera_delay_s=0.03)
    messages = list(drive.messages())
    exposed = pictures(messages)[1]
    motion = min((m for m in messages if isinstance(m, EgoMotion)), key=lambda m: abs(m.stamp_ns - exposed.stamp_ns))
    pair = FramePair(exposed, sweeps(messages)[1], motion)
    good, bad = (share_consistent(drive, pair, compensated=done) for done in (True, False))
    assert good > 0.85
    assert good > bad + 0.04


def test_the_twist_leads_from_one_pose_to_the_next() -> None:
    drive = small()
    step_s = 0.02
    motion = drive._journey.trip
    for time_s in (0.0, 3.3, 17.0):
        linear, angular = motion.twist(time_s)
        before, after = motion.poses(time_s + np.array([-step_s / 2, step_s / 2]))
        moved = before @ exp(step_s * np.concatenate([angular, linear]))
        np.testing.assert_allclose(difference(moved, after), 0.0, atol=2e-4)
        assert 5.0 < linear[0] < 12.0


def test_the_truth_follows_the_faults_and_the_rig_knows_nothing_of_them() -> None:
    drive = small("step:10:rx=3", "drift:20-30:tz=0.1", workshop=(0.0, 2.0, 0.0, 0.0, 0.0, 0.0))
    start, displaced, crept = (drive.truth(START_NS + round(t * 1e9)) for t in (0.0, 15.0, 40.0))
    np.testing.assert_allclose(np.rad2deg(difference(displaced, start)[:3]), [3, 0, 0], atol=1e-9)
    np.testing.assert_allclose(difference(crept, displaced), [0, 0, 0, 0, 0, 0.1], atol=1e-9)
    nominal = difference(drive.rig.T_camera_lidar_nominal, start)
    np.testing.assert_allclose(np.rad2deg(nominal[:3]), [0, 2, 0], atol=1e-9)
    assert np.array_equal(drive.T_camera_lidar_start, drive.rig.T_camera_lidar_nominal)


def test_a_displaced_camera_sees_something_else_from_then_on() -> None:
    displaced = tuple(small("step:0.5:rx=3").messages())
    same = [a.image == b.image for a, b in zip(pictures(plain()), pictures(displaced), strict=True)]
    assert same == [True, True, True, False, False]
    assert all(np.array_equal(a.xyz_m, b.xyz_m) for a, b in zip(sweeps(plain()), sweeps(displaced), strict=True))


def test_dirt_blurs_and_darkness_is_dark() -> None:
    clean = pixels(pictures(plain())[0])
    dirty, dark = (pixels(pictures(small(fault).messages([0]))[0]) for fault in ("dirt:0", "dark:0"))
    assert dark.mean() < 0.6 * clean.mean()
    assert 0.1 < (np.abs(clean.astype(int) - dirty).max(axis=2) > 25).mean() < 0.6


def test_a_frozen_camera_repeats_its_last_picture_with_fresh_stamps() -> None:
    frames = pictures(small("frozen:0.35-0.7").messages())
    assert [frame.image == frames[1].image for frame in frames] == [False, True, True, True, False]
    assert len({frame.stamp_ns for frame in frames}) == 5
    assert frames[1].image == pictures(plain())[1].image


def test_a_frozen_lidar_repeats_its_last_sweep_with_fresh_stamps() -> None:
    frames = sweeps(small("lidar_frozen:0.35-0.7").messages())
    first = frames[1].xyz_m.tobytes()
    assert [frame.xyz_m.tobytes() == first for frame in frames] == [False, True, True, True, False]
    assert len({frame.stamp_ns for frame in frames}) == 5
    assert first == sweeps(plain())[1].xyz_m.tobytes()


def test_an_odometer_that_is_stuck_reports_a_standing_vehicle_that_drives_on() -> None:
    drive = small("zero-ego:0.2-0.6")
    sent = [drive._journey.motion(number, number / 50, 0) for number in range(50)]
    assert [message.reaches(1.0) for message in sent] == [not 10 <= number < 30 for number in range(50)]
    assert {(message.linear_mps, message.angular_radps) for message in sent[10:30]} == {((0.0,) * 3, (0.0,) * 3)}
    assert np.array_equal(drive._journey.pose(0.5), small()._journey.pose(0.5))


def test_in_stop_and_go_traffic_the_vehicle_stands_between_two_drives() -> None:
    trip = small(stop_s=15.0, seconds=90.0)._journey.trip
    speeds = {time_s: float(np.linalg.norm(trip.twist(time_s)[0])) for time_s in (10.0, 24.0, 37.0, 50.0, 75.0, 95.0)}
    assert [speed > 4.0 for speed in speeds.values()] == [True, False, False, True, False, True], speeds
    assert max(speeds[24.0], speeds[37.0], speeds[75.0]) < 1e-6, "it is still on its springs, too"
    times = np.linspace(-0.1, 90.0, 4000)
    steps = np.diff(trip.pace.progress(times))
    assert steps.min() >= 0.0
    assert np.abs(np.diff(steps)).max() < 4.0 * (times[1] - times[0]) ** 2, "it brakes and speeds up gently"


def test_dead_beams_lost_motion_late_stamps_and_loss() -> None:
    dead = sweeps(small("beams:0:share=0.5", seconds=0.1).messages([0]))[0]
    assert dead.ring is not None
    assert 4 <= len(set(dead.ring.tolist())) <= 12
    plan = small("no-ego:0.2-0.6", "offset:0.3:seconds=0.05", "loss:0.8:share=1")
    stamps = [stamp - START_NS for stamp in plan.camera_stamps_ns]
    assert stamps == [10_000_000, 210_000_000, 460_000_000, 660_000_000]
    ego = [m for m in plan.messages([0, 1, 2, 3]) if isinstance(m, EgoMotion)]
    times = [(m.stamp_ns - START_NS) / 1e9 for m in ego]
    assert not [t for t in times if 0.2 <= t < 0.6 or t >= 0.8]
    assert len(times) == 10 + 10
    assert 30 < len(small("loss:0:share=0.5", seconds=20.0).camera_stamps_ns) < 70


def test_the_body_is_masked() -> None:
    mask = small().rig.mask
    assert mask is not None
    assert not mask[0, 0]
    assert not mask[-10, 64]
    assert mask[64, 64]


def test_any_camera_of_the_registry_can_drive_along() -> None:
    camera = cameras.build(
        "kannala_brandt", width=96, height=64, fx=40.0, fy=40.0, cx=47.5, cy=31.5, k1=-0.05, k2=0.01, k3=0.0, k4=0.0
    )
    frame = pictures(small(camera=camera, seconds=0.1).messages())[0]
    assert pixels(frame).shape == (64, 96, 3)
    assert pixels(frame).std() > 10
