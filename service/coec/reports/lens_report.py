"""The lens as `coec calibrate --intrinsics` reports it: as given, as estimated, and what to do if the two differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from coec.reports import console
from coec.reports.formatting import NONE, number
from coec.schemas.replies import Intrinsics, Lens, LensDrift, LensTerm

if TYPE_CHECKING:
    from coec.reports.page import Section

NO_LENS = (
    "The lens was not estimated: the objective uses no edges (use `--objective fused`), or the edges of this window "
    "determine no pose."
)

LIKELY_OFF = 0.5
"""Probability of another lens from which there is advice; the verdict refuses the window at the same one."""

SCALED, CROPPED = 0.02, 0.01
"""Difference of the focal length, as a share, and of the principal point, in widths of the image, from which images of
another size, or a part of the image, are more likely than an inaccurate calibration."""

HEADS = ("", "as given", "estimated", "± σ", "difference, σ", "window alone", "± σ", "unit")


def rows_of(lens: Lens, given: Intrinsics) -> list[tuple[str, ...]]:
    """fx, fy, cx, cy and the radial term, as the cells under `HEADS`. The radial term counts from the given lens."""
    focal, parameters = lens.focal_length, given.parameters
    return [
        _row("fx", parameters["fx"], focal, parameters["fx"]),
        _row("fy", parameters["fy"], focal, parameters["fy"]),
        _row("cx", parameters["cx"], lens.principal_point_x, 1.0),
        _row("cy", parameters["cy"], lens.principal_point_y, 1.0),
        _row("radial, at a corner", 0.0, lens.radial, 1.0),
    ]


def _row(name: str, given: float, term: LensTerm, unit_px: float) -> tuple[str, ...]:
    alone = (number(given + term.free_difference * unit_px, 2), number(term.free_sigma * unit_px, 2))
    return (
        name,
        number(given, 2),
        number(given + term.difference * unit_px, 2),
        number(term.sigma * unit_px, 2),
        _in_sigma(term),
        *(alone if term.determined else ("not determined", "")),
        "px",
    )


def _in_sigma(term: LensTerm) -> str:
    return number(term.difference / term.sigma, 1, sign=True) if term.sigma > 0.0 else NONE


def remarks(lens: Lens, given: Intrinsics) -> list[str]:
    """What the figures mean, and what to do if the lens is another one."""
    off = lens.probability >= LIKELY_OFF
    sentences = [
        f"Probability that the images were taken through another lens than the intrinsics say: "
        f"{_percent(lens.probability)}. Estimated: by the window and the stated σ of the intrinsics; window alone: "
        "whatever the intrinsics are."
    ]
    if not off:
        return sentences
    if abs(lens.focal_length.difference) >= SCALED:
        factor = number(1.0 + lens.focal_length.difference, 3)
        sentences.append(
            f"The focal length is {factor} times the given one: check that the intrinsics are for images of "
            f"{given.width} x {given.height} px, not of another size, and that fx is not that of another camera."
        )
    right, down = lens.principal_point_x.difference, lens.principal_point_y.difference
    if max(abs(right), abs(down)) >= CROPPED * given.width:
        sentences.append(
            f"The principal point differs by {number(right, 1, sign=True)} px to the right and "
            f"{number(down, 1, sign=True)} px down: check whether the images are a crop, whose offset is missing in cx "
            "and cy."
        )
    values = ", ".join(f"{name}: {value:.2f}" for name, value in lens.estimated.items())
    sentences.append(
        f"If the calibration of the lens cannot be corrected: write `{values}` under `camera:` of dataset.yaml, or "
        "under `camera.intrinsics` of the configuration, and calibrate again. Nothing applies it by itself."
    )
    if lens.radial.sigma > 0.0 and abs(lens.radial.difference) >= 3.0 * lens.radial.sigma:
        sentences.append(
            "The radial distortion differs, too, and is not in these values: calibrate the lens with a target."
        )
    return sentences


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def show(lens: Lens | None, given: Intrinsics | None) -> None:
    """Prints the lens."""
    if lens is None or given is None:
        console.show(NO_LENS, "yellow")
        return
    table = console.table(*HEADS, right=range(1, 7))
    for row in rows_of(lens, given):
        table.add_row(*row)
    console.out.print(table)
    for sentence in remarks(lens, given):
        console.show(sentence)


def section(lens: Lens | None, given: Intrinsics | None) -> Section:
    """The section of a page."""
    from coec.reports.page import Section, Table, Text  # pictures, which most that show a lens do without

    if lens is None or given is None:
        return Section("Lens", (Text((NO_LENS,)),))
    rows: Sequence[Sequence[str]] = rows_of(lens, given)
    caption = f"Intrinsics of the {given.model}, {given.width} × {given.height} px, and what the window says of them"
    return Section("Lens", (Table(caption, HEADS, rows, frozenset(range(1, 7))), Text(tuple(remarks(lens, given)))))


def drift_text(lens: LensDrift) -> str:
    """The drift of the lens in one line."""
    terms = (
        ("focal length", lens.focal_length, 100.0, " %", 2),
        ("principal point right", lens.principal_point_x, 1.0, " px", 1),
        ("down", lens.principal_point_y, 1.0, " px", 1),
        ("radial at a corner", lens.radial, 1.0, " px", 1),
    )
    texts = (
        f"{name} {number(factor * term.difference, digits, sign=True)} ± {number(factor * term.sigma, digits)}{unit}"
        for name, term, factor, unit, digits in terms
    )
    return f"{', '.join(texts)}; another lens with probability {_percent(lens.probability)} (window {lens.window_id})"
