"""The nuisance parameters of a window, and what changes when they are relaxed: where the camera's centre is, when the
exposures were, and through which lens they were taken. Does the window contradict what was assumed?

A held camera centre, trusted clocks and a lens taken from a sheet, if wrong, leave a pattern in the residuals that no
pose removes. They are relaxed one after the other, the earlier ones staying free: the centre, then the clocks, then the
lens (a nested likelihood ratio, Wilks 1938, on the sharpest edges). The gain is compared with the scatter of frames and
sectors of the image.

A parameter that is relaxed moves together with the pose that answers it. For example, a principal point further right
acts on most of the image like a camera turned to the left; only what the turn does not explain shows the principal
point.

Two cases are weighed by Bayes' rule: the assumption is right, within its known accuracy; or it is wrong, and the window
is the only evidence. The error that this adds to the pose is the root mean square of how far the pose moves in each
case. Nothing jumps: a slightly surer gain counts slightly more. Where ascents have several ends, the one is taken that
moves the pose farthest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import fsum, hypot, radians, sqrt, tanh

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.objective.edges import in_reach
from coec.calibration.objective.landscape import certainty
from coec.calibration.objective.mutual_information import COLUMNS, ROWS, SearchBox, sectors
from coec.calibration.search.local_search import Box, maximum_in
from coec.calibration.types import Matrix4, Window
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.geometry.edges.alignment import LEAST_SQUARE, EdgeFrames, alignment_of_parts, alignments, alignments_of_late
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, SHARP_SIGMA_PX, VOID
from coec.geometry.linalg import inverted
from coec.geometry.points import lengths, thinned
from coec.geometry.projection import half_field_of_view_rad, project

TURNS, SHIFTS, CLOCKS, LENS = range(3), range(3, 6), range(6, 9), range(9, 12)
"""Places in a deviation (12,). Turns and shifts: the perturbation ξ of the pose, rad and m. Clocks, s: by how much the
camera was exposed later than assumed, by how much more at the end of the window than at its beginning, and by how much
more in the last row than in the first. Lens: by how much the principal point lies further right and down, in focal
lengths, and the share by which the focal length is longer."""

LATE, PRINCIPAL_POINT = CLOCKS[:2], LENS[:2]
"""Places that a move of the pose answers almost entirely: on a straight way a late camera looks like one elsewhere on
the way, and a principal point further right looks like a camera that is turned to the left."""

SIZE = 12

REACH = np.array([radians(3.0)] * 3 + [0.4] * 3 + [0.08, 0.08, 0.06] + [0.04, 0.04, 0.05])
"""How far each place may be from what was assumed. The mount: as far as the edges of the coarsest band lead back.
Clocks: most of a frame at 10 Hz, and the readout of the slowest rolling shutters. The lens: beyond what a focus ring or
another unit of the same type does."""

STEP_RAD = 1e-3
"""Difference step, as a share of the range by which a point is shifted: about a pixel or less."""

LEADING_POINTS, SETTLING_POINTS = 4_000, 20_000
"""Most range edges that are used on a level that leads to the next one, and on the sharpest: some four hundred
evaluations of them cost as much as ten of the search's. With half as many, the sharpest level is a third less certain
of a principal point that is four pixels off in a fisheye."""

SEEN = SearchBox(radians(15.0), 4.0)
"""How far from the assumed pose range edges are kept: twice the reach of its turns about three axes at once, and what
passes at 40 m/s within the reach of the clocks. The edge of the coarsest map is known only to some degrees."""

SLOWEST_MPS = 1.0
"""Below this speed a clock that is off by a tenth of a second moves nothing by more than 10 cm, and everything
alike."""


@dataclass(frozen=True, slots=True, eq=False)
class AssumedEdges:
    """The range edges of a window on the image edges of one level, as assumed, and what it takes to move them to where
    they lie under other assumptions.

    Attributes:
        frames: the edges as assumed.
        pose: (4, 4) from which deviations are counted.
        passing: (3, E) how fast standing things pass the LiDAR, m/s, LiDAR frame.
        share: (3, E) the share of each clock's error at each range edge; 0 without ego-motion.
    """

    frames: EdgeFrames
    pose: Matrix4
    passing: NDArray[np.float32]
    share: NDArray[np.float32]

    def otherwise(self, deviation: NDArray[np.float64]) -> tuple[EdgeFrames, Matrix4]:
        """The edges and the pose (4, 4) after a deviation (12,)."""
        frames, later_s = self._through_lens(deviation), deviation[CLOCKS].astype(np.float32)
        if later_s.any():
            late = later_s[0] * self.share[0] + later_s[1] * self.share[1] + later_s[2] * self.share[2]
            frames = replace(frames, xyz_m=frames.xyz_m + self.passing * late)
        return frames, se3.perturb(self.pose, deviation[: SHIFTS.stop])

    def _through_lens(self, deviation: NDArray[np.float64]) -> EdgeFrames:
        frames = self.frames
        if not deviation[LENS].any():
            return frames
        return replace(frames, camera=_through(frames.camera, deviation[LENS]))

    def thinned(self, at_most: int) -> AssumedEdges:
        """The same with at most about this many range edges."""
        indices = thinned(len(self.frames.weight), at_most)
        return replace(
            self, frames=self.frames.of_points(indices), passing=self.passing[:, indices], share=self.share[:, indices]
        )

    def significances(self, deviations: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K,) of the alignment at each of K deviations (K, 12)."""
        values = np.empty(len(deviations))
        for through in _of_one_lens(deviations):
            some = deviations[through]
            poses = np.array([se3.perturb(self.pose, deviation[: SHIFTS.stop]) for deviation in some])
            frames, late_s = self._through_lens(some[0]), some[:, CLOCKS].astype(np.float32)
            if late_s.any():
                at = alignments_of_late(frames, self.passing, self.share, late_s, poses)
            else:
                at = alignments(frames, poses)
            values[through] = [at.at(k).significance for k in range(len(some))]
        return values

    def pixels(self, deviation: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(E, 2) the pixels at which the range edges lie at a deviation (12,), and (E,) whether they have one."""
        frames, T = self.otherwise(deviation)
        p_camera = np.einsum("ij,jn->ni", T[:3, :3], frames.xyz_m.astype(np.float64)) + T[:3, 3]
        return project(frames.camera, p_camera)

    def moved(
        self, deviation: NDArray[np.float64], places: tuple[int, ...]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(n, E, 2) how far each of n places of a deviation moves the range edges, at a deviation (12,), pixels per
        unit; and (E,) for which of the range edges that is known.

        It multiplies how the pixel follows the point, by differences, with how the point follows a place.
        """
        frames, T = self.otherwise(deviation)
        p_camera = np.einsum("ij,jn->ni", T[:3, :3], frames.xyz_m.astype(np.float64)) + T[:3, 3]
        uv_px, seen = project(frames.camera, p_camera)
        height, width = self.frames.maps.shape[1:]
        seen = seen & (uv_px >= 0.0).all(axis=1) & (uv_px <= [width - 1.0, height - 1.0]).all(axis=1)
        # A deviation first turns about the camera as assumed, and then shifts.
        turned_m = p_camera - deviation[SHIFTS]
        step_m = STEP_RAD * lengths(p_camera)
        follows = np.empty((len(uv_px), 2, 3))
        for axis, unit in enumerate(np.eye(3)):
            (ahead, seen_ahead), (behind, seen_behind) = (
                project(frames.camera, p_camera + sign * step_m[:, None] * unit) for sign in (1.0, -1.0)
            )
            follows[:, :, axis] = (ahead - behind) / np.maximum(2.0 * step_m, 1e-9)[:, None]
            seen = seen & seen_ahead & seen_behind
        columns = np.empty((len(places), len(uv_px), 2))
        for column, place in zip(columns, places, strict=True):
            if place in LENS:
                column[:] = _moved_by_lens(self.frames.camera, frames.camera, uv_px, place)
            else:
                column[:] = np.sum(follows * self._moved_by(place, turned_m, T)[:, None, :], axis=2)
        return columns, seen

    def _moved_by(self, place: int, turned_m: NDArray[np.float64], T: Matrix4) -> NDArray[np.float64]:
        """(E, 3) how points move with one place of a deviation, per unit, at a pose (4, 4). `turned_m` (E, 3) are the
        points in the camera frame, turned and not yet shifted."""
        if place in TURNS:
            return np.cross(np.eye(3)[place], turned_m)
        if place in SHIFTS:
            return np.broadcast_to(np.eye(3)[place - SHIFTS.start], turned_m.shape)
        passing_m = (self.passing * self.share[place - CLOCKS.start]).astype(np.float64)
        return np.asarray(np.einsum("ij,jn->ni", T[:3, :3], passing_m))


def _of_one_lens(deviations: NDArray[np.float64]) -> list[list[int]]:
    """For each lens, the indices of those of K deviations (K, 12) that have that lens."""
    places: dict[bytes, list[int]] = {}
    for place, lens in enumerate(deviations[:, LENS]):
        places.setdefault(lens.tobytes(), []).append(place)
    return list(places.values())


def assumed_levels(edges: Sequence[EdgeFrames], window: Window, pose: Matrix4) -> list[AssumedEdges]:
    """The levels of a window at `pose` (4, 4), from `edges` of coarser levels that lead there to the sharpest one.
    Edges that no deviation brings into view are left out."""
    counts = [*([LEADING_POINTS] * (len(edges) - 1)), SETTLING_POINTS]
    half_view_rad = half_field_of_view_rad(edges[0].camera, edges[0].maps[0] != VOID)
    levels = [level.of_points(thinned(len(level.weight), count)) for level, count in zip(edges, counts, strict=True)]
    return [_assumed_edges(in_reach(level, half_view_rad, pose, SEEN), window, pose) for level in levels]


def _assumed_edges(frames: EdgeFrames, window: Window, pose: Matrix4) -> AssumedEdges:
    """The range edges of one level of a window at `pose` (4, 4)."""
    counts, pairs = np.diff(frames.first_point), window.pairs
    frame = np.repeat(np.arange(len(pairs)), counts)
    velocity, turn, moves = np.zeros((len(pairs), 3)), np.zeros((len(pairs), 3)), np.zeros(len(pairs))
    for index, pair in enumerate(pairs):
        if pair.motion is not None:
            turn[index], velocity[index] = sensor_twist(pair.motion, window.rig.T_lidar_ego)
            moves[index] = 1.0
    xyz_m = frames.xyz_m.T.astype(np.float64)
    passing = -(velocity[frame] + np.cross(turn[frame], xyz_m))
    begin_ns, end_ns = pairs[0].stamp_ns, pairs[-1].stamp_ns
    elapsed = np.array([(pair.stamp_ns - begin_ns) / max(end_ns - begin_ns, 1) - 0.5 for pair in pairs])
    assumed = AssumedEdges(frames, pose, passing.T.astype(np.float32, order="C"), np.zeros((3, len(frame)), np.float32))
    uv_px, _ = assumed.pixels(np.zeros(SIZE))
    row = np.clip(uv_px[:, 1] / frames.camera.height - 0.5, -0.5, 0.5)
    share = moves[frame] * np.stack([np.ones(len(frame)), elapsed[frame], row])
    return replace(assumed, share=share.astype(np.float32))


def moves(window: Window) -> bool:
    """Whether the vehicle moves enough for the error of a clock to show."""
    return any(pair.motion is not None and pair.motion.reaches(SLOWEST_MPS) for pair in window.pairs)


def _moved_by_lens(assumed: Camera, camera: Camera, uv_px: NDArray[np.float64], place: int) -> NDArray[np.float64]:
    """(E, 2) how pixels (E, 2) of a camera move with one place of the lens, in units of the deviation."""
    moved = np.zeros_like(uv_px)
    if place == LENS.start:
        moved[:, 0] = assumed.fx
    elif place == LENS.start + 1:
        moved[:, 1] = assumed.fy
    else:
        moved[:, 0] = (uv_px[:, 0] - camera.cx) * assumed.fx / camera.fx
        moved[:, 1] = (uv_px[:, 1] - camera.cy) * assumed.fy / camera.fy
    return moved


def _through(camera: Camera, lens: NDArray[np.float64]) -> Camera:
    right, down, longer = lens.tolist()
    return camera._replace(
        cx=camera.cx + right * camera.fx,
        cy=camera.cy + down * camera.fy,
        fx=camera.fx * (1.0 + longer),
        fy=camera.fy * (1.0 + longer),
    )


LEADING, SETTLING = 0.1, 0.03
"""A climb ends within this share of its first step, on a level that leads to the next one and on the sharpest. The
second is small because the hill is a ridge: an offset of the clocks and a shift along the way differ by little."""

POINTS = 5_000
"""Most range edges from which the directions are computed: least squares over twelve unknowns needs no more."""

MAX_EVALUATIONS = 200
"""Bound on one climb; it takes 20 to 80."""

LATTICE = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Where further climbs may begin along a ridge, in halves of its reach."""

BEGINS = 2
"""Climbs from such a lattice, of some 15 ms each. Where what was assumed is right, one of them begins there."""

SHARP_STEP_PX = 2.0 * SHARP_SIGMA_PX
"""First step on the sharpest edges, as wide as their hill."""


@dataclass(frozen=True, slots=True, eq=False)
class ParameterSubset:
    """The directions of a climb, n of them.

    Attributes:
        directions: (12, n) in the space of deviations: of what moves by itself, and of what is set free together with
            the answer of the pose.
        steps: (n,) along each direction that move the edges by one pixel of the sharpest map.
        free: places of what is set free.
        residual: (f, f) mean products of how the f free ones still move the edges after their answers, px².
    """

    directions: NDArray[np.float64]
    steps: NDArray[np.float64]
    free: tuple[int, ...]
    residual: NDArray[np.float64]

    @classmethod
    def of(
        cls, sharp: AssumedEdges, at: NDArray[np.float64], base: tuple[int, ...], free: tuple[int, ...]
    ) -> ParameterSubset:
        """The directions about a deviation (12,): the places `base` move already, the places `free` are set free.

        Raises:
            ValueError: the edges in view do not determine `base`.
        """
        places, count = (*base, *free), len(base)
        some = sharp.thinned(POINTS)
        columns, seen = some.moved(at, places)
        weight = np.where(seen, some.frames.weight, 0.0)[:, None]
        whole = max(float(weight.sum()), LEAST_SQUARE)
        n = range(len(places))
        normal = [[0.0] * len(places) for _ in n]
        for i in n:
            weighted = columns[i] * weight
            for j in range(i + 1):
                # A sum without a BLAS product is the same to the bit in every process.
                normal[i][j] = normal[j][i] = float(np.sum(weighted * columns[j])) / whole
        own = [row[:count] for row in normal[:count]]
        directions = np.zeros((SIZE, len(places)))
        directions[places, n] = 1.0
        inverse = inverted(own)
        answers = [[fsum(a * normal[k][j] for k, a in enumerate(row)) for row in inverse] for j in n[count:]]
        for column, answer in enumerate(answers, start=count):
            directions[list(base), column] = np.negative(answer)
        residual = [
            [normal[i][j] - fsum(a * normal[i][k] for k, a in enumerate(answers[j - count])) for j in n[count:]]
            for i in n[count:]
        ]
        squares = [normal[i][i] for i in range(count)] + [residual[k][k] for k in range(len(free))]
        return cls(directions, np.array([1.0 / sqrt(max(s, LEAST_SQUARE)) for s in squares]), free, np.array(residual))

    @property
    def widest(self) -> NDArray[np.float64]:
        """(n,) half the reach of each direction."""
        reach = REACH[:, None] / np.maximum(np.abs(self.directions), 1e-9)
        return np.asarray(0.5 * reach.min(axis=0))

    def combined(self, along: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, 12) the deviations of K moves (K, n) along the directions."""
        return np.asarray(np.sum(self.directions * along[:, None, :], axis=2))

    def lattice(self, places: Sequence[int], about: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, 12) the deviations at which some of the free places, with their answers, are off from `about` (12,) by
        each combination of `LATTICE`."""
        columns = len(self.steps) - len(self.free) + np.array([self.free.index(place) for place in places])
        along = np.zeros((len(LATTICE) ** len(places), len(self.steps)))
        along[:, columns] = self.widest[columns] * list(product(LATTICE, repeat=len(places)))
        return about + self.combined(along)

    def moved_px(self, deviation: NDArray[np.float64]) -> float:
        """By how many pixels the free places of a deviation (12,) still move the edges after their answers."""
        values = deviation[list(self.free)].tolist()
        rows = self.residual.tolist()
        square = fsum(a * b * rows[i][j] for i, a in enumerate(values) for j, b in enumerate(values))
        return sqrt(max(square, 0.0))


def local_ascent(
    levels: Sequence[AssumedEdges], subset: ParameterSubset, start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The deviation (12,) of the most significant alignment on the last level next to `start` (12,). The levels before
    it lead there."""
    sharpest, widest = levels[-1].frames.camera.width, subset.widest
    at = start
    for level in levels:
        last = level is levels[-1]
        blur_px = SHARP_STEP_PX if last else BLUR_SIGMA_PX * sharpest / level.frames.camera.width
        step = np.minimum(blur_px * subset.steps, widest)
        begin = at

        def scores(
            points: NDArray[np.float64], level: AssumedEdges = level, begin: NDArray[np.float64] = begin
        ) -> list[float]:
            values: list[float] = _scores(level, begin + subset.combined(points)).tolist()
            return values

        box = Box(-2.0 * widest, 2.0 * widest, step, (SETTLING if last else LEADING) * step)
        best, _ = maximum_in(box, scores, np.zeros(len(step)), MAX_EVALUATIONS)
        at = begin + subset.combined(best[None])[0]
    return at


def ends_along(
    places: Sequence[int], levels: Sequence[AssumedEdges], subset: ParameterSubset, start: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """The deviations (12,) at which climbs from about `start` (12,) end; `places` are those of the free ones that the
    pose answers almost entirely. They make a long ridge, whose dents hold a climb: beside the one that the levels lead,
    others begin on the last level, at the best points of a lattice of these places. Without such places there is one.
    """
    led = local_ascent(levels, subset, start)
    if not places:
        return [led]
    lattice = subset.lattice(places, start)
    best = np.argsort(-_scores(levels[-1], lattice), kind="stable")[:BEGINS]
    return [led, *(local_ascent(levels[-1:], subset, lattice[k]) for k in best)]


def _scores(level: AssumedEdges, deviations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) what a climb makes large, at each of K deviations (K, 12). It costs half a unit at the end of the reach, so
    that what the window does not show stays as assumed."""
    unlike = deviations[:, SHIFTS.stop :] / REACH[SHIFTS.stop :]
    return np.asarray(level.significances(deviations) - 0.5 * np.sum(unlike * unlike, axis=1))


CENTRE_EVEN = 1.5
"""Certainty (`Landscape.certainty`) at which a centre is as likely wrong as right: three standard deviations. See
docs/measured.md."""

LEAST_CERTAINTY = 1e-6
"""Below this certainty a centre that is decimetres off would be known only to kilometres, so it counts as
unmeasured."""

LEAST_M2 = 1e-12
"""Least variance, m²: a centre is neither known nor measured to better than a thousandth of a millimetre."""


def centre_weight(certainty: float, off_m: float, known_m: float) -> float:
    """The share by which a shift of the camera's centre counts that a window sees: 0 for no shift, 1 for one beyond
    doubt.

    In the case that the centre is as well known as assumed, the measured and the assumed place are weighed by their
    variances (Wiener 1949): a window that determines the centre to 3 cm says little of one that is known to 1 cm.

    Args:
        certainty: of the window's gain by the shift, half the distance in standard deviations; see
            `Landscape.certainty`.
        off_m: length of the shift.
        known_m: standard deviation of the assumed place, along each axis.
    """
    if certainty <= LEAST_CERTAINTY or off_m <= 0.0:
        return 0.0
    measured = (off_m / (2.0 * certainty)) ** 2
    if_right = 1.0 - measured / max(known_m * known_m + measured, LEAST_M2)
    is_wrong = posterior_weight(certainty, CENTRE_EVEN) ** 2
    return sqrt((1.0 - is_wrong) * if_right * if_right + is_wrong)


def posterior_weight(certainty: float, even: float) -> float:
    """The share by which the shift counts for an assumption that is either right or wrong: the root of the probability
    that it is wrong.

    A gain of certainty c makes wrong 4·c² nats likelier: half the square of the distance in standard deviations,
    (2·c)²/2, and twice that because those are √2 too wide (see `Landscape.certainty` and `scatter`). At the certainty
    `even` wrong and right are equally likely, because three more unknowns fit that much better by chance. A loss
    (negative certainty) speaks for the assumption.
    """
    return sqrt(_probability(4.0 * (certainty * abs(certainty) - even * even)))


def _probability(nats: float) -> float:
    """The probability for odds given by their logarithm."""
    return 0.5 * (1.0 + tanh(0.5 * nats))


HELD_FREE, CLOCKS_FREE, LENS_FREE = "held_free", "clocks_free", "lens_free"
"""Names of the assumptions that are set free."""

EVEN = 1.0
"""Certainty (`Landscape.certainty`) at which clocks are as likely wrong as right: two standard deviations on a
paraboloid. Chance reaches it once in ten windows, and then moves the pose by a few hundredths of a degree or a few
centimetres. An offset of the clocks that looks like a shift along the way gains little more, but moves the pose by
decimetres."""

LENS_EVEN = 1.5
"""Likewise for a lens: three standard deviations. Its principal point acts nearly like a turn of the pose, so that a
gain by chance moves the pose by half a degree."""

UNSEEN = COLUMNS * ROWS
"""Sector for everything outside the image."""

LEAST_PX = 0.4
"""A different lens matters only if it moves the sharpest edges by this much, root mean square, beyond what the pose can
do: corners of a target are found to a tenth of a pixel, and blur displaces edges by as much. It is also the error that
edges by themselves leave in a lens: a lens that moves them by as much is half believed (`beside_a_turn`). See
docs/measured.md."""


@dataclass(frozen=True, slots=True, eq=False)
class RelaxedAssumption:
    """The result of setting one assumption free.

    Attributes:
        name: of the assumption.
        certainty: of the gain; see `Landscape.certainty`.
        moved_px: how far it moves the edges beyond what the pose can do, root mean square, pixels of the sharpest map.
        deviation: (12,) from what was assumed, together with what was set free before it; see `TURNS`.
        shift: (6,) by how much the pose turned and shifted meanwhile, rad and m.
        believed: the share by which the shift counts.
    """

    name: str
    certainty: float
    moved_px: float
    deviation: NDArray[np.float64]
    shift: NDArray[np.float64]
    believed: float

    @property
    def astray(self) -> float:
        """The largest share of its reach by which an axis of the pose moves, as far as that is believed."""
        return self.believed * float(np.max(np.abs(self.shift) / REACH[: SHIFTS.stop]))

    @property
    def matters(self) -> bool:
        """Whether it moves the edges by more than the error that calibrations leave."""
        return self.moved_px >= LEAST_PX

    @property
    def contradicts(self) -> bool:
        """Whether the window is believed rather than the assumption."""
        return self.believed >= 0.5


def relax_assumptions(
    edges: Sequence[EdgeFrames], window: Window, pose: Matrix4, held: Sequence[int], known_m: float
) -> tuple[RelaxedAssumption, ...]:
    """Sets the assumptions of a window free, one after the other; empty if the edges in view do not determine a pose.

    Args:
        edges: of the window, from coarser levels that lead to the sharpest one.
        window: the window whose assumptions are set free.
        pose: (4, 4) where its search ended.
        held: the translations (places in ξ) that were taken as known.
        known_m: the standard deviation to which each of them is known.
    """
    levels = assumed_levels(edges, window, pose)
    free: list[tuple[str, Sequence[int], Sequence[int]]] = [(HELD_FREE, held, ())] if held else []
    if moves(window):
        free.append((CLOCKS_FREE, CLOCKS, LATE))
    free.append((LENS_FREE, LENS, PRINCIPAL_POINT))
    base = tuple(axis for axis in range(SHIFTS.stop) if axis not in held)
    try:
        before = local_ascent(levels[-1:], ParameterSubset.of(levels[-1], np.zeros(SIZE), base, ()), np.zeros(SIZE))
        results = []
        for name, places, along in free:
            subset = ParameterSubset.of(levels[-1], before, base, tuple(places))
            ends = ends_along(along, levels, subset, before)
            judged = [_judged(name, levels[-1], subset, before, after, known_m) for after in ends]
            results.append(max(judged, key=lambda one: one.astray))
            base, before = (*base, *places), results[-1].deviation
    except ValueError:
        return ()
    return tuple(results)


def _judged(
    name: str,
    sharp: AssumedEdges,
    subset: ParameterSubset,
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    known_m: float,
) -> RelaxedAssumption:
    uv_px, seen = sharp.pixels(after)
    sector = np.full(len(uv_px), UNSEEN, np.uint8)
    sector[seen] = sectors(uv_px[seen])
    shift = se3.difference(sharp.otherwise(after)[1], sharp.otherwise(before)[1])
    gained = certainty(_cells(sharp, after, sector) - _cells(sharp, before, sector))
    moved_px = subset.moved_px(after - before)
    if name == HELD_FREE:
        believed = centre_weight(gained, hypot(*(after - before)[list(subset.free)].tolist()), known_m)
    elif name == CLOCKS_FREE:
        believed = posterior_weight(gained, EVEN)
    else:
        believed = posterior_weight(gained, LENS_EVEN) * weight_beyond_turn(moved_px)
    return RelaxedAssumption(name, gained, moved_px, after, shift, believed)


def weight_beyond_turn(moved_px: float) -> float:
    """The share by which a lens is believed that moves the edges by so much beyond the pose that answers it.

    A lens trades its principal point against a turn of the camera: one that moves the edges by a fifth of a pixel
    beyond the turn turns the camera by half a degree. `moved_px` is measured with an error of `LEAST_PX`, so only the
    part of it that is not error is believed (Wiener 1949).
    """
    return moved_px**2 / (moved_px**2 + LEAST_PX**2)


def _cells(sharp: AssumedEdges, deviation: NDArray[np.float64], sector: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(F, B) what each frame adds to the significance in each sector; `sector` (E,) is where each range edge lies."""
    frames, pose = sharp.otherwise(deviation)
    of_parts = alignment_of_parts(frames, sector, UNSEEN + 1, pose[None])
    square = float(of_parts.square[0, :, :UNSEEN].sum())
    return np.asarray(of_parts.strength[0, :, :UNSEEN] / sqrt(max(square, LEAST_SQUARE)))
