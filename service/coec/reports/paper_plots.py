"""Figures of the published experiments, as PNG bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import degrees

import numpy as np
from matplotlib.figure import Figure

from coec.calibration.commissioning.equation_2 import PaperLimits
from coec.evaluation.paper import MOVES_DEG, FailureFigures
from coec.evaluation.statistics import HIT_RAD, SolveOutcome
from coec.reports.plots import png

MOVE_COLOURS = ("tab:green", "tab:orange", "tab:red")

PANELS = (
    ("mi", "mutual information, nats"),
    ("f1", "largest slope f', nats per rad"),
    ("f2", "least peakedness f'', nats per rad²"),
)

FAILURE_BINS = 30

ROTATIONS = ((2, "roll"), (0, "pitch"), (1, "yaw"))
"""Axis and name, in the order of the paper."""


def failure_metrics(figures: Sequence[FailureFigures], limits: PaperLimits, title: str) -> bytes:
    """The three figures at the right pose and at wrong ones, with the limits between them."""
    figure = Figure(figsize=(14.0, 4.6), layout="constrained")
    figure.suptitle(title)
    for axes, (name, label) in zip(figure.subplots(1, 3), PANELS, strict=True):
        values = {moved: [getattr(f, name) for f in figures if f.moved_deg == moved] for moved in MOVES_DEG}
        edges = np.histogram_bin_edges(np.concatenate(list(values.values())), FAILURE_BINS)
        for colour, (moved, of) in zip(MOVE_COLOURS, values.items(), strict=True):
            what = "right" if moved == 0.0 else f"{moved:g}° off"
            axes.hist(of, edges, color=colour, alpha=0.55, label=what)
        limit = {"mi": limits.min_mi, "f1": limits.max_f1, "f2": limits.min_f2}[name]
        axes.axvline(limit, color="black", linestyle="--", label=f"limit {limit:.3g}")
        axes.set_xlabel(label)
        axes.legend(fontsize="small")
        axes.grid(alpha=0.3)
    return png(figure)


def drive(runs: Mapping[str, Sequence[tuple[float, SolveOutcome]]], title: str) -> bytes:
    """Errors of roll, pitch and yaw over sensor time (seconds), for several named sets of starts."""
    figure = Figure(figsize=(11.0, 8.0), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(3, 1, sharex=True)
    for axes, (axis, name) in zip(panels, ROTATIONS, strict=True):
        for label, outcomes in runs.items():
            seconds = [second for second, _ in outcomes]
            errors = np.degrees([outcome.error[axis] for _, outcome in outcomes])
            axes.plot(
                seconds, errors, "o", markersize=4, alpha=0.6,
                label=f"{label}: {errors.mean():+.3f} ± {errors.std():.3f}°",
            )  # fmt: skip
        axes.axhspan(-degrees(HIT_RAD), degrees(HIT_RAD), color="tab:green", alpha=0.08)
        axes.axhline(0.0, color="grey", linewidth=0.8)
        axes.set_ylabel(f"{name} error, deg")
        axes.legend(fontsize="small", loc="upper right")
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("middle of the slice, s after the first frame")
    return png(figure)
