"""Other poses that the window cannot distinguish from the optimum: modes at which a search ended or began, the mode
next to the camera's place before the search, and the profile of the objective along each translation.

A shift and a turn make up for each other on all but near things, along a ridge that bends. A straight walk from its top
leaves the ridge, and finds a drop where the ridge goes on. Many independent looks make the ridge short. A single look
leaves dents in it, any of which may be the top, and a search ends in one of them. So the ridge is followed as far as an
accepted translation may be off; if the window cannot tell that end from the optimum, the uncertainty shows it.

A search that includes translations may end on a hill far from the one about the known place: if few things are seen
again and again, chance makes several hills. The hill next to the known place is a rival of the pose found, whatever way
the search took.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, fsum

import numpy as np

from coec.calibration.objective.mutual_information import Divisible
from coec.calibration.ports import Silence
from coec.calibration.search.local_search import TRANSLATIONS, FixedCentre, near, polish
from coec.calibration.types import Matrix4, Window
from coec.calibration.uncertainty.nuisance_parameters import (
    SHIFTS,
    SIZE,
    TURNS,
    ParameterSubset,
    assumed_levels,
    local_ascent,
)
from coec.calibration.uncertainty.scatter import Landscape
from coec.config import CalibrationConfig
from coec.geometry import se3
from coec.geometry.edges.alignment import EdgeFrames
from coec.geometry.linalg import solved

SAME_HILL = 3.0
"""A pose within this many standard deviations belongs to the hill of the optimum, whose width is counted already."""


@dataclass(frozen=True, slots=True, eq=False)
class Rivals:
    """Poses under one objective: the best (4, 4), and `others` (4, 4) that might be the true one."""

    objective: Divisible
    best: Matrix4
    others: tuple[Matrix4, ...]


def with_modes(rivals: Rivals, moved: Sequence[int], covariance: list[list[float]]) -> list[list[float]]:
    """The covariance (n, n) of the axes `moved`, about the best summit, of a mixture with the other summits.

    A summit has the weight exp(-2·c²), where c is the certainty by which the best one stands above it. That is the
    likelihood exp(-d²/2) of a pose that is as far down on a paraboloid. A summit above the best has the weight 1.
    """
    axes = tuple(moved)
    aways = [se3.difference(other, rivals.best)[list(axes)].tolist() for other in rivals.others]
    aways_and_poses = [
        (away, other) for away, other in zip(aways, rivals.others, strict=True) if _on_another_hill(away, covariance)
    ]
    if not aways_and_poses:
        return covariance
    landscape = Landscape.about(rivals.objective.cells(rivals.best), rivals.best, axes)
    at_others = landscape.cells.at(np.array([other for _, other in aways_and_poses]))
    weighted = [
        (exp(-2.0 * max(landscape.certainty(cells), 0.0) ** 2), away)
        for (away, _), cells in zip(aways_and_poses, at_others, strict=True)
    ]
    whole = 1.0 + fsum(weight for weight, _ in weighted)
    n = range(len(axes))
    return [[covariance[i][j] + fsum(w * away[i] * away[j] for w, away in weighted) / whole for j in n] for i in n]


def _on_another_hill(away: list[float], covariance: list[list[float]]) -> bool:
    """Whether a summit that lies `away` (n,) from the best one is on another hill."""
    return fsum(a * b for a, b in zip(away, solved(covariance, away), strict=True)) > SAME_HILL**2


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
