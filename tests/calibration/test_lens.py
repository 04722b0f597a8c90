"""The lens of a window is the mean of what its hypotheses have, and of the window alone that of the free one."""

from __future__ import annotations

import numpy as np
import pytest

from coec.calibration.uncertainty.displaced_edges import LENS, SIZE
from coec.calibration.uncertainty.posterior import LENS_OFF, NOMINAL, Hypothesis, Posterior
from coec.calibration.verdict import estimate_lens
from coec.geometry.cameras import build

CAMERA = build("pinhole", width=600, height=800, fx=400.0, fy=500.0, cx=300.0, cy=400.0)


def hypothesis(name: str, probability: float, lens: list[float], sigma: list[float]) -> Hypothesis:
    deviation, variances = np.zeros(SIZE), np.zeros(SIZE)
    deviation[LENS], variances[LENS] = lens, np.square(sigma)
    return Hypothesis(name, probability, deviation, np.diag(variances))


def posterior(of_lens: float) -> Posterior:
    return Posterior(
        (
            hypothesis(NOMINAL, 1.0 - of_lens, [0.0, 0.0, 0.0, 0.0], [0.002, 0.002, 0.002, 0.001]),
            hypothesis(LENS_OFF, of_lens, [0.05, -0.02, 0.04, 0.01], [0.01, 0.02, 0.005, 0.01]),
        ),
        0.2,
        20.0,
    )


def test_a_certain_lens_is_that_of_its_hypothesis() -> None:
    lens = estimate_lens(posterior(1.0), CAMERA)
    assert lens is not None
    # A focal length is 400 px across and 500 px down; a corner is 500 px from the middle.
    np.testing.assert_allclose(lens.difference, [20.0, -10.0, 0.04, 5.0])
    np.testing.assert_allclose(lens.sigma, [4.0, 10.0, 0.005, 5.0])
    np.testing.assert_array_equal(lens.free_difference, lens.difference)
    # A third of the prior of a free lens: 1.7 % of a focal length, 3.3 %, 0.7 %.
    assert lens.determined.tolist() == [True, False, True, False]
    assert lens.probability == 1.0
    camera = lens.corrected(CAMERA)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((416.0, 520.0, 320.0, 390.0))


def test_a_lens_that_is_as_given_stays_so_whatever_the_free_one_is() -> None:
    lens = estimate_lens(posterior(0.01), CAMERA)
    assert lens is not None
    np.testing.assert_allclose(lens.difference, [0.2, -0.1, 0.0004, 0.05])
    np.testing.assert_allclose(lens.free_difference, [20.0, -10.0, 0.04, 5.0])
    # A mixture is wider than its parts by how far they are apart.
    assert lens.sigma[0] == pytest.approx(np.sqrt(0.99 * 0.8**2 + 0.01 * 4.0**2 + 0.99 * 0.01 * 20.0**2))
    assert lens.probability == 0.01


def test_without_a_posterior_there_is_no_lens() -> None:
    assert estimate_lens(None, CAMERA) is None
    assert estimate_lens(Posterior((hypothesis(NOMINAL, 1.0, [0.0] * 4, [0.0] * 4),), 0.2, 20.0), CAMERA) is None
