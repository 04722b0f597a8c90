"""What a registration tells an edge: its strong directions, whole; of weak ones nothing."""

from __future__ import annotations

import numpy as np
import pytest

from coec.calibration.rig.edge_observations import (
    UNDETERMINED_TIMES,
    determined_covariance,
    observation_of_registration,
    window_of,
)
from coec.calibration.rig.lidar_sampling import KNOWN_BEFORE
from coec.geometry import se3

SHARP = np.diag([*np.radians([0.03] * 3), 0.005, 0.005, 0.005]) ** 2
ALONG = np.array([0.0, 0.0, 0.0, 0.6, 0.8, 0.0])


def test_what_is_sharp_is_reported_as_it_is() -> None:
    reported = determined_covariance(SHARP)
    assert reported is not None
    np.testing.assert_allclose(reported, SHARP, rtol=1e-9, atol=1e-15)
    observation = observation_of_registration("roof to bumper", 7, np.eye(4), reported)
    np.testing.assert_allclose(observation.information, np.linalg.inv(SHARP), rtol=1e-6)
    assert not observation.weak


def test_a_direction_that_nothing_determines_is_as_wide_as_if_it_were_not_known_and_the_others_are_retained() -> None:
    reported = determined_covariance(SHARP + 0.5**2 * np.outer(ALONG, ALONG))
    assert reported is not None
    across = np.array([0.0, 0.0, 0.0, -0.8, 0.6, 0.0])
    assert np.sqrt(ALONG @ reported @ ALONG) == pytest.approx(UNDETERMINED_TIMES * KNOWN_BEFORE[3], rel=1e-3)
    assert np.sqrt(across @ reported @ across) == pytest.approx(0.005, rel=1e-3)
    assert np.sqrt(reported[0, 0]) == pytest.approx(np.radians(0.03), rel=1e-6)
    # A minute of such looks tells less than what was known before.
    information = observation_of_registration("e", 0, np.eye(4), reported).information
    assert ALONG @ information @ ALONG * 24 < 1.0 / KNOWN_BEFORE[3] ** 2 * 1.01


def test_where_nothing_is_reported_there_is_no_observation() -> None:
    assert determined_covariance(np.diag((0.6 * KNOWN_BEFORE) ** 2)) is None


@pytest.mark.parametrize("bad", [np.full((6, 6), np.nan), np.eye(5), np.full((6, 6), np.inf)])
def test_what_is_no_covariance_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="6, 6"):
        determined_covariance(bad)


def test_the_window_is_as_sure_as_all_observations_of_one_rig_can_be() -> None:
    reported = determined_covariance(SHARP)
    assert reported is not None
    window = window_of(7, se3.exp(np.full(6, 0.1)), reported)
    assert (window.uncertainty.sigma >= np.sqrt(SHARP.diagonal())).all()
    assert np.rad2deg(window.uncertainty.sigma[0]) > 0.04
    assert window.determined_axes() == list(range(6))
