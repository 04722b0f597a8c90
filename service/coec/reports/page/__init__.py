"""Every page that coec leaves, made of one small vocabulary of blocks: a command says what it has to tell as a `Page`,
`write` makes one HTML file of it that needs no other.

`blocks` is the vocabulary, `charts`, `ticks` and `discs` draw plots as SVG, `embedding` fits pictures into the page,
`rendering` puts all of it through the templates beside it. What is told stands with who tells it: `calibration_page`
and the like.
"""

from coec.reports.page.blocks import (
    AxesTable,
    AxisLine,
    Block,
    Cell,
    Charts,
    Compare,
    Copies,
    Copy,
    Discs,
    Facts,
    FigureLine,
    Figures,
    Page,
    Picture,
    Pictures,
    Section,
    Table,
    Text,
    Tone,
    Trend,
    Verdict,
)
from coec.reports.page.charts import Chart, Ground, Limit, Mark, Series
from coec.reports.page.discs import Disc, Dot, DotKind, Ring
from coec.reports.page.rendering import render, write

__all__ = [
    "AxesTable",
    "AxisLine",
    "Block",
    "Cell",
    "Chart",
    "Charts",
    "Compare",
    "Copies",
    "Copy",
    "Disc",
    "Discs",
    "Dot",
    "DotKind",
    "Facts",
    "FigureLine",
    "Figures",
    "Ground",
    "Limit",
    "Mark",
    "Page",
    "Picture",
    "Pictures",
    "Ring",
    "Section",
    "Series",
    "Table",
    "Text",
    "Tone",
    "Trend",
    "Verdict",
    "render",
    "write",
]
