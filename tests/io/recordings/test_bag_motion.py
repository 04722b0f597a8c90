"""How the vehicle moves, in bags of every kind: velocities, else transforms, else turn rates; and when points were
measured."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import EgoMotion, LidarFrame
from coec.errors import SourceError, UsageError
from coec.geometry import se3
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import RecordingSource
from support.recordings import Bag, drive_messages, imu_message, ros_header, timed_cloud_message, transform_message

SECOND = 10**9
TWIST = np.array([0.0, 0.0, 0.3, 5.0, 0.0, 0.0])
"""Turning at 5 m/s, the vehicle's own."""

Message = tuple[str, Any]
VEHICLE = [transform_message("base", name, np.eye(4)) for name in ("base_link", "ego")]
DRIVE = [*drive_messages(), ("/tf_static", ros.tf2_msgs__msg__TFMessage(VEHICLE))]
WITHOUT = [message for message in DRIVE if message[0] != "/odom"]


def poses(parent: str = "odom", child: str = "base_link", topic: str = "/tf") -> list[Message]:
    """20 ms apart, among the joints of a robot."""
    wheel = transform_message("base_link", "wheel", np.eye(4), SECOND)
    joints = (transform_message(parent, child, se3.exp(TWIST * k * 0.02), SECOND + k * 20_000_000) for k in range(20))
    return [(topic, ros.tf2_msgs__msg__TFMessage([wheel, joint])) for joint in joints]


def imus(topic: str = "/imu") -> list[Message]:
    return [(topic, imu_message(SECOND + k * 10_000_000, 0.01 * k)) for k in range(40)]


def twists() -> list[Message]:
    twist = ros.geometry_msgs__msg__Twist(
        ros.geometry_msgs__msg__Vector3(3.0, 0.0, 0.0), ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.2)
    )
    covered = ros.geometry_msgs__msg__TwistWithCovariance(twist, np.zeros(36))
    stamped = ros.geometry_msgs__msg__TwistWithCovarianceStamped
    return [("/twist", stamped(ros_header(SECOND + k * 20_000_000, "base"), covered)) for k in range(20)]


def opened(folder: Path, messages: list[Message], query: str = "") -> RecordingSource:
    return open_source(f"{Bag(messages).write(folder / 'bag.mcap')}{query}")


def motions(recording: RecordingSource, cameras: list[int] | None = None) -> list[EgoMotion]:
    return [message for message in recording.messages(cameras) if isinstance(message, EgoMotion)]


def test_a_velocity_comes_before_transforms_and_these_before_turn_rates(tmp_path: Path) -> None:
    everything = [*DRIVE, *poses(), *imus()]
    assert {m.frame_id for m in motions(opened(tmp_path, everything))} == {"base"}
    assert {m.frame_id for m in motions(opened(tmp_path, [*WITHOUT, *twists(), *poses(), *imus()]))} == {"base"}
    assert {m.frame_id for m in motions(opened(tmp_path, [*WITHOUT, *imus(), *poses()]))} == {"base_link"}
    joints_only = poses("body", "head")
    assert all(m.linear_mps is None for m in motions(opened(tmp_path, [*WITHOUT, *imus(), *joints_only])))
    assert motions(opened(tmp_path, [*WITHOUT, *joints_only])) == []


def test_the_motion_in_transforms(tmp_path: Path) -> None:
    recording = opened(tmp_path, [*WITHOUT, *poses()])
    result = motions(recording)
    assert recording.motion_stamps_ns == tuple(m.stamp_ns for m in result)
    assert [m.stamp_ns for m in result] == [SECOND + 10_000_000 + k * 20_000_000 for k in range(19)]
    for motion in result:
        assert motion.linear_mps == pytest.approx(TWIST[3:], abs=1e-6)
        assert motion.angular_radps == pytest.approx(TWIST[:3], abs=1e-6)
    assert 0 < len(motions(recording, [0])) <= len(result), "a chosen frame gets those near it"


def test_velocities_of_two_frames_on_one_topic_have_to_be_selected_from(tmp_path: Path) -> None:
    drive = list(DRIVE)
    for place, (topic, message) in enumerate(DRIVE):
        if topic == "/odom" and place % 2:
            drive[place] = (topic, replace(message, child_frame_id="ego"))
    with pytest.raises(SourceError, match=r"/odom are of the motion of 2 frames: 'base', 'ego'.*\?odometry_frame=NAME"):
        opened(tmp_path, drive)
    selected = motions(opened(tmp_path, drive, "?odometry_frame=ego"))
    assert {one.frame_id for one in selected} == {"ego"}
    assert 0 < len(selected) < 20


def test_any_topic_of_motion_is_taken_that_is_requested(tmp_path: Path) -> None:
    everything = [*DRIVE, *poses(), *imus(), *imus("/imu2")]
    turning = motions(opened(tmp_path, everything, "?odometry=/imu2"))
    assert [m.angular_radps[2] for m in turning] == pytest.approx([0.01 * k for k in range(40)])
    assert len(motions(opened(tmp_path, everything, "?odometry=/tf"))) == 19
    with pytest.raises(SourceError, match=r"several topics for odometry.*/imu2 \(sensor_msgs/msg/Imu, 40 messages\)"):
        opened(tmp_path, [*WITHOUT, *imus(), *imus("/imu2")])


def test_the_frames_of_the_vehicle_are_named_or_reported(tmp_path: Path) -> None:
    bag = [*WITHOUT, *poses("map", "ego")]
    assert len(motions(opened(tmp_path, bag, "?moving=map,ego"))) == 19
    with pytest.raises(SourceError, match=r"'base_link' moves in 'odom'.*there: base_link,wheel, map,ego"):
        opened(tmp_path, bag, "?odometry=/tf")
    with pytest.raises(UsageError, match="moving=odom,base_link"):
        opened(tmp_path, bag, "?moving=map")


def test_points_are_timed_as_their_values_or_a_person_say(tmp_path: Path) -> None:
    cameras = [m for m in WITHOUT if m[0] != "/points"]

    def sweep_of(name: str, times: list[float], query: str = "") -> LidarFrame:
        cloud = ("/points", timed_cloud_message(SECOND + 4_000_000, name, times))
        return next(m for m in opened(tmp_path, [*cameras, cloud], query).messages() if isinstance(m, LidarFrame))

    assert sweep_of("timestamp", [1.004, 1.104]).timed_by.startswith(
        "timestamp: float64, s on the stamp's clock; 0.0 to"
    )
    with pytest.raises(SourceError, match=r"may be s since the stamp.*\?time=time,s,stamp"):
        sweep_of("time", [0.0, 5.0])
    reported = sweep_of("time", [0.0, 5.0], "?time=time,ms").time_offset_s
    assert reported is not None
    assert reported.tolist() == pytest.approx([0.0, 0.005])
    with pytest.raises(UsageError, match="for example time=timestamp,s,clock"):
        sweep_of("time", [0.0, 5.0], "?time=time,hours")
