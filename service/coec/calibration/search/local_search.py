"""Maximises an objective over a box of perturbations with BOBYQA (Powell 2009, NLopt): bounded, derivative-free,
deterministic. Along translations that a window cannot determine, the camera's centre stays where it was before the
search.

There are two stages on one objective. The first finds the basin with a trust region of degrees; the second starts again
there with a fresh quadratic model of the basin's size. Deterministic: the same objective gives the same evaluations and
the same optimum.

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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import degrees, radians

import nlopt
import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.landscape import Curvature
from coec.calibration.objective.mutual_information import Objective, SearchBox
from coec.calibration.types import Matrix4, Progress, StopReason
from coec.config import SearchConfig, VerdictConfig
from coec.geometry import se3


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Where to search, in the units of each of n axes.

    Attributes:
        lower, upper: (n,) bounds.
        step: (n,) first trust region.
        tolerance: (n,) last trust region.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    step: NDArray[np.float64]
    tolerance: NDArray[np.float64]


Scores = Callable[[NDArray[np.float64]], Sequence[float]]
"""The scores of K points (K, n), each by itself."""


def maximum_in(
    box: Box, scores: Scores, start: NDArray[np.float64], max_evaluations: int
) -> tuple[NDArray[np.float64], bool]:
    """The best coordinates (n,) in the box that a search from `start` (n,) finds, and whether its evaluations ran out
    before it ended.

    The first points do not depend on their scores, so they are scored together; the others are scored one by one.
    """
    # The first quadratic model needs two steps of room between the bounds.
    step = np.minimum(box.step, (box.upper - box.lower) / 2.0)
    first = _first_points(start, step)[:max_evaluations]
    known = dict(zip((point.tobytes() for point in first), scores(first), strict=True))

    def score(point: NDArray[np.float64], _gradient: NDArray[np.float64]) -> float:
        cached = known.pop(point.tobytes(), None)
        return scores(point[None])[0] if cached is None else cached

    optimiser = nlopt.opt(nlopt.LN_BOBYQA, len(start))
    optimiser.set_lower_bounds(box.lower)
    optimiser.set_upper_bounds(box.upper)
    optimiser.set_initial_step(step)
    optimiser.set_xtol_abs(box.tolerance)
    optimiser.set_maxeval(max_evaluations)
    optimiser.set_max_objective(score)
    best = np.asarray(optimiser.optimize(start))
    return best, optimiser.last_optimize_result() == nlopt.MAXEVAL_REACHED


def _first_points(start: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2·n + 1, n) the points of BOBYQA's first model: the start, and a step either way along each axis. Where the box
    has no room for both steps, BOBYQA begins at other points."""
    return np.concatenate([start[None], start + np.diag(step), start - np.diag(step)])


REFINE_BOX_RAD, REFINE_STEP_RAD = radians(1.5), radians(0.6)
"""Box and first step of the second stage. The box holds the widest ripple of pixels and scan lines around the end of
the first stage. The step spans several of those ripples (cells of a depth map, rings of a sweep: 0.1 to 0.4 degrees),
so that the first quadratic model sees the hill and not the ripple."""

POLISH_STEPS = 4.0
"""Half-width of the box of a polish, in steps: the search that leads to a basin ends within a few steps of its
maximum."""

POLISH_METRES_PER_RADIAN = 20.0
"""Metres per radian of the first trust region of a polish. It is wider along the translations because their hill is
wider. See docs/measured.md."""

FIXATED_M = 8.0
"""A shift of a polish to the side or upwards turns the camera, so that things at this distance stay where they are in
the image. Turns and shifts then make up for each other along a single axis, not along a narrow valley askew between
two, in which a search with few evaluations halts half a degree and a decimetre before the summit."""

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
    reach, step = (se3.axis_steps(turn_rad)[: config.dof] for turn_rad in (REFINE_BOX_RAD, REFINE_STEP_RAD))
    best, exhausted_again = maximum_in(_box(best, reach, half_width, step, config), scores, best, most)
    stop_reason = StopReason.TOLERANCE
    if exhausted or exhausted_again:
        stop_reason = StopReason.EVALUATIONS
    elif (np.abs(best) >= AT_BOUND * half_width).any():
        stop_reason = StopReason.AT_BOUND
    return SearchResult(_pose(start, best), evaluations, stop_reason)


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


def polish(
    objective: Objective,
    basin: Matrix4,
    config: SearchConfig,
    progress: Progress,
    evaluations: int = 0,
    constraint: FixedCentre | None = None,
) -> SearchResult:
    """The maximum next to `basin` (4, 4), within a few difference steps of the objective. `evaluations` were made
    before and are included in the result. Every pose that is tried obeys `constraint`."""
    moved = [axis for axis in range(config.dof) if constraint is None or axis not in constraint.axes]

    def pose(coordinates: NDArray[np.float64]) -> Matrix4:
        perturbation = np.zeros(6)
        perturbation[moved] = coordinates
        right_m, down_m = perturbation[3:5]
        perturbation[:2] += down_m / FIXATED_M, -right_m / FIXATED_M
        perturbed = se3.perturb(basin, perturbation)
        return perturbed if constraint is None else constraint(perturbed)

    def scores(points: NDArray[np.float64]) -> list[float]:
        nonlocal evaluations
        evaluations += len(points)
        progress.step("search", evaluations, config.max_evaluations)
        return [at.score for at in objective.evaluate_each(np.array([pose(point) for point in points]))]

    step = se3.axis_steps(objective.step_rad, POLISH_METRES_PER_RADIAN)[moved]
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
