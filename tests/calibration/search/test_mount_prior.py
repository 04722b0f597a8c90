"""How mounts move, before a window is looked at."""

from math import pi

import numpy as np
import pytest

from coec.calibration.solver import log_prior
from coec.calibration.types import MOUNT_RAD
from coec.geometry import se3

START = se3.perturb(np.eye(4), np.array([0.4, -1.1, 0.2, 0.3, -0.1, 0.05]))


def turned(degrees: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return se3.perturb(START, np.radians(degrees) * np.array([0.6, 0.0, -0.8, 0.0, 0.0, 0.0]))


def test_small_moves_are_far_likelier_than_large_ones() -> None:
    nats = [log_prior(turned(degrees), START, MOUNT_RAD) for degrees in (0.0, 0.2, 0.5, 1.0, 3.0, 10.0, 25.0)]
    assert nats[0] == pytest.approx(0.0, abs=1e-9)
    assert nats == sorted(nats, reverse=True)
    assert nats[2] == pytest.approx(-2.0 * np.log(2.0), rel=1e-6)


def test_a_knock_is_never_ruled_out() -> None:
    """A rank of eight against a start that is as good as any wrong pose (four) outweighs any turn at all."""
    assert -log_prior(turned(60.0), START, MOUNT_RAD) < 0.5 * (8.0**2 - 4.0**2)


def test_of_a_guess_nothing_is_known() -> None:
    assert log_prior(turned(28.0), START, pi) > -0.05


def test_a_shift_that_leaves_the_rotation_costs_nothing() -> None:
    shifted = se3.perturb(START, np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.2]))
    assert log_prior(shifted, START, MOUNT_RAD) == pytest.approx(0.0, abs=1e-6)
