"""What a registration of two LiDARs says of the edge between them."""

from __future__ import annotations

from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.lidar_to_lidar.types import KNOWN_BEFORE
from coec.calibration.rig.evidence import Look, information_of
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.geometry.linear import eigen

Array = NDArray[np.float64]

PLACE = np.array([radians(0.02)] * 3 + [0.004] * 3)
"""Standard deviation by which streets differ in where they put one LiDAR in another, beyond what a look claims (rad,
m): within simulated drives (seeds 41000 to 41005) looks scattered by 0.01 to 0.03° and 1 to 4 mm."""

BIAS = np.array([radians(0.03)] * 3 + [0.006] * 3)
"""Of what no street tells, errors of angle and range that belong to the two sensors (rad, m): the means of these drives
were off by 0.01 to 0.04° and 1 to 6 mm."""

TELLS = 0.3
"""Share of what is known before that the standard deviation of a direction may have, for the look to tell it: 3° and
30 cm."""

UNTOLD = 5.0
"""Times that, the standard deviation of a direction that is not told: two minutes of such looks together tell less than
was known before."""


def told_by(covariance: Array) -> Array | None:
    """The covariance (6, 6) of what the surroundings told: of directions in which that is hardly more than was known
    before, as wide as if nothing was; None where that is so of all.

    Raises:
        ValueError: it is not finite, or no covariance.
    """
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError("a covariance must be (6, 6) finite numbers")
    unit = KNOWN_BEFORE[:, None] * KNOWN_BEFORE
    widened, tells_something = np.zeros((6, 6)), False
    for value, vector in eigen((0.5 * (covariance + covariance.T) / unit).tolist()):
        told = value < TELLS**2
        tells_something |= told
        widened += (value if told else UNTOLD**2) * np.outer(vector, vector)
    return widened * unit if tells_something else None


def look_of(edge: str, stamp_ns: int, T_a_b: Matrix4, covariance: Array) -> Look:
    """A look that puts b there in a (4, 4); `covariance` (6, 6) is that of `told_by`.

    Raises:
        ValueError: the covariance is none.
    """
    return Look(edge, stamp_ns, T_a_b, information_of(covariance), PLACE, BIAS)


def window_of(stamp_ns: int, T_a_b: Matrix4, covariance: Array) -> Measurement:
    """The same for the joint estimate, in which it stands for all looks: what they have in common is noise there."""
    return Measurement(T_a_b, Uncertainty(covariance + np.diag(PLACE**2 + BIAS**2), {}, float("nan")), stamp_ns)
