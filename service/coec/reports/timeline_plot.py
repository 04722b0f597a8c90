"""Error and health over a drive, as PNG bytes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from coec.reports.plots import png

HEALTH_COLOURS = {
    "healthy": "tab:green",
    "suspect": "gold",
    "degraded": "orange",
    "miscalibrated": "tab:red",
    "stale": "silver",
    "unknown": "lightgrey",
}


def timeline(
    series: Sequence[tuple[float, float, str]], marks: Sequence[tuple[float, str]], limit_deg: float, title: str
) -> bytes:
    """The error of the served extrinsic against the truth, over a background coloured by the state that the service
    reports.

    Args:
        series: (second of the drive, error in degrees, state of health), ascending in time.
        marks: (second, what happened).
        limit_deg: a good error stays below this.
    """
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots()
    for (begin, _, state), (end, *_) in pairwise(series):
        axes.axvspan(begin, end, color=HEALTH_COLOURS.get(state, "white"), alpha=0.3, linewidth=0)
    seconds, errors_deg = [point[0] for point in series], [point[1] for point in series]
    # Both the served extrinsic and the truth change in steps.
    curve = axes.plot(seconds, errors_deg, color="black", linewidth=1.8, drawstyle="steps-post", label="error")
    limit = axes.axhline(limit_deg, color="grey", linestyle=":", linewidth=1.0, label=f"{limit_deg:g}°: a good error")
    axes.set_ylim(0.0, max(errors_deg) * 1.25 + 0.1)
    for second, what in marks:
        axes.axvline(second, color="black", linestyle="--", linewidth=1.0)
        axes.annotate(
            f"{what}, {second:.0f} s ", (second, axes.get_ylim()[1]), rotation=90, ha="right", va="top", fontsize=9
        )
    axes.set_xlim(series[0][0], series[-1][0])
    axes.set_xlabel("drive, s")
    axes.set_ylabel("rotation error against the truth, deg")
    seen = dict.fromkeys(state for _, _, state in series)
    grounds = [Patch(color=HEALTH_COLOURS.get(state, "white"), alpha=0.3, label=state) for state in seen]
    handles = [*curve, limit, *grounds]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return png(figure)
