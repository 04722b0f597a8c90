"""What pages have in common: their head with its style, and tables. Pages load nothing from anywhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

STYLE = """
:root{color-scheme:light dark;--line:#1769aa;--band:#1769aa33;--bad:#b3261e;--rule:#8884}
@media(prefers-color-scheme:dark){:root{--line:#7cc4ff;--band:#7cc4ff33;--bad:#ff8a80}}
body{font:15px/1.45 system-ui,sans-serif;margin:0 auto;max-width:1100px;padding:1rem}
h1{font-size:1.4rem}h2{font-size:1.1rem;margin-top:2rem}
.scroll{overflow-x:auto}table{border-collapse:collapse;width:100%}
th,td{padding:.25rem .6rem;text-align:left;border-bottom:1px solid var(--rule);white-space:nowrap;
font-variant-numeric:tabular-nums}
td.n,th.n{text-align:right}.bad{color:var(--bad);font-weight:600}.quiet{opacity:.7}
img{max-width:100%;height:auto}svg{display:block}polyline{fill:none;stroke:var(--line);stroke-width:1.5}polygon{fill:var(--band)}
.zero{stroke:var(--rule);stroke-width:1}
@media print{body{max-width:none}}
"""


def head(title: str) -> str:
    """The beginning of a page, up to its headline; `title` is text."""
    return "\n".join(
        (
            "<!doctype html><html lang=en><meta charset=utf-8>",
            "<meta name=viewport content='width=device-width,initial-scale=1'>",
            f"<title>{escape(title)}</title><style>{STYLE}</style><h1>{escape(title)}</h1>",
        )
    )


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: set[int]) -> str:
    """Cells are HTML already."""

    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{' class=n' if index in numbers else ''}>{value}</{tag}>" for index, value in enumerate(values)
        )

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return (
        f"<div class=scroll><table><thead><tr>{cells('th', head)}</tr></thead><tbody>\n{body}\n</tbody></table></div>"
    )
