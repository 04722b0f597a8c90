"""The Gaussian next to a posterior, against averages over many samples of it; and what its mean owes to groups."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.calibration.uncertainty.ascent import inverse_root
from coec.calibration.uncertainty.displaced_edges import LENS, SHIFTS, SIZE, TURNS, AssumedEdges, assumed_levels
from coec.calibration.uncertainty.gaussian import (
    PRECISE,
    GaussianFit,
    covariance_under,
    deletion_covariance,
    fit_gaussian,
)
from coec.geometry import se3
from coec.geometry.edges.alignment import EdgeFrames
from support.scenes import (
    IDENTITY_POSE,
    corner_edge_levels,
    corner_motions,
    corner_pixels,
    corner_points,
    corner_window,
)

PLACES = (*TURNS, *SHIFTS, *LENS)
PRIOR = np.array([0.09] * 3 + [0.5] * 3 + [0.002] * 3 + [0.004, 0.004, 0.002, 0.001])
SHARE = 0.003


def level_of(levels: list[EdgeFrames], pose: Matrix4 = IDENTITY_POSE) -> AssumedEdges:
    return assumed_levels(levels, corner_window(corner_motions(speed=0.0)), pose)[-1]


@pytest.fixture
def level(rng: np.random.Generator) -> AssumedEdges:
    points = corner_points(rng)
    return level_of(corner_edge_levels(corner_pixels(points), points))


def fitted(level: AssumedEdges, share: float = SHARE, *, known: bool = True) -> GaussianFit:
    return fit_gaussian(level, np.zeros(SIZE), PLACES, PRIOR, share, effort=PRECISE, share_is_known=known)


def slopes(level: AssumedEdges, fit: GaussianFit, samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, n) gradients of the log-posterior at K samples (K, n) about the mean, one after the other."""
    edges, free = level.at(fit.mean, PLACES), list(PLACES)
    rows = []
    for sample in samples:
        z, gradient = edges.significance(sample)
        rows.append(fit.independent_share * max(z, 0.0) * gradient - (fit.mean[free] + sample) / PRIOR[free] ** 2)
    return np.array(rows)


def test_gradient_and_curvature_of_the_posterior_vanish_and_agree_on_average(
    level: AssumedEdges, rng: np.random.Generator
) -> None:
    """The two equations of the fixed point, by Stein's lemma: the mean curvature is that of samples with gradients."""
    fit, free = fitted(level), list(PLACES)
    covariance = fit.covariance[np.ix_(free, free)]
    factor = np.linalg.cholesky(covariance)
    standard = rng.normal(size=(2000, len(free)))
    standard = np.concatenate([standard, -standard])
    of_samples = slopes(level, fit, standard @ factor.T) @ factor
    assert np.abs(of_samples.mean(axis=0)).max() < 0.25, "standard deviations"
    curvature = -(standard.T @ of_samples) / len(standard)
    np.testing.assert_allclose(np.diag(curvature), 1.0, atol=0.3)
    assert np.abs(curvature - np.diag(np.diag(curvature))).max() < 0.3


def test_fewer_independent_edges_make_it_wider(level: AssumedEdges) -> None:
    few, many = fitted(level, 0.02), fitted(level, 0.2)
    assert (few.covariance.diagonal()[:3] > 2.0 * many.covariance.diagonal()[:3]).all()


def test_it_does_not_depend_on_where_it_begins(rng: np.random.Generator) -> None:
    points = corner_points(rng)
    levels = corner_edge_levels(corner_pixels(points), points)
    starts = [se3.perturbation(np.array([6e-4, -4e-4, 5e-4, 0.004, -0.003, 0.002]) * sign) for sign in (-1.0, 0.0, 1.0)]
    fits = [fitted(level_of(levels, start), known=False) for start in starts]
    poses = [se3.perturb(start, fit.mean[:6]) for start, fit in zip(starts, fits, strict=True)]
    sigma = np.sqrt(fits[1].covariance.diagonal()[:6])
    for pose, fit in zip(poses, fits, strict=True):
        assert np.abs(se3.difference(pose, poses[1]) / sigma).max() < 0.25
        np.testing.assert_allclose(np.sqrt(fit.covariance.diagonal()[:6]), sigma, rtol=0.1)


def test_frames_that_disagree_make_the_mean_uncertain(rng: np.random.Generator) -> None:
    points = corner_points(rng)
    pixels = corner_pixels(points)
    disagreeing = [at + np.array([1.2 * (-1) ** frame, 0.0]) for frame, at in enumerate(pixels)]
    alike, different = (level_of(corner_edge_levels(seen, points)) for seen in (pixels, disagreeing))

    def spread(level: AssumedEdges) -> float:
        return float(np.sqrt(deletion_covariance(level, fitted(level, 0.02), PLACES, PRIOR)[1, 1]))

    assert spread(different) > 1.5 * spread(alike)


def test_the_mean_moves_without_a_group_as_far_as_that_of_a_gaussian_fitted_without_it(
    rng: np.random.Generator,
) -> None:
    """One step at common points and on a paraboloid, against a fit of the edges that are left, frame by frame."""
    points = corner_points(rng)
    disagreeing = [at + np.array([1.2 * (-1) ** frame, 0.0]) for frame, at in enumerate(corner_pixels(points))]
    level = level_of(corner_edge_levels(disagreeing, points))
    fit, means = fitted(level, 0.02), []
    for frame in range(len(level.frames.maps)):
        weight = np.where(level.frame == frame, np.float32(0.0), level.frames.weight)
        means.append(fitted(replace(level, frames=replace(level.frames, weight=weight)), 0.02).mean[:3])
    off = np.array(means) - np.mean(means, axis=0)
    count = len(means)
    expected = np.sqrt((off**2).sum(axis=0) * (count - 1) / count)
    # The covariance adds what parts of the image do, and takes three steps at the width of all edges.
    spread = np.sqrt(deletion_covariance(level, fit, PLACES, PRIOR).diagonal()[:3])
    assert (spread > 0.5 * expected).all()
    assert (spread < 2.0 * expected).all()


def test_a_covariance_under_another_prior_is_as_it_is_fitted_there(level: AssumedEdges) -> None:
    wide, free = PRIOR.copy(), list(PLACES)
    wide[list(LENS)] *= 2.0
    fit = fitted(level)
    expected = fit_gaussian(level, fit.mean, PLACES, wide, SHARE, effort=PRECISE, share_is_known=True).covariance
    covariance = covariance_under(fit, PLACES, PRIOR, wide)
    assert covariance is not None
    sigma = np.sqrt(covariance.diagonal())
    assert (sigma > 1.01 * np.sqrt(fit.covariance.diagonal()[free])).any()
    np.testing.assert_allclose(sigma, np.sqrt(expected.diagonal()[free]), rtol=0.15)


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_what_is_not_finite_is_refused(broken: float) -> None:
    matrix = np.eye(3)
    matrix[0, 1] = matrix[1, 0] = broken
    with pytest.raises(ValueError, match="do not"):
        inverse_root(matrix)
