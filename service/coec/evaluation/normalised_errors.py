"""Does a claimed standard deviation hold? Errors divided by what was claimed for them.

An error e with the claimed covariance C gives two figures: per axis e_i / √C_ii, of which 68, 95 and 99.7 % lie within
1, 2 and 3 if the claim holds and errors are normal; and over all axes the normalised estimation error squared
eᵀ·C⁻¹·e (NEES), whose mean per axis is 1 (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and
navigation", 2001, section 5.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.quantiles import chi2_quantile
from coec.calibration.types import Estimate
from coec.evaluation.statistics import SolveOutcome
from coec.geometry import se3

SIGMAS = (1.0, 2.0, 3.0)
"""Coverage is reported within these numbers of claimed standard deviations."""

BIN_EDGES = tuple(0.5 * step for step in range(-10, 11))
"""Edges of the histogram of e / σ; the first and the last bin also hold what lies beyond."""

CONFIDENCES = tuple(0.1 * step for step in range(1, 10))
"""Levels of the reliability plot: the share of errors that a normal distribution puts within √2·erf⁻¹ of them."""

BOUNDS = 0.95
"""Share of evaluations whose mean NEES lies within the bounds, if every claim holds."""


@dataclass(frozen=True, slots=True, eq=False)
class Claims:
    """Errors and what was claimed for them, of n results.

    Attributes:
        errors: (n, 6) ξ, rx ry rz (rad) tx ty tz (m).
        covariances: (n, 6, 6) in the same units; NaN in the rows and columns of axes without a claim.
        refused: number of results that were not accepted or claim nothing; no figure includes them.
    """

    errors: NDArray[np.float64]
    covariances: NDArray[np.float64]
    refused: int


@dataclass(frozen=True, slots=True, eq=False)
class NormalisedErrors:
    """Figures of `Claims`; per axis rx ry rz tx ty tz, NaN where nothing is claimed.

    Attributes:
        judged, refused: results with and without a claim.
        independent: how many of the judged share no frame; `nees_bounds` are for so many.
        rms, largest: (6,) root mean square and largest absolute error, rad and m.
        sigma: (6,) mean claimed standard deviation.
        sigma_over_rms: (6,) their ratio: above 1 the claims are wider than the errors.
        coverage: (3, 6) share of the errors within `SIGMAS`.
        histogram: (6, len(BIN_EDGES) - 1) counts of e / σ.
        reliability: (len(CONFIDENCES), 6) share of the errors within the interval that should hold that share.
        nees: mean of eᵀ·C⁻¹·e per axis, 1 if the claims hold.
        nees_bounds: interval that holds `nees` in the share `BOUNDS` of all evaluations, if the claims hold.
    """

    judged: int
    refused: int
    independent: int
    rms: NDArray[np.float64]
    largest: NDArray[np.float64]
    sigma: NDArray[np.float64]
    sigma_over_rms: NDArray[np.float64]
    coverage: NDArray[np.float64]
    histogram: NDArray[np.int64]
    reliability: NDArray[np.float64]
    nees: float
    nees_bounds: tuple[float, float]


def normalise(claims: Claims, independent: int) -> NormalisedErrors:
    """The figures of some claims, of which `independent` share no frame (capped at their number)."""
    errors, covariances = claims.errors, claims.covariances
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    known = np.isfinite(sigma)
    some = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    z = np.where(known, errors / np.where(known, sigma, 1.0), np.nan)
    known_errors = np.where(known, errors, 0.0)
    rms = np.sqrt((known_errors**2).sum(axis=0) / some)
    mean_sigma = np.where(known, sigma, 0.0).sum(axis=0) / some
    nees, axes = _nees(errors, covariances, known)
    used = min(independent, len(errors))
    return NormalisedErrors(
        judged=len(errors),
        refused=claims.refused,
        independent=used,
        rms=rms,
        largest=np.where(np.isfinite(some), np.abs(known_errors).max(axis=0, initial=0.0), np.nan),
        sigma=mean_sigma,
        sigma_over_rms=mean_sigma / np.where(rms > 0.0, rms, np.nan),
        coverage=np.array([(np.abs(z) <= limit).sum(axis=0) / some for limit in SIGMAS]),
        histogram=np.array([_histogram(column[np.isfinite(column)]) for column in z.T]),
        reliability=np.array([(np.abs(z) <= within(share)).sum(axis=0) / some for share in CONFIDENCES]),
        nees=nees,
        nees_bounds=_bounds(axes * used // max(len(errors), 1)),
    )


def within(share: float) -> float:
    """How many standard deviations about the mean hold this share of a normal distribution."""
    return NormalDist().inv_cdf(0.5 + 0.5 * share)


def of_outcomes(outcomes: Sequence[SolveOutcome]) -> Claims:
    """Errors of accepted outcomes against their reference."""
    judged = [(outcome.error, claimed(outcome)) for outcome in outcomes]
    return gathered([None if claim is None else (error, claim) for error, claim in judged])


def of_differences(outcomes: Sequence[tuple[SolveOutcome, SolveOutcome]]) -> Claims:
    """Differences of results that share no frame, so their variances add up."""
    differences: list[tuple[NDArray[np.float64], NDArray[np.float64]] | None] = []
    for a, b in outcomes:
        first, second = claimed(a), claimed(b)
        if first is None or second is None:
            differences.append(None)
            continue
        differences.append((se3.difference(a.T_camera_lidar, b.T_camera_lidar), first + second))
    return gathered(differences)


def gathered(results: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]] | None]) -> Claims:
    """Claims from error (6,) and covariance (6, 6) of each result; None stands for a refused one."""
    accepted = [result for result in results if result is not None]
    return Claims(
        errors=np.array([error for error, _ in accepted]).reshape(-1, 6),
        covariances=np.array([covariance for _, covariance in accepted]).reshape(-1, 6, 6),
        refused=len(results) - len(accepted),
    )


def claimed(outcome: SolveOutcome) -> NDArray[np.float64] | None:
    """The covariance (6, 6) that an outcome claims; None if it was not accepted or claims nothing at all."""
    estimate = outcome.trial.estimate
    if estimate is None or not outcome.accepted:
        return None
    covariance = covariance_of(estimate)
    return covariance if np.isfinite(np.diagonal(covariance)).any() else None


def covariance_of(estimate: Estimate) -> NDArray[np.float64]:
    """Covariance (6, 6) from the standard deviations of an estimate, taking axes as independent; NaN on axes that were
    not solved."""
    sigma = np.where(estimate.solved, estimate.sigma, np.nan)
    known = np.isfinite(sigma)
    covariance = np.diag(sigma**2)
    covariance[~known, :] = covariance[:, ~known] = np.nan
    return covariance


def _nees(errors: NDArray[np.float64], covariances: NDArray[np.float64], known: NDArray[np.bool_]) -> tuple[float, int]:
    """Mean NEES per axis (NaN without a claim), and the number of claimed axes over all results."""
    total, axes = 0.0, 0
    for error, covariance, of in zip(errors, covariances, known, strict=True):
        if of.any():
            total += float(error[of] @ np.linalg.solve(covariance[np.ix_(of, of)], error[of]))
            axes += int(of.sum())
    return (total / axes if axes else float("nan")), axes


def _bounds(dof: int) -> tuple[float, float]:
    """Interval of a mean of χ² per degree of freedom."""
    if dof < 1:
        return (float("nan"), float("nan"))
    tail = 0.5 * (1.0 - BOUNDS)
    # The approximation of the quantile falls below zero in the lower tail of one degree of freedom.
    return max(chi2_quantile(tail, dof), 0.0) / dof, chi2_quantile(1.0 - tail, dof) / dof


def _histogram(values: NDArray[np.float64]) -> NDArray[np.int64]:
    inner = np.asarray(BIN_EDGES)[1:-1]
    return np.bincount(np.searchsorted(inner, values, side="right"), minlength=len(inner) + 1)


UNKNOWN_SHARE = 0.1
"""An axis that rests by more than this share of its length on an axis without a claim has no claim either. Smaller
shares come from parallel cameras, whose axes differ by rounding."""


def carried(covariance: NDArray[np.float64], jacobian: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 6) J·C·Jᵀ, with NaN on the axes that rest on an axis without a claim."""
    unknown = ~np.isfinite(np.diagonal(covariance))
    moved = jacobian @ np.where(np.isfinite(covariance), covariance, 0.0) @ jacobian.T
    spoiled = np.sqrt((jacobian**2 * unknown).sum(axis=1)) > UNKNOWN_SHARE
    moved[spoiled, :] = moved[:, spoiled] = np.nan
    return np.asarray(moved)
