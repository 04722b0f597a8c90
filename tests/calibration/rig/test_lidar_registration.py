"""The pose of one LiDAR in another: found, with a covariance that is honest where the surroundings do not tell it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.rig.lidar_registration import register
from coec.calibration.rig.lidar_sampling import LidarEdge, LidarRig, SweepPair
from coec.calibration.types import EgoMotion, LidarFrame
from coec.geometry import se3
from support.surroundings import NOISE_M, Shape, corridor, room, sweep

Doubles = NDArray[np.float64]

T_A_EGO = se3.perturbation(np.array([0.02, -0.01, 0.3, -1.0, 0.2, -1.8]))
T_A_B = se3.perturbation(np.array([0.05, -0.03, 1.4, 0.1, 0.9, -0.8]))


def drive(shape: Shape, seed: int, *, pairs: int = 3, longer_m: float = 0.0, count: int = 1500) -> list[SweepPair]:
    result = []
    for number in range(pairs):
        rng = np.random.default_rng([seed, number])
        a = sweep(shape(rng, count), T_A_EGO, "a", rng)
        b = sweep(shape(rng, count // 3), se3.inverse(T_A_B) @ T_A_EGO, "b", rng, longer_m=longer_m)
        result.append(SweepPair(a, b, None))
    return result


def edge(pairs: list[SweepPair], off: Doubles) -> LidarEdge:
    """Registered from a nominal pose that is wrong by ξ `off` (6,)."""
    return register(LidarRig("a", "b", se3.perturb(T_A_B, off), T_A_EGO), pairs)


def error(detected: LidarEdge) -> Doubles:
    return se3.difference(detected.T_a_b, T_A_B)


KNOCK = np.array([0.0, 0.0, np.deg2rad(1.0), 0.0, 0.0, 0.0])
FAR = np.array([0.03, -0.02, 0.04, 0.1, -0.08, 0.06])


@lru_cache(maxsize=1)
def in_a_room() -> LidarEdge:
    return edge(drive(room, 1), FAR)


def test_the_pose_is_detected_from_two_degrees_and_ten_centimetres_away() -> None:
    detected = in_a_room()
    assert not detected.reasons
    assert np.rad2deg(np.abs(error(detected)[:3])).max() < 0.06
    assert np.abs(error(detected)[3:]).max() < 0.01
    assert np.abs(error(detected) / detected.sigma).max() < 3.5
    assert detected.rms_m == pytest.approx(NOISE_M, rel=0.3)
    np.testing.assert_allclose(detected.correction, se3.difference(detected.T_a_b, detected.rig.T_a_b_nominal))


def test_a_knock_of_one_degree_is_the_correction_and_its_absence_is_none() -> None:
    pairs = drive(room, 2, pairs=2)
    displaced, calm = edge(pairs, KNOCK), edge(pairs, np.zeros(6))
    assert np.rad2deg(displaced.correction[2]) == pytest.approx(-1.0, abs=0.1)
    assert displaced.chi2 > 200.0
    assert calm.chi2 < 30.0


def test_moving_b_by_s_moves_its_pose_by_the_inverse() -> None:
    shift = se3.perturbation(np.array([0.2, -0.1, 0.4, 0.5, -0.3, 0.2]))
    pairs = drive(room, 3, pairs=1)
    moved = [
        SweepPair(
            p.a, LidarFrame(p.b.stamp_ns, "b", (p.b.xyz_m @ shift[:3, :3].T + shift[:3, 3]).astype(np.float32)), None
        )
        for p in pairs
    ]
    before = register(LidarRig("a", "b", T_A_B, T_A_EGO), pairs)
    after = register(LidarRig("a", "b", T_A_B @ se3.inverse(shift), T_A_EGO), moved)
    # Another choice of points, one in every cube, is another draw of the noise.
    separation = se3.difference(after.T_a_b @ shift, before.T_a_b)
    assert np.rad2deg(np.abs(separation[:3])).max() < 0.1
    assert np.abs(separation[3:]).max() < 0.015


def test_the_pose_of_a_in_b_is_the_inverse() -> None:
    rng = np.random.default_rng(12)
    a = sweep(room(rng, 2200), T_A_EGO, "a", rng)
    b = sweep(room(rng, 2200), se3.inverse(T_A_B) @ T_A_EGO, "b", rng)
    off = np.array([0.0, 0.0, np.deg2rad(1.0), 0.0, 0.03, 0.0])
    start = se3.perturb(T_A_B, off)
    there = register(LidarRig("a", "b", start, T_A_EGO), [SweepPair(a, b, None)])
    T_b_ego = se3.inverse(T_A_B) @ T_A_EGO
    back = register(LidarRig("b", "a", se3.inverse(start), T_b_ego), [SweepPair(b, a, None)])
    separation = se3.difference(there.T_a_b, se3.inverse(back.T_a_b))
    # Points of the one on planes of the other, and the other way round: not the same draw of the noise.
    sigma = np.hypot(there.sigma, (np.abs(se3.adjoint(there.T_a_b)) @ back.sigma))
    assert (np.abs(separation) < 3.0 * sigma).all()
    assert np.rad2deg(np.abs(separation[:3])).max() < 0.2


def test_along_a_corridor_nothing_is_claimed() -> None:
    """Normals that scatter must not pass for a wall across."""
    along, up = T_A_EGO[:3, 0], T_A_EGO[:3, 2]
    detected = edge(drive(corridor, 4, pairs=2), np.concatenate([np.zeros(3), 0.2 * along]))
    sigma_m = float(np.sqrt(along @ detected.covariance[3:, 3:] @ along))
    assert sigma_m > 0.1
    assert abs(error(detected)[3:] @ along) < 3.0 * sigma_m
    for axis in (np.cross(along, up), up):
        assert float(np.sqrt(axis @ detected.covariance[3:, 3:] @ axis)) < 0.03
    held = in_a_room()
    assert float(np.sqrt(along @ held.covariance[3:, 3:] @ along)) < 0.03


def test_a_range_bias_is_reported_and_does_not_bend_the_pose() -> None:
    detected = edge(drive(room, 5, longer_m=0.05), np.zeros(6))
    assert detected.range_bias.longer_m == pytest.approx(0.05, abs=3.5 * detected.range_bias.sigma_m)
    assert detected.range_bias.sigma_m < 0.015
    assert np.abs(error(detected)[3:]).max() < 0.02


def test_the_same_view_again_is_no_further_evidence() -> None:
    once = drive(room, 6, pairs=1)
    again, alone = edge(once * 4, np.zeros(6)), edge(once, np.zeros(6))
    assert (again.sigma / alone.sigma).min() > 0.7


def test_sweeps_are_brought_to_one_instant_through_the_mount_that_is_detected() -> None:
    """b is 40 ms later and turned by 2° from where it was mounted: taken through its nominal mount, its points would
    lie 2 cm aside."""
    motion = EgoMotion(0, "ego", (15.0, 0.0, 0.0), (0.0, 0.0, 0.3))
    pairs = []
    for number in range(2):
        rng = np.random.default_rng([7, number])
        late = 0.04 + rng.uniform(-0.05, 0.05, 900)
        a = sweep(room(rng, 2500), T_A_EGO, "a", rng)
        b = sweep(
            room(rng, 900), se3.inverse(T_A_B) @ T_A_EGO, "b", rng, after_s=late, motion=motion, stamp_ns=40_000_000
        )
        pairs.append(SweepPair(a, b, motion))
    detected = edge(pairs, 2.0 * KNOCK)
    assert np.rad2deg(np.abs(error(detected)[:3])).max() < 0.12
    assert np.abs(error(detected)[3:]).max() < 0.012


def test_what_sees_nothing_in_common_is_refused_as_text() -> None:
    far = [SweepPair(p.a, LidarFrame(0, "b", p.b.xyz_m + np.float32(100.0)), None) for p in drive(room, 8, pairs=1)]
    detected = edge(far, np.zeros(6))
    assert [reason.code for reason in detected.reasons] == ["lidar_overlap"]
    assert "overlap too little" in detected.reasons[0].text
    assert detected.sigma[0] > np.deg2rad(5.0)
    with pytest.raises(ValueError, match="no sweep"):
        edge([], np.zeros(6))


def test_points_that_lie_anywhere_do_not_pull() -> None:
    """A third of b is of things that a does not see."""
    pairs = []
    for number, pair in enumerate(drive(room, 9, pairs=2)):
        rng = np.random.default_rng([10, number])
        xyz = pair.b.xyz_m.copy()
        wrong = rng.random(len(xyz)) < 0.33
        xyz[wrong] *= rng.uniform(0.5, 0.95, (wrong.sum(), 1)).astype(np.float32)
        pairs.append(SweepPair(pair.a, LidarFrame(0, "b", xyz), None))
    detected = edge(pairs, FAR)
    assert np.rad2deg(np.abs(error(detected)[:3])).max() < 0.15
    assert np.abs(error(detected)[3:]).max() < 0.02
