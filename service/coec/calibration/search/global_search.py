"""The global stage: finds every basin of the edge cue within reach of the start, from coarse to fine, in bounded
time.

A low-discrepancy cover of the reach is scored on the coarsest level with few edges, and the better part of it with
more. The best poses that lie apart climb on ever finer levels with ever more edges. Range edges that no pose of the
reach brings into view are left out. Nothing is random: the same input gives the same basins.
"""

from dataclasses import dataclass
from math import cos, hypot, pi, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.edges import EdgeCue, in_reach
from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.geometry.edges.alignment import AscentStart, EdgeFrames, Summit, ascend, significances
from coec.geometry.edges.charts import (
    EdgeCharts,
    charted_significances,
    moved_by,
    pattern_search,
    select_separated,
    unit_ball,
)
from coec.geometry.points import lengths, thinned

COVER_RAD = radians(0.9)
"""Distance between the poses of the cover: less than the blur of the coarsest level on common lenses."""

MIN_COVER, MAX_COVER = 10_000, 150_000
"""Least and most poses of the cover: enough for the translations of a small reach, bounded time for a large one."""

BLOCK = 10_000
"""Poses that are made at once: intermediate arrays are many times as large as the poses."""

SCREENING_POINTS = 400
"""Most range edges that score the whole cover."""

CANDIDATES = 12_000
"""How many of the best poses of the cover by that score are scored with all thinned edges. The beginnings are chosen
among them; it takes many, because most neighbours of a good pose are good, too."""


@dataclass(frozen=True, slots=True)
class _Round:
    """One round of climbing.

    Attributes:
        poses: how many poses begin it, the best on its chart.
        separation_rad: how far these lie apart at least.
        chart: the coarse or the fine chart, `thinned` or not.
        points: with how many of its edges they climb at most.
        step_rad, halvings: first step, and how often it is halved.
    """

    poses: int
    separation_rad: float
    chart: int
    thinned: bool
    points: int
    step_rad: float
    halvings: int


COARSE, FINE = 0, 1
"""Places of the charts in `EdgeCue.charts` and `.thinned`."""

ROUNDS = (
    _Round(1500, radians(0.9), COARSE, thinned=True, points=800, step_rad=radians(0.45), halvings=1),
    _Round(150, radians(0.7), FINE, thinned=True, points=3_000, step_rad=radians(0.3), halvings=1),
    _Round(24, radians(0.4), FINE, thinned=False, points=10_000, step_rad=radians(0.15), halvings=1),
)
"""The steps of each round begin at the width of its blur and end at that of the next. Each round chooses its poses by
its own chart, which is how the true pose is found: on a coarse chart hundreds of layouts that happen to fit may rank
above it. See docs/measured.md."""

SHIFT_SHARE = 0.65
"""Distance of the tried shifts from the middle of the reach, as a share of its radius. See docs/measured.md."""

GOLDEN = (1.0 + sqrt(5.0)) / 2.0

CORNERS = [np.roll([0.0, a, b], k) for k in range(3) for a in (1.0, -1.0) for b in (GOLDEN, -GOLDEN)]

SHIFTS = SHIFT_SHARE * np.array([np.zeros(3), *(corner / hypot(1.0, GOLDEN) for corner in CORNERS)])
"""(13, 3) shifts that cover the unit ball: its centre, and the corners of an icosahedron. If translation is searched,
the poses that begin the first round are tried with each, because the cover has few translations for each rotation."""

SHIFTED_POSES, SHIFT_RAD = 16, radians(2.0)
"""If translation is searched, each of this many best poses is shifted either way along each axis by this angle as seen
from the nearest edges, and the shifted poses climb again. This is needed because poses of one rotation do not count as
apart, so their translation was chosen on the coarse chart, which hardly shows it. See docs/measured.md."""

SHIFT_TURNS, SHIFT_SPAN_M = 3, 0.5
"""How often that is done at least, each time with the best poses so far that were not shifted yet; and how far it leads
at least: the translation of the cover may be that far off, which in a room is many shifts."""

SHIFT_RANKS, LEAST_SHIFTED = 60, 0.7
"""A pose that so many better ones lie apart from is not shifted, nor one of less than this share of the highest
significance. See docs/measured.md."""

TURNED_FOR = 1.4
"""A shift to the side or upwards is also tried with the turn that leaves things at this multiple of the distance of the
nearest edges where they are in the image. Along this valley turns and shifts make up for each other, and a climb along
single axes halts in it."""

NEAREST_PERCENT = 25
"""This percentile of the ranges of the edges is the distance of the nearest ones. It is seven metres in streets
(`se3.METRES_PER_RADIAN`) and counts as no more."""

LEAST_NEAR_M = 1.0
"""The least such distance: bounds the number of shifts."""

SHIFTED = _Round(10 * SHIFTED_POSES, 0.0, FINE, thinned=False, points=4_000, step_rad=radians(0.15), halvings=1)
"""How the shifted poses climb: as in the last round, with as many edges as it takes to see a quarter of a metre."""


@dataclass(frozen=True, slots=True, eq=False)
class Basin:
    """A local maximum of the edge cue: its pose (4, 4) and its significance on the fine chart."""

    T_camera_lidar: Matrix4
    significance: float


AT_RIM = 0.98
"""Share of the reach beyond which a pose counts as lying on its rim, because the maximum may lie outside."""


def at_rim(pose: Matrix4, start: Matrix4, reach: SearchBox) -> bool:
    """Whether a pose (4, 4) lies on or outside the rim of the ball of poses about `start` that was searched."""
    difference = se3.difference(pose, start)
    turn_rad, shift_m = float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))
    return turn_rad > AT_RIM * reach.rotation_rad or (
        reach.translation_m > 0.0 and shift_m > AT_RIM * reach.translation_m
    )


def find_basins(edges: EdgeCue, start: Matrix4, reach: SearchBox) -> list[Basin]:
    """The most significant basins whose poses lie within `reach` of `start` (4, 4), best first.

    The reach is a ball: a rotation (rad) about any axis, and a shift (m) in any direction (0: rotation only).
    """
    thinned_to = [in_reach(charts, edges.half_view_rad, start, reach) for charts in edges.thinned]
    finest = in_reach(edges.charts[FINE], edges.half_view_rad, start, reach)
    poses = _promising(thinned_to[ROUNDS[0].chart], start, reach)
    for number in ROUNDS:
        charts = thinned_to[number.chart] if number.thinned else finest
        poses = poses[separated(poses, charted_significances(charts, poses), number.poses, number.separation_rad)]
        poses, z = _pattern_searched(charts, poses, number, start, reach)
    near_m = _near_m(finest)
    shift_m = near_m * SHIFT_RAD
    turns = max(SHIFT_TURNS, round(SHIFT_SPAN_M / shift_m)) if reach.translation_m > 0.0 else 0
    are_shifted = np.zeros(len(poses), np.bool_)
    for _ in range(turns):
        best = separated(poses, z, SHIFT_RANKS, ROUNDS[-1].separation_rad)
        best = best[~are_shifted[best] & (z[best] >= LEAST_SHIFTED * z.max())][:SHIFTED_POSES]
        if not len(best):
            break
        are_shifted[best] = True
        moved = _within(shifted(poses[best], shift_m, TURNED_FOR * near_m), start, reach)
        more, _ = _pattern_searched(finest, moved, SHIFTED, start, reach)
        poses, z = np.concatenate([poses, more]), np.concatenate([z, charted_significances(finest, more)])
        are_shifted = np.concatenate([are_shifted, np.zeros(len(more), np.bool_)])
    z = charted_significances(finest, poses)
    return [Basin(poses[k], float(z[k])) for k in separated(poses, z, len(poses), ROUNDS[-1].separation_rad)]


def basin_next_to(edges: EdgeCue, pose: Matrix4, reach: SearchBox) -> Matrix4:
    """The pose (4, 4) to which the rounds lead from `pose` (4, 4), within `reach` of it, even if other poses rank
    higher."""
    end = pose[None]
    for number in ROUNDS:
        charts = (edges.thinned if number.thinned else edges.charts)[number.chart]
        end, _ = _pattern_searched(in_reach(charts, edges.half_view_rad, pose, reach), end, number, pose, reach)
    return np.asarray(end[0])


SUMMIT_SPACING_RAD = (radians(1.0), radians(2.0), radians(4.0))
"""Shifts that lead to other summits of a basin, as angles seen from the nearest edges. See docs/measured.md."""

SUMMIT_TURNED_RAD = (radians(1.0), radians(2.0), radians(3.0))
"""Turns that do. See docs/measured.md."""

SUMMIT_LEADING_RAD = (radians(0.4), radians(0.2), radians(0.1))
SUMMIT_STEPS_RAD = (radians(0.2), radians(0.1), radians(0.05), radians(0.025))
"""Steps of the climbs from there: on the finest band, and then on the sharpest edges."""

SAME_SUMMIT_RAD = radians(0.1)
"""Climbs that come as near to each other go on as one. See docs/measured.md."""

SUMMIT_REACH = SearchBox(radians(5.0), 0.5)
"""How far these climbs may lead."""

SUMMIT_POINTS = 5_000
"""Most range edges of these climbs."""

SUMMIT_TURNS = 3
"""How often they begin again beside the end of the last ones."""

SUMMIT_MARGIN, TURNED_MARGIN = 1.0, 3.0
"""How much more significant another summit has to be, standard deviations: less may be chance. If the centre is
held, it has to be more, because its error displaces the sharpest edges. See docs/measured.md."""


def highest_summit(edges: EdgeCue, pose: Matrix4, held_m: float | None) -> Matrix4:
    """The most significant summit (4, 4) on the sharpest edges that climbs from `pose` (4, 4) and from beside it lead
    to.

    A basin may have several summits: where all is near, turns and shifts make up for each other along a valley, and
    each edge of a pattern along it meets one image edge after the other; where all is far ahead, a roll displaces
    little. Blurred edges show one summit where these are. `held_m` is the standard deviation of a centre of the camera
    that is held. If that displaces near edges by more than they are wide, the sharpest ones tell no summits apart.
    """
    seen = in_reach(edges.sharp, edges.half_view_rad, pose, SUMMIT_REACH)
    few = seen.of_points(thinned(len(seen.weight), SUMMIT_POINTS))
    near_m, unit, turns_only = _near_m(few), np.eye(6), held_m is not None
    if held_m is not None and held_m > near_m * edges.blur_rad:
        return pose
    turns, shifts = unit[:3], near_m * unit[3:]
    one_way = turns if turns_only else np.array([*turns, *shifts, shifts[0] - turns[1], shifts[1] + turns[0]])
    turned = np.array([angle * turn for angle in SUMMIT_TURNED_RAD for turn in (*turns, *-turns)])
    of_band, of_sharp = (
        np.array([[se3.perturbation(step * move) for move in (*one_way, *-one_way)] for step in steps_rad])
        for steps_rad in (SUMMIT_LEADING_RAD, SUMMIT_STEPS_RAD)
    )
    band = in_reach(edges.bands[0], edges.half_view_rad, pose, SUMMIT_REACH)
    band = band.of_points(thinned(len(band.weight), SUMMIT_POINTS))
    highest = float(significances(seen, pose[None])[0])
    for _ in range(SUMMIT_TURNS):
        starts = [pose, *(se3.perturb(pose, turn) for turn in turned)]
        if not turns_only:
            starts.extend(other for turn in SUMMIT_SPACING_RAD for other in shifted(pose[None], near_m * turn, near_m))
        ends = np.array(starts)
        for frames, moves in ((band, of_band[:1]), (band, of_band[1:]), (few, of_sharp)):
            ends = _different(ascend(frames, [AscentStart(end, 0, len(frames.maps)) for end in ends], moves), near_m)
        z = significances(seen, ends)
        best = int(np.argmax(z))
        if z[best] <= highest + (TURNED_MARGIN if turns_only else SUMMIT_MARGIN):
            break
        pose, highest = ends[best], float(z[best])
    return pose


def _different(summits: list[Summit], near_m: float) -> NDArray[np.float64]:
    """(n, 4, 4) the poses of some summits, the highest of those that lie within `SAME_SUMMIT_RAD`."""
    poses = np.array([summit.pose for summit in sorted(summits, key=lambda summit: -summit.score)])
    offsets = poses[:, None, :3] - poses[:, :3]
    # A small turn by an angle changes a rotation matrix by √2 of it (Frobenius).
    turns_rad = np.sqrt(0.5 * np.sum(offsets[..., :3] ** 2, axis=(2, 3)))
    shifts_rad = np.sqrt(np.sum(offsets[..., 3] ** 2, axis=2)) / near_m
    same, retained = np.maximum(turns_rad, shifts_rad) <= SAME_SUMMIT_RAD, np.zeros(len(poses), np.bool_)
    for k in range(len(poses)):
        retained[k] = not (same[k] & retained).any()
    return poses[retained]


def sample_reach(start: Matrix4, reach: SearchBox, count: int) -> NDArray[np.float64]:
    """(count, 4, 4) poses that cover the reach evenly."""
    return _Cover(start, reach, count).poses(np.arange(count))


class _Cover:
    """A number of poses that cover the reach evenly. They are made when needed, because all at once would take more
    memory than the edges of a window."""

    def __init__(self, start: Matrix4, reach: SearchBox, count: int) -> None:
        self._start, self._reach, self._ball = np.ascontiguousarray(start), reach, unit_ball(count)

    def poses(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """(n, 4, 4) the poses with the given numbers."""
        # Translations come in another order, so that they are not correlated with the rotations.
        turn_rad, shift_m = self._ball[index], self._ball[(index * 7919) % len(self._ball)]
        return moved_by(self._start, turn_rad * self._reach.rotation_rad, shift_m * self._reach.translation_m)


def _promising(charts: EdgeCharts, start: Matrix4, reach: SearchBox) -> NDArray[np.float64]:
    """The poses that begin the first round, out of the cover and the start."""
    volume = 4.0 / 3.0 * pi * (reach.rotation_rad / COVER_RAD) ** 3
    count = int(min(max(volume, MIN_COVER), MAX_COVER))
    cover = _Cover(start, reach, count)
    blocks = np.array_split(np.arange(count), -(-count // BLOCK))
    screen = charts.at_most(SCREENING_POINTS)
    z = np.concatenate([charted_significances(screen, cover.poses(block)) for block in blocks])
    best = np.flatnonzero(z >= np.partition(z, -min(CANDIDATES, count))[-min(CANDIDATES, count)])
    # Filled in place, because a second copy of all poses would be the peak of memory of a solve.
    poses = np.empty((1 + len(best), 4, 4))
    poses[0] = start
    for begin in range(0, len(best), BLOCK):
        poses[1 + begin : 1 + begin + BLOCK] = cover.poses(best[begin : begin + BLOCK])
    z = charted_significances(charts, poses)
    poses = poses[separated(poses, z, ROUNDS[0].poses, ROUNDS[0].separation_rad)]
    return poses if reach.translation_m == 0.0 else _with_best_shifts(screen, poses, start, reach)


def _with_best_shifts(
    charts: EdgeCharts, poses: NDArray[np.float64], start: Matrix4, reach: SearchBox
) -> NDArray[np.float64]:
    """(K, 4, 4) each of some poses (K, 4, 4) with its own shift from the start, or that of `SHIFTS` which fits best."""
    tried = np.repeat(poses[:, None], 1 + len(SHIFTS), axis=1)
    unmoved_m = -poses[:, :3, :3] @ se3.inverse(start)[:3, 3]
    tried[:, 1:, :3, 3] = unmoved_m[:, None] + reach.translation_m * SHIFTS
    z = charted_significances(charts, tried.reshape(-1, 4, 4)).reshape(len(poses), -1)
    return np.asarray(tried[np.arange(len(poses)), z.argmax(axis=1)])


def _near_m(edges: EdgeCharts | EdgeFrames) -> float:
    nearest_m = float(np.percentile(lengths(edges.xyz_m.T), NEAREST_PERCENT)) if len(edges.weight) else np.inf
    return min(max(nearest_m, LEAST_NEAR_M), se3.METRES_PER_RADIAN)


def shifted(poses: NDArray[np.float64], shift_m: float, turned_for_m: float) -> NDArray[np.float64]:
    """(10·K, 4, 4) the poses (K, 4, 4), each shifted either way along each camera axis, and sideways and upwards also
    with the turn that makes up for it."""
    turn_rad = shift_m / turned_for_m
    x, y, z = shift_m * np.eye(6)[3:]
    one_way = np.array([x, x - turn_rad * np.eye(6)[1], y, y + turn_rad * np.eye(6)[0], z])
    return np.array([se3.perturb(pose, step) for pose in poses for step in (*one_way, *-one_way)])


def _within(poses: NDArray[np.float64], start: Matrix4, reach: SearchBox) -> NDArray[np.float64]:
    """Those of some poses (K, 4, 4) whose shift is within the reach."""
    unmoved_m = np.einsum("kij,j->ki", poses[:, :3, :3], se3.inverse(start)[:3, 3])
    return np.asarray(poses[np.linalg.norm(poses[:, :3, 3] + unmoved_m, axis=1) <= reach.translation_m])


def _pattern_searched(
    charts: EdgeCharts, poses: NDArray[np.float64], number: _Round, start: Matrix4, reach: SearchBox
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    steps = se3.axis_steps(number.step_rad, _near_m(charts))
    if reach.translation_m == 0.0:
        steps[3:] = 0.0
    few = charts.at_most(number.points)
    return pattern_search(
        few, poses, steps, number.halvings, start, np.array([reach.rotation_rad, reach.translation_m])
    )


def separated(
    poses: NDArray[np.float64], z: NDArray[np.float64], count: int, separation_rad: float
) -> NDArray[np.int64]:
    """Indices of the best poses, best first, no two closer in rotation than `separation_rad`."""
    return np.asarray(select_separated(poses, np.argsort(-z, kind="stable"), count, 1.0 + 2.0 * cos(separation_rad)))
