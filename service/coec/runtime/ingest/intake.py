"""The thread that takes the samples of a vehicle, on one page. It decodes each sample once to a frame and hands the
frame to every camera-LiDAR pair that uses it. For each of these it gives the next pair of frames to the chooser.

There is one thread for all, for three reasons. Its work holds the interpreter nearly all the time, so that more threads
would only share the same second. Frames are handed on without a lock. And every pair sees the samples in the order in
which they came. Nothing here waits: not for the disk, not for the worker, not for another pair.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol

from coec.adapters.system.threads import ServiceThread
from coec.adapters.zenoh.inputs import InputSample
from coec.config import KnownStreamConfig, LimitsConfig, PairConfig
from coec.runtime.ingest.decoder import Frame
from coec.runtime.ingest.frame_budget import FrameBudget
from coec.runtime.ingest.inbox import Arrivals, Call, Inbox, Parcel
from coec.runtime.ingest.pair_buffer import WaitingFrames
from coec.runtime.ingest.sensor import SensorStream, read_alike

ALL_FRAMES = 1.5
"""How many bytes of frames a vehicle may have in memory, as a multiple of `limits.max_held_bytes`. The additional half
is for frames that wait for their partner, the disk or the worker: 25 pairs of 2.5 MB."""

TIGHT = 1.3
"""The same ratio, above which pairs no longer wait for an answer: to look at pairs too early is better than to refuse
new frames. The rest up to `ALL_FRAMES` holds half a second of eight cameras and three LiDARs. Below it, 75 MB for the
checks of one pair do no harm."""

TICK_S = 0.1
"""Time between two looks at the clocks while samples come, s. The reports are read once a second."""

IDLE_S = 0.25
"""Longest wait for a sample, s: so soon silence is noticed."""


class FrameConsumer(Protocol):
    """What the intake needs of a camera-LiDAR pair (see `pair_stream`), or of an edge between two LiDARs."""

    @property
    def sensors(self) -> Mapping[str, SensorStream]:
        """The streams of the pair, by the names that the pair gives them."""

    def taker(self, name: str) -> Callable[[Frame], None]:
        """The function that takes the frames of one of its streams."""

    def may_choose(self) -> bool:
        """Whether a pair of frames has come that may be looked at now."""

    def choose_next(self) -> bool:
        """Looks at the next pair of frames if that may be looked at; returns whether it did."""

    def tick(self, *, waiting: bool) -> None:
        """Time has passed; `waiting`: samples of its streams are in the inbox."""


class Intake:
    """The intake of one vehicle. `join` and `sensors_of` are for the main thread, `inbox` and `arrivals` for any.

    Attributes:
        waiting_frames: frames of the pairs that have come and wait to be looked at.
    """

    def __init__(self, limits: LimitsConfig, reserved_bytes: int = 0) -> None:
        """`kept_bytes`: memory for frames that are kept in any case (for snippets), in addition to the limits."""
        self._limits = limits
        self._sensors: dict[tuple[str, str], SensorStream] = {}
        self._by_number: dict[str, SensorStream] = {}
        self._unsubscribed: list[SensorStream] = []
        self.inbox = Inbox({}, limits.max_waiting_bytes, self._overrun)
        self.thread = ServiceThread("ingest", self._run)
        budget = self._budget = FrameBudget(reserved_bytes + round(ALL_FRAMES * limits.max_held_bytes))
        tight = reserved_bytes + round(TIGHT * limits.max_held_bytes)
        self.waiting_frames = WaitingFrames(limits.max_held_bytes, lambda: budget.bytes > tight)
        self._pairs: list[FrameConsumer] = []
        self._ticked_s = 0.0

    def request_stop(self) -> None:
        """End the thread."""
        self.thread.request_stop()
        self.inbox.wake()

    # --- on the main thread -----------------------------------------------------------------------------------------

    @property
    def sensors(self) -> tuple[SensorStream, ...]:
        """All streams."""
        return tuple(self._sensors.values())

    def sensors_of(self, pair: PairConfig) -> dict[str, SensorStream]:
        """The streams of a pair by kind: shared with other pairs where they read the same, else new."""
        return {kind: self.sensor(kind, stream) for kind, stream in pair.streams.items()}

    def sensor(self, kind: str, stream: KnownStreamConfig) -> SensorStream:
        """A stream of this kind: an existing one that reads the same, else a new one."""
        alike = read_alike(kind, stream)
        if alike not in self._sensors:
            sensor = SensorStream(kind, f"{kind}-{len(self._sensors)}", stream, self._limits)
            self._by_number[sensor.number] = sensor
            self.inbox.open(sensor.number, sensor.depth)
            self._unsubscribed.append(sensor)
            self._sensors[alike] = sensor
        return self._sensors[alike]

    def join(self, pair: FrameConsumer) -> None:
        """A pair takes part from now on."""
        self.inbox.call(lambda: self._join(pair))

    def listen(self, subscribe: Callable[[KnownStreamConfig, Callable[[InputSample], None]], object]) -> None:
        """Subscribe to each stream that nobody has subscribed to yet."""
        unsubscribed, self._unsubscribed = self._unsubscribed, []
        for sensor in unsubscribed:
            subscribe(sensor.config, self.inbox.receiver(sensor.number))

    # --- on any -----------------------------------------------------------------------------------------------------

    def arrivals(self, sensors: Mapping[str, SensorStream]) -> dict[str, Arrivals]:
        """What came on these streams, by the names that the caller gives them."""
        arrivals = self.inbox.arrivals(time.monotonic())
        return {name: arrivals[sensor.number] for name, sensor in sensors.items()}

    def _overrun(self, parcel: Parcel) -> None:
        self._by_number[parcel.stream].decoder.overrun(parcel.sample)

    # --- on the ingest thread ---------------------------------------------------------------------------------------

    def _join(self, pair: FrameConsumer) -> None:
        self._pairs.append(pair)
        for name, sensor in pair.sensors.items():
            sensor.takers = (*sensor.takers, pair.taker(name))

    def turn(self, idle_s: float) -> bool:
        """Takes the oldest sample, then looks at one pair of frames for each camera-LiDAR pair that has one. Returns
        whether there was any work within `idle_s`."""
        in_turn = any(pair.may_choose() for pair in self._pairs)
        item = self.inbox.take(0.0 if in_turn else idle_s)
        if isinstance(item, Call):
            item.run()
        elif item is not None:
            self._by_number[item.stream].take(item.sample, self._budget)
        processed = [pair.choose_next() for pair in self._pairs]
        if time.monotonic() - self._ticked_s >= TICK_S:
            self._tick()
        return item is not None or any(processed)

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            self.turn(IDLE_S)

    def _tick(self) -> None:
        self._ticked_s = time.monotonic()
        waiting = self.inbox.waiting()
        for sensor in self.sensors:
            sensor.log.tick()
        for pair in self._pairs:
            pair.tick(waiting=any(sensor.number in waiting for sensor in pair.sensors.values()))
