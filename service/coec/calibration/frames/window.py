"""Chooses the pairs of a window while the stream passes: evenly over the slice, each sharp, in view, taken in motion.

The slice is divided into as many bins as pairs are wanted. The first good pair of a bin is taken, and the rest of the
bin is not even decoded. Bins and slices are cut by sensor time, so a replay at any rate chooses the same pairs.

If a window was refused because the camera moved within it, its pairs from after the move are as good as any: they are
kept and count for the next window.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.between import BetweenPairs
from coec.calibration.frames.sampling import stands
from coec.calibration.ports import ImageInspector, ImageReducer
from coec.calibration.types import FramePair, ImageQuality, Matrix4, Rig
from coec.config import WindowConfig
from coec.errors import DecodeError
from coec.geometry.cameras import Camera, in_image, project_point

NS_PER_S = 1_000_000_000

CELLS = 180
"""Cells of the table of directions in view, from the optical axis to its opposite (1° each) and all around it (2°)."""

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
    """The end of a slice in which at least one pair was chosen. `pairs` includes those that were `kept` for it; the
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
    def slice_end_ns(self) -> int | None:
        """Sensor time at which the open slice ends; None when none is open."""
        return self._open.start_ns + self._open.length_ns if self._open else None

    @property
    def slice_start_ns(self) -> int | None:
        """Stamp of the pair that opened the slice; None when none is open."""
        return self._open.start_ns if self._open else None

    def offer(self, pair: FramePair, T_camera_lidar: Matrix4) -> list[WindowEvent]:
        """Takes the next pair; `T_camera_lidar` (4, 4) is the current extrinsic, at which its points must be in view. A
        slice with kept pairs ends as soon as it has as many pairs as any slice."""
        events: list[WindowEvent] = [*self._end_before(pair.stamp_ns)]
        if self._open is None:
            events += self._forget_before(pair.stamp_ns)
            window_id = f"{self._rig.pair}-{pair.stamp_ns}"
            self._config = self._next_config
            length_ns = self._hurried_ns or round(self._config.slice_s * NS_PER_S)
            self._open = _Slice(window_id, pair.stamp_ns, length_ns, set(), pair.stamp_ns)
            self._between.begin(self._config, pair.stamp_ns, length_ns)
            self._hurried_ns = None
        if self._select(self._open, pair, T_camera_lidar):
            self._between.on_selected(pair.stamp_ns)
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
        self._open = None
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

    def _select(self, current: _Slice, pair: FramePair, T_camera_lidar: Matrix4) -> bool:
        bin_ns = current.length_ns // self._config.pairs
        index = min((pair.stamp_ns - current.start_ns) // bin_ns, self._config.pairs - 1)
        if index in current.filled or pair.stamp_ns < current.next_inspection_ns:
            return False
        reason = self._objection(pair, T_camera_lidar)
        if reason is not None:
            self.rejections[reason] += 1
            current.next_inspection_ns = pair.stamp_ns + bin_ns // INSPECTIONS_PER_BIN
            return False
        current.filled.add(index)
        current.next_inspection_ns = pair.stamp_ns + bin_ns // 2
        return True

    def _objection(self, pair: FramePair, T_camera_lidar: Matrix4) -> str | None:
        """Why the pair is not fit for a window, cheapest test first; None if it is fit."""
        config = self._config
        standing = stands(pair, config)
        if config.require_motion and standing:
            return "standing"
        if self._points_in_view(pair, T_camera_lidar) < config.min_points_in_view:
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

    def _points_in_view(self, pair: FramePair, T_camera_lidar: Matrix4) -> int:
        """Number of points in view, by the table of directions. Its border is a degree wide, which matters little for a
        limit on the whole number. It uses no compiled kernel, because the process that cuts windows loads no compiler,
        and no BLAS, whose threads spin."""
        x_m, y_m, z_m = pair.lidar.xyz_m.T
        T = T_camera_lidar.astype(np.float32)
        x, y, z = (T[i, 0] * x_m + T[i, 1] * y_m + T[i, 2] * z_m + T[i, 3] for i in range(3))
        across = np.arctan2(np.hypot(x, y), z) * (CELLS / np.pi)
        around = (np.arctan2(y, x) + np.pi) * (0.5 * CELLS / np.pi)
        cells = tuple(np.minimum(value.astype(np.int64), CELLS - 1) for value in (across, around))
        return int(np.count_nonzero(self._in_view[cells]))


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
