"""How the velocities of an odometry are meant, by its poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.message_evidence import (
    PoseAndTwist,
    TwistReading,
    motions_of_poses,
    reading_of_twists,
)
from coec.calibration.types import EgoMotion, Matrix4
from coec.geometry import se3

Vector = NDArray[np.float64]
TWIST = np.array([0.0, 0.01, 0.25, 7.0, 0.3, 0.0])
MS = 1_000_000


OF_TURNS = (TwistReading.DEGREES, TwistReading.NO_TURN, TwistReading.OTHER_SIGN)
READINGS = tuple(reading for reading in TwistReading if reading not in OF_TURNS)


def stated(reading: TwistReading, pose: Matrix4, velocity_mps: Vector) -> Vector:
    """The velocity in the message, from the pose and the velocity in the child frame."""
    return {
        TwistReading.AS_STATED: velocity_mps,
        TwistReading.NOT_FILLED_IN: np.zeros(3),
        TwistReading.PARENT_FRAME: pose[:3, :3] @ velocity_mps,
        TwistReading.BACKWARDS: -velocity_mps,
        TwistReading.KM_PER_H: 3.6 * velocity_mps,
        TwistReading.CONTRADICTED: np.array([0.0, 5.0, 5.0]),
    }[reading]


def drive(
    reading: TwistReading = TwistReading.AS_STATED,
    period_ms: int = 20,
    noise_m: float = 0.0,
    moving: float = 1.0,
    wrong: float = 1.0,
) -> list[PoseAndTwist]:
    """Messages of a vehicle in a bend, whose velocities are `wrong` times as large."""
    rng = np.random.default_rng(0)
    pose, messages = se3.exp(np.array([0.0, 0.0, 2.0, 40.0, -7.0, 0.0])), []
    for k in range(200):
        speed = TWIST * moving
        noisy = pose @ se3.exp(np.concatenate([np.zeros(3), rng.normal(0.0, noise_m, 3)]))
        x, y, z = (wrong * stated(reading, pose, speed[3:])).tolist()
        messages.append(PoseAndTwist(noisy, EgoMotion(k * period_ms * MS, "base", (x, y, z), (0.0, 0.0, 0.25))))
        pose = pose @ se3.exp(speed * period_ms * 1e-3)
    return messages


@pytest.mark.parametrize("noise_m", [0.0, 0.01])
@pytest.mark.parametrize("period_ms", [5, 20, 100])
@pytest.mark.parametrize("reading", READINGS)
def test_what_was_written_is_recognised(reading: TwistReading, period_ms: int, noise_m: float) -> None:
    assert reading_of_twists(drive(reading, period_ms, noise_m)) is reading


@pytest.mark.parametrize(
    ("factor", "reading"),
    [
        (57.3, TwistReading.DEGREES),
        (0.0, TwistReading.NO_TURN),
        (1.1, TwistReading.AS_STATED),
        (0.5, TwistReading.AS_STATED),
        (-1.0, TwistReading.OTHER_SIGN),
    ],
)
def test_turn_rates_are_recognised_where_velocities_are_right(factor: float, reading: TwistReading) -> None:
    turned = [
        PoseAndTwist(one.T_parent_child, replace(one.motion, angular_radps=(0.0, 0.0, 0.25 * factor)))
        for one in drive()
    ]
    assert reading_of_twists(turned) is reading


@pytest.mark.parametrize(
    ("factor", "reading"), [(57.3, TwistReading.DEGREES), (1.0, TwistReading.AS_STATED), (5.0, TwistReading.AS_STATED)]
)
def test_turn_rates_in_degrees_are_recognised_where_the_vehicle_hardly_turns(
    factor: float, reading: TwistReading
) -> None:
    pose, messages = np.eye(4), []
    for k in range(200):
        messages.append(PoseAndTwist(pose, EgoMotion(k * 20 * MS, "base", (7.0, 0.0, 0.0), (0.0, 0.0, 0.02 * factor))))
        pose = pose @ se3.exp(np.array([0.0, 0.0, 0.02, 7.0, 0.0, 0.0]) * 0.02)
    assert reading_of_twists(messages) is reading


@pytest.mark.parametrize("wrong", [0.9, 1.1])
def test_a_velocity_that_is_roughly_right_is_as_stated(wrong: float) -> None:
    assert reading_of_twists(drive(wrong=wrong)) is TwistReading.AS_STATED


@pytest.mark.parametrize("reading", READINGS)
def test_a_vehicle_that_stands_shows_nothing(reading: TwistReading) -> None:
    assert reading_of_twists(drive(reading, moving=0.0)) is TwistReading.AS_STATED


def test_poses_that_are_not_filled_in_show_nothing() -> None:
    messages = drive()
    still = [PoseAndTwist(np.eye(4), one.motion) for one in messages]
    none = [PoseAndTwist(None, one.motion) for one in messages]
    for without in (still, none, messages[:3], []):
        assert reading_of_twists(without) is TwistReading.AS_STATED
    assert motions_of_poses(none) == ()


@pytest.mark.parametrize("period_ms", [5, 20, 100, 400])
def test_the_motion_of_poses_is_that_of_the_vehicle(period_ms: int) -> None:
    motions = motions_of_poses(drive(TwistReading.NOT_FILLED_IN, period_ms))
    assert len(motions) >= 150
    assert [m.stamp_ns for m in motions] == sorted(m.stamp_ns for m in motions)
    for one in motions:
        assert one.linear_mps == pytest.approx(TWIST[3:], abs=1e-6)
        assert one.angular_radps == pytest.approx(TWIST[:3], abs=1e-6)
        assert one.frame_id == "base"


def test_over_a_gap_nothing_is_known() -> None:
    messages = drive(TwistReading.NOT_FILLED_IN, 100)
    gap = [message for message in messages if not 5_000 * MS <= message.stamp_ns < 8_000 * MS]
    assert not any(4_900 * MS < one.stamp_ns < 8_000 * MS for one in motions_of_poses(gap))
    assert motions_of_poses(drive(TwistReading.NOT_FILLED_IN, 600)) == ()
