"""Tests whether a classical mistake in the inputs explains why a window fits nothing.

Every supposition (`mistakes`) gives a pose near which the edges should fit, because what people give is only
approximate. A cover of turns about it is scored on coarse edges, and from the best poses local ascents follow finer
ones, in all six degrees of freedom. What is compared is the significance z of the edges at their ends. Poses about an
end, with about the same in view, show how z scatters where nothing fits: by σ₀, more than 1 because range edges are not
independent. The log-likelihood is z² / (2·σ₀²), as in `uncertainty.posterior` with κ = 1 / σ₀².

A mistake is named if its posterior odds against everything else are `LEAST_ODDS`: against the inputs as given, wherever
the search ended, and against the suppositions that put the camera elsewhere. So a window that fits nowhere accuses
nothing.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, log, log1p, log2, nan, pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.evidence import are_raw, compensated_for, upright_axes
from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.objective import edges as cue
from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.search.global_search import sample_reach
from coec.calibration.search.mistakes import (
    AS_GIVEN,
    AS_GIVEN_ODDS,
    BACKWARDS,
    CLOCK_OFFSET,
    COMPENSATED,
    DISTORTION,
    FOCAL_LENGTH,
    IMAGE_SCALE,
    IMAGE_SIZE,
    KINDS,
    LIDAR_AXES,
    MOTION_AXES,
    MOTION_UNIT,
    NOTICEABLE,
    OFF_BY_ONE,
    OFF_MIDDLE,
    OTHER_AXES,
    QUARTER_TURN,
    RECTIFIED,
    TRANSLATION,
    TURNED_90,
    Supposition,
    changed,
    off_middle,
    suppositions,
    suppositions_of_two,
    zoomed,
)
from coec.calibration.solver import WindowData
from coec.calibration.types import FramePair, Matrix4, Mistake, Rig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera, pixel_rad, scaled
from coec.geometry.edges.alignment import (
    LEAST_SQUARE,
    AscentStart,
    EdgeFrames,
    alignment_of_parts,
    ascend,
    frame_alignment,
    significances,
)
from coec.geometry.edges.charts import moved_by, unit_ball
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, STRENGTH_STEPS, EdgeScales
from coec.geometry.points import thinned

FRAMES = 8
"""Most pairs that are used, evenly selected."""

LEAST_PAIRS = 3
"""Fewest pairs that can accuse: one scene fits by chance, upside down for example."""

LEVELS = 4
"""Levels of edges: each twice as sharp as the one before. The coarsest is blurred by 0.6 to 1.2 degrees."""

FINEST, FINE, MEDIUM, COARSE = range(LEVELS)
"""Places of the levels."""

SCREENING_POINTS, REFINING_POINTS, ASCENT_POINTS, SETTLING_POINTS = 600, 2_000, 4_000, 20_000
"""Most range edges of the window from level to level. What fits a few of them by chance does not fit them all."""

REACH_RAD, COVER = radians(6.0), 1_000
"""Reach of the cover of turns about each supposition, and its number of poses: a degree apart, about the blur of the
coarse edges."""

STARTS, ABOUT_RAD, COVER_ABOUT = 9, radians(0.8), 40
"""Best poses of a cover, about each of which turns are scored on finer edges, their reach and their number."""

ASCENTS, ASCENDING, SETTLED = 7, 24, 8
"""Local ascents of a supposition; suppositions that have any; and those that reach the finest edges."""

NULL_POSES, NULL_RAD, NULL_INSIDE = 150, radians(15.0), 0.3
"""Poses about an end that show how z scatters where nothing fits, how far they reach, and the share of it that is left
out: the hill of an end is narrower."""

IN_VIEW, LEAST_NULL = 0.4, 20
"""These poses need this share of what the end has in view; at least so many of them count."""

LEAST_IN_VIEW = 0.05
"""An end counts only if it sees this share of the range edges of the end that sees most. A few edges at the rim of a
view fit anywhere."""

KNOWN_TO_RAD = radians(2.0)
"""Scale of the turn from what is given to what is true, as of a measured or constructed mount."""

KNOWN_TO_M = 0.2
"""Scale of the shift, likewise."""

SHIFT_M = 0.5
"""How far along each axis of the camera further ascents of the inputs as given begin: ascents lead about as far."""

LEAST_ODDS = 1000.0
"""Posterior odds from which on a mistake is named. See docs/measured.md."""

LEAST_SPEED_MPS = 2.0
"""Slower vehicles hardly move within a sweep."""

LEAST_TIMED = 6
"""Fewest pairs whose times are doubted: the time of a sweep changes little."""

LATER = (-1.0, -0.5, -0.15, 0.15, 0.5, 1.0)
"""By how many sweeps clouds may be later than their stamps say: a frame; from the middle of a sweep to its end; or the
delay of an exposure."""

NEAR_ZOOMS = (0.95, 0.97, 0.98, 0.99, 1.01, 1.02, 1.03, 1.05)
"""Ratios of the right focal length to the given one that may be taken for wrong motion."""

COARSER_ZOOMS, FINER_ZOOMS = (1.03,), (1.015, 1.007)
"""Ratios by which focal lengths are refined, in ascents from every start and at their best end: coarse edges fit to
about a thirtieth, sharp ones to a hundredth."""

SAME_ASPECT = 0.02
"""Relative difference of the aspect ratios of an image and of the same image in another size, at most."""

OTHER_SIZE, ALIKE = 0.3, 0.1
"""A principal point shows the size of the image if it is so far from the middle along both sides, as a share of half a
side, and by the same factor but for this share."""

CENTRED_ODDS = 100.0
"""Prior odds of a principal point near the middle of the image against one that is `OFF_MIDDLE`."""

GROSS = 0.7
"""A mistake is named only if the inputs as given are less significant than this share of it. What is a little off is
the subject of the posterior. See docs/measured.md."""

GROSS_OF_TWO = 0.5
"""The same for two mistakes at once, of which there are many pairs."""

NOT_CORRECTABLE = (BACKWARDS, MOTION_AXES, MOTION_UNIT, COMPENSATED, CLOCK_OFFSET, OFF_BY_ONE, DISTORTION, TRANSLATION)
"""What no pose and no lens that were tried correct."""

UNITS = ((1.0 / 3.6, 1.0), (1.0, pi / 180.0))
"""What velocities in km/h and turns in degrees per second have to be multiplied by: linear, angular."""

OTHER_UNITS = ((0.5 / 3.6, 1.0), (2.0 / 3.6, 1.0), (1.0, 0.1))
"""Factors that are none of a unit. Of sweeps and images of other instants less motion fits better, whatever the factor;
a sixtieth of a turn hardly differs from less."""

SAME_RAD = radians(5.0)
"""Poses nearer than this are one explanation."""


Null = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Mean and standard deviation of the z of each kind of edges where nothing fits, (KINDS,) each."""


@dataclass(frozen=True, slots=True, eq=False)
class Ranked:
    """A supposition, and where its edges fit best.

    Attributes:
        T_camera_lidar: (4, 4) that pose.
        significance: of the edges there, in units of its scatter.
        in_view: Σ w² of the range edges in view there.
        null: what its significance was measured against.
        log_posterior: up to a constant.
    """

    supposition: Supposition
    T_camera_lidar: Matrix4
    significance: float
    in_view: float
    null: Null
    log_posterior: float


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Edges of some sweeps, and the edges of their images at the last levels of a pyramid, from fine to coarse.

    Attributes:
        xyz_m: (3, E) float32.
        weight: (E,) float32.
        kind: (E,) uint8, of range or of reflectance.
        first_point: (F + 1,) int64.
        maps: by level, halvings of the resolution and (F, h, w) int8.
        detected: the edges of each sweep.
    """

    xyz_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    kind: NDArray[np.uint8]
    first_point: NDArray[np.int64]
    maps: tuple[tuple[int, NDArray[np.int8]], ...]
    detected: tuple[cue.DetectedEdges, ...]

    def seen_by(self, supposition: Supposition, number: int, points: int) -> EdgeFrames:
        """About `points` of them on one level."""
        level, maps = self.maps[number]
        camera = scaled(supposition.camera, 0.5**level, 0.5**level)._replace(width=maps.shape[2], height=maps.shape[1])
        maps = np.ascontiguousarray(maps[:, :, ::-1]) if supposition.mirrored else maps
        frames = EdgeFrames(camera, self.xyz_m, self.weight, self.first_point, maps)
        return frames.of_points(thinned(len(self.weight), points))

    def repaired(self, later: int) -> "Edges":
        """The edges of each sweep with the image that is so many pairs later; those at the end have none."""
        count = len(self.detected) - abs(later)
        sweeps, images = max(-later, 0), max(later, 0)
        begin, end = self.first_point[sweeps], self.first_point[sweeps + count]
        return Edges(
            np.ascontiguousarray(self.xyz_m[:, begin:end]),
            self.weight[begin:end],
            self.kind[begin:end],
            self.first_point[sweeps : sweeps + count + 1] - begin,
            tuple((level, maps[images : images + count]) for level, maps in self.maps),
            self.detected[sweeps : sweeps + count],
        )


def probable_mistake(data: WindowData, solved: Matrix4 | None) -> Mistake | None:
    """The mistake in the inputs of a window that was refused; None if none is probable. `solved` (4, 4) is where the
    search ended; None: nowhere."""
    try:
        wrong_size = _wrong_size(data)
        edges = _edges(data) if wrong_size is None else None
    except CalibrationError:
        return None
    if edges is None:
        return wrong_size or _of_other_size(data.window.rig)
    of_clouds = _other_cloud_axes(data)
    if of_clouds is not None:
        return of_clouds
    given = _of_given(edges, data.window.rig, solved)
    ranked = _ranked(edges, suppositions(data.window.rig), given)
    given = _wherever_shifted(given, ranked, data.window.rig)
    late_s, timed = _other_time(data, edges, given)
    best, *_ = ranked or [given]
    certain = _is_certain(ranked, given)
    # Where a mistake is certain, the edges fit, so that images and sweeps belong together.
    shifted = None if certain else _other_pairing(data)
    if shifted is not None and shifted.log_posterior > max(best.log_posterior, given.log_posterior) + log(LEAST_ODDS):
        return _named(shifted, given)
    if timed is not None and (timed.log_posterior > best.log_posterior or not certain):
        mistake = _named(timed, given)
        by = f"(the clouds {late_s:+.3f} s; of a bag, ?lidar_offset={late_s:.3f})"
        return replace(mistake, text=f"{mistake.text} {by}") if late_s else mistake
    if not certain:
        ranked = sorted(
            [*ranked, *_ranked(edges, suppositions_of_two(data.window.rig), given)], key=lambda one: -one.log_posterior
        )
    if _is_certain(ranked, given):
        return _named(ranked[0], given)
    return _other_translation(data, edges, ranked, given, solved) or _of_other_size(data.window.rig)


def _is_certain(ranked: Sequence[Ranked], given: Ranked) -> bool:
    """Whether the first, the most probable, is `LEAST_ODDS` more probable than all other mistakes that put the camera
    elsewhere."""
    share = GROSS_OF_TWO if ranked and ranked[0].supposition.also else GROSS
    if not ranked or given.significance > share * ranked[0].significance:
        return False
    first, others = ranked[0].supposition, ranked[1:]
    rivals = [one for one in others if one.supposition.code != first.code and not _same_place(one, ranked[0])]
    log_rivals = [given.log_posterior, *(one.log_posterior for one in rivals)]
    return ranked[0].log_posterior - float(np.logaddexp.reduce(log_rivals)) >= log(LEAST_ODDS)


def _named(best: Ranked, given: Ranked) -> Mistake:
    supposition = best.supposition
    kinds = [KINDS[code] for code in (supposition.code, supposition.also) if code]
    fit = f"with {' and '.join(kind.tried for kind in kinds)} the edges fit at {best.significance:.1f} sigma"
    return Mistake(
        supposition.code,
        f"{fit} (as given: {max(given.significance, 0.0):.1f}): {'; and '.join(kind.advice for kind in kinds)}",
        best.significance,
        given.significance,
        supposition.camera,
        supposition.T_camera_lidar,
        correctable=not supposition.mirrored and supposition.code not in NOT_CORRECTABLE,
    )


MOST_LATE_S = 0.3
"""A shift along the way of a vehicle may be that of clocks which are off by so much."""

AS_SUPPOSED = 0.25
"""A supposition explains a shift if what it leaves of it is at most this share."""


def _wherever_shifted(given: Ranked, ranked: Sequence[Ranked], rig: Rig) -> Ranked:
    """The inputs as given, also where a supposition led to that is only shifted against them."""
    pose = rig.T_camera_lidar_nominal
    shifted = (
        one
        for one in ranked
        if not one.supposition.mirrored
        and _same_lens(one, given)
        and se3.rotation_angle_rad(one.T_camera_lidar @ se3.inverse(pose)) < REACH_RAD
    )
    best = max(shifted, key=lambda one: one.significance, default=given)
    if best.significance <= given.significance:
        return given
    log_posterior = _log_posterior_as_given(best.significance, rig.camera)
    return replace(best, supposition=given.supposition, log_posterior=log_posterior)


def _other_translation(
    data: WindowData, edges: Edges, ranked: Sequence[Ranked], given: Ranked, solved: Matrix4 | None
) -> Mistake | None:
    """A translation that the search (`solved` is its end) did not come to, though the edges fit there. None if they fit
    about as well with the one that was given, if other inputs are about as probable, and if the shift may be that of a
    vehicle whose clocks are off."""
    rig, end = data.window.rig, given.T_camera_lidar
    pose = rig.T_camera_lidar_nominal if solved is None else solved
    if float(np.linalg.norm(_shift_m(pose, end))) < KNOWN_TO_M:
        return None
    turning = _local_ascent(edges, given.supposition, (pose, rig.T_camera_lidar_nominal), axes=3)
    held = _settled(edges, turning, given.null, axes=3)
    shift_m = _shift_m(held.T_camera_lidar, end)
    distance_m = float(np.linalg.norm(shift_m))
    elsewhere = (one for one in ranked if not (_same_place(one, given) and _same_lens(one, given)))
    rivals = [held.log_posterior, *(one.log_posterior for one in elsewhere)]
    log_prior = log(KINDS[TRANSLATION].odds / AS_GIVEN_ODDS) - 2.0 * log1p((distance_m / KNOWN_TO_M) ** 2)
    certain = given.log_posterior + log_prior >= float(np.logaddexp.reduce(rivals)) + log(LEAST_ODDS)
    across_m = float(np.linalg.norm(_across_the_way(data, end, shift_m)))
    if not certain or held.significance > GROSS * given.significance or across_m < max(KNOWN_TO_M, 0.5 * distance_m):
        return None
    alike = (
        one
        for one in ranked
        if _same_place(one, given)
        and _same_lens(one, given)
        and float(np.linalg.norm(_shift_m(one.supposition.T_camera_lidar, end))) <= AS_SUPPOSED * distance_m
    )
    supposed = max(alike, key=lambda one: one.log_posterior, default=None)
    supposition = replace(given.supposition, code=TRANSLATION) if supposed is None else supposed.supposition
    mistake = _named(replace(given, supposition=supposition), held)
    right_m, down_m, ahead_m = shift_m.tolist()
    where = f"(right {right_m:+.2f}, down {down_m:+.2f}, forward {ahead_m:+.2f})"
    return replace(mistake, text=f"{mistake.text}; they fit with the camera {distance_m:.2f} m from there {where}")


def _shift_m(T_from: Matrix4, T_to: Matrix4) -> NDArray[np.float64]:
    """(3,) from the camera's centre in one pose (4, 4) to that in another, along the axes of the other camera."""
    return -se3.difference(T_to, T_from)[3:]


def _across_the_way(data: WindowData, T_camera_lidar: Matrix4, shift_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of a shift (3,), camera frame, that clocks which are off by up to `MOST_LATE_S` do not make of the way
    of a vehicle that moves."""
    motions = [pair.motion for pair in data.window.pairs if pair.motion is not None]
    velocities = [sensor_twist(one, data.window.rig.T_lidar_ego)[1] for one in motions if one.reaches(LEAST_SPEED_MPS)]
    if not velocities:
        return shift_m
    way_mps = T_camera_lidar[:3, :3] @ np.mean(velocities, axis=0)
    late_s = float(way_mps @ shift_m) / max(float(way_mps @ way_mps), LEAST_SPEED_MPS**2)
    return np.asarray(shift_m - way_mps * min(max(late_s, -MOST_LATE_S), MOST_LATE_S))


def _other_cloud_axes(data: WindowData) -> Mistake | None:
    """Clouds that turn about an axis other than z, while T_camera_lidar is meant for z up. Range edges are detected
    along turns about z, so that they are detected anew in the other axes; the motion may be given in either."""
    part = _some_pairs(data)
    upright = upright_axes([pair.lidar for pair in part.window.pairs])
    if upright is None:
        return None
    rig, turn = part.window.rig, se3.transform_from(upright, np.zeros(3))
    pose, about_z = rig.T_camera_lidar_nominal, se3.transform_from(QUARTER_TURN, np.zeros(3))
    up_or_down = (np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0]))
    meant = [pose @ np.linalg.matrix_power(about_z, n) @ flip for flip in up_or_down for n in range(4)]
    moves = any(pair.motion is not None for pair in part.window.pairs)
    ends: list[Ranked] = []
    for T_lidar_ego in (rig.T_lidar_ego, turn @ rig.T_lidar_ego)[: 1 + moves]:
        edges = _edges(_in_axes(part, upright, T_lidar_ego))
        if edges is None:
            return None
        for code, T in ((AS_GIVEN, pose @ se3.inverse(turn)), *((LIDAR_AXES, T) for T in meant)):
            supposition = Supposition(code, rig.camera, T)
            end = _settled(edges, _local_ascent(edges, supposition, _screened(edges, supposition).starts))
            odds = 0.0 if code == AS_GIVEN else log(KINDS[code].odds / len(meant) / AS_GIVEN_ODDS)
            ends.append(replace(end, log_posterior=end.log_posterior + odds))
    ends.sort(key=lambda end: -end.log_posterior)
    best, given = ends[0], next(end for end in ends if end.supposition.code == AS_GIVEN)
    rivals = [given.log_posterior, *(end.log_posterior for end in ends if not _same_place(end, best))]
    certain = best.log_posterior - float(np.logaddexp.reduce(rivals)) >= log(LEAST_ODDS)
    if not certain or given.significance > GROSS * best.significance:
        return None
    mistake = _named(best, given)
    return replace(
        mistake,
        text=f"the clouds turn about their {'xyz'[int(np.abs(upright[2]).argmax())]} axis, not about z; {mistake.text}",
        T_camera_lidar=mistake.T_camera_lidar @ turn,
    )


def _in_axes(data: WindowData, rotation: NDArray[np.float64], T_lidar_ego: Matrix4) -> WindowData:
    """The window with the points of all sweeps multiplied by a rotation (3, 3), and another pose of the vehicle."""

    def turned(pair: FramePair) -> FramePair:
        xyz_m = np.ascontiguousarray(pair.lidar.xyz_m @ rotation.T.astype(np.float32))
        return replace(pair, lidar=replace(pair.lidar, xyz_m=xyz_m))

    window = data.window
    rig = replace(window.rig, T_lidar_ego=T_lidar_ego)
    return replace(data, window=replace(window, rig=rig, pairs=tuple(map(turned, window.pairs))))


def _other_time(data: WindowData, edges: Edges, given: Ranked) -> tuple[float, Ranked | None]:
    """The clouds as they are, if a driver may have compensated them for motion, or for the opposite motion, or for
    motion in other axes, or some seconds later: which fits best, and by how many seconds it is later. None if none is
    more probable by `LEAST_ODDS` than the inputs as given and than a slightly other focal length, which looks like
    motion ahead; for vehicles that hardly move, and where no times are known."""
    part = _some_pairs(data)
    sweep_s = _sweep_duration_s(part)
    moving = any(pair.motion is not None and pair.motion.reaches(LEAST_SPEED_MPS) for pair in part.window.pairs)
    if not (data.compensated and moving and sweep_s > 0.0 and len(part.window.pairs) >= LEAST_TIMED):
        return 0.0, None
    trials = [(AS_GIVEN, 0.0, part)]
    driven = [(pair.lidar, pair.motion) for pair in part.window.pairs if pair.motion is not None]
    T_lidar_ego = part.window.rig.T_lidar_ego
    if not are_raw(driven, T_lidar_ego):
        trials.append((COMPENSATED, 0.0, replace(part, compensated=False)))
    trials.append((BACKWARDS, 0.0, _with_motion(part, -np.eye(3))))
    trials += [(MOTION_UNIT, 0.0, _with_motion(part, np.eye(3), *factors)) for factors in UNITS]
    if compensated_for(driven, T_lidar_ego) is None:
        trials += [(MOTION_AXES, 0.0, _with_motion(part, rotation)) for rotation in OTHER_AXES]
    trials += [(CLOCK_OFFSET, share * sweep_s, _later(part, share * sweep_s)) for share in LATER]

    def settled(code: str, other: WindowData) -> Ranked:
        moved = replace(edges, xyz_m=_placed(other, edges.detected))
        supposition = replace(given.supposition, code=code)
        starts = [given.T_camera_lidar, supposition.T_camera_lidar]
        # The same scatter for all: only the difference counts.
        end = _settled(moved, _local_ascent(moved, supposition, starts), given.null)
        odds = 0.0 if code == AS_GIVEN else log(KINDS[code].odds / AS_GIVEN_ODDS)
        return replace(end, log_posterior=end.log_posterior + odds)

    ends = [(late_s, settled(code, other)) for code, late_s, other in trials]
    rivals, as_given, camera = [given, ends[0][1]], ends[0][1], given.supposition.camera
    late_s, best = max(ends[1:], key=lambda end: end[1].log_posterior)
    if best.log_posterior < max(rival.log_posterior for rival in rivals) + log(LEAST_ODDS):
        return 0.0, None
    for zoom in NEAR_ZOOMS:
        supposition = replace(given.supposition, camera=zoomed(camera, zoom))
        rival = _settled(edges, _local_ascent(edges, supposition, [as_given.T_camera_lidar]), given.null)
        odds = log(KINDS[FOCAL_LENGTH].odds / AS_GIVEN_ODDS)
        rivals.append(replace(rival, log_posterior=rival.log_posterior + odds))
    # Motion backwards is motion in other axes, too, of a vehicle that hardly turns.
    same = {MOTION_AXES: (MOTION_AXES, BACKWARDS), MOTION_UNIT: (MOTION_UNIT,)}.get(best.supposition.code)
    if same is not None:
        rivals += [end for _, end in ends[1:] if end.supposition.code not in same]
    if best.supposition.code == MOTION_UNIT:
        rivals += [settled(MOTION_UNIT, _with_motion(part, np.eye(3), *factors)) for factors in OTHER_UNITS]
    certain = best.log_posterior >= max(rival.log_posterior for rival in rivals) + log(LEAST_ODDS)
    return (late_s, best) if certain else (0.0, None)


def _other_pairing(data: WindowData) -> Ranked | None:
    """Images that belong to the sweep of the pair before or after their own, as of files that are listed off by one;
    None if that is not certain. Pairs in a row tell, of a vehicle that moves."""
    pairs = data.window.pairs
    first = max(0, (len(pairs) - FRAMES) // 2)
    part = replace(data, window=replace(data.window, pairs=pairs[first : first + FRAMES]))
    edges = _edges(part) if len(pairs) >= LEAST_TIMED else None
    if edges is None:
        return None
    rig, ends = data.window.rig, []
    for later in (0, 1, -1):
        supposition = Supposition(OFF_BY_ONE if later else AS_GIVEN, rig.camera, rig.T_camera_lidar_nominal)
        paired = edges.repaired(later)
        end = _settled(paired, _local_ascent(paired, supposition, _screened(paired, supposition).starts))
        odds = log(KINDS[OFF_BY_ONE].odds / AS_GIVEN_ODDS) if later else 0.0
        ends.append(replace(end, log_posterior=end.log_posterior + odds))
    given, best = ends[0], max(ends[1:], key=lambda end: end.log_posterior)
    certain = best.log_posterior - given.log_posterior >= log(LEAST_ODDS)
    return best if certain and given.significance <= GROSS * best.significance else None


def _sweep_duration_s(data: WindowData) -> float:
    """The time from the first point of a sweep to its last; 0 if it is unknown."""
    times_s, sweep = data.window.pairs[0].lidar.time_offset_s, data.window.rig.sweep
    if times_s is not None and len(times_s):
        return float(times_s.max() - times_s.min())
    return 0.0 if sweep is None else sweep.period_s


def _with_motion(
    data: WindowData, rotation: NDArray[np.float64], linear: float = 1.0, angular: float = 1.0
) -> WindowData:
    """The window with the vectors of all motion multiplied by a matrix (3, 3) and by factors."""
    pairs = (
        pair if pair.motion is None else replace(pair, motion=pair.motion.in_axes(rotation, linear, angular))
        for pair in data.window.pairs
    )
    return replace(data, window=replace(data.window, pairs=tuple(pairs)))


def _later(data: WindowData, late_s: float) -> WindowData:
    """The window with all sweeps later."""
    pairs = (
        replace(pair, lidar=replace(pair.lidar, stamp_ns=pair.lidar.stamp_ns + round(1e9 * late_s)))
        for pair in data.window.pairs
    )
    return replace(data, window=replace(data.window, pairs=tuple(pairs)))


def _wrong_size(data: WindowData) -> Mistake | None:
    """Images that are not of the size of the intrinsics."""
    camera, pose = data.window.rig.camera, data.window.rig.T_camera_lidar_nominal
    height, width = next(iter(data.greys())).shape
    if (width, height) == (camera.width, camera.height):
        return None
    sizes = f"the images have {width} x {height} px, the intrinsics are for {camera.width} x {camera.height} px"
    if (width, height) == (camera.height, camera.width):
        return Mistake(TURNED_90, f"{sizes}: {KINDS[TURNED_90].advice}", nan, nan, camera, pose, correctable=False)
    across, down = width / camera.width, height / camera.height
    if abs(across / down - 1.0) > SAME_ASPECT:
        # Which it is, and at which side, no header says.
        text = (
            f"{sizes}: the images are probably cropped, or scaled by other factors across and down, and the intrinsics "
            "are not: give those of the images as they are (of a crop, subtract what was cut from cx and cy)"
        )
        return Mistake(IMAGE_SIZE, text, nan, nan, camera, pose, correctable=False)
    fitting = scaled(camera, across, down)._replace(width=width, height=height)
    return Mistake(IMAGE_SCALE, f"{sizes}: {KINDS[IMAGE_SCALE].advice}", nan, nan, fitting, pose, correctable=True)


def _of_other_size(rig: Rig) -> Mistake | None:
    """Intrinsics whose principal point is in the middle of an image of another size, though nothing fits better with
    those of this one."""
    camera, pose = rig.camera, rig.T_camera_lidar_nominal
    across, down = (2.0 * camera.cx + 1.0) / camera.width, (2.0 * camera.cy + 1.0) / camera.height
    if min(abs(across - 1.0), abs(down - 1.0)) < OTHER_SIZE or abs(across / down - 1.0) > ALIKE:
        return None
    right, below = (camera.cx + 0.5) / across - 0.5, (camera.cy + 0.5) / across - 0.5
    fitting = changed(camera, fx=camera.fx / across, fy=camera.fy / across, cx=right, cy=below)
    text = (
        f"the principal point ({camera.cx:.0f}, {camera.cy:.0f}) is in the middle of an image {across:.2g} times as "
        f"large as {camera.width} x {camera.height} px: {KINDS[IMAGE_SCALE].advice}"
    )
    return Mistake(IMAGE_SCALE, text, nan, nan, fitting, pose, correctable=True)


def _of_given(edges: Edges, rig: Rig, solved: Matrix4 | None) -> Ranked:
    """The inputs as given, wherever they fit best, also with another translation."""
    pose = rig.T_camera_lidar_nominal
    screened = _screened(edges, Supposition(AS_GIVEN, rig.camera, pose))
    shifts = np.concatenate([SHIFT_M * np.eye(6)[3:], -SHIFT_M * np.eye(6)[3:]])
    starts = [*screened.starts, *(se3.perturb(pose, shift) for shift in shifts), *([] if solved is None else [solved])]
    return _settled(edges, _local_ascent(edges, screened.supposition, starts))


def _ranked(edges: Edges, tried: Sequence[Supposition], given: Ranked) -> list[Ranked]:
    """The inputs as they would be without a mistake, the most probable first."""
    screened = sorted((_screened(edges, supposition) for supposition in tried), key=lambda one: -one.significance)
    ascended = [_rezoomed(edges, one.supposition, one.starts, COARSER_ZOOMS) for one in screened[:ASCENDING]]
    best = sorted(ascended, key=lambda one: -one.significance)[:SETTLED]
    variants = Counter((one.code, one.also) for one in tried)
    finer = [_rezoomed(edges, one.supposition, [one.T_camera_lidar], FINER_ZOOMS) for one in best]
    ends = [_settled(edges, one) for one in finer]
    least = LEAST_IN_VIEW * max(one.in_view for one in (given, *ends))
    return _with_priors([one for one in ends if one.in_view >= least], variants)


@dataclass(frozen=True, slots=True, eq=False)
class _Screened:
    """A supposition, its largest significance on coarser edges, and the starts (4, 4) of its local ascents."""

    supposition: Supposition
    significance: float
    starts: tuple[Matrix4, ...]


def _screened(edges: Edges, supposition: Supposition) -> _Screened:
    """The best of a cover of turns. The supposed pose is a start, too, wherever it ranks."""
    poses = _with_turns(supposition.T_camera_lidar[None], REACH_RAD, COVER)
    z = significances(edges.seen_by(supposition, COARSE, SCREENING_POINTS), poses)
    starts = np.concatenate([poses[:1], poses[np.argsort(-z, kind="stable")[: STARTS - 1]]])
    poses = _with_turns(starts, ABOUT_RAD, COVER_ABOUT)
    z = significances(edges.seen_by(supposition, MEDIUM, REFINING_POINTS), poses).reshape(STARTS, COVER_ABOUT)
    starts = poses.reshape(STARTS, COVER_ABOUT, 4, 4)[np.arange(STARTS), z.argmax(axis=1)]
    best = np.argsort(-z.max(axis=1)[1:], kind="stable")[: ASCENTS - 1] + 1
    return _Screened(supposition, float(z.max()), (starts[0], *starts[best]))


def _with_turns(poses: NDArray[np.float64], reach_rad: float, count: int) -> NDArray[np.float64]:
    """(K·count, 4, 4) each of the poses (K, 4, 4), and turns of it that cover a ball."""
    box = SearchBox(reach_rad, 0.0)
    return np.concatenate([part for pose in poses for part in (pose[None], sample_reach(pose, box, count - 1))])


def _shell(pose: Matrix4) -> NDArray[np.float64]:
    """(n, 4, 4) poses about an end where nothing fits, but about as much is in view."""
    ball = unit_ball(NULL_POSES)
    turns = NULL_RAD * ball[np.linalg.norm(ball, axis=1) > NULL_INSIDE]
    return moved_by(np.ascontiguousarray(pose), turns, np.zeros_like(turns))


def _local_ascent(edges: Edges, supposition: Supposition, starts: Sequence[Matrix4], axes: int = 6) -> Ranked:
    """The best end of local ascents along the first `axes` of ξ, on ever finer edges."""
    ends = list(starts)
    for number, step_rad in ((MEDIUM, radians(0.3)), (FINE, radians(0.15))):
        frames = edges.seen_by(supposition, number, ASCENT_POINTS)
        ends = _ascended(frames, ends, step_rad, axes)
    z = [frame_alignment(frames, end).significance for end in ends]
    best = int(np.argmax(z))
    return Ranked(supposition, ends[best], z[best], 0.0, (np.zeros(cue.KINDS), np.ones(cue.KINDS)), 0.0)


def _rezoomed(edges: Edges, supposition: Supposition, starts: Sequence[Matrix4], zooms: Sequence[float]) -> Ranked:
    """The best end of local ascents, also with focal lengths between those that are tried, if the supposition has
    another one."""
    ascended = _local_ascent(edges, supposition, starts)
    if {supposition.code, supposition.also} & {FOCAL_LENGTH, RECTIFIED, DISTORTION}:
        for step in zooms:
            camera = ascended.supposition.camera
            lenses = [replace(supposition, camera=zoomed(camera, zoom)) for zoom in (step, 1.0 / step)]
            ends = (_local_ascent(edges, lens, (*starts, ascended.T_camera_lidar)) for lens in lenses)
            ascended = max(ascended, *ends, key=lambda one: one.significance)
    return ascended


def _settled(edges: Edges, ascended: Ranked, null: Null | None = None, axes: int = 6) -> Ranked:
    """The end of the local ascent on the finest edges. `null` as in `Ranked`; None: from poses about the end.

    What the edges of range and those of reflectance are worth is open, so that the log-likelihoods of both add up.
    """
    frames = edges.seen_by(ascended.supposition, FINEST, SETTLING_POINTS)
    (end,) = _ascended(frames, [ascended.T_camera_lidar], radians(0.08), axes)
    kind = edges.kind[thinned(len(edges.kind), SETTLING_POINTS)]
    sums = alignment_of_parts(frames, kind, cue.KINDS, np.concatenate([end[None], _shell(end)]))
    of_kinds = sums.square.sum(axis=1)
    z = sums.strength.sum(axis=1) / np.sqrt(np.maximum(of_kinds, LEAST_SQUARE))
    square = of_kinds.sum(axis=1)
    # What looks past the points does not scatter.
    looking = (
        1 + np.argsort(-square[1:], kind="stable")[: max(LEAST_NULL, int((square[1:] > IN_VIEW * square[0]).sum()))]
    )
    if null is None:
        null = z[looking].mean(axis=0), np.maximum(1.0, z[looking].std(axis=0))
    significance = float(np.linalg.norm(np.maximum((z[0] - null[0]) / null[1], 0.0)))
    log_posterior = _log_posterior_as_given(significance, ascended.supposition.camera)
    return Ranked(ascended.supposition, end, significance, float(square[0]), null, log_posterior)


def _ascended(frames: EdgeFrames, poses: Sequence[Matrix4], step_rad: float, axes: int) -> list[Matrix4]:
    ascents = [AscentStart(pose, 0, len(frames.maps)) for pose in poses]
    return [summit.pose for summit in ascend(frames, ascents, _moves(step_rad, axes))]


def _with_priors(ranked: Sequence[Ranked], variants: Mapping[tuple[str, str], int]) -> list[Ranked]:
    """Suppositions that put the camera to one place fit equally well. Which is the likeliest depends on how far each is
    from there, and on the odds of its kind, of which there are so many `variants`."""
    probable = []
    for one in ranked:
        alike = [other for other in ranked if _same_place(other, one) and _same_lens(other, one)]
        best = max(alike, key=lambda other: other.significance)
        difference = se3.difference(best.T_camera_lidar, one.supposition.T_camera_lidar)
        away = (difference[:3] @ difference[:3]) / KNOWN_TO_RAD**2 + (difference[3:] @ difference[3:]) / KNOWN_TO_M**2
        code, also = one.supposition.code, one.supposition.also
        odds = KINDS[code].odds * (KINDS[also].odds if also else 1.0) / variants[code, also]
        log_prior = log(odds) - 2.0 * log1p(away) + _log_prior_of_centre(one.supposition.camera)
        log_posterior = 0.5 * max(best.significance, 0.0) ** 2 + log_prior
        probable.append(replace(one, significance=best.significance, log_posterior=log_posterior))
    return sorted(probable, key=lambda one: -one.log_posterior)


def _log_posterior_as_given(significance: float, camera: Camera) -> float:
    return 0.5 * significance**2 + log(AS_GIVEN_ODDS) + _log_prior_of_centre(camera)


def _log_prior_of_centre(camera: Camera) -> float:
    return -log(CENTRED_ODDS) if off_middle(camera) > OFF_MIDDLE else 0.0


def _same_place(one: Ranked, other: Ranked) -> bool:
    """Whether two suppositions put the camera to the same place, perhaps with another lens."""
    same_images = one.supposition.mirrored == other.supposition.mirrored
    return same_images and se3.rotation_angle_rad(one.T_camera_lidar @ se3.inverse(other.T_camera_lidar)) < SAME_RAD


def _same_lens(one: Ranked, other: Ranked) -> bool:
    """Whether the lenses of two suppositions displace no pixel noticeably against each other."""
    a, b = one.supposition.camera, other.supposition.camera
    shifts = ((a.cx - b.cx) / a.width, (a.cy - b.cy) / a.height, 0.5 * (a.fx / b.fx - 1.0), 0.5 * (a.fy / b.fy - 1.0))
    return max(map(abs, shifts)) < NOTICEABLE and a == changed(b, fx=a.fx, fy=a.fy, cx=a.cx, cy=a.cy)


def _moves(step_rad: float, axes: int) -> NDArray[np.float64]:
    """(2, 2·axes, 4, 4) a step either way along each of the first `axes` of ξ, and half of it."""
    steps = se3.axis_steps(step_rad)
    return np.array(
        [
            [se3.perturbation(sign * share * steps * unit) for unit in np.eye(6)[:axes] for sign in (1.0, -1.0)]
            for share in (1.0, 0.5)
        ]
    )


def _some_pairs(data: WindowData) -> WindowData:
    """The window with at most `FRAMES` pairs."""
    pairs = data.window.pairs
    selected = sorted({round(place) for place in np.linspace(0, len(pairs) - 1, FRAMES)})
    return replace(data, window=replace(data.window, pairs=tuple(pairs[index] for index in selected)))


def _placed(data: WindowData, detected: Sequence[cue.DetectedEdges]) -> NDArray[np.float32]:
    """(3, E) edges of all pairs, motion-compensated."""
    placed = [data.points(frame, edges.index) + edges.shift_m for frame, edges in enumerate(detected)]
    return np.ascontiguousarray(np.concatenate(placed).T)


def _edges(data: WindowData) -> Edges | None:
    """Those of some pairs; None if there are too few."""
    if len(data.window.pairs) < LEAST_PAIRS:
        return None
    part = _some_pairs(data)
    detected = tuple(cue.detected_edges(part.window.pairs))
    first = np.concatenate([[0], np.cumsum([len(edges.index) for edges in detected])]).astype(np.int64)
    if first[-1] == 0:
        return None
    camera, mask = part.window.rig.camera, part.window.rig.mask
    lit = mask if mask is not None else np.ones((camera.height, camera.width), np.bool_)
    coarsest = max(LEVELS - 1, ceil(log2(cue.COARSEST_BLUR_RAD / (BLUR_SIGMA_PX * pixel_rad(camera)))))
    levels = range(coarsest + 1 - LEVELS, coarsest + 1)
    # No axis of the LiDAR is distinguished: which it is depends on the supposition.
    scales = EdgeScales(lit, levels[0], coarsest, upright=np.zeros(2))
    bands = [scales.pyramid(grey).bands for grey in part.greys()]
    most = np.int8(cue.MOST_STRENGTH * STRENGTH_STEPS)
    maps = tuple(
        (level, np.minimum(np.stack([of_frame[k] for of_frame in bands]), most)) for k, level in enumerate(levels)
    )
    weight, kind = (np.concatenate([getattr(edges, of) for edges in detected]) for of in ("weight", "kind"))
    weight *= cue.power_balance(weight, kind)[kind].astype(np.float32)
    return Edges(_placed(part, detected), weight, kind, first, maps, detected)
