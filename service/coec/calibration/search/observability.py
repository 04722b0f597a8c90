"""Translations that a window cannot determine: along these the camera's centre keeps its place from before the search.

Rotations move every point of an image alike, translations only near ones. If nothing near has an edge, the optimum
slides along a translation and takes a rotation with it. It is better to leave the camera where it was, and to say so.

What stays is the camera's *centre*, c = -Rᵀ·t in LiDAR coordinates for T_camera_lidar = [R | t], not an entry of t. The
column t is the place of the LiDAR as seen from the camera. It changes with every rotation that is found: by 35 cm for a
start that was turned by 20° and a camera 1 m from the LiDAR, although nobody moved the camera.

In the terms of METHOD, section 4: the perturbation T(ξ) = exp(ξ)·T on the left turns the camera about its own centre,
and its translation shifts that centre along the axes of the turned camera, by -R·(c - c₀). An axis is kept if this
component, counted from the start, is zero. With three degrees of freedom all three are kept: a search of rotations
alone leaves the centre of the start where it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.curvature import Curvature
from coec.calibration.objective.mutual_information import Objective
from coec.calibration.ports import Progress
from coec.calibration.search.local_search import SearchResult, polish
from coec.calibration.types import Matrix4
from coec.config import SearchConfig, VerdictConfig
from coec.geometry import se3

TRANSLATIONS = range(3, 6)
"""Places of the translations in ξ = [rx ry rz tx ty tz]."""


@dataclass(frozen=True, slots=True, eq=False)
class FixedCentre:
    """Keeps the camera's centre where it was along some axes of the camera.

    Attributes:
        axes: the kept axes, out of `TRANSLATIONS`.
        prior: (4, 4) T_camera_lidar whose centre is kept.
    """

    axes: tuple[int, ...]
    prior: Matrix4

    def __call__(self, T_camera_lidar: Matrix4) -> Matrix4:
        """The pose (4, 4) with its centre put back along the kept axes of that camera; its rotation stays."""
        shifted = se3.difference(T_camera_lidar, self.prior)
        pose = T_camera_lidar.copy()
        for axis in self.axes:
            pose[axis - TRANSLATIONS.start, 3] -= shifted[axis]
        return pose


def unobservable(curvature: Curvature, sigma: NDArray[np.float64], dof: int, limits: VerdictConfig) -> tuple[int, ...]:
    """The searched translation axes that have no maximum, or one whose standard deviation in `sigma` (6,) exceeds
    `max_sigma_m`.

    If there is no covariance at all (too few frames, or no maximum on a rotation) nothing can be said: empty.
    """
    if dof <= TRANSLATIONS.start or not np.isfinite(curvature.second_derivative[: TRANSLATIONS.start]).all():
        return ()
    flat = [axis for axis in TRANSLATIONS if not curvature.second_derivative[axis] > 0.0]
    wide = [axis for axis in TRANSLATIONS if sigma[axis] > limits.max_sigma_m]
    return tuple(sorted({*flat, *wide}))


def without(
    blind: tuple[int, ...],
    search: SearchResult,
    objective: Objective,
    prior: Matrix4,
    config: SearchConfig,
    progress: Progress,
) -> SearchResult:
    """The search finished again with the camera's centre put back to that of `prior` (4, 4) along the axes `blind`."""
    constraint = FixedCentre(blind, prior)
    again = polish(objective, constraint(search.T_camera_lidar), config, progress, search.evaluations, constraint)
    return replace(again, stop_reason=search.stop_reason)
