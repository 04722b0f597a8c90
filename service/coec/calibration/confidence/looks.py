"""How many independent looks the frames of a window are worth. All that stands still in the vehicle's frame is one
look.

The lane markings, guard rails and horizon of a straight motorway lie on the same pixels in every image, and the range
edges of its sweeps among the same beams. Frames that agree on such things count as one look, however many they are. To
find them, sweeps and images change partners: passing things fit only in their own frame, still ones in every frame.
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
"""Most range edges that change partners: with F images that is the work of F evaluations, of which a search takes
hundreds."""


@dataclass(frozen=True, slots=True)
class IndependentSamples:
    """The looks at one pose.

    Attributes:
        count: how many independent looks the F frames are worth, 1 to F.
        significance: of the edges, with what frames have in common counted once: z·√(count / F), because z grows with
            the root of the independent part; standard deviations.
    """

    count: float
    significance: float


def independent_samples_at(edges: EdgeFrames, T_camera_lidar: Matrix4) -> IndependentSamples:
    """How many independent looks put the camera at `T_camera_lidar` (4, 4), and how significantly."""
    some = edges.of_points(thinned(len(edges.weight), POINTS))
    count = effective_sample_size(strengths_on_each_map(some, T_camera_lidar))
    whole = frame_alignment(edges, T_camera_lidar).significance
    return IndependentSamples(count, whole * sqrt(count / len(edges.maps)))


def effective_sample_size(agreement: NDArray[np.float64]) -> float:
    """The number of independent looks of F frames, from how well each sweep (rows) agrees with each image (columns),
    (F, F). It is F over the design effect (Kish 1965) of as many repetitions,

        F / (1 + (F - 1)·ρ),  ρ = mean agreement with other frames / mean agreement with the own one,

    where ρ is the intraclass correlation, 0 to 1. Neither the order of the frames nor repeating all of them changes it.
    Frames that do not agree with themselves count as one look.
    """
    frames = len(agreement)
    own = fsum(np.diag(agreement).tolist())
    if own <= 0.0 or frames == 1:
        return 1.0
    others = (fsum(agreement.ravel().tolist()) - own) / (frames - 1)
    alike = min(max(others / own, 0.0), 1.0)
    return frames / (1.0 + (frames - 1) * alike)
