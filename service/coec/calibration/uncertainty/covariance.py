"""How far an optimum may be off.

With edges, from the posterior of the window over pose, lens and clocks (`posterior`), and from errors of the sensors
that no window shows (`systematic`). An objective without edges has only its scatter: the sandwich covariance J⁻¹·V·J⁻¹
(Huber 1967), with V between frames and between sectors of the image. Both are needed: all frames of a standing vehicle
show the same and so agree on anything, but its sectors, which show different things, do not. A covariance describes a
hill only at its top, so the hill is walked down until its drop is certain; how wide it counts follows from how certain
the drop is on the way.
"""

from dataclasses import dataclass, replace
from itertools import combinations
from math import fsum, hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective import landscape as surface
from coec.calibration.objective.edges import RANGE, IndependentSamples, independent_samples_at
from coec.calibration.objective.landscape import Curvature, Landscape, measure_curvature
from coec.calibration.objective.mutual_information import Divisible
from coec.calibration.search import local_search
from coec.calibration.search.local_search import TRANSLATIONS, SearchResult
from coec.calibration.solver import EstimatorResult, WindowData
from coec.calibration.types import Matrix4, Uncertainty, Window
from coec.calibration.uncertainty.posterior import (
    Assumptions,
    OtherCentre,
    Posterior,
    measure_posterior,
    other_centre,
    significance_next_to,
)
from coec.calibration.uncertainty.systematic import OF_SENSORS, lens_error_px, sensor_resolution, systematic_shifts
from coec.config import CalibrationConfig
from coec.geometry import se3
from coec.geometry.linalg import Rows, congruent, eigen, inverted

WIDER = (1.0, 2.0, 4.0)
"""Difference steps, in steps of the cells, that are tried until the objective has a maximum: a ripple may dent the top
of a hill."""

SAME = 1e-9
"""If frames differ, the smallest axis of the scatter has at least this share of the largest, with each figure in units
of its standard deviation. Frames that repeat one another leave 1e-16, the rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """The spread of an optimum by chance.

    Attributes:
        covariance: (n, n) of the axes that were searched, radians and metres.
        information: (n, n) negative Hessian of the objective, likewise.
        independent_samples: how many independent frames the window is worth for the place of the optimum: as many as
            there are, if what a frame says of a sector is independent of the other frames; one, if all say the same.
            How often they say that this is the right hill is another question: see `IndependentSamples`.
    """

    covariance: list[list[float]]
    information: list[list[float]]
    independent_samples: float


def measure_noise(landscape: Landscape) -> Noise | None:
    """The noise, by central differences. None if the objective has no maximum, or if too few frames differ: two views
    in turn, however often, scatter along one line and would leave the other axes without any error."""
    fitted = len(landscape.moved)
    if landscape.frames <= fitted:
        return None
    for wider in WIDER:
        gradients, information = _derivatives(landscape, wider * landscape.cells.step_rad)
        try:
            inverse = inverted(information)
        except ValueError:
            continue
        scattered = surface.scatter(gradients, fitted)
        if not _is_of_full_rank(scattered):
            return None
        return Noise(congruent(inverse, scattered), information, effective_frame_count(gradients, inverse))
    return None


def _derivatives(landscape: Landscape, step_rad: float) -> tuple[NDArray[np.float64], list[list[float]]]:
    """The gradient (n, F, B) of each cell, and the negative Hessian (n, n) of their sum."""
    shape, count = landscape.centre.shape, len(landscape.moved)
    steps = se3.axis_steps(step_rad)[list(landscape.moved)]

    def at(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        return landscape.at(offsets).reshape(len(offsets), -1)

    gradients, second = surface.along(at, steps, range(count))
    information = [[0.0] * count for _ in range(count)]
    for i in range(count):
        information[i][i] = -fsum(second[i].tolist())
    pairs = list(combinations(range(count), 2))
    for (i, j), mixed in zip(pairs, surface.across(at, steps, pairs), strict=True):
        information[i][j] = information[j][i] = -fsum(mixed.tolist())
    return gradients.reshape(count, *shape), information


def _is_of_full_rank(covariance: Rows) -> bool:
    """Whether every combination of the figures scatters."""
    deviations = [sqrt(row[i]) for i, row in enumerate(covariance)]
    if min(deviations) == 0.0:
        return False
    of_all = range(len(covariance))
    values = eigen([[covariance[i][j] / deviations[i] / deviations[j] for j in of_all] for i in of_all])
    return values[-1][0] > SAME * values[0][0]


def effective_frame_count(gradients: NDArray[np.float64], inverse: list[list[float]]) -> float:
    """The number of independent looks of F frames, from the gradients (n, F, B) of their cells and the inverse (n, n)
    of the information. It is F over the design effect (Kish 1965): how much more the sectors scatter than they would if
    the cells of each frame were independent of those of the others."""
    n, frames, _ = gradients.shape

    def size(groups: NDArray[np.float64]) -> float:
        rows = groups.reshape(n, -1).tolist()
        squares = [[fsum(a * b for a, b in zip(one, other, strict=True)) for other in rows] for one in rows]
        return fsum(inverse[i][j] * squares[j][i] for i in range(n) for j in range(n))

    together = size(gradients.sum(axis=1))
    return min(max(frames * size(gradients) / together, 1.0), float(frames)) if together > 0.0 else float(frames)


CERTAIN, BEYOND_DOUBT = 1.5, 3.0
"""Certainty of a drop (`Landscape.certainty`) at three standard deviations of the optimum, on a paraboloid, and at six,
where the walk ends. It goes on beyond the first because a certain drop may be a dent in a ridge that goes on behind
it."""

ABOUT = 0.25
"""How well a certainty is known where a drop becomes certain: its unit is a standard deviation that some twenty sectors
determine to a sixth, 1 / √(2·19). A place whose certainty is nearer than that to `CERTAIN` counts in part."""

FIRST, DOUBLINGS = 4.0, 5
"""The walk begins this many standard deviations away, and the distance doubles this often, up to 128; on most hills the
walk ends at 8 or 16."""

STRAIGHT = 1e-6
"""Certainties that differ by less count as equal."""


def widened(landscape: Landscape, noise: Noise) -> list[list[float]]:
    """The covariance (n, n) of the noise, with each principal axis lengthened as much as the hill is wider there than a
    paraboloid. The width is where the drop becomes certain, root mean square of both sides. No axis gets shorter."""
    scale = se3.axis_steps(1.0)[list(landscape.moved)].tolist()
    n = range(len(scale))
    scaled = [[noise.covariance[i][j] / scale[i] / scale[j] for j in n] for i in n]
    wide = [row[:] for row in noise.covariance]
    axes = [
        [sqrt(max(variance, 0.0)) * part * of for part, of in zip(direction, scale, strict=True)]
        for variance, direction in eigen(scaled)
    ]
    both_sides = _reaches(landscape, np.array([[axis, np.negative(axis)] for axis in axes]).reshape(-1, len(scale)))
    for axis, ahead, behind in zip(axes, both_sides[::2], both_sides[1::2], strict=True):
        more = max(0.5 * (ahead**2 + behind**2) / _expected(noise, axis) ** 2 - 1.0, 0.0)
        wide = [[wide[i][j] + more * axis[i] * axis[j] for j in n] for i in n]
    return wide


def _expected(noise: Noise, axis: list[float]) -> float:
    """How many lengths of an axis (n,) away the drop of a paraboloid becomes certain: three if the axis is also a
    principal axis of the hill."""
    n = range(len(axis))
    pull = [fsum(noise.information[i][j] * axis[j] for j in n) for i in n]
    ((scatter,),) = congruent([pull], noise.covariance)
    return 2.0 * CERTAIN * sqrt(scatter) / fsum(a * b for a, b in zip(pull, axis, strict=True))


def _reaches(landscape: Landscape, one_sigma: NDArray[np.float64]) -> list[float]:
    """Along each of m ways, over how many standard deviations the drop is not certain; one standard deviation is an
    offset of `one_sigma` (m, n). On a ridge with dents all of it counts except the dents. A slightly surer drop makes
    the reach slightly shorter."""
    reaches, walking = [0.0] * len(one_sigma), list(range(len(one_sigma)))
    before, certainties_before = 0.0, [0.0] * len(one_sigma)
    distance = FIRST
    for _ in range(DOUBLINGS + 1):
        going_on = []
        for way, cells in zip(walking, landscape.at(distance * one_sigma[walking]), strict=True):
            certainty = landscape.certainty(cells)
            reaches[way] += (distance - before) * _share_open(certainties_before[way], certainty)
            certainties_before[way] = certainty
            if certainty < BEYOND_DOUBT:
                going_on.append(way)
        if not going_on:
            break
        walking, before = going_on, distance
        distance *= 2.0
    return reaches


def _share_open(begin: float, end: float) -> float:
    """The share of the places between two where the optimum may lie because the drop is not certain. The certainty goes
    from `begin` to `end` in a straight line."""
    if abs(end - begin) < STRAIGHT:
        return min(max((CERTAIN + ABOUT - 0.5 * (begin + end)) / (2.0 * ABOUT), 0.0), 1.0)
    return (_open_up_to(end) - _open_up_to(begin)) / (end - begin)


def _open_up_to(certainty: float) -> float:
    """The integral over certainties of a share that is 1 while a drop is uncertain and falls to 0 about `CERTAIN`."""
    falling = min(max(certainty - (CERTAIN - ABOUT), 0.0), 2.0 * ABOUT)
    return min(certainty, CERTAIN + ABOUT) - falling * falling / (4.0 * ABOUT)


def _scattered(
    objective: Divisible, pose: Matrix4, moved: tuple[int, ...], window: Window, held_m: float
) -> Uncertainty:
    """The uncertainty of an optimum at `pose` (4, 4) from the scatter of an objective without edges, searched along the
    axes `moved` of ξ; unknown if the objective has no maximum there or the frames are too few."""
    landscape = Landscape.about(objective.cells(pose), pose, moved)
    noise = measure_noise(landscape)
    if noise is None:
        return Uncertainty.unknown()
    whole = np.full((6, 6), np.nan)
    whole[np.ix_(moved, moved)] = widened(landscape, noise)
    resolution = sensor_resolution(window, pose, held_m)
    shared = systematic_shifts(landscape.cells.points, resolution, moved, pose[:3, 2])
    return Uncertainty(whole, shared, noise.independent_samples)


def _posterior_uncertainty(
    posterior: Posterior, objective: Divisible, pose: Matrix4, moved: tuple[int, ...], window: Window, samples: float
) -> Uncertainty:
    """The uncertainty of an optimum at `pose` (4, 4), searched along the axes `moved` of ξ, from the posterior of its
    window: the nominal hypothesis, the distance to the others, and the errors of the sensors that no window shows."""
    whole = np.full((6, 6), np.nan)
    whole[np.ix_(moved, moved)] = posterior.noise(moved)
    resolution = sensor_resolution(window, pose, 0.0)
    every = systematic_shifts(objective.cells(pose).points, resolution, moved, pose[:3, 2])
    of_sensors = {name: shift for name, shift in every.items() if name in OF_SENSORS}
    return Uncertainty(whole, of_sensors | posterior.shifts(moved), samples)


@dataclass(frozen=True, slots=True, eq=False)
class AssessedOptimum:
    """An optimum and what the window says of it.

    Attributes:
        search: the search, with the mean of the posterior as its end if there is one: what maximises the objective lies
            on one of its ripples.
        unobservable: the translations (places in ξ) that were searched but that the window does not determine. Along
            these the camera's centre is that of the start.
        curvature: of the objective where the search ended.
        posterior: of pose, lens and clocks; None if the estimator used no edges, or they determine no pose.
        independent: how many independent frames the window is worth; None if the estimator used no edges.
        range_significance: of the range edges alone where the search ended; None if the estimator used no edges.
        rivals: significances of the sharpest edges next to the rivals of the pose (see `EstimatorResult`).
        other_centre: another maximum of them, at another centre of the camera; None if there is none.
        uncertainty: of the pose.
        sigma: (6,) its standard deviations, rad and m; NaN on axes that were not determined.
    """

    search: SearchResult
    unobservable: tuple[int, ...]
    curvature: Curvature
    posterior: Posterior | None
    independent: IndependentSamples | None
    range_significance: float | None
    rivals: tuple[float, ...]
    other_centre: OtherCentre | None
    uncertainty: Uncertainty
    sigma: NDArray[np.float64]


AMBIGUOUS = 0.8
"""Significance at another centre of the camera, over that at the result, with which the window does not determine where
along that axis the centre is. See docs/measured.md."""


def assess_optimum(result: EstimatorResult, data: WindowData, config: CalibrationConfig) -> AssessedOptimum:
    """What an estimator found, at the mean of its posterior, and the uncertainty of that. If the posterior has another
    mode that is more probable, that one is assessed. If the window does not determine a translation, or edges fit about
    as well elsewhere along it, the search is finished again with the camera's centre held there, and its new end is
    assessed."""
    start, dof, limits = data.window.T_camera_lidar_start, config.search.dof, config.verdict
    held = tuple(axis for axis in TRANSLATIONS if axis >= dof)
    optimum = _assessed(result, result.search, (), held, limits.held_translation_sigma_m, data.window, config)
    better = None if optimum.posterior is None else optimum.posterior.better_mode
    if better is not None:
        mode = se3.perturb(result.search.T_camera_lidar, np.where(np.arange(6) < dof, better.deviation[:6], 0.0))
        search = replace(result.search, T_camera_lidar=mode)
        optimum = _assessed(result, search, (), held, limits.held_translation_sigma_m, data.window, config)
    blind = local_search.unobservable(optimum.curvature, optimum.sigma, dof, limits)
    elsewhere = optimum.other_centre
    if elsewhere is not None and elsewhere.significance > AMBIGUOUS:
        blind = tuple(sorted({*blind, elsewhere.axis}))
    if not blind:
        return optimum
    search = local_search.without(blind, optimum.search, result.objective, start, config.search, data.progress)
    return _assessed(result, search, blind, blind, limits.max_sigma_m, data.window, config)


def _assessed(
    result: EstimatorResult,
    search: SearchResult,
    blind: tuple[int, ...],
    held: tuple[int, ...],
    held_to_m: float,
    window: Window,
    config: CalibrationConfig,
) -> AssessedOptimum:
    """The end of a search along all axes but `blind`. The centre along the axes `held` is known to `held_to_m`."""
    objective, edges, pose, dof = result.objective, result.edges, search.T_camera_lidar, config.search.dof
    moved = tuple(axis for axis in range(dof) if axis not in blind)
    curvature = measure_curvature(objective, pose, dof, blind)
    posterior, independent, of_range, uncertainty = None, None, None, Uncertainty.unknown()
    rivals: tuple[float, ...] = ()
    elsewhere = None
    if edges is None:
        uncertainty = _scattered(objective, pose, moved, window, config.verdict.held_translation_sigma_m)
    else:
        limits, fitted_px = config.verdict, lens_error_px(window.rig.camera_residual_px)
        lens = hypot(limits.principal_point_sigma * window.rig.camera.width, fitted_px), limits.focal_length_sigma
        assumed = Assumptions(edges.to_the_sharpest, window, held, held_to_m, lens)
        levels = assumed.levels_at(pose)
        posterior = measure_posterior(assumed, levels)
        rivals = tuple(significance_next_to(assumed, rival) for rival in result.rivals)
        # A centre that nobody searched and that is a little off displaces most edges of a near scene.
        likely = pose
        if posterior is not None and dof == TRANSLATIONS.start:
            likely = se3.perturb(pose, posterior.hypotheses[0].deviation[:6])
        independent = independent_samples_at(edges.sharp, likely)
        of_range = float(edges.significances(edges.sharp, pose)[RANGE])
        if posterior is not None:
            elsewhere = other_centre(assumed, levels, posterior, limits.max_sigma_m)
            uncertainty = _posterior_uncertainty(posterior, objective, pose, moved, window, independent.count)
            search = replace(search, T_camera_lidar=se3.perturb(pose, posterior.step(moved)))
    sigma = uncertainty.sigma
    return AssessedOptimum(
        search, blind, curvature, posterior, independent, of_range, rivals, elsewhere, uncertainty, sigma
    )
