"""Figures of an evaluation, as PNG bytes. Drawn in memory: no display, no window, no global state of matplotlib.

Colours of errors run from dark (good) to bright (bad) on a logarithmic scale about the limit of a hit.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from math import pi

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.projections.polar import PolarAxes
from numpy.typing import NDArray

from coec.evaluation.statistics import SolveOutcome
from coec.reports.bullseye import HIT_DEG, LATITUDES_DEG, Places, end_places, latitude_radius, rim_of, start_places

DPI = 110

ERROR_RANGE_DEG = (0.02, 20.0)
"""Ends of the colour scale: the scatter of a good search, and an error that is lost altogether."""

TICKS = tuple(step * 10.0**decade for decade in range(-4, 3) for step in (1.0, 2.0, 3.0, 5.0, 7.0))
"""Ticks of logarithmic axes."""

COLOURS = "plasma"


def bullseye(outcomes: Sequence[SolveOutcome], directions: Mapping[str, NDArray[np.float64]], title: str) -> bytes:
    """Left, for each of `directions` (title, (n, 3) unit vectors in camera axes): the start directions, coloured by
    where their solves ended. Right: where they ended, as seen from the reference.

    `bullseye.start_places` says how the sphere of directions is flattened.
    """
    figure = Figure(figsize=(6.2 * (len(directions) + 1), 7.0), layout="constrained")
    figure.suptitle(title)
    colours = LogNorm(*ERROR_RANGE_DEG, clip=True)
    for column, (name, unit) in enumerate(directions.items()):
        _plot_starts(_polar(figure, 1, len(directions) + 1, column), name, unit, outcomes, colours)
    axes = _polar(figure, 1, len(directions) + 1, len(directions))
    _plot_target(axes, outcomes, colours, rim_of(outcomes))
    _scale(figure, [axes], colours)
    figure.legend(handles=_legend(outcomes), loc="outside lower center", ncols=4, frameon=False)
    return png(figure)


def compared(methods: Mapping[str, Sequence[SolveOutcome]], directions: NDArray[np.float64], title: str) -> bytes:
    """A column per method: above, the start directions ((n, 3) unit vectors in camera axes) coloured by where their
    solves ended; below, where they ended. The targets have one radius, that of the worst method."""
    figure = Figure(figsize=(5.6 * len(methods) + 1.0, 11.5), layout="constrained")
    figure.suptitle(title)
    colours = LogNorm(*ERROR_RANGE_DEG, clip=True)
    rim_deg = max(rim_of(outcomes) for outcomes in methods.values())
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
    axes: PolarAxes, name: str, unit: NDArray[np.float64], outcomes: Sequence[SolveOutcome], colours: LogNorm
) -> None:
    _marks(axes, start_places(unit), outcomes, colours)
    rings, names = [latitude_radius(ring) for ring in LATITUDES_DEG], [f"{ring:g}°" for ring in LATITUDES_DEG]
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


def _plot_target(axes: PolarAxes, outcomes: Sequence[SolveOutcome], colours: LogNorm, rim_deg: float) -> None:
    _marks(axes, end_places(outcomes, rim_deg), outcomes, colours)
    axes.plot(np.linspace(0.0, 2.0 * pi, 181), np.full(181, HIT_DEG), color="tab:green", linewidth=1.2)
    rings = [0.25 * rim_deg, 0.5 * rim_deg, 0.75 * rim_deg, rim_deg]
    axes.set_rgrids(rings, [f"{ring:g}°" for ring in rings], angle=100.0, color="grey", fontsize="small")
    axes.set_ylim(0.0, 1.05 * rim_deg)
    axes.set_thetagrids([0.0, 90.0, 180.0, 270.0], ["+yaw", "+pitch", "-yaw", "-pitch"])
    axes.set_title(
        f"where they ended\nradius: rotation error; rim: {rim_deg:g}° and more; green: a hit", fontsize="medium"
    )


def _marks(axes: PolarAxes, places: Places, outcomes: Sequence[SolveOutcome], colours: LogNorm) -> None:
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


def _legend(outcomes: Sequence[SolveOutcome]) -> list[Line2D]:
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


def png(figure: Figure) -> bytes:
    """The figure as a file; equal figures give equal bytes."""
    stream = io.BytesIO()
    # Without the software's name and version, which would differ.
    figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
    return stream.getvalue()
