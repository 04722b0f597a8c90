"""The engine of one vehicle: takes samples and events, one after the other, and has all pairs, the registrations of
LiDARs and the rig go on. One thread runs it in the service; tests and replays run it without any.

A turn is: take the oldest event or sample; hand the event to its receiver, or decode the sample and hand the frame to
every pair that uses the sensor; let each pair evaluate its next frame pair; let the rig take what was reported. Nothing
here waits: not for the disk, not for the worker, not for another pair. So every pair sees the samples in the order in
which they came, frames are handed on without a lock, and what a turn does depends on the samples and events alone.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from coec.config import KnownStreamConfig, LimitsConfig, PairConfig
from coec.io.system import ServiceThread
from coec.io.zenoh.bus import InputSample
from coec.service.cpu_budget import Budget
from coec.service.engine.messages import JobDone, JobSubject
from coec.service.engine.rig import RigEstimator, RigSnapshot
from coec.service.ingest.decoder import SensorStream, Taker, read_alike
from coec.service.ingest.inbox import Arrivals, Inbox, Parcel, Posted
from coec.service.ingest.pair_stream import FrameBudget, WaitingFrames
from coec.service.timing import Clock
from coec.service.worker.worker_jobs import JobOutcome

ALL_FRAMES = 1.5
"""How many bytes of frames a vehicle may have in memory, as a multiple of `limits.max_held_bytes`. The additional half
is for frames that wait for their partner, the disk or the worker: 25 pairs of 2.5 MB."""

TIGHT = 1.3
"""The same ratio, above which frame pairs no longer wait for a result: to evaluate them too early is better than to
refuse new frames. The rest up to `ALL_FRAMES` holds half a second of eight cameras and three LiDARs. Below it, 75 MB
for the checks of one pair do no harm."""

TICK_S = 0.1
"""Time between two ticks of the receivers, s. The statistics are read once a second."""

RIG_TICK_S = 1.0

IDLE_S = 0.25
"""Longest wait for a sample, s: so soon silence is noticed."""


class Receiver(Protocol):
    """A camera-LiDAR pair (`camera_lidar_pair`), or the registrations of two LiDARs (`lidar_pairs`)."""

    @property
    def name(self) -> str:
        """By which events are addressed."""

    @property
    def sensors(self) -> Mapping[str, SensorStream]:
        """The streams, by the names that the receiver gives them."""

    @property
    def unanswered(self) -> int:
        """Number of requests to the worker that have no result."""

    def taker(self, name: str) -> Taker:
        """The function that takes the frames of one of its streams."""

    def on_event(self, event: Any) -> object:
        """Takes an event; returns the reply, if somebody waits for one."""

    def advance(self, now_s: float) -> bool:
        """Evaluates the next frames if nothing is missing before; returns whether it did. `now_s`: steady clock."""

    def tick(self, now_s: float, *, waiting: bool) -> None:
        """Time has passed; `waiting`: samples of its streams are in the inbox."""


class Vehicle:
    """The engine of one vehicle. `sensor`, `sensors_of`, `join` and `new_streams` are for the main thread,
    `post_outcome`, `inbox` and `arrivals` for any, `turn` and `finish` for `thread`, or for a caller without threads.

    Attributes:
        waiting_frames: frames of the pairs that have come and wait to be evaluated.
        is_busy: the last turn did something after which there may be more to do, so the next one waits for nothing.
    """

    def __init__(
        self,
        limits: LimitsConfig,
        budget: Budget,
        rig: RigEstimator,
        on_rig: Callable[[RigSnapshot], None],
        reserved_bytes: int = 0,
        clock: Clock | None = None,
    ) -> None:
        """`on_rig` is called with what is known of the rig whenever it has changed. `reserved_bytes`: memory for frames
        that are kept in any case (for snippets), in addition to the limits."""
        self.budget = budget
        self.rig = rig
        self.clock = clock or Clock()
        self.inbox = Inbox({}, limits.max_waiting_bytes, self._overrun)
        self.thread = ServiceThread("engine", self._run)
        self._limits = limits
        self._on_rig = on_rig
        self._sensors: dict[tuple[str, str], SensorStream] = {}
        self._by_number: dict[str, SensorStream] = {}
        self._unsubscribed: list[SensorStream] = []
        frames = self._frames = FrameBudget(reserved_bytes + round(ALL_FRAMES * limits.max_held_bytes))
        tight = reserved_bytes + round(TIGHT * limits.max_held_bytes)
        self.waiting_frames = WaitingFrames(limits.max_held_bytes, lambda: frames.bytes > tight)
        self._receivers: dict[str, Receiver] = {}
        self.is_busy = True
        self._ticked_s = self._rig_ticked_s = 0.0

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

    def join(self, receiver: Receiver) -> None:
        """A receiver takes part from now on."""
        self.inbox.post("", receiver)

    def new_streams(self) -> list[tuple[KnownStreamConfig, Callable[[InputSample], None]]]:
        """The streams that no earlier call has returned, each with the function that takes its samples."""
        unsubscribed, self._unsubscribed = self._unsubscribed, []
        return [(sensor.config, self.inbox.receiver(sensor.number)) for sensor in unsubscribed]

    # --- on any -----------------------------------------------------------------------------------------------------

    def post_outcome(self, receiver: str, subject: JobSubject, outcome: JobOutcome) -> None:
        """A job of the worker for a receiver has ended."""
        self.inbox.post(receiver, JobDone(subject, outcome))

    def arrivals(self, sensors: Mapping[str, SensorStream]) -> dict[str, Arrivals]:
        """What came on these streams, by the names that the caller gives them."""
        arrivals = self.inbox.arrivals(self.clock.monotonic_s())
        return {name: arrivals[sensor.number] for name, sensor in sensors.items()}

    def _overrun(self, parcel: Parcel) -> None:
        self._by_number[parcel.stream].decoder.overrun(parcel.sample)

    # --- on the thread of the engine --------------------------------------------------------------------------------

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            self.turn(IDLE_S)

    def turn(self, idle_s: float) -> bool:
        """Does one turn; waits up to `idle_s` if there is nothing to do. Returns whether there was."""
        item = self.inbox.take(0.0 if self.is_busy else idle_s)
        now_s = self.clock.monotonic_s()
        if isinstance(item, Parcel):
            sensor = self._by_number[item.stream]
            for frame in sensor.take(item.sample, now_s):
                if not self._frames.admit(frame):
                    sensor.losses.add(sensor.kind, "memory_full")
                    continue
                for taker in sensor.takers:
                    taker(frame, now_s)
        elif item is not None:
            self._deliver(item)
        self.is_busy = False
        for receiver in self._receivers.values():
            self.is_busy |= receiver.advance(now_s)
        while self.rig.has_news and self.rig.take_report(all_are_silent=self.rig.is_quiet and self.unanswered == 0):
            self.is_busy = True
            self._on_rig(self.rig.snapshot)
        if now_s - self._ticked_s >= TICK_S:
            self._tick(now_s)
        return item is not None or self.is_busy

    @property
    def unanswered(self) -> int:
        """Number of requests to the worker that have no result."""
        return sum(receiver.unanswered for receiver in self._receivers.values())

    def _deliver(self, posted: Posted) -> None:
        if not posted.receiver:
            self._admit(posted.event)
            return
        receiver = self._receivers[posted.receiver]
        if posted.reply is None:
            receiver.on_event(posted.event)
        elif posted.reply.begin():
            try:
                posted.reply.finish(receiver.on_event(posted.event))
            except Exception as error:
                posted.reply.fail(error)

    def _admit(self, receiver: Receiver) -> None:
        self._receivers[receiver.name] = receiver
        for name, sensor in receiver.sensors.items():
            sensor.takers = (*sensor.takers, receiver.taker(name))

    def _tick(self, now_s: float) -> None:
        self._ticked_s = now_s
        if now_s - self._rig_ticked_s >= RIG_TICK_S:
            self._rig_ticked_s = now_s
            self.rig.tick()
        waiting = self.inbox.waiting()
        for sensor in self.sensors:
            sensor.log.tick(now_s)
        for receiver in self._receivers.values():
            receiver.tick(now_s, waiting=any(sensor.number in waiting for sensor in receiver.sensors.values()))

    def finish(self) -> None:
        """Takes all events that were posted, and all reports to the rig; for the end of the service, after that of the
        thread. Samples that have not been decoded are left."""
        while (posted := self.inbox.take_posted()) is not None:
            self._deliver(posted)
        self.rig.finish()
        self._on_rig(self.rig.snapshot)
