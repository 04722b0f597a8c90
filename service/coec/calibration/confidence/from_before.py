"""Where the range edges lead to from the place that the camera had before the search.

A search of translations, too, may end on a hill of its own far from the one about the place that was known: where few
things are seen again and again, chance makes several. The hill that is next to what was known is a rival of what was
found, however the search came by.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coec.calibration.confidence.told import SHIFTS, SIZE, TURNS, levels_told
from coec.calibration.confidence.ways import Ways, climbed
from coec.calibration.search.observability import CentreKept
from coec.calibration.types import Matrix4, Window
from coec.geometry import se3
from coec.geometry.edges.alignment import EdgeFrames


def summit_from_before(edges: Sequence[EdgeFrames], window: Window, pose: Matrix4) -> Matrix4 | None:
    """The pose (4, 4) of the most significant alignment next to the centre of the window's start, the rotation that of
    `pose` (4, 4) to begin with: turned first, then shifted as well. None where the edges in view determine no pose.

    `edges` are those of the window, from a level that leads there to the sharpest one.
    """
    kept = CentreKept(tuple(SHIFTS), window.T_camera_lidar_start)(pose)
    levels = levels_told(edges, window, kept)
    nothing, turns, every = np.zeros(SIZE), tuple(TURNS), (*TURNS, *SHIFTS)
    try:
        turned = climbed(levels, Ways.of(levels[-1], nothing, turns, ()), nothing)
        found = climbed(levels, Ways.of(levels[-1], turned, every, ()), turned)
    except ValueError:
        return None
    return se3.perturb(kept, found[: SHIFTS.stop])
