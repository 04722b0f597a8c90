"""Ego-motion from messages with a velocity: `Odometry`, `TwistStamped`, `TwistWithCovarianceStamped`, and `Imu`, which
has turn rates only."""

from __future__ import annotations

import math
from typing import Final

from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.frames.incoming import MAX_SPEED, Refusal
from coec.adapters.ros.heads import check_header
from coec.adapters.ros.messages import deserialized
from coec.adapters.ros.stamps import frame_id, stamp_ns
from coec.calibration.types import EgoMotion
from coec.errors import DecodeError

MAX_MOTION_BYTES: Final = 4096
"""Largest message. An odometry has 724 bytes and its two frame ids."""

Vector = tuple[float, float, float]


def odometry(payload: bytes) -> EgoMotion:
    """The twist of an `Odometry`, which is expressed in its child frame.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    _check(payload)
    message = deserialized(ros.nav_msgs__msg__Odometry, payload)
    return _twisted(message.header, message.child_frame_id or message.header.frame_id, message.twist.twist)


def twist(payload: bytes) -> EgoMotion:
    """The twist of a `TwistStamped`, expressed in the frame of its header.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    _check(payload)
    message = deserialized(ros.geometry_msgs__msg__TwistStamped, payload)
    return _twisted(message.header, message.header.frame_id, message.twist)


def twist_with_covariance(payload: bytes) -> EgoMotion:
    """The same for a `TwistWithCovarianceStamped`; its covariance is not used.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    _check(payload)
    message = deserialized(ros.geometry_msgs__msg__TwistWithCovarianceStamped, payload)
    return _twisted(message.header, message.header.frame_id, message.twist.twist)


def imu(payload: bytes) -> EgoMotion:
    """The turn rates of an `Imu`, about the axes of its own frame; the linear velocity is not known.

    Raises:
        DecodeError: the reasons of `checked`, not this message, or the IMU says that it does not measure turn rates.
    """
    _check(payload)
    message = deserialized(ros.sensor_msgs__msg__Imu, payload)
    if message.angular_velocity_covariance[0] == -1.0:  # sensor_msgs/Imu: "does not produce" it
        raise DecodeError(Refusal.MOTION_INVALID, "the IMU says that it does not measure turn rates")
    rates = message.angular_velocity
    stamp, frame = stamp_ns(message.header), frame_id(message.header.frame_id)
    return checked(stamp, frame, None, (rates.x, rates.y, rates.z))


def checked(stamp: int, frame: str, linear_mps: Vector | None, angular_radps: Vector) -> EgoMotion:
    """The motion, checked to be possible for a vehicle.

    Raises:
        DecodeError: `motion_invalid`.
    """
    if not all(math.isfinite(v) and abs(v) <= MAX_SPEED for v in (*(linear_mps or ()), *angular_radps)):
        raise DecodeError(Refusal.MOTION_INVALID, "a velocity is not finite or beyond every vehicle")
    return EgoMotion(stamp, frame, linear_mps, angular_radps)


def _twisted(header: ros.std_msgs__msg__Header, frame: str, twist: ros.geometry_msgs__msg__Twist) -> EgoMotion:
    linear, angular = twist.linear, twist.angular
    return checked(stamp_ns(header), frame_id(frame), (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z))


def _check(payload: bytes) -> None:
    if len(payload) > MAX_MOTION_BYTES:
        raise DecodeError(Refusal.MESSAGE_TOO_LARGE, f"a message of motion has at most {MAX_MOTION_BYTES} bytes")
    check_header(payload)
