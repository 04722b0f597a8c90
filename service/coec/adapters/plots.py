"""Figures of an evaluation, as PNG bytes. Drawn in memory: no display, no window, no global state of matplotlib.

Colours of errors run from dark (good) to bright (bad) on a logarithmic scale about the limit of a hit.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from math import degrees, pi

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.projections.polar import PolarAxes
from numpy.typing import NDArray

from coec.calibration.evaluation import HIT_M, HIT_RAD, FramesPoint, Outcome, Spread
from coec.calibration.landscape import Scan

DPI = 110

AXIS_TITLES = ("rx pitch", "ry yaw", "rz roll", "tx right", "ty down", "tz forward")

ERROR_RANGE_DEG = (0.02, 20.0)
"""Ends of the colours: what a good search scatters by, and what is lost altogether."""

TICKS = tuple(step * 10.0**decade for decade in range(-4, 3) for step in (1.0, 2.0, 3.0, 5.0, 7.0))
"""Of logarithmic axes."""

TARGET_RIMS_DEG = (1.0, 2.0, 5.0, 10.0, 20.0, 45.0, 90.0, 180.0)
"""Radii of the target: the smallest that holds 95 % of the ends is taken, the others are drawn on its rim. One degree
is twice the limit of a hit."""

HIT_DEG = degrees(HIT_RAD)

COLOURS = "plasma"


def bullseye(outcomes: Sequence[Outcome], directions: Mapping[str, NDArray[np.float64]], title: str) -> bytes:
    """Left, for each of `directions` (title, (n, 3) unit vectors in camera axes): the start directions, coloured by
    where their solves ended. Right: where they ended, as seen from the reference.

    The sphere of directions is flattened with equal areas (Lambert): the centre looks along +z (roll), the rim along
    -z, the middle ring lies across.
    """
    figure = Figure(figsize=(6.2 * (len(directions) + 1), 7.0), layout="constrained")
    figure.suptitle(title)
    colours = LogNorm(*ERROR_RANGE_DEG, clip=True)
    for column, (name, unit) in enumerate(directions.items()):
        _draw_starts(_polar(figure, len(directions) + 1, column), name, unit, outcomes, colours)
    axes = _polar(figure, len(directions) + 1, len(directions))
    _draw_target(axes, outcomes, colours)
    scale = figure.colorbar(
        ScalarMappable(colours, COLOURS), ax=axes, shrink=0.7, pad=0.1, label="final rotation error, deg"
    )
    ticks = [tick for tick in TICKS if ERROR_RANGE_DEG[0] <= tick <= ERROR_RANGE_DEG[1]]
    scale.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    figure.legend(handles=_legend(outcomes), loc="outside lower center", ncols=4, frameon=False)
    return _png(figure)


def landscape(curves: Mapping[str, Sequence[Scan]], title: str) -> bytes:
    """Each named objective along the six axes about the reference. Several are drawn between their lowest (0) and
    highest value (1) over all axes, so that units do not matter; one is drawn as it is."""
    figure = Figure(figsize=(13.0, 7.0), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(2, 3, sharey=True)
    shared = len(curves) > 1
    for name, scans in curves.items():
        every = np.concatenate([scan.scores for scan in scans])
        lowest, height = every.min(), np.ptp(every) or 1.0
        for scan in scans:
            axes = panels[divmod(scan.axis, 3)]
            scale, unit = (degrees(1.0), "deg") if scan.axis < 3 else (1.0, "m")
            scores = (scan.scores - lowest) / height if shared else scan.scores
            best = scan.best_offset * scale
            (line,) = axes.plot(scan.offsets * scale, scores, label=f"{name}, best at {best:+.2f} {unit}")
            axes.plot(best, scores.max(), "o", color=line.get_color(), markersize=5)
            axes.set_xlabel(f"{AXIS_TITLES[scan.axis]}, {unit}")
    for axes in panels.flat:
        axes.axvline(0.0, color="grey", linewidth=0.8, linestyle="--")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", loc="lower center")
    for axes in panels[:, 0]:
        axes.set_ylabel("score, from its lowest to its highest" if shared else "score")
    return _png(figure)


def error_against_frames(points: Sequence[FramesPoint], with_translation: bool, title: str) -> bytes:
    """Median and 95th percentile of the error over subsets, by the number of frames; the share of hits below."""
    figure = Figure(figsize=(8.0 * (2 if with_translation else 1), 6.5), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(2, 2 if with_translation else 1, sharex=True, squeeze=False, height_ratios=(3, 1))
    frames = [point.frames for point in points]
    limits = [("rotation error, deg", HIT_DEG, [_in_degrees(point.rotation_rad) for point in points])]
    if with_translation:
        limits.append(("translation error, m", HIT_M, [point.translation_m for point in points]))
    for column, (label, limit, spreads) in enumerate(limits):
        upper, lower = panels[0, column], panels[1, column]
        upper.plot(frames, [errors.p95 for errors in spreads], "s--", label="95th percentile")
        upper.plot(frames, [errors.median for errors in spreads], "o-", label="median")
        upper.axhline(limit, color="grey", linewidth=0.8, linestyle=":", label=f"limit of a hit, {limit:g}")
        upper.set_yscale("log")
        low, high = upper.get_ylim()
        ticks = [tick for tick in TICKS if low <= tick <= high]
        upper.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        upper.minorticks_off()
        upper.set_ylabel(label)
        upper.legend()
        lower.plot(frames, [100.0 * point.hit_rate for point in points], "o-", color="tab:green")
        lower.set_ylabel("hits, %")
        lower.set_ylim(-5.0, 105.0)
        lower.set_xscale("log")
        lower.set_xticks(frames, [str(count) for count in frames])
        lower.minorticks_off()
        lower.set_xlabel("frames in the window")
        for axes in (upper, lower):
            axes.grid(alpha=0.3, which="both")
    return _png(figure)


def _draw_starts(
    axes: PolarAxes, name: str, unit: NDArray[np.float64], outcomes: Sequence[Outcome], colours: LogNorm
) -> None:
    from_z = np.arccos(np.clip(unit[:, 2], -1.0, 1.0))
    _marks(axes, np.arctan2(unit[:, 1], unit[:, 0]), np.sin(from_z / 2.0), outcomes, colours)
    rings = np.radians([45.0, 90.0, 135.0])
    axes.set_rgrids(np.sin(rings / 2.0), ["45°", "90°", "135°"], angle=100.0, color="grey", fontsize="small")
    axes.set_ylim(0.0, 1.05)
    axes.set_thetagrids([0.0, 90.0, 180.0, 270.0], ["+x", "+y", "-x", "-y"])
    axes.set_title(f"{name}\ncentre +z, rim -z", fontsize="medium")


def _draw_target(axes: PolarAxes, outcomes: Sequence[Outcome], colours: LogNorm) -> None:
    errors = np.degrees(np.array([outcome.error[:3] for outcome in outcomes]))
    angle_deg = np.linalg.norm(errors, axis=1)
    rim_deg = next(rim for rim in TARGET_RIMS_DEG if np.quantile(angle_deg, 0.95) <= rim)
    # Yaw to the right and pitch upwards, as the picture moves.
    _marks(axes, np.arctan2(errors[:, 0], errors[:, 1]), np.minimum(angle_deg, rim_deg), outcomes, colours)
    axes.plot(np.linspace(0.0, 2.0 * pi, 181), np.full(181, HIT_DEG), color="tab:green", linewidth=1.2)
    rings = [0.25 * rim_deg, 0.5 * rim_deg, 0.75 * rim_deg, rim_deg]
    axes.set_rgrids(rings, [f"{ring:g}°" for ring in rings], angle=100.0, color="grey", fontsize="small")
    axes.set_ylim(0.0, 1.05 * rim_deg)
    axes.set_thetagrids([0.0, 90.0, 180.0, 270.0], ["+yaw", "+pitch", "-yaw", "-pitch"])
    axes.set_title(
        f"where they ended\nradius: rotation error; rim: {rim_deg:g}° and more; green: a hit", fontsize="medium"
    )


def _marks(
    axes: PolarAxes,
    angle: NDArray[np.float64],
    radius: NDArray[np.float64],
    outcomes: Sequence[Outcome],
    colours: LogNorm,
) -> None:
    final_deg = np.degrees([outcome.rotation_rad for outcome in outcomes])
    for hit in (True, False):
        for accepted in (True, False):
            of = np.array([outcome.hit is hit and outcome.accepted is accepted for outcome in outcomes])
            if of.any():
                axes.scatter(
                    angle[of], radius[of], c=final_deg[of], cmap=COLOURS, norm=colours, zorder=3, clip_on=False,
                    marker=_marker(hit), s=46.0 if hit else 90.0, edgecolors=_edge(accepted), linewidths=1.3,
                )  # fmt: skip


def _legend(outcomes: Sequence[Outcome]) -> list[Line2D]:
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


def _polar(figure: Figure, columns: int, column: int) -> PolarAxes:
    axes = figure.add_subplot(1, columns, column + 1, projection="polar")
    if not isinstance(axes, PolarAxes):
        raise TypeError(f"matplotlib made {type(axes).__name__} of a polar projection")
    return axes


def _in_degrees(errors: Spread) -> Spread:
    return Spread(degrees(errors.median), degrees(errors.p95), degrees(errors.max))


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    # Without the name of the software and its version: equal figures give equal bytes.
    figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
    return stream.getvalue()
