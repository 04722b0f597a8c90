"""How commands print: documents and tables on standard output, progress and remarks on standard error.

Whatever is printed may hold text that came over a network or out of a recording. Nothing here lets a control character
other than a line break through, except those of the styles and of the cursor that rich makes itself; none of it is read
as markup.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.highlighter import JSONHighlighter
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from coec.reports import plain_text
from coec.reports.progress import Bars
from coec.schemas import replies
from coec.untrusted import json_printable, printable, printable_lines

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


class EscapingConsole(Console):
    """A console that escapes control characters in all text that it renders, before rich adds styles, and that reads no
    text as markup."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of a renderable, as rich makes them, with their text escaped. Segments with control codes are
        those with which rich moves the cursor."""
        for segment in super().render(renderable, options):
            text = segment.text
            if segment.control or (text.isascii() and text.isprintable()):
                yield segment
            else:
                yield Segment(printable_lines(text), segment.style)


def made(environment: Mapping[str, str], *, on_error: bool = False) -> Console:
    """A console on standard output, or on standard error. A plain one is no terminal to rich: no colours, no bold,
    nothing that moves."""
    width = PIPE_WIDTH if not on_error and not sys.stdout.isatty() else None
    if plain_text.wants_plain(environment):
        return EscapingConsole(stderr=on_error, width=width, force_terminal=False, color_system=None)
    return EscapingConsole(stderr=on_error, width=width)


out = made(os.environ)
err = made(os.environ, on_error=True)


def print_json(document: Any) -> None:
    """The one document of `--json`: a line with sorted keys, floats in the shortest form that reads back exactly."""
    escaped = not plain_text.is_unicode(sys.stdout.encoding)
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=escaped, allow_nan=False)
    plain_text.write(f"{json_printable(text)}\n")


def show_json(document: Any) -> None:
    """A JSON document for people, on standard output: indented, and in colours on a terminal."""
    escaped = not plain_text.is_unicode(sys.stdout.encoding)
    text = json_printable(json.dumps(document, indent=2, ensure_ascii=escaped, allow_nan=False))
    out.print(JSONHighlighter()(Text(text)), soft_wrap=True)


def write(text: str) -> None:
    """Writes text that is meant as a file to standard output, without styles or folding."""
    plain_text.write(text)


def plain(text: str) -> str:
    """The text as one line without anything that a terminal would obey, because some of it came over a network. Signs
    that the terminal lacks are replaced here, so that columns stay in line."""
    shown = printable(text, None)
    return shown if plain_text.is_unicode(out.encoding) else plain_text.encodable(shown, out.encoding)


def say(text: str) -> None:
    """Prints a remark, as it is, as one line on standard error."""
    err.print(Text(plain(text)), soft_wrap=True)


def show(text: str, style: str = "") -> None:
    """Prints a text, as it is, as one line on standard output."""
    out.print(Text(plain(text), style=style), soft_wrap=True)


def show_lines(text: str) -> None:
    """Prints a document of several lines, as it is, on standard output."""
    for line in text.split("\n"):
        show(line)


def progress(*, counted: bool = True, compiling: bool = True) -> Bars:
    """A progress display on standard error that disappears when it is done. Where standard error is not a terminal, a
    line now and then. `compiling`: it also shows when kernels are compiled."""
    return Bars(err, say, counted=counted, compiling=compiling)


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


def attempt(status: str | None) -> Text:
    """How the latest calibration ended, by the `status` of a reply. None: nothing is known of the pair's sensors yet.

    On the wire, `not_accepted` stands before the first attempt; an attempt whose result is refused has `failed`.
    """
    if status in (None, "not_accepted"):
        return Text("no attempt yet")
    return Text("latest attempt ").append_text(styled(status))


def styled(state: str) -> Text:
    """A state in its colour."""
    return Text(plain(state), style=STATE_STYLES.get(state, "bold"))


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
