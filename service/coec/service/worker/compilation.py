"""The compilation of kernels in the worker: the kernels that checks and windows use and how many of them are there,
its progress as the service follows it, and a clock that stands still meanwhile, because no job's time limit counts
the time of compiling.

A kernel is compiled once on a machine, within seconds on an idle core, and within minutes where other processes want
the core. The worker sends `{"kind": "compiling", "done", "total"}` when it begins and at least at every further kernel,
and `{"kind": "compiled"}` after each kernel.

A kernel counts once it can run, whether it was compiled or read from the cache. Those that are only called from other
kernels do not count, because they come with these. Kernels are compiled for the types of their arguments, which differ
only by the model of the lens.
"""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from coec.calibration.types import Reason

_log = logging.getLogger(__name__)

CODE = "compiling_kernels"
"""Code of the reason that the worker has no answer because it compiles kernels."""

STALLED_S = 600.0
"""A worker that reports no progress of the compilation for so long is replaced, s. The longest step is the generation
of one kernel's machine code. See docs/measured.md."""

LINE_S = 15.0
"""Time between two lines of the log about the progress, s."""

SHORT_S = 2.0
"""A compilation that took less is not worth a line at its end, s."""


@dataclass(frozen=True, slots=True)
class Compiling:
    """`done` of `total` kernels are there, `elapsed_s` after the first of the others was begun."""

    done: int
    total: int
    elapsed_s: float

    @property
    def reason(self) -> Reason:
        """For health and status."""
        text = (
            f"The worker compiles its kernels, once on this machine: {self.done} of {self.total} are there. Windows "
            "are recorded meanwhile; checks begin after it."
        )
        return Reason(CODE, text)


class Compilation:
    """Belongs to the supervisor's thread; `status`, `now_s` and `paused_s` are for any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a steady clock, s."""
        self._clock = clock
        self._reached: tuple[int, int] | None = None
        self._started_s = self._reported_s = self._logged_s = 0.0
        # Time that the clock has stood still up to now, and since when it does; written together.
        self._pause: tuple[float, float | None] = 0.0, None

    @property
    def paused_s(self) -> float:
        """Time spent compiling so far, s."""
        before_s, since_s = self._pause
        return before_s if since_s is None else before_s + self._clock() - since_s

    def now_s(self) -> float:
        """A steady clock that stands still while kernels are compiled, s."""
        return self._clock() - self.paused_s

    @property
    def status(self) -> Compiling | None:
        """The compilation in progress; None if there is none."""
        reached = self._reached
        return None if reached is None else Compiling(*reached, self._clock() - self._started_s)

    @property
    def has_stalled(self) -> bool:
        """Whether a kernel is being compiled, and nothing was reported for `STALLED_S`."""
        return self._pause[1] is not None and self._clock() - self._reported_s > STALLED_S

    def take(self, message: Mapping[str, Any]) -> bool:
        """Takes a message of the worker if it is about the compilation; returns whether it is."""
        match message:
            case {"kind": "compiling", "done": int(done), "total": int(total)}:
                self._go_on(done, total)
            case {"kind": "compiled"}:
                self._resume()
            case _:
                return False
        return True

    def end(self) -> None:
        """The worker has answered, or is gone: nothing is being compiled."""
        self._resume()
        if self._reached is None:
            return
        _, total = self._reached
        self._reached = None
        elapsed_s = self._clock() - self._started_s
        if elapsed_s >= SHORT_S:
            fields = {"seconds": round(elapsed_s, 1), "kernels": total}
            _log.info(f"kernels compiled in {elapsed_s:.0f} s: those that are needed now", extra={"fields": fields})

    def _go_on(self, done: int, total: int) -> None:
        now_s = self._reported_s = self._clock()
        if self._reached is None:
            self._started_s, self._logged_s = now_s, now_s
            _log.info(f"compiling kernels, once on this machine: {done} of {total} are there")
        elif now_s - self._logged_s >= LINE_S:
            self._logged_s = now_s
            _log.info(f"compiling kernels: {done} of {total}, after {now_s - self._started_s:.0f} s")
        self._reached = done, total
        before_s, since_s = self._pause
        self._pause = before_s, now_s if since_s is None else since_s

    def _resume(self) -> None:
        self._pause = self.paused_s, None


COMMON: Mapping[str, tuple[str, ...]] = {
    "edges.charts": (
        "_cells", "_charted_z", "_pattern_search", "moved_by", "select_separated", "unit_ball",
    ),
    "edges.displaced_alignment": ("_sums_at", "_sums_of_cells", "_linearised"),
    "edges.image_edges": (
        "_eroded_by", "_gain_over", "_gradient", "_less", "_over_local_mean", "_row_sums", "_smoothed", "_stepped",
        "halved",
    ),
    "edges.range_edges": ("_jumps",),
    "edges.reflectance_edges": ("_steps",),
    "edges.scan_lines": ("_along_the_rows",),
    "images": ("connected_groups", "level_counts", "neighbour_differences", "square_sums"),
    "mutual_information": ("_count_reached", "_information", "_informations", "_tasks"),
    "sweep_kernels": ("_bearings", "_deskew", "grid_counts"),
}  # fmt: skip
"""Kernels that are the same for every lens, by their module in `coec.geometry`."""

OF_A_LENS: Mapping[str, tuple[str, ...]] = {
    "edges.alignment": (
        "_ascend", "_nearest_pixel_z", "_smooth_sums", "_smooth_sums_of_parts", "_sums_on_each_map",
    ),
    "edges.charts": ("_pixels",),
    "mutual_information": ("_count",),
    "projection": ("_largest_error_px", "_project", "_unproject"),
}  # fmt: skip
"""Kernels that are compiled for each model of a lens."""


@dataclass(frozen=True, slots=True)
class Compiled:
    """`done` of `total` kernels are there."""

    done: int
    total: int

    def __str__(self) -> str:
        return f"{self.done} of {self.total}"


def compiled(lenses: int) -> Compiled:
    """How many kernels of so many lens models are there in this process. Loads the compiler."""
    total = sum(map(len, COMMON.values())) + lenses * sum(map(len, OF_A_LENS.values()))
    return Compiled(_present(COMMON, 1) + _present(OF_A_LENS, lenses), total)


def _present(kernels: Mapping[str, tuple[str, ...]], most: int) -> int:
    """Number of the kernels that are there, each at most so many times."""
    return sum(
        min(len(getattr(import_module(f"coec.geometry.{module}"), name).overloads), most)
        for module, names in kernels.items()
        for name in names
    )
