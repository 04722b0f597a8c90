"""Steps of translation beside steps of rotation."""

import numpy as np
import pytest

from coec.calibration.search.local_search import POLISH_METRES_PER_RADIAN
from coec.geometry import se3
from coec.geometry.se3 import METRES_PER_RADIAN


@pytest.mark.parametrize("metres_per_radian", [METRES_PER_RADIAN, POLISH_METRES_PER_RADIAN])
def test_a_shift_moves_a_point_at_that_range_as_far_as_the_turn(metres_per_radian: float) -> None:
    steps = se3.axis_steps(1e-3, metres_per_radian)
    ahead = np.array([0.0, 0.0, metres_per_radian, 1.0])
    for turn, shift in ((0, 4), (1, 3)):
        by_turn = se3.perturbation(steps * (np.arange(6) == turn)) @ ahead - ahead
        by_shift = se3.perturbation(steps * (np.arange(6) == shift)) @ ahead - ahead
        assert np.linalg.norm(by_turn) == pytest.approx(np.linalg.norm(by_shift), rel=1e-6)
