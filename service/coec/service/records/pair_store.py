"""The books of a pair: its state, its history, its incidents, and when a check was last completed.

Every change of the state passes through `update`. It compares the states before and after, and writes down what has
changed: a line of the history for every new extrinsic and every new state of health, and evidence for every red one.
Then all books are put on the disk. Only the thread of the engine changes them; what others read is
immutable.
"""

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from coec.calibration.frames.window import CarriedOverPairs
from coec.calibration.state import PairState, Provenance, aged, carried_over_pairs, initial_state, overdue, restored
from coec.calibration.state_machine import HealthState
from coec.calibration.types import NS_PER_S, Matrix4, Reason, Rig
from coec.config import StateConfig
from coec.errors import NotFoundError, StateError
from coec.io.disk_writer import DiskWriter
from coec.io.logs import LossCounter
from coec.io.serialise import transform_of
from coec.schemas import replies
from coec.service.recording.window_store import WindowStore, WindowVersion
from coec.service.records.history import GENESIS, CheckLog, HistoryRecord, PairHistory
from coec.service.records.incidents import Incidents, Side
from coec.service.records.state_store import Clocks, LostPart, StateStore
from coec.service.timing import Clock

_log = logging.getLogger(__name__)

EntryKind = Literal["estimate", "extrinsic", "state", "command", "commissioned", "chain"]

MIN_HASH = 8
"""At least so many characters of a hash name a line of the history."""

DEFAULT_TEXTS = {
    HealthState.HEALTHY: "What is served has been looked at and agrees with the data.",
    HealthState.UNKNOWN: "What is served has not been looked at.",
}
"""Text for a state of health that comes without reasons."""


@dataclass(frozen=True, slots=True, eq=False)
class ServedExtrinsic:
    """An extrinsic (4, 4) that is or was served; `epoch` counts the extrinsics that were served."""

    epoch: int
    T_camera_lidar: Matrix4


@dataclass(frozen=True, slots=True, eq=False)
class StateTransition:
    """A step that was taken: the states before and after it, and what is served after it."""

    before: PairState
    after: PairState
    served: ServedExtrinsic


@dataclass(frozen=True, slots=True)
class PairRecords:
    """The books as others see them, oldest first."""

    entries: tuple[HistoryRecord, ...]
    checks: tuple[replies.CheckReply, ...]
    events: tuple[replies.EvidenceEvent, ...]

    @property
    def results(self) -> tuple[replies.CalibrationResult, ...]:
        """Results of windows."""
        return tuple(record.result for record in self.entries if record.result is not None)


class PairStore:
    """Keeps the books of one pair.

    Attributes:
        state: the state now; `update` changes it.
        history, incidents: the books themselves.
        damage: why a part of what was found on the disk could not be used; None if all could.
        transitions: number of changes of health, by the state that was entered.
    """

    def __init__(
        self,
        rig: Rig,
        vehicle: str,
        config: StateConfig,
        store: StateStore,
        disk_writer: DiskWriter,
        folder: WindowStore,
        losses: LossCounter,
        clock: Clock,
    ) -> None:
        self._rig = rig
        self._clock = clock
        self._disk_writer = disk_writer
        self._vehicle = vehicle
        self._store = store
        self._folder = folder
        self._losses = losses
        self._completed_s: float | None = None
        self._completed_stamp_ns: int | None = None
        self._since_ns = self._clock.wall_ns()
        self.damage: Reason | None = None
        self.transitions: Counter[str] = Counter()
        self._epoch = 0
        self._commissioned_from: tuple[str, ...] = ()
        remembered, heads = self._restore()
        self.state = restored(remembered)
        self.history = PairHistory(config.directory, rig.pair, config.history, heads)
        self.incidents = Incidents(config.directory / "evidence", rig.pair, config.evidence)
        self._checks = CheckLog(config.directory / f"checks-{rig.pair}.jsonl", config.checks)
        self.protect()
        disk_writer.register(self.history, self.incidents, self._checks, store)
        disk_writer.on_replaced(self._note_replaced)
        if self.damage is not None:
            self.history.append(self._entry("chain", self.damage.code, self.damage.text))
        if self.history.damage is not None:
            losses.add("storage", "history_damaged", detail=self.history.damage)
            text = f"The chain of the history is broken: {self.history.damage}. It is kept aside."
            self.damage = self.damage or Reason("history_damaged", text)
            self.history.append(self._entry("chain", "broken", text))
        if self.damage is not None:
            self.save()
        if self.state.health is not remembered.health:
            self._since_ns = self._clock.wall_ns()
            self._note_health(remembered, self.state, None)

    @property
    def served(self) -> ServedExtrinsic:
        """What is served now."""
        return ServedExtrinsic(self._epoch, self.state.T_camera_lidar)

    @property
    def carried_over(self) -> CarriedOverPairs | None:
        """Pairs of the latest window that belong to the next one, because the camera moved before they were taken. None
        if there are none, or a window has been recorded since."""
        latest = self.state.latest
        recorded = self._folder.windows(self._rig.pair)
        if latest is None or not recorded or recorded[-1].stem != latest.window_id:
            return None
        return carried_over_pairs(latest)

    @property
    def since_ns(self) -> int:
        """Wall clock when the state of health began."""
        return self._since_ns

    @property
    def completed_stamp_ns(self) -> int | None:
        """Sensor time of the last pair of the check, or the accepted window, that was completed last."""
        return self._completed_stamp_ns

    @property
    def age_s(self) -> float | None:
        """Time since a check was last completed or a window accepted, s; None if unknown."""
        return None if self._completed_s is None else self._clock.monotonic_s() - self._completed_s

    def update(
        self,
        step: Callable[[PairState], PairState],
        stamp_ns: int | None,
        *,
        completed: bool,
        epoch: int | None = None,
    ) -> StateTransition | None:
        """Takes a step. Returns None, and does nothing, if the extrinsic has changed since `epoch`.

        Args:
            stamp_ns: sensor time of the data behind the step.
            completed: whether a check was completed or a window accepted, so that the age begins anew.

        Raises:
            CommandRefusedError: raised by `step`; nothing has changed then.
        """
        if epoch is not None and epoch != self._epoch:
            return None
        before = self.state
        after = step(before)
        record = after.record.watched(self._completed_stamp_ns, stamp_ns) if completed else after.record
        replaced = not np.array_equal(before.T_camera_lidar, after.T_camera_lidar)
        after = self.state = replace(after, record=record.entered(after.health, replaced=replaced))
        if completed:
            self._completed_s, self._completed_stamp_ns = self._clock.monotonic_s(), stamp_ns
            self.damage = None if self.history.damage is None else self.damage
        self._note(before, after, stamp_ns, replaced=replaced)
        self.save()
        return StateTransition(before, after, self.served)

    def note_result(self, result: replies.CalibrationResult) -> None:
        """A window was solved."""
        reasons = "; ".join(reason.text for reason in result.verdict.reasons)
        text = reasons or f"A window of {result.pairs} pairs was accepted."
        entry = self._entry("estimate", result.verdict.decision, text, result.data_stamp_ns)
        self.history.append(entry.model_copy(update={"window_id": result.window_id}), result)

    def note_check(self, check: replies.CheckReply) -> None:
        """The monitor made a check."""
        values = {name: metric.value for name, metric in check.metrics.items()}
        self.incidents.note(replies.MetricsPoint(stamp_ns=check.stamp_ns, state=check.state, metrics=values))
        self._checks.append(check)
        self._disk_writer.write(self._checks, self.incidents)

    def checks(self) -> tuple[replies.CheckReply, ...]:
        """All checks that are kept, oldest first."""
        return self._checks.checks()

    def publishable_records(self) -> PairRecords:
        """The books that may be reported: only what is on the disk, so that a restart would know it, too. If the disk
        has refused for so long that `health` reports it, everything."""
        if self._disk_writer.problem is None:
            return PairRecords(self.history.on_disk(), self._checks.on_disk(), self.incidents.on_disk())
        return PairRecords(self.history.entries(), self._checks.checks(), self.incidents.events())

    def note_command(
        self, name: str, code: str, text: str, sender: str, *, accepted: bool, reason: str | None = None
    ) -> None:
        """Writes down that a command was carried out or refused, with the `reason` that its sender gave, if any. If
        equal refusals follow each other, only the first is written down."""
        last = next(reversed(self.history.entries()), None)
        entry_text = f"{name}: {text}"
        if not accepted and last is not None:
            entry = last.entry
            if (entry.kind, entry.code, entry.text) == ("command", code, entry_text):
                return
        self.history.append(
            self._entry("command", code, entry_text).model_copy(update={"sender": sender, "reason": reason})
        )

    def note_commissioned(self, text: str, window_ids: tuple[str, ...]) -> None:
        """The rig has a baseline, learned from these windows."""
        self.history.append(self._entry("commissioned", "commissioned", text))
        self._commissioned_from = window_ids
        self.protect()

    def served_before(self, name: str | None) -> tuple[HistoryRecord, replies.CalibrationResult]:
        """A calibration that was served, as the history holds it, and the accepted result on which it rested.

        Args:
            name: id of an accepted window, or the beginning of the sha256 of its line or of an extrinsic's line. It
                names the calibration that was served once that line was known. None: the calibration before the one
                that is served now.

        Raises:
            NotFoundError: no calibration has this name, or the name is ambiguous.
        """
        served = transform_of(self.state.T_camera_lidar).matrix
        results: dict[str, replies.CalibrationResult] = {}
        matches: dict[str, HistoryRecord] = {}
        in_force: HistoryRecord | None = None
        requested_by_window: str | None = None
        for record in self.history.entries():
            entry = record.entry
            if record.result is not None and record.result.status == "accepted":
                results[record.result.window_id] = record.result
                requested_by_window = record.result.window_id if _is_named(record, name) else requested_by_window
                if in_force is not None and _is_named(record, name):
                    matches[record.result.window_id] = in_force
            if entry.kind != "extrinsic" or entry.camera_from_lidar is None or entry.window_id not in results:
                continue
            in_force = record
            if name is None:
                if entry.camera_from_lidar.matrix != served:
                    matches = {entry.window_id: record}
            elif _is_named(record, name) or entry.window_id == requested_by_window:
                matches[entry.window_id] = record
        if not matches:
            raise NotFoundError("no such served calibration in `history`; `reset` returns to nominal")
        if len(matches) > 1:
            raise NotFoundError("the beginning of the hash is ambiguous: give more of it")
        (line,) = matches.values()
        return line, results[str(line.entry.window_id)]

    def save(self) -> None:
        """Has all books put on the disk: those of the history before the state, because the state names their ends."""
        age_s = self.age_s
        completed_ns = None if age_s is None else self._clock.wall_ns() - round(age_s * NS_PER_S)
        clocks = Clocks(completed_ns, self._completed_stamp_ns, self._since_ns)
        heads, windows = self.history.durable_heads, self._commissioned_from
        self._store.update(self._rig, self.state, clocks, heads, windows)
        self._disk_writer.write(self.history, self.incidents, self._store)

    def is_on_disk(self) -> bool:
        """Whether all that was noted and saved before this call is on the disk; see `DiskWriter.has_written`."""
        return self._disk_writer.has_written()

    def may_be_published(self) -> bool:
        """Whether the state is on the disk, or `health` says why not. Does not wait."""
        return self._disk_writer.has_written(0.0) or self._disk_writer.problem is not None

    def age(self, why_overdue: Reason | None, silent_s: float, stale_after_s: float) -> None:
        """Time has passed: ages the state. `why_overdue` says why no check was completed in time (None: one was);
        `silent_s` is the time since the last completed check."""

        def passed(state: PairState) -> PairState:
            late = state if why_overdue is None else overdue(state, why_overdue)
            return aged(late, silent_s, stale_after_s)

        if passed(self.state) is not self.state:
            self.update(passed, None, completed=False)

    # --- inside -----------------------------------------------------------------------------------------------------

    def _note_replaced(self, text: str) -> None:
        self.history.append(self._entry("chain", "rewritten", text))

    def _entry(self, kind: EntryKind, code: str, text: str, stamp_ns: int | None = None) -> replies.HistoryEntry:
        """An entry dated now; its place in the chain is filled in when it is appended."""
        return replies.HistoryEntry(
            sequence=0,
            previous_sha256=GENESIS,
            kind=kind,
            code=code,
            text=text,
            wall_ns=self._clock.wall_ns(),
            stamp_ns=stamp_ns,
        )

    def _restore(self) -> tuple[PairState, Mapping[str, str]]:
        damage = self._store.damage
        try:
            remembered = self._store.load(self._rig)
        except StateError as error:
            damage, remembered = (*damage, str(error)), None
        lost = () if remembered is None else remembered.lost
        if damage:
            source = "the previous copy" if remembered else "the nominal calibration"
            text = f"The state on the disk cannot be used: {'; '.join(damage)}. It is kept aside; {source} is served."
            self.damage = Reason("state_damaged", text)
            self._losses.add("storage", "state_damaged", len(damage), detail="; ".join(damage))
        if lost:
            self.damage = _damage_of(lost, self.damage)
        for part in lost:
            cause = "state_damaged" if part.written_by is None else f"state_{part.written_by}"
            self._losses.add("storage", cause, detail=part.text)
        if remembered is None:
            return initial_state(self._rig), {}
        self._commissioned_from = remembered.commissioned_from
        clocks = remembered.clocks
        now_ns = self._clock.wall_ns()
        if clocks.since_wall_ns is not None and clocks.since_wall_ns <= now_ns:
            self._since_ns = clocks.since_wall_ns
        # A clock that was set back since, or has not been set yet, cannot say how old the check is.
        if clocks.completed_wall_ns is not None and clocks.completed_wall_ns <= now_ns:
            self._completed_s = self._clock.monotonic_s() - (now_ns - clocks.completed_wall_ns) / NS_PER_S
            self._completed_stamp_ns = clocks.completed_stamp_ns
        return remembered.state, remembered.history_heads

    def _note(self, before: PairState, after: PairState, stamp_ns: int | None, *, replaced: bool) -> None:
        window_id = after.accepted.window_id if after.accepted else None
        if replaced or before.provenance is not after.provenance:
            self._epoch += replaced
            entry = self._entry("extrinsic", after.provenance.value, _ORIGIN[after.provenance], stamp_ns)
            served = {"camera_from_lidar": transform_of(after.T_camera_lidar), "window_id": window_id}
            self.history.append(entry.model_copy(update=served))
            fields = {"pair": self._rig.pair, "provenance": after.provenance.value, "window": window_id}
            _log.info(_ORIGIN[after.provenance], extra={"fields": fields})
        if before.health is not after.health:
            self._since_ns = self._clock.wall_ns()
            self._note_health(before, after, stamp_ns)

    def _note_health(self, before: PairState, after: PairState, stamp_ns: int | None) -> None:
        self.transitions[after.health.value] += 1
        text = "; ".join(reason.text for reason in after.reasons) or DEFAULT_TEXTS.get(after.health, "")
        self.history.append(self._entry("state", after.health.value, text, stamp_ns))
        fields = {"pair": self._rig.pair, "from": before.health.value, "to": after.health.value, "why": text}
        _log.info(f"health: {after.health.value}, before {before.health.value}", extra={"fields": fields})
        if after.health is HealthState.MISCALIBRATED:
            self._begin_incident(after, stamp_ns)
        elif before.health is HealthState.MISCALIBRATED:
            self.incidents.resolve(stamp_ns, f"{after.health.value}: {text}")

    def _begin_incident(self, state: PairState, stamp_ns: int | None) -> None:
        at_ns = stamp_ns if stamp_ns is not None else self._clock.wall_ns()
        since_ns = state.flagged_since_ns if state.flagged_since_ns is not None else at_ns
        by_window = state.pending is not None and state.latest is state.pending.estimate
        # The window that contradicts the served extrinsic cannot be the window before the event.
        deciding = state.latest.window_id if by_window and state.latest else None
        earlier = [
            result.window_id
            for result in self.history.results()
            if result.window_id != deciding
            and result.data_stamp_ns < since_ns
            and self._folder.path(result.window_id).exists()
        ]
        self.incidents.begin(
            replies.EvidenceEvent(
                event_id=f"{self._rig.pair}-{at_ns}",
                vehicle=self._vehicle,
                pair=self._rig.pair,
                stamp_ns=at_ns,
                wall_ns=self._clock.wall_ns(),
                reasons=tuple(replies.Reason(code=reason.code, text=reason.text) for reason in state.reasons),
                camera_from_lidar=transform_of(state.T_camera_lidar),
                window_before=earlier[-1] if earlier else None,
                window_after=deciding,
                metrics=(),
            )
        )
        self.protect()

    def add_picture(self, event_id: str, side: Side, jpeg: bytes) -> None:
        """Add a picture to an event."""
        self.incidents.add_overlay(event_id, side, jpeg)
        self._disk_writer.write(self.incidents)

    def note_window(self, window_id: str, version: WindowVersion) -> None:
        """Notes the new version of a window's file after it was written again."""
        self._folder.note(window_id, version)
        self._disk_writer.write(self._folder)

    def protect(self) -> None:
        """Protects in the window folder the windows that are evidence, and those from which the rig was
        commissioned."""
        protected: dict[str, replies.RetentionReason] = dict.fromkeys(self._commissioned_from, "commissioning")
        protected |= dict.fromkeys(self.incidents.window_ids, "red_event")
        self._folder.protect(self._rig.pair, protected)


def _damage_of(lost: tuple[LostPart, ...], before: Reason | None) -> Reason:
    """The reason that names the parts of the state that were lost, after the damage `before`."""
    texts = "; ".join(part.text for part in lost)
    text = (
        f"Parts of the state on the disk cannot be read: {texts}. Everything else is kept, and the file is kept aside."
    )
    if before is not None:
        return Reason(before.code, f"{before.text} {text}")
    if any(part.written_by is None for part in lost):
        return Reason("state_damaged", text)
    return Reason("state_other_version", text)


def _is_named(record: HistoryRecord, name: str | None) -> bool:
    if name is None:
        return False
    return name == record.entry.window_id or (len(name) >= MIN_HASH and record.sha256.startswith(name))


_ORIGIN = {
    Provenance.NOMINAL: "The workshop calibration is served.",
    Provenance.COMMISSIONED: "The commissioned calibration is served.",
    Provenance.ESTIMATED: "An accepted estimate is served.",
    Provenance.RESTORED: "An earlier calibration is served again.",
}
