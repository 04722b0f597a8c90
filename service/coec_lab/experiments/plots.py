"""Plots of experiments as PNG bytes, by matplotlib: where solves started and ended, objectives along the axes, errors
against the amount of data, normalised errors, the charts of a page, the quality of a depth network. Drawn in memory:
no display, no window, no global state of matplotlib.

Colours of errors run from dark (good) to bright (bad) on a logarithmic scale about the limit of a hit.
"""

import io
from collections.abc import Mapping, Sequence
from math import degrees, erf, pi, sqrt
from statistics import NormalDist

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.projections.polar import PolarAxes
from numpy.typing import NDArray

from coec.reports.charts import Chart
from coec.reports.console import AXIS_NAMES
from coec.reports.page import Charts
from coec_lab.experiments import evaluation_charts, solve_statistics
from coec_lab.experiments.depth_quality import DepthQuality, Pairing
from coec_lab.experiments.evaluation_schema import FramesPoint, SlicePoint, Spread
from coec_lab.experiments.matrix_statistics import normalised_errors
from coec_lab.experiments.objective_scans import Scan, Views
from coec_lab.experiments.simulation_schemas import MatrixReport, SolveStatistics

DPI = 110

ERROR_RANGE_DEG = (0.02, 20.0)
"""Ends of the colour scale: the scatter of a good search, and an error that is lost altogether."""

TICKS = tuple(step * 10.0**decade for decade in range(-4, 3) for step in (1.0, 2.0, 3.0, 5.0, 7.0))
"""Ticks of logarithmic axes."""

COLOURS = "plasma"


def bullseye(
    outcomes: Sequence[solve_statistics.SolveOutcome], directions: Mapping[str, NDArray[np.float64]], title: str
) -> bytes:
    """Left, for each of `directions` (title, (n, 3) unit vectors in camera axes): the start directions, coloured by
    where their solves ended. Right: where they ended, as seen from the reference.

    `bullseye.start_places` says how the sphere of directions is flattened.
    """
    figure = titled(title, 6.2 * (len(directions) + 1), 7.0)
    colours = LogNorm(*ERROR_RANGE_DEG, clip=True)
    for column, (name, unit) in enumerate(directions.items()):
        _plot_starts(_polar(figure, 1, len(directions) + 1, column), name, unit, outcomes, colours)
    axes = _polar(figure, 1, len(directions) + 1, len(directions))
    _plot_target(axes, outcomes, colours, evaluation_charts.rim_of(outcomes))
    _scale(figure, [axes], colours)
    figure.legend(handles=_legend(outcomes), loc="outside lower center", ncols=4, frameon=False)
    return png(figure)


def compared(
    methods: Mapping[str, Sequence[solve_statistics.SolveOutcome]], directions: NDArray[np.float64], title: str
) -> bytes:
    """A column per method: above, the start directions ((n, 3) unit vectors in camera axes) coloured by where their
    solves ended; below, where they ended. The targets have one radius, that of the worst method."""
    figure = titled(title, 5.6 * len(methods) + 1.0, 11.5)
    colours = LogNorm(*ERROR_RANGE_DEG, clip=True)
    rim_deg = max(evaluation_charts.rim_of(outcomes) for outcomes in methods.values())
    panels = []
    for column, (name, outcomes) in enumerate(methods.items()):
        hits = sum(outcome.hit for outcome in outcomes)
        above, below = _polar(figure, 2, len(methods), column), _polar(figure, 2, len(methods), len(methods) + column)
        _plot_starts(above, f"{name}: {hits} of {len(outcomes)} hit", directions, outcomes, colours)
        _plot_target(below, outcomes, colours, rim_deg)
        panels += [above, below]
    _scale(figure, panels, colours)
    every = [outcome for outcomes in methods.values() for outcome in outcomes]
    figure.legend(handles=_legend(every), loc="outside lower center", ncols=4, frameon=False)
    return png(figure)


def _plot_starts(
    axes: PolarAxes,
    name: str,
    unit: NDArray[np.float64],
    outcomes: Sequence[solve_statistics.SolveOutcome],
    colours: LogNorm,
) -> None:
    _marks(axes, evaluation_charts.start_places(unit), outcomes, colours)
    rings, names = (
        [evaluation_charts.latitude_radius(ring) for ring in evaluation_charts.LATITUDES_DEG],
        [f"{ring:g}°" for ring in evaluation_charts.LATITUDES_DEG],
    )
    axes.set_rgrids(rings, names, angle=100.0, color="grey", fontsize="small")
    axes.set_ylim(0.0, 1.05)
    axes.set_thetagrids([0.0, 90.0, 180.0, 270.0], ["+x", "+y", "-x", "-y"])
    axes.set_title(f"{name}\ncentre +z, rim -z", fontsize="medium")


def _scale(figure: Figure, panels: Sequence[PolarAxes], colours: LogNorm) -> None:
    scale = figure.colorbar(
        ScalarMappable(colours, COLOURS), ax=panels, shrink=0.7, pad=0.1, label="final rotation error, deg"
    )
    ticks = [tick for tick in TICKS if ERROR_RANGE_DEG[0] <= tick <= ERROR_RANGE_DEG[1]]
    scale.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])


def _plot_target(
    axes: PolarAxes, outcomes: Sequence[solve_statistics.SolveOutcome], colours: LogNorm, rim_deg: float
) -> None:
    _marks(axes, evaluation_charts.end_places(outcomes, rim_deg), outcomes, colours)
    axes.plot(
        np.linspace(0.0, 2.0 * pi, 181), np.full(181, evaluation_charts.HIT_DEG), color="tab:green", linewidth=1.2
    )
    rings = [0.25 * rim_deg, 0.5 * rim_deg, 0.75 * rim_deg, rim_deg]
    axes.set_rgrids(rings, [f"{ring:g}°" for ring in rings], angle=100.0, color="grey", fontsize="small")
    axes.set_ylim(0.0, 1.05 * rim_deg)
    axes.set_thetagrids([0.0, 90.0, 180.0, 270.0], ["+yaw", "+pitch", "-yaw", "-pitch"])
    axes.set_title(
        f"where they ended\nradius: rotation error; rim: {rim_deg:g}° and more; green: a hit", fontsize="medium"
    )


def _marks(
    axes: PolarAxes,
    places: evaluation_charts.Places,
    outcomes: Sequence[solve_statistics.SolveOutcome],
    colours: LogNorm,
) -> None:
    angle, radius = places.T
    final_deg = np.degrees([outcome.rotation_rad for outcome in outcomes])
    for hit in (True, False):
        for accepted in (True, False):
            of = np.array([outcome.hit is hit and outcome.accepted is accepted for outcome in outcomes])
            if of.any():
                axes.scatter(
                    angle[of], radius[of], c=final_deg[of], cmap=COLOURS, norm=colours, zorder=3, clip_on=False,
                    marker=_marker(hit), s=46.0 if hit else 90.0, edgecolors=_edge(accepted), linewidths=1.3,
                )  # fmt: skip


def _legend(outcomes: Sequence[solve_statistics.SolveOutcome]) -> list[Line2D]:
    return [
        Line2D(
            [], [], linestyle="", marker=_marker(hit), markersize=7 if hit else 9, markerfacecolor="lightgrey",
            markeredgecolor=_edge(accepted), markeredgewidth=1.3,
            label=f"{'accepted' if accepted else 'failed'} {'hit' if hit else 'miss'}: "
            f"{sum(outcome.hit is hit and outcome.accepted is accepted for outcome in outcomes)}",
        )
        for hit in (True, False)
        for accepted in (True, False)
    ]  # fmt: skip


def _marker(hit: bool) -> str:
    return "o" if hit else "X"


def _edge(accepted: bool) -> str:
    """Accepted has a dark edge, failed a red one."""
    return "black" if accepted else "red"


def _polar(figure: Figure, rows: int, columns: int, index: int) -> PolarAxes:
    axes = figure.add_subplot(rows, columns, index + 1, projection="polar")
    if not isinstance(axes, PolarAxes):
        raise TypeError(f"matplotlib made {type(axes).__name__} of a polar projection")
    return axes


def titled(title: str, width: float, height: float) -> Figure:
    """An empty figure, inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title)
    return figure


def _grid_and_legend(axes: Axes) -> None:
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def png(figure: Figure) -> bytes:
    """The figure as a file; equal figures give equal bytes."""
    stream = io.BytesIO()
    # Without the software's name and version, which would differ.
    figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
    return stream.getvalue()


def landscape(curves: Mapping[str, Views], title: str) -> bytes:
    """Each named objective along its axes about the reference, a column per axis: rotations from afar and from near,
    and below them translations, where they were scanned.

    Scores are scaled: 0 is the lowest and 1 the highest value of an objective from afar, over all rotations or all
    translations.
    """
    axes_scanned = len(next(iter(curves.values())).wide)
    groups = [range(3), range(3, 6)] if axes_scanned == 6 else [range(3)]
    figure = titled(title, 15.0, 3.9 * 2 * len(groups))
    panels = figure.subplots(2 * len(groups), 3, sharey="row", squeeze=False)
    for row, group in enumerate(groups):
        for name, views in curves.items():
            every = np.concatenate([views.wide[axis].scores for axis in group])
            lowest, height = float(every.min()), float(np.ptp(every)) or 1.0
            for column, axis in enumerate(group):
                _plot_scan(panels[2 * row, column], name, views.wide[axis], lowest, height)
                _plot_scan(panels[2 * row + 1, column], name, views.narrow[axis], lowest, height)
        panels[2 * row, 0].set_ylabel("score, lowest 0 to highest 1")
        panels[2 * row + 1, 0].set_ylabel("same scale, near the reference")
    for axes in panels.flat:
        axes.axvline(0.0, color="grey", linewidth=0.8, linestyle="--")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", loc="best", framealpha=0.6)
    return png(figure)


def error_against_frames(points: Sequence[FramesPoint], with_translation: bool, title: str) -> bytes:
    """Median and 95th percentile of the error over subsets, and the σ that the solves claim, by the number of frames;
    below, the share of hits."""
    frames = [float(point.frames) for point in points]
    return _errors(
        points, frames, [f"{point.frames}" for point in points], "frames in the window", with_translation, title
    )


def error_against_slice(points: Sequence[SlicePoint], with_translation: bool, title: str) -> bytes:
    """Like `error_against_frames`, by the length of the slice, with the number of frames in it."""
    lengths_s = [point.length_s for point in points]
    labels = [f"{point.length_s:.3g} s\n{point.pairs:g} fr." for point in points]
    return _errors(points, lengths_s, labels, "length of the slice and frames in it (median)", with_translation, title)


def _plot_scan(axes: Axes, name: str, scan: Scan, lowest: float, height: float) -> None:
    scale, unit = (degrees(1.0), "deg") if scan.axis < 3 else (1.0, "m")
    scores = (scan.scores - lowest) / height
    best = scan.best_offset * scale
    (line,) = axes.plot(scan.offsets * scale, scores, linewidth=1.3, label=f"{name}, best at {best:+.2f} {unit}")
    axes.plot(best, scores.max(), "o", color=line.get_color(), markersize=4)
    axes.set_xlabel(f"{AXIS_NAMES[scan.axis]}, {unit}")


def _errors(
    points: Sequence[FramesPoint] | Sequence[SlicePoint],
    at: Sequence[float],
    labels: Sequence[str],
    what: str,
    with_translation: bool,
    title: str,
) -> bytes:
    columns = 2 if with_translation else 1
    figure = titled(title, 8.0 * columns, 6.5)
    panels = figure.subplots(2, columns, sharex=True, squeeze=False, height_ratios=(3, 1))
    _plot_errors(
        panels[0, 0],
        at,
        [point.rotation_deg for point in points],
        "rotation error, deg",
        evaluation_charts.HIT_DEG,
    )
    claimed = _known([point.sigma_deg for point in points])
    panels[0, 0].plot(at, claimed, "^:", color="tab:purple", label="σ claimed (root of the three variances), median")
    if with_translation:
        _plot_errors(
            panels[0, 1], at, [point.translation_m for point in points], "translation error, m", solve_statistics.HIT_M
        )
    for upper, lower in zip(panels[0], panels[1], strict=True):
        _tick(upper)
        upper.legend()
        lower.plot(at, [100.0 * point.hit_rate for point in points], "o-", color="tab:green")
        lower.set_ylabel("hits, %")
        lower.set_ylim(-5.0, 105.0)
        lower.set_xscale("log")
        lower.set_xticks(at, labels)
        lower.minorticks_off()
        lower.set_xlabel(what)
        for axes in (upper, lower):
            axes.grid(alpha=0.3, which="both")
    return png(figure)


def _plot_errors(axes: Axes, at: Sequence[float], errors: Sequence[Spread], label: str, limit: float) -> None:
    axes.plot(at, _known([error.p95 for error in errors]), "s--", label="95th percentile")
    axes.plot(at, _known([error.median for error in errors]), "o-", label="median")
    axes.axhline(limit, color="grey", linewidth=0.8, linestyle=":", label=f"limit of a hit, {limit:g}")
    axes.set_yscale("log")
    axes.set_ylabel(label)


def _tick(axes: Axes) -> None:
    """Labels a logarithmic axis with plain numbers."""
    low, high = axes.get_ylim()
    ticks = [tick for tick in TICKS if low <= tick <= high]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def _known(values: Sequence[float | None]) -> NDArray[np.float64]:
    """(n,) the values, NaN where there is none."""
    return np.array(values, dtype=np.float64)


def normalised(by_reference: Mapping[str, solve_statistics.NormalisedErrors], title: str) -> bytes:
    """A row for each, by name: left, errors over claimed standard deviations per axis; right, the share of errors that
    lie in an interval against the share that should, up to 1, 2 and 3 standard deviations.

    Above the diagonal claims are wider than errors; below it they are too narrow.
    """
    figure = titled(title, 14.0, 5.0 * len(by_reference))
    panels = figure.subplots(len(by_reference), 2, squeeze=False)
    for (left, right), (against, errors) in zip(panels, by_reference.items(), strict=True):
        _plot_histogram(left, errors)
        left.set_title(f"against {against}: {errors.judged} accepted, {errors.refused} refused", fontsize="medium")
        _plot_reliability(right, errors)
        low, high = errors.nees_bounds
        right.set_title(f"NEES per axis {errors.nees:.2f}, of true claims {low:.2f} to {high:.2f}", fontsize="medium")
    return png(figure)


def _plot_histogram(axes: Axes, errors: solve_statistics.NormalisedErrors) -> None:
    edges = np.array(solve_statistics.BIN_EDGES)
    normal = NormalDist()
    expected = np.diff([0.0, *(normal.cdf(edge) for edge in edges[1:-1]), 1.0])
    axes.stairs(expected, edges, fill=True, color="lightgrey", label="normal distribution")
    for name, counts in zip(AXIS_NAMES, errors.histogram, strict=True):
        if counts.sum():
            axes.stairs(counts / counts.sum(), edges, linewidth=1.4, label=name)
    axes.set_xlabel("error / claimed σ; the outermost bins hold what lies beyond")
    axes.set_ylabel("share of results")
    _grid_and_legend(axes)


def _plot_reliability(axes: Axes, errors: solve_statistics.NormalisedErrors) -> None:
    beyond = [2.0 * NormalDist().cdf(limit) - 1.0 for limit in solve_statistics.SIGMAS]
    shares = np.array([*solve_statistics.CONFIDENCES, *beyond])
    held = np.concatenate([errors.reliability, errors.coverage])
    order = np.argsort(shares)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="grey", linewidth=0.8, linestyle="--", label="true claims")
    for name, column in zip(AXIS_NAMES, held.T, strict=True):
        if np.isfinite(column).any():
            axes.plot(shares[order], column[order], "o-", markersize=4, linewidth=1.2, label=name)
    for limit, share in zip(solve_statistics.SIGMAS, beyond, strict=True):
        axes.axvline(share, color="lightgrey", linewidth=0.8)
        axes.annotate(f"{limit:g} σ", (share, 0.02), fontsize="small", rotation=90)
    axes.set_xlabel(f"share that should lie within (50 %: {solve_statistics.within(0.5):.2f} σ)")
    axes.set_ylabel("share that does")
    axes.set_xlim(0.0, 1.02)
    axes.set_ylim(0.0, 1.02)
    _grid_and_legend(axes)


ERROR_REACH = 6.0
"""Errors beyond so many sigmas are drawn at the rim."""
ERROR_BINS = 24
SIGMA_GRID = np.linspace(0.0, ERROR_REACH, 121)


def matrix_errors(report: MatrixReport) -> bytes:
    """A row of panels per number of degrees of freedom, from its accepted windows: for each axis a histogram of errors
    over sigmas beside the normal distribution that they should follow; last, the share of errors by sigmas."""
    shown = [solves for solves in report.solves if solves.accepted] or list(report.solves)
    figure = titled(
        "error over claimed sigma, accepted windows; grey: as it should be", 3.3 * 7, 3.4 * max(len(shown), 1)
    )
    panels = figure.subplots(max(len(shown), 1), 7, squeeze=False)
    for row, solves in zip(panels, shown, strict=False):
        _plot_solves(row, report, solves)
    return png(figure)


def _plot_solves(
    row: np.ndarray[tuple[int], np.dtype[np.object_]], report: MatrixReport, solves: SolveStatistics
) -> None:
    coverage: Axes = row[6]
    should = np.array([erf(sigmas / sqrt(2.0)) for sigmas in SIGMA_GRID])
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
        panel.set_title(f"{solves.dof} dof, {AXIS_NAMES[axis]}, n = {len(errors)}", fontsize="medium")
        if len(errors):
            share = (np.abs(errors)[:, None] <= SIGMA_GRID).mean(axis=0)
            coverage.plot(SIGMA_GRID, 100.0 * share, linewidth=1.2, label=AXIS_NAMES[axis])
    coverage.set_title("share within so many sigmas, %", fontsize="medium")
    coverage.grid(alpha=0.3)
    if coverage.get_legend_handles_labels()[0]:
        coverage.legend(fontsize="small")


RESIDUAL_LIMIT = 0.5
"""Residual rank at the ends of the colours: half of all points lie between a point's rank and the one by the map."""


def joint(counts: NDArray[np.int64], title: str) -> bytes:
    """The joint histogram (bins, bins) of the shares of a map and of the ranges. A perfect network fills the diagonal
    alone; one that tells nothing fills the square evenly."""
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    axes = figure.add_subplot()
    shown = axes.imshow(np.maximum(counts, 0.5), norm=LogNorm(), origin="lower", extent=(0, 100, 0, 100))
    figure.colorbar(shown, ax=axes, label="points")
    axes.set_xlabel("rank of the inverse range, % of the points: near is right")
    axes.set_ylabel("rank of the network's output, %: what it takes for near is above")
    axes.set_title(title, fontsize="medium")
    return png(figure)


def curves(quality: DepthQuality, title: str) -> bytes:
    """Mutual information along the three axes about the calibration, the level of unrelated maps, and the optimum."""
    figure = titled(title, 15.0, 4.6)
    panels = figure.subplots(1, 3, sharey=True)
    for axes, scan in zip(panels, quality.scans, strict=True):
        bias_deg, half_deg = degrees(quality.bias[scan.axis]), degrees(quality.half_width[scan.axis])
        axes.plot(np.degrees(scan.offsets), scan.scores, label=f"half-width of the peak {half_deg:.1f} deg")
        axes.axhline(quality.mi_of_unrelated, color="tab:red", linewidth=0.9, linestyle=":", label="unrelated maps")
        axes.axvline(0.0, color="grey", linewidth=0.8, linestyle="--", label="calibration")
        axes.axvline(
            bias_deg, color="tab:green", linewidth=0.9, label=f"optimum of all three axes, {bias_deg:+.2f} deg"
        )
        axes.set_xlabel(f"{AXIS_NAMES[scan.axis]}, deg")
        _grid_and_legend(axes)
    panels[0].set_ylabel("mutual information, nats")
    return png(figure)


def frame(image_bgr: NDArray[np.uint8], values: NDArray[np.float32], pairing: Pairing, title: str) -> bytes:
    """The image (height, width, 3) with the points of the sweep, and the map (h, w) of the same view beside it.

    Red points are nearer to the network than to the LiDAR, blue ones further, pale ones agree.
    """
    height, width = image_bgr.shape[:2]
    wide = width > 1.6 * height
    rows, columns = (2, 1) if wide else (1, 2)
    panel_width = 13.0 if wide else 8.0
    panel_height = panel_width * height / width + 0.5
    figure = titled(title, panel_width * columns + 1.2, panel_height * rows + 0.6)
    panels: Sequence[object] = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    seen, output = panels
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    grey = np.repeat(image_bgr.mean(axis=2, keepdims=True).astype(np.uint8), 3, axis=2)
    seen.imshow(grey, extent=extent)  # type: ignore[attr-defined]
    points = seen.scatter(  # type: ignore[attr-defined]
        pairing.uv_px[:, 0], pairing.uv_px[:, 1], c=pairing.residuals(), s=2.0, cmap="coolwarm",
        vmin=-RESIDUAL_LIMIT, vmax=RESIDUAL_LIMIT, linewidths=0.0,
    )  # fmt: skip
    figure.colorbar(points, ax=seen, label="residual rank: + the network says nearer")  # type: ignore[arg-type]
    shown = output.imshow(values, extent=extent, cmap="magma")  # type: ignore[attr-defined]
    figure.colorbar(shown, ax=output, label="output as it comes")  # type: ignore[arg-type]
    return png(figure)


TONE_COLOURS = {"good": "tab:green", "unsure": "gold", "poor": "orange", "bad": "tab:red", "none": "silver"}
"""Colours of the states behind a curve."""

SHAPES = {"line": "-", "steps": "-", "points": "o", "dotted": ":"}
"""Format of matplotlib for each shape of a series."""


def charts(block: Charts, title: str, columns: int, panel_inches: tuple[float, float]) -> bytes:
    """The charts of a page as one picture, in rows of `columns` panels of one size (width, height)."""
    rows = -(-len(block.items) // columns)
    width, height = panel_inches
    figure = titled(title, width * columns, height * rows)
    for axes, chart in zip(figure.subplots(rows, columns, squeeze=False).flat, block.items, strict=False):
        _plot_chart(axes, chart)
    return png(figure)


def _plot_chart(axes: Axes, chart: Chart) -> None:
    for ground in chart.grounds:
        colour = TONE_COLOURS[ground.tone]
        axes.axvspan(ground.begin, ground.end, color=colour, alpha=0.3, linewidth=0, label=ground.name)
    for series in chart.series:
        x, y = np.array(series.points).reshape(-1, 2).T
        style = "steps-post" if series.shape == "steps" else "default"
        axes.plot(x, y, SHAPES[series.shape], drawstyle=style, markersize=4, alpha=0.7, label=series.name)
    for limit in chart.limits:
        axes.axhline(limit.at, color="grey", linestyle=":", label=limit.name)
    for mark in chart.marks:
        axes.axvline(mark.at, color="black", linestyle="--", linewidth=1.0)
        top = axes.get_xaxis_transform()
        axes.text(mark.at, 0.98, f"{mark.name} ", rotation=90, ha="right", va="top", fontsize="small", transform=top)
    if chart.from_zero:
        axes.set_ylim(bottom=0.0)
    axes.set_title(chart.title, fontsize="medium")
    axes.set_xlabel(chart.x_label)
    axes.set_ylabel(chart.y_label)
    axes.grid(alpha=0.3)
    handles, labels = axes.get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    axes.legend(by_label.values(), by_label.keys(), fontsize="small")
