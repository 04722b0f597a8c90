"""Ego-motion from `/tf`: held to drives of which every pose and velocity is known."""

import math
import struct

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion
from coec.errors import DecodeError
from coec.geometry import se3
from coec.io.ros.transforms import MAX_BETWEEN_S, MAX_TRANSFORMS, MovingFrame, OdometryMotion
from support.ros import Packer, PoseValues, transforms

START = 1_700_000_000 * 10**9
MS = 10**6
TWIST = np.array([0.01, -0.02, 0.4, 9.0, 0.5, -0.1])
"""A sharp turn at 9 m/s: rad/s and m/s, in the vehicle's frame."""

SIGNALLING: float = struct.unpack("<d", b"\1\0\0\0\0\0\xf0\x7f")[0]
"""A NaN at which arithmetic raises its hand (IEEE 754)."""

AT = se3.transform_from(se3.rotation_exp(np.array([0.0, 0.1, 2.5])), np.array([3.4e5, 5.8e6, 110.0]))
"""Far from the origin of the map, as in UTM."""


def pose(T: NDArray[np.float64]) -> PoseValues:
    x, y, z = T[:3, 3]
    i, j, k, w = se3.quaternion_xyzw_from_rotation(T[:3, :3])
    return (float(x), float(y), float(z), float(i), float(j), float(k), float(w))


def there(ms: float, twist: NDArray[np.float64] = TWIST) -> PoseValues:
    return pose(AT @ se3.exp(twist * ms * 1e-3))


def at(ms: float, *, parent: str = "odom", child: str = "base_link", where: PoseValues | None = None) -> bytes:
    return transforms((parent, child, START + round(ms * MS), where or there(ms)))


def taken(*payloads: bytes, frame: MovingFrame | None = None) -> list[EgoMotion | None]:
    moving = frame or MovingFrame("odom", "base_link")
    return [moving.motion(payload) for payload in payloads]


def test_two_poses_report_the_twist_between_them() -> None:
    first, second = taken(at(0), at(20))

    assert first is None
    assert second is not None
    assert (second.stamp_ns, second.frame_id) == (START + 10 * MS, "base_link")
    assert second.linear_mps == pytest.approx(TWIST[3:], abs=1e-5)
    assert second.angular_radps == pytest.approx(TWIST[:3], abs=1e-5)


def test_a_drive_that_brakes_in_a_bend_is_reported_to_second_order() -> None:
    """Poses at 50 Hz, 4 m/s² and 0.5 rad/s²: the velocity at each stamp, within what half a step of change leaves."""
    moving, T, step_s = MovingFrame("/odom", "base_link"), np.eye(4), 1e-3
    worst = 0.0
    for tick in range(1001):
        if tick % 20 == 0:
            motion = moving.motion(transforms(("odom", "base_link", START + tick * MS, pose(T))))
            if motion is not None:
                now_s = (motion.stamp_ns - START) * 1e-9
                assert motion.linear_mps is not None
                worst = max(worst, abs(motion.linear_mps[0] - (10.0 - 4.0 * now_s)))
                worst = max(worst, abs(motion.angular_radps[2] - 0.5 * now_s))
        middle_s = (tick + 0.5) * step_s
        T = T @ se3.exp(np.array([0, 0, 0.5 * middle_s, 10.0 - 4.0 * middle_s, 0, 0]) * step_s)
    assert 0.0 < worst < 1e-3


def test_other_frames_make_no_motion_and_do_not_disturb() -> None:
    wheel = at(10, parent="base_link", child="wheel")
    other = at(10, parent="map", child="base_link")
    several = transforms(
        ("base_link", "wheel", START, there(0)),
        ("odom", "base_link", START + 20 * MS, there(20)),
        ("map", "odom", START, there(0)),
    )

    result = taken(at(0), wheel, other, transforms(), several)

    assert [motion is not None for motion in result] == [False, False, False, False, True]


def test_a_message_with_two_poses_of_the_frame_reports_the_last_motion() -> None:
    both = transforms(("odom", "base_link", START, there(0)), ("odom", "base_link", START + 20 * MS, there(20)))

    (motion,) = taken(both)

    assert motion is not None
    assert motion.stamp_ns == START + 10 * MS


def test_poses_nearer_than_their_own_resolution_wait_for_a_longer_base() -> None:
    """At 1 kHz a millimetre of a pose would be a metre per second."""
    result = taken(*(at(ms) for ms in range(21)))

    assert [ms for ms, motion in enumerate(result) if motion is not None] == [10, 20]


@pytest.mark.parametrize("later_ms", [0, -1000, 1e3 * MAX_BETWEEN_S + 1])
def test_nothing_is_reported_across_a_gap_or_a_step_back(later_ms: float) -> None:
    assert taken(at(0), at(later_ms)) == [None, None]
    assert taken(at(0), at(later_ms), at(later_ms + 50))[2] is not None, "it goes on from there"


@pytest.mark.fault(
    "an invalid pose on /tf, or one that nobody can have driven to", "it is refused, and the stream goes on"
)
@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        ((math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "transform_invalid"),
        ((1e30, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "transform_invalid"),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), "transform_invalid"),
        ((0.0, 0.0, 0.0, math.inf, 0.0, 0.0, 1.0), "transform_invalid"),
        ((0.0, 0.0, 0.0, SIGNALLING, 0.0, 0.0, 1.0), "transform_invalid"),
        ((SIGNALLING, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "transform_invalid"),
        ((5e8, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "motion_invalid"),  # a filter was reset
    ],
)
def test_a_pose_that_is_none_is_refused(broken: PoseValues, reason: str) -> None:
    moving = MovingFrame("odom", "base_link")
    taken(at(0), at(20), frame=moving)
    with pytest.raises(DecodeError) as refused:
        moving.motion(at(40, where=broken))
    assert refused.value.reason == reason
    later = taken(*(at(ms) for ms in (1000, 1050)), frame=moving)
    assert later[1] is not None


@pytest.mark.fault("a /tf message with millions of transforms", "it is refused before any is made")
@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (transforms(claimed=2**32 - 1), "transforms_too_many"),
        (transforms(claimed=MAX_TRANSFORMS), "message_malformed"),
        (transforms(*[("a", "b", START, there(0))] * (MAX_TRANSFORMS + 1)), "transforms_too_many"),
        (at(0, child="x" * 2**20), "message_too_large"),
        (at(0)[:-9], "message_malformed"),
        (b"", "message_malformed"),
        (b"\0\1\0\0", "message_malformed"),
    ],
)
def test_a_hostile_message_of_transforms_is_refused(payload: bytes, reason: str) -> None:
    with pytest.raises(DecodeError) as refused:
        MovingFrame("odom", "base_link").motion(payload)
    assert refused.value.reason == reason


def odometry(ms: float, stated: NDArray[np.float64], twist: NDArray[np.float64] = TWIST) -> bytes:
    """An `Odometry` of the drive, with this velocity in it."""
    packer = Packer().header("odom", *divmod(START + round(ms * MS), 10**9)).text("base_link")
    packer.put("d", *there(ms, twist), *[0.0] * 36)
    return packer.put("d", *stated[3:].tolist(), *stated[:3].tolist(), *[0.0] * 36).done()


STANDING = np.zeros(6)


@pytest.mark.parametrize(
    ("stated", "reading"),
    [
        (STANDING, "are not filled in"),
        (np.r_[TWIST[:3], -TWIST[3:]], "are backwards"),
        (np.r_[TWIST[:3], 3.6 * TWIST[3:]], "are in km/h"),
        (np.r_[np.degrees(TWIST[:3]), TWIST[3:]], "are given with turn rates in degrees"),
    ],
)
@pytest.mark.parametrize("period_ms", [5, 20, 100])
@pytest.mark.fault(
    "velocities of an odometry that its poses contradict, on the bus",
    "the motion is that of the poses, and this is reported",
)
def test_an_odometry_whose_velocities_are_not_as_stated(
    stated: NDArray[np.float64], reading: str, period_ms: int
) -> None:
    reader = OdometryMotion(None)
    motions = [reader.motion(odometry(ms, stated)) for ms in range(0, 6000, period_ms)]
    assert f"The velocities of the odometry {reading}, by its poses" in reader.note
    assert "say ego.motion: twist" in reader.note
    first, last = motions[0], motions[-1]
    assert first is not None
    assert first.linear_mps == pytest.approx(tuple(stated[3:]))
    assert last is not None
    assert last.linear_mps == pytest.approx(tuple(TWIST[3:]), abs=1e-4)
    assert last.angular_radps == pytest.approx(tuple(TWIST[:3]), abs=1e-5)
    assert last.stamp_ns == pytest.approx(START + (6000 - period_ms - max(period_ms, 100) / 2) * MS, abs=2)
    overridden = OdometryMotion("twist")
    assert all(overridden.motion(odometry(ms, stated)) is not None for ms in range(0, 6000, period_ms))
    assert overridden.note == ""


def test_an_odometry_that_says_what_its_poses_show() -> None:
    reader = OdometryMotion(None)
    for ms in range(0, 60_000, 20):
        motion = reader.motion(odometry(ms, TWIST))
        assert motion is not None
        assert motion.linear_mps == pytest.approx(tuple(TWIST[3:]))
    standing = OdometryMotion(None)
    for ms in range(0, 60_000, 100):
        standing.motion(odometry(ms, STANDING, STANDING))
    assert (reader.note, standing.note) == ("", "")


def test_poses_that_jump_stand_or_step_back_are_no_motion() -> None:
    reader = OdometryMotion("pose")
    assert reader.motion(odometry(0, STANDING)) is None
    assert reader.motion(odometry(900, STANDING)) is None, "a gap"
    assert reader.motion(odometry(1000, STANDING)) is not None
    assert reader.motion(odometry(500, STANDING)) is None, "another clock"
    with pytest.raises(DecodeError):
        reader.motion(odometry(600, STANDING, 1e4 * TWIST))
    contradicted = OdometryMotion(None)
    for ms in range(0, 6000, 20):
        motion = contradicted.motion(odometry(ms, 0.4 * TWIST))
        assert motion is not None
        assert motion.linear_mps == pytest.approx(tuple(0.4 * TWIST[3:]))
    assert "say ego.motion: pose" in contradicted.note
