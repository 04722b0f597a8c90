"""Listens to the streams for some seconds: which samples came, when, and the frames that they make.

The service is not disturbed: the doctor has a session of its own, and the service gets the same samples.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

import zenoh

from coec.adapters.system.logs import LossCounter
from coec.adapters.zenoh.bus import Bus
from coec.adapters.zenoh.inputs import Input, Sample
from coec.adapters.zenoh.ros_side import RosSide
from coec.config import Config, PairConfig
from coec.runtime.ingest.decoder import EGO, Decoder, Frame, StreamCounts
from coec.runtime.nominal.findings import info_topic_of, needs_transforms
from coec.schemas.ros_names import TF_STATIC

SAMPLES_WAITING = 8
"""Most samples of a stream that wait to be decoded; further ones are only counted."""

MOTIONS_WAITING = 512

SAMPLES_COUNTED = 200_000
"""Most samples of a stream whose arrival and size are noted: a minute at 3 kHz. A flood beyond that is not counted."""

POLL_S = 0.01

_SILENT = logging.Logger("doctor")
_SILENT.addHandler(logging.NullHandler())


@dataclass(slots=True)
class Heard:
    """What came on one stream.

    Attributes:
        place: its key or topic.
        expressions: key expressions that its samples match.
        arrivals_s: when (steady clock) each sample came.
        sizes: bytes of each.
        stamps: sensor time of each frame, and the wall clock when its sample came, ns, in the order of arrival.
        refused: samples that made no frame, by reason.
        latest: the last frame.
        counts: counts of the senders, at the end.
        elsewhere: number of samples that a client of the same router got.
    """

    place: str
    expressions: tuple[str, ...] = ()
    arrivals_s: list[float] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    stamps: list[tuple[int, int]] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    latest: Frame | None = None
    counts: StreamCounts | None = None
    elsewhere: int = 0

    def count(self, sample: Sample) -> None:
        """Counts a sample that is not decoded."""
        if len(self.arrivals_s) < SAMPLES_COUNTED:
            self.arrivals_s.append(time.monotonic())
            self.sizes.append(len(sample.payload))

    @property
    def rate_hz(self) -> float | None:
        """Samples per second; None with fewer than two samples."""
        if len(self.arrivals_s) < 2:
            return None
        spread_s = self.arrivals_s[-1] - self.arrivals_s[0]
        return (len(self.arrivals_s) - 1) / spread_s if spread_s > 0 else None


@dataclass(frozen=True, slots=True)
class Reception:
    """What came in the time.

    Attributes:
        pairs: by stream, for each complete pair of the configuration.
        awaited: by place, what pairs wait for whose configuration leaves something out. Nothing of it is decoded.
    """

    pairs: list[dict[str, Heard]]
    awaited: dict[str, Heard]


def listen(
    session: zenoh.Session,
    beside: zenoh.Session,
    ros: RosSide,
    config: Config,
    seconds: float,
    heard: Callable[[float], None],
) -> Reception:
    """What comes through a session as the service has it, and how much of it comes to the client `beside` it. `heard`
    is called now and then with the seconds that have passed."""
    ears = [_Ear(session, ros, pair, config) for pair in config.pairs]
    awaited, bus = _awaited(session, ros, config)
    every = [one for ear in ears for one in ear.heard.values()] + list(awaited.values())
    counters = [counter for one in every for counter in _count_elsewhere(beside, one)]
    begun_s = time.monotonic()
    try:
        while (passed_s := time.monotonic() - begun_s) < seconds:
            if sum(ear.take() for ear in ears) == 0:
                time.sleep(POLL_S)
            heard(passed_s)
    finally:
        for ear in ears:
            ear.close()
        bus.undeclare_inputs()
        for counter in counters:
            counter.undeclare()
    return Reception([ear.heard for ear in ears], awaited)


def _awaited(session: zenoh.Session, ros: RosSide, config: Config) -> tuple[dict[str, Heard], Bus]:
    """Listens, as the service does, for what the awaited pairs leave out."""
    bus, awaited = Bus(session), dict[str, Heard]()

    def listen_to(place: str, stream: Input, subscribe: Callable[[Input, Callable[[Sample], None]], object]) -> None:
        if place not in awaited:
            awaited[place] = Heard(place, stream.expressions)
            subscribe(stream, awaited[place].count)

    for pair in config.awaited:
        for stream in pair.streams.values():
            listen_to(stream.place, ros.input_of(stream), bus.subscribe)
        topic = info_topic_of(pair)
        if topic is not None:
            listen_to(topic, ros.input_of_info(topic), bus.subscribe_latched)
        if needs_transforms(pair):
            listen_to(TF_STATIC, ros.input_of_static_transforms(), bus.subscribe_latched)
    return awaited, bus


def _count_elsewhere(beside: zenoh.Session, heard: Heard) -> list[zenoh.Subscriber[None]]:
    def count(sample: zenoh.Sample) -> None:
        heard.elsewhere += sample.kind == zenoh.SampleKind.PUT

    receiver = zenoh.handlers.Callback(count, indirect=False)
    return [beside.declare_subscriber(expression, receiver) for expression in heard.expressions]


class _Ear:
    """Listens to the streams of one pair."""

    def __init__(self, session: zenoh.Session, ros: RosSide, pair: PairConfig, config: Config) -> None:
        inputs = {name: ros.input_of(stream) for name, stream in pair.streams.items()}
        self.heard = {name: Heard(stream.place, inputs[name].expressions) for name, stream in pair.streams.items()}
        self._waiting: dict[str, deque[tuple[int, Sample]]] = {
            name: deque(maxlen=MOTIONS_WAITING if name == EGO else SAMPLES_WAITING) for name in self.heard
        }
        self._losses = LossCounter(_SILENT, pair.name)
        self._decoders = {
            name: Decoder(name, stream, config.limits, self._losses) for name, stream in pair.streams.items()
        }
        self._subscribers = [
            self._subscribe(session, expression, stream.read, name)
            for name, stream in inputs.items()
            for expression in stream.expressions
        ]
        tokens = [stream.token for stream in inputs.values() if stream.token is not None]
        self._tokens = [session.liveliness().declare_token(token) for token in tokens]

    def close(self) -> None:
        """Stop listening, and decode what still waits."""
        for token in self._tokens:
            token.undeclare()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        while self.take():
            pass
        for name, heard in self.heard.items():
            heard.counts = self._decoders[name].counts()

    def take(self) -> bool:
        """Decode the next sample of each stream; returns whether there was one."""
        found = False
        for name, waiting in self._waiting.items():
            if not waiting:
                continue
            found = True
            wall_ns, sample = waiting.popleft()
            frame = self._decoders[name].frame(sample)
            heard = self.heard[name]
            if frame is not None:
                heard.latest = frame
                heard.stamps.append((frame.stamp_ns, wall_ns))
            heard.refused = Counter(
                {
                    reason: count
                    for (place, reason), count in self._losses.snapshot().items()
                    if place == name and reason != "sequence_gap"  # samples that are not decoded leave gaps, too
                }
            )
        return found

    def _subscribe(
        self, session: zenoh.Session, expression: str, read: Callable[[zenoh.Sample], Sample], name: str
    ) -> zenoh.Subscriber[None]:
        heard, waiting = self.heard[name], self._waiting[name]

        def receive(sample: zenoh.Sample) -> None:
            if sample.kind != zenoh.SampleKind.PUT or len(heard.arrivals_s) >= SAMPLES_COUNTED:
                return
            came = read(sample)
            heard.count(came)
            waiting.append((time.time_ns(), came))

        return session.declare_subscriber(expression, zenoh.handlers.Callback(receive, indirect=False))
