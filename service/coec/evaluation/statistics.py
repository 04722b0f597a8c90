"""How well an estimator finds a known pose again: statistics over solves from many starts on one window.

The figures of METHOD, section 2. Rotation and translation errors, verdicts and efforts are taken over all starts, so
that no failure is hidden. Bias and spread per axis are taken over the hits alone: a solve that ended in another basin
says nothing about the width of the true one, and one such solve at 20 degrees would outweigh 199 good ones. The hit
rate and the tails show how many misses there are and how far off.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Decision, Estimate, Matrix4
from coec.geometry import se3

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


@dataclass(frozen=True, slots=True)
class Verdicts:
    """Starts by decision and truth. An accepted miss is the dangerous one: a wrong pose that would be served."""

    accepted_hits: int
    accepted_misses: int
    failed_hits: int
    failed_misses: int


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
        verdicts: see `Verdicts`.
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
    verdicts: Verdicts
    stop_reasons: dict[str, int]

    @property
    def hit_rate(self) -> float:
        """Share of the starts that hit."""
        return self.hits / self.starts

    @property
    def classified_correctly(self) -> float:
        """Share of the starts whose verdict, accepted or failed, agrees with hit or miss."""
        return (self.verdicts.accepted_hits + self.verdicts.failed_misses) / self.starts


@dataclass(frozen=True, slots=True)
class FrameCountStatistics:
    """Errors over several subsets of one number of frames, hits and misses alike.

    `sigma_rad` is the standard deviation of the rotation that the solves claim (median; NaN where none does): the root
    of the sum of the variances about the three axes, to compare with the errors.
    """

    frames: int
    subsets: int
    hit_rate: float
    rotation_rad: SpreadStatistics
    translation_m: SpreadStatistics
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class SliceStatistics:
    """Errors over several slices of one length in seconds, hits and misses alike; `frames` is the median per slice."""

    length_s: float
    slices: int
    frames: float
    solves: int
    hit_rate: float
    rotation_rad: SpreadStatistics
    translation_m: SpreadStatistics
    sigma_rad: float


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
        verdicts=Verdicts(
            accepted_hits=verdicts[True, True],
            accepted_misses=verdicts[True, False],
            failed_hits=verdicts[False, True],
            failed_misses=verdicts[False, False],
        ),
        stop_reasons=dict(sorted(Counter(map(stop_reason, outcomes)).items())),
    )


def frames_point(frames: int, outcomes: Sequence[SolveOutcome]) -> FrameCountStatistics:
    """Figures of windows of `frames` frames, from at least one outcome."""
    return FrameCountStatistics(
        frames=frames,
        subsets=len(outcomes),
        hit_rate=sum(outcome.hit for outcome in outcomes) / len(outcomes),
        rotation_rad=spread(outcome.rotation_rad for outcome in outcomes),
        translation_m=spread(outcome.translation_m for outcome in outcomes),
        sigma_rad=_claimed_rotation_rad(outcomes),
    )


def slice_point(length_s: float, slices: Sequence[tuple[int, Sequence[SolveOutcome]]]) -> SliceStatistics:
    """Figures of slices of one length, each given as its frames and outcomes; at least one outcome in all."""
    outcomes = [outcome for _, of_slice in slices for outcome in of_slice]
    return SliceStatistics(
        length_s=length_s,
        slices=len(slices),
        frames=float(np.median([frames for frames, _ in slices])),
        solves=len(outcomes),
        hit_rate=sum(outcome.hit for outcome in outcomes) / len(outcomes),
        rotation_rad=spread(outcome.rotation_rad for outcome in outcomes),
        translation_m=spread(outcome.translation_m for outcome in outcomes),
        sigma_rad=_claimed_rotation_rad(outcomes),
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


def _claimed_rotation_rad(outcomes: Sequence[SolveOutcome]) -> float:
    """Median claimed standard deviation of the rotation, over the outcomes with a claim."""
    sigmas = [outcome.trial.estimate.sigma[:3] for outcome in outcomes if outcome.trial.estimate is not None]
    claims = [float(np.linalg.norm(sigma)) for sigma in sigmas if np.isfinite(sigma).all()]
    return float(np.median(claims)) if claims else float("nan")


def _unknown() -> NDArray[np.float64]:
    return np.full(6, np.nan)
