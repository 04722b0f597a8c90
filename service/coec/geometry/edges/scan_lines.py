"""Rows of a sweep. This module has no kernel, so that recording, which thins sweeps by rows, can use it without a
compiler."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

BAND_RAD = math.radians(0.42)
"""Height of a band of elevation if no ring is known: the beam spacing of a 64-beam sensor. Wider bands only cost time;
narrower ones cut scan lines of a tilted sensor into pieces."""


def distinct_rings(ring: NDArray[np.uint16] | None) -> NDArray[np.uint16] | None:
    """The rings (N,) if they distinguish beams; None if there are none, or if the driver fills the field with one
    number for all beams."""
    if ring is None or not len(ring) or ring.min() == ring.max():
        return None
    return ring
