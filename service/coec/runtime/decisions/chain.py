"""A book of the history of a pair, as a hash chain: append-only, one line per entry, and each entry holds the sha256 of
the one before, so that tampering shows.

A line is `<sha256 of the entry> <entry, JSON><tab><result, JSON or null>`; the entry names the sha256 of its result.
Hashes are over the bytes of the line, so that a version with other fields can still verify it. An entry of another
schema version that this one cannot read stays in its place, byte for byte, with a stand-in to be shown. Only the newest
`limit` entries are kept; the first line's `previous_sha256` is then the hash of a dropped entry. The state file also
holds place and hash of the last entry on the disk, so that a missing end is noticed. If a chain is broken, its file is
kept aside as it is, and the chain goes on from the part that is sound.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from coec.adapters.files import durable
from coec.adapters.files.conversions import matrix_of
from coec.adapters.files.ledger import AppendLog
from coec.adapters.files.state_file import BROKEN
from coec.errors import DecodeError, StateError
from coec.geometry.se3 import is_rigid
from coec.schemas.base import SCHEMA_VERSION, from_json, to_json
from coec.schemas.replies import CalibrationResult, ChainedEntry, HistoryEntry

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
        self._ledger: AppendLog[HistoryRecord] = AppendLog(path, limit, lambda record: record.line)
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
                    durable.quarantine(self._path, BROKEN)
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
