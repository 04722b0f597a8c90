"""Colours of ranges for pictures: near is yellow, far is violet.

With the perceptual colour map plasma, ranges a quarter of the scale apart differ by at least 18 in CIELAB for every
kind of colour vision (Machado, Oliveira, Fernandes 2009: protanopia, deuteranopia, tritanopia). With turbo they differ
by 10, because a deuteranope cannot distinguish its red from its green. Viridis is as good as plasma, but its greens are
lost on trees.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, log10

import cv2
import numpy as np
from numpy.typing import NDArray

NEAREST_M, FURTHEST_M = 2.0, 80.0
"""Ranges that the objective uses, metres."""

DARKEST = 0.1
"""Place in the colour map where far ranges end; below it colours are nearly black."""

ROBUST = (0.02, 0.98)
"""Quantiles of the ranges in view between which the colours change, so that a bird or a church tower uses up no
colours."""

LEAST_RATIO = 4.0
"""Least ratio of the far end to the near end, so that a wall has one colour instead of a rainbow of its noise."""

SCALE_SAMPLES = 4096
"""Approximate number of ranges from which the quantiles are taken."""

SCALE_STEPS = (1.0, 2.0, 5.0)
"""Ends and labels of scales are these numbers, times powers of ten."""

TURNED_STEPS = 2
"""A scale changes only if an end of the fitting scale is at least this many steps away; with one step it would
flicker."""


@dataclass(frozen=True, slots=True)
class RangeScale:
    """A logarithmic scale of ranges between two ends, metres."""

    nearest_m: float
    furthest_m: float

    def share_of(self, range_m: NDArray[np.floating] | float) -> NDArray[np.float64]:
        """Place on the scale, 0 at the near end and 1 at the far one, of ranges in metres."""
        clipped = np.clip(range_m, self.nearest_m, self.furthest_m)
        return np.asarray(np.log(clipped / self.nearest_m) / np.log(self.furthest_m / self.nearest_m), dtype=np.float64)

    def range_at(self, share: NDArray[np.floating]) -> NDArray[np.float64]:
        """Ranges (N,) at places (N,) on the scale, metres."""
        return np.asarray(self.nearest_m * (self.furthest_m / self.nearest_m) ** share, dtype=np.float64)

    def colours_bgr(self, range_m: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Colours (N, 3) of ranges (N,), metres."""
        level = np.rint(255 * (1.0 - (1.0 - DARKEST) * self.share_of(range_m))).astype(np.uint8)
        return np.asarray(_PLASMA[level], dtype=np.uint8)

    def ticks_m(self) -> tuple[float, ...]:
        """Round ranges from end to end."""
        first, last = _step(self.nearest_m), _step(self.furthest_m)
        return tuple(_of_step(step) for step in range(first, last + 1))


WHOLE_SCALE = RangeScale(NEAREST_M, FURTHEST_M)
"""The scale over all ranges that the objective uses."""


def scale_of(range_m: NDArray[np.floating]) -> RangeScale:
    """The scale of a scene: from the nearest to the furthest of its ranges (N,), without a few outliers, at round
    steps; `WHOLE` if there are no ranges. Points nearer than `NEAREST_M` are on the vehicle itself and not drawn."""
    # Some thousand points give good enough quantiles in a tenth of the time.
    thinned = np.asarray(range_m[:: max(1, len(range_m) // SCALE_SAMPLES)], dtype=np.float64)
    thinned = thinned[thinned >= NEAREST_M]
    if len(thinned) == 0:
        return WHOLE_SCALE
    near_m, far_m = np.quantile(thinned, ROBUST).tolist()
    nearest = furthest = _step(near_m)
    while _of_step(furthest) < far_m or _of_step(furthest) < LEAST_RATIO * _of_step(nearest):
        furthest += 1
    return RangeScale(_of_step(nearest), _of_step(furthest))


def stable_scale(latest: RangeScale | None, fitting: RangeScale) -> RangeScale:
    """The scale of the latest picture if it is still good enough, else the one that fits this picture, so that the
    pictures of a drive keep their colours."""
    if latest is None:
        return fitting
    ends = ((latest.nearest_m, fitting.nearest_m), (latest.furthest_m, fitting.furthest_m))
    return fitting if any(abs(_step(a) - _step(b)) >= TURNED_STEPS for a, b in ends) else latest


def _step(range_m: float) -> int:
    """The number of the largest step that is not above a range: 0 is 1 m, 3 is 10 m."""
    decade = floor(log10(range_m) + 1e-9)
    return 3 * decade + sum(10.0**decade * step <= range_m * (1 + 1e-9) for step in SCALE_STEPS) - 1


def _of_step(number: int) -> float:
    decade, which = divmod(number, len(SCALE_STEPS))
    return float(SCALE_STEPS[which] * 10.0**decade)


_PLASMA = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_PLASMA)).reshape(
    -1, 3
)
