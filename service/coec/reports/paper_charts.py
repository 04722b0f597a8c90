"""Plots of the page of `coec paper`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import degrees

import numpy as np

from coec.calibration.commissioning.equation_2 import PaperLimits
from coec.evaluation.paper import MOVES_DEG, FailureFigures
from coec.evaluation.statistics import SolveOutcome
from coec.reports.bullseye import HIT_DEG
from coec.reports.page import Chart, Charts, Limit, Mark, Series
from coec.reports.page.words import number, significant

FIGURES = {
    "mi": "Mutual information, nats",
    "f1": "Largest slope f′, nats per rad",
    "f2": "Least peakedness f″, nats per rad²",
}

BINS = 24

ROTATIONS = {2: "Roll", 0: "Pitch", 1: "Yaw"}
"""Names by axis, in the order of the paper."""


def failure_figures(figures: Sequence[FailureFigures], limits: PaperLimits) -> Charts:
    """The three figures at the right pose and at wrong ones, with the limits between them."""
    at = {"mi": limits.min_mi, "f1": limits.max_f1, "f2": limits.min_f2}
    return Charts(
        tuple(_failure_histogram(name, title, figures, at[name]) for name, title in FIGURES.items()), small=True
    )


def drive(runs: Mapping[str, Sequence[tuple[float, SolveOutcome]]]) -> Charts:
    """Errors of roll, pitch and yaw over sensor time (seconds), for several named sets of starts."""
    return Charts(tuple(_along(axis, name, runs) for axis, name in ROTATIONS.items()))


def _failure_histogram(name: str, title: str, figures: Sequence[FailureFigures], limit: float) -> Chart:
    values = {moved: [getattr(each, name) for each in figures if each.moved_deg == moved] for moved in MOVES_DEG}
    edges = np.histogram_bin_edges(np.concatenate(list(values.values())), BINS)
    series = []
    for moved, of in values.items():
        share = (np.histogram(of, edges)[0] / max(len(of), 1)).tolist()
        steps = [*zip(edges.tolist(), share, strict=False), (float(edges[-1]), share[-1])]
        series.append(Series("right" if moved == 0.0 else f"{moved:g}° off", steps, "steps"))
    description = (
        f"share of checks by this figure, at the right extrinsic and beside it; the limit is {significant(limit)}"
    )
    marks = (Mark(limit, f"limit {significant(limit)}"),)
    return Chart(f"{title}, share of checks", "", "", tuple(series), description, marks=marks, from_zero=True)


def _along(axis: int, name: str, runs: Mapping[str, Sequence[tuple[float, SolveOutcome]]]) -> Chart:
    series, summaries = [], []
    for of, outcomes in runs.items():
        errors_deg = [degrees(outcome.error[axis]) for _, outcome in outcomes]
        mean_std = f"{number(float(np.mean(errors_deg)), sign=True)} ± {number(float(np.std(errors_deg)))}°"
        points = [(second, error) for (second, _), error in zip(outcomes, errors_deg, strict=True)]
        series.append(Series(f"{of}: {mean_std}", points, "points"))
        summaries.append(f"{of} {mean_std}")
    limits = (Limit(-HIT_DEG, f"a hit: ±{HIT_DEG:g}°"), Limit(HIT_DEG, f"a hit: ±{HIT_DEG:g}°"))
    return Chart(
        f"{name} error of every run", "middle of the slice, s after the first frame", "error, °", tuple(series),
        "; ".join(summaries), limits=limits,
    )  # fmt: skip
