"""The states of all pairs, in one state file."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from coec.adapters.files.conversions import estimate_of, result_of
from coec.adapters.files.rig import rig_to_json
from coec.adapters.files.state_file import StateFile
from coec.calibration.lifecycle import (
    AlarmRecord,
    Candidate,
    Change,
    Health,
    HealthState,
    Hold,
    PairState,
    Provenance,
    Status,
)
from coec.calibration.monitor.change_detector import MonitorState
from coec.calibration.tracker import Track, track_from_dict, track_to_dict
from coec.calibration.types import Estimate, Matrix4, Reason, Rig
from coec.errors import CoecError, NotFoundError, StateError
from coec.geometry import se3
from coec.schemas import replies
from coec.schemas.base import Part
from coec.schemas.replies import CalibrationResult

_log = logging.getLogger(__name__)


STATE_FILE = "state.json"

LARGEST = 1e9
"""Largest correction, and standard deviation of it, that a state file may hold, radians or metres. No window gives
more, and values below it stay finite in degrees and squared."""

Rows = tuple[replies.Row4, replies.Row4, replies.Row4, replies.Row4]

WallNs = Annotated[int, Field(ge=0, lt=2**63)]
"""Nanoseconds since 1970, as the clocks of Linux count them."""


class StoredCandidate(Part):
    """`Candidate` on the disk."""

    T_camera_lidar: Rows
    result: CalibrationResult
    waits: replies.Reason
    contradicts: bool


class StoredHealth(Part):
    """`Health` on the disk."""

    state: replies.HealthState
    reasons: tuple[replies.Reason, ...]


class StoredHold(Part):
    """`Hold` on the disk."""

    since_ns: WallNs | None = None
    sender: str = ""
    reason: str = ""


class StoredChange(Part):
    """`Change` on the disk."""

    stamp_ns: int
    step: tuple[float, ...]


class StoredRecord(Part):
    """`AlarmRecord` on the disk."""

    watched_ns: replies.Count = 0
    confirmed: replies.Count = 0
    withdrawn: replies.Count = 0
    accused: bool = False


class StoredPair(Part):
    """`PairState` on the disk. Beside it: when (wall clock) a check was last completed, since when the pair is in its
    state of health, and the heads of its history on the disk. Fields that a file of an earlier version lacks have the
    values of a first start."""

    rig_sha256: str
    T_camera_lidar: Rows
    provenance: Literal["nominal", "commissioned", "estimated", "restored"]
    status: Literal["not_accepted", "accepted", "failed"]
    valid_from_ns: int
    latest: CalibrationResult | None
    accepted: CalibrationResult | None
    failures: tuple[replies.Reason, ...]
    completed_wall_ns: WallNs | None
    health: replies.HealthState = "unknown"
    reasons: tuple[replies.Reason, ...] = ()
    unseen_from: StoredHealth | None = None
    pending: StoredCandidate | None = None
    frozen: bool = False
    hold: StoredHold | None = None
    proven: bool = False
    track: dict[str, Any] | None = None
    monitor: MonitorState = MonitorState()
    flagged_since_ns: int | None = None
    poor_since_ns: int | None = None
    changes: tuple[StoredChange, ...] = ()
    since_wall_ns: WallNs | None = None
    completed_stamp_ns: int | None = None
    history_heads: dict[str, str] = Field(default_factory=dict)
    commissioned_from: tuple[str, ...] = ()
    record: StoredRecord = StoredRecord()


@dataclass(frozen=True, slots=True)
class Clocks:
    """When a check was last completed (wall clock and sensor time), and since when (wall clock) the pair is in its
    state of health."""

    completed_wall_ns: int | None
    completed_stamp_ns: int | None
    since_wall_ns: int | None


@dataclass(frozen=True, slots=True)
class Remembered:
    """A pair's state as it was before the restart, and the windows that it was commissioned from."""

    state: PairState
    clocks: Clocks
    history_heads: Mapping[str, str]
    commissioned_from: tuple[str, ...]


class StateStore:
    """Keeps the state file; safe to use from several threads. Only `flush` waits for the disk.

    Attributes:
        damage: what was wrong with the copies found at the start, one sentence each.
    """

    def __init__(self, folder: Path, vehicle: str) -> None:
        self._file = StateFile(folder / STATE_FILE)
        self._vehicle = vehicle
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._heads: dict[str, Callable[[], Mapping[str, str]]] = {}
        loaded = self._file.load()
        self.damage = loaded.damage
        pairs = loaded.body.get("pairs") if loaded.body else None
        self._pairs: dict[str, Any] = pairs if isinstance(pairs, dict) else {}

    def recall(self, rig: Rig) -> Remembered | None:
        """What is known of the pair; None if nothing is, or if it belongs to another rig, which is logged.

        Raises:
            StateError: the file is intact, but this version cannot read it, or a matrix in it is no pose. The file is
                kept aside when the state is next put on the disk.
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
            clocks = Clocks(stored.completed_wall_ns, stored.completed_stamp_ns, stored.since_wall_ns)
            return Remembered(_state_of(stored), clocks, stored.history_heads, stored.commissioned_from)
        except (ValidationError, CoecError, ArithmeticError, LookupError, ValueError, TypeError) as error:
            self._file.distrust()
            why = "a pose in it is no rigid transform" if isinstance(error, _NoPoseError) else "it has another form"
            raise StateError(f"the state of pair {rig.pair} cannot be used: {why}") from error

    def remember(
        self,
        rig: Rig,
        state: PairState,
        clocks: Clocks,
        history_heads: Callable[[], Mapping[str, str]],
        commissioned_from: tuple[str, ...] = (),
    ) -> None:
        """Keeps the pair's state, and the ids of the windows from which it was commissioned. The next `flush` writes
        them, together with what `history_heads()` returns then."""
        stored = StoredPair(
            rig_sha256=_rig_sha256(rig),
            T_camera_lidar=_rows(state.T_camera_lidar.tolist()),
            provenance=state.provenance.value,
            status=state.status.value,
            valid_from_ns=state.valid_from_ns,
            latest=result_of(state.latest, rig, self._vehicle) if state.latest else None,
            accepted=result_of(state.accepted, rig, self._vehicle) if state.accepted else None,
            failures=_told(state.failures),
            completed_wall_ns=clocks.completed_wall_ns,
            health=state.health.value,
            reasons=_told(state.reasons),
            unseen_from=None
            if state.unseen_from is None
            else StoredHealth(state=state.unseen_from.state.value, reasons=_told(state.unseen_from.reasons)),
            pending=self._candidate(state.pending, rig) if state.pending else None,
            frozen=state.hold is not None,
            hold=None if state.hold is None else StoredHold(**asdict(state.hold)),
            proven=state.proven,
            track=track_to_dict(state.track) if state.track else None,
            monitor=state.monitor,
            flagged_since_ns=state.flagged_since_ns,
            poor_since_ns=state.poor_since_ns,
            changes=tuple(StoredChange(stamp_ns=change.stamp_ns, step=change.step) for change in state.changes),
            since_wall_ns=clocks.since_wall_ns,
            completed_stamp_ns=clocks.completed_stamp_ns,
            commissioned_from=commissioned_from,
            record=StoredRecord(**asdict(state.record)),
        )
        with self._lock:
            self._pairs[rig.pair] = stored.model_dump(mode="json")
            self._heads[rig.pair] = history_heads

    def flush(self) -> None:
        """Writes what is kept to the disk.

        Raises:
            StateError: the disk refuses; the next call tries again.
        """
        with self._writing:
            with self._lock:
                pairs, heads = dict(self._pairs), dict(self._heads)
            # Entries of pairs that this service does not know may have any form, and stay as they are.
            told = {pair: {**pairs[pair], "history_heads": dict(of_pair())} for pair, of_pair in heads.items()}
            self._file.save({"pairs": {**pairs, **told}})

    def _candidate(self, pending: Candidate, rig: Rig) -> StoredCandidate:
        return StoredCandidate(
            T_camera_lidar=_rows(pending.T_camera_lidar.tolist()),
            result=result_of(pending.estimate, rig, self._vehicle),
            waits=replies.Reason(code=pending.waits.code, text=pending.waits.text),
            contradicts=pending.contradicts,
        )


def read_pairs(folder: Path) -> dict[str, tuple[StoredPair, PairState]]:
    """What a state directory holds of every pair, for programs that read it beside the service or without one.

    Raises:
        NotFoundError: the directory holds no state file.
        StateError: no copy of the state file can be used; the message says why.
    """
    loaded = StateFile(folder / STATE_FILE).load()
    if loaded.body is None:
        if loaded.damage:
            raise StateError(f"{folder / STATE_FILE} cannot be used: {'; '.join(loaded.damage)}")
        raise NotFoundError(f"{folder} holds no {STATE_FILE}")
    try:
        stored = {name: StoredPair.model_validate(pair) for name, pair in loaded.body["pairs"].items()}
        return {name: (pair, _state_of(pair)) for name, pair in stored.items()}
    except (ValidationError, CoecError, ArithmeticError, LookupError, ValueError, TypeError, AttributeError) as error:
        raise StateError(f"{folder / STATE_FILE} cannot be used: it has another form") from error


def _rig_sha256(rig: Rig) -> str:
    return hashlib.sha256(json.dumps(rig_to_json(rig), sort_keys=True).encode()).hexdigest()


def _rows(rows: list[list[float]]) -> Rows:
    a, b, c, d = ((row[0], row[1], row[2], row[3]) for row in rows)
    return a, b, c, d


def _told(reasons: tuple[Reason, ...]) -> tuple[replies.Reason, ...]:
    return tuple(replies.Reason(code=reason.code, text=reason.text) for reason in reasons)


def _reasons(stored: tuple[replies.Reason, ...]) -> tuple[Reason, ...]:
    return tuple(Reason(reason.code, reason.text) for reason in stored)


class _NoPoseError(StateError):
    """A matrix that should be a pose is no rigid transform."""


def _pose(rows: Rows) -> Matrix4:
    """The pose in these rows, checked to be rigid: the checksum of the file does not prove that this service wrote
    it."""
    T = np.array(rows, dtype=np.float64)
    if not se3.is_rigid(T):
        raise _NoPoseError("no rigid transform")
    return T


def _estimate(stored: CalibrationResult) -> Estimate:
    moved = () if stored.moved is None else (stored.moved.before, stored.moved.after)
    for transform in (stored.camera_from_lidar, *moved):
        _pose(transform.matrix)
    estimate = estimate_of(stored)
    if (estimate.uncertainty.noise.diagonal() < 0.0).any():
        raise ValueError("a variance is negative")
    shifts = np.abs([estimate.correction, *estimate.uncertainty.systematic.values()])
    if (shifts > LARGEST).any() or (np.abs(estimate.uncertainty.noise) > LARGEST**2).any():
        raise ValueError("a correction or its uncertainty is larger than any that is estimated")
    return estimate


def _track(stored: dict[str, Any]) -> Track:
    track = track_from_dict(stored)
    for belief in (track.slow, track.candidate):
        if belief is not None:
            _pose(_rows(belief.T_camera_lidar.tolist()))
    return track


def _hold(stored: StoredPair) -> Hold | None:
    """The hold on the extrinsic; None if there is none. A file of an earlier version does not say who holds it."""
    if not stored.frozen:
        return None
    return Hold() if stored.hold is None else Hold(**stored.hold.model_dump())


def _state_of(stored: StoredPair) -> PairState:
    pending = stored.pending
    return PairState(
        T_camera_lidar=_pose(stored.T_camera_lidar),
        provenance=Provenance(stored.provenance),
        status=Status(stored.status),
        valid_from_ns=stored.valid_from_ns,
        latest=_estimate(stored.latest) if stored.latest else None,
        accepted=_estimate(stored.accepted) if stored.accepted else None,
        failures=_reasons(stored.failures),
        health=HealthState(stored.health),
        reasons=_reasons(stored.reasons),
        unseen_from=None
        if stored.unseen_from is None
        else Health(HealthState(stored.unseen_from.state), _reasons(stored.unseen_from.reasons)),
        pending=None
        if pending is None
        else Candidate(
            _pose(pending.T_camera_lidar),
            _estimate(pending.result),
            Reason(pending.waits.code, pending.waits.text),
            pending.contradicts,
        ),
        hold=_hold(stored),
        proven=stored.proven,
        track=_track(stored.track) if stored.track else None,
        monitor=stored.monitor,
        flagged_since_ns=stored.flagged_since_ns,
        poor_since_ns=stored.poor_since_ns,
        changes=tuple(Change(change.stamp_ns, change.step) for change in stored.changes),
        record=AlarmRecord(**stored.record.model_dump()),
    )
