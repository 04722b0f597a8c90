"""Plots on the page of an evaluation: objectives about the reference, and errors over what was claimed for them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from math import degrees
from statistics import NormalDist

import numpy as np

from coec.evaluation.profiles import Scan, Views
from coec.reports.console import AXIS_NAMES
from coec.reports.page import Chart, Charts, Mark, Series
from coec.reports.page.words import number
from coec.schemas.evaluation import NormalisedErrorsReport

AS_IT_SHOULD_BE = "as it should be"

AXES_OF = {"rotations": range(3), "translations": range(3, 6)}
"""Axes that share a scale; rotations and translations have different units."""


def landscape(seen: Mapping[str, Views]) -> Charts:
    """Each named objective along its axes about the reference, from afar and from near. Scores are scaled: 0 is the
    lowest and 1 the highest value of an objective from afar, over all rotations or all translations."""
    scanned = len(next(iter(seen.values())).wide)
    return Charts(
        tuple(chart for group in AXES_OF.values() if group[0] < scanned for chart in _of_group(seen, group)), small=True
    )


def _of_group(seen: Mapping[str, Views], group: range) -> Iterator[Chart]:
    scales = {}
    for name, views in seen.items():
        every = np.concatenate([views.wide[axis].scores for axis in group])
        scales[name] = float(every.min()), float(np.ptp(every)) or 1.0
    for distance, attribute in (("from afar", "wide"), ("from near", "narrow")):
        for axis in group:
            scans: dict[str, Scan] = {name: getattr(views, attribute)[axis] for name, views in seen.items()}
            yield _scans(f"{AXIS_NAMES[axis]}, {distance}", scans, scales)


def _scans(title: str, scans: Mapping[str, Scan], scales: Mapping[str, tuple[float, float]]) -> Chart:
    series, best = [], []
    for name, scan in scans.items():
        (lowest, height), (factor, unit, digits) = scales[name], _unit(scan.axis)
        scores = ((scan.scores - lowest) / height).tolist()
        series.append(Series(name, list(zip((factor * scan.offsets).tolist(), scores, strict=True))))
        best.append(f"{name} at {number(factor * scan.best_offset, digits, sign=True)} {unit}")
    description = f"the highest place is that of {', '.join(best)}"
    return Chart(title, f"from the reference, {unit}", "", tuple(series), description, marks=(Mark(0.0, ""),))


def _unit(axis: int) -> tuple[float, str, int]:
    """Factor from the internal unit to the shown one, the shown unit, and its digits."""
    return (degrees(1.0), "°", 2) if axis < 3 else (100.0, "cm", 1)


def normalised(report: NormalisedErrorsReport) -> Charts:
    """A histogram of errors over claimed standard deviations beside the normal distribution that they should follow,
    and the share of errors in intervals against the share that should lie there; rotations and translations apart."""
    axes_by_group = {name: [axis for axis in group if sum(report.histogram[axis])] for name, group in AXES_OF.items()}
    return Charts(
        tuple(
            chart
            for name, axes in axes_by_group.items()
            if axes
            for chart in (_histogram(report, name, axes), _held(report, name, axes))
        ),
        small=True,
    )


def _histogram(report: NormalisedErrorsReport, name: str, axes: list[int]) -> Chart:
    edges, normal = report.bin_edges, NormalDist()
    beyond = [0.0, *(normal.cdf(edge) for edge in edges[1:-1]), 1.0]
    expected = _steps(edges, [high - low for low, high in pairwise(beyond)])
    counted = []
    for axis in axes:
        counts = report.histogram[axis]
        counted.append(Series(AXIS_NAMES[axis], _steps(edges, [count / sum(counts) for count in counts]), "steps"))
    description = (
        f"{report.judged} accepted results, errors against {report.against}; the outermost steps hold what lies beyond"
    )
    series = (Series(AS_IT_SHOULD_BE, expected, "dotted"), *counted)
    return Chart(f"Share of results by error / σ, {name}", "error / claimed σ", "", series, description, from_zero=True)


def _held(report: NormalisedErrorsReport, name: str, axes: list[int]) -> Chart:
    shares = [
        Series(
            AXIS_NAMES[axis],
            [
                (at, held)
                for at, held in zip(report.confidences, report.reliability[axis], strict=True)
                if held is not None
            ],
        )
        for axis in axes
    ]
    description = "above the diagonal claims are wider than errors, below it they are too narrow"
    series = (Series(AS_IT_SHOULD_BE, [(0.0, 0.0), (1.0, 1.0)], "dotted"), *shares)
    return Chart(
        f"Share within their intervals, {name}", "share that should be", "", series, description, from_zero=True
    )


def _steps(edges: tuple[float, ...], values: list[float]) -> list[tuple[float, float]]:
    """Points of a step line with one value from each edge to the next."""
    return [*zip(edges, values, strict=False), (edges[-1], values[-1])]
