"""How far the edges of a look insist on where they put the mount.

An optimum is always somewhere, and never below the pose that was expected. Whether the way there is more than chance
gained on it, the look itself tells: a mount that moved is seen to have moved by most frames and in most sectors of the
image, and at the pose that it left much of the significance is gone. Where spray, a lamp post or a guard rail drew the
optimum aside, a few cells gained what others lost, and the expected pose fits nearly as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import fsum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.quantiles import normal_quantile
from coec.calibration.confidence.landscape import certainty
from coec.calibration.monitor.neighbourhood import NEAR_SHARE

CERTAIN = normal_quantile(0.95)
"""Standard deviations by which a gain is more than chance."""


@dataclass(frozen=True, slots=True)
class Support:
    """What the edges say for an optimum and against the pose at which it was expected.

    Attributes:
        kept: significance at the expected pose over that at the optimum, on the sharpest edges.
        certainty: of the gain, in standard deviations as frames and sectors scatter; see `Landscape`.
    """

    kept: float
    certainty: float

    @property
    def gained(self) -> bool:
        """Whether the gain is more than chance."""
        return self.certainty > CERTAIN

    @property
    def insists(self) -> bool:
        """Whether it also is as much as a place elsewhere has to gain on the one next to a pose to be believed."""
        return self.gained and self.kept < NEAR_SHARE


def support(there: NDArray[np.float64], expected: NDArray[np.float64]) -> Support:
    """From the cells (F, B) at the optimum and at the expected pose."""
    best, left = (fsum(cells.ravel().tolist()) for cells in (there, expected))
    # An optimum without edges has gained nothing.
    return Support(left / best if best > 0.0 else 1.0, certainty(there - expected))
