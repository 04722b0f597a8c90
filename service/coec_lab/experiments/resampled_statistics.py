"""What solves of resampled real windows (`resampled_windows`) come to, by recording and degrees of freedom: the
document of `coec resample` and its tables. Angles in degrees, lengths in metres, axes rx ry rz tx ty tz about and along
the camera axes. A number that could not be computed is null.
"""

from collections import Counter
from collections.abc import Sequence
from math import inf
from typing import cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from coec.calibration.types import INTRINSICS_OFF
from coec.reports import console
from coec.reports.page_parts import finite_degrees, finite_or_none
from coec.schemas.message import Message, Part, Text
from coec.schemas.replies import Count, Counts, Maybe6, Vector6
from coec_lab.experiments.resampled_windows import Reference, ResampledSolve, Resampling, described

LENS_SIZES = {"cx": (10.0, 25.0), "cy": (10.0, 25.0), "f": (0.05, 0.15)}
"""Sizes at which errors of a lens are divided into small, medium and large ones: pixels, and shares."""

COVERED_SIGMAS = 3.0
"""Standard deviations within which errors are counted as covered."""


class SolvedResample(Part):
    """One solve."""

    window: Text = Field(description="number and sample of the window")
    error: Maybe6 = Field(description="from the reference; null on axes that were not solved")
    sigma: Maybe6 = Field(description="as the estimate claims it")
    hit: bool
    accepted: bool
    wrong: bool = Field(description="an axis is off by more than four standard deviations and by 0.3 degrees or 10 cm")
    reasons: tuple[Text, ...] = Field(description="codes of the reasons why it was refused, in their order")


class ResampleRow(Part):
    """A recording with one number of degrees of freedom."""

    source: Text
    dof: Count
    reference_offset: Vector6 = Field(description="of the reference from the recording's calibration")
    reference_accepted: Count = Field(description="accepted results whose median the reference is")
    windows: Count
    solves: Count
    failed: Count = Field(description="solves without an estimate")
    hits: Count
    accepted: Count
    accepted_hits: Count
    wrong_accepted: Count
    refused_by: Counts = Field(description="refused hits by reason; one may have several")
    covered: Maybe6 = Field(description="share of the hits whose error is within three standard deviations")
    sigma_over_rms: Maybe6 = Field(description="mean standard deviation of the hits over their rms error")
    verdicts_differ: Count = Field(description="windows whose hits have different verdicts")
    sigma_spread: float | None = Field(
        description="over windows, median of (largest - least) / median of the standard deviation of the hits; of the "
        "axis where it is largest"
    )
    sigma_spread_max: float | None = Field(description="the largest")
    each: tuple[SolvedResample, ...]


class LensRow(Part):
    """Windows with one kind of lens error."""

    source: Text
    dof: Count
    error: Text
    solves: Count
    accepted: Count
    wrong_accepted: Count
    named: Count = Field(description="refused with `intrinsics_off` among the reasons")
    led: Count = Field(description="refused with `intrinsics_off` as the first reason")
    refused_by: Counts


class ResampleReport(Message):
    """`coec resample`."""

    seed: Count
    rows: tuple[ResampleRow, ...]
    lenses: tuple[LensRow, ...] = Field(description="empty without --lens-errors")


def row_of(of: Resampling, reference: Reference, solves: Sequence[ResampledSolve]) -> ResampleRow:
    """The figures of a recording."""
    hits = [solve for solve in solves if solve.hit]
    errors, sigma = (_stacked([getattr(solve, name) for solve in hits]) for name in ("error", "sigma"))
    rms = np.sqrt(_mean(errors**2, errors, sigma))
    spreads, differ = [], 0
    for number in sorted({solve.number for solve in hits}):
        of_window = [solve for solve in hits if solve.number == number]
        differ += len({solve.accepted for solve in of_window}) > 1
        if len(of_window) > 1:
            spreads.append(_relative_spread(np.array([solve.sigma for solve in of_window])))
    known = [spread for spread in spreads if np.isfinite(spread)]
    return ResampleRow(
        source=of.source,
        dof=of.dof,
        reference_offset=cast("Vector6", finite_degrees(reference.offset)),
        reference_accepted=reference.accepted,
        windows=len({solve.number for solve in solves}),
        solves=len(solves),
        failed=sum(not np.isfinite(solve.error[:3]).all() for solve in solves),
        hits=len(hits),
        accepted=sum(solve.accepted for solve in solves),
        accepted_hits=sum(solve.accepted for solve in hits),
        wrong_accepted=sum(solve.accepted and solve.wrong for solve in solves),
        refused_by=_refused_by(hits),
        covered=_maybe(_mean(np.abs(errors) <= COVERED_SIGMAS * sigma, errors, sigma)),
        sigma_over_rms=_maybe(_mean(sigma, errors, sigma) / np.where(rms > 0.0, rms, np.nan)),
        verdicts_differ=differ,
        sigma_spread=float(np.median(known)) if known else None,
        sigma_spread_max=max(known, default=None),
        each=tuple(_document(solve) for solve in solves),
    )


def lens_rows(of: Resampling, solves: Sequence[ResampledSolve]) -> list[LensRow]:
    """Figures by kind and size of the lens error."""
    kinds: dict[str, list[ResampledSolve]] = {}
    for solve in solves:
        kinds.setdefault(_lens_kind(solve), []).append(solve)
    return [
        LensRow(
            source=of.source,
            dof=of.dof,
            error=kind,
            solves=len(group),
            accepted=sum(solve.accepted for solve in group),
            wrong_accepted=sum(solve.accepted and solve.wrong for solve in group),
            named=sum(INTRINSICS_OFF in solve.reasons for solve in group),
            led=sum(solve.reasons[:1] == (INTRINSICS_OFF,) for solve in group),
            refused_by=_refused_by(group),
        )
        for kind, group in sorted(kinds.items())
    ]


def _lens_kind(solve: ResampledSolve) -> str:
    lens = solve.sample.lens
    if lens is None:
        return "right"
    bounds = (0.0, *LENS_SIZES[lens.kind], inf)
    place = int(np.searchsorted(bounds, abs(lens.size), side="right")) - 1
    low, high = bounds[place], bounds[place + 1]
    factor, unit = (100.0, "%") if lens.kind == "f" else (1.0, "px")
    most = "" if high == inf else f" to {factor * high:g}"
    return f"{lens.kind}, {'from ' if not most else ''}{factor * low:g}{most} {unit}"


def _document(solve: ResampledSolve) -> SolvedResample:
    return SolvedResample(
        window=f"{solve.number}: {described(solve.sample)}",
        error=finite_degrees(solve.error),
        sigma=finite_degrees(solve.sigma),
        hit=solve.hit,
        accepted=solve.accepted,
        wrong=solve.wrong,
        reasons=solve.reasons,
    )


def _refused_by(solves: Sequence[ResampledSolve]) -> Counts:
    return dict(Counter(reason for solve in solves for reason in solve.reasons).most_common())


def _stacked(of_solves: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.array(of_solves).reshape(-1, 6)


def _mean(values: NDArray[np.generic], *of: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) mean of the values (N, 6) whose figures in all of `of` (N, 6) are known; NaN where none are."""
    known = np.isfinite(of).all(axis=0)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def _relative_spread(sigma: NDArray[np.float64]) -> float:
    """The largest relative spread of an axis with a standard deviation in all of (N, 6); NaN if there is none."""
    known = sigma[:, np.isfinite(sigma).all(axis=0)]
    return float((np.ptp(known, axis=0) / np.median(known, axis=0)).max()) if known.size else float("nan")


def _maybe(values: NDArray[np.float64]) -> Maybe6:
    return cast("Maybe6", tuple(finite_or_none(float(value)) for value in values))


def show(report: ResampleReport) -> None:
    """Prints the tables."""
    table = console.table(
        "recording", "dof", "windows", "solves", "hits", "accepted", "wrong accepted", "verdicts differ", "spread of σ",
        "refused hits by", right=range(1, 9),
    )  # fmt: skip
    for row in report.rows:
        counts = (row.dof, row.windows, row.solves, row.hits, row.accepted, row.wrong_accepted, row.verdicts_differ)
        spread = "-" if row.sigma_spread is None else f"{100 * row.sigma_spread:.1f} %"
        table.add_row(row.source, *map(str, counts), spread, _counts(row.refused_by))
    console.out.print(table)
    axes = console.table("recording", "dof", "figure", *console.AXIS_NAMES, right=range(3, 9))
    for row in report.rows:
        for name, values, digits in (
            (f"reference, of {row.reference_accepted} accepted", row.reference_offset, 3),
            (f"within {COVERED_SIGMAS:g} σ", row.covered, 3),
            ("σ over rms", row.sigma_over_rms, 2),
        ):
            axes.add_row(row.source, str(row.dof), name, *(console.figure(value, digits) for value in values))
    console.out.print(axes)
    if not report.lenses:
        return
    lenses = console.table(
        "recording", "dof", "lens error", "solves", "accepted", "wrong accepted", "lens named", "lens first",
        "refused by", right=(1, 3, 4, 5, 6, 7),
    )  # fmt: skip
    for of in report.lenses:
        figures = (of.solves, of.accepted, of.wrong_accepted, of.named, of.led)
        lenses.add_row(of.source, str(of.dof), of.error, *map(str, figures), _counts(of.refused_by))
    console.out.print(lenses)


def _counts(counts: Counts) -> str:
    return ", ".join(f"{name} {number}" for name, number in counts.items()) or "-"
