"""How far an optimum may be off, all in all: by chance (the sandwich covariance J⁻¹·V·J⁻¹, Huber 1967), by ridges that
are wider than their top, by other modes, by errors that all frames share, and by assumptions that the window itself
contradicts.

The sandwich has V from the scatter of the score between frames and between sectors of the image. Both are needed: all
frames of a standing vehicle show the same and so agree on anything, but its sectors, which show different things, do
not; and a wrong lens acts on a sector in every frame alike.

A covariance describes a hill only at its top. A ridge stays flat where a paraboloid with the same top has fallen, and
the optimum may lie anywhere on it. So the hill is walked down until its drop is certain; how wide it counts follows
from how certain the drop is on the way.

Other modes are poses that the window cannot distinguish from the optimum: those at which a search ended or began, the
one next to the camera's place before the search, and the profile of the objective along each translation. A shift and a
turn make up for each other on all but near things, along a ridge that bends: a straight walk from its top leaves it.
Many independent samples make the ridge short. A single one leaves dents in it, any of which may be the top. So the
ridge is followed as far as an accepted translation may be off. The mode next to the known place is a rival of the pose
found, whatever way the search took, because chance makes several hills if few things are seen again and again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import exp, fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective import landscape as surface
from coec.calibration.objective.edges import IndependentSamples, independent_samples_at
from coec.calibration.objective.landscape import Curvature, Landscape, measure_curvature
from coec.calibration.objective.mutual_information import Divisible
from coec.calibration.search import local_search
from coec.calibration.search.local_search import TRANSLATIONS, FixedCentre, SearchResult
from coec.calibration.solver import EstimatorResult, Rivals, WindowData
from coec.calibration.types import Matrix4, Silence, Uncertainty, Window
from coec.calibration.uncertainty import nuisance_parameters as nuisance
from coec.calibration.uncertainty.nuisance_parameters import SHIFTS, ParameterSubset, RelaxedAssumption
from coec.calibration.uncertainty.systematic import sensor_resolution, systematic_shifts
from coec.config import CalibrationConfig
from coec.geometry import se3
from coec.geometry.edges.alignment import EdgeFrames
from coec.geometry.linalg import Rows, congruent, eigen, inverted, solved

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


SAME_HILL = 3.0
"""A pose within this many standard deviations belongs to the hill of the optimum, whose width is counted already."""


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
    search = local_search.near(config.search, objective)
    ends = []
    for axis in moved:
        if axis not in TRANSLATIONS:
            continue
        for way in SIGNS:
            displaced = se3.perturb(pose, way * config.verdict.max_sigma_m * np.eye(6)[axis])
            constraint = FixedCentre((axis, *held), displaced)
            end = local_search.polish(objective, displaced, search, Silence(), 0, constraint)
            ends.append(end.T_camera_lidar)
    return Rivals(objective, pose, tuple(ends))


def mode_next_to_prior(edges: Sequence[EdgeFrames], window: Window, pose: Matrix4) -> Matrix4 | None:
    """The pose (4, 4) of the most significant alignment next to the camera's centre at the window's start. The climb
    begins with the rotation of `pose` (4, 4); it first turns only, then also shifts. None if the edges in view
    determine no pose.

    `edges` are those of the window, from coarser levels that lead there to the sharpest one.
    """
    start_pose = FixedCentre(tuple(SHIFTS), window.T_camera_lidar_start)(pose)
    levels = nuisance.assumed_levels(edges, window, start_pose)
    nothing, turns, every = np.zeros(nuisance.SIZE), tuple(nuisance.TURNS), (*nuisance.TURNS, *SHIFTS)
    try:
        turned = nuisance.local_ascent(levels, ParameterSubset.of(levels[-1], nothing, turns, ()), nothing)
        deviation = nuisance.local_ascent(levels, ParameterSubset.of(levels[-1], turned, every, ()), turned)
    except ValueError:
        return None
    return se3.perturb(start_pose, deviation[: SHIFTS.stop])


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

    `rivals` are other summits that the search found. `relaxed` is how the pose moves when assumptions are set free. A
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


@dataclass(frozen=True, slots=True, eq=False)
class AssessedOptimum:
    """An optimum and what the window says of it.

    Attributes:
        search: where the search ended.
        unobservable: the translations (places in ξ) that were searched but that the window does not determine. Along
            these the camera's centre is that of the start.
        curvature: of the objective at the pose.
        relaxed: what changes when the assumptions (held centre, clocks, lens) are relaxed one by one.
        independent: how many independent frames the window is worth; None if the estimator used no edges.
        uncertainty: of the pose.
        sigma: (6,) its standard deviations, rad and m; NaN on axes that were not determined.
    """

    search: SearchResult
    unobservable: tuple[int, ...]
    curvature: Curvature
    relaxed: tuple[RelaxedAssumption, ...]
    independent: IndependentSamples | None
    uncertainty: Uncertainty
    sigma: NDArray[np.float64]


def assess_optimum(result: EstimatorResult, data: WindowData, config: CalibrationConfig) -> AssessedOptimum:
    """The uncertainty of what an estimator found. If it shows that the window does not determine a translation, the
    search is finished again with the camera's centre held there, and its new end is assessed."""
    start, dof, limits = data.window.T_camera_lidar_start, config.search.dof, config.verdict
    held = tuple(axis for axis in TRANSLATIONS if axis >= dof)
    rivals = (*result.rivals, *_prior_mode(result, data.window, dof))
    optimum = _assessed(result, result.search, rivals, (), held, limits.held_translation_sigma_m, data.window, config)
    blind = local_search.unobservable(optimum.curvature, optimum.sigma, dof, limits)
    if not blind:
        return optimum
    search = local_search.without(blind, result.search, result.objective, start, config.search, data.progress)
    return _assessed(result, search, rivals, blind, blind, limits.max_sigma_m, data.window, config)


def _assessed(
    result: EstimatorResult,
    search: SearchResult,
    rivals: tuple[Rivals, ...],
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
    # From bands that still feel a lens which is off by pixels to the sharpest edges.
    relaxed = () if edges is None else nuisance.relax_assumptions(edges.to_the_sharpest, window, pose, held, held_to_m)
    independent = None if edges is None else independent_samples_at(edges.sharp, pose)
    if independent is not None and independent.count < len(moved):
        # Frames that are worth fewer samples than there are axes leave dents in every ridge of the objective.
        rivals = (*rivals, translation_profile(objective, pose, moved, config))
    held_m = config.verdict.held_translation_sigma_m
    uncertainty = measure_uncertainty(objective, pose, moved, rivals, relaxed, window, held_m)
    if independent is not None:
        uncertainty = replace(uncertainty, independent_samples=independent.count)
    return AssessedOptimum(search, blind, curvature, relaxed, independent, uncertainty, uncertainty.sigma)


def _prior_mode(result: EstimatorResult, window: Window, dof: int) -> tuple[Rivals, ...]:
    """The summit next to the camera's place before the search, as a rival of the pose found. Empty without edges,
    without searched translations, or without such a summit."""
    if result.edges is None or dof <= TRANSLATIONS.start:
        return ()
    pose = result.search.T_camera_lidar
    summit = mode_next_to_prior(result.edges.to_the_sharpest, window, pose)
    return () if summit is None else (Rivals(result.objective, pose, (summit,)),)
