"""The stream of one sensor, which is decoded once whatever number of pairs uses it, and its lines in the log."""

import logging
import time
from collections.abc import Callable

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import KnownStreamConfig, LimitsConfig
from coec.io.logs import LossCounter
from coec.io.zenoh.bus import InputSample
from coec.service.ingest.decoder import EGO, TWO_SENDERS, Decoder, Frame
from coec.service.ingest.frame_buffers import FrameBudget
from coec.service.timing import NS_PER_S, QUICK_S, Histogram

_log = logging.getLogger(__name__)

LoggedFrame = CameraFrame | LidarFrame | EgoMotion

RATE_FRAMES = 30
"""The rate is measured over the first so many frames."""

SILENT_S = 5.0
"""A stream counts as silent after so long without a frame, s."""

QUIET_S = 60.0
"""Time between two lines about the silence of one stream, s: an unsteady network must not fill the log."""


class StreamLog:
    """Belongs to the thread of the engine."""

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
"""Samples of a camera or a LiDAR that may wait for the engine: 1.6 s at 10 Hz."""

MOTIONS_WAITING = 512
"""Ego-motion samples that may wait: 2.5 s at 200 Hz."""

READ_WITHOUT = frozenset({"name", "mask", "hardware_id", "info_topic", "sweep", "T_lidar_ego"})
"""Settings that do not change how the samples of a stream are read. Streams that differ only in these are one."""


def read_alike(kind: str, stream: KnownStreamConfig) -> tuple[str, str]:
    """A key that is equal for two streams if their samples give the same frames."""
    return kind, stream.model_dump_json(exclude=set(READ_WITHOUT))


class SensorStream:
    """One stream. `counts` and `losses` are for any thread, everything else is for the thread of the engine.

    Attributes:
        kind: what the stream brings: camera frames, LiDAR sweeps or ego-motion.
        number: name of the stream in the inbox.
        log: its lines in the log.
        took: how long the decoding of each sample took.
        takers: functions that get each frame, in the order in which the frames came.
    """

    def __init__(
        self,
        kind: str,
        number: str,
        config: KnownStreamConfig,
        limits: LimitsConfig,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.kind = kind
        self.number = number
        self.config = config
        self.losses = LossCounter(_log, config.sensor, "sensor")
        self.decoder = Decoder(kind, config, limits, self.losses)
        self.log = StreamLog(kind, config.sensor, clock)
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
