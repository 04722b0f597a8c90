"""Poses by the thousand: each against the single form of `se3`, and where the ball's points lie."""

import numpy as np
import pytest

from coec.geometry import se3
from coec.geometry.edges.charts import moved_by, unit_ball

POSE = se3.perturbation(np.array([0.4, -0.3, 1.2, 0.5, -1.0, 2.0]))


def test_each_pose_is_turned_and_then_shifted() -> None:
    rng = np.random.default_rng(0)
    turn_rad, shift_m = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    turn_rad[:3] = [[0.0, 0.0, 0.0], [0.0, np.pi, 0.0], [1e-9, 0.0, -1e-9]]
    for pose, turn, shift in zip(moved_by(POSE, turn_rad, shift_m), turn_rad, shift_m, strict=True):
        expected = se3.transform_from(se3.rotation_exp(turn), np.zeros(3)) @ POSE
        expected[:3, 3] += shift
        assert pose == pytest.approx(expected, abs=1e-12)


def test_the_ball_is_filled_evenly() -> None:
    ball = unit_ball(4000)
    radius = np.linalg.norm(ball, axis=1)
    assert radius.max() <= 1.0
    # As many points as their share of the volume, in every shell and every octant.
    shells, _ = np.histogram(radius**3, bins=8, range=(0.0, 1.0))
    octants = np.bincount((ball > 0.0) @ [1, 2, 4], minlength=8)
    assert shells == pytest.approx(500, abs=15)
    assert octants == pytest.approx(500, abs=30)


def test_a_larger_ball_is_another_sample_of_the_same_points() -> None:
    assert (unit_ball(100) == unit_ball(1000)[:100]).all()
