"""A frame to learn from. Kept apart from rendering, because training needs neither rays nor scenes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SHAPES: dict[str, tuple[int, int]] = {"round": (192, 192), "wide": (160, 288), "panorama": (128, 416)}
"""(height, width) px by kind: whole fisheyes, common cameras, KITTI's narrow strips. Multiples of 32."""
KINDS: tuple[tuple[str, float], ...] = (("round", 0.4), ("wide", 0.35), ("panorama", 0.25))
"""Kinds with their shares."""
NEAREST_M = 1.0
"""Range whose inverse has the largest code, 65535; nearer surfaces have the same code."""
UNKNOWN, SKY = 0, 1
"""Codes of pixels without a target (own body, outside the lens) and of the sky."""


class TrainingFrame(NamedTuple):
    """A frame to learn from.

    Attributes:
        kind: key of `SHAPES`.
        bgr: (height, width, 3) uint8.
        code: (height, width) uint16, inverse range: 65535 · `NEAREST_M` / range; `SKY`, `UNKNOWN`.
    """

    kind: str
    bgr: NDArray[np.uint8]
    code: NDArray[np.uint16]
