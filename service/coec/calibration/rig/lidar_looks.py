"""What a registration of two LiDARs says of the edge between them, as a look and as a window."""

from __future__ import annotations

from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.lidar_to_lidar.types import KNOWN_BEFORE
from coec.calibration.rig.evidence import EdgeObservation, information_of
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.geometry.linear import eigen

ArrayOfRegistration = NDArray[np.float64]

PLACE = np.array([radians(0.02)] * 3 + [0.004] * 3)
"""Standard deviation by which the pose between two LiDARs differs from street to street, beyond what a look claims
(rad, m): within simulated drives (seeds 41000 to 41005) looks scattered by 0.01 to 0.03° and 1 to 4 mm."""

BIAS = np.array([radians(0.03)] * 3 + [0.006] * 3)
"""Standard deviation of the error that is the same on every street: errors of angle and range that belong to the two
sensors (rad, m). The means of these drives were off by 0.01 to 0.04° and 1 to 6 mm."""

DETERMINED_SHARE = 0.3
"""A look determines a direction if its standard deviation there is below this share of what is known before it: below
3° and 30 cm."""

UNDETERMINED_TIMES = 5.0
"""Standard deviation of a direction that is not determined, as a multiple of what is known before a look: two minutes
of such looks together then say less than was known before."""


def determined_covariance(covariance: ArrayOfRegistration) -> ArrayOfRegistration | None:
    """The covariance (6, 6) of what the surroundings determined; None if they determined no direction. Directions in
    which they say hardly more than was known before are made so wide that they count as not determined.

    Raises:
        ValueError: the covariance is not (6, 6) or not finite.
    """
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError("a covariance must be (6, 6) finite numbers")
    unit = KNOWN_BEFORE[:, None] * KNOWN_BEFORE
    widened, any_determined = np.zeros((6, 6)), False
    for value, vector in eigen((0.5 * (covariance + covariance.T) / unit).tolist()):
        determined = value < DETERMINED_SHARE**2
        any_determined |= determined
        widened += (value if determined else UNDETERMINED_TIMES**2) * np.outer(vector, vector)
    return widened * unit if any_determined else None


def observation_of_registration(
    edge: str, stamp_ns: int, T_a_b: Matrix4, covariance: ArrayOfRegistration
) -> EdgeObservation:
    """A look at an edge that found `T_a_b` (4, 4); `covariance` (6, 6) is that of `told_by`.

    Raises:
        ValueError: the covariance is invalid.
    """
    return EdgeObservation(edge, stamp_ns, T_a_b, information_of(covariance), PLACE, BIAS)


def window_of(stamp_ns: int, T_a_b: Matrix4, covariance: ArrayOfRegistration) -> Measurement:
    """The same for the joint estimate. There it stands for all looks at the edge, so the errors that they have in
    common count as noise."""
    return Measurement(T_a_b, Uncertainty(covariance + np.diag(PLACE**2 + BIAS**2), {}, float("nan")), stamp_ns)
