"""The history of a pair: append-only, a line per entry, each holding the sha256 of the one before (tamper-evident).

A line is `<sha256 of the entry> <entry, JSON><tab><result, JSON or null>`; the entry names the sha256 of its result.
Hashes are over the bytes of the line, so that a later version with more fields can still verify it. Only the newest
`limit` entries are kept: the first line's `previous_sha256` is then the hash of what was dropped. The last hash also
stands in the state file, so that a tail that was cut off is noticed. A chain that does not hold is kept aside as it is,
and goes on from the part that does.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from coec.errors import DecodeError, StateError
from coec.schemas.base import from_json, to_json
from coec.schemas.replies import CalibrationResult, ChainedEntry, HistoryEntry

GENESIS = 64 * "0"
"""`previous_sha256` of the first entry."""


@dataclass(frozen=True, slots=True)
class Kept:
    """An entry with its hash, its result if it is one of a window, and its line in the file."""

    sha256: str
    entry: HistoryEntry
    result: CalibrationResult | None
    line: bytes

    @property
    def chained(self) -> ChainedEntry:
        """Without the result."""
        return ChainedEntry(sha256=self.sha256, entry=self.entry)


class History:
    """All that is kept of one pair, oldest first. Safe to use from several threads.

    Attributes:
        damage: what was wrong with the chain that was found, one sentence; None when it held.
    """

    def __init__(self, path: Path, limit: int, head: str | None = None) -> None:
        """`head` is the last hash that the state file knows of: the chain must hold it, or it was cut off."""
        self._path = path
        self._lock = threading.Lock()
        self._kept: deque[Kept] = deque(maxlen=limit)
        self._lines = 0
        self.damage: str | None = None
        self._load(head)

    @property
    def head(self) -> str:
        """Hash of the newest entry."""
        with self._lock:
            return self._kept[-1].sha256 if self._kept else GENESIS

    def entries(self) -> tuple[Kept, ...]:
        """All that are kept."""
        with self._lock:
            return tuple(self._kept)

    def results(self) -> tuple[CalibrationResult, ...]:
        """Results of windows."""
        return tuple(kept.result for kept in self.entries() if kept.result is not None)

    def append(self, entry: HistoryEntry, result: CalibrationResult | None = None) -> Kept:
        """Keep one more; its place in the chain is filled in. On the disk when this returns.

        Raises:
            StateError: it is kept in memory, but not on the disk.
        """
        with self._lock:
            last = self._kept[-1] if self._kept else None
            placed = entry.model_copy(
                update={
                    "sequence": last.entry.sequence + 1 if last else 0,
                    "previous_sha256": last.sha256 if last else GENESIS,
                    "result_sha256": _sha256(to_json(result)) if result else None,
                }
            )
            document = to_json(placed)
            sha256 = _sha256(document)
            body = document + b"\t" + (to_json(result) if result else b"null")
            kept = Kept(sha256, placed, result, sha256.encode() + b" " + body + b"\n")
            self._kept.append(kept)
            try:
                if self._lines >= 2 * (self._kept.maxlen or 1):
                    self._rewrite()
                else:
                    with self._path.open("ab") as stream:
                        stream.write(kept.line)
                        stream.flush()
                        os.fsync(stream.fileno())
                    self._lines += 1
            except OSError as error:
                raise StateError(f"cannot write {self._path}: {error.strerror}") from error
            return kept

    def _load(self, head: str | None) -> None:
        try:
            data = self._path.read_bytes()
        except OSError:
            data = b""
        whole, _, torn = data.rpartition(b"\n")
        lines = whole.split(b"\n") if whole else []
        hashes: list[str] = []
        for number, line in enumerate(lines, start=1):
            kept = _parsed(line)
            if kept is None or (hashes and kept.entry.previous_sha256 != hashes[-1]):
                self.damage = f"line {number} of {len(lines)} is not what its hash, or the one before it, says"
                break
            hashes.append(kept.sha256)
            self._kept.append(kept)
        if self.damage is None and head not in (None, GENESIS, *hashes):
            self.damage = "its end was cut off: it lacks an entry that the state file knows of"
        self._lines = len(lines)
        if self.damage is not None:
            self._keep_aside()
        elif torn:  # a write that a power cut interrupted
            self._restore()

    def _keep_aside(self) -> None:
        aside, number = self._path.with_name(f"{self._path.name}.broken"), 0
        while aside.exists():
            number += 1
            aside = self._path.with_name(f"{self._path.name}.broken-{number}")
        with contextlib.suppress(OSError):
            self._path.replace(aside)
        self._restore()

    def _restore(self) -> None:
        with contextlib.suppress(OSError):
            self._rewrite()

    def _rewrite(self) -> None:
        fresh = self._path.with_name(self._path.name + ".new")
        with fresh.open("wb") as stream:
            stream.write(b"".join(kept.line for kept in self._kept))
            stream.flush()
            os.fsync(stream.fileno())
        fresh.replace(self._path)
        self._lines = len(self._kept)


def _parsed(line: bytes) -> Kept | None:
    """The entry of a line, None when the line is not what its hashes say."""
    sha256, _, body = line.partition(b" ")
    document, _, result = body.partition(b"\t")
    try:
        entry = from_json(HistoryEntry, document)
        told = None if entry.result_sha256 is None else from_json(CalibrationResult, result)
    except DecodeError:
        return None
    if _sha256(document).encode() != sha256 or (_sha256(result) if told else None) != entry.result_sha256:
        return None
    return Kept(sha256.decode(), entry, told, line + b"\n")


def _sha256(document: bytes) -> str:
    return hashlib.sha256(document).hexdigest()
