"""The state of every pair in the one state file, and its past results in a file of lines per pair."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from coec.adapters.rig import rig_to_json
from coec.adapters.state_file import StateFile
from coec.adapters.wire import estimate_of, result_of
from coec.calibration.lifecycle import PairState, Provenance, Status, restored
from coec.calibration.values import Reason, Rig
from coec.errors import CoecError, DecodeError, StateError
from coec.schemas import replies
from coec.schemas.base import Part, from_json, to_json
from coec.schemas.replies import CalibrationResult

_log = logging.getLogger(__name__)


class StoredPair(Part):
    """`PairState` on the disk, and when (wall clock) its latest window was evaluated."""

    rig_sha256: str
    T_camera_lidar: tuple[replies.Row4, replies.Row4, replies.Row4, replies.Row4]
    provenance: Literal["nominal", "commissioned", "estimated", "restored"]
    status: Literal["not_accepted", "accepted", "failed"]
    valid_from_ns: int
    latest: CalibrationResult | None
    accepted: CalibrationResult | None
    failures: tuple[replies.Reason, ...]
    evaluated_wall_ns: int | None


@dataclass(frozen=True, slots=True)
class Remembered:
    """A pair's state as it was before the restart."""

    state: PairState
    evaluated_wall_ns: int | None


class StateStore:
    """Keeps the state file; safe to use from several threads.

    Attributes:
        damage: what was wrong with the copies found at the start, one sentence each.
    """

    def __init__(self, folder: Path, vehicle: str) -> None:
        self._file = StateFile(folder / "state.json")
        self._vehicle = vehicle
        self._lock = threading.Lock()
        loaded = self._file.load()
        self.damage = loaded.damage
        pairs = loaded.body.get("pairs") if loaded.body else None
        self._pairs: dict[str, Any] = pairs if isinstance(pairs, dict) else {}

    def recall(self, rig: Rig) -> Remembered | None:
        """What is known of the pair; None when nothing is, or when it belongs to another rig (then said in the log).

        Raises:
            StateError: the file is intact, but not what this version can read.
        """
        document = self._pairs.get(rig.pair)
        if document is None:
            return None
        try:
            stored = StoredPair.model_validate(document)
            if stored.rig_sha256 != _rig_sha256(rig):
                _log.warning(
                    "the state on the disk belongs to another rig: starting from nominal",
                    extra={"fields": {"pair": rig.pair}},
                )
                return None
            return Remembered(restored(_state_of(stored)), stored.evaluated_wall_ns)
        except (ValidationError, CoecError, ValueError) as error:
            raise StateError(f"the state of pair {rig.pair} cannot be used: it has another form") from error

    def remember(self, rig: Rig, state: PairState, evaluated_wall_ns: int | None) -> None:
        """Put the pair's state on the disk.

        Raises:
            StateError: it could not be written; it is tried again with the next change.
        """
        stored = StoredPair(
            rig_sha256=_rig_sha256(rig),
            T_camera_lidar=_rows(state.T_camera_lidar.tolist()),
            provenance=state.provenance.value,
            status=state.status.value,
            valid_from_ns=state.valid_from_ns,
            latest=result_of(state.latest, rig, self._vehicle) if state.latest else None,
            accepted=result_of(state.accepted, rig, self._vehicle) if state.accepted else None,
            failures=tuple(replies.Reason(code=reason.code, text=reason.text) for reason in state.failures),
            evaluated_wall_ns=evaluated_wall_ns,
        )
        with self._lock:
            self._pairs[rig.pair] = stored.model_dump(mode="json")
            self._file.save({"pairs": self._pairs})


class History:
    """Past results of one pair, oldest first: a line each, `<sha256 of the JSON> <JSON>`; the newest `limit` are kept.

    A damaged line costs its result only. Safe to use from several threads.
    """

    def __init__(self, path: Path, limit: int) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._results: deque[CalibrationResult] = deque(maxlen=limit)
        self._lines = 0
        self.damaged = 0
        self._load()

    def results(self) -> tuple[CalibrationResult, ...]:
        """All that are kept."""
        with self._lock:
            return tuple(self._results)

    def append(self, result: CalibrationResult) -> None:
        """Keep one more.

        Raises:
            StateError: it is kept in memory, but not on the disk.
        """
        with self._lock:
            self._results.append(result)
            try:
                if self._lines >= 2 * (self._results.maxlen or 1):
                    self._rewrite()
                    return
                with self._path.open("ab") as stream:
                    stream.write(_line(result))
                self._lines += 1
            except OSError as error:
                raise StateError(f"cannot write {self._path}: {error.strerror}") from error

    def _load(self) -> None:
        try:
            lines = self._path.read_bytes().splitlines()
        except OSError:
            return
        self._lines = len(lines)
        for line in lines[-(self._results.maxlen or 0) :]:
            checksum, _, document = line.partition(b" ")
            if checksum != _checksum(document):
                self.damaged += 1
                continue
            try:
                self._results.append(from_json(CalibrationResult, document))
            except DecodeError:
                self.damaged += 1

    def _rewrite(self) -> None:
        fresh = self._path.with_name(self._path.name + ".new")
        fresh.write_bytes(b"".join(_line(result) for result in self._results))
        fresh.replace(self._path)
        self._lines = len(self._results)


def _line(result: CalibrationResult) -> bytes:
    document = to_json(result)
    return _checksum(document) + b" " + document + b"\n"


def _checksum(document: bytes) -> bytes:
    return hashlib.sha256(document).hexdigest().encode()


def _rig_sha256(rig: Rig) -> str:
    return hashlib.sha256(json.dumps(rig_to_json(rig), sort_keys=True).encode()).hexdigest()


def _rows(rows: list[list[float]]) -> tuple[replies.Row4, replies.Row4, replies.Row4, replies.Row4]:
    a, b, c, d = ((row[0], row[1], row[2], row[3]) for row in rows)
    return a, b, c, d


def _state_of(stored: StoredPair) -> PairState:
    return PairState(
        T_camera_lidar=np.array(stored.T_camera_lidar, dtype=np.float64),
        provenance=Provenance(stored.provenance),
        status=Status(stored.status),
        valid_from_ns=stored.valid_from_ns,
        latest=estimate_of(stored.latest) if stored.latest else None,
        accepted=estimate_of(stored.accepted) if stored.accepted else None,
        failures=tuple(Reason(reason.code, reason.text) for reason in stored.failures),
    )
