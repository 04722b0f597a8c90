"""The history of a pair, in three books with a quota each, so that none can push what another holds out of it.

`results`: the estimate of each window, and the extrinsic that became served by it: all that a roll back and a
commissioning need. `states`: changes of health, and what was found wrong with a book. `commands`: what people had done,
the extrinsics that this put in place, and what comes of windows that are solved again, which is only done by command.
Whoever floods the service with commands flushes this book.

Each book is a hash chain in a file of its own. The entries of all are numbered together, in the order in which they
came.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from coec.calibration.lifecycle import Provenance
from coec.errors import StateError
from coec.runtime.decisions.chain import Chain, Kept
from coec.schemas.replies import Book, CalibrationResult, HistoryEntry

FILES: Final[Mapping[Book, str]] = {"results": "history", "states": "states", "commands": "commands"}
"""First part of the name of the file of a book."""


class History:
    """All that is kept of one pair. Safe to use from several threads.

    Only `flush` waits for the disk, and nobody waits for it. Entries of a book go there in order: the chains on the
    disk hold at any time.

    Attributes:
        damage: what was wrong with the chains that were found, one sentence; None when they held.
    """

    def __init__(self, folder: Path, pair: str, limit: int, heads: Mapping[str, str]) -> None:
        """
        Args:
            limit: entries kept in each book, the newest.
            heads: the `durable_heads` that the state file knows of: the chains must reach them, or were cut off.
        """
        self._lock = threading.Lock()
        self._books = {
            book: Chain(folder / f"{name}-{pair}.jsonl", limit, heads.get(book)) for book, name in FILES.items()
        }
        found = [f"{book}: {chain.damage}" for book, chain in self._books.items() if chain.damage is not None]
        self.damage = "; ".join(found) or None
        self._next = 1 + max((kept.entry.sequence for kept in self.entries()), default=-1)

    @property
    def durable_heads(self) -> dict[str, str]:
        """Of each book that has one, the newest entry that is on the disk. These, and nothing newer, are for the state
        file to remember."""
        heads = ((book, chain.durable_head) for book, chain in self._books.items())
        return {book: head for book, head in heads if head is not None}

    def entries(self) -> tuple[Kept, ...]:
        """All that are kept, oldest first."""
        return _in_order(chain.entries() for chain in self._books.values())

    def on_disk(self) -> tuple[Kept, ...]:
        """All that are on the disk, oldest first."""
        return _in_order(chain.on_disk() for chain in self._books.values())

    def results(self) -> tuple[CalibrationResult, ...]:
        """Results of windows, oldest first."""
        return tuple(kept.result for kept in self.entries() if kept.result is not None)

    def append(self, entry: HistoryEntry, result: CalibrationResult | None = None) -> Kept:
        """Keep one more, in its book; its place is filled in. On the disk with the next `flush`."""
        with self._lock:
            book = self._book_of(entry)
            number, self._next = self._next, self._next + 1
            return self._books[book].append(entry.model_copy(update={"sequence": number, "book": book}), result)

    def flush(self) -> None:
        """Put on the disk what is not there yet.

        Raises:
            StateError: it is not possible; the next call tries again.
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
        """Whether the window of an entry has one of its kind there already."""
        kept = (kept.entry for kept in self._books["results"].entries())
        return any((one.kind, one.window_id) == (entry.kind, entry.window_id) for one in kept)


def _in_order(books: Iterable[Sequence[Kept]]) -> tuple[Kept, ...]:
    return tuple(sorted((kept for book in books for kept in book), key=lambda kept: kept.entry.sequence))
