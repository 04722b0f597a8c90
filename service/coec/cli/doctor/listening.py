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
from coec.adapters.zenoh.inputs import Sample
from coec.adapters.zenoh.ros_side import RosSide
from coec.config import Config, PairConfig
from coec.runtime.ingest.decoder import EGO, Decoder, Frame, StreamCounts

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
        arrivals_s: when (steady clock) each sample came.
        sizes: bytes of each.
        stamps: sensor time of each frame, and the wall clock when its sample came, ns, in the order of arrival.
        refused: samples that made no frame, by reason.
        latest: the last frame.
        counts: counts of the senders, at the end.
    """

    place: str
    arrivals_s: list[float] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    stamps: list[tuple[int, int]] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    latest: Frame | None = None
    counts: StreamCounts | None = None

    @property
    def rate_hz(self) -> float | None:
        """Samples per second; None with fewer than two samples."""
        if len(self.arrivals_s) < 2:
            return None
        spread_s = self.arrivals_s[-1] - self.arrivals_s[0]
        return (len(self.arrivals_s) - 1) / spread_s if spread_s > 0 else None


def listen(
    session: zenoh.Session, ros: RosSide, config: Config, seconds: float, heard: Callable[[float], None]
) -> list[dict[str, Heard]]:
    """What comes on the streams of each pair; `heard` is called now and then with the seconds that have passed."""
    ears = [_Ear(session, ros, pair, config) for pair in config.pairs]
    begun_s = time.monotonic()
    try:
        while (passed_s := time.monotonic() - begun_s) < seconds:
            if sum(ear.take() for ear in ears) == 0:
                time.sleep(POLL_S)
            heard(passed_s)
    finally:
        for ear in ears:
            ear.close()
    return [ear.heard for ear in ears]


class _Ear:
    """Listens to the streams of one pair."""

    def __init__(self, session: zenoh.Session, ros: RosSide, pair: PairConfig, config: Config) -> None:
        inputs = {name: ros.input_of(stream) for name, stream in pair.streams.items()}
        self.heard = {name: Heard(stream.place) for name, stream in pair.streams.items()}
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
            heard.arrivals_s.append(time.monotonic())
            came = read(sample)
            heard.sizes.append(len(came.payload))
            waiting.append((time.time_ns(), came))

        return session.declare_subscriber(expression, zenoh.handlers.Callback(receive, indirect=False))
