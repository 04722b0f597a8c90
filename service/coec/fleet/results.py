"""The folder of a batch: its terms, the finished rows, and the tables that are made of them.

A finished row is on the disk before the next one is awaited. So a batch that is stopped at any point, or whose machine
loses its power, loses only the windows under way. Rows wait in a journal until there are enough for a file of a table.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from coec.adapters.files import durable, output
from coec.errors import DecodeError, OutputError, UsageError
from coec.fleet import tables
from coec.fleet.extra import optional_library
from coec.fleet.terms import ReplaySettings
from coec.schemas.base import from_json, to_json
from coec.schemas.fleet import WindowRow

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
        self._open(settings, resume=resume)
        self._written = tables.tabulated_urls(folder)
        self._rows: list[WindowRow] = []
        self._journal = durable.LineLog(folder / JOURNAL_FILE, 2 * ROWS_A_FILE, self._lines)
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
        tables.write_tables(self._folder, self._rows, f"part-{name}")
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
            output.replace_output(path, json.dumps(document, sort_keys=True, indent=1).encode())
        elif not resume:
            raise UsageError(f"{self._folder} holds a batch: --resume goes on with it, another folder begins anew")
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
