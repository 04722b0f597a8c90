"""How many independent looks the frames of a window are worth: what stands still in the vehicle's frame is one look.

The lane markings, guard rails and the horizon of a straight motorway lie on the same pixels in every image, and the
range edges of its sweeps among the same beams. Frames that agree on them say it once, however many they are. It shows
when sweeps and images change partners: what passes fits in its own frame only, what stands still in every one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.edges.alignment import EdgeFrames, frame_alignment, strengths_on_each_map
from coec.geometry.thinning import thinned

POINTS = 20_000
"""Range edges of the window that change partners, at most: with each of F images as much work as F evaluations of a
search that takes hundreds."""


@dataclass(frozen=True, slots=True)
class Looks:
    """At one pose.

    Attributes:
        count: how many independent looks the F frames are worth, 1 to F.
        significance: of the edges there, what frames have in common counted once: z·√(count / F), as z grows with the
            root of what is independent; standard deviations.
    """

    count: float
    significance: float


def look(edges: EdgeFrames, T_camera_lidar: Matrix4) -> Looks:
    """How often the edges say that the camera is at `T_camera_lidar` (4, 4), and how certainly."""
    some = edges.of_points(thinned(len(edges.weight), POINTS))
    count = independent_looks(strengths_on_each_map(some, T_camera_lidar))
    whole = frame_alignment(edges, T_camera_lidar).significance
    return Looks(count, whole * sqrt(count / len(edges.maps)))


def independent_looks(agreement: NDArray[np.float64]) -> float:
    """Of F frames, from how well the sweep of each (rows) agrees with the image of each (columns), (F, F): F over the
    design effect (Kish 1965) of as many repetitions,

        F / (1 + (F - 1)·ρ),  ρ = mean agreement with other frames / mean agreement with the own one,

    ρ being their intraclass correlation, from 0 to 1. Neither the order of the frames nor how often all of them are
    repeated changes it. Frames that do not agree with themselves say nothing, and that once.
    """
    frames = len(agreement)
    own = fsum(np.diag(agreement).tolist())
    if own <= 0.0 or frames == 1:
        return 1.0
    others = (fsum(agreement.ravel().tolist()) - own) / (frames - 1)
    alike = min(max(others / own, 0.0), 1.0)
    return frames / (1.0 + (frames - 1) * alike)
