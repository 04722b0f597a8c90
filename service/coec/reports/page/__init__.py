"""Every page that coec writes is made of one small vocabulary of blocks: a command describes its content as a `Page`,
and `write` makes one self-contained HTML file of it.

`blocks` is the vocabulary; `charts`, `ticks` and `discs` draw plots as SVG; `embedding` fits pictures into the page;
`rendering` fills the templates beside it. The content of each page is in a module of its own, such as
`calibration_page`.
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
    VerdictBanner,
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
    "VerdictBanner",
    "render",
    "write",
]
