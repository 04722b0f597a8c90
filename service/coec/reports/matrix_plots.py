"""The picture of `coec sim matrix`: errors in units of the claimed sigmas."""

from __future__ import annotations

from math import erf, sqrt

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coec.evaluation.matrix import normalised_errors
from coec.reports.curves import AXIS_TITLES
from coec.reports.plots import png
from coec.schemas.matrix import MatrixReport, SolveStatistics

ERROR_REACH = 6.0
"""Errors beyond so many sigmas are drawn at the rim."""
ERROR_BINS = 24
SIGMA_GRID = np.linspace(0.0, ERROR_REACH, 121)


def matrix_errors(report: MatrixReport) -> bytes:
    """A row of panels per number of degrees of freedom, from its accepted windows: for each axis a histogram of errors
    over sigmas beside the normal distribution that they should follow; last, the share of errors by sigmas."""
    shown = [solves for solves in report.solves if solves.accepted] or list(report.solves)
    figure = Figure(figsize=(3.3 * 7, 3.4 * max(len(shown), 1)), layout="constrained")
    figure.suptitle("error over claimed sigma, accepted windows; grey: as it should be")
    panels = figure.subplots(max(len(shown), 1), 7, squeeze=False)
    for row, solves in zip(panels, shown, strict=False):
        _plot_solves(row, report, solves)
    return png(figure)


def _plot_solves(
    row: np.ndarray[tuple[int], np.dtype[np.object_]], report: MatrixReport, solves: SolveStatistics
) -> None:
    coverage: Axes = row[6]
    should = np.array([_within_normal(sigmas) for sigmas in SIGMA_GRID])
    coverage.plot(SIGMA_GRID, 100.0 * should, color="grey", linewidth=2.5)
    for axis in range(6):
        panel: Axes = row[axis]
        if axis >= solves.dof:
            panel.set_axis_off()
            continue
        windows = [window for drive in report.rows for window in drive.windows.get("3" if solves.dof == 3 else "6", ())]
        errors = np.array(normalised_errors(axis, [window for window in windows if window.accepted]))
        edges = np.linspace(-ERROR_REACH, ERROR_REACH, ERROR_BINS + 1)
        panel.hist(np.clip(errors, -ERROR_REACH, ERROR_REACH), bins=edges.tolist())
        middle = np.linspace(-ERROR_REACH, ERROR_REACH, 200)
        normal = np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi)
        panel.plot(middle, len(errors) * (edges[1] - edges[0]) * normal, color="grey", linewidth=2.5)
        panel.set_title(f"{solves.dof} dof, {AXIS_TITLES[axis]}, n = {len(errors)}", fontsize="medium")
        if len(errors):
            share = (np.abs(errors)[:, None] <= SIGMA_GRID).mean(axis=0)
            coverage.plot(SIGMA_GRID, 100.0 * share, linewidth=1.2, label=AXIS_TITLES[axis])
    coverage.set_title("share within so many sigmas, %", fontsize="medium")
    coverage.grid(alpha=0.3)
    if coverage.get_legend_handles_labels()[0]:
        coverage.legend(fontsize="small")


def _within_normal(sigmas: float) -> float:
    return erf(sigmas / sqrt(2.0))
