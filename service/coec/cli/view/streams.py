"""The frames of a running pair's sensors for a viewer: the newest pair, and none while nobody looks."""

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
"""Samples that may wait; the oldest are dropped. A pair needs its neighbours in time, and two seconds of ego-motion."""

PATIENCE_S = 5.0
"""Time after which a stream without samples is reported."""

BUSY_S = 0.2
"""Time after which the newest pair so far is shown, even if more samples wait."""

_SILENT = logging.Logger("view")
_SILENT.addHandler(logging.NullHandler())


class Streams:
    """The sensors of one pair. Subscriptions exist only while somebody looks, so that an unwatched viewer costs the
    vehicle nothing. A slow viewer loses frames here, not on the vehicle."""

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
        Gaps in sequence numbers do not count, because most frames are skipped here anyway."""
        counts = {cause: count for cause, count in self._losses.snapshot().items() if cause[1] != "sequence_gap"}
        for name, count in self._pairer.losses.items():
            stream, _, cause = name.partition("_")
            counts[stream, cause] = count
        return Counter(counts)

    @property
    def ages_s(self) -> dict[str, float | None]:
        """Time since a sample came, by stream; None: none since somebody looks. Empty while nobody looks."""
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
        """Subscribe if frames are wanted, else unsubscribe."""
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
        """The newest pair of the samples that have come; older pairs are skipped. None: nothing came within `wait_s`,
        or it made no pair."""
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
        """Count something that could not be shown or understood."""
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
