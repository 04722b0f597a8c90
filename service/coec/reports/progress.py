"""Progress on standard error: bars in a terminal, elsewhere a line now and then, so that no wait is silent; and how
long the stages of a calibration took.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from coec.geometry import compilation_events
from coec.untrusted import printable

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
        """Called by `compile_news` when a kernel is begun."""
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


class PlainColumn(TextColumn):
    """A column of text that is shown as it is, on one line: names in it come from recordings and vehicles."""

    def __init__(self, text_format: str) -> None:
        super().__init__(text_format, markup=False)

    def render(self, task: Task) -> Text:
        """The text of a task."""
        return Text(printable(self.text_format.format(task=task)))


class Bars(Progress):
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
        self._compiling: TaskID | None = None
        count = (MofNCompleteColumn(),) if counted else ()
        super().__init__(
            SpinnerColumn("dots" if console.encoding.startswith("utf") else "line"),
            PlainColumn("{task.description}"),
            BarColumn(),
            *count,
            TimeElapsedColumn(),
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

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Updates a task as in rich, and prints a line when it is time."""
        super().update(task_id, **changes)
        if self.disable and self._is_time():
            self._say(f"coec: {self._line(self._tasks[task_id])}")

    def _line(self, task: Task) -> str:
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

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._tasks: dict[str, TaskID] = {}
        self._mark_s = self._start_s = time.perf_counter()
        self._elapsed_s: dict[str, float] = {}

    def step(self, stage: str, done: int, total: int) -> None:
        """See `ports.Progress`. A search has no total: its number of evaluations is unknown until it ends."""
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
