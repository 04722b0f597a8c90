"""One self-contained HTML file from a `Page`: the blocks that a page is made of, pictures shrunk until all of them fit,
and the templates that are filled. The content of each page is in a module of its own, such as `incident_page`.

Names that came over a network can only ever be text, for two reasons: templates escape whatever they are given, and the
content policy in the head of the page lets no script run but the page's own. Characters without a shape, and those that
reverse the order of others, are shown as escapes (`coec.untrusted`).
"""

import base64
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import ClassVar, Literal

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from numpy.typing import NDArray

from coec.calibration.types import EncodedImage
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io import user_files
from coec.io.images import decode_bgr, probe
from coec.reports import charts
from coec.reports.charts import Chart, Disc, DotKind
from coec.untrusted import printable_lines

Tone = Literal["good", "unsure", "poor", "bad", "none"]
"""How good something is, from what may be used to what must not be; `none` says nothing. It adds a colour to a word and
never stands as a colour alone."""


@dataclass(frozen=True, slots=True)
class Text:
    """Paragraphs. `quiet` marks a remark that helps to read what follows."""

    template: ClassVar = "text"
    paragraphs: tuple[str, ...]
    quiet: bool = False


@dataclass(frozen=True, slots=True)
class VerdictBanner:
    """The outcome in a sentence.

    Attributes:
        word: one or two words on the badge: Accepted, Refused.
        todo: what to do now, one sentence each.
    """

    template: ClassVar = "verdict"
    tone: Tone
    word: str
    sentence: str
    todo: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class AxisLine:
    """One degree of freedom.

    Attributes:
        value: with its sign, or the reason in words why there is none; then `sigma` is empty.
        share: length of the value's bar over the widest bar of the table, -1 to 1; None without a value.
        sigma_share: likewise for σ.
    """

    name: str
    value: str
    sigma: str
    unit: str
    share: float | None
    sigma_share: float | None
    more: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class AxesTable:
    """The result per axis.

    Attributes:
        value_name: what the values are: correction, offset, bias.
        more: heads of further number columns.
        quiet: those of them that did not enter the decision; they are grey.
    """

    template: ClassVar = "axes"
    caption: str
    value_name: str
    lines: tuple[AxisLine, ...]
    more: tuple[str, ...] = ()
    quiet: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Copy:
    """Something to copy into another program.

    Attributes:
        shown: for people, lines of equal width.
        copied: what the button puts on the clipboard.
    """

    name: str
    note: str
    shown: str
    copied: str


@dataclass(frozen=True, slots=True)
class Copies:
    """Several things to copy."""

    template: ClassVar = "copies"
    items: tuple[Copy, ...]


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture within the page.

    Attributes:
        data: bytes of a PNG or JPEG file.
        alt: what it shows, for readers who cannot see it.
        href: file beside the page that it links to; empty for none.
    """

    data: bytes
    alt: str
    caption: str
    href: str = ""


@dataclass(frozen=True, slots=True)
class Pictures:
    """Pictures one under the other, as wide as the page."""

    template: ClassVar = "pictures"
    items: tuple[Picture, ...]


@dataclass(frozen=True, slots=True)
class Compare:
    """Two pictures of one size in one place, with a slider that shows more of the one or of the other. Without script,
    and on paper, they stand side by side."""

    template: ClassVar = "compare"
    before: Picture
    after: Picture
    name: str


@dataclass(frozen=True, slots=True)
class Charts:
    """Plots; small ones stand beside each other where there is room."""

    template: ClassVar = "charts"
    items: tuple[Chart, ...]
    small: bool = False


@dataclass(frozen=True, slots=True)
class Discs:
    """Discs beside each other where there is room; `legend` says what each kind of dot stands for."""

    template: ClassVar = "discs"
    items: tuple[Disc, ...]
    legend: tuple[tuple[DotKind, str], ...]


@dataclass(frozen=True, slots=True)
class FigureLine:
    """A figure against its limit.

    Attributes:
        limit: with its sign; empty where there is none, and then `met` is None.
        margin: where the figure stands between failing (0), its limit (½) and plenty (1); None where that is unknown.
        advice: what to do; empty where the limit is met.
        decided: whether it entered the decision; one that did not is grey.
    """

    code: str
    title: str
    value: str
    unit: str
    limit: str
    met: bool | None
    margin: float | None
    meaning: str
    advice: str
    decided: bool = True


@dataclass(frozen=True, slots=True)
class Figures:
    """All figures that a verdict rests on."""

    template: ClassVar = "figures"
    caption: str
    lines: tuple[FigureLine, ...]


@dataclass(frozen=True, slots=True)
class Trend:
    """A plot as small as a word: a line and its band (x, low, middle, high) about `zero`; its scale reaches at least
    `least` to each side."""

    title: str
    points: tuple[tuple[float, float, float, float], ...]
    zero: float
    least: float


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of a table that is more than text.

    Attributes:
        href: file beside the page, or `#place` on it.
    """

    text: str
    tone: Tone | None = None
    href: str = ""
    trend: Trend | None = None
    code: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells. Columns whose index is in `numbers` hold numbers; in `prose`, sentences, which are folded. Wide
    tables scroll in a region of their own that the keyboard reaches."""

    template: ClassVar = "table"
    caption: str
    heads: tuple[str, ...]
    rows: Sequence[Sequence[str | Cell]]
    numbers: frozenset[int] = frozenset()
    prose: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and values: where something comes from, how it was found. `codes` are the names whose value is read letter
    by letter: hashes, a command."""

    template: ClassVar = "facts"
    items: tuple[tuple[str, str], ...]
    codes: frozenset[str] = frozenset()


Block = Text | VerdictBanner | AxesTable | Copies | Pictures | Compare | Charts | Discs | Figures | Table | Facts
"""The `template` of a block names its file in `templates/blocks`."""


@dataclass(frozen=True, slots=True)
class Section:
    """A headline and the blocks under it. A section of `level` 3 belongs to the last one of level 2."""

    title: str
    blocks: tuple[Block, ...]
    level: Literal[2, 3] = 2


@dataclass(frozen=True, slots=True)
class Page:
    """A document.

    Attributes:
        kind: what sort of page it is, shown above the title.
        title: of the document and of its headline.
        opening: blocks before the first section, a verdict first.
    """

    kind: str
    title: str
    opening: tuple[Block, ...]
    sections: tuple[Section, ...]


BUDGET_BYTES = 2_000_000
"""Limit for all pictures of a page: base64 makes 2.7 MB of it, and a page shall not be larger than 3 MB."""

LADDER = ((1920, 90), (1600, 84), (1400, 80), (1200, 76), (1000, 72), (800, 66), (640, 60), (480, 50))
"""Largest side (px) and WebP quality of all pictures that are too large as they are; the first step with which they fit
is taken. A page is at most 1040 px wide, and a screen may have two pixels for each of those."""

SMALL_SHARE = 1 / 8
"""A picture of at most this share of the budget stays as it is, to the byte."""

LIMITS = LimitsConfig()
"""Limits of a picture, because some come from a vehicle."""


@dataclass(frozen=True, slots=True)
class Embedded:
    """A picture as it stands in the page: its address, and its size, px."""

    uri: str
    width: int
    height: int


def embedded(pictures: Sequence[bytes], budget_bytes: int = BUDGET_BYTES) -> list[Embedded]:
    """All pictures of a page (bytes of PNG or JPEG files) in their order, together within the budget.

    Raises:
        DecodeError: one is no such picture, or there are so many that they do not fit even in the smallest form.
    """
    probed = [probe(data, LIMITS) for data in pictures]
    small = [len(data) <= SMALL_SHARE * budget_bytes for data in pictures]
    pixels = [None if as_is else decode_bgr(image, LIMITS) for image, as_is in zip(probed, small, strict=True)]
    for side_px, quality in LADDER:
        made = [
            _as_it_is(image) if large is None else _smaller(large, side_px, quality)
            for image, large in zip(probed, pixels, strict=True)
        ]
        if sum(len(data) for _, data in made) <= budget_bytes:
            return [
                Embedded(f"data:image/{kind};base64,{base64.b64encode(data).decode()}", image.width, image.height)
                for (kind, data), image in zip(made, probed, strict=True)
            ]
    raise DecodeError("pictures_too_large", f"{len(pictures)} pictures do not fit into one page: leave some out")


def _as_it_is(image: EncodedImage) -> tuple[str, bytes]:
    return image.format.value, bytes(image.data)


def _smaller(pixels: NDArray[np.uint8], side_px: int, quality: int) -> tuple[str, bytes]:
    share = side_px / max(pixels.shape[:2])
    shown = cv2.resize(pixels, None, fx=share, fy=share, interpolation=cv2.INTER_AREA) if share < 1.0 else pixels
    return "webp", cv2.imencode(".webp", shown, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()


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
    return user_files.write_output(path, render(page).encode())


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
        loader=PackageLoader("coec.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.globals.update(
        layout=charts.layout, legend=charts.legend, WIDE=charts.WIDE, NARROW=charts.NARROW, SMALL=charts.SMALL,
        disc_place=charts.dot_position, DISC_SIDE=charts.DISC_SIDE_PX, DISC_RADIUS=charts.DISC_RADIUS_PX,
        trend_paths=_trend_paths, TREND_WIDTH=TREND_WIDTH, TREND_HEIGHT=TREND_HEIGHT,
    )  # fmt: skip
    made.filters["prose"] = _prose
    made.tests["plain"] = lambda cell: isinstance(cell, str)
    return made


def _finalized(value: object) -> object:
    """What an expression of a template comes to, as it stands in the page before its markup is escaped."""
    return _escaped_controls(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _escaped_controls(text: str) -> str:
    """As `printable_lines`, but with the narrow space of `formatting` between digits, and before a percent sign."""
    narrow = "\N{NARROW NO-BREAK SPACE}"
    return narrow.join(printable_lines(part) for part in text.split(narrow))


def _prose(text: str) -> Markup:
    """A sentence as HTML. Text between two backticks is code; with an odd number of backticks none is."""
    text = _escaped_controls(text)
    parts = text.split("`")
    if len(parts) % 2 == 0:
        return escape(text)
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if index % 2 else part for index, part in enumerate(parts)
    )


@cache
def _asset(name: str) -> str:
    return (files("coec.reports") / "templates" / name).read_text(encoding="utf-8")


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
