"""How commands print: documents and tables on standard output, progress and remarks on standard error."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from coec.reports import plain_text
from coec.reports.progress import Bars
from coec.schemas import replies

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
AXIS_NAMES = ("rx pitch", "ry yaw", "rz roll", "tx right", "ty down", "tz forward")
UNITS = ("deg", "deg", "deg", "m", "m", "m")

STATE_STYLES = {
    "healthy": "bold green",
    "accepted": "bold green",
    "suspect": "bold yellow",
    "degraded": "bold yellow",
    "failed": "bold red",
    "miscalibrated": "bold red",
    "calibrated": "bold green",
    "undecided": "bold yellow",
    "camera_moved": "bold red",
    "lidar_moved": "bold red",
}
"""A state that is not listed is neither good nor bad."""

PIPE_WIDTH = 140
"""Columns where standard output is no terminal, so that lines of a log are not folded."""


def made(environment: Mapping[str, str], *, on_error: bool = False) -> Console:
    """A console on standard output, or on standard error. A plain one is no terminal to rich: no colours, no bold,
    nothing that moves."""
    width = PIPE_WIDTH if not on_error and not sys.stdout.isatty() else None
    if plain_text.wants_plain(environment):
        return Console(stderr=on_error, highlight=False, width=width, force_terminal=False, color_system=None)
    return Console(stderr=on_error, highlight=False, width=width)


out = made(os.environ)
err = made(os.environ, on_error=True)


def print_json(document: Any) -> None:
    """The one document of `--json`: a line with sorted keys, floats in the shortest form that reads back exactly."""
    escaped = not plain_text.is_unicode(sys.stdout.encoding)
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=escaped, allow_nan=False)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def raw(text: str) -> None:
    """Prints text that is meant as a file to standard output, unchanged."""
    sys.stdout.write(text)
    sys.stdout.flush()


def plain(text: str) -> str:
    """The text without control characters that a terminal would obey, because some of it came over a network. Signs
    that the terminal lacks are replaced here, so that columns stay in line."""
    obeyed = "".join(character if character.isprintable() or character in "\n\t" else "\ufffd" for character in text)
    return obeyed if plain_text.is_unicode(out.encoding) else plain_text.encodable(obeyed, out.encoding)


def say(text: str) -> None:
    """Prints a remark, as it is, on standard error."""
    err.print(Text(plain(text)), soft_wrap=True)


def show(text: str, style: str = "") -> None:
    """Prints a line, as it is, on standard output."""
    out.print(Text(plain(text), style=style), soft_wrap=True)


def progress(*, counted: bool = True) -> Bars:
    """A progress display on standard error that disappears when it is done. Where standard error is not a terminal, a
    line now and then."""
    return Bars(err, say, counted=counted)


def table(*columns: str, right: Iterable[int] = ()) -> Table:
    """A table; the columns whose index is in `right` hold numbers."""
    columned = _PlainTable(box=None, pad_edge=False, header_style="bold")
    numbers = set(right)
    for index, column in enumerate(columns):
        columned.add_column(plain(column), justify="right" if index in numbers else "left", overflow="fold")
    return columned


class _PlainTable(Table):
    """A table whose text cells are shown as plain text, never as markup."""

    def add_row(self, *cells: RenderableType | None, **more: Any) -> None:
        super().add_row(*(Text(plain(cell)) if isinstance(cell, str) else cell for cell in cells), **more)


def figure(value: float | None, digits: int = 3, sign: bool = False) -> str:
    """A number for people: `-` where there is none, and no exponent below a million."""
    if value is None:
        return "-"
    if abs(value) >= 1e6:
        return f"{value:.1e}"
    # Adding zero turns -0 into 0.
    return f"{round(value, digits) + 0.0:{'+' if sign else ''}.{digits}f}"


def styled(state: str) -> Text:
    """A state in its colour."""
    return Text(state, style=STATE_STYLES.get(state, "bold"))


def show_verdict(result: replies.CalibrationResult) -> None:
    """Prints the decision, the reasons in words, and every figure beside its limit."""
    out.print("verdict ", styled(result.verdict.decision), sep="")
    for reason in result.verdict.reasons:
        show(f"  {reason.code}: {reason.text}", "yellow")
    show_metrics(result.metrics)


def show_metrics(metrics: dict[str, replies.MetricReply]) -> None:
    """Prints every figure beside the limit that judged it."""
    if not metrics:
        return
    figures = table("figure", "value", "limit", "", right=(1,))
    for name, metric in metrics.items():
        figures.add_row(name, figure(metric.value), *limit_of(metric))
    out.print(figures)


def limit_of(metric: replies.MetricReply) -> tuple[str, Text]:
    """The limit of a figure, and whether the figure meets it; both empty without a limit, as before commissioning."""
    if metric.limit is None:
        return "", Text()
    limit = f"{'≥' if metric.at_least else '≤'} {figure(metric.limit)}"
    return limit, Text(plain("✓"), "green") if metric.passed else Text(plain("✗"), "red")
