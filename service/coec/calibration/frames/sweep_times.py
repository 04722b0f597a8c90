"""When each point of a sweep was measured, from the turning of the sensor, if its driver does not say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import SweepTiming


def azimuth_offsets_s(xyz_m: NDArray[np.float32], sweep: SweepTiming) -> NDArray[np.float64]:
    """(N,) seconds after the sweep's stamp at which each point was measured, from its azimuth (see `SweepTiming`)."""
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]).astype(np.float64) - sweep.stamp_azimuth_rad
    revolutions = azimuth / (2.0 * np.pi)
    revolutions -= np.rint(revolutions)
    return sweep.sign * sweep.period_s * revolutions
