"""Converts the statistics of an evaluation to wire models: degrees instead of radians, null instead of NaN."""

from collections.abc import Sequence
from math import degrees
from typing import Any, cast

import numpy as np

from coec.reports.page_parts import finite_degrees, finite_or_none, finite_values
from coec.schemas.replies import Maybe6
from coec_lab.experiments import evaluation_schema as wire
from coec_lab.experiments import solve_statistics
from coec_lab.experiments.detection import TriedCheck, table
from coec_lab.experiments.solve_statistics import BIN_EDGES, CONFIDENCES, Halves, NormalisedErrors, SolveOutcome


def spread_of(spread: solve_statistics.SpreadStatistics, scale: float = 1.0) -> wire.Spread:
    """The spread of a figure, times `scale`."""
    return wire.Spread(
        median=finite_or_none(scale * spread.median),
        p95=finite_or_none(scale * spread.p95),
        max=finite_or_none(scale * spread.max),
    )


def angle_spread_of(spread_rad: solve_statistics.SpreadStatistics) -> wire.Spread:
    """The spread of an angle, radians, in degrees."""
    return spread_of(spread_rad, degrees(1.0))


def frames_point(frames: int, outcomes: Sequence[SolveOutcome]) -> wire.FramesPoint:
    """Figures of windows of `frames` frames, from at least one outcome."""
    return wire.FramesPoint(frames=frames, subsets=len(outcomes), **_errors_of(outcomes))


def slice_point(length_s: float, slices: Sequence[tuple[int, Sequence[SolveOutcome]]]) -> wire.SlicePoint:
    """Figures of slices of one length, each given as its frames and outcomes; at least one outcome in all."""
    outcomes = [outcome for _, of_slice in slices for outcome in of_slice]
    pairs = float(np.median([frames for frames, _ in slices]))
    return wire.SlicePoint(
        length_s=length_s, slices=len(slices), pairs=pairs, solves=len(outcomes), **_errors_of(outcomes)
    )


def _errors_of(outcomes: Sequence[SolveOutcome]) -> dict[str, Any]:
    """Share of hits, errors of hits and misses alike, and the standard deviation that the solves claim, by the names
    that the points have for them."""
    return {
        "hit_rate": sum(outcome.hit for outcome in outcomes) / len(outcomes),
        "rotation_deg": angle_spread_of(solve_statistics.spread(outcome.rotation_rad for outcome in outcomes)),
        "translation_m": spread_of(solve_statistics.spread(outcome.translation_m for outcome in outcomes)),
        "sigma_deg": finite_or_none(degrees(solve_statistics.claimed_rotation_rad(outcomes))),
    }


def halves_of(halves: Halves) -> wire.HalvesReport:
    """Differences between halves."""
    return wire.HalvesReport(
        splits=halves.splits,
        pairs=halves.pairs,
        solved=halves.solved,
        accepted=halves.accepted,
        hits=halves.hits,
        rms=finite_degrees(halves.rms),
        largest=finite_degrees(halves.largest),
        sigma=finite_degrees(halves.sigma),
        claimed=cast("wire.Counts6", tuple(int(count) for count in halves.claimed)),
        covered=cast("Maybe6", tuple(finite_values(halves.covered))),
    )


def detection_of(tried: Sequence[TriedCheck], splits: int, pairs: int) -> wire.DetectionReport:
    """The checks of `try_detection` over `splits` splits of `pairs` pairs, counted by move."""
    return wire.DetectionReport(splits=splits, pairs=pairs, moves=table(tried))


def normalised_of(against: str, errors: NormalisedErrors) -> wire.NormalisedErrorsReport:
    """Normalised errors, relative to what `against` names."""
    within = [cast("Maybe6", tuple(finite_values(row))) for row in errors.coverage]
    low, high = errors.nees_bounds
    return wire.NormalisedErrorsReport(
        against=against,
        judged=errors.judged,
        refused=errors.refused,
        independent=errors.independent,
        rms=finite_degrees(errors.rms),
        largest=finite_degrees(errors.largest),
        sigma=finite_degrees(errors.sigma),
        sigma_over_rms=cast("Maybe6", tuple(finite_values(errors.sigma_over_rms))),
        within_1_sigma=within[0],
        within_2_sigma=within[1],
        within_3_sigma=within[2],
        bin_edges=BIN_EDGES,
        histogram=tuple(tuple(int(count) for count in row) for row in errors.histogram),
        confidences=CONFIDENCES,
        reliability=tuple(tuple(finite_values(column)) for column in errors.reliability.T),
        nees=finite_or_none(errors.nees),
        nees_low=finite_or_none(low),
        nees_high=finite_or_none(high),
    )
