"""The thread that takes the samples of a vehicle, on one page: sample -> frame, once -> every pair that it is of, and
of each the pair whose turn it is to the chooser.

One thread for all: what it does holds the interpreter nearly all the while, so that more of them would only pass the
same second around; frames are handed on without a lock; and the order in which samples came is the order for every
pair. Nothing here waits: not for the disk, not for the worker, not for another pair.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol

from coec.adapters.system.threads import ServiceThread
from coec.adapters.zenoh.inputs import Sample
from coec.config import KnownStreamConfig, LimitsConfig, PairConfig
from coec.runtime.ingest.decoder import Frame
from coec.runtime.ingest.frame_budget import FrameBudget
from coec.runtime.ingest.inbox import Arrivals, Call, Inbox, Parcel
from coec.runtime.ingest.pair_buffer import WaitingFrames
from coec.runtime.ingest.sensor import SensorStream, read_alike

ALL_FRAMES = 1.5
"""Bytes of all frames that a vehicle may have in memory, in those that may be held: the others wait for their partner,
the disk or the worker, 25 pairs of 2.5 MB."""

TIGHT = 1.3
"""The same, above which pairs wait for no answer any more: better looked at too early than that no frame is let in.
What is left is half a second of eight cameras and three LiDARs; below it, 75 MB of one pair's checks are no matter."""

TICK_S = 0.1
"""Between two looks at the clocks while samples come; whoever reads the reports looks once a second."""

IDLE_S = 0.25
"""Longest wait for a sample: how soon silence is noticed."""


class Takes(Protocol):
    """A pair, as far as it takes part, see `pair_stream`; or two LiDARs."""

    @property
    def sensors(self) -> Mapping[str, SensorStream]:
        """Its streams, by the names that they have here."""

    def taker(self, name: str) -> Callable[[Frame], None]:
        """Who takes the frames of one of its streams."""

    def may_choose(self) -> bool:
        """Whether a pair has come that may be looked at now."""

    def choose_next(self) -> bool:
        """Look at the pair whose turn it is, if it may be looked at; whether one was."""

    def tick(self, *, waiting: bool) -> None:
        """Time has passed; samples of its streams are waiting, or none."""


class Intake:
    """Of one vehicle. `join` and `sensors_of` are for the main thread, `inbox` and `arrivals` for any.

    Attributes:
        waiting_frames: those of the pairs that have come and wait to be looked at.
    """

    def __init__(self, limits: LimitsConfig, kept_bytes: int = 0) -> None:
        """`kept_bytes`: of frames that are kept whatever becomes of them, beyond those of the limits."""
        self._limits = limits
        self._sensors: dict[tuple[str, str], SensorStream] = {}
        self._by_number: dict[str, SensorStream] = {}
        self._unheard: list[SensorStream] = []
        self.inbox = Inbox({}, limits.max_waiting_bytes, self._overrun)
        self.thread = ServiceThread("ingest", self._run)
        budget = self._budget = FrameBudget(kept_bytes + round(ALL_FRAMES * limits.max_held_bytes))
        tight = kept_bytes + round(TIGHT * limits.max_held_bytes)
        self.waiting_frames = WaitingFrames(limits.max_held_bytes, lambda: budget.bytes > tight)
        self._pairs: list[Takes] = []
        self._ticked_s = 0.0

    def request_stop(self) -> None:
        """End the thread."""
        self.thread.request_stop()
        self.inbox.wake()

    # --- on the main thread -----------------------------------------------------------------------------------------

    @property
    def sensors(self) -> tuple[SensorStream, ...]:
        """All of them."""
        return tuple(self._sensors.values())

    def sensors_of(self, pair: PairConfig) -> dict[str, SensorStream]:
        """The streams of a pair by kind: those that other pairs have, too, and new ones."""
        return {kind: self.sensor(kind, stream) for kind, stream in pair.streams.items()}

    def sensor(self, kind: str, stream: KnownStreamConfig) -> SensorStream:
        """A stream of this kind: the one that others have, too, or a new one."""
        alike = read_alike(kind, stream)
        if alike not in self._sensors:
            sensor = SensorStream(kind, f"{kind}-{len(self._sensors)}", stream, self._limits)
            self._by_number[sensor.number] = sensor
            self.inbox.open(sensor.number, sensor.depth)
            self._unheard.append(sensor)
            self._sensors[alike] = sensor
        return self._sensors[alike]

    def join(self, pair: Takes) -> None:
        """A pair takes part from now on."""
        self.inbox.call(lambda: self._join(pair))

    def listen(self, subscribe: Callable[[KnownStreamConfig, Callable[[Sample], None]], object]) -> None:
        """Subscribe to each stream that nobody has subscribed to yet."""
        unheard, self._unheard = self._unheard, []
        for sensor in unheard:
            subscribe(sensor.config, self.inbox.receiver(sensor.number))

    # --- on any -----------------------------------------------------------------------------------------------------

    def arrivals(self, sensors: Mapping[str, SensorStream]) -> dict[str, Arrivals]:
        """What came on these streams, by the names that they have here."""
        came = self.inbox.arrivals(time.monotonic())
        return {name: came[sensor.number] for name, sensor in sensors.items()}

    def _overrun(self, parcel: Parcel) -> None:
        self._by_number[parcel.stream].decoder.overrun(parcel.sample)

    # --- on the ingest thread ---------------------------------------------------------------------------------------

    def _join(self, pair: Takes) -> None:
        self._pairs.append(pair)
        for name, sensor in pair.sensors.items():
            sensor.takers = (*sensor.takers, pair.taker(name))

    def turn(self, idle_s: float) -> bool:
        """Take what came first, and look at a pair of each that has one; whether anything came within `idle_s`."""
        in_turn = any(pair.may_choose() for pair in self._pairs)
        item = self.inbox.take(0.0 if in_turn else idle_s)
        if isinstance(item, Call):
            item.run()
        elif item is not None:
            self._by_number[item.stream].take(item.sample, self._budget)
        chosen = [pair.choose_next() for pair in self._pairs]
        if time.monotonic() - self._ticked_s >= TICK_S:
            self._tick()
        return item is not None or any(chosen)

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            self.turn(IDLE_S)

    def _tick(self) -> None:
        self._ticked_s = time.monotonic()
        waiting = self.inbox.waiting()
        for pair in self._pairs:
            pair.tick(waiting=any(sensor.number in waiting for sensor in pair.sensors.values()))
