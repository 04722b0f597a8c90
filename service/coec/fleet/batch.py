"""Judges many windows again, on one page: jobs -> engine -> rows -> tables."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from coec.fleet.engines.engine import Engine
from coec.fleet.places import Job
from coec.fleet.results import BatchFolder
from coec.fleet.terms import ReplaySettings
from coec.schemas.fleet import BatchReport, WindowRow


def run(
    jobs: Sequence[Job],
    settings: ReplaySettings,
    engine: Engine,
    folder: Path,
    on_row: Callable[[WindowRow], object],
    *,
    resume: bool,
) -> BatchReport:
    """Judges windows, and writes tables of the results into a folder.

    Args:
        jobs: the windows.
        terms: the terms on which all windows are judged.
        engine: the engine that judges them.
        folder: folder for the tables. If it already holds a batch, that batch is continued.
        told: called with every row, once it is on the disk.
        resume: whether the folder may already hold a batch.

    Raises:
        UsageError, OutputError, SourceError: the folder cannot be used; see `Results`.
        FleetError: the engine failed, or windows could not be judged for a common cause. Finished rows are kept.
    """
    results = BatchFolder(folder, settings, resume=resume)
    evaluated_urls = results.urls
    remaining = [job for job in jobs if job.url not in evaluated_urls]
    tally = _Tally()
    started_s = time.monotonic()
    try:
        for row in engine.rows(remaining, settings):
            results.add(row)
            tally.add(row)
            on_row(row)
    finally:  # so that an interrupted batch has its tables, too
        results.finish()
    elapsed_s = time.monotonic() - started_s
    return tally.report(folder, len(jobs), len(jobs) - len(remaining), elapsed_s, engine.cores)


class _Tally:
    """Counts of the rows of one run."""

    def __init__(self) -> None:
        self._accepted = self._refused = self._compared = self._differing = 0
        self._errors: Counter[str] = Counter()
        self._seconds = self._cpu_s = 0.0

    def add(self, row: WindowRow) -> None:
        """Counts one more row."""
        self._seconds += row.seconds
        self._cpu_s += row.cpu_s
        if row.error_code is not None:
            self._errors[row.error_code] += 1
        if row.result is not None:
            accepted = row.result.verdict.decision == "accepted"
            self._accepted += accepted
            self._refused += not accepted
            self._compared += row.recorded is not None
            self._differing += row.recorded not in (None, row.decided)

    def report(self, folder: Path, windows: int, evaluated_before: int, elapsed_s: float, cores: int) -> BatchReport:
        """The report of this run."""
        has_run = windows > evaluated_before and elapsed_s > 0.0
        return BatchReport(
            output=str(folder),
            windows=windows,
            kept=evaluated_before,
            accepted=self._accepted,
            refused=self._refused,
            errors=dict(sorted(self._errors.items())),
            compared=self._compared,
            differing=self._differing,
            elapsed_s=elapsed_s,
            cpu_s=self._cpu_s,
            share_of_ideal=self._seconds / (cores * elapsed_s) if has_run else None,
        )
