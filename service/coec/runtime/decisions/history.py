"""The history of a pair, in three books. Each has its own quota, so that none can push out what another holds.

- `results`: the estimate of each window, and the extrinsic that was served because of it. That is all that a roll back
  and a commissioning need.
- `states`: changes of health, and damage that was found in a book.
- `commands`: commands of people, the extrinsics that they put in place, and the outcomes of windows that are solved
  again, which happens only by command. A flood of commands pushes out only entries of this book.

Each book is a hash chain in a file of its own. The entries of all books are numbered together, in the order in which
they came.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from coec.calibration.lifecycle import Provenance
from coec.errors import StateError
from coec.runtime.decisions.chain import HashChain, HistoryRecord
from coec.schemas.replies import Book, CalibrationResult, HistoryEntry

FILES: Final[Mapping[Book, str]] = {"results": "history", "states": "states", "commands": "commands"}
"""First part of the file name of each book."""


class PairHistory:
    """The three books of one pair. Safe to use from several threads.

    Only `flush` waits for the disk, and no other call waits for `flush`. Entries of a book are written in order, so the
    chains on the disk are sound at any time.

    Attributes:
        damage: what was wrong with the chains on the disk at the start, one sentence; None if they were sound.
    """

    def __init__(self, folder: Path, pair: str, limit: int, heads: Mapping[str, str]) -> None:
        """
        Args:
            limit: how many entries, the newest, are kept in each book.
            heads: the `durable_heads` in the state file; a chain that does not reach its head was cut off.
        """
        self._lock = threading.Lock()
        self._books = {
            book: HashChain(folder / f"{name}-{pair}.jsonl", limit, heads.get(book)) for book, name in FILES.items()
        }
        damages = [f"{book}: {chain.damage}" for book, chain in self._books.items() if chain.damage is not None]
        self.damage = "; ".join(damages) or None
        self._next = 1 + max((record.entry.sequence for record in self.entries()), default=-1)

    @property
    def durable_heads(self) -> dict[str, str]:
        """The newest entry on the disk of each book that has one. The state file may remember these and nothing
        newer."""
        heads = ((book, chain.durable_head) for book, chain in self._books.items())
        return {book: head for book, head in heads if head is not None}

    def entries(self) -> tuple[HistoryRecord, ...]:
        """All entries that are kept, oldest first."""
        return _in_order(chain.entries() for chain in self._books.values())

    def on_disk(self) -> tuple[HistoryRecord, ...]:
        """All entries that are on the disk, oldest first."""
        return _in_order(chain.on_disk() for chain in self._books.values())

    def results(self) -> tuple[CalibrationResult, ...]:
        """Results of windows, oldest first."""
        return tuple(record.result for record in self.entries() if record.result is not None)

    def append(self, entry: HistoryEntry, result: CalibrationResult | None = None) -> HistoryRecord:
        """Appends an entry to its book and fills in its place. The next `flush` writes it."""
        with self._lock:
            book = self._book_of(entry)
            number, self._next = self._next, self._next + 1
            return self._books[book].append(entry.model_copy(update={"sequence": number, "book": book}), result)

    def flush(self) -> None:
        """Writes to the disk what is not there yet.

        Raises:
            StateError: the disk refuses; the next call tries again.
        """
        failed = []
        for chain in self._books.values():
            try:
                chain.flush()
            except StateError as error:
                failed.append(str(error))
        if failed:
            raise StateError("; ".join(failed))

    def _book_of(self, entry: HistoryEntry) -> Book:
        match entry.kind:
            case "state" | "chain":
                return "states"
            case "extrinsic" if entry.code != Provenance.ESTIMATED.value:
                return "commands"
            case "estimate" | "extrinsic" if not self._is_in_results(entry):
                return "results"
            case _:
                return "commands"

    def _is_in_results(self, entry: HistoryEntry) -> bool:
        """Whether the book `results` already holds an entry of this kind for the same window."""
        record = (record.entry for record in self._books["results"].entries())
        return any((one.kind, one.window_id) == (entry.kind, entry.window_id) for one in record)


def _in_order(books: Iterable[Sequence[HistoryRecord]]) -> tuple[HistoryRecord, ...]:
    return tuple(sorted((record for book in books for record in book), key=lambda record: record.entry.sequence))
