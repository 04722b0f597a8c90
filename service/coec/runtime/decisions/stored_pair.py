"""The state of a pair on the disk: one flat JSON object, whose fields belong to parts with versions of their own.

What one version of the software wrote, older and newer ones have to read, so three rules hold for every change:

- A field that is added has a default, which it takes in files of earlier versions.
- A field that an earlier version requires is written for ever.
- The version of a part is raised only if earlier versions would misunderstand the part; they drop it then.

`pair_reader` reads what all versions wrote.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from coec.adapters.files.conversions import result_of
from coec.adapters.files.rig import identity_sha256, rig_identity
from coec.calibration.lifecycle import PairState
from coec.calibration.monitor.change_detector import MonitorState
from coec.calibration.tracker import track_to_dict
from coec.calibration.types import Matrix4, Reason, Rig
from coec.schemas import replies
from coec.schemas.base import Part
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
        failures=_stored_reasons(state.failures),
        completed_wall_ns=clocks.completed_wall_ns,
        health=state.health.value,
        reasons=_stored_reasons(state.reasons),
        unseen_from=None
        if state.unseen_from is None
        else StoredHealth(state=state.unseen_from.state.value, reasons=_stored_reasons(state.unseen_from.reasons)),
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


def _stored_reasons(reasons: tuple[Reason, ...]) -> tuple[replies.Reason, ...]:
    return tuple(replies.Reason(code=reason.code, text=reason.text) for reason in reasons)
