"""Where the range edges lead from the camera's place before the search.

A search that includes translations may end on a hill far from the one about the known place: if few things are seen
again and again, chance makes several hills. The hill next to the known place is a rival of the pose found, whatever way
the search took.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coec.calibration.confidence.told import SHIFTS, SIZE, TURNS, assumed_levels
from coec.calibration.confidence.ways import ParameterSubset, local_ascent
from coec.calibration.search.observability import FixedCentre
from coec.calibration.types import Matrix4, Window
from coec.geometry import se3
from coec.geometry.edges.alignment import EdgeFrames


def mode_next_to_prior(edges: Sequence[EdgeFrames], window: Window, pose: Matrix4) -> Matrix4 | None:
    """The pose (4, 4) of the most significant alignment next to the camera's centre at the window's start. The climb
    begins with the rotation of `pose` (4, 4); it first turns only, then also shifts. None if the edges in view
    determine no pose.

    `edges` are those of the window, from coarser levels that lead there to the sharpest one.
    """
    start_pose = FixedCentre(tuple(SHIFTS), window.T_camera_lidar_start)(pose)
    levels = assumed_levels(edges, window, start_pose)
    nothing, turns, every = np.zeros(SIZE), tuple(TURNS), (*TURNS, *SHIFTS)
    try:
        turned = local_ascent(levels, ParameterSubset.of(levels[-1], nothing, turns, ()), nothing)
        deviation = local_ascent(levels, ParameterSubset.of(levels[-1], turned, every, ()), turned)
    except ValueError:
        return None
    return se3.perturb(start_pose, deviation[: SHIFTS.stop])
