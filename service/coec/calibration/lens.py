"""The lens as a result: what the posterior of a window says of focal length, principal point and first radial term.

Each hypothesis of the posterior has a lens of its own. The estimate is the mean of this mixture, so it stays with the
intrinsics of the rig, within what is known of them, unless the window contradicts them. What the window says alone is
the lens of the hypothesis whose lens is free.
"""

from math import hypot

import numpy as np

from coec.calibration.types import LensEstimate
from coec.calibration.uncertainty.posterior import LENS_OFF, LENS_WRONG, OF_LENS, Posterior
from coec.geometry.cameras import Camera

DETERMINED = 1.0 / 3.0
"""A window determines what it knows to this share of the prior of a free lens: the prior then displaces it by no more
than a tenth."""


def estimate_lens(distribution: Posterior | None, camera: Camera) -> LensEstimate | None:
    """What a posterior says of the lens of a camera; None without a posterior."""
    free = None if distribution is None else distribution.of(LENS_OFF)
    if distribution is None or free is None:
        return None
    weights = np.array([one.probability for one in distribution.hypotheses])
    lenses = np.array([one.lens for one in distribution.hypotheses])
    variances = np.array([one.lens_sigma for one in distribution.hypotheses]) ** 2
    mean = np.einsum("h,hi->i", weights, lenses)
    spread = np.sqrt(np.einsum("h,hi->i", weights, variances + (lenses - mean) ** 2))
    unit = np.array([camera.fx, camera.fy, 1.0, 0.5 * hypot(camera.width, camera.height)])
    values = np.stack([mean, spread, free.lens, free.lens_sigma]) * unit
    if not np.isfinite(values).all():
        return None
    determined = free.lens_sigma <= DETERMINED * np.array(LENS_WRONG)
    difference, sigma, free_difference, free_sigma = values
    return LensEstimate(difference, sigma, free_difference, free_sigma, determined, distribution.probability(*OF_LENS))
