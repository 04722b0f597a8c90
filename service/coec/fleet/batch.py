"""Evaluates many windows again: jobs -> engine -> rows -> tables. The folder of a batch holds its settings, the
finished rows, and the tables that are made of them.

A finished row is on the disk before the next one is awaited. So a batch that is stopped at any point, or whose machine
loses its power, loses only the windows under way. Rows wait in a journal until there are enough for a file of a table.
"""

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from coec.errors import DecodeError, OutputError, UsageError
from coec.fleet.evaluator import ReplaySettings
from coec.fleet.jobs import Job
from coec.fleet.report import optional_library, tabulated_urls, write_tables
from coec.fleet.worker_pool import Engine
from coec.io import storage, user_files
from coec.schemas.documents import BatchReport, WindowRow
from coec.schemas.message import from_json, to_json

SETTINGS_FILE, JOURNAL_FILE = "terms.json", "journal.jsonl"

ROWS_A_FILE = 512
"""Rows in one file of a table: files then have some megabytes, and at most so many rows are read again at a start."""


class BatchFolder:
    """The results of one batch. Call `finish` at its end, however it ends."""

    def __init__(self, folder: Path, settings: ReplaySettings, *, resume: bool) -> None:
        """Begins a folder, or continues one. A batch without a row, which failed before its first window, counts as
        none.

        Raises:
            UsageError: the folder holds a batch already, or one on other terms.
            OutputError: the folder cannot be written.
            SourceError: a table in it is damaged, or the libraries for tables are not installed.
        """
        self._folder = folder
        optional_library("pyarrow.parquet")  # before anything is written
        user_files.try_folder(folder)
        self._open(settings, resume=resume)
        self._written = tabulated_urls(folder)
        self._rows: list[WindowRow] = []
        self._journal = storage.LineLog(folder / JOURNAL_FILE, 2 * ROWS_A_FILE, self._lines)
        with self._writing(folder / JOURNAL_FILE):
            rows = [_row(line) for line in self._journal.load()]
        # A run that ended just after it wrote tables may have left their rows in the journal.
        self._rows = [row for row in rows if row is not None and row.url not in self._written]

    @property
    def urls(self) -> frozenset[str]:
        """URLs of the windows that have a row."""
        return frozenset(self._written | {row.url for row in self._rows})

    def add(self, row: WindowRow) -> None:
        """Adds the row of a finished window; it is on the disk when this returns.

        Raises:
            OutputError: it cannot be written.
        """
        self._rows.append(row)
        with self._writing(self._folder / JOURNAL_FILE):
            self._journal.add(to_json(row))
            self._journal.flush()
        if len(self._rows) >= ROWS_A_FILE:
            self.finish()

    def finish(self) -> None:
        """Writes the waiting rows into tables.

        Raises:
            OutputError: a table cannot be written. The rows stay in the journal, and the next run writes the tables.
        """
        if not self._rows:
            return
        # The name depends on the rows in the file, so that no file replaces one with other rows.
        urls = [row.url for row in self._rows]
        name = hashlib.sha256("\n".join(sorted(urls)).encode()).hexdigest()[:16]
        write_tables(self._folder, self._rows, f"part-{name}")
        self._written.update(urls)
        self._rows = []
        with self._writing(self._folder / JOURNAL_FILE):
            self._journal.renew()
            self._journal.flush()

    def _lines(self) -> Iterator[bytes]:
        return (to_json(row) for row in self._rows)

    def _open(self, settings: ReplaySettings, *, resume: bool) -> None:
        path = self._folder / SETTINGS_FILE
        try:
            stored = json.loads(path.read_bytes())["fingerprint"]
        except (FileNotFoundError, NotADirectoryError):  # if the folder cannot be made, `output.replace` raises
            stored = None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(f"{path} cannot be read ({error}): choose another folder") from error
        if stored is None or not self._has_rows():
            document = {"fingerprint": settings.fingerprint, "terms": settings.model_dump(mode="json")}
            user_files.replace_output(path, json.dumps(document, sort_keys=True, indent=1).encode())
        elif not resume:
            raise UsageError(
                f"{self._folder} holds a batch: --resume goes on with it, choose another folder to start a new batch"
            )
        elif stored != settings.fingerprint:
            raise UsageError(
                f"{self._folder} holds a batch of another configuration, rig, network or version of coec: its rows "
                "cannot be compared with new ones; choose another folder"
            )

    def _has_rows(self) -> bool:
        """Whether a window of the batch in the folder has a row, readable or not."""
        with suppress(OSError):
            if (self._folder / JOURNAL_FILE).stat().st_size > 0:
                return True
        return next(self._folder.glob("date=*/vehicle=*/*.parquet"), None) is not None

    @contextmanager
    def _writing(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error


def _row(line: bytes) -> WindowRow | None:
    """The row in a line of the journal. None: the line is damaged, and its window is judged again."""
    try:
        return from_json(WindowRow, line)
    except DecodeError:
        return None


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
        settings: the terms on which all windows are judged.
        engine: the engine that judges them.
        folder: folder for the tables. If it already holds a batch, that batch is continued.
        on_row: called with every row, once it is on the disk.
        resume: whether the folder may already hold a batch.

    Raises:
        UsageError, OutputError, SourceError: the folder cannot be used; see `BatchFolder`.
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
