"""What a command of a person does to a pair: it is carried out completely or not at all, and either outcome is written
into the history.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from coec.calibration import state as lifecycle
from coec.calibration.types import Rig
from coec.config import PairConfig
from coec.errors import NotFoundError
from coec.io.serialise import candidate_of, estimate_of, matrix_of
from coec.schemas.commands import Acknowledgement
from coec.schemas.replies import Candidate
from coec.service.engine.messages import Action, CommissioningSubject, SubmitCommissioning, SubmitSolve, WindowSubject
from coec.service.engine.pair import Pair
from coec.service.ingest.inbox import BusyError
from coec.service.recording.window_store import WindowStore
from coec.service.records.pair_store import MIN_HASH
from coec.service.timing import Clock

_log = logging.getLogger(__name__)

COMMISSIONING_WINDOWS = 8
"""How many windows, the newest, a rig is commissioned from: 200 pairs."""

EXPIRED = "The command waited for longer than its sender does; nothing was done. Send it again."


@dataclass(frozen=True, slots=True)
class PairCommand:
    """A command.

    Attributes:
        name: one of `apply`, `rollback`, `reset`, `commission`, `hold`, `calibrate`.
        deadline_s: time of the steady clock at which its sender gives up; later it is not carried out.
        sender: who gave it.
        reason: why, if the sender says so.
        candidate: which candidate `apply` means: id of its window, or the beginning of its sha256; None: any.
        to: which calibration `rollback` means; None: the one before.
        release: `hold` ends the hold.
    """

    name: str
    deadline_s: float
    sender: str
    reason: str | None = None
    candidate: str | None = None
    to: str | None = None
    release: bool = False


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a command needs to know from outside: the latest window on the disk, and how far a commissioning of the pair
    is, in words (None: it has none)."""

    latest: Path | None
    commissioning: str | None


class CommandExecutor:
    """Carries out the commands of one pair, on the thread of the engine."""

    def __init__(
        self, pair: PairConfig, vehicle: str, rig: Rig, engine: Pair, folder: WindowStore, clock: Clock
    ) -> None:
        self._vehicle = vehicle
        self._rig = rig
        self._engine = engine
        self._store = engine.store
        self._folder = folder
        self._clock = clock
        self._actions: list[Action] = []
        self.reconfigure(pair)

    def reconfigure(self, pair: PairConfig) -> None:
        """Carries out commands by these settings from now on."""
        self._pair, self._rules = pair, lifecycle.PairRules(pair.policy, pair.tracker, pair.monitor)

    def execute(self, command: PairCommand, surroundings: Surroundings) -> tuple[Acknowledgement, list[Action]]:
        """Carries out a command, or says why not; also returns what is to be done outside.

        Raises:
            BusyError: its sender has given up; nothing was done.
        """
        if self._clock.monotonic_s() > command.deadline_s:
            raise BusyError(EXPIRED)
        decided: dict[str, Callable[[], Acknowledgement]] = {
            "apply": partial(self._apply, command.candidate),
            "rollback": partial(self._roll_back, command.to),
            "reset": self._reset,
            "commission": partial(self._commission, surroundings.commissioning),
            "hold": partial(self._hold, command.sender, command.reason, release=command.release),
            "calibrate": partial(self._calibrate, surroundings.latest),
        }
        try:
            done = decided[command.name]()
        except lifecycle.CommandRefusedError as error:
            done = self._acknowledge(command.name, error.code, str(error), accepted=False)
        except NotFoundError as error:
            done = self._acknowledge(command.name, error.reply_code, str(error), accepted=False)
        self._write_down(done, command)
        actions, self._actions = self._actions, []
        return done, [*self._engine.take_actions(), *actions]

    def _write_down(self, done: Acknowledgement, command: PairCommand) -> None:
        sender, reason = command.sender, command.reason
        fields = {"pair": self._pair.name, "command": done.command, "sender": sender, "reason": reason}
        _log.info("command received", extra={"fields": {**fields, "accepted": done.accepted, "code": done.code}})
        self._store.note_command(done.command, done.code, done.text, sender, accepted=done.accepted, reason=reason)
        self._store.save()
        self._engine.publish()

    def _apply(self, name: str | None) -> Acknowledgement:
        """Applies the candidate that waits. `name`: id of its window, or the beginning of its sha256; another one that
        waits is not applied. None: whichever waits."""
        waits = candidate_of(self._store.state)

        def applied(state: lifecycle.PairState) -> lifecycle.PairState:
            after = lifecycle.apply_pending(state, self._rules)
            if waits is not None and name is not None and not _is_named(waits, name):
                raise lifecycle.CommandRefusedError(
                    "other_candidate",
                    f"There is another candidate, {str(waits.sha256)[:16]} from window {waits.window_id}; nothing was "
                    "done. Look at it (`extrinsic`), and name it.",
                )
            return after

        self._store.update(applied, None, completed=False)
        assert waits is not None  # `apply_pending` refuses
        text = f"The candidate {str(waits.sha256)[:16]} is served from now on."
        return self._replaced("apply", "applied", text, waits.window_id)

    def _roll_back(self, to: str | None) -> Acknowledgement:
        record, result = self._store.served_before(to)
        assert record.entry.camera_from_lidar is not None  # `served_before` returns no other
        pose, estimate = matrix_of(record.entry.camera_from_lidar), estimate_of(result)
        self._store.update(
            lambda state: lifecycle.rolled_back(state, pose, estimate, self._rules), None, completed=False
        )
        text = (
            f"The calibration {record.sha256[:16]} is served again; the next accepted window may move it: see `hold`."
        )
        return self._replaced("rollback", "rolled_back", text, result.window_id)

    def _reset(self) -> Acknowledgement:
        self._store.update(lambda state: lifecycle.reset(state, self._rig), None, completed=False)
        text = "The workshop calibration is served; the next accepted window may move it: see `hold`."
        return self._replaced("reset", "reset", text)

    def _hold(self, sender: str, reason: str | None, *, release: bool) -> Acknowledgement:
        if release:
            self._store.update(lifecycle.released, None, completed=False)
            return self._acknowledge("hold", "released", "Accepted estimates may be applied again.")
        hold = lifecycle.ExtrinsicHold(self._clock.wall_ns(), sender, reason or "")
        self._store.update(partial(lifecycle.held, hold=hold), None, completed=False)
        return self._acknowledge("hold", "held", "The extrinsic stays as it is until it is released.")

    def _replaced(self, name: str, code: str, text: str, window_id: str | None = None) -> Acknowledgement:
        self._engine.replaced()
        return self._acknowledge(name, code, text, window_id=window_id)

    def _commission(self, reached: str | None) -> Acknowledgement:
        """Has the worker learn the baseline from the windows that agree with what is served. A pair has one
        commissioning at a time; those of several pairs are done one after the other."""
        if reached is not None:
            text = f"The rig is being commissioned already ({reached}); `history` will say how it went."
            return self._acknowledge("commission", "commissioning_underway", text, accepted=False)
        pose = self._store.state.T_camera_lidar
        agreeing = [
            self._folder.path(result.window_id)
            for result in self._store.history.results()
            if result.status == "accepted"
            and self._folder.path(result.window_id).exists()
            and lifecycle.agrees(pose, estimate_of(result).optimum.T_camera_lidar, self._pair.policy)
        ]
        paths = list(dict.fromkeys(agreeing))[-COMMISSIONING_WINDOWS:]
        if not paths:
            text = "No recorded window agrees with what is served: calibrate first."
            return self._acknowledge("commission", "too_few_windows", text, accepted=False)
        subject = CommissioningSubject(tuple(path.stem for path in paths))
        self._actions.append(SubmitCommissioning(subject, pose, self._pair.calibration))
        windows = f"{len(paths)} window{'' if len(paths) == 1 else 's'}"
        text = (
            f"The rig is being commissioned from {windows}, between checks; `status` shows how far it is, `history` "
            "will say how it went."
        )
        return self._acknowledge("commission", "commissioning", text, window_id=paths[-1].stem)

    def _calibrate(self, latest: Path | None) -> Acknowledgement:
        """Finishes the open window now and solves it, if it has enough pairs; else solves the latest window again."""
        selector = self._engine.selector
        lacking = self._pair.window.min_pairs - selector.statistics.selected
        if lacking <= 0 and (closed := selector.finish()) is not None:
            self._actions.append(closed)
            text = f"The window of {closed.pairs} pair{'' if closed.pairs == 1 else 's'} is being solved."
            return self._acknowledge("calibrate", "window_finished", text, window_id=closed.window_id)
        if latest is not None and latest.exists():
            self._actions.append(SubmitSolve(WindowSubject(latest.stem), latest))
            text = f"The latest window is being solved again; {lacking} more pairs are needed for a new one."
            return self._acknowledge("calibrate", "window_again", text, window_id=latest.stem)
        return self._acknowledge("calibrate", "too_few_pairs", f"{lacking} more pairs needed.", accepted=False)

    def _acknowledge(
        self, name: str, code: str, text: str, *, accepted: bool = True, window_id: str | None = None
    ) -> Acknowledgement:
        return Acknowledgement(
            vehicle=self._vehicle,
            pair=self._pair.name,
            command=name,
            accepted=accepted,
            code=code,
            text=text,
            window_id=window_id,
        )


def _is_named(candidate: Candidate, name: str) -> bool:
    """As `rollback` names what was served: by the id of a window, or by the beginning of a sha256."""
    by_hash = len(name) >= MIN_HASH and str(candidate.sha256).startswith(name)
    return name == candidate.window_id or by_hash
