"""What a page may be made of. No text is ever markup: what looks like markup is shown as written. In sentences, text
between two backticks is shown as code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from coec.reports.page.charts import Chart
from coec.reports.page.discs import Disc, DotKind

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
    """

    template: ClassVar = "axes"
    caption: str
    value_name: str
    lines: tuple[AxisLine, ...]
    more: tuple[str, ...] = ()


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
