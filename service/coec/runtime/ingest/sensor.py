"""A stream of a sensor: taken, decoded and counted once, however many pairs it is of."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from coec.adapters.system.logs import LossCounter
from coec.adapters.zenoh.inputs import Sample
from coec.config import KnownStreamConfig, LimitsConfig
from coec.runtime.ingest.decoder import EGO, Decoder, Frame
from coec.runtime.ingest.frame_budget import FrameBudget
from coec.runtime.timings import QUICK_S, Histogram

_log = logging.getLogger(__name__)

FRAMES_WAITING = 16
"""Samples of a camera or a LiDAR that may wait for the ingest thread: 1.6 s at 10 Hz."""

MOTIONS_WAITING = 512
"""Ego-motion samples that may wait: 2.5 s at 200 Hz."""

READ_WITHOUT = frozenset({"name", "mask", "hardware_id", "info_topic", "sweep", "T_lidar_ego"})
"""Settings of a stream that change nothing of how its samples are read: streams that differ in no other are one."""


def read_alike(kind: str, stream: KnownStreamConfig) -> tuple[str, str]:
    """What two streams have in common whose samples are the same frames."""
    return kind, stream.model_dump_json(exclude=set(READ_WITHOUT))


class SensorStream:
    """One of them. `counts` and `losses` are for any thread, the rest is the ingest thread's.

    Attributes:
        kind: what it brings.
        number: by which its samples are told apart from those of others.
        took: decoding of each sample.
        takers: who gets the frames, in the order in which they came.
    """

    def __init__(self, kind: str, number: str, config: KnownStreamConfig, limits: LimitsConfig) -> None:
        self.kind = kind
        self.number = number
        self.config = config
        self.losses = LossCounter(_log, config.sensor, "sensor")
        self.decoder = Decoder(kind, config, limits, self.losses)
        self.took = Histogram(QUICK_S)
        self.takers: tuple[Callable[[Frame], None], ...] = ()

    @property
    def depth(self) -> int:
        """Samples that may wait."""
        return MOTIONS_WAITING if self.kind == EGO else FRAMES_WAITING

    def take(self, sample: Sample, budget: FrameBudget) -> None:
        """Decode a sample that has come; whoever takes the frames gets the same one."""
        begun_s = time.monotonic()
        frame = self.decoder.frame(sample)
        self.took.add(time.monotonic() - begun_s, self.kind)
        if frame is None:
            return
        if not budget.admit(frame):
            self.losses.add(self.kind, "memory_full")
            return
        for taker in self.takers:
            taker(frame)
