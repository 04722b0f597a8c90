"""Do two halves of one recording agree? The test of an estimator that needs no reference.

The two halves share no frame and no start. So their results differ only by the noise of the estimator, and this noise
must be as large as the standard deviations that the results claim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.evaluation.statistics import SolveOutcome
from coec.geometry import se3

SPLIT_SEED = 20_240_104
"""Any number; the first day of WACV 2024, where the protocol appeared."""

COVERING_SIGMAS = 3.0
"""A difference within so many standard deviations is covered: 99.7 % of a normal distribution are."""


@dataclass(frozen=True, slots=True, eq=False)
class Halves:
    """Differences of the results on disjoint halves of the frames, per axis rx ry rz (rad) tx ty tz (m).

    Attributes:
        splits: how many times the frames were split.
        pairs: frames in each half.
        solved: splits with a result from both halves; all figures are of these.
        accepted: solved splits whose results were both accepted.
        hits: solved splits whose results both hit the reference.
        rms, largest: (6,) root mean square and largest absolute difference; NaN on axes that were not searched.
        sigma: (6,) median of the claimed standard deviation of the difference, the root of the sum of both variances;
            NaN where none is claimed.
        claimed: (6,) splits in which both halves claim one.
        covered: (6,) share of the claimed splits whose difference lies within `COVERING_SIGMAS` claimed standard
            deviations; NaN where none is claimed.
    """

    splits: int
    pairs: int
    solved: int
    accepted: int
    hits: int
    rms: NDArray[np.float64]
    largest: NDArray[np.float64]
    sigma: NDArray[np.float64]
    claimed: NDArray[np.int64]
    covered: NDArray[np.float64]


def split(available: int, trial: int) -> tuple[list[int], list[int]]:
    """Two disjoint halves of `available` indices, each ascending; of an odd number one is left out.

    Seeded by the trial, so that trials differ and evaluations repeat.

    Raises:
        ValueError: there are fewer than two.
    """
    if available < 2:
        raise ValueError(f"halves need at least two frames, got {available}")
    order = np.random.default_rng([SPLIT_SEED, available, trial]).permutation(available).tolist()
    half = available // 2
    return sorted(order[:half]), sorted(order[half : 2 * half])


def compare(outcomes: Sequence[tuple[SolveOutcome, SolveOutcome]], pairs: int, dof: int) -> Halves:
    """What the outcomes of both halves of every split say; `pairs` frames in each, `dof` axes searched."""
    estimates = [(a.trial.estimate, b.trial.estimate) for a, b in outcomes]
    both = [
        (outcome, first.sigma, second.sigma)
        for outcome, (first, second) in zip(outcomes, estimates, strict=True)
        if first is not None and second is not None
    ]
    searched = np.arange(6) < dof
    difference = np.array([se3.difference(a.T_camera_lidar, b.T_camera_lidar) for (a, b), _, _ in both]).reshape(-1, 6)
    sigma = np.array([np.hypot(first, second) for _, first, second in both]).reshape(-1, 6)
    claims = np.isfinite(sigma) & searched
    covered = claims & (np.abs(difference) <= COVERING_SIGMAS * sigma)
    counts = claims.sum(axis=0)
    some = len(both) > 0
    unknown = np.full(6, np.nan)
    return Halves(
        splits=len(outcomes),
        pairs=pairs,
        solved=len(both),
        accepted=sum(a.accepted and b.accepted for (a, b), _, _ in both),
        hits=sum(a.hit and b.hit for (a, b), _, _ in both),
        rms=np.where(searched, np.sqrt((difference**2).mean(axis=0)), np.nan) if some else unknown,
        largest=np.where(searched, np.abs(difference).max(axis=0), np.nan) if some else unknown,
        sigma=np.array(
            [np.median(column[of]) if of.any() else np.nan for column, of in zip(sigma.T, claims.T, strict=True)]
        ),
        claimed=counts,
        covered=np.where(counts > 0, covered.sum(axis=0) / np.maximum(counts, 1), np.nan),
    )
