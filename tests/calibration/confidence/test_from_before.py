"""The summit next to where the camera was before, whatever the search found."""

from __future__ import annotations

import numpy as np

from coec.calibration.confidence.from_before import summit_from_before
from coec.geometry import se3
from corners import ABOUT_NOTHING, levels, motions, pixels, things, window


def test_it_is_the_true_one_where_the_place_was_known_and_the_search_went_astray(rng: np.random.Generator) -> None:
    points = things(rng)
    edges, of = levels(pixels(points), points), window(motions())
    astray = se3.perturbation(np.array([0.004, -0.004, 0.003, 0.1, -0.08, 0.05]))
    summit = summit_from_before(edges, of, astray)
    assert summit is not None
    away = se3.difference(summit, ABOUT_NOTHING)
    assert np.linalg.norm(away[:3]) < 1e-3
    assert np.linalg.norm(away[3:]) < 0.01


def test_where_nothing_is_in_view_there_is_none(rng: np.random.Generator) -> None:
    behind = [-at for at in things(rng)]
    assert summit_from_before(levels(pixels(things(rng)), behind), window(motions()), ABOUT_NOTHING) is None
