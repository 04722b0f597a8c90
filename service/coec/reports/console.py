"""How commands print: documents and tables on standard output, progress and remarks on standard error.

Whatever is printed may hold text that came over a network or out of a recording. Nothing here lets a control character
other than a line break through, except those of the styles and of the cursor that rich makes itself; none of it is read
as markup.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich import progress as rich_progress
from rich.console import Console, ConsoleOptions, RenderableType
from rich.highlighter import JSONHighlighter
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from coec.geometry import compilation_events
from coec.reports import formatting
from coec.untrusted import json_printable, printable, printable_lines

if TYPE_CHECKING:
    from coec.reports import page
    from coec.schemas import replies

LINE_S = 30.0
"""Time between two lines without a terminal: the log of an hour has about a hundred."""

COMPILING_S = 2.0
"""A shorter wait for the compiler is not reported."""

COMPILING = "compiling the kernels, once on this machine, for about a minute"


class CompilationProgress:
    """A compilation in progress: how many `kernels` were begun, and how long ago the first was (`lasted_s`)."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._began_s: float | None = None
        self._names: set[str] = set()

    def on_kernel(self, kernel: str) -> None:
        """Called by `compilation_events` when a kernel is begun."""
        if self._began_s is None:
            self._began_s = self._now_s()
        self._names.add(kernel)

    @property
    def kernels(self) -> int:
        """How many were begun up to now."""
        return len(self._names)

    @property
    def lasted_s(self) -> float:
        """Seconds since the first began; 0 before that."""
        return 0.0 if self._began_s is None else self._now_s() - self._began_s


class PlainColumn(rich_progress.TextColumn):
    """A column of text that is shown as it is, on one line: names in it come from recordings and vehicles."""

    def __init__(self, text_format: str) -> None:
        super().__init__(text_format, markup=False)

    def render(self, task: rich_progress.Task) -> Text:
        """The text of a task."""
        return Text(printable(self.text_format.format(task=task)))


class Bars(rich_progress.Progress):
    """A bar for each task that disappears when all is done. Where the console is no terminal, a line on the current
    task every half minute; quicker work gets none."""

    def __init__(
        self,
        console: Console,
        say: Callable[[str], None],
        *,
        counted: bool,
        compiling: bool = True,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """`say` prints a line; `counted` shows how many of how many parts are done, `compiling` a task of its own
        while kernels are compiled."""
        self._say = say
        self._counted = counted
        self._now_s = now_s
        self._reported_s = now_s()
        self._news = CompilationProgress(now_s)
        self._listening: AbstractContextManager[None] = (
            compilation_events.listening(self._on_kernel) if compiling else nullcontext()
        )
        self._compiling: rich_progress.TaskID | None = None
        count = (rich_progress.MofNCompleteColumn(),) if counted else ()
        super().__init__(
            rich_progress.SpinnerColumn("dots" if console.encoding.startswith("utf") else "line"),
            PlainColumn("{task.description}"),
            rich_progress.BarColumn(),
            *count,
            rich_progress.TimeElapsedColumn(),
            PlainColumn("{task.fields[note]}"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> Bars:
        self._listening.__enter__()
        super().__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        super().__exit__(kind, error, at)
        self._listening.__exit__(None, None, None)

    def add_download(self, description: str) -> Callable[[int, int], None]:
        """Adds a task that is told, by a call of what this returns, how many bytes are there and how many there will
        be."""
        task = self.add_task(description, note="")

        def on_progress(done: int, total: int) -> None:
            self.update(task, completed=done, total=total, note=f"{done / 1e6:.1f} of {total / 1e6:.1f} MB")

        return on_progress

    def update(self, task_id: rich_progress.TaskID, **changes: Any) -> None:
        """Updates a task as in rich, and prints a line when it is time."""
        super().update(task_id, **changes)
        if self.disable and self._is_time():
            self._say(f"coec: {self._line(self._tasks[task_id])}")

    def _line(self, task: rich_progress.Task) -> str:
        """What a task does, how far it is if that is counted, and its note."""
        done = f"{task.completed:g}" + ("" if task.total is None else f" of {task.total:g}") if self._counted else ""
        so_far = ", ".join(part for part in (done, task.fields.get("note", "")) if part)
        return f"{task.description}: {so_far}" if so_far else task.description

    def _on_kernel(self, kernel: str) -> None:
        self._news.on_kernel(kernel)
        if self._news.lasted_s < COMPILING_S:
            return
        first = self._compiling is None
        if first:
            self._compiling = self.add_task(COMPILING, total=None, note="")
        assert self._compiling is not None
        super().update(self._compiling, completed=self._news.kernels, note=f"{self._news.kernels} so far")
        if self.disable and (first or self._is_time()):
            self._reported_s = self._now_s()
            self._say(f"coec: {COMPILING}: {self._news.kernels} so far")

    def _is_time(self) -> bool:
        if self._now_s() - self._reported_s < LINE_S:
            return False
        self._reported_s = self._now_s()
        return True


class StageTimes:
    """Progress bars and the seconds that each stage took. A stage ends with its last step."""

    def __init__(self, bars: rich_progress.Progress) -> None:
        self._bars = bars
        self._tasks: dict[str, rich_progress.TaskID] = {}
        self._mark_s = self._start_s = time.perf_counter()
        self._elapsed_s: dict[str, float] = {}

    def step(self, stage: str, done: int, total: int) -> None:
        """See `calibration.types.Progress`. A search has no total: its number of evaluations is unknown until it
        ends."""
        now_s = time.perf_counter()
        self._elapsed_s[stage] = self._elapsed_s.get(stage, 0.0) + now_s - self._mark_s
        self._mark_s = now_s
        if stage not in self._tasks:
            open_end = stage == "search"
            self._tasks[stage] = self._bars.add_task(stage, total=None if open_end else total, note="")
        note = f"{done} evaluations" if stage == "search" else ""
        self._bars.update(self._tasks[stage], completed=done, note=note)

    def elapsed_s(self) -> dict[str, float]:
        """Seconds by stage, and in `total`."""
        return {**self._elapsed_s, "total": time.perf_counter() - self._start_s}


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

TONE_STYLES: Mapping[page.Tone, str] = {
    "good": "bold green",
    "unsure": "bold yellow",
    "poor": "bold yellow",
    "bad": "bold red",
    "none": "bold",
}

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
    if formatting.wants_plain(environment):
        return EscapingConsole(stderr=on_error, width=width, force_terminal=False, color_system=None)
    return EscapingConsole(stderr=on_error, width=width)


out = made(os.environ)
err = made(os.environ, on_error=True)


def report(document: Any, show: Callable[[], object], *, as_json: bool) -> None:
    """Prints the outcome of a command: with `--json` as the one document, else for people, by `show`."""
    if as_json:
        print_json(document)
    else:
        show()


def print_json(document: Any) -> None:
    """The one document of `--json`, a wire model or what JSON consists of: a line with sorted keys, floats in the
    shortest form that reads back exactly."""
    if hasattr(document, "model_dump"):
        document = document.model_dump(mode="json")
    escaped = not formatting.is_unicode(sys.stdout.encoding)
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=escaped, allow_nan=False)
    formatting.write(f"{json_printable(text)}\n")


def show_json(document: Any) -> None:
    """A JSON document for people, on standard output: indented, and in colours on a terminal."""
    escaped = not formatting.is_unicode(sys.stdout.encoding)
    text = json_printable(json.dumps(document, indent=2, ensure_ascii=escaped, allow_nan=False))
    out.print(JSONHighlighter()(Text(text)), soft_wrap=True)


def write(text: str) -> None:
    """Writes text that is meant as a file to standard output, without styles or folding."""
    formatting.write(text)


def plain(text: str) -> str:
    """The text as one line without anything that a terminal would obey, because some of it came over a network. Signs
    that the terminal lacks are replaced here, so that columns stay in line; so are the narrow spaces of figures."""
    shown = printable(text.replace("\N{NARROW NO-BREAK SPACE}", " "), None)
    return shown if formatting.is_unicode(out.encoding) else formatting.encodable(shown, out.encoding)


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


def show_section(section: page.Section) -> None:
    """Prints what can be printed of a section of a page: its title, tables, facts and texts."""
    show(section.title, "bold")
    for block in section.blocks:
        show_block(block)


def show_block(block: page.Block) -> None:
    """Prints a table, facts or texts of a page; blocks of other kinds are for the page alone."""
    # The library that fills pages is loaded by the few commands that make them.
    from coec.reports import page

    if isinstance(block, page.Table):
        show(block.caption)
        printed = table(*block.heads, right=block.numbers)
        for row in block.rows:
            printed.add_row(*(_cell(cell) for cell in row))
        out.print(printed)
    elif isinstance(block, page.Facts):
        printed = table("", "")
        printed.show_header = False
        for item in block.items:
            printed.add_row(*item)
        out.print(printed)
    elif isinstance(block, page.Text):
        for paragraph in block.paragraphs:
            show(paragraph, "dim" if block.quiet else "")


def _cell(cell: str | page.Cell) -> RenderableType:
    if isinstance(cell, str):
        return cell
    return cell.text if cell.tone is None else Text(plain(cell.text), TONE_STYLES[cell.tone])


def show_verdict(result: replies.CalibrationResult, mistake: str = "") -> None:
    """Prints the decision, a mistake in the inputs as its cause, the reasons, and every figure beside its limit."""
    out.print("verdict ", styled(result.verdict.decision), sep="")
    if mistake:
        show(f"  probable cause: {mistake}", "bold yellow")
    for reason in result.verdict.reasons:
        out.print(
            Text(f"  {plain(reason.text)}", "yellow"), Text(f" ({plain(reason.code)})", "dim"), sep="", soft_wrap=True
        )
    show_metrics(result.metrics)


def show_metrics(metrics: dict[str, replies.MetricReply], deciding: frozenset[str] | None = None) -> None:
    """Prints every figure beside the limit that judged it. Figures that are not among the `deciding` ones (None: all
    decide) are faint and in brackets."""
    if not metrics:
        return
    figures = table("figure", "value", "limit", "", right=(1,))
    for name, metric in metrics.items():
        limit, mark = limit_of(metric)
        decided = deciding is None or name in deciding
        mark = mark if decided or not mark else Text(f"({mark.plain})")
        figures.add_row(name, figure(metric.value), limit, mark, style="" if decided else "dim")
    out.print(figures)
    if deciding is not None:
        show("Figures with their mark in brackets, or without one, did not enter the decision.", "dim")


def limit_of(metric: replies.MetricReply) -> tuple[str, Text]:
    """The limit of a figure, and whether the figure meets it; both empty without a limit, as before commissioning."""
    if metric.limit is None:
        return "", Text()
    limit = f"{'≥' if metric.at_least else '≤'} {figure(metric.limit)}"
    return limit, Text(plain("✓"), "green") if metric.passed else Text(plain("✗"), "red")
