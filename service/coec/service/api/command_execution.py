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
from typing import Any

from coec.errors import CoecError, NotFoundError
from coec.schemas.commands import CANDIDATE, COMMAND_NAMES, REASON, Acknowledgement
from coec.schemas.keys import RIG
from coec.service.api.rig_answers import RigAnswers
from coec.service.engine.commands import EXPIRED, PairCommand
from coec.service.ingest.inbox import STARTED, BusyError, Inbox
from coec.service.records.pair_store import PairStore
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


class _CountedCommands:
    """What all commands of one pair have in common. For any thread."""

    def __init__(self, pair: str, vehicle: str) -> None:
        self._pair = pair
        self._vehicle = vehicle
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def counted(self) -> dict[str, int]:
        """Number of commands since the start, by name and outcome: accepted, refused, or not allowed."""
        with self._lock:
            return dict(self._counts)

    def note_refused(self, name: str, sender: str, why: CoecError) -> None:
        """Counts a command that its sender may not give. Only the first and then every 2^n-th is logged, so that
        senders without rights cannot fill the disk."""
        known = name if name in COMMAND_NAMES else "unknown"
        count = self._count(f"{known}_not_allowed")
        if count & (count - 1) == 0:
            fields = {"pair": self._pair, "command": known, "sender": sender, "code": why.reply_code}
            _log.warning(f"a command was denied: {why}", extra={"fields": {**fields, "count": count}})

    def _count(self, outcome: str) -> int:
        with self._lock:
            self._counts[outcome] += 1
            return self._counts[outcome]

    def _refuse(self, name: str, code: str, text: str) -> Acknowledgement:
        return Acknowledgement(
            vehicle=self._vehicle, pair=self._pair, command=name, accepted=False, code=code, text=text
        )


class PendingPairCommands(_CountedCommands):
    """The commands of a pair without a nominal calibration: every command is understood, and refused with what is
    missing."""

    def __init__(self, pair: str, vehicle: str, missing: Callable[[], CoecError]) -> None:
        super().__init__(pair, vehicle)
        self._missing = missing

    def reserve_for(self, proven: Iterable[str]) -> None:
        """Does nothing: there is no rate limit here."""

    def carry_out(self, name: str, arguments: dict[str, Any], sender: str, deadline_s: float = 0.0) -> Acknowledgement:
        """Refuses the command, and says why."""
        del arguments, sender, deadline_s
        self._count(f"{name}_refused")
        missing = self._missing()
        return self._refuse(name, missing.reply_code, str(missing))


class Commands(_CountedCommands):
    """The commands of one pair. For any thread."""

    def __init__(self, pair: str, vehicle: str, store: PairStore, inbox: Inbox) -> None:
        super().__init__(pair, vehicle)
        self._store = store
        self._inbox = inbox
        self._rate = RateLimit()

    def reserve_for(self, proven: Iterable[str]) -> None:
        """Reserves a rate for each sender who can prove his name, so that others cannot use it up. The names are those
        of `proven_sender`."""
        self._rate.reserve_for(proven)

    def carry_out(
        self, name: str, arguments: dict[str, Any], sender: str, deadline_s: float = math.inf
    ) -> Acknowledgement:
        """Carries out a command of `COMMAND_NAMES`, or says why not. A command that is not begun by the deadline
        (steady clock), at which its sender gives up, is not carried out."""
        command = PairCommand(
            name,
            deadline_s,
            sender,
            arguments.get(REASON.name) or None,
            arguments.get(CANDIDATE.name),
            arguments.get("to"),
            bool(arguments.get("release", False)),
        )
        within_s = min(TIMEOUT_S, max(deadline_s - time.monotonic(), 0.0))
        wait_s = self._rate.take(sender)
        try:
            if wait_s > 0.0:
                text = f"You give commands faster than {PER_S:g} per second; nothing was done. Wait {wait_s:.1f} s."
                acknowledged = self._refuse(name, "too_many", text)
            else:
                acknowledged = self._inbox.request(self._pair, command, within_s)
        except BusyError as error:
            late = time.monotonic() >= deadline_s and str(error) != STARTED
            code, text = ("expired", EXPIRED) if late else (error.reply_code, str(error))
            fields = {"pair": self._pair, "command": name, "sender": sender, "code": code}
            _log.warning(f"a command was not executed in time: {text}", extra={"fields": fields})
            acknowledged = self._refuse(name, code, text)
        if acknowledged.accepted:
            acknowledged = acknowledged.model_copy(update={"durable": self._store.is_on_disk()})
        self._count(f"{name}_{'accepted' if acknowledged.accepted else 'refused'}")
        return acknowledged


PairCommands = Commands | PendingPairCommands


class RigCommands:
    """The rig commands of one vehicle. `pairs` may gain pairs while commands come."""

    def __init__(self, vehicle: str, pairs: Mapping[str, PairCommands], rig: RigAnswers) -> None:
        """The reply of `rig` names the pairs of each sensor."""
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
        sensors = {one.name: one.pairs for one in self._rig.reply.sensors}
        if sensor not in sensors:
            raise NotFoundError(f"no such sensor; the rig has {', '.join(sensors)}")
        return tuple(pair for pair in sensors[sensor] if pair in self._pairs)
