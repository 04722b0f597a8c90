"""Pairs follow from stamps alone: nearest neighbours, settled before they are handed out, whatever the interleaving."""

import itertools
from collections.abc import Iterable

import numpy as np
import pytest

from coec.calibration.frames.pairing import AGREEING_STAMPS, Pairer
from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, FramePair, ImageFormat, LidarFrame
from coec.config import PairingConfig

MS = 1_000_000
S = 1_000_000_000
START = 1_700_000_000 * S
IMAGE = EncodedImage(ImageFormat.JPEG, 4, 4, b"")
Message = CameraFrame | LidarFrame | EgoMotion


def camera(ms: float) -> CameraFrame:
    return CameraFrame(START + round(ms * MS), "camera", IMAGE)


def sweep(ms: float) -> LidarFrame:
    return LidarFrame(START + round(ms * MS), "lidar", np.zeros((1, 3), np.float32))


def motion(ms: float, speed: float = 1.0, yaw: float = 0.0) -> EgoMotion:
    return EgoMotion(START + round(ms * MS), "ego", (speed, 0.0, 0.0), (0.0, 0.0, yaw))


def run(messages: Iterable[Message], *, expects_motion: bool = False) -> tuple[list[FramePair], Pairer]:
    pairer = Pairer(PairingConfig(), expects_motion=expects_motion)
    pairs = [pair for message in messages for pair in pairer.push(message)]
    return pairs + pairer.flush(), pairer


def stamps_ms(pairs: Iterable[FramePair]) -> list[tuple[float, float]]:
    return [((p.camera.stamp_ns - START) / MS, (p.lidar.stamp_ns - START) / MS) for p in pairs]


def test_each_sweep_takes_the_nearest_of_three_times_as_many_camera_frames() -> None:
    cameras = [camera(i * 33.3) for i in range(12)]
    sweeps = [sweep(5 + i * 100) for i in range(4)]
    pairs, _ = run(sorted([*cameras, *sweeps], key=lambda m: m.stamp_ns))
    assert stamps_ms(pairs) == [(0.0, 5.0), (99.9, 105.0), (199.8, 205.0), (299.7, 305.0)]


def test_a_camera_frame_goes_to_the_nearer_of_two_sweeps() -> None:
    pairs, pairer = run([sweep(0), sweep(50), camera(45), sweep(100), camera(145)])
    assert stamps_ms(pairs) == [(45.0, 50.0), (145.0, 100.0)]
    assert pairer.losses["lidar_unpaired"] == 1


def test_no_pair_beyond_the_tolerance() -> None:
    pairs, pairer = run([sweep(0), camera(51)])
    assert pairs == []
    assert pairer.losses == {"lidar_unpaired": 1}


def test_a_pair_is_not_handed_out_while_a_nearer_frame_may_come() -> None:
    pairer = Pairer(PairingConfig(), expects_motion=False)
    assert pairer.push(camera(0)) == []
    assert pairer.push(sweep(20)) == []
    assert stamps_ms(pairer.push(camera(21)) + pairer.flush()) == [(21.0, 20.0)]


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_the_interleaving_of_the_streams_does_not_matter(order: tuple[int, ...]) -> None:
    streams: list[list[Message]] = [
        [camera(i * 100 + 7) for i in range(6)],
        [sweep(i * 100) for i in range(6)],
        [motion(i * 20, speed=i) for i in range(32)],
    ]
    expected, _ = run(sorted(itertools.chain(*streams), key=lambda m: m.stamp_ns), expects_motion=True)
    one_after_the_other, _ = run([m for index in order for m in streams[index]], expects_motion=True)
    assert stamps_ms(one_after_the_other) == stamps_ms(expected)
    if order[0] == 2:  # motion that is there in time is used, whenever it came
        assert [p.motion for p in one_after_the_other] == [p.motion for p in expected]


def test_motion_is_interpolated_between_its_neighbours() -> None:
    pairs, _ = run([motion(0, 1.0), motion(100, 3.0), sweep(25), camera(25)], expects_motion=True)
    assert pairs[0].motion is not None
    assert pairs[0].motion.linear_mps == pytest.approx((1.5, 0.0, 0.0))
    assert pairs[0].motion.stamp_ns == pairs[0].stamp_ns


def test_a_velocity_that_one_of_two_samples_does_not_report_is_not_known_between_them() -> None:
    turning = EgoMotion(START, "ego", None, (0.0, 0.0, 0.2))
    pairs, _ = run([turning, motion(100, 3.0), sweep(25), camera(25)], expects_motion=True)
    assert pairs[0].motion is not None
    assert pairs[0].motion.linear_mps is None
    assert pairs[0].motion.angular_radps == pytest.approx((0.0, 0.0, 0.15))


def test_motion_with_the_stamp_of_the_camera_is_taken_as_it_is() -> None:
    exact = motion(25, 2.0)
    pairs, _ = run([motion(0), exact, motion(50), sweep(25), camera(25)], expects_motion=True)
    assert pairs[0].motion is exact


def test_motion_too_far_away_is_no_motion() -> None:
    pairs, _ = run([motion(0), sweep(500), camera(500), camera(900), sweep(900)], expects_motion=True)
    assert [pair.motion for pair in pairs] == [None, None]


def test_a_pair_waits_for_its_motion() -> None:
    pairer = Pairer(PairingConfig(), expects_motion=True)
    pairer.push(sweep(0))
    assert pairer.push(camera(0)) == []
    assert len(pairer.push(motion(10))) == 1


def test_motion_that_comes_nine_tenths_of_a_second_late_is_used() -> None:
    pictures = [message for i in range(10) for message in (sweep(i * 100), camera(i * 100))]
    pairs, _ = run([*pictures, *(motion(i * 50, speed=i) for i in range(20))], expects_motion=True)
    assert [pair.motion.linear_mps for pair in pairs if pair.motion] == [(i * 2, 0.0, 0.0) for i in range(10)]


def late_motion(late_ms: int, period_ms: int) -> tuple[list[FramePair], Pairer]:
    """Pictures and sweeps for three seconds, and motion that comes so late."""
    pictures = [(ms, message) for ms in range(0, 3000, period_ms) for message in (sweep(ms), camera(ms))]
    motions = [(ms + late_ms, motion(ms, speed=ms)) for ms in range(0, 3000, 50)]
    coming = [message for _, message in sorted([*pictures, *motions], key=lambda one: one[0])]
    return run(coming, expects_motion=True)


@pytest.mark.parametrize("period_ms", [50, 100])
def test_motion_may_come_a_second_late_however_fast_the_pictures_come(period_ms: int) -> None:
    pairs, pairer = late_motion(900, period_ms)
    assert [pair.motion.linear_mps[0] for pair in pairs if pair.motion and pair.motion.linear_mps] == [
        float(ms) for ms in range(0, 3000, period_ms)
    ]
    assert pairer.losses == {}


@pytest.mark.fault("ego-motion later than a second", "pairs go without it, and it is counted")
def test_motion_that_comes_after_its_pair_went_without_it_is_counted() -> None:
    pairs, pairer = late_motion(1300, 100)
    assert sum(pair.motion is None for pair in pairs) > 10
    assert pairer.losses["motion_late"] > 10


@pytest.mark.fault("ego-motion stops", "pairs go on without it, a second later")
def test_a_pair_goes_without_its_motion_when_pictures_are_more_than_a_second_ahead() -> None:
    pairer = Pairer(PairingConfig(), expects_motion=True)
    released = [len(pairer.push(message)) for i in range(13) for message in (sweep(i * 100), camera(i * 100))]
    assert sum(released) == 2


@pytest.mark.fault("a single stamp an hour ahead", "it is refused, and the stream goes on")
def test_a_single_stamp_an_hour_ahead_is_refused_and_the_stream_goes_on() -> None:
    hour_ms = 3_600_000
    pairs, pairer = run([sweep(0), camera(0), camera(hour_ms), sweep(100), camera(100), sweep(200), camera(200)])
    assert len(pairs) == 3
    assert pairer.losses == {"camera_stamp_ahead": 1}


def test_a_single_stamp_that_jumps_back_is_refused_and_the_stream_goes_on() -> None:
    pairs, pairer = run([sweep(0), camera(0), sweep(-5000), sweep(100), camera(100)])
    assert len(pairs) == 2
    assert pairer.losses == {"lidar_stamp_back": 1}


@pytest.mark.fault("a step of the sensors' clock that lasts", "it is followed")
@pytest.mark.parametrize("step_ms", [-60_000, 3_600_000])
def test_a_step_of_the_clock_that_lasts_is_followed(step_ms: int) -> None:
    before = [m for i in range(3) for m in (sweep(i * 100), camera(i * 100))]
    after = [m for i in range(3, 20) for m in (sweep(i * 100 + step_ms), camera(i * 100 + step_ms))]
    pairs, pairer = run([*before, *after])
    followed = {pair.stamp_ns for pair in pairs} & {frame.stamp_ns for frame in after}
    # A step back costs one pair more: the first sweep behind it meets cameras that are still ahead.
    assert len(followed) >= len(after) // 2 - AGREEING_STAMPS
    kind = "back" if step_ms < 0 else "ahead"
    assert pairer.losses[f"camera_stamp_{kind}"] == AGREEING_STAMPS - 1


@pytest.mark.fault("a sensor that is off", "the memory for frames that wait for it stays bounded")
def test_a_stream_without_partners_stays_bounded() -> None:
    pairs, pairer = run([sweep(i * 100) for i in range(1000)])
    assert pairs == []
    assert pairer.losses["lidar_unpaired"] == 1000
