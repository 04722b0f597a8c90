"""Selects the pairs of a window while the stream passes: evenly over the slice, each sharp, in view, taken in motion;
the thinned pairs between them, which date a move of the camera; the pairs of each check of the monitor; and urgent
windows, whose slice is shorter. Sensor time alone decides.

They enter no estimate, so they are not selected for quality, and a part of each sweep is enough. The part consists of
whole scan lines, so that the jumps in range along them are found as in the whole sweep.

Periods are counted from the zero of sensor time, not from the first pair, so that a restarted service and a replay at
any rate cut the same checks. Unlike the pairs of a window these are not selected for quality, because the monitor has
to see a dirty lens, a frozen camera, and a mount that is hit while the vehicle stands.

The slice is divided into as many bins as pairs are wanted. The first good pair of a bin is taken, and the rest of the
bin is not even decoded. Bins and slices are cut by sensor time, so a replay at any rate chooses the same pairs.

If a window was refused because the camera moved within it, its pairs from after the move are as good as any: they are
kept and count for the next window.

An open slice that began before the mount moved mixes two extrinsics, so it is ended, whatever it holds. A slice that
began later is ended as soon as it is enough for a window, or replaced by a short dense one if that comes sooner.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, cos, pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import (
    NS_PER_S,
    FramePair,
    ImageInspector,
    ImageQuality,
    ImageReducer,
    LidarFrame,
    Matrix4,
    Rig,
)
from coec.config import MonitorConfig, WindowConfig
from coec.errors import DecodeError
from coec.geometry.cameras import Camera, in_image, project_point
from coec.geometry.points import BAND_RAD, distinct_rings

MIB = 2**20

POINTS = 12_000
"""About how many points of a sweep are kept. Among them are as many range edges as the search for a change uses of each
frame in a window of 25 (`search.change_point.POINTS`)."""

BEYOND_RAD = radians(6.0)
"""Points are kept so far beyond the border of the view, because a knock may bring them into view."""


@dataclass(slots=True)
class _ThinnedSlice:
    """The open slice. From the stamp `next_ns` on a pair lies far enough from those before it; None before the first
    pair. From the stamp `afforded_ns` on there are bytes for another pair."""

    start_ns: int
    length_ns: int
    spacing_ns: int
    max_bytes: int
    afforded_ns: int
    bytes: int = 0
    next_ns: int | None = None


class BetweenPairs:
    """Picks and thins the pairs between, slice by slice: at a given distance in seconds, within a given size."""

    def __init__(self, images: ImageReducer, half_view_rad: float) -> None:
        """`half_view_rad` is the largest angle from the optical axis at which the image has a pixel."""
        self._images = images
        self._half_view_rad = half_view_rad
        self._open: _ThinnedSlice | None = None

    def begin(self, config: WindowConfig, start_ns: int, length_ns: int) -> None:
        """Begins a slice that is cut by `config`. If its chosen pairs will be so near to each other that they show the
        time as well, it has no pairs between."""
        spacing_ns = round(config.between_s * NS_PER_S)
        enabled = config.between_mib > 0 and length_ns >= 2 * spacing_ns * config.pairs
        self._open = (
            _ThinnedSlice(start_ns, length_ns, spacing_ns, config.between_mib * MIB, start_ns) if enabled else None
        )

    def on_selected(self, stamp_ns: int) -> None:
        """The window has chosen a pair of this stamp; the next pair between has to keep its distance from it."""
        if self._open is not None:
            self._open.next_ns = stamp_ns + self._open.spacing_ns

    def offer(self, pair: FramePair, T_camera_lidar: Matrix4) -> FramePair | None:
        """The pair, thinned, if it is to be recorded; `T_camera_lidar` (4, 4) is the current extrinsic."""
        current, stamp_ns = self._open, pair.camera.stamp_ns
        if current is None or current.next_ns is None or stamp_ns < max(current.next_ns, current.afforded_ns):
            return None
        current.next_ns = stamp_ns + current.spacing_ns
        try:
            camera = self._images.reduced(pair.camera)
        except DecodeError:
            return None
        lidar = thinned_sweep(pair.lidar, T_camera_lidar, self._half_view_rad)
        spent = current.bytes + len(camera.image.data) + _bytes(lidar)
        if spent > current.max_bytes:
            self._open = None
            return None
        current.bytes = spent
        # At any time no more than that time's share of the bytes is spent, so that they last to the end of the slice.
        current.afforded_ns = current.start_ns + current.length_ns * spent // current.max_bytes
        return replace(pair, camera=camera, lidar=lidar)


def thinned_sweep(lidar: LidarFrame, T_camera_lidar: Matrix4, half_view_rad: float) -> LidarFrame:
    """The sweep with about `POINTS` points: every n-th row of those in view, or nearly, at `T_camera_lidar` (4, 4).
    Without intensities."""
    seen = np.flatnonzero(_near_the_view(lidar.xyz_m, T_camera_lidar, half_view_rad + BEYOND_RAD))
    every = ceil(len(seen) / POINTS)
    if every > 1:
        seen = seen[_rows(lidar, seen) % every == 0]
    return replace(
        lidar,
        xyz_m=np.ascontiguousarray(lidar.xyz_m[seen]),
        intensity=None,
        ring=None if lidar.ring is None else lidar.ring[seen],
        time_offset_s=None if lidar.time_offset_s is None else lidar.time_offset_s[seen],
    )


def _near_the_view(xyz_m: NDArray[np.float32], T_camera_lidar: Matrix4, angle_rad: float) -> NDArray[np.bool_]:
    """(N,) whether points lie within an angle of the optical axis. It uses no compiled kernel and no BLAS, see
    `WindowCutter._sees_points`."""
    if angle_rad >= pi:
        return np.ones(len(xyz_m), np.bool_)
    x_m, y_m, z_m = xyz_m.T
    T = T_camera_lidar.astype(np.float32)
    x, y, z = (T[i, 0] * x_m + T[i, 1] * y_m + T[i, 2] * z_m + T[i, 3] for i in range(3))
    return np.asarray(z >= np.float32(cos(angle_rad)) * np.sqrt(x * x + y * y + z * z))


def _rows(lidar: LidarFrame, of: NDArray[np.int64]) -> NDArray[np.int64]:
    """The row of each point: its ring, or, without rings, its band of elevation."""
    ring = distinct_rings(lidar.ring)
    if ring is not None:
        return ring[of].astype(np.int64)
    x_m, y_m, z_m = lidar.xyz_m[of].T
    elevation = np.arctan2(z_m, np.hypot(x_m, y_m))
    return np.asarray(np.floor(elevation / np.float32(BAND_RAD)).astype(np.int64))


def _bytes(lidar: LidarFrame) -> int:
    return sum(column.nbytes for column in (lidar.xyz_m, lidar.ring, lidar.time_offset_s) if column is not None)


SPAN_PERIODS = 6
"""Periods that the pairs of one check may span. The slowest useful stream, with a pair per period, fills the four pairs
of a check in four periods; two more allow for losses. Pairs further apart do not belong to one check. From then on its
checks share pairs, so that one is completed in every period."""


MOVING_MPS = 1.0
"""Above this speed a vehicle passes the things that it sees."""


def drives(pairs: Sequence[FramePair]) -> bool:
    """Whether the vehicle is known to be on the move in most of the pairs."""
    return 2 * sum(pair.motion is not None and pair.motion.reaches(MOVING_MPS) for pair in pairs) > len(pairs)


def stands(pair: FramePair, window: WindowConfig) -> bool:
    """Whether the vehicle is known to stand, so that it sees nothing new."""
    return pair.motion is not None and pair.motion.stays_below(window.min_speed_mps)


class CheckSampler:
    """Keeps the pairs of the next check, at most `MonitorConfig.pairs`."""

    def __init__(self, config: MonitorConfig) -> None:
        self._config = config
        self._period_ns = round(config.period_s * NS_PER_S)
        self._pairs: list[FramePair] = []
        self._new = 0
        self._period = self._cell = -1
        self._last_ns = -1

    def offer(self, pair: FramePair) -> tuple[FramePair, ...] | None:
        """Takes the next pair. Returns the pairs of a check, newest last, if a period has ended with enough of them."""
        stamp_ns = pair.camera.stamp_ns
        if stamp_ns < self._last_ns:  # sensor time stepped back
            self._pairs.clear()
            self._new = 0
        self._last_ns = stamp_ns
        oldest_ns = stamp_ns - SPAN_PERIODS * self._period_ns
        self._pairs = [earlier for earlier in self._pairs if earlier.camera.stamp_ns >= oldest_ns]
        period, cell = stamp_ns // self._period_ns, stamp_ns * self._config.pairs // self._period_ns
        check = None
        if period != self._period and self._new > 0 and len(self._pairs) >= self._config.min_pairs:
            check = tuple(self._pairs)
            if check[-1].stamp_ns - check[0].stamp_ns < self._period_ns:
                self._pairs.clear()
            self._new = 0
        self._period = period
        if cell != self._cell:
            self._cell = cell
            self._pairs.append(pair)
            self._new += 1
            del self._pairs[: -self._config.pairs]
        return check


CELLS = 180
"""Cells of the table of directions in view, from the optical axis to its opposite (1° each) and all around it (2°)."""

SHARES_OF_SWEEP = 8
"""Shares of a sweep, each of every eighth point, that are looked at until enough points are in view."""

INSPECTIONS_PER_BIN = 16
"""Pairs of a bin that are inspected before it stays empty. Each inspection decodes an image, and a camera that is
dirty, dark or standing for an hour must not cost a decode of every frame."""


@dataclass(frozen=True, slots=True, eq=False)
class PairSelected:
    """A pair that belongs to the window; `first` opens it."""

    window_id: str
    pair: FramePair
    first: bool


@dataclass(frozen=True, slots=True, eq=False)
class PairBetween:
    """A thinned pair that is recorded beside those of the window."""

    window_id: str
    pair: FramePair


@dataclass(frozen=True, slots=True)
class CarriedOverPairs:
    """Pairs of a recorded window that also count for the next one.

    Attributes:
        window_id: the recorded window.
        since_ns: stamp of the first of them; all later pairs of that window are kept, too.
        last_ns: stamp of the last.
        pairs: how many there are.
    """

    window_id: str
    since_ns: int
    last_ns: int
    pairs: int


@dataclass(frozen=True, slots=True)
class SliceClosed:
    """The end of a slice in which at least one pair was chosen. `pairs` includes those that were carried over; the
    slice is `complete` if they are enough for a window."""

    window_id: str
    pairs: int
    complete: bool
    carried_over: CarriedOverPairs | None = None


@dataclass(frozen=True, slots=True)
class CarriedOverDropped:
    """The kept pairs are too far in time from the slice that begins, and will be in no other window."""

    carried_over: CarriedOverPairs


WindowEvent = PairSelected | PairBetween | SliceClosed | CarriedOverDropped


@dataclass(slots=True)
class _Slice:
    window_id: str
    start_ns: int
    length_ns: int
    filled: set[int]
    next_inspection_ns: int


class WindowCutter:
    """Cuts the stream of one camera-LiDAR pair into slices and picks the pairs of each.

    Attributes:
        slice_end_ns: sensor time at which the open slice ends; None when none is open.
        rejections: number of pairs that were inspected and refused, by reason.
        last_quality: result of the last inspection of an image.
    """

    def __init__(self, config: WindowConfig, rig: Rig, inspector: ImageInspector, reducer: ImageReducer) -> None:
        self._config = config
        self._rig = rig
        self._inspector = inspector
        self._in_view = _directions_in_view(rig.camera)
        self._between = BetweenPairs(reducer, _half_view_rad(self._in_view))
        self._next_config = config
        self._hurried_ns: int | None = None
        self._open: _Slice | None = None
        self._carried_over: CarriedOverPairs | None = None
        self.slice_end_ns: int | None = None
        self.rejections: Counter[str] = Counter()
        self.last_quality: ImageQuality | None = None

    @property
    def config(self) -> WindowConfig:
        """The configuration of the open slice, or of the next one if none is open."""
        return self._config if self._open else self._next_config

    def reconfigure(self, config: WindowConfig) -> None:
        """Sets the configuration for the next slice; the open one keeps its own."""
        self._next_config = config

    @property
    def selected(self) -> int:
        """Number of pairs of the open slice so far: those chosen, and those kept for it."""
        return len(self._open.filled) + self._carried_over_pairs if self._open else 0

    @property
    def slice_start_ns(self) -> int | None:
        """Stamp of the pair that opened the slice; None when none is open."""
        return self._open.start_ns if self._open else None

    def offer(self, pair: FramePair, T_camera_lidar: Matrix4) -> list[WindowEvent]:
        """Takes the next pair; `T_camera_lidar` (4, 4) is the current extrinsic, at which its points must be in view. A
        slice with kept pairs ends as soon as it has as many pairs as any slice."""
        stamp_ns = pair.camera.stamp_ns
        events: list[WindowEvent] = [*self._end_before(stamp_ns)]
        if self._open is None:
            events += self._forget_before(stamp_ns)
            window_id = f"{self._rig.pair}-{stamp_ns}"
            self._config = self._next_config
            length_ns = self._hurried_ns or round(self._config.slice_s * NS_PER_S)
            self._open = _Slice(window_id, stamp_ns, length_ns, set(), stamp_ns)
            self.slice_end_ns = stamp_ns + length_ns
            self._between.begin(self._config, stamp_ns, length_ns)
            self._hurried_ns = None
        if self._select(self._open, pair, stamp_ns, T_camera_lidar):
            self._between.on_selected(stamp_ns)
            events.append(PairSelected(self._open.window_id, pair, first=len(self._open.filled) == 1))
            if self._carried_over is not None and self.selected >= self._config.pairs:
                events += self.finish()
        elif (between := self._between.offer(pair, T_camera_lidar)) is not None:
            events.append(PairBetween(self._open.window_id, between))
        return events

    def carry_over(self, carried_over: CarriedOverPairs) -> None:
        """Adds kept pairs to the open window, or else to the next one. They replace earlier kept pairs, which are a
        part of them or from another time."""
        self._carried_over = carried_over

    def advance(self, stamp_ns: int) -> list[SliceClosed]:
        """Ends the open slice if sensor time has passed its end although no pair came."""
        return self._end_before(stamp_ns) if self.slice_end_ns and stamp_ns >= self.slice_end_ns else []

    def hurry(self, slice_s: float) -> None:
        """Makes the next slice `slice_s` long, because a window is wanted soon. The one after it has its usual
        length."""
        self._hurried_ns = round(slice_s * NS_PER_S)

    def finish(self) -> list[SliceClosed]:
        """Ends the open slice now. If it has too few pairs for a window, the kept pairs stay for the next one."""
        closed, pairs, carried_over = self._open, self.selected, self._carried_over
        self._open = self.slice_end_ns = None
        if closed is None or not closed.filled:
            return []
        complete = pairs >= self._config.min_pairs
        if complete:
            self._carried_over = None
        return [SliceClosed(closed.window_id, pairs, complete, carried_over if complete else None)]

    @property
    def _carried_over_pairs(self) -> int:
        return self._carried_over.pairs if self._carried_over is not None else 0

    def _forget_before(self, start_ns: int) -> list[CarriedOverDropped]:
        """Drops kept pairs that do not lie within one slice length before the slice that begins: they are older, or
        newer because sensor time stepped back."""
        carried_over = self._carried_over
        if carried_over is None or 0 <= start_ns - carried_over.last_ns <= round(self._config.slice_s * NS_PER_S):
            return []
        self._carried_over = None
        return [CarriedOverDropped(carried_over)]

    def _end_before(self, stamp_ns: int) -> list[SliceClosed]:
        """Ends the open slice if the stamp lies outside it, also because sensor time stepped back."""
        if self._open is None or 0 <= stamp_ns - self._open.start_ns < self._open.length_ns:
            return []
        return self.finish()

    def _select(self, current: _Slice, pair: FramePair, stamp_ns: int, T_camera_lidar: Matrix4) -> bool:
        bin_ns = current.length_ns // self._config.pairs
        index = min((stamp_ns - current.start_ns) // bin_ns, self._config.pairs - 1)
        if index in current.filled or stamp_ns < current.next_inspection_ns:
            return False
        reason = self._objection(pair, T_camera_lidar)
        if reason is not None:
            self.rejections[reason] += 1
            current.next_inspection_ns = stamp_ns + bin_ns // INSPECTIONS_PER_BIN
            return False
        current.filled.add(index)
        current.next_inspection_ns = stamp_ns + bin_ns // 2
        return True

    def _objection(self, pair: FramePair, T_camera_lidar: Matrix4) -> str | None:
        """Why the pair is not fit for a window, cheapest test first; None if it is fit."""
        config = self._config
        standing = stands(pair, config)
        if config.require_motion and standing:
            return "standing"
        if not self._sees_points(pair, T_camera_lidar):
            return "out_of_view"
        previous = self.last_quality
        try:
            quality = self._inspector.inspect(pair.camera)
        except DecodeError as error:
            return error.reason
        self.last_quality = quality
        if quality.mean_level < config.min_mean_level:
            return "too_dark"
        if quality.clipped > config.max_clipped:
            return "clipped"
        if quality.sharpness < config.min_sharpness:
            return "blurred"
        if previous is not None and previous.digest == quality.digest and not standing:
            return "frozen"
        return None

    def _sees_points(self, pair: FramePair, T_camera_lidar: Matrix4) -> bool:
        """Whether enough points are in view, by the table of directions. Its border is a degree wide, which matters
        little for a limit on the whole number. It uses no compiled kernel, because the process that cuts windows loads
        no compiler, and no BLAS, whose threads spin."""
        T = T_camera_lidar.astype(np.float32)
        in_view = 0
        for first in range(SHARES_OF_SWEEP):  # one of them is enough in most sweeps
            x_m, y_m, z_m = pair.lidar.xyz_m[first::SHARES_OF_SWEEP].T
            x, y, z = (T[i, 0] * x_m + T[i, 1] * y_m + T[i, 2] * z_m + T[i, 3] for i in range(3))
            across = np.arctan2(np.hypot(x, y), z) * (CELLS / np.pi)
            around = (np.arctan2(y, x) + np.pi) * (0.5 * CELLS / np.pi)
            cells = tuple(np.minimum(value.astype(np.int64), CELLS - 1) for value in (across, around))
            in_view += int(np.count_nonzero(self._in_view[cells]))
            if in_view >= self._config.min_points_in_view:
                return True
        return False


@lru_cache(maxsize=32, typed=True)
def _directions_in_view(camera: Camera) -> NDArray[np.bool_]:
    """(`CELLS`, `CELLS`), read-only: whether the middle of each cell of directions, camera frame, has a pixel in the
    image. Every camera model is central, so the distance does not matter. The result is cached, because a camera
    belongs to several pairs and the table takes 0.2 s without a kernel."""
    across = (np.arange(CELLS) + 0.5) * (np.pi / CELLS)
    around = (np.arange(CELLS) + 0.5) * (2.0 * np.pi / CELLS) - np.pi
    angle, turn = (grid.ravel() for grid in np.meshgrid(across, around, indexing="ij"))
    rays = np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
    pixels = np.array([project_point(camera, *ray) for ray in rays.tolist()])
    seen = (pixels[:, 2] != 0.0) & in_image(camera, pixels[:, :2])
    cells = np.asarray(seen.reshape(CELLS, CELLS))
    cells.setflags(write=False)
    return cells


def _half_view_rad(in_view: NDArray[np.bool_]) -> float:
    """The angle at the end of the last ring of cells that has a pixel."""
    return float(np.flatnonzero(in_view.any(axis=1)).max(initial=-1) + 1) * (np.pi / CELLS)


TRIES = 3
"""Urgent windows per suspicion: if these do not help, more of them will not either."""

RATE_PAIRS = 32
"""Number of pairs from which the rate is taken at which they come: three seconds at 10 Hz."""

MARGIN = 1.2
"""Factor by which a slice is longer than its pairs need at the rate at which they come."""


class UrgentWindow:
    """Hurries the `WindowCutter` of one pair while a window is wanted. Sensor time alone decides."""

    def __init__(self, monitor: MonitorConfig) -> None:
        self._monitor = monitor
        self._stamps_ns: deque[int] = deque(maxlen=RATE_PAIRS)
        self._since_ns: int | None = None
        self._tries = 0
        self._hurried = False
        self._for_rig = False
        self._longer_s = 0.0

    @property
    def is_waiting(self) -> bool:
        """Whether a window is wanted and has not come."""
        return self._since_ns is not None

    def alarm(self, since_ns: int) -> None:
        """The pair suspects a move and wants a window of frames since `since_ns`. It does not wait for its turn, as
        pairs do that the rig waits for."""
        if (self._since_ns is None or self._for_rig) and self._tries < TRIES:
            self._request(since_ns, for_rig=False, longer_s=0.0)
            self._tries += 1

    def request(self, since_ns: int, longer_s: float) -> None:
        """The rig waits for a window of frames since `since_ns`, whatever the pair itself suspects. The slice is
        `longer_s` longer than an urgent one, because the pairs of a sensor are solved one after the other."""
        if self._since_ns is None:
            self._request(since_ns, for_rig=True, longer_s=longer_s)

    def calm(self) -> None:
        """The suspicion is over. A window for which the rig waits is still wanted."""
        self._tries = 0
        if not self._for_rig:
            self._since_ns = None

    def forget(self) -> None:
        """Nothing is wanted any more: sensor time has stepped back."""
        self.calm()
        self._since_ns = None

    def _request(self, since_ns: int, *, for_rig: bool, longer_s: float) -> None:
        self._since_ns, self._hurried = since_ns, False
        self._for_rig, self._longer_s = for_rig, longer_s

    def observe(self, stamp_ns: int) -> None:
        """A pair with this stamp came. A stamp that steps back starts anew."""
        if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
            self._stamps_ns.clear()
        self._stamps_ns.append(stamp_ns)

    def apply(self, cutter: WindowCutter) -> list[SliceClosed]:
        """Ends the slice of the cutter if necessary; to be called before a pair is offered to the cutter."""
        if self._since_ns is None:
            return []
        start_ns, enough = cutter.slice_start_ns, cutter.selected >= cutter.config.min_pairs
        if start_ns is None:
            return self._hurry(cutter)
        if start_ns < self._since_ns:
            return self._hurry(cutter)
        if self._hurried:
            return []
        if enough:
            self._since_ns = None
            return cutter.finish()
        lacking = cutter.config.min_pairs - cutter.selected
        waits_s = lacking * cutter.config.slice_s / cutter.config.pairs
        return [] if waits_s <= self._length_s(cutter.config) else self._hurry(cutter)

    def on_slice_closed(self, event: SliceClosed, cutter: WindowCutter) -> None:
        """A slice ended by itself. If it has enough pairs it is the window that was wanted; else the next one is
        hurried."""
        if self._since_ns is None or not self._hurried:
            return
        if event.complete:
            self._since_ns = None
        else:
            cutter.hurry(self._length_s(cutter.config))

    def _hurry(self, cutter: WindowCutter) -> list[SliceClosed]:
        closed = cutter.finish()
        cutter.hurry(self._length_s(cutter.config))
        self._hurried = True
        return closed

    def _length_s(self, window: WindowConfig) -> float:
        """Length of an urgent slice: as configured, or longer if pairs come slowly, but no longer than any other."""
        seen, needed_s = self._stamps_ns, 0.0
        if len(seen) > 1:
            rate_hz = (len(seen) - 1) * NS_PER_S / (seen[-1] - seen[0])
            needed_s = MARGIN * window.pairs / rate_hz
        return min(max(self._monitor.urgent_slice_s, needed_s) + self._longer_s, window.slice_s)
