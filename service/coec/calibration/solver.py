"""The estimators of the extrinsic of a window, by the name of their objective, and the data of a window that they
read. One line in `ESTIMATORS` adds another.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log1p, nan, radians
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.ego_mask import MIN_FRAMES, MIN_SPEED_MPS, lit_pixels
from coec.calibration.frames.evidence import stands
from coec.calibration.frames.motion_compensation import EVERY, Choice, compensate
from coec.calibration.objective import mutual_information
from coec.calibration.objective.edges import EdgeCue, build_edges, independent_samples_at
from coec.calibration.objective.fused import FusedObjective, Fusion, Scale
from coec.calibration.search.global_search import at_rim, basin_next_to, find_basins, highest_summit
from coec.calibration.search.local_search import TRANSLATIONS, SearchResult, box_of, maximise, near, polish_in_turn
from coec.calibration.types import (
    CameraFrame,
    CueShare,
    DepthMap,
    DepthModel,
    ImageReader,
    Matrix4,
    Metric,
    Progress,
    StopReason,
    Window,
)
from coec.config import CalibrationConfig, SearchConfig
from coec.errors import CalibrationError, DecodeError
from coec.geometry import se3
from coec.geometry.edges.image_edges import halved
from coec.geometry.points import thinned

MAX_CACHED_BYTES = 64_000_000
"""Most bytes of decoded images that are kept: twenty-five of 2.5 megapixels. Their edge maps take as much, and each
image is dropped when its maps are made. Images beyond this are decoded again."""


class CachedImages:
    """An image reader that keeps images from their first use to their second."""

    def __init__(self, images: ImageReader) -> None:
        self._images = images
        self._cache: dict[int, NDArray[np.uint8]] = {}
        self._bytes = 0

    def first(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values of a frame; `grey` will be called for it later.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """
        grey = self._images.grey(frame)
        if id(frame) not in self._cache and self._bytes + grey.nbytes <= MAX_CACHED_BYTES:
            self._cache[id(frame)] = grey
            self._bytes += grey.nbytes
        return grey

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values; the reader then drops the image.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """
        cached = self._cache.pop(id(frame), None)
        if cached is None:
            return self._images.grey(frame)
        self._bytes -= cached.nbytes
        return cached


Seen = TypeVar("Seen")

POLISHED_BASINS = 5
"""How many basins are polished on the fused objective beside that of the start. The true basin never ranked below the
second place."""

POLISHED_ALIKE = 3
"""At most this many polishes, that of the start included, may end in one basin: further ones come to the same end. See
docs/measured.md."""

CLEAR, STANDING_ALONE = 5.0, 0.4
"""A basin of range edges stands alone if both kinds of edges have at least this contrast there, standard deviations,
and all basins beyond its neighbourhood at most this share of its contrast. See docs/measured.md."""

PLAUSIBLE = 0.5
"""A basin, or the neighbourhood of the start, is polished if it has at least this share of the best rank. A polish adds
a tenth to a rank, a quarter at most; a rank half as high as the best would have to double."""

NEIGHBOURHOOD_RAD = radians(5.0)
"""Radius of the neighbourhood of a pose: polishes lead there from anywhere within it."""

SETTLED_POSES = 2
"""How many poses of the best basin are settled. One is not enough: with six degrees of freedom, blurred edges can lead
it astray. See docs/measured.md."""

LEADING_DEPTH_POINTS = 150_000
"""Points of the window's clouds, in view or not, that the depth cue of a fusion uses until its basin is known. Few
are enough because its hill is degrees wide."""

SEEN_DEPTH_POINTS = 100_000
"""Points in view that the depth cue uses at the end, unless at least half as many are in view already. The counts of a
histogram scatter by their square root; that scatter in a thousand cells puts ripples on the hill, and where little is
near the edges alone do not hold its top. See docs/measured.md."""

TELLING = 2.0
"""More points are spent on the depth cue only if it stands out by at least this many standard deviations. Below
that its peak may be chance, and more points would not change that."""

SETTLING = mutual_information.SearchBox(radians(8.0), 0.5)
"""How far from a settled pose these points are used at most: for its summits, and to measure how wide its hill is."""

DISPLACED = mutual_information.SearchBox(SETTLING.rotation_rad + radians(2.0), SETTLING.translation_m + 3.0)
"""The same for points before motion compensation: in half a sweep, 40 m/s and 40°/s displace them by the difference."""

SAME_BASIN_RAD = radians(1.5)
"""Poses nearer than this are one basin, not rivals."""

BETWEEN = (0.5, 0.75, 0.25)
"""Shares of the way from the pose to another summit at which a valley between them is looked for."""

MOST_RIVALS = 10
"""Most rivals that are compared on the sharpest edges: bounds the time. With more, a window is ambiguous."""

MAX_GREY_WIDTH_PX = 800
"""Images are halved to at most this width before grey values are compared: pixels are then about as far apart as the
points of a sweep."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowData:
    """A window as an estimator sees it.

    Sweeps are motion-compensated, depth is inferred and images are decoded only when an estimator asks for them,
    because most windows need only a part of each.
    """

    window: Window
    compensated: bool
    depth: DepthModel
    images: ImageReader
    progress: Progress

    def points(self, index: int, selection: Choice = EVERY) -> NDArray[np.float32]:
        """P_i: (N, 3) the chosen points of the sweep of pair `index`, at the instant of the exposure."""
        return compensate(self.window.pairs[index], self.window.rig, enabled=self.compensated, selection=selection)

    def depths(self) -> list[DepthMap]:
        """D_i of every pair.

        Raises:
            CalibrationError: a frame has no usable depth.
        """
        return list(self._each("depth", lambda index: self.depth.infer(self.window.pairs[index].camera)))

    def greys(self) -> Iterator[NDArray[np.uint8]]:
        """The images of every pair, (height, width) grey values, each decoded when it is asked for.

        Raises:
            CalibrationError: an image cannot be decoded.
        """
        return self._each("images", lambda index: self.images.grey(self.window.pairs[index].camera))

    def _each(self, stage: str, load: Callable[[int], Seen]) -> Iterator[Seen]:
        for index, pair in enumerate(self.window.pairs):
            try:
                seen = load(index)
            except DecodeError as error:
                raise CalibrationError(f"no {stage} for the camera frame at {pair.stamp_ns} ns: {error}") from error
            self.progress.step(stage, index + 1, len(self.window.pairs))
            yield seen


def prepare_window_data(
    window: Window, depth: DepthModel, images: ImageReader, config: CalibrationConfig, progress: Progress
) -> WindowData:
    """The window as `config` wants it seen. If the rig has no mask, one is found from the window's own frames."""
    data = WindowData(window, config.motion_compensation, depth, images, progress)
    return data if window.rig.mask is not None or len(window.pairs) < MIN_FRAMES else _masked(data)


def _masked(data: WindowData) -> WindowData:
    pairs = data.window.pairs
    if all(pair.motion is None for pair in pairs) and stands([pair.lidar for pair in pairs]):
        return data  # its surroundings would pass for the vehicle's body
    images = CachedImages(data.images)
    data = replace(data, images=images)
    first_images = data._each("images", lambda index: images.first(pairs[index].camera))
    moving = (
        grey
        for grey, pair in zip(first_images, pairs, strict=True)
        if pair.motion is None or not pair.motion.stays_below(MIN_SPEED_MPS)
    )
    rig = data.window.rig
    try:
        mask = lit_pixels(moving)
    except CalibrationError:
        return data  # an estimator that needs the images will say so
    if mask is None or mask.shape != (rig.camera.height, rig.camera.width):
        return data
    return replace(data, window=replace(data.window, rig=replace(rig, mask=mask)))


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorResult:
    """What an estimator found.

    Attributes:
        objective: what it maximised.
        search: the end of the search on it.
        metrics: those that only this objective has.
        edges: the edges of the window; None if it used none.
        edge_scale: of the significance of the sharpest edges at other poses; None likewise.
        rivals: poses (4, 4) that are ambiguous with the one found as far as blurred edges tell.
        cues: what each cue contributed; empty if there is one only.
    """

    objective: mutual_information.Divisible
    search: SearchResult
    metrics: tuple[Metric, ...]
    edges: EdgeCue | None = None
    edge_scale: Scale | None = None
    rivals: tuple[Matrix4, ...] = ()
    cues: tuple[CueShare, ...] = ()


Estimator = Callable[[WindowData, CalibrationConfig], EstimatorResult]


def by_depth(data: WindowData, config: CalibrationConfig) -> EstimatorResult:
    """The paper's estimator: BOBYQA on the mutual information of depth and range."""
    return _by_mutual_information(depth_features(data, data.window.T_camera_lidar_start), data, config)


def by_intensity(data: WindowData, config: CalibrationConfig) -> EstimatorResult:
    """Pandey, McBride, Savarese, Eustice 2012: BOBYQA on the mutual information of reflectance and grey value.

    Raises:
        CalibrationError: the sweeps carry no intensity.
    """
    frames = []
    for index, (pair, grey) in enumerate(zip(data.window.pairs, data.greys(), strict=True)):
        if pair.lidar.intensity is None:
            raise CalibrationError(f"the sweep at {pair.lidar.stamp_ns} ns carries no intensity: use another objective")
        pixels = grey.astype(np.float32)
        while pixels.shape[1] > MAX_GREY_WIDTH_PX:
            pixels = halved(pixels)
        frames.append(mutual_information.Features(data.points(index), pair.lidar.intensity, pixels))
    return _by_mutual_information(frames, data, config)


def by_fusion(data: WindowData, config: CalibrationConfig) -> EstimatorResult:
    """Edges and depth: finds every basin of the edge cue within reach, ranks them by both cues, polishes the best on
    both, chooses one by its posterior, and settles its summit on the sharpest edges."""
    window, start = data.window, data.window.T_camera_lidar_start
    reach = mutual_information.SearchBox(
        radians(config.search.reach_deg), config.search.reach_m if config.search.dof == 6 else 0.0
    )
    # Edges first: depth may be inferred meanwhile.
    edges = build_edges(window.pairs, data.points, data.greys(), window.rig)
    features = depth_features(data, start, LEADING_DEPTH_POINTS)
    depth = mutual_information.build_mutual_information(features, window.rig, start, reach, config.objective)
    fusion = Fusion(edges, depth, start, reach)
    basins = basins_of_each_kind(fusion)
    data.progress.step("basins", 1, 1)
    ranked = rank_basins(fusion, basins, window.start_known_to_rad)
    polished = polish_basins(fusion, ranked, config.search, data.progress)
    summits = choose_basin(fusion, polished, window)
    edges, basin = edges.balanced_at(summits[0]), summits[0]
    held_m = config.verdict.held_translation_sigma_m if config.search.dof == TRANSLATIONS.start else None
    highest = highest_summit(edges, basin, held_m)
    if highest is not basin:
        summits, edges = (highest, *summits), edges.balanced_at(highest)
        # Within a basin, blurred edges have one summit.
        basin = highest if _differ(highest, basin) else basin
    fusion = fusion.about(basin)
    contrast, rivals = basin_metrics(fusion, polished, basin, config)
    count = Metric("range_edges", edges.effective_count, least_range_edges(config), at_least=True)
    objective, search = settle_basin(fusion, edges, summits, polished.evaluations, data, config)
    cues = objective.cue_shares(edges, search.T_camera_lidar, config.search.dof)
    return EstimatorResult(objective, search, (count, *contrast), edges, objective.edge_scale, rivals, cues)


@dataclass(frozen=True, slots=True, eq=False)
class RankedPose:
    """A pose (4, 4) and how far it stands out to both cues, standard deviations."""

    rank: float
    T_camera_lidar: Matrix4


@dataclass(frozen=True, slots=True, eq=False)
class RankedBasins:
    """The basins of a window by how far they stand out.

    Attributes:
        plausible: poses (4, 4) of the basins to polish, best first.
        implausible: those of all other basins.
        start_is_plausible: whether the neighbourhood of the start is to be polished as well.
    """

    plausible: tuple[Matrix4, ...]
    implausible: tuple[Matrix4, ...]
    start_is_plausible: bool


@dataclass(frozen=True, slots=True, eq=False)
class PolishedBasins:
    """Where the polishes of the plausible basins ended.

    Attributes:
        ends: in the order of the polishes.
        implausible: poses (4, 4) of the basins that were not polished.
        evaluations: number of evaluations of the objectives.
    """

    ends: tuple[RankedPose, ...]
    implausible: tuple[Matrix4, ...]
    evaluations: int


def basins_of_each_kind(fusion: Fusion) -> list[Matrix4]:
    """Poses (4, 4) of the basins of each kind of edges by itself, so that those of one kind that fit nothing hide no
    basin of the other. Once a basin stands alone to both kinds, no further kind is searched."""
    poses: list[Matrix4] = []
    for cue in fusion.edges.kinds_alone:
        if poses and _has_one_that_stands_alone(fusion, poses):
            break
        poses.extend(basin.T_camera_lidar for basin in find_basins(cue, fusion.start, fusion.reach))
    return poses


def _has_one_that_stands_alone(fusion: Fusion, poses: Sequence[Matrix4]) -> bool:
    of_kinds = np.maximum(fusion.contrasts_by_kind(np.array(poses)), 0.0)
    contrast = np.sqrt((of_kinds**2).sum(axis=0))
    best = int(np.argmax(contrast))
    far = [_angle_rad(pose, poses[best]) > NEIGHBOURHOOD_RAD for pose in poses]
    return bool(of_kinds[:, best].min() >= CLEAR and contrast[far].max(initial=0.0) <= STANDING_ALONE * contrast[best])


def rank_basins(fusion: Fusion, basins: Sequence[Matrix4], start_known_to_rad: float) -> RankedBasins:
    """The basins (4, 4) by both cues, and whether the neighbourhood of the start, which is known to some angle,
    compares with them. It is polished wherever the charts rank it, and if no basin could outweigh the prior of the
    start."""
    ranked = sorted(_with_ranks(fusion, basins), key=lambda basin: -basin.rank)
    least = PLAUSIBLE * max((basin.rank for basin in ranked), default=0.0)
    plausible = tuple(basin.T_camera_lidar for basin in ranked[:POLISHED_BASINS] if basin.rank >= least)
    implausible = tuple(basin.T_camera_lidar for basin in ranked[len(plausible) :])
    of_start = basin_next_to(
        fusion.edges, fusion.start, mutual_information.SearchBox(NEIGHBOURHOOD_RAD, fusion.reach.translation_m)
    )
    outweighed = any(
        log_prior(basin.T_camera_lidar, fusion.start, start_known_to_rad) + 0.5 * basin.rank**2 > 0.0
        for basin in ranked[: len(plausible)]
    )
    if fusion.rank(of_start) >= least or not outweighed:
        return RankedBasins(plausible, implausible, start_is_plausible=True)
    return RankedBasins(plausible, (*implausible, of_start), start_is_plausible=False)


def polish_basins(fusion: Fusion, ranked: RankedBasins, config: SearchConfig, progress: Progress) -> PolishedBasins:
    """The maxima of the fused objective next to the start and to the plausible basins."""
    to_rank = near(config, fusion.ranking[-1])
    ends = []
    if ranked.start_is_plausible:
        ends.append(polish_in_turn(fusion.ranking, fusion.start, to_rank, progress))
    for basin in ranked.plausible:
        alike = sum(not _differ(end.T_camera_lidar, basin) for end in ends)
        if alike < POLISHED_ALIKE:
            # The coarser bands led the first polish of a basin. They would lead the others to the same end.
            bands = fusion.ranking[-1:] if alike else fusion.ranking
            ends.append(polish_in_turn(bands, basin, to_rank, progress))
    with_ranks = _with_ranks(fusion, [end.T_camera_lidar for end in ends])
    return PolishedBasins(tuple(with_ranks), ranked.implausible, sum(end.evaluations for end in ends))


def choose_basin(fusion: Fusion, polished: PolishedBasins, window: Window) -> tuple[Matrix4, ...]:
    """Poses (4, 4) of the polishes that ended in the basin of the answer, highest rank first. It is the basin of the
    most probable end that lies within the reach, or of the most probable one if none does."""
    highest = max(polished.ends, key=lambda end: end.rank)
    independent = independent_samples_at(fusion.edges.sharp, highest.T_camera_lidar).count / len(window.pairs)

    def preferred(end: RankedPose) -> tuple[bool, float]:
        # Half the square of a rank is, in nats, what the window says against chance, if its frames are independent:
        # ten frames of one view fit a wrong pose ten times. A maximum outside of the reach is a rival, but the answer
        # has to lie inside.
        prior = log_prior(end.T_camera_lidar, fusion.start, window.start_known_to_rad)
        return not at_rim(end.T_camera_lidar, fusion.start, fusion.reach), 0.5 * independent * end.rank**2 + prior

    pose = max(polished.ends, key=preferred).T_camera_lidar
    alike = sorted((end for end in polished.ends if not _differ(end.T_camera_lidar, pose)), key=lambda end: -end.rank)
    return tuple(end.T_camera_lidar for end in alike)


def basin_metrics(
    fusion: Fusion, polished: PolishedBasins, pose: Matrix4, config: CalibrationConfig
) -> tuple[tuple[Metric, ...], tuple[Matrix4, ...]]:
    """How far the basin of a pose (4, 4) stands out from the others, and the poses (4, 4) of those that it does not
    stand out from; none of them if they are too many to be tried on the sharpest edges."""
    contrast, limits = fusion.edge_contrast(pose), config.verdict
    ambiguous = limits.max_runner_up * contrast
    others = (*polished.implausible, *(end.T_camera_lidar for end in polished.ends))
    rivals = _rivals(fusion, [other for other in others if _differ(other, pose)], pose, ambiguous)
    ties = tuple(other for rival, other in rivals if rival > ambiguous)
    metrics = (
        Metric("edge_contrast", contrast, limits.min_edge_contrast, at_least=True),
        Metric("runner_up", runner_up(contrast, [rival for rival, _ in rivals]), limits.max_runner_up, at_least=False),
    )
    return metrics, ties if len(ties) <= MOST_RIVALS else ()


def settle_basin(
    fusion: Fusion,
    edges: EdgeCue,
    summits: Sequence[Matrix4],
    evaluations: int,
    data: WindowData,
    config: CalibrationConfig,
) -> tuple[FusedObjective, SearchResult]:
    """The objective on the sharpest edges, balanced in the basin of some poses (4, 4), and its highest summit in that
    basin. `evaluations` were made before and are included in the result."""
    highest = summits[0]
    leading, finest = fusion.settling(edges)
    if fusion.depth_contrast(highest) >= TELLING:
        finest = finest.with_depth(_denser(data, fusion.depth, highest, config))
    settled = [
        polish_in_turn((leading, finest), summit, config.search, data.progress) for summit in summits[:SETTLED_POSES]
    ]
    best = max(settled, key=lambda end: finest.evaluate(end.T_camera_lidar).score)
    search = replace(best, evaluations=evaluations + sum(end.evaluations for end in settled))
    if at_rim(best.T_camera_lidar, fusion.start, fusion.reach):
        search = replace(search, stop_reason=StopReason.AT_BOUND)
    return finest, search


def _with_ranks(fusion: Fusion, poses: Sequence[Matrix4]) -> list[RankedPose]:
    return [RankedPose(rank, pose) for rank, pose in zip(fusion.ranks(poses), poses, strict=True)]


def _rivals(fusion: Fusion, others: Sequence[Matrix4], pose: Matrix4, ambiguous: float) -> list[tuple[float, Matrix4]]:
    """Edge contrasts and poses of those of `others` (4, 4) that are summits beside `pose` (4, 4), one for each basin:
    all whose contrast is larger than `ambiguous`, else the largest one; an empty list if none is a summit.

    A climb may also end on the shoulder of the hill whose top is `pose`, because turns and shifts make up for each
    other. From a shoulder the way to the top never leads down, so it is no rival.
    """
    rivals: list[tuple[float, Matrix4]] = []
    contrasts = fusion.edge_contrasts(np.array(others).reshape(-1, 4, 4))
    for contrast, other in sorted(zip(contrasts, others, strict=True), key=lambda item: -item[0]):
        if rivals and contrast <= ambiguous:
            break
        if any(not _differ(other, known) for _, known in rivals):
            continue
        difference = se3.difference(other, pose)
        if any(fusion.edge_contrast(se3.perturb(pose, share * difference)) < contrast for share in BETWEEN):
            rivals.append((contrast, other))
    return rivals


def log_prior(T_camera_lidar: Matrix4, start: Matrix4, known_to_rad: float) -> float:
    """Log prior of a pose (4, 4) relative to that of the start (4, 4), which is known to `known_to_rad`: nats, 0 at the
    start and negative elsewhere.

    A calibrated mount seldom moves, and seldom far. The prior is a density of the angle θ between the pose and the
    start, per volume of rotations. It falls like Cauchy's in three dimensions (Student's with one degree of freedom,
    the longest tails of the family): p(θ) ∝ (1 + θ² / s²)⁻². Its scale s is the error that creep, temperature and a
    workshop leave. A displacement has no typical size, so the tails are long: 3° are 7 nats less likely than 0°, 25°
    are 16. The evidence of a street outweighs that several times over; that of a tunnel, where some pose among a
    hundred thousand always fits by chance, does not.
    """
    turned = se3.rotation_angle_rad(T_camera_lidar @ se3.inverse(start)) / known_to_rad
    return -2.0 * log1p(turned * turned)


def least_range_edges(config: CalibrationConfig) -> float:
    """How many range jumps a window must have: in proportion to the degrees of freedom.

    The more poses there are to try, the better one of them fits by chance: the largest of N normal deviates grows as
    √(2·ln N), a significance as the root of the jumps. With the translations within 20 cm, N is ten thousand times as
    large as for the rotations within 10° alone.
    """
    return config.verdict.min_range_edges * config.search.dof / 3.0


def runner_up(contrast: float, rivals: Sequence[float]) -> float:
    """The largest edge contrast of the rivals over that of the pose; 0 if no rival stands out at all.

    NaN if the pose itself does not stand out, so that the metric passes no limit.
    """
    return max((0.0, *rivals)) / contrast if contrast > 0.0 else nan


ESTIMATORS: Mapping[str, Estimator] = MappingProxyType({"mi": by_depth, "fused": by_fusion, "intensity": by_intensity})


def solve(data: WindowData, config: CalibrationConfig) -> EstimatorResult:
    """What the estimator of the configured objective finds in a window.

    Raises:
        CalibrationError: the window has no pairs, a frame has no usable depth, or no point can come into view.
    """
    if not data.window.pairs:
        raise CalibrationError("the window holds no pairs of a camera frame and a sweep: check the stamps of both")
    return ESTIMATORS[config.objective.kind](data, config)


def depth_features(
    data: WindowData, T_camera_lidar: Matrix4, at_most: int | None = None
) -> list[mutual_information.Features]:
    """What mutual information compares in every pair, with the camera at `T_camera_lidar` (4, 4). Every sweep gives the
    same share of its points, so that about `at_most` are used in all.

    Raises:
        CalibrationError: a frame has no usable depth.
    """
    counts = [len(pair.lidar.xyz_m) for pair in data.window.pairs]
    share = 1.0 if at_most is None else min(1.0, at_most / max(sum(counts), 1))
    return [
        mutual_information.distance_and_depth(
            data.points(index, _share_of(counts[index], share)), depth, T_camera_lidar
        )
        for index, depth in enumerate(data.depths())
    ]


def _share_of(count: int, share: float) -> Choice:
    return EVERY if share >= 1.0 else thinned(count, _number(count, share))


def _number(count: int, share: float) -> int:
    return count if share >= 1.0 else round(share * count)


def _denser(
    data: WindowData, depth: mutual_information.MutualInformation, pose: Matrix4, config: CalibrationConfig
) -> mutual_information.MutualInformation:
    """The depth cue with about `SEEN_DEPTH_POINTS` in view at `pose` (4, 4); unchanged if at least half as many are
    in view there already. At least one point must be in view there."""
    seen = depth.evaluate(pose).points_in_view
    if 2 * seen >= SEEN_DEPTH_POINTS:
        return depth
    counts = [len(pair.lidar.xyz_m) for pair in data.window.pairs]
    leading = [_number(count, LEADING_DEPTH_POINTS / sum(counts)) for count in counts]
    share, points, times = SEEN_DEPTH_POINTS / seen * sum(leading) / sum(counts), [], []
    for index, (count, led) in enumerate(zip(counts, leading, strict=True)):
        indices = thinned(count, _number(count, share))
        times.append(len(indices) / max(led, 1))
        indices = indices[depth.may_see(data.window.pairs[index].lidar.xyz_m[indices], pose, DISPLACED)]
        points.append(mutual_information.distances(data.points(index, indices), pose))
    return depth.with_points(points, np.array(times), pose, SETTLING, config.objective)


def _by_mutual_information(
    frames: list[mutual_information.Features], data: WindowData, config: CalibrationConfig
) -> EstimatorResult:
    start, progress = data.window.T_camera_lidar_start, data.progress
    objective: mutual_information.MutualInformation = mutual_information.build_mutual_information(
        frames, data.window.rig, start, box_of(config.search), config.objective
    )
    search = maximise(objective, start, config.search, progress)
    mi, unrelated = objective.evaluate(search.T_camera_lidar).mi, objective.mi_of_unrelated(search.T_camera_lidar)
    ratio = Metric("mi_over_unrelated", mi / max(unrelated, 1e-12), config.verdict.min_mi_over_unrelated, at_least=True)
    return EstimatorResult(objective, search, (ratio,))


def _differ(a: Matrix4, b: Matrix4) -> bool:
    return _angle_rad(a, b) > SAME_BASIN_RAD


def _angle_rad(a: Matrix4, b: Matrix4) -> float:
    return se3.rotation_angle_rad(a @ se3.inverse(b))
