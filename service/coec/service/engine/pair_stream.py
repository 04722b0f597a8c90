"""Forms frame pairs from the frames of one camera and one LiDAR, holds them until they may be evaluated, and notices
when the streams fall silent.
"""

from collections import deque
from collections.abc import Mapping

from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import Frame, FramePair, Matrix4
from coec.config import Config, PairConfig
from coec.io.logs import LossCounter
from coec.service.engine.messages import SelectionStatistics, StreamStatistics
from coec.service.engine.vehicle import Vehicle
from coec.service.ingest.decoder import LIDAR, SensorStream
from coec.service.ingest.frame_buffers import FrameRing, PairBuffer
from coec.service.ingest.inbox import Arrivals
from coec.service.timing import NS_PER_S, QUICK_S, Histogram, SensorClock

GRACE_NS = NS_PER_S
"""Sensor time that must pass after the end of a slice before silence ends it, ns: late pairs may still be on their
way."""

QUIET_TICKS = 3
"""Ticks without a frame before a stream may count as silent. If the process slept, a tick is late, and frames that came
meanwhile need another tick to arrive here."""


class PairStream:
    """Takes the frames of one camera-LiDAR pair. `arrivals`, `losses` and `report` are for any thread, everything else
    is for that of the engine.

    Attributes:
        sensors: the streams, by kind; other pairs may share them.
        report: the latest statistics.
        waiting_took: how long each frame pair waited from when it was certain until it was evaluated.
        held: frame pairs that wait to be evaluated.
    """

    def __init__(
        self, pair: PairConfig, config: Config, vehicle: Vehicle, losses: LossCounter, ring: FrameRing | None = None
    ) -> None:
        """`losses` counts those of this pair. `ring` keeps the last seconds, if they are wanted."""
        self.sensors: Mapping[str, SensorStream] = vehicle.sensors_of(pair)
        self.report = StreamStatistics()
        self.waiting_took = Histogram(QUICK_S)
        self.held = PairBuffer(vehicle.waiting_frames, config.worker.timeout_s)
        self._vehicle = vehicle
        self._pairer = Pairer(pair.pairing, expects_motion=pair.ego is not None)
        self._clock = SensorClock()
        self._received_s: deque[float] = deque()
        self._losses = losses
        self._ring = ring
        self._pairs = 0
        self._sync_error_s: float | None = None
        self._quiet_ticks = 0
        self._silence: tuple[int, int] | None = None

    def losses(self) -> dict[tuple[str, str], int]:
        """Losses of the pair and of its streams, by place and cause."""
        counted = self._losses.snapshot()
        for sensor in self.sensors.values():
            counted |= sensor.losses.snapshot()
        return counted

    def arrivals(self) -> dict[str, Arrivals]:
        """What came on its streams, by kind."""
        return self._vehicle.arrivals(self.sensors)

    # --- frames -----------------------------------------------------------------------------------------------------

    def push(self, frame: Frame) -> None:
        """Takes the next frame of one of the streams; each frame says of which."""
        self._quiet_ticks = 0
        if self._ring is not None:
            self._ring.push(frame, self._vehicle.clock.monotonic_s())
        self._check_silence(frame.stamp_ns)
        self.hold(self._pairer.push(frame), set_clock=True)

    def hold(self, pairs: list[FramePair], *, set_clock: bool) -> None:
        """New frame pairs wait for their turn. `set_clock`: their stamps tell the sensor time now."""
        now_s = self._vehicle.clock.monotonic_s()
        for pair in pairs:
            if set_clock:
                self._clock.observe(pair.stamp_ns, now_s)
            self._received_s.append(now_s)
            self._pairs += 1
            self._sync_error_s = (pair.camera.stamp_ns - pair.lidar.stamp_ns) / NS_PER_S
            self.held.add(pair)

    @property
    def next_ns(self) -> int | None:
        """Stamp of the oldest frame pair that waits; None if none does."""
        return self.held.next_ns if self._received_s else None

    def take(self) -> FramePair:
        """Takes out the oldest frame pair."""
        self.waiting_took.add(self._vehicle.clock.monotonic_s() - self._received_s.popleft())
        return self.held.take()

    def flush(self) -> None:
        """Forms the frame pairs for which no better partner is awaited any more."""
        self.hold(self._pairer.flush(), set_clock=False)

    # --- the seconds around an event --------------------------------------------------------------------------------

    def keep_snippet(self, event: str, T_camera_lidar: Matrix4) -> None:
        """The seconds around an event are to be kept, if snippets are; `T_camera_lidar` (4, 4) is served then."""
        if self._ring is not None:
            self._ring.event(event, T_camera_lidar)

    def finish_snippet(self) -> None:
        """Ends the open snippet without waiting for further frames."""
        if self._ring is not None:
            self._ring.finish()

    # --- time -------------------------------------------------------------------------------------------------------

    def tick(self, selection: SelectionStatistics, *, waiting: bool) -> None:
        """Time has passed; `waiting`: samples of the streams are in the inbox. Renews the report."""
        self._quiet_ticks = 0 if waiting else self._quiet_ticks + 1
        if self._ring is not None:
            self._ring.tick(self._vehicle.clock.monotonic_s())
        self.renew_report(selection)

    def silence_ends(self, slice_end_ns: int | None) -> bool:
        """Whether the open slice, which ends at this sensor time, is over by extrapolated time, because the streams
        have stopped and no frame pair waits."""
        if slice_end_ns is None or self.held or self._quiet_ticks <= QUIET_TICKS:
            return False
        now_ns = self._clock.silent_now_ns(self._vehicle.clock.monotonic_s())
        return now_ns is not None and now_ns >= slice_end_ns + GRACE_NS

    def end_in_silence(self, slice_end_ns: int, last_ns: int | None) -> None:
        """The slice is ended in silence; `last_ns` is the stamp of the last frame pair that was evaluated. Frame pairs
        that are certain only by the silence came earlier, so they do not set the clock."""
        pairs = self._pairer.flush()
        self.hold(pairs, set_clock=False)
        self._silence = (pairs[-1].stamp_ns if pairs else last_ns) or 0, slice_end_ns

    def _check_silence(self, stamp_ns: int) -> None:
        """Checks, when a frame comes, whether a slice that ended in silence ended too early. If the frame belongs to
        that slice, the streams were not silent but held up. The window then differs from that of a replay, and that is
        counted."""
        if self._silence is None:
            return
        last_ns, end_ns = self._silence
        self._silence = None
        if last_ns < stamp_ns < end_ns:
            self._losses.add("window", "ended_too_early", detail="frames that were held up came after the slice ended")

    def renew_report(self, selection: SelectionStatistics) -> None:
        """Renews the report, with the statistics of the selection."""
        silent = self._clock.is_silent(self._vehicle.clock.monotonic_s())
        rate_hz = self._clock.rate_hz
        self.report = StreamStatistics(
            streams={kind: sensor.decoder.counts() for kind, sensor in self.sensors.items()},
            unpaired=dict(self._pairer.losses),
            pairs=self._pairs,
            held=len(self.held),
            selection=selection,
            rate_hz=0.0 if silent and rate_hz is not None else rate_hz,
            pace=self._clock.pace,
            sync_error_s=self._sync_error_s,
            timed_by=self.sensors[LIDAR].decoder.timed_by,
        )
