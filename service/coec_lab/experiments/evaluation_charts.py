"""Charts of experiments for pages (SVG): where solves started and ended, objectives along the axes, normalised errors,
the paper's figures.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from math import degrees
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import PaperLimits
from coec.reports.charts import Chart, Disc, Dot, DotKind, Limit, Mark, Ring, Series
from coec.reports.console import AXIS_NAMES
from coec.reports.formatting import number, significant
from coec.reports.page import Charts, Discs
from coec_lab.experiments.evaluation_schema import NormalisedErrorsReport
from coec_lab.experiments.objective_scans import Scan, Views
from coec_lab.experiments.paper_figures import MOVES_DEG, FailureFigures
from coec_lab.experiments.solve_statistics import HIT_RAD, SolveOutcome

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


HIT_DEG = degrees(HIT_RAD)

RIMS_DEG = (1.0, 2.0, 5.0, 10.0, 20.0, 45.0, 90.0, 180.0)
"""Radii of the target: the smallest that holds 95 % of the ends is taken, and ends beyond it are drawn on its rim. One
degree is twice the limit of a hit."""

LATITUDES_DEG = (45.0, 90.0, 135.0)
"""Rings on the disc of directions, from +z."""

QUARTERS = (0.25, 0.5, 0.75)
"""Rings on the target, shares of its rim."""

CLEAR = 0.12
"""A ring of the target that is closer than this to the ring of a hit is left out, so that labels do not overlap."""

KINDS: Mapping[tuple[bool, bool], DotKind] = {
    (True, True): DotKind("hits, accepted", "good", "circle", full=True),
    (True, False): DotKind("hits, refused", "unsure", "circle", full=False),
    (False, False): DotKind("misses, refused", "none", "cross", full=False),
    (False, True): DotKind("misses, accepted", "bad", "cross", full=True),
}
"""By hit and accepted; the worst come last, so that they are drawn on top."""

Places = NDArray[np.float64]
"""(n, 2) angle, radians from the right counter-clockwise, and radius."""


def start_places(unit: NDArray[np.float64]) -> Places:
    """Places of directions (n, 3), unit vectors in camera axes, on an equal-area disc of radius 1 (Lambert): the centre
    is +z (roll), the rim -z, the middle ring perpendicular to z."""
    from_z = np.arccos(np.clip(unit[:, 2], -1.0, 1.0))
    return np.column_stack([np.arctan2(unit[:, 1], unit[:, 0]), np.sin(from_z / 2.0)])


def latitude_radius(from_z_deg: float) -> float:
    """Radius of a ring on the disc of `start_places`."""
    return float(np.sin(np.radians(from_z_deg) / 2.0))


def end_places(outcomes: Sequence[SolveOutcome], rim_deg: float) -> Places:
    """Places of ends on the target, degrees from the reference: yaw to the right and pitch upwards, as the picture
    moves; ends beyond the rim lie on it."""
    errors = np.degrees(np.array([outcome.error[:3] for outcome in outcomes]))
    angle_deg = np.linalg.norm(errors, axis=1)
    return np.column_stack([np.arctan2(errors[:, 0], errors[:, 1]), np.minimum(angle_deg, rim_deg)])


def rim_of(outcomes: Sequence[SolveOutcome]) -> float:
    """The radius of the target, degrees, see `RIMS_DEG`."""
    p95_deg = np.quantile(np.degrees([outcome.rotation_rad for outcome in outcomes]), 0.95)
    return next(rim for rim in RIMS_DEG if p95_deg <= rim)


def bullseye(methods: Mapping[str, Sequence[SolveOutcome]], directions: Mapping[str, NDArray[np.float64]]) -> Discs:
    """For each method, a disc of its starts by each of `directions` (title, (n, 3) unit vectors in camera axes), and a
    target of its ends. All targets have the radius of the worst method. A single method may have an empty name."""
    rim_deg = max(rim_of(outcomes) for outcomes in methods.values())
    discs = []
    for method, outcomes in methods.items():
        of = f"{method}: " if method else ""
        discs += [_starts(f"{of}{name}", unit, outcomes) for name, unit in directions.items()]
        discs.append(_target(f"{of}Where they ended", outcomes, rim_deg))
    every = [outcome for outcomes in methods.values() for outcome in outcomes]
    counts = {kind: sum((one.hit, one.accepted) == key for one in every) for key, kind in KINDS.items()}
    return Discs(tuple(discs), tuple((kind, f"{kind.name}: {count}") for kind, count in counts.items()))


def _starts(title: str, unit: NDArray[np.float64], outcomes: Sequence[SolveOutcome]) -> Disc:
    rings = tuple(Ring(latitude_radius(from_z_deg), f"{from_z_deg:g}°") for from_z_deg in LATITUDES_DEG)
    missed = sum(not outcome.hit for outcome in outcomes)
    description = (
        f"{len(outcomes)} directions, of which {missed} led to a miss; the centre looks along +z, the rim along −z"
    )
    return Disc(title, description, ("+x", "+y", "−x", "−y"), rings, _dots(start_places(unit), outcomes))


def _target(title: str, outcomes: Sequence[SolveOutcome], rim_deg: float) -> Disc:
    goal = HIT_DEG / rim_deg
    others = (Ring(share, f"{share * rim_deg:g}°") for share in QUARTERS if abs(share - goal) >= CLEAR)
    rings = (*others, Ring(goal, f"a hit: {HIT_DEG:g}°", goal=True))
    places = end_places(outcomes, rim_deg)
    places[:, 1] /= rim_deg
    hits = sum(outcome.hit for outcome in outcomes)
    description = (
        f"{hits} of {len(outcomes)} lie within {HIT_DEG:g}° of the reference; the rim is {rim_deg:g}° and more"
    )
    return Disc(
        f"{title} (rim: {rim_deg:g}° and more)", description, ("yaw", "pitch", "", ""), rings, _dots(places, outcomes)
    )


def _dots(places: Places, outcomes: Sequence[SolveOutcome]) -> tuple[Dot, ...]:
    order = list(KINDS)
    dots = [
        (
            order.index((outcome.hit, outcome.accepted)),
            Dot(
                float(radius * np.cos(angle)),
                float(radius * np.sin(angle)),
                KINDS[outcome.hit, outcome.accepted],
                f"start {index}: ends {number(degrees(outcome.rotation_rad), 2)}° off",
            ),
        )
        for index, ((angle, radius), outcome) in enumerate(zip(places.tolist(), outcomes, strict=True))
    ]
    return tuple(dot for _, dot in sorted(dots, key=lambda item: item[0]))


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
