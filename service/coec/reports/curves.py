"""Curves of an evaluation, as PNG bytes: objectives about a pose, and errors against the amount of data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import degrees

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coec.evaluation.profiles import Scan, Views
from coec.evaluation.statistics import HIT_M, FrameCountStatistics, SliceStatistics, SpreadStatistics
from coec.reports.bullseye import HIT_DEG
from coec.reports.plots import TICKS, png

AXIS_TITLES = ("rx pitch", "ry yaw", "rz roll", "tx right", "ty down", "tz forward")


def landscape(curves: Mapping[str, Views], title: str) -> bytes:
    """Each named objective along its axes about the reference, a column per axis: rotations from afar and from near,
    and below them translations, where they were scanned.

    Scores are scaled: 0 is the lowest and 1 the highest value of an objective from afar, over all rotations or all
    translations.
    """
    axes_scanned = len(next(iter(curves.values())).wide)
    groups = [range(3), range(3, 6)] if axes_scanned == 6 else [range(3)]
    figure = Figure(figsize=(15.0, 3.9 * 2 * len(groups)), layout="constrained")
    figure.suptitle(title)
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


def error_against_frames(points: Sequence[FrameCountStatistics], with_translation: bool, title: str) -> bytes:
    """Median and 95th percentile of the error over subsets, and the σ that the solves claim, by the number of frames;
    below, the share of hits."""
    frames = [float(point.frames) for point in points]
    return _errors(
        points, frames, [f"{point.frames}" for point in points], "frames in the window", with_translation, title
    )


def error_against_slice(points: Sequence[SliceStatistics], with_translation: bool, title: str) -> bytes:
    """Like `error_against_frames`, by the length of the slice, with the number of frames in it."""
    lengths_s = [point.length_s for point in points]
    labels = [f"{point.length_s:.3g} s\n{point.frames:g} fr." for point in points]
    return _errors(points, lengths_s, labels, "length of the slice and frames in it (median)", with_translation, title)


def _plot_scan(axes: Axes, name: str, scan: Scan, lowest: float, height: float) -> None:
    scale, unit = (degrees(1.0), "deg") if scan.axis < 3 else (1.0, "m")
    scores = (scan.scores - lowest) / height
    best = scan.best_offset * scale
    (line,) = axes.plot(scan.offsets * scale, scores, linewidth=1.3, label=f"{name}, best at {best:+.2f} {unit}")
    axes.plot(best, scores.max(), "o", color=line.get_color(), markersize=4)
    axes.set_xlabel(f"{AXIS_TITLES[scan.axis]}, {unit}")


def _errors(
    points: Sequence[FrameCountStatistics] | Sequence[SliceStatistics],
    at: Sequence[float],
    labels: Sequence[str],
    what: str,
    with_translation: bool,
    title: str,
) -> bytes:
    columns = 2 if with_translation else 1
    figure = Figure(figsize=(8.0 * columns, 6.5), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(2, columns, sharex=True, squeeze=False, height_ratios=(3, 1))
    _plot_errors(
        panels[0, 0], at, [_in_degrees(point.rotation_rad) for point in points], "rotation error, deg", HIT_DEG
    )
    claimed = [degrees(point.sigma_rad) for point in points]
    panels[0, 0].plot(at, claimed, "^:", color="tab:purple", label="σ claimed (root of the three variances), median")
    if with_translation:
        _plot_errors(panels[0, 1], at, [point.translation_m for point in points], "translation error, m", HIT_M)
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


def _plot_errors(axes: Axes, at: Sequence[float], errors: Sequence[SpreadStatistics], label: str, limit: float) -> None:
    axes.plot(at, [error.p95 for error in errors], "s--", label="95th percentile")
    axes.plot(at, [error.median for error in errors], "o-", label="median")
    axes.axhline(limit, color="grey", linewidth=0.8, linestyle=":", label=f"limit of a hit, {limit:g}")
    axes.set_yscale("log")
    axes.set_ylabel(label)


def _tick(axes: Axes) -> None:
    """Labels a logarithmic axis with plain numbers."""
    low, high = axes.get_ylim()
    ticks = [tick for tick in TICKS if low <= tick <= high]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def _in_degrees(errors: SpreadStatistics) -> SpreadStatistics:
    return SpreadStatistics(degrees(errors.median), degrees(errors.p95), degrees(errors.max))
