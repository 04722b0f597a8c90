"""A stream of a sensor. Each sample is taken, decoded and counted once, however many pairs use the stream."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from coec.adapters.system.logs import LossCounter
from coec.adapters.zenoh.inputs import InputSample
from coec.config import KnownStreamConfig, LimitsConfig
from coec.runtime.ingest.decoder import EGO, TWO_SENDERS, Decoder, Frame
from coec.runtime.ingest.frame_budget import FrameBudget
from coec.runtime.ingest.stream_log import StreamLog
from coec.runtime.timings import QUICK_S, Histogram

_log = logging.getLogger(__name__)

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
