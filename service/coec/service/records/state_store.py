"""The states of all pairs, in one state file: for each pair a flat JSON object, whose fields belong to parts with
versions of their own.

What one version of the software wrote, older and newer ones have to read, so three rules hold for every change:

- A field that is added has a default, which it takes in files of earlier versions.
- A field that an earlier version requires is written for ever.
- The version of a part is raised only if earlier versions would misunderstand the part; they drop it then.

A part that cannot be read falls back alone, and never to something better than what was known: an unreadable hold
holds, an unreadable health is `unknown` at best, and a suspicion outlives the evidence for it.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from cattrs import ClassValidationError, Converter
from cattrs.gen import override
from pydantic import ValidationError

from coec.calibration import state as lifecycle
from coec.calibration.monitor.change_detector import ACCUSING, MonitorOutcome, MonitorState
from coec.calibration.state_machine import AlarmRecord, HealthState
from coec.calibration.tracker import PosePosterior, Track
from coec.calibration.types import Decision, Estimate, Matrix4, Reason, Rig
from coec.errors import NotFoundError, StateError
from coec.io import converter
from coec.io.rig_files import identity_sha256, is_same_rig, rig_identity
from coec.io.serialise import estimate_of, result_of
from coec.io.storage import BROKEN, NEWER, OLDER, StateFile
from coec.schemas.replies import CalibrationResult
from coec.untrusted import Untrusted

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class StoredPair(lifecycle.PairState):
    """`PairState` on the disk. Beside it: the versions of its parts, the rig that it belongs to, when (wall clock) a
    check was last completed, since when the pair is in its state of health, and the heads of its history on the disk.

    The defaults are those of a file that lacks the field. `rig_sha256` and `frozen` say what `rig` and `hold` say, for
    earlier versions.
    """

    T_camera_lidar: Matrix4 = field(default_factory=lambda: np.eye(4))
    provenance: lifecycle.Provenance = lifecycle.Provenance.RESTORED
    status: lifecycle.CalibrationStatus = lifecycle.CalibrationStatus.NOT_ACCEPTED
    valid_from_ns: int = 0
    reasons: tuple[Reason, ...] = ()
    versions: dict[str, int] = field(default_factory=dict)
    rig_sha256: str | None = None
    rig: dict[str, Any] | None = None
    frozen: bool = False
    completed_wall_ns: int | None = None
    completed_stamp_ns: int | None = None
    since_wall_ns: int | None = None
    history_heads: dict[str, str] = field(default_factory=dict)
    commissioned_from: tuple[str, ...] = ()


FIELDS: Final = frozenset(one.name for one in fields(StoredPair))
"""The names of all fields on the disk."""

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

    state: lifecycle.PairState
    clocks: Clocks
    history_heads: Mapping[str, str]
    commissioned_from: tuple[str, ...]
    lost: tuple[LostPart, ...] = ()


def pair_to_json(
    rig: Rig, vehicle: str, state: lifecycle.PairState, clocks: Clocks, commissioned_from: tuple[str, ...]
) -> dict[str, Any]:
    """The state as JSON values, without the heads of the history."""
    identity = rig_identity(rig)
    stored = StoredPair(
        **_fields_of(state),
        versions={name: part.version for name, part in PARTS.items()},
        rig_sha256=identity_sha256(identity),
        rig=identity,
        frozen=state.hold is not None,
        **_fields_of(clocks),
        commissioned_from=commissioned_from,
    )
    document: dict[str, Any] = STATE_FORM.unstructure(stored)
    for holder, name in ((document, "latest"), (document, "accepted"), (document["pending"], "result")):
        if holder is not None and holder[name] is not None:
            holder[name] = result_of(holder[name], rig, vehicle).model_dump(mode="json")
    return document


def _fields_of(value: lifecycle.PairState | Clocks) -> dict[str, Any]:
    """The fields of a dataclass by name."""
    return {one.name: getattr(value, one.name) for one in fields(value)}


LARGEST_CORRECTION = 1e9
"""Largest correction, and standard deviation of it, that a state file may hold, radians or metres. No window gives
more, and values below it stay finite in degrees and squared."""


class _BeyondMeasureError(ValueError):
    """A number is one that no estimate has."""


def _state_form() -> Converter:
    """The rules by which a `StoredPair` is written and read. Of an estimate the wire's model is written, which names
    the rig and the vehicle, too; see `pair_to_json`."""
    form = converter.make_converter()
    form.register_structure_hook(Estimate, _read_estimate)
    form.register_unstructure_hook(Estimate, lambda estimate: estimate)
    untrusted = override(struct_hook=lambda value, _: Untrusted(converter.text(value)))
    converter.register(form, Reason, code=untrusted, text=untrusted)
    converter.register(
        form, lifecycle.PendingEstimate, T_camera_lidar=converter.POSE, estimate=override(rename="result")
    )
    observed = converter.array(6, of=converter.flag)
    converter.register(
        form,
        PosePosterior,
        T_camera_lidar=converter.POSE,
        covariance=converter.array(6, 6),
        systematic=converter.arrays(6),
        observed=observed,
    )
    # The first versions knew no lag.
    converter.register(
        form,
        Track,
        required=[one.name for one in fields(Track) if one.name != "lag"],
        prior_sigma=converter.array(6),
        lag=converter.array(6),
    )
    count = converter.bounded(converter.whole_number, lambda value: value >= 0, "a count")
    converter.register(form, AlarmRecord, watched_ns=count, confirmed=count, withdrawn=count)
    # Nanoseconds since 1970, as the clocks of Linux count them.
    wall_ns = converter.bounded(
        lambda value: None if value is None else converter.whole_number(value),
        lambda value: value is None or 0 <= value < 2**63,
        "a time since 1970",
    )
    converter.register(form, lifecycle.ExtrinsicHold, since_ns=wall_ns)
    converter.register(
        form, StoredPair, T_camera_lidar=converter.POSE, completed_wall_ns=wall_ns, since_wall_ns=wall_ns
    )
    return form


def _read_estimate(value: Any, _: object) -> Estimate:
    result = CalibrationResult.model_validate(value)
    moved = () if result.moved is None else (result.moved.before, result.moved.after)
    for transform in (result.camera_from_lidar, *moved):
        converter.read_pose(transform.matrix)
    estimate = estimate_of(result)
    if (estimate.uncertainty.noise.diagonal() < 0.0).any():
        raise _BeyondMeasureError("a variance is negative")
    shifts = np.abs([estimate.correction, *estimate.uncertainty.systematic.values()])
    if (shifts > LARGEST_CORRECTION).any() or (np.abs(estimate.uncertainty.noise) > LARGEST_CORRECTION**2).any():
        raise _BeyondMeasureError("a correction or its uncertainty exceeds the largest that is estimated")
    return estimate


STATE_FORM: Final = _state_form()


class AnotherRigError(StateError):
    """The state belongs to another rig."""


def pair_from_json(document: Mapping[str, Any], rig: Rig | None, nominal: lifecycle.PairState) -> RestoredPair:
    """The state that this version or another one wrote, as far as it can be read.

    Args:
        rig: the rig of the pair; None: any.
        nominal: the state if the extrinsic is lost.

    Raises:
        AnotherRigError: the state belongs to another rig.
    """
    reader = _Reader(document, nominal)
    reader.check_rig(rig)
    return reader.restored()


class _Reader:
    """Reads the parts of one document, each by itself, and notes which are lost."""

    def __init__(self, document: Mapping[str, Any], nominal: lifecycle.PairState) -> None:
        self._document = document
        self._nominal = nominal
        versions = document.get("versions")
        self._versions: Mapping[str, Any] = versions if isinstance(versions, dict) else {}
        self._lost: dict[str, LostPart] = {}
        self._stored, self._unreadable = self._read()

    def _read(self) -> tuple[StoredPair, frozenset[str]]:
        """The document with the defaults for all fields that cannot be read, and the names of these fields, whose parts
        are lost."""
        unreadable = {name for part in PARTS if self._written_by(part) == "newer" for name in PARTS[part].fields} | {
            "versions"
        }
        monitor = self._document.get("monitor")
        if isinstance(monitor, dict) and "turned" not in monitor:  # the first versions counted votes
            unreadable.add("monitor")
        damage: dict[str, str | None] = {}
        while True:
            readable = {name: value for name, value in self._document.items() if name not in unreadable}
            try:
                stored = STATE_FORM.structure(readable, StoredPair)
                break
            except ClassValidationError as error:
                damage = {note.name: _implausible(one) for one, note in error.group_exceptions()[0]}
                unreadable |= damage.keys()
        for name, part in PARTS.items():
            # Of the rig one of two fields suffices, and an older version writes only one of them.
            if name != "rig" and unreadable.intersection(part.fields):
                self._lose(name, next((why for one in part.fields if (why := damage.get(one))), None))
        return stored, frozenset(unreadable)

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

    def check_rig(self, rig: Rig | None) -> None:
        """Notes that the rig is unknown if it is.

        Raises:
            AnotherRigError: the state belongs to another rig.
        """
        sha256, identity = self._stored.rig_sha256, self._stored.rig
        if sha256 is None and identity is None:
            self._lose("rig")
        elif rig is not None:
            same = sha256 == identity_sha256(rig_identity(rig))
            if not same and not (identity is not None and is_same_rig(rig, identity)):
                raise AnotherRigError("the state belongs to another rig")

    def restored(self) -> RestoredPair:
        """The state, as far as it can be read."""
        stored = self._stored
        state = lifecycle.PairState(**{one.name: getattr(stored, one.name) for one in fields(lifecycle.PairState)})
        state = replace(self._with_calibration(state), hold=self._hold())
        if "status" in self._unreadable and state.latest is not None:
            accepted = state.latest.verdict.decision is Decision.ACCEPTED
            state = replace(
                state, status=lifecycle.CalibrationStatus.ACCEPTED if accepted else lifecycle.CalibrationStatus.FAILED
            )
        state = self._with_health(state)
        if "monitor" in self._lost and (state.seen in _RED or state.monitor.outcome in ACCUSING):
            # A monitor that has forgotten what it had against the extrinsic may not acquit it: only a window may.
            state = replace(state, proven=False)
        clocks = Clocks(stored.completed_wall_ns, stored.completed_stamp_ns, stored.since_wall_ns)
        # The first versions kept one book, and its head under another name.
        head = self._document.get("history_head")
        is_alone = isinstance(head, str) and "history_heads" not in self._document
        heads = {"results": str(head)} if is_alone else stored.history_heads
        return RestoredPair(state, clocks, heads, stored.commissioned_from, tuple(self._lost.values()))

    def _with_calibration(self, state: lifecycle.PairState) -> lifecycle.PairState:
        """What is served, and all that refers to it."""
        if self._document.get("T_camera_lidar") is None:
            self._lose("extrinsic")
        monitor = state.monitor if "monitor" not in self._unreadable else self._without_evidence()
        if "extrinsic" in self._lost or "rig" in self._lost:
            nominal = self._nominal
            state = replace(
                state,
                T_camera_lidar=nominal.T_camera_lidar,
                provenance=nominal.provenance,
                valid_from_ns=nominal.valid_from_ns,
                accepted=nominal.accepted,
                proven=nominal.proven,
                # Of another pose the evidence says nothing, but causes in the data stay what they are.
                monitor=MonitorState(blind=monitor.blind, dirt=monitor.dirt),
            )
            return replace(state, track=None, pending=None) if "rig" in self._lost else state
        if "valid_from_ns" in self._unreadable and state.accepted is not None:
            state = replace(state, valid_from_ns=state.accepted.data_stamp_ns)
        return replace(state, monitor=monitor, proven=state.proven and "provenance" not in self._lost)

    def _without_evidence(self) -> MonitorState:
        """What is left of a monitor whose evidence cannot be read: what speaks against the mount or the data, and
        whether a window has vouched for the extrinsic."""
        document = self._document.get("monitor")
        left = MonitorState()
        if not isinstance(document, dict):
            return left
        for name in document.keys() & {"outcome", "blind", "dirt", "vouched", "doubtful"}:
            try:
                read = converter.structured(STATE_FORM, {name: document[name]}, MonitorState)
            except converter.MalformedValueError:
                continue
            left = replace(left, **{name: getattr(read, name)})
        return left if left.outcome in ACCUSING else replace(left, outcome=MonitorOutcome.UNKNOWN)

    def _hold(self) -> lifecycle.ExtrinsicHold | None:
        """The hold on the extrinsic; None if there is none. The earliest versions do not say who holds it. Who releases
        what somebody may have held cannot take it back."""
        stored, unreadable = self._stored, self._unreadable
        is_held = stored.frozen if "frozen" not in unreadable else self._document.get("frozen") is not False
        return (stored.hold or lifecycle.ExtrinsicHold()) if is_held else None

    def _with_health(self, state: lifecycle.PairState) -> lifecycle.PairState:
        """The state with its health: as it was, or with less confidence if a part of the state is lost."""
        unreadable, health, reasons = self._unreadable, state.health, state.reasons
        if unreadable.intersection(("health", "unseen_from")) and health not in _RED:
            health = self._at_best(state, health)
        if unreadable.intersection(("health", "reasons")):
            why = f"Last known: {health.value}. The reasons could not be read from the state."
            reasons = (Reason(lifecycle.LAST_KNOWN, why),)
        if self._lost and health is HealthState.HEALTHY:
            health = HealthState.UNKNOWN
        unseen_from = state.unseen_from
        if unseen_from is not None and self._lost and unseen_from.state is HealthState.HEALTHY:
            unseen_from = None
        flagged_since_ns = state.flagged_since_ns
        if "flagged_since_ns" in unreadable and (health in _RED or state.monitor.outcome in ACCUSING):
            flagged_since_ns = state.valid_from_ns
        return replace(
            state, health=health, reasons=reasons, unseen_from=unseen_from, flagged_since_ns=flagged_since_ns
        )

    def _at_best(self, state: lifecycle.PairState, health: HealthState) -> HealthState:
        """The health that the other parts of the state allow at best, where the health itself is lost."""
        if state.monitor.outcome is MonitorOutcome.CONFIRMED:
            return HealthState.MISCALIBRATED
        contradicted = state.pending is not None and state.pending.contradicts
        if state.record.accused or contradicted or state.monitor.outcome in ACCUSING:
            return HealthState.SUSPECT
        return health if "health" not in self._unreadable else HealthState.UNKNOWN


_RED = frozenset({HealthState.SUSPECT, HealthState.MISCALIBRATED})


def _implausible(error: BaseException) -> str | None:
    """Why a value of the right form is none that this service wrote; None if its form is wrong."""
    if isinstance(error, BaseExceptionGroup):
        return next((why for one in error.exceptions if (why := _implausible(one))), None)
    if isinstance(error, converter.NotRigidError):
        return "a pose in it is no rigid transform"
    return str(error) if isinstance(error, _BeyondMeasureError) else None


STATE_FILE = "state.json"

_SUFFIX: Final[Mapping[Literal["older", "newer"] | None, str]] = {"older": OLDER, "newer": NEWER, None: BROKEN}
"""Suffix under which a file is kept aside, by the version that wrote the part that cannot be read."""


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

    def load(self, rig: Rig) -> RestoredPair | None:
        """What is known of the pair, as far as it can be read; None if nothing is, or if it belongs to another rig,
        which is logged. If a part cannot be read, the file is kept aside when the state is next put on the disk.

        Raises:
            StateError: nothing of the pair can be read. The file is kept aside likewise.
        """
        document = self._pairs.get(rig.pair)
        if document is None:
            return None
        if not isinstance(document, dict):
            self._file.reject()
            raise StateError(f"the state of pair {rig.pair} is no JSON object")
        try:
            remembered = pair_from_json(document, rig, lifecycle.initial_state(rig))
        except AnotherRigError:
            _log.warning(
                "the state on the disk belongs to another rig: starting from nominal",
                extra={"fields": {"pair": rig.pair}},
            )
            return None
        for lost in remembered.lost:
            self._file.reject(_SUFFIX[lost.written_by])
            fields = {"pair": rig.pair, "part": lost.part, "why": lost.why}
            _log.warning("a part of the state on the disk cannot be read", extra={"fields": fields})
        if document.keys() - FIELDS - OF_FIRST_VERSIONS:
            self._file.reject(NEWER)
            message = "a newer version wrote fields of the state that this one does not know: the file is kept aside"
            _log.info(message, extra={"fields": {"pair": rig.pair}})
        return remembered

    def update(
        self,
        rig: Rig,
        state: lifecycle.PairState,
        clocks: Clocks,
        history_heads: Callable[[], Mapping[str, str]],
        commissioned_from: tuple[str, ...] = (),
    ) -> None:
        """Keeps the pair's state, and the ids of the windows from which it was commissioned. The next `flush` writes
        them, together with what `history_heads()` returns then."""
        document = pair_to_json(rig, self._vehicle, state, clocks, commissioned_from)
        with self._lock:
            self._pairs[rig.pair] = document
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
            updated = {pair: {**pairs[pair], "history_heads": dict(of_pair())} for pair, of_pair in heads.items()}
            self._file.save({"pairs": {**pairs, **updated}})


def read_pairs(folder: Path) -> dict[str, tuple[CalibrationResult | None, lifecycle.PairState]]:
    """What a state directory holds of every pair whose extrinsic can be read, for programs that read it beside the
    service or without one: the accepted result and the state. Other parts that cannot be read have their defaults, as
    in the service.

    Raises:
        NotFoundError: the directory holds no state file.
        StateError: no copy of the state file, or none of its extrinsics, can be used; the message says why.
    """
    loaded = StateFile(folder / STATE_FILE).load()
    if loaded.body is None:
        if loaded.damage:
            raise StateError(f"{folder / STATE_FILE} cannot be used: {'; '.join(loaded.damage)}")
        raise NotFoundError(f"{folder} holds no {STATE_FILE}")
    documents = loaded.body.get("pairs")
    readable: dict[str, tuple[CalibrationResult | None, lifecycle.PairState]] = {}
    refused = [] if isinstance(documents, dict) else ["it lists no pairs"]
    for name, document in (documents if isinstance(documents, dict) else {}).items():
        if not isinstance(document, dict):
            refused.append(f"pair {name} is no JSON object")
            continue
        unknown = lifecycle.PairState(
            np.eye(4), lifecycle.Provenance.NOMINAL, lifecycle.CalibrationStatus.NOT_ACCEPTED, 0
        )
        remembered = pair_from_json(document, None, unknown)
        extrinsic = [lost.why for lost in remembered.lost if lost.part == "extrinsic"]
        if extrinsic:
            refused.append(f"the extrinsic of pair {name} is {extrinsic[0]}")
        else:
            readable[name] = _accepted_result(document), remembered.state
    if refused and not readable:
        raise StateError(f"{folder / STATE_FILE} cannot be used: {'; '.join(refused)}")
    return readable


def _accepted_result(document: Mapping[str, Any]) -> CalibrationResult | None:
    """The accepted result as it was written, which names the frames and the lens; None if it cannot be read."""
    try:
        return CalibrationResult.model_validate(document.get("accepted"))
    except ValidationError:
        return None
