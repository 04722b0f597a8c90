"""The live view of the demonstration in a terminal; without a terminal, a line for each turn of the story."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType

from rich.console import Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from coec.reports import console
from coec.reports.page.words import count
from coec.reports.progress import COMPILING, COMPILING_S, CompilingNews
from coec_lab.demo import story
from coec_lab.demo.watch import Seen, Watch

BARS = "▁▂▃▄▅▆▇█"
BAR_WIDTH = 48
CURVE_WIDTH = 72

FIGURES = ("distance_rotation", "distance_pose", "edges_per_pair", "overlap", "mi")
"""Figures of the latest check of the monitor: those by which it decides, and mutual information."""


STARTING = "starting"
"""State of a worker that compiles its kernels, or reads them from the cache, before its first job."""


class Screen:
    """Shows, while it is open, what the client sees."""

    def __init__(self) -> None:
        self._live = Live(console=console.err, transient=True, auto_refresh=False)
        self._told = ""
        self._news = CompilingNews(time.monotonic)
        self._said_compiling = False

    def __enter__(self) -> Screen:
        self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._live.stop()

    def hear(self, kernel: str) -> None:
        """Called by `compile_news` when a kernel is being compiled in this process."""
        self._news.hear(kernel)
        if self._news.lasted_s >= COMPILING_S:
            self._compiling(f"{COMPILING}: {self._news.kernels} so far, {self._news.lasted_s:.0f} s")

    def _compiling(self, text: str) -> None:
        if console.err.is_terminal:
            self.wait(text)
        elif not self._said_compiling:
            self._said_compiling = True
            console.say(f"demo: {COMPILING}; the drive begins then")

    def wait(self, what: str) -> None:
        """Shows a text while there is nothing to see yet."""
        if console.err.is_terminal:
            self._live.update(Panel(Text(what), title="coec demo", width=CURVE_WIDTH + 30), refresh=True)

    def show(self, watch: Watch, seen: Seen) -> None:
        """Shows the latest answers."""
        if console.err.is_terminal:
            self._live.update(view(watch, seen), refresh=True)
            return
        moment = seen.moment
        if seen.status.worker.state == STARTING and moment.t_s > COMPILING_S:
            self._compiling("")
            return
        told = f"{moment.health}, {moment.provenance}"
        if told != self._told:
            self._told = told
            console.say(f"demo: {moment.drive_s:5.1f} s of driving: {told}, {moment.error_deg:.2f}° from the truth")


def view(watch: Watch, seen: Seen) -> RenderableType:
    """The whole view of one instant."""
    moment, pair = seen.moment, seen.pair
    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="bold")
    rows.add_column()
    rows.add_row("drive", _drive(moment.drive_s) if seen.status.worker.state != STARTING else _before(moment.t_s))
    rows.add_row("health", Text.assemble(console.styled(moment.health), "  ", _reason(seen)))
    rows.add_row("error against the truth", _error(seen))
    rows.add_row("", curve(watch.series))
    rows.add_row("extrinsic", f"{moment.provenance}, {console.attempt(moment.status)}")
    rows.add_row("correction", "  ".join(f"{value:+.3f}°" for value in moment.correction_deg) + "  pitch, yaw, roll")
    rows.add_row("next window", _window(pair.selected))
    so_far = (count(pair.pairs, "pair"), count(pair.checks, "check"), count(pair.solved, "window"))
    rows.add_row("so far", f"{', '.join(so_far)} solved ({_worker(seen)})")
    return Panel(Group(rows, Text(), _figures(seen)), title=f"coec demo  {moment.t_s:.0f} s", width=CURVE_WIDTH + 30)


def curve(series: Sequence[tuple[float, float, str]], width: int = CURVE_WIDTH) -> Text:
    """The error over the drive as a row of bars, from 0 to a little more than the knock, in the colours of health."""
    latest: dict[int, tuple[float, str]] = {}
    seconds_per_bar = max(1.0, (series[-1][0] + 1.0) / width) if series else 1.0
    for second, error_deg, health in series:
        latest[int(second / seconds_per_bar)] = (error_deg, health)
    text = Text()
    for column in range(max(latest, default=-1) + 1):
        if column not in latest:
            text.append(" ")
            continue
        error_deg, health = latest[column]
        height = min(int(error_deg / (story.KNOCK_DEG * 1.1) * len(BARS)), len(BARS) - 1)
        text.append(BARS[height], console.STATE_STYLES.get(health, "dim"))
    return text


def _before(t_s: float) -> Text:
    """Text while the drive waits for the worker to start."""
    return Text(f"waits: kernels compile, once, for about a minute; {t_s:.0f} s so far")


def _drive(second: float) -> Text:
    if second < story.KNOCK_S:
        return Text(f"{second:5.1f} s   the mount is knocked by {story.KNOCK_DEG:g}° in {story.KNOCK_S - second:.0f} s")
    ago = f"{second - story.KNOCK_S:.0f} s ago"
    return Text.assemble(f"{second:5.1f} s   ", (f"KNOCKED by {story.KNOCK_DEG:g}° {ago}", "bold magenta"))


def _error(seen: Seen) -> Text:
    style = "bold green" if seen.moment.error_deg < story.MAX_ERROR_DEG else "bold red"
    return Text(f"{seen.moment.error_deg:.3f}°", style)


def _reason(seen: Seen) -> str:
    if seen.health.reasons:
        return seen.health.reasons[0].text
    figures = (seen.health.metrics.get(name) for name in FIGURES)
    if any(figure is not None and not figure.passed for figure in figures):
        return "The latest check speaks against it; one check alone is not believed."
    return "The monitor finds nothing wrong."


def _worker(seen: Seen) -> str:
    return {"idle": "idle", "busy": "at work"}.get(seen.status.worker.state, seen.status.worker.state)


def _window(selected: int) -> RenderableType:
    grid = Table.grid(padding=(0, 2))
    bar = ProgressBar(total=story.WINDOW.pairs, completed=selected, width=BAR_WIDTH)
    grid.add_row(bar, f"{selected} of {story.WINDOW.pairs} pairs")
    return grid


def _figures(seen: Seen) -> Table:
    table = console.table("figure of the latest check", "value", "limit", "", right=(1,))
    for name in FIGURES:
        metric = seen.health.metrics.get(name)
        if metric is None:
            table.add_row(name, "-", "", "")
            continue
        table.add_row(name, console.figure(metric.value), *console.limit_of(metric))
    return table
