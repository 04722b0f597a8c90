"""Where the optimum goes if the camera is shifted aside and everything else may follow.

A shift and a turn make up for each other on all but near things, along a ridge that bends. A straight walk from its top
leaves the ridge, and finds a drop where the ridge goes on. Many independent looks make the ridge short. A single look
leaves dents in it, any of which may be the top, and a search ends in one of them. So the ridge is followed as far as an
accepted translation may be off; if the window cannot tell that end from the optimum, the uncertainty shows it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coec.calibration.confidence.modes import Rivals
from coec.calibration.objective.mutual_information import Divisible
from coec.calibration.ports import Silence
from coec.calibration.search.local_search import near, polish
from coec.calibration.search.observability import TRANSLATIONS, FixedCentre
from coec.calibration.types import Matrix4
from coec.config import CalibrationConfig
from coec.geometry import se3

SIGNS = (1.0, -1.0)


def translation_profile(objective: Divisible, pose: Matrix4, moved: Sequence[int], config: CalibrationConfig) -> Rivals:
    """The best poses with the camera `verdict.max_sigma_m` aside of the optimum at `pose` (4, 4), either way along each
    translation among the axes `moved`: the profile of the objective there. There are no such poses if only rotations
    moved."""
    held = tuple(axis for axis in TRANSLATIONS if axis not in moved)
    search = near(config.search, objective)
    ends = []
    for axis in moved:
        if axis not in TRANSLATIONS:
            continue
        for way in SIGNS:
            displaced = se3.perturb(pose, way * config.verdict.max_sigma_m * np.eye(6)[axis])
            constraint = FixedCentre((axis, *held), displaced)
            ends.append(polish(objective, displaced, search, Silence(), 0, constraint).T_camera_lidar)
    return Rivals(objective, pose, tuple(ends))
