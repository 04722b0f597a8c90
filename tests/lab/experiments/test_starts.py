"""Starts of an evaluation: evenly around, each direction once, the same every time."""

from __future__ import annotations

from math import radians

import numpy as np
import pytest

from coec.geometry import se3
from coec_lab.experiments.solve_experiments import (
    frame_counts,
    frame_subset,
    perturbations,
    sphere_directions,
    start_poses,
    translation_partners,
)

COUNTS = [1, 2, 3, 5, 8, 30, 97, 200, 1400]
"""With the primes, the Fibonacci numbers and the sizes of the papers among them."""


@pytest.mark.parametrize("count", COUNTS)
def test_directions_are_unit_vectors(count: int) -> None:
    sphere = sphere_directions(count)
    assert sphere.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(sphere, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("count", [30, 97, 200, 1400])
def test_directions_are_evenly_spread(count: int) -> None:
    sphere = sphere_directions(count)
    assert np.abs(sphere.mean(axis=0)).max() < 0.02
    cosines = sphere @ sphere.T - 2.0 * np.eye(count)
    nearest_rad = np.arccos(cosines.max(axis=1))
    # A hexagonal lattice of as many points on as large an area has neighbours 3.81 / √count apart, a square one 3.54.
    assert nearest_rad.min() > 2.7 / np.sqrt(count)
    assert nearest_rad.max() < 3.9 / np.sqrt(count)


def test_directions_are_the_usual_lattice() -> None:
    np.testing.assert_allclose(sphere_directions(4)[:, 2], [0.75, 0.25, -0.25, -0.75])
    golden_angle_rad = radians(137.50776405003785)
    second = sphere_directions(4)[1]
    assert np.arctan2(second[1], second[0]) == pytest.approx(golden_angle_rad)


def test_no_direction_is_an_error() -> None:
    with pytest.raises(ValueError, match="at least one"):
        sphere_directions(0)


@pytest.mark.parametrize("count", [*range(1, 60), 200, 233, 1400])
def test_partners_are_a_permutation(count: int) -> None:
    assert sorted(translation_partners(count)) == list(range(count))


def test_partners_are_no_copy_and_neighbours_get_distant_ones() -> None:
    sphere = sphere_directions(200)
    separation_rad = np.arccos(np.clip((sphere * sphere[translation_partners(200)]).sum(axis=1), -1.0, 1.0))
    assert (separation_rad < radians(1.0)).mean() < 0.02
    assert abs(np.corrcoef(sphere[:, 2], sphere[translation_partners(200), 2])[0, 1]) < 0.2


def test_perturbations_have_the_radii_that_were_requested() -> None:
    xi = perturbations(50, 0.2, 0.5)
    np.testing.assert_allclose(np.linalg.norm(xi[:, :3], axis=1), 0.2)
    np.testing.assert_allclose(np.linalg.norm(xi[:, 3:], axis=1), 0.5)
    np.testing.assert_allclose(xi[:, :3] / 0.2, sphere_directions(50))


def test_starts_move_the_reference_on_the_left() -> None:
    reference = se3.exp(np.array([0.3, -1.2, 1.0, 0.5, -0.2, 0.8]))
    for start, xi in zip(start_poses(reference, 7, 0.1, 0.3), perturbations(7, 0.1, 0.3), strict=True):
        np.testing.assert_allclose(se3.difference(start, reference), xi, atol=1e-12)


@pytest.mark.parametrize(
    ("available", "counts"),
    [(1, [1]), (4, [1, 2, 3, 4]), (10, [1, 2, 3, 5, 7, 10]), (25, [1, 2, 3, 5, 7, 10, 20, 25])],
)
def test_frame_counts_end_with_all(available: int, counts: list[int]) -> None:
    assert frame_counts(available) == counts


def test_subsets_differ_by_trial_and_are_the_same_every_time() -> None:
    rendered = [frame_subset(10, 3, trial) for trial in range(20)]
    assert rendered == [frame_subset(10, 3, trial) for trial in range(20)]
    assert len({tuple(one) for one in rendered}) > 10
    assert all(one == sorted(set(one)) and set(one) <= set(range(10)) for one in rendered)
    assert frame_subset(4, 4, 0) == [0, 1, 2, 3]
