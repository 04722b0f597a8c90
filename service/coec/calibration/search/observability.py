"""Translations that a window does not tell: they keep the place that they had before the search.

Rotations move every point of an image alike, translations only near ones. Where nothing near has an edge, the optimum
slides along a translation, and takes a rotation with it: better to leave it where the workshop put it, and say so.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from coec.calibration.objective.curvature import Curvature
from coec.calibration.objective.mutual_information import Objective
from coec.calibration.ports import Progress
from coec.calibration.search.local_search import SearchResult, polish
from coec.calibration.types import Matrix4
from coec.config import SearchConfig, VerdictConfig

TRANSLATIONS = range(3, 6)


def unobservable(curvature: Curvature, dof: int, limits: VerdictConfig) -> tuple[int, ...]:
    """The translation axes, of those searched, whose maximum is no maximum or wider than `max_sigma_m`.

    Without a covariance at all (too few frames, or no maximum on a rotation) nothing can be said, and nothing is.
    """
    if dof <= TRANSLATIONS.start or not np.isfinite(curvature.second_derivative[: TRANSLATIONS.start]).all():
        return ()
    flat = [axis for axis in TRANSLATIONS if not curvature.second_derivative[axis] > 0.0]
    wide = [axis for axis in TRANSLATIONS if curvature.sigma[axis] > limits.max_sigma_m]
    return tuple(sorted({*flat, *wide}))


def without(
    blind: tuple[int, ...],
    search: SearchResult,
    objective: Objective,
    prior: Matrix4,
    config: SearchConfig,
    progress: Progress,
) -> SearchResult:
    """The search ended anew with the translations `blind` put back to those of `prior` (4, 4)."""
    pose = search.T_camera_lidar.copy()
    for axis in blind:
        pose[axis - TRANSLATIONS.start, 3] = prior[axis - TRANSLATIONS.start, 3]
    again = polish(objective, pose, config, progress, search.evaluations, blind)
    return replace(again, stop_reason=search.stop_reason)
