"""The history of a pair, in three books, and the log of its checks. Each book has its own quota, so that none can push
out what another holds.

- `results`: the estimate of each window, and the extrinsic that was served because of it. That is all that a roll back
  and a commissioning need.
- `states`: changes of health, and damage that was detected in a book.
- `commands`: commands of people, the extrinsics that they put in place, and the outcomes of windows that are solved
  again, which happens only by command. A flood of commands pushes out only entries of this book.

Each book is a hash chain in a file of its own: append-only, one line per entry, and each entry holds the sha256 of the
one before, so that tampering shows. The entries of all books are numbered together, in the order in which they came.

A line is `<sha256 of the entry> <entry, JSON><tab><result, JSON or null>`; the entry names the sha256 of its result.
Hashes are over the bytes of the line, so that a version with other fields can still verify it. An entry of another
schema version that this one cannot read stays in its place, byte for byte, with a stand-in to be shown. Only the newest
`limit` entries are retained; the first line's `previous_sha256` is then the hash of a dropped entry. The state file
also holds place and hash of the last entry on the disk, so that a missing end is noticed. If a chain is broken, its
file is quarantined as it is, and the chain goes on from the part that is sound.

The log of the monitor's checks has one JSON line each, and only the newest are retained. No decision depends on it, so
a line that cannot be read is left out.
"""

import contextlib
import hashlib
import json
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from coec.calibration.state import Provenance
from coec.errors import DecodeError, StateError
from coec.geometry.se3 import is_rigid
from coec.io import storage
from coec.io.serialise import matrix_of
from coec.schemas.message import SCHEMA_VERSION, from_json, to_json
from coec.schemas.replies import Book, CalibrationResult, ChainedEntry, CheckReply, HistoryEntry

GENESIS = 64 * "0"
"""`previous_sha256` of the first entry."""


MAX_DIGITS = 19
"""Most digits of the number of an entry: more entries than that can never be written."""


@dataclass(frozen=True, slots=True)
class HistoryRecord:
    """An entry with its hash, its line in the file, and the result if it is the entry of a window's result and this
    version can read it."""

    sha256: str
    entry: HistoryEntry
    result: CalibrationResult | None
    line: bytes

    @property
    def chained(self) -> ChainedEntry:
        """The entry without the result."""
        return ChainedEntry(sha256=self.sha256, entry=self.entry)


class HashChain:
    """The entries of one book, oldest first. Safe to use from several threads; only `flush` waits for the disk.

    Entries go to the disk in order, so the chain on the disk is sound at any time.

    Attributes:
        damage: what was wrong with the chain on the disk at the start, one sentence; None if it was sound.
    """

    def __init__(self, path: Path, limit: int, head: str | None = None) -> None:
        """`head` is the `durable_head` in the state file: a chain that does not reach it was cut off."""
        self._path = path
        self._ledger: storage.AppendLog[HistoryRecord] = storage.AppendLog(path, limit, lambda record: record.line)
        self._writing = threading.Lock()
        self._to_quarantine = False
        self.damage: str | None = None
        self._load(head)

    @property
    def durable_head(self) -> str | None:
        """Place and hash of the newest entry on the disk, in the format of this module; None before the first. The
        state file may remember this and nothing newer."""
        durable = self._ledger.durable
        return None if durable is None else f"{durable.entry.sequence} {durable.sha256}"

    def entries(self) -> tuple[HistoryRecord, ...]:
        """All entries that are kept."""
        return self._ledger.items()

    def on_disk(self) -> tuple[HistoryRecord, ...]:
        """All entries that are on the disk."""
        return self._ledger.on_disk()

    def append(self, entry: HistoryEntry, result: CalibrationResult | None = None) -> HistoryRecord:
        """Appends an entry and fills in its place in the chain. Its number stays, or becomes the next one if it is
        taken. The next `flush` writes it."""

        def placed_behind(last: HistoryRecord | None) -> HistoryRecord:
            placed = entry.model_copy(
                update={
                    "sequence": max(entry.sequence, last.entry.sequence + 1 if last else 0),
                    "previous_sha256": last.sha256 if last else GENESIS,
                    "result_sha256": _sha256(to_json(result)) if result else None,
                }
            )
            document = to_json(placed)
            sha256 = _sha256(document)
            body = document + b"\t" + (to_json(result) if result else b"null")
            return HistoryRecord(sha256, placed, result, sha256.encode() + b" " + body)

        return self._ledger.add(placed_behind)

    def flush(self) -> None:
        """Writes to the disk what is not there yet.

        Raises:
            StateError: the disk refuses; the next call tries again.
        """
        with self._writing:
            try:
                if self._to_quarantine:
                    storage.quarantine(self._path, storage.BROKEN)
                    self._to_quarantine = False
                self._ledger.flush()
            except OSError as error:
                raise StateError(f"cannot write {self._path}: {error.strerror}") from error

    def _load(self, head: str | None) -> None:
        lines = self._read()
        chain: list[HistoryRecord] = []
        for number, line in enumerate(lines, start=1):
            record = _parsed(line)
            if record is None or (chain and record.entry.previous_sha256 != chain[-1].sha256):
                self.damage = f"line {number} of {len(lines)} is not what its hash, or the one before it, says"
                break
            chain.append(record)
            self._ledger.restored(record)
        if self.damage is None and not _reaches(self._ledger.items(), head):
            self.damage = "its end was cut off: it lacks an entry that the state file knows of"
        if self.damage is not None:
            self._to_quarantine = True
            self._ledger.renew()
            with contextlib.suppress(StateError):
                self.flush()

    def _read(self) -> list[bytes]:
        try:
            return self._ledger.load()
        except OSError as error:
            self.damage = f"it cannot be read: {error.strerror}"
            return []


def _parsed(line: bytes) -> HistoryRecord | None:
    """The entry of a line; None if the line contradicts its hashes, or holds a matrix that is no pose."""
    sha256, _, body = line.partition(b" ")
    document, _, result = body.partition(b"\t")
    try:
        entry = from_json(HistoryEntry, document)
    except DecodeError:
        unread = _stand_in(document)
        if unread is None:
            return None
        entry = unread
    reported = None
    if entry.result_sha256 is not None:
        try:
            reported = from_json(CalibrationResult, result)
        except DecodeError:
            if _other_version(result) is None:
                return None
    if entry.camera_from_lidar is not None and not is_rigid(matrix_of(entry.camera_from_lidar)):
        return None
    if reported is not None and not is_rigid(matrix_of(reported.camera_from_lidar)):
        return None
    result_sha256 = None if entry.result_sha256 is None else _sha256(result)
    if _sha256(document).encode() != sha256 or result_sha256 != entry.result_sha256:
        return None
    return HistoryRecord(sha256.decode(), entry, reported, line)


def _stand_in(document: bytes) -> HistoryEntry | None:
    """What this version can show of an entry that another version wrote, in a form that this one does not read; None if
    it cannot be placed in the chain, or if this version wrote it."""
    other = _other_version(document)
    if other is None:
        return None
    placed = {name: other.get(name) for name in ("schema_version", "sequence", "previous_sha256", "result_sha256")}
    kind = other.get("kind")
    text = (
        f"Entry {kind if isinstance(kind, str) else ''} of another version of the software, which this one cannot read."
    )
    try:
        return HistoryEntry.model_validate({**placed, "kind": "chain", "code": "unread", "text": text, "wall_ns": 0})
    except ValidationError:
        return None


def _other_version(document: bytes) -> dict[str, Any] | None:
    """The fields of a message that a version with another schema wrote; None if this version wrote it, or if it is no
    JSON object."""
    try:
        fields = json.loads(document)
    except (ValueError, RecursionError):
        return None
    version = fields.get("schema_version") if isinstance(fields, dict) else None
    return fields if isinstance(version, int) and version != SCHEMA_VERSION else None


def _reaches(chain: Sequence[HistoryRecord], head: str | None) -> bool:
    """Whether a sound chain holds the entry that `head` names, or only later ones because the oldest were dropped."""
    if head is None:
        return True
    number, _, sha256 = head.partition(" ")
    if not (number.isdecimal() and len(number) <= MAX_DIGITS and chain):
        return False
    return int(number) < chain[0].entry.sequence or any(
        record.entry.sequence == int(number) and record.sha256 == sha256 for record in chain
    )


def _sha256(document: bytes) -> str:
    return hashlib.sha256(document).hexdigest()


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


class CheckLog:
    """The checks, oldest first. Safe to use from several threads; only `flush` waits for the disk."""

    def __init__(self, path: Path, limit: int) -> None:
        """`path` holds the checks of earlier runs; the newest `limit` are kept."""
        self._path = path
        self._ledger: storage.AppendLog[CheckReply] = storage.AppendLog(path, limit, to_json)
        self._load()

    def checks(self) -> tuple[CheckReply, ...]:
        """All checks that are kept."""
        return self._ledger.items()

    def on_disk(self) -> tuple[CheckReply, ...]:
        """All checks that are on the disk."""
        return self._ledger.on_disk()

    def append(self, check: CheckReply) -> None:
        """Appends a check; the next `flush` writes it."""
        self._ledger.add(lambda _: check)

    def flush(self) -> None:
        """Writes to the disk what is not there yet.

        Raises:
            StateError: the disk refuses; the next call tries again.
        """
        try:
            self._ledger.flush()
        except OSError as error:
            raise StateError(f"cannot write {self._path}: {error.strerror}") from error

    def _load(self) -> None:
        try:
            lines = self._ledger.load()
        except OSError:  # then the log begins anew
            return
        for line in lines:
            with contextlib.suppress(ValidationError):
                self._ledger.restored(CheckReply.model_validate_json(line))
