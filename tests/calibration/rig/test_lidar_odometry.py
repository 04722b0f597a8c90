"""The motion of a LiDAR from its own sweeps: right where the surroundings show it, unknown where they do not."""

import numpy as np
import pytest

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.rig import nearest_neighbours
from coec.calibration.rig.lidar_odometry import motions_of_sweeps
from coec.calibration.types import EgoMotion, LidarFrame
from coec.geometry import se3
from support.surroundings import Doubles, Shape, corridor, room, sweep

pytestmark = pytest.mark.skipif(not nearest_neighbours.installed(), reason="the extra `lidars` is not installed")

T_LIDAR_EGO = se3.perturbation(np.array([0.02, -0.01, 0.3, -1.0, 0.2, -1.8]))
TURN_S = 0.1


def consecutive(shape: Shape, motion: EgoMotion, *, turns: float = 1.0, seed: int = 1) -> tuple[LidarFrame, LidarFrame]:
    """Two sweeps of a LiDAR that moves, with the time of each point, so many turns apart."""
    rng = np.random.default_rng(seed)
    sweeps = []
    for number, count in ((0, 5_000), (1, 1_600)):
        stamp_s = number * turns * TURN_S
        after_s = stamp_s + rng.uniform(-0.5 * TURN_S, 0.5 * TURN_S, count)
        frame = sweep(
            1.5 * shape(rng, count),
            T_LIDAR_EGO,
            "lidar",
            rng,
            after_s=after_s,
            motion=motion,
            stamp_ns=round(1e9 * stamp_s),
        )
        sweeps.append(frame)
    return sweeps[0], sweeps[1]


def ego(speed_mps: float, turn_radps: float) -> EgoMotion:
    return EgoMotion(0, "ego", (speed_mps, 0.0, 0.0), (0.0, 0.0, turn_radps))


def of_lidar(motion: EgoMotion) -> Doubles:
    return np.concatenate(sensor_twist(motion, T_LIDAR_EGO))


@pytest.mark.parametrize(("speed_mps", "turn_radps"), [(8.0, 0.3), (0.0, 0.0)])
def test_the_motion_between_two_sweeps_is_measured(speed_mps: float, turn_radps: float) -> None:
    """Velocities that carry the vehicle further than a registration leads are measured from one that is near."""
    moved = ego(speed_mps, turn_radps)
    (measured,) = motions_of_sweeps([consecutive(room, moved)], None)
    assert measured is not None
    assert measured.linear_mps is not None
    twist = np.array([*measured.angular_radps, *measured.linear_mps])
    np.testing.assert_allclose(twist[:3], of_lidar(moved)[:3], atol=np.deg2rad(2.0))
    np.testing.assert_allclose(twist[3:], of_lidar(moved)[3:], atol=0.2)


def test_a_velocity_is_followed_from_pair_to_pair() -> None:
    moved = ego(-18.0, 0.0)
    pairs = [consecutive(room, moved, seed=seed) for seed in (1, 2)]
    for measured in motions_of_sweeps(pairs, None):
        assert measured is not None
        assert measured.speed_mps == pytest.approx(18.0, abs=0.2)


@pytest.mark.fault("odometry is missing, and the LiDAR drives along a corridor", "the velocity stays unknown")
def test_along_a_corridor_the_turn_alone_is_known() -> None:
    (measured,) = motions_of_sweeps([consecutive(corridor, ego(5.0, 0.2))], None)
    assert measured is not None
    assert measured.linear_mps is None
    np.testing.assert_allclose(measured.angular_radps, of_lidar(ego(5.0, 0.2))[:3], atol=np.deg2rad(3.0))


def test_sweeps_that_are_not_consecutive_show_no_motion() -> None:
    same = consecutive(room, ego(1.0, 0.0))[0]
    pairs = [consecutive(room, ego(1.0, 0.0), turns=4.0), (same, same)]
    assert list(motions_of_sweeps(pairs, None)) == [None, None]


def test_surroundings_that_do_not_fit_show_no_motion() -> None:
    """Sweeps of two places."""
    rng = np.random.default_rng(3)
    here, _ = consecutive(room, ego(0.0, 0.0))
    elsewhere = LidarFrame(
        10**8, "lidar", rng.uniform(-30.0, 30.0, (1500, 3)).astype(np.float32), time_offset_s=np.zeros(1500, np.float32)
    )
    assert list(motions_of_sweeps([(here, elsewhere)], None)) == [None]
