"""The state of a pair on the disk: one flat JSON object, whose fields belong to parts with versions of their own; and
its reader, which reads what all versions of the software wrote. What one version of the software wrote, older and
newer ones have to read, so three rules hold for every change: - A field that is added has a default, which it takes
in files of earlier versions. - A field that an earlier version requires is written for ever. - The version of a
part is raised only if earlier versions would misunderstand the part; they drop it then. A part that cannot be read
falls back alone, and never to something better than what was known: an unreadable hold holds, an unreadable health
is `unknown` at best, and a suspicion outlives the evidence for it.

What one version of the software wrote, older and newer ones have to read, so three rules hold for every change:

- A field that is added has a default, which it takes in files of earlier versions.
- A field that an earlier version requires is written for ever.
- The version of a part is raised only if earlier versions would misunderstand the part; they drop it then.

`pair_reader` reads what all versions wrote.

A part that cannot be read falls back alone, and never to something better than what was known: an unreadable hold
holds, an unreadable health is `unknown` at best, and a suspicion outlives the evidence for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from coec.calibration.monitor.change_detector import ACCUSING, MonitorOutcome, MonitorState
from coec.calibration.state import (
    LAST_KNOWN,
    CalibrationStatus,
    ExtrinsicHold,
    Health,
    PairState,
    PendingEstimate,
    Provenance,
)
from coec.calibration.state_machine import AlarmRecord, AppliedChange, HealthState
from coec.calibration.tracker import Track, track_from_dict, track_to_dict
from coec.calibration.types import Decision, Estimate, Matrix4, Reason, Rig
from coec.errors import CoecError, StateError
from coec.geometry import se3
from coec.io.rig_files import identity_sha256, is_same_rig, rig_identity
from coec.io.serialise import estimate_of, reasons_of, result_of
from coec.schemas import replies
from coec.schemas.message import Part
from coec.schemas.replies import CalibrationResult

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
    """`PairState` on the disk. Beside it: the versions of its parts, the rig that it belongs to, when (wall clock) a
    check was last completed, since when the pair is in its state of health, and the heads of its history on the disk.

    The defaults are those of a file that lacks the field. `rig_sha256` and `frozen` say what `rig` and `hold` say, for
    earlier versions.
    """

    versions: dict[str, int] = Field(default_factory=dict)
    rig_sha256: str | None = None
    rig: dict[str, Any] | None = None
    T_camera_lidar: Rows | None = None
    provenance: Literal["nominal", "commissioned", "estimated", "restored"] = "restored"
    status: Literal["not_accepted", "accepted", "failed"] = "not_accepted"
    valid_from_ns: int = 0
    latest: CalibrationResult | None = None
    accepted: CalibrationResult | None = None
    failures: tuple[replies.Reason, ...] = ()
    completed_wall_ns: WallNs | None = None
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


OF_FIRST_VERSIONS: Final = frozenset({"history_head"})
"""Fields that only the first versions wrote."""


@dataclass(frozen=True, slots=True)
class PartForm:
    """A part of the state: the version of its form, its fields in `StoredPair`, and what follows if it is lost."""

    version: int
    fields: tuple[str, ...]
    without: str


PARTS: Final[Mapping[str, PartForm]] = {
    "rig": PartForm(
        1, ("rig_sha256", "rig"), "the rig of the calibration is unknown, so the nominal calibration is served"
    ),
    "extrinsic": PartForm(1, ("T_camera_lidar",), "the nominal calibration is served"),
    "provenance": PartForm(
        1, ("provenance", "valid_from_ns", "proven"), "the calibration counts as restored, and as not yet confirmed"
    ),
    "accepted estimate": PartForm(1, ("accepted",), "the uncertainty of the calibration is unknown"),
    "hold": PartForm(1, ("frozen", "hold"), "the calibration is held unless the state says that it is not"),
    "latest estimate": PartForm(1, ("status", "latest", "failures"), "it is unknown until the next window"),
    "health": PartForm(
        1,
        ("health", "reasons", "unseen_from", "flagged_since_ns", "poor_since_ns"),
        "health is unknown, or suspect if another part of the state accuses the calibration",
    ),
    "candidate": PartForm(1, ("pending",), "no candidate waits for `apply`"),
    "track": PartForm(1, ("track",), "the next accepted window begins a new track"),
    "monitor": PartForm(1, ("monitor",), "the monitor begins to collect evidence anew"),
    "changes": PartForm(1, ("changes",), "the limits of the policy do not count the steps of the last day"),
    "clocks": PartForm(
        1, ("completed_wall_ns", "completed_stamp_ns", "since_wall_ns"), "the age of the last check is unknown"
    ),
    "heads of the history": PartForm(1, ("history_heads",), "a history that was cut off would not be noticed"),
    "windows of the commissioning": PartForm(1, ("commissioned_from",), "they are removed in turn, like other windows"),
    "alarm record": PartForm(1, ("record",), "alarms are counted from zero"),
}
"""The parts by the names that people read."""


@dataclass(frozen=True, slots=True)
class LostPart:
    """A part of the state that could not be read.

    Attributes:
        part: its name in `PARTS`.
        why: the cause, in a few words.
        written_by: the version of the software that wrote it, compared with this one; None if the versions agree, so
            that the part is damaged.
    """

    part: str
    why: str
    written_by: Literal["older", "newer"] | None

    @property
    def text(self) -> str:
        """The part, the cause and the consequence."""
        return f"{self.part} ({self.why}): {PARTS[self.part].without}"


@dataclass(frozen=True, slots=True)
class Clocks:
    """When a check was last completed (wall clock and sensor time), and since when (wall clock) the pair is in its
    state of health; None if unknown."""

    completed_wall_ns: int | None
    completed_stamp_ns: int | None
    since_wall_ns: int | None


@dataclass(frozen=True, slots=True)
class RestoredPair:
    """A pair as it was before the restart, the windows that it was commissioned from, and the parts that were lost."""

    state: PairState
    clocks: Clocks
    history_heads: Mapping[str, str]
    commissioned_from: tuple[str, ...]
    lost: tuple[LostPart, ...] = ()


def pair_to_json(
    rig: Rig, vehicle: str, state: PairState, clocks: Clocks, commissioned_from: tuple[str, ...]
) -> dict[str, Any]:
    """The state as JSON values, without the heads of the history."""
    identity = rig_identity(rig)
    stored = StoredPair(
        versions={name: part.version for name, part in PARTS.items()},
        rig_sha256=identity_sha256(identity),
        rig=identity,
        T_camera_lidar=rows_of(state.T_camera_lidar),
        provenance=state.provenance.value,
        status=state.status.value,
        valid_from_ns=state.valid_from_ns,
        latest=result_of(state.latest, rig, vehicle) if state.latest else None,
        accepted=result_of(state.accepted, rig, vehicle) if state.accepted else None,
        failures=reasons_of(state.failures),
        completed_wall_ns=clocks.completed_wall_ns,
        health=state.health.value,
        reasons=reasons_of(state.reasons),
        unseen_from=None
        if state.unseen_from is None
        else StoredHealth(state=state.unseen_from.state.value, reasons=reasons_of(state.unseen_from.reasons)),
        pending=None
        if state.pending is None
        else StoredCandidate(
            T_camera_lidar=rows_of(state.pending.T_camera_lidar),
            result=result_of(state.pending.estimate, rig, vehicle),
            waits=replies.Reason(code=state.pending.waits.code, text=state.pending.waits.text),
            contradicts=state.pending.contradicts,
        ),
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
    return stored.model_dump(mode="json")


def rows_of(pose: Matrix4) -> Rows:
    """A pose (4, 4) as it stands in the file."""
    a, b, c, d = ((row[0], row[1], row[2], row[3]) for row in pose.tolist())
    return a, b, c, d


LARGEST_CORRECTION = 1e9
"""Largest correction, and standard deviation of it, that a state file may hold, radians or metres. No window gives
more, and values below it stay finite in degrees and squared."""

T = TypeVar("T")


class AnotherRigError(StateError):
    """The state belongs to another rig."""


def pair_from_json(document: Mapping[str, Any], rig: Rig | None, nominal: PairState) -> tuple[StoredPair, RestoredPair]:
    """The state that this version or another one wrote, as far as it can be read.

    Args:
        rig: the rig of the pair; None: any.
        nominal: the state if the extrinsic is lost.

    Raises:
        AnotherRigError: the state belongs to another rig.
    """
    reader = _Reader(document, nominal)
    reader.check_rig(rig)
    return reader.stored, reader.remembered()


class _Reader:
    """Reads the parts of one document, each by itself, and notes which are lost."""

    def __init__(self, document: Mapping[str, Any], nominal: PairState) -> None:
        self._document = document
        self._nominal = nominal
        versions = document.get("versions")
        self._versions: Mapping[str, Any] = versions if isinstance(versions, dict) else {}
        self._lost: dict[str, LostPart] = {}
        self.stored, self._unreadable = self._validated()
        for name, part in PARTS.items():
            # Of the rig one of two fields suffices, and an older version writes only one of them.
            if name != "rig" and self._unreadable.intersection(part.fields):
                self._lose(name)

    def _validated(self) -> tuple[StoredPair, frozenset[str]]:
        """The document with the defaults for all fields that cannot be read, and the names of these fields."""
        unreadable = {
            field for name, part in PARTS.items() if self._written_by(name) == "newer" for field in part.fields
        } | {"versions"}
        monitor = self._document.get("monitor")
        if isinstance(monitor, dict) and "turned" not in monitor:  # the first versions counted votes
            unreadable.add("monitor")
        readable = {name: value for name, value in self._document.items() if name not in unreadable}
        try:
            return StoredPair.model_validate(readable), frozenset(unreadable)
        except ValidationError as error:
            unreadable |= {str(one["loc"][0]) for one in error.errors(include_url=False, include_input=False)}
        readable = {name: value for name, value in readable.items() if name not in unreadable}
        return StoredPair.model_validate(readable), frozenset(unreadable)

    def _written_by(self, part: str) -> Literal["older", "newer"] | None:
        """Which version wrote a part, compared with this one; None: one with the same form."""
        written, known = self._versions.get(part), PARTS[part].version
        if not isinstance(written, int) or written < known:  # files of the first versions hold no versions
            return "older"
        return "newer" if written > known else None

    def _lose(self, part: str, damage: str | None = None) -> None:
        by = self._written_by(part) if damage is None else None
        why = "damaged: " + (damage or "not in the form that this version writes")
        if by == "newer":
            why = f"written by a newer version, in form {self._versions[part]}; this one reads {PARTS[part].version}"
        elif by == "older":
            why = "written by an older version, in a form that this one does not read"
        self._lost.setdefault(part, LostPart(part, why, by))

    def _converted(self, part: str, convert: Callable[[], T], fallback: T) -> T:
        try:
            return convert()
        except _NotAPoseError:
            self._lose(part, "a pose in it is no rigid transform")
        except _BeyondMeasureError as error:
            self._lose(part, str(error))
        except (CoecError, ArithmeticError, LookupError, ValueError, TypeError):
            self._lose(part)
        return fallback

    def check_rig(self, rig: Rig | None) -> None:
        """Notes that the rig is unknown if it is.

        Raises:
            AnotherRigError: the state belongs to another rig.
        """
        sha256, identity = self.stored.rig_sha256, self.stored.rig
        if sha256 is None and identity is None:
            self._lose("rig")
        elif rig is not None:
            same = sha256 == identity_sha256(rig_identity(rig))
            if not same and not (identity is not None and is_same_rig(rig, identity)):
                raise AnotherRigError("the state belongs to another rig")

    def remembered(self) -> RestoredPair:
        """The state, as far as it can be read."""
        stored = self.stored
        state = replace(
            self._calibration(),
            hold=self._hold(),
            changes=tuple(AppliedChange(change.stamp_ns, change.step) for change in stored.changes),
            record=AlarmRecord(**stored.record.model_dump()),
        )
        state = self._with_health(self._with_latest(state))
        if "monitor" in self._lost and (state.seen in _RED or state.monitor.outcome in ACCUSING):
            # A monitor that has forgotten what it had against the extrinsic may not acquit it: only a window may.
            state = replace(state, proven=False)
        clocks = Clocks(stored.completed_wall_ns, stored.completed_stamp_ns, stored.since_wall_ns)
        return RestoredPair(state, clocks, self._heads(), stored.commissioned_from, tuple(self._lost.values()))

    def _calibration(self) -> PairState:
        """What is served, and all that refers to it."""
        stored = self.stored
        if stored.T_camera_lidar is None:
            self._lose("extrinsic")
        rows = stored.T_camera_lidar
        pose = None if rows is None else self._converted("extrinsic", lambda: _pose(rows), None)
        monitor = stored.monitor if "monitor" not in self._unreadable else self._without_evidence()
        if pose is None or "rig" in self._lost:
            # Of another pose the evidence says nothing, but causes in the data stay what they are.
            fresh = MonitorState(blind=monitor.blind, dirt=monitor.dirt)
            state = replace(self._nominal, monitor=fresh)
            return state if "rig" in self._lost else replace(state, track=self._track(), pending=self._candidate())
        accepted = self._converted("accepted estimate", lambda: _estimate_or_none(stored.accepted), None)
        known = "valid_from_ns" not in self._unreadable or accepted is None
        return PairState(
            T_camera_lidar=pose,
            provenance=Provenance(stored.provenance),
            status=CalibrationStatus.NOT_ACCEPTED,
            valid_from_ns=stored.valid_from_ns if known or accepted is None else accepted.data_stamp_ns,
            accepted=accepted,
            pending=self._candidate(),
            proven=stored.proven and "provenance" not in self._lost,
            track=self._track(),
            monitor=monitor,
        )

    def _candidate(self) -> PendingEstimate | None:
        pending = self.stored.pending
        if pending is None:
            return None
        return self._converted(
            "candidate",
            lambda: PendingEstimate(
                _pose(pending.T_camera_lidar),
                _estimate(pending.result),
                Reason(pending.waits.code, pending.waits.text),
                pending.contradicts,
            ),
            None,
        )

    def _track(self) -> Track | None:
        stored = self.stored.track
        return None if stored is None else self._converted("track", lambda: _track(stored), None)

    def _without_evidence(self) -> MonitorState:
        """What is left of a monitor whose evidence cannot be read: what speaks against the mount or the data, and
        whether a window has vouched for the extrinsic."""
        document = self._document.get("monitor")
        if not isinstance(document, dict):
            return MonitorState()
        left = MonitorState()
        for name in ("outcome", "blind", "dirt", "vouched", "doubtful"):
            try:
                read = _MONITOR.validate_python({name: document[name]})
            except (ValidationError, LookupError):
                continue
            left = replace(left, **{name: getattr(read, name)})
        return left if left.outcome in ACCUSING else replace(left, outcome=MonitorOutcome.UNKNOWN)

    def _hold(self) -> ExtrinsicHold | None:
        """The hold on the extrinsic; None if there is none. The earliest versions do not say who holds it. Who releases
        what somebody may have held cannot take it back."""
        stored, unreadable = self.stored, self._unreadable
        is_held = stored.frozen if "frozen" not in unreadable else self._document.get("frozen") is not False
        if not is_held:
            return None
        return ExtrinsicHold() if stored.hold is None else ExtrinsicHold(**stored.hold.model_dump())

    def _with_latest(self, state: PairState) -> PairState:
        stored = self.stored
        latest = self._converted("latest estimate", lambda: _estimate_or_none(stored.latest), None)
        status = CalibrationStatus(stored.status)
        if "status" in self._unreadable and latest is not None:
            status = (
                CalibrationStatus.ACCEPTED if latest.verdict.decision is Decision.ACCEPTED else CalibrationStatus.FAILED
            )
        return replace(state, status=status, latest=latest, failures=_reasons(stored.failures))

    def _with_health(self, state: PairState) -> PairState:
        """The state with its health: as it was, or with less confidence if a part of the state is lost."""
        stored, unreadable = self.stored, self._unreadable
        health, reasons = HealthState(stored.health), _reasons(stored.reasons)
        if unreadable.intersection(("health", "unseen_from")) and health not in _RED:
            health = self._at_best(state, health)
        if unreadable.intersection(("health", "reasons")):
            text = f"Last known: {health.value}. The reasons could not be read from the state."
            reasons = (Reason(LAST_KNOWN, text),)
        if self._lost and health is HealthState.HEALTHY:
            health = HealthState.UNKNOWN
        unseen_from = stored.unseen_from
        if unseen_from is not None and self._lost and unseen_from.state == "healthy":
            unseen_from = None
        flagged_since_ns = stored.flagged_since_ns
        if "flagged_since_ns" in unreadable and (health in _RED or state.monitor.outcome in ACCUSING):
            flagged_since_ns = state.valid_from_ns
        return replace(
            state,
            health=health,
            reasons=reasons,
            unseen_from=None
            if unseen_from is None
            else Health(HealthState(unseen_from.state), _reasons(unseen_from.reasons)),
            flagged_since_ns=flagged_since_ns,
            poor_since_ns=stored.poor_since_ns,
        )

    def _at_best(self, state: PairState, health: HealthState) -> HealthState:
        """The health that the other parts of the state allow at best, where the health itself is lost."""
        if state.monitor.outcome is MonitorOutcome.CONFIRMED:
            return HealthState.MISCALIBRATED
        contradicted = state.pending is not None and state.pending.contradicts
        if state.record.accused or contradicted or state.monitor.outcome in ACCUSING:
            return HealthState.SUSPECT
        return health if "health" not in self._unreadable else HealthState.UNKNOWN

    def _heads(self) -> Mapping[str, str]:
        # The first versions kept one book, and its head under another name.
        head = self._document.get("history_head")
        heads = self.stored.history_heads
        return {"results": head} if isinstance(head, str) and "history_heads" not in self._document else heads


_RED = frozenset({HealthState.SUSPECT, HealthState.MISCALIBRATED})

_MONITOR = TypeAdapter(MonitorState)


class _NotAPoseError(StateError):
    """A matrix that should be a pose is no rigid transform."""


class _BeyondMeasureError(StateError):
    """A number is one that no estimate has."""


def _reasons(stored: tuple[replies.Reason, ...]) -> tuple[Reason, ...]:
    return tuple(Reason(reason.code, reason.text) for reason in stored)


def _pose(rows: Rows) -> Matrix4:
    """The pose in these rows, checked to be rigid: the checksum of the file does not prove that this service wrote
    it."""
    pose = np.array(rows, dtype=np.float64)
    if not se3.is_rigid(pose):
        raise _NotAPoseError("no rigid transform")
    return pose


def _estimate_or_none(stored: CalibrationResult | None) -> Estimate | None:
    return None if stored is None else _estimate(stored)


def _estimate(stored: CalibrationResult) -> Estimate:
    moved = () if stored.moved is None else (stored.moved.before, stored.moved.after)
    for transform in (stored.camera_from_lidar, *moved):
        _pose(transform.matrix)
    estimate = estimate_of(stored)
    if (estimate.uncertainty.noise.diagonal() < 0.0).any():
        raise _BeyondMeasureError("a variance is negative")
    shifts = np.abs([estimate.correction, *estimate.uncertainty.systematic.values()])
    if (shifts > LARGEST_CORRECTION).any() or (np.abs(estimate.uncertainty.noise) > LARGEST_CORRECTION**2).any():
        raise _BeyondMeasureError("a correction or its uncertainty is larger than any that is estimated")
    return estimate


def _track(stored: dict[str, Any]) -> Track:
    track = track_from_dict(stored)
    for posterior in (track.slow, track.candidate):
        if posterior is not None:
            _pose(rows_of(posterior.T_camera_lidar))
    return track
