"""Whether the camera moved while a window was taken, by how much and when: the window then has two poses, one after
the other, instead of one. Thinned pairs between those of the window date the move.

A generalised likelihood ratio over the time of the change (Willsky, Jones 1976; Basseville, Nikiforov, "Detection of
abrupt changes", 1993, section 2.4). For every split of the frames in time

gain = max over T of the early frames' score + max over T of the late frames' score - max over T of all frames'

where the score of a frame is z(T) = Σ w·e / √Σ w² over its own range edges, with about unit variance at a wrong pose
for every frame. The largest gain shows whether there was a change, and its split shows when. A single bad frame in the
middle raises neither side, because no split has it alone.

Within the blur of the edges two poses of one scene score alike, but a step may be far larger. So the fine band of the
edge cue is searched next to the solved pose, a chart as far as a mount is knocked, and both around the best poses
of the chart. The result is settled on the sharpest edges: they resolve half a degree two to three times as well as the
band, and a scene that fits many poses fits none of them sharply. The split and the poses of its sides are found in
turns, each from the other, until neither changes.

The window gives a pose before and a pose after the change (`search.change_point`). A pair i from before the change
scores higher at the former than at the latter, by d_i = z_i(T_before) - z_i(T_after); a pair from after it scores
lower. The likeliest time is where the sum of d over the pairs until then is highest (a change of known size: Page
1954). Every time at which the sum is nearly as high is possible, too.

If a single pair of the window lies before or after the change, that pair determines its pose badly. So the pairs around
the change are also searched for a change, and of all poses found those are taken that explain all pairs best.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf, pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.edges import EdgeCue, Edges, build_edges, in_reach
from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.search.global_search import sample_reach
from coec.calibration.solver import WindowData
from coec.calibration.types import FramePair, Matrix4, MovedWithin
from coec.errors import CalibrationError, DecodeError
from coec.geometry import se3
from coec.geometry.edges import alignment
from coec.geometry.edges.charts import EdgeCharts, charted_significances
from coec.geometry.points import thinned

REACH_RAD = radians(4.0)
"""How far from the solved pose the other pose is searched: a knock of 3°, and how far the solved pose is off its own
side."""

POINTS = 30_000
"""Most range edges of the window that are used: half of those that rank basins. Using every other one lowers the gain
by the root of two; using all would take a tenth of a solve."""

FAR_REACH_RAD = radians(12.0)
"""How far the other pose is searched if frames at an end of the window do not fit the solved pose: a mount that is
bent, or hangs by one screw. It takes 27 times the poses of the reach, but only for a few frames in few windows."""

SEEN = SearchBox(FAR_REACH_RAD + radians(2.0), 0.0)
"""From the solved pose to the farthest end of a climb: edges that come into view nowhere within it are left out."""

CHART_POSES = 2_000
"""Number of poses in the cover of the reach: half a degree apart, the blur of a chart or less."""

END, END_CHARTED, END_POSES = 2, 64, 8
"""Number of frames at either end of a window whose own pose is searched; number of poses of the cover, best for these
few frames on a chart, around which the fine band is searched; and number of poses proposed from that."""

MISFIT = 0.4
"""Frames at an end do not fit the solved pose if they score less than this share of the median frame there. See
docs/measured.md."""

NEAR_BLURS, NEAR_POSES = 2.5, 300
"""Radius about the solved pose that the fine band covers, in its blurs, and number of poses of that cover, 0.6 blurs
apart. Farther off, the chart can distinguish two poses."""

FAR_POSES, AROUND_POSES = 6, 8
"""Number of poses that the chart proposes, by their gain over the solved one, and number of poses around each that are
tried on the fine band, because those of the chart are half a degree apart."""

ASCENT_BLURS, HALVINGS = 0.3, 2
"""First step of a climb, in blurs of its level, and its halvings: down to a tenth of a blur, where a score is within a
percent of its maximum."""

TURNS = 4
"""Most turns of splitting and climbing on the sharpest edges: in nine of ten windows nothing changed any more after
two."""

FEW = 3
"""The best split with at least this many frames on either side is settled, too. One or two frames fit some pose of
hundreds by chance, better than many frames fit the right one on the blurred band."""

STARTS = 6
"""Number of poses from which a side of so few frames is climbed: the best one on the blurred band may be a degree
off."""

MIN_FRAMES = 4
"""With fewer frames there is no early and late."""

MIN_SUPPORT = 5.0
"""Least mean score, on either side at the pose of that side, of the frames that say anything. See docs/measured.md."""

MIN_LIKENESS = 0.6
"""Least likeness of the losses of both sides. If the camera moved from T₁ to T₂, early frames lose as large a share of
their score at T₂ as late frames lose at T₁. A change of the scene does not have that property: in a tunnel the lines
along the way fit many poses. See docs/measured.md."""


@dataclass(frozen=True, slots=True, eq=False)
class ChangePoint:
    """The likeliest change of the pose within a window.

    Attributes:
        first_late: index of the first pair after the change.
        T_before, T_after: (4, 4) T_camera_lidar that fit the pairs before and after the change best.
        gain: how much more two poses score than one, in standard deviations of a frame's score.
        support: mean score of the frames on the side that scores less, at the pose of that side. Each frame is weighted
            by its score, so that frames which say nothing do not count.
        likeness: the share of its score that a side loses at the pose of the other, frames weighted likewise: the
            smaller of both shares over the larger.
    """

    first_late: int
    T_before: Matrix4
    T_after: Matrix4
    gain: float
    support: float
    likeness: float

    @property
    def turn_rad(self) -> float:
        """Angle between the two poses."""
        return se3.rotation_angle_rad(self.T_after @ se3.inverse(self.T_before))

    @property
    def of_camera(self) -> bool:
        """Whether the camera changed, rather than the scene."""
        return self.support >= MIN_SUPPORT and self.likeness >= MIN_LIKENESS


def change_point(edges: EdgeCue, pose: Matrix4) -> ChangePoint | None:
    """The likeliest change within a window that was solved to `pose` (4, 4), however unlikely it is; None with fewer
    than `MIN_FRAMES` pairs. The camera turns about its centre."""
    if len(edges.whole.first_point) - 1 < MIN_FRAMES:
        return None
    band = _edges_in_reach(edges.bands[0], edges.half_view_rad, pose)
    sharp = _edges_in_reach(edges.sharp, edges.half_view_rad, pose)
    chart = _edges_in_reach(edges.charts[-1], edges.half_view_rad, pose)
    blur_rad, frames = edges.band_blur_rad[0], len(band.first_point) - 1
    near = sample_reach(pose, SearchBox(NEAR_BLURS * blur_rad, 0.0), NEAR_POSES)
    far = _put_forward(chart, pose, frames)
    poses = np.concatenate([pose[None], near, *far, *_put_forward_by_ends(chart, band, pose)])
    early = np.cumsum(alignment.alignments(band, poses).of_single_frames, axis=1).T  # (F, K)
    total = early[-1]
    late = total - early
    gains = early[:-1].max(axis=1) + late[:-1].max(axis=1) - total.max()
    starts = [alignment.AscentStart(poses[int(np.argmax(total))], 0, frames)]
    sides: list[range] = []
    promising = _promising(gains)
    for last_early in promising:
        for first, last, of_side in ((0, last_early + 1, early), (last_early + 1, frames, late)):
            number = STARTS if last - first <= FEW else 1
            best = np.argsort(-of_side[last_early], kind="stable")[:number].tolist()
            sides.append(range(len(starts), len(starts) + number))
            starts += [alignment.AscentStart(poses[k], first, last) for k in best]
    on_band = [end.pose for end in _ascents(band, starts, blur_rad)]
    again = [replace(start, pose=pose) for start, pose in zip(starts, on_band, strict=True)]
    # The pose for all frames is climbed on the sharpest edges later, beside the poses of the settled sides.
    on_sharp = _ascents(sharp, again[1:], edges.blur_rad)
    of_sides = [max((on_sharp[k - 1] for k in side), key=lambda end: end.score).pose for side in sides]
    splits = [
        _Split(last_early + 1, T_before, T_after)
        for last_early, T_before, T_after in zip(promising, of_sides[::2], of_sides[1::2], strict=True)
    ]
    settled = _settled(sharp, splits, on_band[0], edges.blur_rad)
    return max(settled, key=lambda change: (change.of_camera, change.gain))


@dataclass(frozen=True, slots=True, eq=False)
class _Split:
    """Where a window is split, and the pose (4, 4) of either side."""

    first_late: int
    T_before: Matrix4
    T_after: Matrix4


def _promising(gains: NDArray[np.float64]) -> list[int]:
    """The splits to settle (the last early frame of each), from gains (F - 1,): the best one, and the best that leaves
    at least `FEW` frames on either side."""
    best, inner = int(np.argmax(gains)), gains[FEW - 1 : len(gains) - FEW + 1]
    return [best] if len(inner) == 0 else list(dict.fromkeys((best, FEW - 1 + int(np.argmax(inner)))))


def _settled(
    sharp: alignment.EdgeFrames, splits: Sequence[_Split], T_whole: Matrix4, blur_rad: float
) -> list[ChangePoint]:
    """The likeliest change next to each split, from the poses that fit its two sides and one (4, 4) that fits all
    frames. All splits take their turns together, so that several climbs run at once."""
    frames, turning = len(sharp.first_point) - 1, dict(enumerate(splits))
    best, most = dict(turning), dict.fromkeys(turning, -inf)
    for _ in range(TURNS):
        ends = _ascents(sharp, [start for split in turning.values() for start in _sides(split, frames)], blur_rad)
        at_ends = _scores(sharp, [end.pose for end in ends])
        again = {}
        for (number, split), place in zip(turning.items(), range(0, len(ends), 2), strict=True):
            before, after = ends[place : place + 2]
            now = replace(split, T_before=before.pose, T_after=after.pose)
            if before.score + after.score > most[number]:
                best[number], most[number] = now, before.score + after.score
            first_late = 1 + int(np.argmax(np.cumsum(at_ends[place] - at_ends[place + 1])[:-1]))
            if first_late != split.first_late:
                again[number] = replace(now, first_late=first_late)
        if not again:
            break
        turning = again
    # The one pose for all frames is also sought from the poses of the sides, so that it is no worse than theirs.
    final = list(best.values())
    whole = [T_whole, *(T for split in final for T in (split.T_before, split.T_after))]
    of_whole, *of_sides = _ascents(sharp, [alignment.AscentStart(T, 0, frames) for T in whole], blur_rad)
    at_sides = _scores(sharp, whole[1:])
    changes = []
    for place, split in zip(range(0, len(of_sides), 2), final, strict=True):
        together = max(end.score for end in (of_whole, *of_sides[place : place + 2]))
        changes.append(_change(split, at_sides[place], at_sides[place + 1], together))
    return changes


def _sides(split: _Split, frames: int) -> tuple[alignment.AscentStart, alignment.AscentStart]:
    return alignment.AscentStart(split.T_before, 0, split.first_late), alignment.AscentStart(
        split.T_after, split.first_late, frames
    )


def _change(
    split: _Split, at_before: NDArray[np.float64], at_after: NDArray[np.float64], together: float
) -> ChangePoint:
    """The change of a settled split, from the scores (F,) of the frames at both poses, and their score `together` at
    one pose for all."""
    first_late = split.first_late
    before, after = float(at_before[:first_late].sum()), float(at_after[first_late:].sum())
    losses = (
        _loss(at_before[:first_late], at_after[:first_late]),
        _loss(at_after[first_late:], at_before[first_late:]),
    )
    return ChangePoint(
        first_late,
        split.T_before,
        split.T_after,
        gain=before + after - together,
        support=min(_support(at_before[:first_late]), _support(at_after[first_late:])),
        likeness=min(losses) / max(losses) if min(losses) > 0.0 else 0.0,
    )


def _put_forward(chart: EdgeCharts, pose: Matrix4, frames: int) -> list[NDArray[np.float64]]:
    """Proposes poses (n, 4, 4): those at which the frames of one side of a split score most on the chart, and others
    around them."""
    cover = sample_reach(pose, SearchBox(REACH_RAD, 0.0), CHART_POSES)
    cover = np.concatenate([pose[None], cover])
    of_frames = chart.frame
    charted = np.array(
        [charted_significances(chart.of_points(np.flatnonzero(of_frames == f)), cover) for f in range(frames)]
    )
    early = np.cumsum(charted, axis=0)
    sides = np.concatenate([early[:-1], early[-1] - early[:-1]])
    best = np.argmax(sides, axis=1)
    # How much a side gains over the solved pose; a pose may be the best for many sides.
    gained = {int(k): 0.0 for k in best if k != 0}
    for side, k in zip(sides, best.tolist(), strict=True):
        if k != 0:
            gained[k] = max(gained[k], float(side[k] - side[0]))
    selected = sorted(gained, key=lambda k: (-gained[k], k))[:FAR_POSES]
    return [cover[selected], *(_about(cover[k]) for k in selected)] if selected else []


def _put_forward_by_ends(chart: EdgeCharts, band: alignment.EdgeFrames, pose: Matrix4) -> list[NDArray[np.float64]]:
    """Proposes poses (n, 4, 4) that the first and the last frames fit best, by the chart and then by the band. They are
    searched farther off if these frames do not fit the solved pose."""
    at_pose, selected = scores(band, pose), []
    for begin in (0, len(at_pose) - END):
        end = begin + END
        fits = float(at_pose[begin:end].mean()) >= MISFIT * float(np.median(at_pose))
        reach_rad = REACH_RAD if fits else FAR_REACH_RAD
        cover = sample_reach(pose, SearchBox(reach_rad, 0.0), round(CHART_POSES * (reach_rad / REACH_RAD) ** 3))
        part = chart.of_points(np.flatnonzero((chart.frame >= begin) & (chart.frame < end)))
        best = np.argsort(-charted_significances(part, cover), kind="stable")[:END_CHARTED]
        about = np.concatenate([cover[best], *(_about(cover[k]) for k in best.tolist())])
        fine = alignment.significances(_part(band, begin, end), about)
        selected.append(about[np.argsort(-fine, kind="stable")[:END_POSES]])
    return selected


def _about(pose: Matrix4) -> NDArray[np.float64]:
    """Poses (n, 4, 4) between a pose of the cover and its neighbours."""
    spacing_rad = REACH_RAD * (4.0 / 3.0 * pi / CHART_POSES) ** (1.0 / 3.0)
    return sample_reach(pose, SearchBox(spacing_rad, 0.0), AROUND_POSES)


def scores(band: alignment.EdgeFrames, pose: Matrix4) -> NDArray[np.float64]:
    """(F,) z of each frame by itself at a pose (4, 4)."""
    return np.asarray(_scores(band, [pose])[0])


def _scores(band: alignment.EdgeFrames, poses: Sequence[Matrix4]) -> NDArray[np.float64]:
    """(K, F) z of each frame by itself at each of K poses (4, 4)."""
    return alignment.alignments(band, np.stack(poses)).of_single_frames


def _support(of_frames: NDArray[np.float64]) -> float:
    """Mean of scores (F,), each weighted by itself; 0 if none is above 0."""
    positive = np.maximum(of_frames, 0.0)
    return float(np.square(positive).sum() / max(positive.sum(), alignment.LEAST_SQUARE))


def _loss(own: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """The share of the scores `own` (F,) that is lost if they become `other` (F,), each weighted by itself; 0 if none
    is above 0."""
    positive = np.maximum(own, 0.0)
    return float((positive * (own - other)).sum() / max(np.square(positive).sum(), alignment.LEAST_SQUARE))


def _ascents(
    band: alignment.EdgeFrames, starts: Sequence[alignment.AscentStart], blur_rad: float
) -> list[alignment.Summit]:
    """The ends of climbs: the poses next to their beginnings at which their frames score most, one axis after the
    other."""
    nowhere, turns = np.eye(4), (*np.eye(6)[:3], *-np.eye(6)[:3])
    steps_rad = [ASCENT_BLURS * blur_rad * 0.5**halved for halved in range(HALVINGS + 1)]
    moves = np.array([[se3.perturb(nowhere, step_rad * turn) for turn in turns] for step_rad in steps_rad])
    return alignment.ascend(band, list(starts), moves)


def _edges_in_reach(edges: Edges, half_view_rad: float, pose: Matrix4) -> Edges:
    """The edges with at most `POINTS` range edges, and of those only the ones that some pose brings into view."""
    return in_reach(edges.of_points(thinned(len(edges.weight), POINTS)), half_view_rad, pose, SEEN)


def _part(frames: alignment.EdgeFrames, begin: int, end: int) -> alignment.EdgeFrames:
    """The frames from `begin` to before `end`."""
    first, last = frames.first_point[begin], frames.first_point[end]
    return replace(
        frames,
        xyz_m=np.ascontiguousarray(frames.xyz_m[:, first:last]),
        weight=frames.weight[first:last],
        first_point=frames.first_point[begin : end + 1] - first,
        maps=frames.maps[begin:end],
    )


MAY_BE = 4.0
"""The change may be wherever the sum is at most this far below its highest value. See docs/measured.md."""

AT_ONCE = 36
"""Most pairs whose edges are found at a time: 120 MB of edge maps of 2 megapixels."""


@dataclass(frozen=True, slots=True, eq=False)
class DatedEdges:
    """The edge cue of some pairs, and their stamps, ascending."""

    stamps_ns: tuple[int, ...]
    edges: EdgeCue


@dataclass(frozen=True, slots=True, eq=False)
class StepTime:
    """The camera moved between two stamps, from one pose (4, 4) to the other."""

    last_before_ns: int
    first_after_ns: int
    T_before: Matrix4
    T_after: Matrix4

    def holds(self, stamp_ns: int) -> bool:
        """Whether a pair of this stamp may narrow the interval."""
        return self.last_before_ns < stamp_ns < self.first_after_ns


def step_time(
    change: ChangePoint,
    window: DatedEdges,
    between: Sequence[FramePair],
    edges_of: Callable[[Sequence[FramePair]], DatedEdges | None],
) -> StepTime:
    """The stamps between which the camera moved, and the poses before and after.

    Args:
        change: the change of the window.
        window: the pairs of the window.
        between: the thinned pairs between them, ascending.
        edges_of: finds the edges of those of some pairs that have any; None if none has.
    """
    stamps_ns, seen, changes = window.stamps_ns, [window], [change]
    # One more pair of the window on either side, because the poses were fitted to the supposed time of the change.
    first, last = max(0, change.first_late - 2), min(len(stamps_ns) - 1, change.first_late + 1)
    about, waiting = StepTime(stamps_ns[first], stamps_ns[last], change.T_before, change.T_after), list(between)
    while True:
        requested = [pair for pair in waiting if about.holds(pair.stamp_ns)]
        for some in _bunches(requested):
            dated = edges_of(some)
            if dated is not None:
                near = change_point(dated.edges, _better_known(change, len(stamps_ns)))
                seen.append(dated)
                changes += [] if near is None else [near]
        best = _best_step_time(seen, changes)
        if not requested:
            return best
        waiting = [pair for pair in waiting if not about.holds(pair.stamp_ns)]
        about = best


def _bunches(pairs: Sequence[FramePair]) -> Iterator[Sequence[FramePair]]:
    """Bunches of at most `AT_ONCE` pairs, each spread over the whole time, so that each shows a change anywhere."""
    count = -(-len(pairs) // AT_ONCE)
    return (pairs[begin::count] for begin in range(count))


def _better_known(change: ChangePoint, frames: int) -> Matrix4:
    """The pose (4, 4) of the side of a window that has more frames."""
    return change.T_before if 2 * change.first_late > frames else change.T_after


def _best_step_time(seen: Sequence[DatedEdges], changes: Sequence[ChangePoint]) -> StepTime:
    """The time of the change by all pairs, at the two poses that explain them best. At least one pair lies on either
    side."""
    stamps_ns = np.concatenate([np.array(some.stamps_ns, np.int64) for some in seen])
    order = np.argsort(stamps_ns)
    stamps_ns = stamps_ns[order]

    def at(pose: Matrix4) -> NDArray[np.float64]:
        return np.concatenate([scores(some.edges.sharp, pose) for some in seen])[order]

    before = [(one.T_before, at(one.T_before)) for one in changes]
    after = [(one.T_after, at(one.T_after)) for one in changes]
    best, most = None, -np.inf
    for (T_before, early), (T_after, late) in product(before, after):
        # For each split: the pairs before it score at one pose and the rest at the other.
        summed = late.sum() + np.cumsum(early - late)[:-1]
        highest = float(summed.max())
        if best is None or highest > most:
            may_be = np.flatnonzero(summed >= highest - MAY_BE)
            most = highest
            best = StepTime(int(stamps_ns[may_be[0]]), int(stamps_ns[may_be[-1] + 1]), T_before, T_after)
    assert best is not None, "there is a change"
    return best


def moved_within(change: ChangePoint, edges: EdgeCue, data: WindowData) -> MovedWithin:
    """The change that the edges of a window show, dated also by the pairs recorded between those of the window."""
    window = data.window
    stamps_ns = tuple(pair.stamp_ns for pair in window.pairs)
    step = step_time(change, DatedEdges(stamps_ns, edges), window.between, lambda pairs: _edges_of(pairs, data))
    pairs_after = sum(stamp_ns >= step.first_after_ns for stamp_ns in stamps_ns)
    return MovedWithin(step.last_before_ns, step.first_after_ns, pairs_after, step.T_before, step.T_after)


def _edges_of(pairs: Sequence[FramePair], data: WindowData) -> DatedEdges | None:
    """The edges of some pairs; None if none are usable. These pairs were not decoded before, so any that cannot be
    decoded is left out."""
    seen = []
    for pair in pairs:
        try:
            seen.append((pair, data.images.grey(pair.camera)))
        except DecodeError:
            continue
    usable = [pair for pair, _ in seen]
    of = replace(data, window=replace(data.window, pairs=tuple(usable)))
    try:
        cue = build_edges(usable, of.points, (grey for _, grey in seen), data.window.rig)
    except CalibrationError:
        return None
    return DatedEdges(tuple(pair.stamp_ns for pair in usable), cue)
