"""How far an optimum may be off, all in all: by chance, by the shape of the hill, by other summits, by errors that all
frames share, and by assumptions that the window itself contradicts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coec.calibration.confidence.budget import systematic_shifts
from coec.calibration.confidence.grain import sensor_resolution
from coec.calibration.confidence.landscape import Landscape
from coec.calibration.confidence.loosened import RelaxedAssumption
from coec.calibration.confidence.modes import Rivals, with_modes
from coec.calibration.confidence.noise import measure_noise
from coec.calibration.confidence.ridges import widened
from coec.calibration.objective.mutual_information import Divisible
from coec.calibration.types import Matrix4, Uncertainty, Window


def measure_uncertainty(
    objective: Divisible,
    pose: Matrix4,
    moved: Sequence[int],
    rivals: Sequence[Rivals],
    relaxed: Sequence[RelaxedAssumption],
    window: Window,
    held_m: float,
) -> Uncertainty:
    """The uncertainty of the optimum at `pose` (4, 4), searched along the axes `moved` of ξ; unknown if the objective
    has no maximum there or the frames are too few.

    `rivals` are other summits that the search found. `loosened` is how the pose moves when assumptions are set free. A
    held translation is known to `held_m`.
    """
    axes = tuple(moved)
    landscape = Landscape.about(objective.cells(pose), pose, axes)
    noise = measure_noise(landscape)
    if noise is None:
        return Uncertainty.unknown()
    covariance = widened(landscape, noise)
    for summits in rivals:
        covariance = with_modes(summits, axes, covariance)
    whole = np.full((6, 6), np.nan)
    whole[np.ix_(axes, axes)] = covariance
    axis_of_sweep = pose[:3, 2]  # the third axis of the LiDAR
    shared = systematic_shifts(landscape.cells.points, sensor_resolution(window, pose, held_m), axes, axis_of_sweep)
    for one in relaxed:
        shared[one.name] = one.believed * np.where(np.isin(np.arange(6), axes), one.shift, 0.0)
    return Uncertainty(whole, shared, noise.independent_samples)
