"""Statistics of solves of a window: how well an estimator finds a known pose again from many starts (METHOD, section
2), whether its errors follow the uncertainty that it claims, and whether two halves of one recording agree.

Rotation and translation errors, verdicts and efforts are taken over all starts, so that no failure is hidden. Bias and
spread per axis are taken over the hits alone: a solve that ended in another basin contains no information on the width
of the true one, and one such solve at 20 degrees would outweigh 199 good ones. The hit rate and the tails show how many
misses there are and how far off.

The two halves share no frame and no start. So their results differ only by the noise of the estimator, and this noise
must be as large as the standard deviations that the results claim.

An error e with the claimed covariance C gives two figures: per axis e_i / √C_ii, of which 68, 95 and 99.7 % lie within
1, 2 and 3 if the claim holds and errors are normal; and over all axes the normalised estimation error squared eᵀ·C⁻¹·e
(NEES), whose mean per axis is 1 (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and
navigation", 2001, section 5.4).
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import radians
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import chi2_quantile
from coec.calibration.types import Decision, Estimate, Matrix4
from coec.geometry import se3
from coec_lab.experiments.evaluation_schema import VerdictCounts

HIT_RAD, HIT_M = radians(0.5), 0.20
"""A hit ends nearer than this to the reference (WACV 2024); the translation counts only where it was searched."""

NOT_SOLVED = "not_solved"
"""Stop reason of a start that gave no estimate."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One solve: its start (4, 4), its estimate (None: no calibration could be computed), and its seconds."""

    start: Matrix4
    estimate: Estimate | None
    solve_s: float


@dataclass(frozen=True, slots=True, eq=False)
class SolveOutcome:
    """A trial against the reference.

    Attributes:
        T_camera_lidar: (4, 4) where it ended; at its start if there is no estimate.
        error: (6,) ξ from the reference to the end: rotation vector (rad) and translation (m) about the camera axes.
        rotation_rad: the angle of the rotation error.
        translation_m: the length of the translation error.
        excess: the larger of the errors that count, over its limit: below 1 is a hit.
        accepted: whether the verdict accepted it.
    """

    trial: Trial
    T_camera_lidar: Matrix4
    error: NDArray[np.float64]
    rotation_rad: float
    translation_m: float
    excess: float
    accepted: bool

    @property
    def hit(self) -> bool:
        """Near enough to the reference, see `HIT_RAD`."""
        return self.excess < 1.0


@dataclass(frozen=True, slots=True)
class SpreadStatistics:
    """Spread of a figure over the starts. `p95` interpolates linearly between the two nearest sorted values."""

    median: float
    p95: float
    max: float


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Figures of all outcomes of an evaluation.

    Attributes:
        starts, hits: how many.
        rotation_rad, translation_m: errors of all starts.
        median: (6,) median error of all starts, hits or not (rad, m): where most of them went.
        bias: (6,) mean error of the hits (rad, m): what all starts have in common; NaN without a hit.
        std: (6,) sample standard deviation of the hits about the bias: what depends on the start; NaN below two hits.
        rms: (6,) root mean square error of the hits; NaN without a hit.
        sigma: (6,) median over the hits of the standard deviation that the estimates claim; NaN where they claim none.
        solve_s: seconds per solve, all starts.
        evaluations: of the objective per solve, of the starts with an estimate.
        verdicts: starts by decision and truth.
        stop_reasons: why searches ended, by name.
    """

    starts: int
    hits: int
    rotation_rad: SpreadStatistics
    translation_m: SpreadStatistics
    median: NDArray[np.float64]
    bias: NDArray[np.float64]
    std: NDArray[np.float64]
    rms: NDArray[np.float64]
    sigma: NDArray[np.float64]
    solve_s: SpreadStatistics
    evaluations: SpreadStatistics
    verdicts: VerdictCounts
    stop_reasons: dict[str, int]

    @property
    def hit_rate(self) -> float:
        """Share of the starts that hit."""
        return self.hits / self.starts

    @property
    def classified_correctly(self) -> float:
        """Share of the starts whose verdict, accepted or failed, agrees with hit or miss."""
        return (self.verdicts.accepted_hits + self.verdicts.failed_misses) / self.starts


def score(trial: Trial, reference: Matrix4, dof: int) -> SolveOutcome:
    """The trial against the reference (4, 4); with 6 degrees of freedom a hit needs the translation too."""
    estimate = trial.estimate
    end_pose = trial.start if estimate is None else estimate.optimum.T_camera_lidar
    error = se3.difference(end_pose, reference)
    rotation_rad, translation_m = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    return SolveOutcome(
        trial=trial,
        T_camera_lidar=end_pose,
        error=error,
        rotation_rad=rotation_rad,
        translation_m=translation_m,
        excess=max(rotation_rad / HIT_RAD, translation_m / HIT_M if dof == 6 else 0.0),
        accepted=estimate is not None and estimate.verdict.decision is Decision.ACCEPTED,
    )


def summarise(outcomes: Sequence[SolveOutcome]) -> Statistics:
    """The statistics of at least one outcome.

    Raises:
        ValueError: there is none.
    """
    if not outcomes:
        raise ValueError("an evaluation needs at least one start")
    hits = [outcome for outcome in outcomes if outcome.hit]
    errors = np.array([outcome.error for outcome in hits]).reshape(-1, 6)
    estimates = [outcome.trial.estimate for outcome in outcomes if outcome.trial.estimate is not None]
    verdicts = Counter((outcome.accepted, outcome.hit) for outcome in outcomes)
    return Statistics(
        starts=len(outcomes),
        hits=len(hits),
        rotation_rad=spread(outcome.rotation_rad for outcome in outcomes),
        translation_m=spread(outcome.translation_m for outcome in outcomes),
        median=np.median([outcome.error for outcome in outcomes], axis=0),
        bias=errors.mean(axis=0) if hits else _unknown(),
        std=errors.std(axis=0, ddof=1) if len(hits) > 1 else _unknown(),
        rms=np.sqrt((errors**2).mean(axis=0)) if hits else _unknown(),
        sigma=_claimed(hits),
        solve_s=spread(outcome.trial.solve_s for outcome in outcomes),
        evaluations=spread(float(estimate.optimum.evaluations) for estimate in estimates),
        verdicts=VerdictCounts(
            accepted_hits=verdicts[True, True],
            accepted_misses=verdicts[True, False],
            failed_hits=verdicts[False, True],
            failed_misses=verdicts[False, False],
        ),
        stop_reasons=dict(sorted(Counter(map(stop_reason, outcomes)).items())),
    )


def stop_reason(outcome: SolveOutcome) -> str:
    """Why the search of an outcome ended."""
    estimate = outcome.trial.estimate
    return NOT_SOLVED if estimate is None else estimate.optimum.stop_reason.value


def spread(figures: Iterable[float]) -> SpreadStatistics:
    """Median, 95th percentile and maximum; NaN of none."""
    values = np.fromiter(figures, dtype=np.float64)
    if not len(values):
        return SpreadStatistics(np.nan, np.nan, np.nan)
    median, p95, largest = np.quantile(values, [0.5, 0.95, 1.0])
    return SpreadStatistics(float(median), float(p95), float(largest))


def worst(outcomes: Sequence[SolveOutcome]) -> int:
    """Index of the outcome furthest from the reference, in units of the limits of a hit."""
    return max(range(len(outcomes)), key=lambda index: outcomes[index].excess)


def _claimed(hits: Sequence[SolveOutcome]) -> NDArray[np.float64]:
    """Median claim per axis, over the hits with a claim."""
    claims = np.array([hit.trial.estimate.sigma for hit in hits if hit.trial.estimate is not None]).reshape(-1, 6)
    known = [column[np.isfinite(column)] for column in claims.T]
    return np.array([np.median(column) if len(column) else np.nan for column in known])


def claimed_rotation_rad(outcomes: Sequence[SolveOutcome]) -> float:
    """Median claimed standard deviation of the rotation, over the outcomes with a claim."""
    sigmas = [outcome.trial.estimate.sigma[:3] for outcome in outcomes if outcome.trial.estimate is not None]
    claims = [float(np.linalg.norm(sigma)) for sigma in sigmas if np.isfinite(sigma).all()]
    return float(np.median(claims)) if claims else float("nan")


def _unknown() -> NDArray[np.float64]:
    return np.full(6, np.nan)


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
