"""The frames of a running pair's sensors, for somebody who looks: the newest pair, and none while nobody looks."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable

import zenoh

from coec.adapters.system.logs import LossCounter
from coec.adapters.zenoh.inputs import Input, input_of
from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import FramePair
from coec.config import Config, PairConfig
from coec.runtime.ingest.decoder import CAMERA, EGO, LIDAR, Decoder
from coec.runtime.ingest.inbox import Inbox, Parcel

DEPTHS = {CAMERA: 4, LIDAR: 4, EGO: 512}
"""Samples that may wait; the oldest go. A pair needs its neighbours in time, and two seconds of ego-motion."""

PATIENCE_S = 5.0
"""After which a stream on which nothing came is worth a word."""

BUSY_S = 0.2
"""After which what was found is shown, however much more there is."""

_SILENT = logging.Logger("view")
_SILENT.addHandler(logging.NullHandler())


class Streams:
    """The sensors of one pair. They are subscribed to only while somebody looks, so nobody's looking costs the vehicle
    nothing; and who looks slowly loses frames here, not there."""

    def __init__(self, session: zenoh.Session, pair: PairConfig, config: Config) -> None:
        self._session = session
        self._pair = pair
        self._limits = config.limits
        self._losses = LossCounter(_SILENT, pair.name)
        self._inputs = {name: input_of(stream, config) for name, stream in pair.streams.items()}
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._begin()

    def _begin(self) -> None:
        self._decoders = {
            name: Decoder(name, stream, self._limits, self._losses) for name, stream in self._pair.streams.items()
        }
        self._pairer = Pairer(self._pair.pairing, expects_motion=self._pair.ego is not None)
        self._since_s = time.monotonic()
        self._inbox = Inbox(DEPTHS, self._limits.max_waiting_bytes, self._overrun)

    @property
    def not_shown(self) -> Counter[tuple[str, str]]:
        """Frames that came and were not shown, by stream and cause: refused, or without a partner since somebody looks.
        Gaps in their numbers say nothing here, where most frames are passed over."""
        counts = {cause: count for cause, count in self._losses.snapshot().items() if cause[1] != "sequence_gap"}
        for name, count in self._pairer.losses.items():
            stream, _, cause = name.partition("_")
            counts[stream, cause] = count
        return Counter(counts)

    @property
    def ages_s(self) -> dict[str, float | None]:
        """By stream, since a sample came; None: none did since somebody looks. Empty while nobody does."""
        if not self._subscribers:
            return {}
        arrivals = self._inbox.arrivals(time.monotonic())
        return {stream: arrivals[stream].age_s for stream in self._inputs}

    @property
    def mute(self) -> tuple[str, ...]:
        """Keys and topics on which nothing has come although somebody has looked for `PATIENCE_S`."""
        if time.monotonic() - self._since_s < PATIENCE_S:
            return ()
        return tuple(self._pair.streams[stream].place for stream, age_s in self.ages_s.items() if age_s is None)

    def listen(self, *, wanted: bool) -> None:
        """Subscribe, or no longer."""
        if wanted and not self._subscribers:
            self._begin()
            self._subscribers = [
                self._subscribe(name, key, source)
                for name, source in self._inputs.items()
                for key in source.expressions
            ]
        elif not wanted:
            self.close()

    def newest(self, wait_s: float) -> FramePair | None:
        """The newest pair of what has come; older ones are passed over. None: nothing came within `wait_s`, or no pair
        of it."""
        pair = None
        parcel = self._inbox.take(wait_s)
        end_s = time.monotonic() + BUSY_S
        while isinstance(parcel, Parcel):
            frame = self._decoders[parcel.stream].frame(parcel.sample)
            formed = [] if frame is None else self._pairer.push(frame)
            pair = formed[-1] if formed else pair
            parcel = self._inbox.take(0.0) if time.monotonic() < end_s else None
        return pair

    def refused(self, stream: str, cause: str) -> None:
        """Count what could not be shown, or be understood."""
        self._losses.add(stream, cause)

    def _overrun(self, parcel: Parcel) -> None:
        self._decoders[parcel.stream].overrun(parcel.sample)

    def close(self) -> None:
        """Withdraw the subscriptions."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers = []

    def _subscribe(self, stream: str, key: str, source: Input) -> zenoh.Subscriber[None]:
        inbox = self._inbox

        def receive(sample: zenoh.Sample) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            if len(sample.payload) > self._limits.max_message_bytes:
                self._losses.add(stream, "message_too_large")
                return
            inbox.put(stream, source.read(sample))

        handler: Callable[[zenoh.Sample], None] = receive
        return self._session.declare_subscriber(key, zenoh.handlers.Callback(handler, indirect=False))
