"""Colours of ranges, for people: near is red, far is blue."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

NEAREST_M, FURTHEST_M = 2.0, 80.0
"""Ranges at the two ends of the colours, metres: those of the objective. The scale is logarithmic."""


def share_of(range_m: NDArray[np.floating] | float) -> NDArray[np.float64]:
    """Place on the scale, 0 at the near end and 1 at the far one, of ranges in metres."""
    clipped = np.clip(range_m, NEAREST_M, FURTHEST_M)
    return np.asarray(np.log(clipped / NEAREST_M) / np.log(FURTHEST_M / NEAREST_M), dtype=np.float64)


def colours_bgr(range_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(N, 3) of ranges (N,), metres: turbo, reversed."""
    # The outermost tenths of turbo are nearly black.
    level = np.rint(255 * (0.95 - 0.85 * share_of(range_m))).astype(np.uint8)
    turbo = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO))
    colours: NDArray[np.uint8] = turbo.astype(np.uint8).reshape(-1, 3)[level]
    return colours
