"""Maximises an objective over a box of perturbations: bounded, derivative-free.

There are two stages on one objective. The first finds the basin with a trust region of degrees; the second starts again
there with a fresh quadratic model of the basin's size. Deterministic: the same objective gives the same evaluations and
the same optimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, radians
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import Objective, SearchBox
from coec.calibration.ports import Progress
from coec.calibration.search.bounded import Box, maximum_in
from coec.calibration.steps import POLISH_METRES_PER_RADIAN, of_both
from coec.calibration.types import Matrix4, StopReason
from coec.config import SearchConfig
from coec.geometry import se3

REFINE_BOX_RAD, REFINE_STEP_RAD = radians(1.5), radians(0.6)
"""Box and first step of the second stage. The box holds the widest ripple of pixels and scan lines around the end of
the first stage. The step spans several of those ripples (cells of a depth map, rings of a sweep: 0.1 to 0.4 degrees),
so that the first quadratic model sees the hill and not the ripple."""

POLISH_STEPS = 4.0
"""Half-width of the box of a polish, in steps: the search that leads to a basin ends within a few steps of its
maximum."""

NEAR = 0.1
"""Tolerance, as a share of the difference step, of a maximum that only ranks a basin or leads to a finer level. The
score there is half a percent of the hill below its maximum, and takes half as many evaluations."""

AT_BOUND = 0.995
"""Share of the half-width of the box beyond which an optimum counts as lying on the bound."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Where a search ended: its pose (4, 4), its number of evaluations, and why it ended."""

    T_camera_lidar: Matrix4
    evaluations: int
    stop_reason: StopReason


def box_of(config: SearchConfig) -> SearchBox:
    """The reach of the search, from the configuration."""
    return SearchBox(radians(config.rotation_deg), config.translation_m if config.dof == 6 else 0.0)


def maximise(objective: Objective, start: Matrix4, config: SearchConfig, progress: Progress) -> SearchResult:
    """The pose with the highest score in the box about `start` (4, 4).

    Coordinates are the perturbation ξ = [rx ry rz tx ty tz] on the left of the start, about the camera axes; with three
    degrees of freedom the camera turns about its centre, which stays that of the start.
    """
    evaluations = 0

    def scores(points: NDArray[np.float64]) -> list[float]:
        nonlocal evaluations
        evaluations += len(points)
        progress.step("search", evaluations, config.max_evaluations)
        return [at.score for at in objective.evaluate_each(np.array([_pose(start, point) for point in points]))]

    centre, most = np.zeros(config.dof), config.max_evaluations
    half_width = _per_axis(config.dof, radians(config.rotation_deg), config.translation_m)
    step = _per_axis(config.dof, radians(config.step_deg), config.step_m)
    best, exhausted = maximum_in(_box(centre, half_width, half_width, step, config), scores, centre, most)
    reach, step = (of_both(turn_rad)[: config.dof] for turn_rad in (REFINE_BOX_RAD, REFINE_STEP_RAD))
    best, exhausted_again = maximum_in(_box(best, reach, half_width, step, config), scores, best, most)
    stop_reason = StopReason.TOLERANCE
    if exhausted or exhausted_again:
        stop_reason = StopReason.EVALUATIONS
    elif (np.abs(best) >= AT_BOUND * half_width).any():
        stop_reason = StopReason.AT_BOUND
    return SearchResult(_pose(start, best), evaluations, stop_reason)


class Constraint(Protocol):
    """What a search keeps as it is."""

    @property
    def axes(self) -> tuple[int, ...]:
        """Places in ξ that are not searched."""
        ...

    def __call__(self, T_camera_lidar: Matrix4) -> Matrix4:
        """The nearest pose (4, 4) that obeys the constraint."""
        ...


def polish(
    objective: Objective,
    basin: Matrix4,
    config: SearchConfig,
    progress: Progress,
    evaluations: int = 0,
    constraint: Constraint | None = None,
) -> SearchResult:
    """The maximum next to `basin` (4, 4), within a few difference steps of the objective. `evaluations` were made
    before and are included in the result. Every pose that is tried obeys `kept`."""
    moved = [axis for axis in range(config.dof) if constraint is None or axis not in constraint.axes]

    def pose(coordinates: NDArray[np.float64]) -> Matrix4:
        perturbation = np.zeros(6)
        perturbation[moved] = coordinates
        perturbed = se3.perturb(basin, perturbation)
        return perturbed if constraint is None else constraint(perturbed)

    def scores(points: NDArray[np.float64]) -> list[float]:
        nonlocal evaluations
        evaluations += len(points)
        progress.step("search", evaluations, config.max_evaluations)
        return [at.score for at in objective.evaluate_each(np.array([pose(point) for point in points]))]

    step = of_both(objective.step_rad, POLISH_METRES_PER_RADIAN)[moved]
    centre, reach = np.zeros(len(moved)), POLISH_STEPS * step
    best, exhausted = maximum_in(_box(centre, reach, reach, step, config), scores, centre, config.max_evaluations)
    stop_reason = StopReason.EVALUATIONS if exhausted else StopReason.TOLERANCE
    return SearchResult(pose(best), evaluations, stop_reason)


def near(config: SearchConfig, objective: Objective) -> SearchConfig:
    """The configuration for a search that may end as soon as it is `NEAR` the maximum of `objective`."""
    near_deg = NEAR * degrees(objective.step_rad)
    return config.model_copy(update={"tolerance_deg": max(near_deg, config.tolerance_deg)})


def polish_in_turn(
    objectives: Sequence[Objective], basin: Matrix4, config: SearchConfig, progress: Progress
) -> SearchResult:
    """The maximum of the last objective next to `basin` (4, 4); the objectives before it lead there, one after the
    other."""
    *leading, last = objectives
    evaluations = 0
    for objective in leading:
        result = polish(objective, basin, near(config, objective), progress, evaluations)
        basin, evaluations = result.T_camera_lidar, result.evaluations
    return polish(last, basin, config, progress, evaluations)


def _box(
    centre: NDArray[np.float64],
    reach: NDArray[np.float64],
    half_width: NDArray[np.float64],
    step: NDArray[np.float64],
    config: SearchConfig,
) -> Box:
    """The box within `reach` of `centre` and inside the box of `half_width`, all (n,). The tolerance of rotations is
    that of the configuration; tolerances are in proportion to the steps."""
    tolerance = step * radians(config.tolerance_deg) / step[0]
    return Box(np.maximum(centre - reach, -half_width), np.minimum(centre + reach, half_width), step, tolerance)


def _per_axis(dof: int, rotation: float, translation: float) -> NDArray[np.float64]:
    return np.array([rotation] * 3 + [translation] * 3)[:dof]


def _pose(start: Matrix4, coordinates: NDArray[np.float64]) -> Matrix4:
    perturbation = np.zeros(6)
    perturbation[: len(coordinates)] = coordinates
    return se3.perturb(start, perturbation)
