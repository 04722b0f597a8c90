"""Progress of a calibration for people who wait, and how long its stages took."""

from __future__ import annotations

import time

from rich.progress import Progress, TaskID


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
