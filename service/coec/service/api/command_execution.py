"""Commands of people. Each is carried out completely, by the thread that owns what it changes, or not at all. Either
outcome is acknowledged, logged and written into the history. Commands that exceed their sender's rate are only
answered. A sensor has no extrinsic of its own: what a command holds, puts back or accepts is what the sensor's
pairs serve. So a command for a sensor, or for the whole rig, is given to each of its pairs in turn. Each sender has
a bucket of tokens that is filled at a constant rate. A sender whose name is authenticated has a bucket that nobody
else draws from. All other senders are known only by the attachments of their queries, which anyone may write. So
the number of their buckets is bounded, and those without one share a common bucket. A sender who invents a new name
for each command ends up in the common one.
"""

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from coec.calibration import state as lifecycle
from coec.calibration.types import Rig
from coec.config import PairConfig
from coec.errors import CoecError, NotFoundError
from coec.io.disk_writer import PATIENCE_S
from coec.io.serialise import estimate_of, matrix_of
from coec.schemas.commands import CANDIDATE, COMMAND_NAMES, REASON
from coec.schemas.keys import RIG
from coec.schemas.replies import Acknowledgement, Candidate
from coec.schemas.rig_state import RigReply
from coec.service.api.pair_answers import PendingPairCommands
from coec.service.api.reply_builders import candidate_of
from coec.service.engine.frame_selector import FrameSelector
from coec.service.engine.job_client import JobClient
from coec.service.engine.pair import CalibrationManager
from coec.service.engine.pair_stream import PairStream
from coec.service.recording.recorder import Recorder
from coec.service.recording.window_store import WindowStore
from coec.service.records.pair_store import MIN_HASH, PairStore
from coec.service.task_queue import BusyError, TaskQueue
from coec.service.timing import TokenBucket

BURST = 20
"""How many commands may come at once: more than a person gives in a row, or a script that uses every command."""

PER_S = 1.0
"""Commands per second after that. No command makes sense more often, and each one is written down, with two fsyncs, by
the same thread that takes the answers to checks."""

SENDERS = 64
"""How many senders have their own bucket: some 10 kB."""


class RateLimit:
    """The rate limit of one pair. Safe to use from several threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a clock in seconds."""
        self._clock = clock
        self._lock = threading.Lock()
        self._reserved: dict[str, TokenBucket] = {}
        self._buckets: dict[str, TokenBucket] = {}
        self._others = TokenBucket(BURST, clock())

    def reserve_for(self, proven: Iterable[str]) -> None:
        """Gives these proven senders, and no others, buckets of their own for good. A sender who had one keeps its
        content."""
        with self._lock:
            before, now_s = self._reserved, self._clock()
            self._reserved = {sender: before.get(sender, TokenBucket(BURST, now_s)) for sender in proven}

    def take(self, sender: str) -> float:
        """0 if `sender` may give a command now, which is then counted; else how many seconds he has to wait."""
        with self._lock:
            now_s = self._clock()
            bucket = self._bucket_of(sender, now_s)
            if bucket.fill(now_s, PER_S) < 1.0:
                return (1.0 - bucket.level) / PER_S
            bucket.level -= 1.0
            return 0.0

    def _bucket_of(self, sender: str, now_s: float) -> TokenBucket:
        if sender in self._reserved:
            return self._reserved[sender]
        if sender not in self._buckets and len(self._buckets) >= SENDERS:
            # A sender whose bucket is full again is treated like a new one, so his bucket can go.
            self._buckets = {name: held for name, held in self._buckets.items() if held.fill(now_s, PER_S) < BURST}
        if sender not in self._buckets:
            if len(self._buckets) >= SENDERS:
                return self._others
            self._buckets[sender] = TokenBucket(BURST, now_s)
        return self._buckets[sender]


_log = logging.getLogger(__name__)

TIMEOUT_S = 4.0
"""Time to begin a command, and again to end it, s: together below the 10 s after which clients give up."""

EXPIRED = "The command waited for longer than its sender does; nothing was done. Send it again."

COMMISSIONING_WINDOWS = 8
"""How many windows, the newest, a rig is commissioned from: 200 pairs."""


class Commands:
    """The commands of one pair. For any thread."""

    def __init__(
        self,
        pair: PairConfig,
        vehicle: str,
        rig: Rig,
        manager: CalibrationManager,
        mailbox: TaskQueue,
        store: PairStore,
        stream: PairStream,
        selector: FrameSelector,
        recorder: Recorder,
        folder: WindowStore,
        job_client: JobClient,
    ) -> None:
        self._pair = pair
        self._vehicle = vehicle
        self._rig = rig
        self._rules = lifecycle.PairRules(pair.policy, pair.tracker, pair.monitor)
        self._manager = manager
        self._mailbox = mailbox
        self._store = store
        self._stream = stream
        self._selector = selector
        self._recorder = recorder
        self._folder = folder
        self._job_client = job_client
        self._rate = RateLimit()
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def reconfigure(self, pair: PairConfig) -> None:
        """Carries out commands by these settings from now on."""
        self._pair, self._rules = pair, lifecycle.PairRules(pair.policy, pair.tracker, pair.monitor)

    def reserve_for(self, proven: Iterable[str]) -> None:
        """Reserves a rate for each sender who can prove his name, so that others cannot use it up. The names are those
        of `payloads.proven_sender`."""
        self._rate.reserve_for(proven)

    @property
    def counts(self) -> dict[str, int]:
        """Number of commands since the start, by name and outcome: accepted, refused, or not allowed."""
        with self._lock:
            return dict(self._counts)

    def carry_out(
        self, name: str, arguments: dict[str, Any], sender: str, deadline_s: float = math.inf
    ) -> Acknowledgement:
        """Carries out a command of `payloads.NAMES`, or says why not. A command that is not begun by the deadline
        (steady clock), at which its sender gives up, is not carried out."""
        reason = arguments.get(REASON.name) or None
        decided: dict[str, Callable[[], Acknowledgement]] = {
            "apply": partial(self._apply, arguments.get(CANDIDATE.name)),
            "rollback": partial(self._roll_back, arguments.get("to")),
            "reset": self._reset,
            "commission": self._commission,
            "hold": partial(self._hold, sender, reason, release=bool(arguments.get("release", False))),
        }
        started = threading.Event()

        def in_time(command: Callable[[], Acknowledgement]) -> Acknowledgement:
            if time.monotonic() > deadline_s:
                raise BusyError(EXPIRED)
            started.set()
            return command()

        within_s = min(TIMEOUT_S, max(deadline_s - time.monotonic(), 0.0))
        wait_s = self._rate.take(sender)
        try:
            if wait_s > 0.0:
                text = f"You give commands faster than {PER_S:g} per second; nothing was done. Wait {wait_s:.1f} s."
                acknowledged = self._acknowledge(name, "too_many", text, accepted=False)
            elif name == "calibrate":
                acknowledged = self._noted(
                    self._stream.call_and_wait(partial(in_time, self._calibrate), within_s), sender, reason
                )
            else:
                decide = partial(self._decide, name, decided[name], sender, reason)
                acknowledged = self._with_durability(self._mailbox.call_and_wait(partial(in_time, decide), within_s))
        except BusyError as error:
            late = time.monotonic() >= deadline_s and not started.is_set()
            code, text = ("expired", EXPIRED) if late else (error.reply_code, str(error))
            fields = {"pair": self._pair.name, "command": name, "sender": sender, "code": code}
            _log.warning(f"a command was not executed in time: {text}", extra={"fields": fields})
            acknowledged = self._acknowledge(name, code, text, accepted=False)
        with self._lock:
            self._counts[f"{name}_{'accepted' if acknowledged.accepted else 'refused'}"] += 1
        return acknowledged

    def note_refused(self, name: str, sender: str, why: CoecError) -> None:
        """Counts a command that its sender may not give. Only the first and then every 2^n-th is logged, so that
        senders without rights cannot fill the disk."""
        known = name if name in COMMAND_NAMES else "unknown"
        with self._lock:
            self._counts[f"{known}_not_allowed"] += 1
            count = self._counts[f"{known}_not_allowed"]
        if count & (count - 1) == 0:
            fields = {"pair": self._pair.name, "command": known, "sender": sender, "code": why.reply_code}
            _log.warning(f"a command was denied: {why}", extra={"fields": {**fields, "count": count}})

    def _noted(self, done: Acknowledgement, sender: str, reason: str | None) -> Acknowledgement:
        """Has a command that was carried out written into the history, and waits a limited time for that."""
        noted = threading.Event()

        def note() -> None:
            self._write_down(done, sender, reason)
            noted.set()

        self._mailbox.post(note)
        return self._with_durability(done, noted=noted.wait(PATIENCE_S))

    def _with_durability(self, done: Acknowledgement, *, noted: bool = True) -> Acknowledgement:
        if not done.accepted:
            return done
        return done.model_copy(update={"durable": noted and self._store.is_on_disk()})

    # --- on the thread that decides ---------------------------------------------------------------------------------

    def _decide(
        self, name: str, command: Callable[[], Acknowledgement], sender: str, reason: str | None
    ) -> Acknowledgement:
        try:
            acknowledged = command()
        except lifecycle.CommandRefusedError as error:
            acknowledged = self._acknowledge(name, error.code, str(error), accepted=False)
        except NotFoundError as error:
            acknowledged = self._acknowledge(name, error.reply_code, str(error), accepted=False)
        self._write_down(acknowledged, sender, reason)
        return acknowledged

    def _write_down(self, done: Acknowledgement, sender: str, reason: str | None) -> None:
        fields = {"pair": self._pair.name, "command": done.command, "sender": sender, "reason": reason}
        _log.info("command received", extra={"fields": {**fields, "accepted": done.accepted, "code": done.code}})
        self._store.note_command(done.command, done.code, done.text, sender, accepted=done.accepted, reason=reason)
        self._store.save()
        self._manager.publish()

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
        hold = lifecycle.ExtrinsicHold(time.time_ns(), sender, reason or "")
        self._store.update(partial(lifecycle.held, hold=hold), None, completed=False)
        return self._acknowledge("hold", "held", "The extrinsic stays as it is until it is released.")

    def _replaced(self, name: str, code: str, text: str, window_id: str | None = None) -> Acknowledgement:
        self._manager.replaced()
        return self._acknowledge(name, code, text, window_id=window_id)

    def _commission(self) -> Acknowledgement:
        """Has the worker learn the baseline from the windows that agree with what is served. A pair has one
        commissioning at a time; those of several pairs are done one after the other."""
        reached = self._job_client.commissioning
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
        done = partial(self._manager.commissioned, tuple(path.stem for path in paths))
        self._job_client.commission(pose, paths, done)
        windows = f"{len(paths)} window{'' if len(paths) == 1 else 's'}"
        text = (
            f"The rig is being commissioned from {windows}, between checks; `status` shows how far it is, `history` "
            "will say how it went."
        )
        return self._acknowledge("commission", "commissioning", text, window_id=paths[-1].stem)

    # --- on the stream's thread -------------------------------------------------------------------------------------

    def _calibrate(self) -> Acknowledgement:
        """Finishes the open window now and solves it, if it has enough pairs; else solves the latest window again."""
        lacking = self._pair.window.min_pairs - self._selector.statistics.selected
        if lacking <= 0 and (closed := self._selector.finish()) is not None:
            text = f"The window of {closed.pairs} pair{'' if closed.pairs == 1 else 's'} is being solved."
            return self._acknowledge("calibrate", "window_finished", text, window_id=closed.window_id)
        latest = self._recorder.latest
        if latest is not None and latest.exists():
            self._job_client.solve(latest.stem, latest, True)
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


PairCommands = Commands | PendingPairCommands


class RigCommands:
    """The rig commands of one vehicle. `pairs` may gain pairs while commands come."""

    def __init__(self, vehicle: str, pairs: Mapping[str, PairCommands], rig: Callable[[], RigReply]) -> None:
        """`rig()` gives the reply that names the pairs of each sensor."""
        self._vehicle = vehicle
        self._pairs = pairs
        self._rig = rig

    def reserve_for(self, proven: Iterable[str]) -> None:
        """Does nothing: every pair reserves for itself."""

    def carry_out(
        self, name: str, arguments: dict[str, Any], sender: str, deadline_s: float = math.inf
    ) -> Acknowledgement:
        """Gives a command to every pair of `arguments["sensor"]`, or of the vehicle if no sensor is named.

        Raises:
            NotFoundError: there is no such sensor.
        """
        pair_arguments = dict(arguments)
        pairs = self._pairs_of(pair_arguments.pop("sensor", None))
        done = []
        for pair in pairs:
            if time.monotonic() > deadline_s:
                done.append(Acknowledgement(
                    vehicle=self._vehicle, pair=pair, command=name, accepted=False, code="expired", text=EXPIRED
                ))  # fmt: skip
            else:
                done.append(self._pairs[pair].carry_out(name, dict(pair_arguments), sender, deadline_s))
        refused = [one for one in done if not one.accepted]
        code = refused[0].code if refused else done[0].code
        durable = [one.durable for one in done if one.durable is not None]
        return Acknowledgement(
            vehicle=self._vehicle,
            pair=RIG,
            command=name,
            accepted=not refused,
            code=code if len(refused) in (0, len(done)) else "in_part",
            text=" ".join(f"{one.pair}: {one.text}" for one in done),
            durable=all(durable) if durable else None,
        )

    def note_refused(self, name: str, sender: str, why: CoecError) -> None:
        """Counts the refusal for every pair, because the command was meant for all of them."""
        for commands in self._pairs.values():
            commands.note_refused(name, sender, why)

    def _pairs_of(self, sensor: str | None) -> tuple[str, ...]:
        if sensor is None:
            return tuple(self._pairs)
        sensors = {one.name: one.pairs for one in self._rig().sensors}
        if sensor not in sensors:
            raise NotFoundError(f"no such sensor; the rig has {', '.join(sensors)}")
        return tuple(pair for pair in sensors[sensor] if pair in self._pairs)
