"""The summit next to where the camera was before, whatever the search found."""

from __future__ import annotations

import numpy as np

from coec.calibration.uncertainty.covariance import mode_next_to_prior
from coec.geometry import se3
from support.scenes import (
    IDENTITY_POSE,
    corner_edge_levels,
    corner_motions,
    corner_pixels,
    corner_points,
    corner_window,
)


def test_it_is_the_true_one_where_the_place_was_known_and_the_search_went_astray(rng: np.random.Generator) -> None:
    points = corner_points(rng)
    edges, of = corner_edge_levels(corner_pixels(points), points), corner_window(corner_motions())
    astray = se3.perturbation(np.array([0.004, -0.004, 0.003, 0.1, -0.08, 0.05]))
    summit = mode_next_to_prior(edges, of, astray)
    assert summit is not None
    away = se3.difference(summit, IDENTITY_POSE)
    assert np.linalg.norm(away[:3]) < 1e-3
    assert np.linalg.norm(away[3:]) < 0.01


def test_where_nothing_is_in_view_there_is_none(rng: np.random.Generator) -> None:
    behind = [-at for at in corner_points(rng)]
    assert (
        mode_next_to_prior(
            corner_edge_levels(corner_pixels(corner_points(rng)), behind),
            corner_window(corner_motions()),
            IDENTITY_POSE,
        )
        is None
    )
