"""The thread that takes the samples of a vehicle, with its bounded inbox and its streams. It decodes each sample once
to a frame and hands the frame to every camera-LiDAR pair that uses it. For each of these it gives the next pair of
frames to the frame selector. The inbox between the network's threads and this one is bounded in number for each stream
and in bytes for all streams together.

There is one thread for all, for three reasons. Its work holds the interpreter nearly all the time, so that more threads
would only share the same second. Frames are handed on without a lock. And every pair sees the samples in the order in
which they came. Nothing here waits: not for the disk, not for the worker, not for another pair.
"""

import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import KnownStreamConfig, LimitsConfig, PairConfig
from coec.io.logs import LossCounter
from coec.io.system import ServiceThread
from coec.io.zenoh.bus import InputSample
from coec.service.ingest.decoder import EGO, TWO_SENDERS, Decoder, Frame
from coec.service.ingest.frame_buffers import FrameBudget, WaitingFrames
from coec.service.timing import NS_PER_S, QUICK_S, Histogram


@dataclass(frozen=True, slots=True)
class Parcel:
    """One sample as it came. `order` counts arrivals over all streams of the inbox."""

    order: int
    stream: str
    sample: InputSample


@dataclass(frozen=True, slots=True)
class Call:
    """Work that another thread wants done on the ingest thread, between two samples."""

    run: Callable[[], None]


@dataclass(frozen=True, slots=True)
class Arrivals:
    """What came on a stream: how many samples wait, and how long ago the last one came (None before the first)."""

    waiting: int
    age_s: float | None


class _Waiting:
    """The samples of one stream, oldest first."""

    def __init__(self, depth: int) -> None:
        self.parcels: deque[Parcel] = deque()
        self.depth = depth
        self.bytes = 0

    def add(self, parcel: Parcel) -> None:
        self.parcels.append(parcel)
        self.bytes += len(parcel.sample.payload)

    def take(self) -> Parcel:
        parcel = self.parcels.popleft()
        self.bytes -= len(parcel.sample.payload)
        return parcel


class Inbox:
    """The streams of one reader. `put` takes microseconds and never blocks on the reader; one thread takes.

    Surplus samples are dropped. A stream with too many samples loses its oldest. If all streams together hold too many
    bytes, the stream that holds most loses its oldest, so that large messages on one stream push nothing out of
    another.
    """

    def __init__(self, depths: dict[str, int], max_bytes: int, on_overrun: Callable[[Parcel], None]) -> None:
        """
        Args:
            depths: by stream, how many samples may wait.
            max_bytes: limit for all waiting samples together. The latest sample is taken whatever its size.
            on_overrun: called with each sample that is dropped.
        """
        self._waiting = {stream: _Waiting(depth) for stream, depth in depths.items()}
        self._max_bytes = max_bytes
        self._received_s: dict[str, float] = {}
        self._calls: deque[Call] = deque()
        self._on_overrun = on_overrun
        self._order = itertools.count()
        self._condition = threading.Condition()

    def put(self, stream: str, sample: InputSample) -> None:
        """A sample came."""
        with self._condition:
            gone = self._make_room(stream, len(sample.payload))
            self._waiting[stream].add(Parcel(next(self._order), stream, sample))
            self._received_s[stream] = time.monotonic()
            self._condition.notify()
        for overrun in gone:
            self._on_overrun(overrun)

    def receiver(self, stream: str) -> Callable[[InputSample], None]:
        """`put` for one stream."""
        return partial(self.put, stream)

    def open(self, stream: str, depth: int) -> None:
        """Adds a stream, of which `depth` samples may wait."""
        with self._condition:
            self._waiting = {**self._waiting, stream: _Waiting(depth)}

    def call(self, run: Callable[[], None]) -> None:
        """Has the reader call `run`, before it takes the waiting samples."""
        with self._condition:
            self._calls.append(Call(run))
            self._condition.notify()

    def arrivals(self, monotonic_s: float) -> dict[str, Arrivals]:
        """What came, by stream; ages are counted at this time of the steady clock."""
        with self._condition:
            return {
                stream: Arrivals(
                    len(waiting.parcels), None if received_s is None else max(monotonic_s - received_s, 0.0)
                )
                for stream, waiting in self._waiting.items()
                for received_s in (self._received_s.get(stream),)
            }

    def waiting(self) -> set[str]:
        """The streams that have waiting samples."""
        with self._condition:
            return {stream for stream, waiting in self._waiting.items() if waiting.parcels}

    def wake(self) -> None:
        """Let a waiting `take` return."""
        with self._condition:
            self._condition.notify()

    def take(self, timeout_s: float) -> Parcel | Call | None:
        """The next call, else the oldest sample; None if nothing came within `timeout_s`, or after `wake`."""
        with self._condition:
            taken = self._pop()
            if taken is None:
                self._condition.wait(timeout_s)
                taken = self._pop()
            return taken

    def _make_room(self, stream: str, size: int) -> list[Parcel]:
        """Takes out the samples that have to make room for a new one of `size` bytes."""
        gone = []
        own = self._waiting[stream]
        if len(own.parcels) == own.depth:
            gone.append(own.take())
        while sum(waiting.bytes for waiting in self._waiting.values()) + size > self._max_bytes:
            # The new sample counts for its stream, so that a stream with large samples makes room for them itself.
            held = {name: waiting.bytes + size * (name == stream) for name, waiting in self._waiting.items()}
            full = [name for name, waiting in self._waiting.items() if waiting.parcels]
            if not full:
                break
            fullest = max(full, key=lambda name: held[name])
            gone.append(self._waiting[fullest].take())
        return gone

    def _pop(self) -> Parcel | Call | None:
        if self._calls:
            return self._calls.popleft()
        waiting = [waiting for waiting in self._waiting.values() if waiting.parcels]
        return min(waiting, key=lambda one: one.parcels[0].order).take() if waiting else None


_log = logging.getLogger(__name__)

LoggedFrame = CameraFrame | LidarFrame | EgoMotion

RATE_FRAMES = 30
"""The rate is measured over the first so many frames."""

SILENT_S = 5.0
"""A stream counts as silent after so long without a frame, s."""

QUIET_S = 60.0
"""Time between two lines about the silence of one stream, s: an unsteady network must not fill the log."""


class StreamLog:
    """Belongs to the intake's thread."""

    def __init__(self, kind: str, sensor: str, clock: Callable[[], float] = time.monotonic) -> None:
        """`kind`: `camera`, `lidar` or `ego`. `sensor`: its name for people. `clock`: a steady clock, s."""
        self._kind = kind
        self._fields = {"stream": kind, "sensor": sensor}
        self._clock = clock
        self._frames = 0
        self._first_ns = 0
        self._latest_s = 0.0
        self._reported_s = -QUIET_S
        self._silent_since_s: float | None = None

    def push(self, frame: LoggedFrame) -> None:
        """A frame was accepted."""
        self._latest_s = self._clock()
        self._frames += 1
        if self._frames == 1:
            self._first_ns = frame.stamp_ns
            _log.info(f"first {self._kind} frame: {_shape(frame)}", extra={"fields": self._fields})
        elif self._frames == RATE_FRAMES and frame.stamp_ns > self._first_ns:
            rate_hz = (RATE_FRAMES - 1) * NS_PER_S / (frame.stamp_ns - self._first_ns)
            _log.info(f"{self._kind} frames arrive at {rate_hz:.1f} Hz by their stamps", extra={"fields": self._fields})
        if self._silent_since_s is not None:
            silent_s = self._latest_s - self._silent_since_s
            self._silent_since_s = None
            _log.info(f"{self._kind} frames arrive again after {silent_s:.0f} s", extra={"fields": self._fields})

    def tick(self) -> None:
        """Time has passed."""
        now_s = self._clock()
        if not self._frames or self._silent_since_s is not None or now_s - self._latest_s < SILENT_S:
            return
        if now_s - self._reported_s >= QUIET_S:
            self._reported_s, self._silent_since_s = now_s, self._latest_s
            text = f"no {self._kind} frames for {now_s - self._latest_s:.0f} s: check the sensor and the network"
            _log.warning(text, extra={"fields": self._fields})


def _shape(frame: LoggedFrame) -> str:
    match frame:
        case CameraFrame():
            return f"{frame.image.width}×{frame.image.height}, frame {frame.frame_id!r}"
        case LidarFrame():
            return f"{len(frame.xyz_m)} points, frame {frame.frame_id!r}"
        case EgoMotion():
            return f"frame {frame.frame_id!r}"


FRAMES_WAITING = 16
"""Samples of a camera or a LiDAR that may wait for the ingest thread: 1.6 s at 10 Hz."""

MOTIONS_WAITING = 512
"""Ego-motion samples that may wait: 2.5 s at 200 Hz."""

READ_WITHOUT = frozenset({"name", "mask", "hardware_id", "info_topic", "sweep", "T_lidar_ego"})
"""Settings that do not change how the samples of a stream are read. Streams that differ only in these are one."""


def read_alike(kind: str, stream: KnownStreamConfig) -> tuple[str, str]:
    """A key that is equal for two streams if their samples give the same frames."""
    return kind, stream.model_dump_json(exclude=set(READ_WITHOUT))


class SensorStream:
    """One stream. `counts` and `losses` are for any thread, everything else is for the ingest thread.

    Attributes:
        kind: what the stream brings: camera frames, LiDAR sweeps or ego-motion.
        number: name of the stream in the inbox.
        log: its lines in the log.
        took: how long the decoding of each sample took.
        takers: functions that get each frame, in the order in which the frames came.
    """

    def __init__(self, kind: str, number: str, config: KnownStreamConfig, limits: LimitsConfig) -> None:
        self.kind = kind
        self.number = number
        self.config = config
        self.losses = LossCounter(_log, config.sensor, "sensor")
        self.decoder = Decoder(kind, config, limits, self.losses)
        self.log = StreamLog(kind, config.sensor)
        self.took = Histogram(QUICK_S)
        self.takers: tuple[Callable[[Frame], None], ...] = ()
        self._on_trial: list[Frame] = []

    @property
    def depth(self) -> int:
        """How many samples may wait."""
        return MOTIONS_WAITING if self.kind == EGO else FRAMES_WAITING

    def take(self, sample: InputSample, budget: FrameBudget) -> None:
        """Decodes a sample and hands the same frame to every taker. The first frames of a new sender are kept back
        until it has sent some in a row: if the sender before comes back, two are sending, and the frames of neither may
        be used."""
        started_s = time.monotonic()
        frame = self.decoder.frame(sample)
        self.took.add(time.monotonic() - started_s, self.kind)
        if self.decoder.contested:
            if self._on_trial:
                self.losses.add(self.kind, TWO_SENDERS, len(self._on_trial))
                self._on_trial.clear()
            return
        if frame is None:
            return
        self._on_trial.append(frame)
        if self.decoder.on_trial:
            return
        frames, self._on_trial = self._on_trial, []
        for each in frames:
            self.log.push(each)
            if not budget.admit(each):
                self.losses.add(self.kind, "memory_full")
                continue
            for taker in self.takers:
                taker(each)


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
