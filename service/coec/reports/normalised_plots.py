"""Normalised errors, as PNG bytes: their histogram beside the normal distribution, and the reliability of claims."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import NormalDist

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coec.evaluation.normalised_errors import BIN_EDGES, CONFIDENCES, SIGMAS, NormalisedErrors, within
from coec.reports.curves import AXIS_TITLES
from coec.reports.plots import png


def normalised(by_reference: Mapping[str, NormalisedErrors], title: str) -> bytes:
    """A row for each, by name: left, errors over claimed standard deviations per axis; right, the share of errors that
    lie in an interval against the share that should, up to 1, 2 and 3 standard deviations.

    Above the diagonal claims are wider than errors; below it they are too narrow.
    """
    figure = Figure(figsize=(14.0, 5.0 * len(by_reference)), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(len(by_reference), 2, squeeze=False)
    for (left, right), (against, errors) in zip(panels, by_reference.items(), strict=True):
        _plot_histogram(left, errors)
        left.set_title(f"against {against}: {errors.judged} accepted, {errors.refused} refused", fontsize="medium")
        _plot_reliability(right, errors)
        low, high = errors.nees_bounds
        right.set_title(f"NEES per axis {errors.nees:.2f}, of true claims {low:.2f} to {high:.2f}", fontsize="medium")
    return png(figure)


def _plot_histogram(axes: Axes, errors: NormalisedErrors) -> None:
    edges = np.array(BIN_EDGES)
    normal = NormalDist()
    expected = np.diff([0.0, *(normal.cdf(edge) for edge in edges[1:-1]), 1.0])
    axes.stairs(expected, edges, fill=True, color="lightgrey", label="normal distribution")
    for name, counts in zip(AXIS_TITLES, errors.histogram, strict=True):
        if counts.sum():
            axes.stairs(counts / counts.sum(), edges, linewidth=1.4, label=name)
    axes.set_xlabel("error / claimed σ; the outermost bins hold what lies beyond")
    axes.set_ylabel("share of results")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def _plot_reliability(axes: Axes, errors: NormalisedErrors) -> None:
    beyond = [2.0 * NormalDist().cdf(limit) - 1.0 for limit in SIGMAS]
    shares = np.array([*CONFIDENCES, *beyond])
    held = np.concatenate([errors.reliability, errors.coverage])
    order = np.argsort(shares)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="grey", linewidth=0.8, linestyle="--", label="true claims")
    for name, column in zip(AXIS_TITLES, held.T, strict=True):
        if np.isfinite(column).any():
            axes.plot(shares[order], column[order], "o-", markersize=4, linewidth=1.2, label=name)
    for limit, share in zip(SIGMAS, beyond, strict=True):
        axes.axvline(share, color="lightgrey", linewidth=0.8)
        axes.annotate(f"{limit:g} σ", (share, 0.02), fontsize="small", rotation=90)
    axes.set_xlabel(f"share that should lie within (50 %: {within(0.5):.2f} σ)")
    axes.set_ylabel("share that does")
    axes.set_xlim(0.0, 1.02)
    axes.set_ylim(0.0, 1.02)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
