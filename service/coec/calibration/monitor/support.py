"""How far the edges of a look insist on where they put the mount.

There is always some optimum, and it never scores below the expected pose. Whether its gain is more than chance shows in
the look itself. If the mount moved, most frames and most sectors of the image show it, and much of the significance is
gone at the pose that the mount left. If spray, a lamp post or a guard rail drew the optimum aside, a few cells gain
what others lose, and the expected pose fits nearly as well.
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
"""Standard deviations from which a gain is more than chance."""


@dataclass(frozen=True, slots=True)
class Support:
    """How strongly the edges prefer an optimum to the pose at which it was expected.

    Attributes:
        kept: significance at the expected pose over that at the optimum, on the sharpest edges.
        certainty: of the gain, in standard deviations of the scatter of frames and sectors; see `Landscape`.
    """

    retained: float
    certainty: float

    @property
    def gained(self) -> bool:
        """Whether the gain is more than chance."""
        return self.certainty > CERTAIN

    @property
    def insists(self) -> bool:
        """Whether the gain is also large enough for another place to be believed instead of the one next to a pose."""
        return self.gained and self.retained < NEAR_SHARE


def support(there: NDArray[np.float64], expected: NDArray[np.float64]) -> Support:
    """The support, from the cells (F, B) at the optimum and at the expected pose."""
    best, left = (fsum(cells.ravel().tolist()) for cells in (there, expected))
    # An optimum without edges has gained nothing.
    return Support(left / best if best > 0.0 else 1.0, certainty(there - expected))
