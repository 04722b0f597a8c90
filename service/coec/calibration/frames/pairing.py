"""By sensor stamps alone: which camera frame belongs to which sweep, how the vehicle moved then, and when each point
of a sweep was measured if its driver does not state it.

Nothing here depends on when or in which interleaving messages arrive, as long as each stream arrives in its own order,
because a pair is formed only when later messages can no longer change it. So a replay at any rate forms the same pairs.
"""

from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import NS_PER_S, CameraFrame, EgoMotion, FramePair, LidarFrame, SweepTiming
from coec.config import PairingConfig

AGREEING_STAMPS = 5
"""This many consecutive frames must agree on a new time line before it is believed: half a second at 10 Hz."""

MOTION_SAMPLES = 512
"""Ego-motion samples kept: more than two seconds at 200 Hz, while pairs wait at most a few frames."""

MOTION_LATE_NS = NS_PER_S
"""How far images may be ahead of ego-motion, in sensor time, before a pair is released without it. Filters and bridges
hold motion back by some tenths of a second, and a pair without compensation is worth less than one that comes later."""

PAIRS_WAITING = 32
"""Most pairs that wait for ego-motion, whatever their stamps say: those of a second of a LiDAR at 30 Hz."""

Frame = TypeVar("Frame", CameraFrame, LidarFrame, EgoMotion)


class TimeLine:
    """Refuses single stamps that are out of order in their stream, but follows a step of the clock that lasts.

    Attributes:
        latest_ns: stamp that was accepted last; None before the first.
    """

    def __init__(self, max_jump_ns: int) -> None:
        self._max_jump_ns = max_jump_ns
        self._refused: list[int] = []
        self.latest_ns: int | None = None

    def refusal(self, stamp_ns: int) -> str | None:
        """None when the stamp is accepted, else the reason it was refused."""
        if self.latest_ns is None or 0 < stamp_ns - self.latest_ns <= self._max_jump_ns:
            self.latest_ns = stamp_ns
            self._refused.clear()
            return None
        reason = "stamp_back" if stamp_ns <= self.latest_ns else "stamp_ahead"
        if self._refused and not 0 < stamp_ns - self._refused[-1] <= self._max_jump_ns:
            self._refused.clear()
        self._refused.append(stamp_ns)
        if len(self._refused) < AGREEING_STAMPS:
            return reason
        self.latest_ns = stamp_ns
        self._refused.clear()
        return None


class Pairer:
    """Joins the three streams of one camera-LiDAR pair.

    A sweep and a camera frame are a pair when each is the other's nearest in sensor time, within the tolerance.

    Attributes:
        losses: frames that ended in no pair, by reason.
    """

    def __init__(self, config: PairingConfig, *, expects_motion: bool) -> None:
        self._tolerance_ns = round(config.tolerance_s * NS_PER_S)
        self._motion_tolerance_ns = round(config.motion_tolerance_s * NS_PER_S)
        self._queue_frames = config.queue_frames
        self._expects_motion = expects_motion
        jump_ns = round(config.max_stamp_jump_s * NS_PER_S)
        self._camera_time, self._lidar_time, self._motion_time = (TimeLine(jump_ns) for _ in range(3))
        self._cameras: deque[CameraFrame] = deque()
        self._sweeps: deque[LidarFrame] = deque()
        self._motions: deque[EgoMotion] = deque(maxlen=MOTION_SAMPLES)
        self._waiting: deque[tuple[CameraFrame, LidarFrame]] = deque()
        self._unmoved_ns: int | None = None
        self.losses: Counter[str] = Counter()

    def push(self, frame: CameraFrame | LidarFrame | EgoMotion) -> list[FramePair]:
        """Takes the next frame of its stream; returns the pairs that became certain, in order of their stamps."""
        match frame:
            case CameraFrame():
                self._enqueue(frame, self._camera_time, self._cameras, "camera")
            case LidarFrame():
                self._enqueue(frame, self._lidar_time, self._sweeps, "lidar")
            case EgoMotion():
                if self._unmoved_ns is not None and frame.stamp_ns <= self._unmoved_ns + self._motion_tolerance_ns:
                    # A pair was released without this motion and differs from the pair that it would have been.
                    self.losses["motion_late"] += 1
                self._enqueue(frame, self._motion_time, self._motions, "motion")
        self._match(final=False)
        return self._release(final=False)

    def flush(self) -> list[FramePair]:
        """The pairs that were still waiting, decided as if the streams had ended here."""
        self._match(final=True)
        return self._release(final=True)

    def _enqueue(self, frame: Frame, time_line: TimeLine, queue: deque[Frame], stream: str) -> None:
        reason = time_line.refusal(frame.stamp_ns)
        if reason is not None:
            self.losses[f"{stream}_{reason}"] += 1
            return
        if queue and queue[-1].stamp_ns >= frame.stamp_ns:  # the clock stepped back: waiting frames are of the old time
            self._lose(stream, len(queue))
            queue.clear()
        queue.append(frame)
        if len(queue) > self._queue_frames and stream != "motion":
            queue.popleft()
            self._lose(stream, 1)

    def _lose(self, stream: str, count: int) -> None:
        self.losses[f"{stream}_unpaired"] += count

    def _match(self, *, final: bool) -> None:
        """Pairs or drops sweeps from the oldest on, until one has to wait for frames that may still be nearer."""
        while self._sweeps:
            sweep = self._sweeps[0]
            newest_camera = self._camera_time.latest_ns
            if not final and (newest_camera is None or newest_camera < sweep.stamp_ns):
                return
            camera = min(self._cameras, key=lambda frame: abs(frame.stamp_ns - sweep.stamp_ns), default=None)
            if camera is None or abs(camera.stamp_ns - sweep.stamp_ns) > self._tolerance_ns:
                self._sweeps.popleft()
                self._lose("lidar", 1)
                continue
            newest_sweep = self._sweeps[-1].stamp_ns
            if not final and newest_sweep < camera.stamp_ns:
                return
            self._sweeps.popleft()
            if any(abs(s.stamp_ns - camera.stamp_ns) < abs(sweep.stamp_ns - camera.stamp_ns) for s in self._sweeps):
                self._lose("lidar", 1)
                continue
            while self._cameras and self._cameras[0].stamp_ns <= camera.stamp_ns:
                # A camera that is faster than the LiDAR has frames between two sweeps; each is counted as a loss.
                if self._cameras.popleft() is not camera:
                    self.losses["camera_surplus"] += 1
            self._waiting.append((camera, sweep))

    def _release(self, *, final: bool) -> list[FramePair]:
        """Hands out the pairs whose ego-motion is known, or will not become known."""
        released = []
        while self._waiting:
            camera, sweep = self._waiting[0]
            if self._expects_motion and not final and not self._motion_has_come(camera.stamp_ns):
                if not self._motion_is_overdue(camera.stamp_ns):
                    break
                self._unmoved_ns = camera.stamp_ns
            self._waiting.popleft()
            motion = motion_at(list(self._motions), camera.stamp_ns, self._motion_tolerance_ns)
            released.append(FramePair(camera, sweep, motion))
        return released

    def _motion_has_come(self, stamp_ns: int) -> bool:
        newest_ns = self._motion_time.latest_ns
        return newest_ns is not None and newest_ns >= stamp_ns

    def _motion_is_overdue(self, stamp_ns: int) -> bool:
        newest_camera_ns = self._camera_time.latest_ns
        patience_ns = max(self._motion_tolerance_ns, MOTION_LATE_NS)
        late = newest_camera_ns is not None and newest_camera_ns - stamp_ns > patience_ns
        return late or len(self._waiting) > PAIRS_WAITING


def motion_at(samples: Sequence[EgoMotion], stamp_ns: int, tolerance_ns: int) -> EgoMotion | None:
    """Ego-motion at a stamp, from samples in the order of their stamps: the sample with exactly this stamp, else one
    interpolated between its neighbours, else the nearest within the tolerance; None if none is."""
    after = bisect_left(samples, stamp_ns, key=lambda sample: sample.stamp_ns)
    near = [s for s in samples[max(after - 1, 0) : after + 1] if abs(s.stamp_ns - stamp_ns) <= tolerance_ns]
    if not near:
        return None
    if near[-1].stamp_ns == stamp_ns:
        return near[-1]
    if len(near) == 1:
        return EgoMotion(stamp_ns, near[0].frame_id, near[0].linear_mps, near[0].angular_radps)
    before, behind = near
    weight = (stamp_ns - before.stamp_ns) / (behind.stamp_ns - before.stamp_ns)
    return EgoMotion(
        stamp_ns,
        before.frame_id,
        _blended_or_unknown(before.linear_mps, behind.linear_mps, weight),
        _blend(before.angular_radps, behind.angular_radps, weight),
    )


Vector = tuple[float, float, float]


def _blended_or_unknown(a: Vector | None, b: Vector | None, weight: float) -> Vector | None:
    return None if a is None or b is None else _blend(a, b, weight)


def _blend(a: Vector, b: Vector, weight: float) -> Vector:
    x, y, z = ((1.0 - weight) * p + weight * q for p, q in zip(a, b, strict=True))
    return x, y, z


def azimuth_offsets_s(xyz_m: NDArray[np.float32], sweep: SweepTiming) -> NDArray[np.float64]:
    """(N,) seconds after the sweep's stamp at which each point was measured, from its azimuth (see `SweepTiming`)."""
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]).astype(np.float64) - sweep.stamp_azimuth_rad
    revolutions = azimuth / (2.0 * np.pi)
    revolutions -= np.rint(revolutions)
    return sweep.sign * sweep.period_s * revolutions
