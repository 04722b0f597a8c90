"""The page on the figures of self-diagnosis, from the table that also explains them in verdicts and reports."""

from __future__ import annotations

from coec.calibration.figures import FIGURES
from generate.markdown import WRITTEN, code, prose, table

HEAD = """\
# Figures

{written}
Every figure of self-diagnosis, of calibrations and of checks: what it tells, what it means where it does not keep its
limit, and what to do then. How limits come about: [the verdict](verdict.md), [the change detector](change.md).

{table}"""


def figures_page() -> str:
    """Markdown: every figure."""
    heads = ("figure", "name, unit", "what it tells", "beyond its limit", "what to do")
    rows = [
        (
            code(name),
            f"{one.title}, {one.unit}" if one.unit else one.title,
            prose(one.tells),
            prose(one.fails),
            prose(one.advice),
        )
        for name, one in FIGURES.items()
    ]
    return HEAD.format(written=WRITTEN, table=table(heads, rows))
