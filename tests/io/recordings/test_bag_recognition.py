"""Bags whose messages mean something else than their fields say: recognised, reported, and overridden by the query."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.errors import SourceError, UsageError
from coec.geometry import se3
from coec.geometry.sweep_kernels import deskew
from coec.io.recordings.bag import BagRecording
from coec.io.recordings.layouts import open_source
from support.recordings import FLOAT32, T_BASE_LIDAR, Bag, drive_messages, odometry_message, ros_header
from support.scenes import turning_sweep

Message = tuple[str, Any]
SECOND, MS = 10**9, 1_000_000
PERIOD_S = 0.1
SPEED_MPS = 8.0
ELSE = [message for message in drive_messages() if message[0] not in ("/points", "/odom")]
T_LIDAR_BASE = se3.inverse(T_BASE_LIDAR)


def odometry(forward_mps: float = SPEED_MPS, frame_id: str = "base", poses: bool = False) -> list[Message]:
    """Two seconds; `poses`: the vehicle moves by its poses, whatever the velocity says."""
    messages = []
    for k in range(100):
        message = odometry_message(SECOND + k * 20 * MS, forward_mps)
        message.child_frame_id = frame_id
        if poses:
            message.pose.pose.position = ros.geometry_msgs__msg__Point(SPEED_MPS * 0.02 * k, 0.0, 0.0)
            message.twist.twist.angular = ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.0)
        messages.append(("/odom", message))
    return messages


def cloud(stamp_ns: int, columns: dict[str, NDArray[Any]], frame_id: str = "lidar") -> Message:
    fields = [ros.sensor_msgs__msg__PointField(name, 4 * i, FLOAT32, 1) for i, name in enumerate(columns)]
    fields[-1] = ros.sensor_msgs__msg__PointField("ring", 4 * (len(columns) - 1), 6, 1)
    rows = np.zeros(len(columns["x"]), [(name, "<u4" if name == "ring" else "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    step, data = rows.itemsize, np.frombuffer(rows.tobytes(), np.uint8)
    header = ros_header(stamp_ns, frame_id)
    message = ros.sensor_msgs__msg__PointCloud2(header, 1, len(rows), fields, False, step, step * len(rows), data, True)
    return "/points", message


def turns(parts: int = 1, timed: bool = True, compensated: bool = False, count: int = 8) -> list[Message]:
    """Sweeps of a turning LiDAR, stamped at their begin, each in so many clouds."""
    messages = []
    for number in range(count):
        sweep = turning_sweep(number)
        xyz_m, ring = sweep.xyz_m, sweep.ring
        assert ring is not None
        share = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) / (2 * np.pi) + 0.5
        if compensated:
            motion = EgoMotion(0, "base", (SPEED_MPS, 0.0, 0.0), (0.0, 0.0, 0.1))
            xyz_m = deskew(xyz_m, share.astype(np.float64) * PERIOD_S, *sensor_twist(motion, T_LIDAR_BASE))
        for part in range(parts):
            selected = np.floor(share * parts).clip(0, parts - 1) == part
            x, y, z = xyz_m[selected].T
            begin_s = PERIOD_S * part / parts
            time = {"time": share[selected] * PERIOD_S - begin_s} if timed else {}
            stamp_ns = SECOND + round((number * PERIOD_S + begin_s) * SECOND)
            messages.append(cloud(stamp_ns, {"x": x, "y": y, "z": z, **time, "ring": ring[selected]}))
    return messages


def of_turn(number: int, shift_m: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    sweep = turning_sweep(number)
    assert sweep.ring is not None
    x, y, z = (sweep.xyz_m + shift_m).T
    return {"x": x, "y": y, "z": z, "ring": sweep.ring}


def opened(folder: Path, messages: list[Message], query: str = "") -> BagRecording:
    recording = open_source(f"{Bag(messages).write(folder / 'bag.mcap')}{query}")
    assert isinstance(recording, BagRecording)
    return recording


def codes(recording: BagRecording) -> list[str]:
    return [one.code for one in recording.recognitions]


def sweeps(recording: BagRecording) -> list[LidarFrame]:
    return [message for message in recording.messages() if isinstance(message, LidarFrame)]


def motions(recording: BagRecording) -> list[EgoMotion]:
    return [message for message in recording.messages() if isinstance(message, EgoMotion)]


def test_a_usual_bag_needs_no_recognition(tmp_path: Path) -> None:
    recording = opened(tmp_path, [*ELSE, *odometry(), *turns()])
    assert codes(recording) == []
    assert recording.sweep_stamps_ns == tuple(SECOND + k * 100 * MS for k in range(8))


@pytest.mark.parametrize("timed", [True, False])
def test_parts_of_a_turn_are_joined(tmp_path: Path, timed: bool) -> None:
    whole = sweeps(opened(tmp_path, [*ELSE, *odometry(), *turns(timed=timed)]))
    recording = opened(tmp_path, [*ELSE, *odometry(), *turns(5, timed)])
    (reported,) = recording.recognitions
    assert (reported.code, reported.level) == ("partial_clouds", "warn")
    assert "5 in a row" in reported.text
    assert recording.sweep_stamps_ns == tuple(SECOND + 40 * MS + k * 100 * MS for k in range(8))
    for one, other in zip(sweeps(recording), whole, strict=True):
        assert len(one.xyz_m) == len(other.xyz_m)
        assert one.time_offset_s is not None
        assert np.ptp(one.time_offset_s) == pytest.approx(0.1 if timed else 0.08, abs=0.002)
        assert one.ring is not None


def test_the_origin_is_checked_once_a_second(tmp_path: Path) -> None:
    def moved(numbers: set[int]) -> list[Message]:
        clouds = turns(count=30)
        return [
            cloud(SECOND + k * 100 * MS, of_turn(k, np.array([0.0, 0.0, 2.0]))) if k in numbers else clouds[k]
            for k in range(30)
        ]

    recording = opened(tmp_path, [*ELSE, *odometry(), *moved({4})])
    assert len(sweeps(recording)) == 30
    recording = opened(tmp_path, [*ELSE, *odometry(), *moved({10})])
    with pytest.raises(SourceError, match="The points contradict their origin"):
        sweeps(recording)


def test_a_person_says_how_many_clouds_make_a_sweep(tmp_path: Path) -> None:
    bag = [*ELSE, *odometry(), *turns(5)]
    assert len(opened(tmp_path, bag, "?clouds_per_sweep=1").sweep_stamps_ns) == 40
    recording = opened(tmp_path, bag, "?clouds_per_sweep=10")
    assert (len(recording.sweep_stamps_ns), codes(recording)) == (4, [])
    with pytest.raises(UsageError, match="it is one of 1 to 48"):
        opened(tmp_path, bag, "?clouds_per_sweep=0")


def test_a_turn_does_not_reach_over_a_gap(tmp_path: Path) -> None:
    clouds = turns(5)
    recording = opened(tmp_path, [*ELSE, *odometry(), *clouds[:13], *clouds[20:]])
    assert len(recording.sweep_stamps_ns) == 6


def test_clouds_of_two_lidars_on_one_topic_are_reported(tmp_path: Path) -> None:
    rear = [(topic, cloud_at(message, 30 * MS)) for topic, message in turns()]
    assert codes(opened(tmp_path, [*ELSE, *odometry(), *turns(), *rear])) == ["several_lidars"]
    other = [(topic, cloud_at(message, 30 * MS, "rear")) for topic, message in turns()]
    with pytest.raises(SourceError, match=r"name 2 frames: 'lidar' .8., 'rear' .8.. Two sensors publish on it"):
        opened(tmp_path, [*ELSE, *odometry(), *turns(), *other])
    second = [(topic, cloud_at(message, 0)) for topic, message in turns(count=9)[1:]]
    for (_, message), (_, first) in zip(second, turns(), strict=True):
        message.header = first.header
    assert codes(opened(tmp_path, [*ELSE, *odometry(), *turns(), *second])) == ["several_lidars"]
    assert codes(opened(tmp_path, [*ELSE, *odometry(), *turns(), *turns()])) == [], "each cloud twice"
    sparse = [(topic, cloud_at(message, k * SECOND)) for k, (topic, message) in enumerate(turns())]
    later = [(topic, cloud_at(message, k * SECOND + 20 * MS)) for k, (topic, message) in enumerate(turns())]
    assert codes(opened(tmp_path, [*ELSE, *odometry(), *sparse])) == []
    assert codes(opened(tmp_path, [*ELSE, *odometry(), *sparse, *later])) == ["several_lidars"]
    # Two halves without times are either.
    assert codes(opened(tmp_path, [*ELSE, *odometry(), *turns(2, timed=False)])) == ["several_lidars"]


def cloud_at(message: Any, later_ns: int, frame_id: str = "lidar") -> Any:
    stamp = message.header.stamp
    message.header = ros_header(stamp.sec * SECOND + stamp.nanosec + later_ns, frame_id)
    return message


def test_compensated_clouds_are_not_compensated_again(tmp_path: Path) -> None:
    bag = [*ELSE, *odometry(), *turns(compensated=True)]
    recording = opened(tmp_path, bag)
    assert codes(recording) == ["already_compensated"]
    for sweep in sweeps(recording):
        assert sweep.time_offset_s is not None
        assert not sweep.time_offset_s.any()
    forced = opened(tmp_path, bag, "?compensated=no")
    assert codes(forced) == []
    times_s = sweeps(forced)[0].time_offset_s
    assert times_s is not None
    assert np.ptp(times_s) == pytest.approx(0.1, abs=0.002)
    reported = opened(tmp_path, [*ELSE, *odometry(), *turns()], "?compensated=end")
    assert sweeps(reported)[0].time_offset_s == pytest.approx(0.1, abs=0.002)


def test_velocities_that_are_not_filled_in_come_from_the_poses(tmp_path: Path) -> None:
    bag = [*ELSE, *odometry(0.0, poses=True), *turns()]
    recording = opened(tmp_path, bag)
    assert codes(recording) == ["twist_from_poses"]
    assert recording.motion_stamps_ns == tuple(m.stamp_ns for m in motions(recording))
    for one in motions(recording):
        assert one.linear_mps == pytest.approx((SPEED_MPS, 0.0, 0.0), abs=1e-6)
    assert {m.speed_mps for m in motions(opened(tmp_path, bag, "?motion=twist"))} == {0.0}


@pytest.mark.parametrize(("stated_mps", "code"), [(-SPEED_MPS, "twist_from_poses"), (3.0, "twist_contradicted")])
def test_velocities_that_poses_contradict(tmp_path: Path, stated_mps: float, code: str) -> None:
    bag = [*ELSE, *odometry(stated_mps, poses=True), *turns()]
    recording = opened(tmp_path, bag)
    assert codes(recording) == [code]
    used_mps = SPEED_MPS if code == "twist_from_poses" else stated_mps
    assert motions(recording)[0].linear_mps == pytest.approx((used_mps, 0.0, 0.0), abs=1e-6)
    by_poses = opened(tmp_path, bag, "?motion=pose")
    assert motions(by_poses)[0].linear_mps == pytest.approx((SPEED_MPS, 0.0, 0.0), abs=1e-6)


def test_poses_that_jump_or_are_invalid_are_no_motion(tmp_path: Path) -> None:
    messages = odometry(0.0, poses=True)
    messages[40][1].pose.pose.position = ros.geometry_msgs__msg__Point(1e8, float("nan"), 0.0)
    messages[60][1].pose.pose.position = ros.geometry_msgs__msg__Point(1e8, 0.0, 0.0)
    messages[80][1].pose.pose.orientation = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 0.0)
    recording = opened(tmp_path, [*ELSE, *messages, *turns()])
    assert codes(recording) == ["twist_from_poses"]
    assert len(recording.motion_stamps_ns) > 80
    for one in motions(recording):
        assert one.linear_mps == pytest.approx((SPEED_MPS, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("frame_id", ["ego", ""])
def test_motion_of_a_frame_that_is_not_in_the_tree_is_left_out(tmp_path: Path, frame_id: str) -> None:
    bag = [*ELSE, *odometry(frame_id=frame_id), *turns()]
    recording = opened(tmp_path, bag)
    (reported,) = recording.recognitions
    assert (reported.code, reported.level, recording.motion_stamps_ns) == ("motion_frame_unconnected", "warn", ())
    assert "?odometry_frame=NAME" in reported.text
    named = opened(tmp_path, bag, "?odometry_frame=base")
    assert len(named.motion_stamps_ns) == 100
    np.testing.assert_allclose(named.rig.T_lidar_ego, T_LIDAR_BASE, atol=1e-9)
    np.testing.assert_array_equal(opened(tmp_path, bag, "?odometry_frame=lidar").rig.T_lidar_ego, np.eye(4))
    with pytest.raises(SourceError, match="does not connect 'wheel'"):
        opened(tmp_path, bag, "?odometry_frame=wheel")


def test_stamps_are_corrected_as_a_person_says(tmp_path: Path) -> None:
    bag = [*ELSE, *odometry(), *turns()]
    before, after = opened(tmp_path, bag), opened(tmp_path, bag, "?camera_offset=-0.03&lidar_offset=37")
    assert after.camera_stamps_ns == tuple(stamp - 30 * MS for stamp in before.camera_stamps_ns)
    assert after.sweep_stamps_ns == tuple(stamp + 37 * SECOND for stamp in before.sweep_stamps_ns)
    assert after.motion_stamps_ns == before.motion_stamps_ns
    read = list(after.messages())
    assert tuple(m.stamp_ns for m in read if isinstance(m, CameraFrame)) == after.camera_stamps_ns
    assert tuple(m.stamp_ns for m in read if isinstance(m, LidarFrame)) == after.sweep_stamps_ns


@pytest.mark.parametrize("value", ["late", "nan", "inf", "1e11", "-1e300"])
def test_offsets_that_are_none_are_refused(tmp_path: Path, value: str) -> None:
    with pytest.raises(UsageError, match="seconds that are added"):
        opened(tmp_path, [*ELSE, *turns()], f"?lidar_offset={value}")


def test_rings_are_scan_lines_if_a_person_says_so(tmp_path: Path) -> None:
    zones = turns(count=1)
    for _, message in zones:
        message.data, message.width = message.data[: 20 * 2000].copy(), 2000
        message.row_step = len(message.data)
        rows = message.data.view([("xyzt", "<f4", 4), ("ring", "<u4")])
        message.data.view(rows.dtype)["ring"] = np.arange(len(rows)) % 6
    bag = [*ELSE, *odometry(), *zones]
    unordered = opened(tmp_path, bag)
    assert (sweeps(unordered)[0].ring, codes(unordered)) == (None, ["no_scan_lines"])
    assert sweeps(opened(tmp_path, bag, "?rings=lines"))[0].ring is not None
    assert sweeps(opened(tmp_path, [*ELSE, *turns()], "?rings=none"))[0].ring is None
    with pytest.raises(UsageError, match="rings=cones: it is one of lines, none"):
        opened(tmp_path, bag, "?rings=cones")
