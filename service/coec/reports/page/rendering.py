"""From a `Page` to one HTML file that loads nothing from anywhere.

Names that came over a network can only ever be text, for two reasons: templates escape whatever they are given, and the
content policy in the head of the page lets no script run but the page's own. Characters without a shape, and those that
reverse the order of others, are shown as escapes (`coec.untrusted`).
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from coec.adapters.files import output
from coec.reports.page import charts, discs
from coec.reports.page.blocks import Compare, Page, Picture, Pictures, Section, Trend
from coec.reports.page.embedding import Embedded, embedded
from coec.untrusted import printable_lines

TREND_WIDTH, TREND_HEIGHT, TREND_MARGIN = 180, 40, 3
"""Size of a plot within a table, px."""

LEAST_CONTENTS = 3
"""A page with at least so many sections has a list of them."""


@dataclass(frozen=True, slots=True)
class _Placed:
    """A section and its anchor in an address."""

    section: Section
    anchor: str


def write(path: Path, page: Page) -> Path:
    """Writes the page to a file.

    Raises:
        OutputError: the file cannot be written.
        DecodeError: one of its pictures cannot be decoded.
    """
    return output.write_output(path, render(page).encode())


def render(page: Page) -> str:
    """The page as an HTML document.

    Raises:
        DecodeError: one of its pictures cannot be decoded.
    """
    pictures = list(_pictures(page))
    shown = embedded([picture.data for picture in pictures])
    by_picture: dict[int, Embedded] = {id(picture): made for picture, made in zip(pictures, shown, strict=True)}
    placed = _placed(page.sections)
    style, script = _asset("style.css"), _asset("script.js")
    return (
        _environment()
        .get_template("page.html")
        .render(
            page=page,
            sections=placed,
            contents=[each for each in placed if each.section.level == 2] if len(placed) >= LEAST_CONTENTS else [],
            style=Markup(style),
            script=Markup(script),
            script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
            shown=lambda picture: by_picture[id(picture)],
        )
    )


def _pictures(page: Page) -> Iterator[Picture]:
    for block in (*page.opening, *(block for section in page.sections for block in section.blocks)):
        if isinstance(block, Pictures):
            yield from block.items
        elif isinstance(block, Compare):
            yield from (block.before, block.after)


def _placed(sections: tuple[Section, ...]) -> list[_Placed]:
    """The sections with unique anchors, whatever the titles are."""
    taken: set[str] = set()
    placed = []
    for section in sections:
        stem = re.sub(r"[^a-z0-9]+", "-", section.title.lower()).strip("-") or "section"
        anchor = next(
            name for number in range(1, 10**6) if (name := f"{stem}-{number}" if number > 1 else stem) not in taken
        )
        taken.add(anchor)
        placed.append(_Placed(section, anchor))
    return placed


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("coec.reports.page"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.globals.update(
        drawn=charts.layout, legend=charts.legend, WIDE=charts.WIDE, NARROW=charts.NARROW, SMALL=charts.SMALL,
        disc_place=discs.dot_position, DISC_SIDE=discs.DISC_SIDE_PX, DISC_RADIUS=discs.DISC_RADIUS_PX,
        trend_paths=_trend_paths, TREND_WIDTH=TREND_WIDTH, TREND_HEIGHT=TREND_HEIGHT,
    )  # fmt: skip
    made.filters["prose"] = _prose
    made.tests["plain"] = lambda cell: isinstance(cell, str)
    return made


def _finalized(value: object) -> object:
    """What an expression of a template comes to, as it stands in the page before its markup is escaped."""
    return printable_lines(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _prose(text: str) -> Markup:
    """A sentence as HTML. Text between two backticks is code; with an odd number of backticks none is."""
    text = printable_lines(text)
    parts = text.split("`")
    if len(parts) % 2 == 0:
        return escape(text)
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if index % 2 else part for index, part in enumerate(parts)
    )


@cache
def _asset(name: str) -> str:
    return (files("coec.reports.page") / "templates" / name).read_text(encoding="utf-8")


def _trend_paths(trend: Trend) -> tuple[str, str]:
    """The band and the line of a small plot, as SVG paths."""
    begin, end = trend.points[0][0], trend.points[-1][0]
    reach = max(trend.least, *(abs(value - trend.zero) for _, low, _, high in trend.points for value in (low, high)))

    def at(x: float, value: float) -> str:
        across = (x - begin) / (end - begin) if end > begin else 0.5
        down = TREND_HEIGHT / 2 - (TREND_HEIGHT / 2 - TREND_MARGIN) * (value - trend.zero) / reach
        return f"{TREND_MARGIN + (TREND_WIDTH - 2 * TREND_MARGIN) * across:.1f} {down:.1f}"

    lower = [at(x, low) for x, low, _, _ in trend.points]
    upper = [at(x, high) for x, _, _, high in reversed(trend.points)]
    line = [at(x, middle) for x, _, middle, _ in trend.points]
    return f"M{'L'.join((*lower, *upper))}Z", f"M{'L'.join(line)}"
