"""Solves a window without an initial guess: any rotation between camera and LiDAR, and, with six degrees of freedom,
the camera anywhere within some metres.

The basins of the edges over all rotations (`free_rotation`) are ranked by both cues, each like a basin about a start of
its own. The best become starts of the ordinary solver. Nothing is known before, so that the prior of the pose is flat,
every other candidate is a rival, and the pose has to stand out from as many more poses as were possible.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot, inf, log, pi, radians, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.scan_axis import upright_turn, with_turned_clouds
from coec.calibration.objective import mutual_information
from coec.calibration.objective.edges import RANGE, EdgeCue, build_edges
from coec.calibration.objective.fused import Fusion
from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.pipeline import estimate_of
from coec.calibration.search.free_rotation import FARTHEST_M, find_free_basins
from coec.calibration.search.global_search import sample_reach
from coec.calibration.solver import (
    SAME_BASIN_RAD,
    EstimatorResult,
    RankedBasins,
    WindowData,
    polish_basins,
    prepare_window_data,
    runner_up,
    solve,
)
from coec.calibration.types import (
    CameraFrame,
    DepthMap,
    DepthModel,
    Estimate,
    ImageReader,
    Matrix4,
    Progress,
    Window,
)
from coec.config import CalibrationConfig
from coec.errors import CalibrationError, UsageError
from coec.geometry import se3
from coec.geometry.edges.charts import charted_significances
from coec.geometry.points import thinned

SHORTLISTED, OTHER_POSES, SHORTLIST_POINTS = 16, 64, 20_000
"""So many basins are ranked by both cues: those that stand out most among so many other poses within the reach of the
solver, by so many edges on the charts. A significance alone is larger where more is in view, also of wrong poses."""

RANKING_DEPTH_POINTS = 40_000
"""Points of the window's clouds that rank a basin by depth."""

SOLVED, COMPARABLE = 4, 0.7
"""At most so many candidates are solved: those with at least this share of the best rank."""

NEIGHBOURS_RAD = radians(8.0)
"""A candidate this near to a better one is not solved: the solver finds the better one from either."""


@dataclass(frozen=True, slots=True)
class Weighed:
    """How many poses a search without a start weighed: rotations that were compared, maxima of them that ascended,
    basins that were ranked by both cues, and candidates that were solved."""

    rotations: int
    ascended: int
    ranked: int
    solved: int


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A pose (4, 4), and how far it stands out to the edges, to depth and to both, standard deviations. `in_view`:
    whether as much is in view as the verdict demands."""

    T_camera_lidar: Matrix4
    edges: float
    depth: float
    in_view: bool

    @property
    def rank(self) -> tuple[bool, float]:
        return self.in_view, hypot(max(self.edges, 0.0), max(self.depth, 0.0))


def without_start(window: Window) -> Window:
    """The window with nothing known of the pose, except where the camera is in the LiDAR's frame."""
    return replace(window, start_known_to_rad=inf)


def calibrate_without_start(
    window: Window, depth: DepthModel, images: ImageReader, config: CalibrationConfig, progress: Progress
) -> tuple[Estimate, Weighed]:
    """The estimate of a window with an unknown start, as `pipeline.calibrate` gives it about a known one.

    With three degrees of freedom the camera's centre in the frame of the LiDAR is that of the window's start.

    Raises:
        UsageError: the objective is not `fused`.
        CalibrationError: no pose brings enough edges into view, or as in `pipeline.calibrate`.
    """
    if config.objective.kind != "fused":
        raise UsageError("without a start, only the objective fused can search: --objective fused")
    if not window.pairs:
        raise CalibrationError("the window holds no pairs of a camera frame and a sweep: check the stamps of both")
    turn, config = upright_turn(window), _stricter(config)
    turned = window if np.array_equal(turn, np.eye(4)) else with_turned_clouds(window, turn)
    data = prepare_window_data(turned, _DepthCache(depth), _ImageCache(images), config, progress)
    result, started, weighed = _solve(data, config)
    estimate = estimate_of(result, started, config)
    pose, moved = estimate.optimum.T_camera_lidar @ turn, estimate.moved
    if moved is not None:
        moved = replace(moved, T_before=moved.T_before @ turn, T_after=moved.T_after @ turn)
    return replace(
        estimate,
        optimum=replace(estimate.optimum, T_camera_lidar=pose),
        correction=se3.difference(pose, window.rig.T_camera_lidar_nominal),
        moved=moved,
    ), weighed


def _solve(data: WindowData, config: CalibrationConfig) -> tuple[EstimatorResult, WindowData, Weighed]:
    """The best solution, and the window with its candidate as start."""
    window, turns_only = data.window, config.search.dof == 3
    place_m = se3.inverse(window.T_camera_lidar_start)[:3, 3] if turns_only else np.zeros(3)
    # No axis of the LiDAR has a known direction in the image.
    rig = replace(window.rig, T_camera_lidar_nominal=np.eye(4))
    # Over all rotations, rows of paint and joints fit many poses; silhouettes, where there are any, fit few.
    edges = build_edges(window.pairs, data.points, data.greys(), rig).kinds_alone[RANGE]
    basins = find_free_basins(edges, place_m, turns_only=turns_only)
    data.progress.step("basins", 1, 1)
    search = config.search
    reach = SearchBox(radians(search.reach_deg), 0.0 if turns_only else search.reach_m)
    candidates = _ranked(edges, data, _shortlist(edges, basins.poses, reach), reach, config)
    if not candidates:
        raise CalibrationError("no pose of the camera brings range edges into view: check the mask and the intrinsics")
    ends = [_solved(candidate, data, place_m, config) for candidate in _to_solve(candidates)]
    best, result, started = max(ends, key=lambda end: hypot(*_contrasts(end[1]), max(end[0].depth, 0.0)))
    pose = result.search.T_camera_lidar
    rivals = [
        one.edges
        for one in candidates
        if one is not best and one.in_view and _angle_rad(one.T_camera_lidar, pose) > SAME_BASIN_RAD
    ]
    weighed = Weighed(basins.rotations, basins.ascended, len(candidates), len(ends))
    return _with_rivals(result, rivals), started, weighed


def _shortlist(edges: EdgeCue, poses: NDArray[np.float64], reach: SearchBox) -> NDArray[np.float64]:
    """The basins (K, 4, 4) that stand out most among the poses about them."""
    about = np.concatenate([np.concatenate([pose[None], sample_reach(pose, reach, OTHER_POSES)]) for pose in poses])
    of_charts = [charted_significances(charts.at_most(SHORTLIST_POINTS), about) for charts in edges.charts]
    z = np.mean(of_charts, axis=0).reshape(len(poses), -1)
    contrast = (z[:, 0] - z[:, 1:].mean(axis=1)) / np.maximum(z[:, 1:].std(axis=1), 1e-9)
    return np.asarray(poses[np.argsort(-contrast, kind="stable")[:SHORTLISTED]])


def _ranked(
    edges: EdgeCue, data: WindowData, poses: NDArray[np.float64], reach: SearchBox, config: CalibrationConfig
) -> list[_Candidate]:
    """The polished basins (K, 4, 4) with something in view, best first."""
    window = data.window
    per_sweep = max(RANKING_DEPTH_POINTS // len(window.pairs), 1)
    points = [data.points(k, thinned(len(pair.lidar.xyz_m), per_sweep)) for k, pair in enumerate(window.pairs)]
    maps, candidates = data.depths(), []
    for pose in poses:
        features = [
            mutual_information.distance_and_depth(some, depth, pose) for some, depth in zip(points, maps, strict=True)
        ]
        try:
            depth = mutual_information.build_mutual_information(features, window.rig, pose, reach, config.objective)
        except CalibrationError:  # nothing in view
            continue
        fusion = Fusion(edges, depth, pose, reach)
        (end,) = polish_basins(fusion, RankedBasins((), (), start_is_plausible=True), config.search, data.progress).ends
        overlap = depth.evaluate(end.T_camera_lidar).overlap
        candidates.append(
            _Candidate(
                end.T_camera_lidar,
                fusion.edge_contrast(end.T_camera_lidar),
                fusion.depth_contrast(end.T_camera_lidar),
                overlap >= config.verdict.min_overlap,
            )
        )
    return sorted(candidates, key=lambda one: one.rank, reverse=True)


def _to_solve(candidates: list[_Candidate]) -> list[_Candidate]:
    selected: list[_Candidate] = []
    for one in candidates:
        comparable = one.rank >= (candidates[0].in_view, COMPARABLE * candidates[0].rank[1])
        if comparable and all(_angle_rad(one.T_camera_lidar, o.T_camera_lidar) > NEIGHBOURS_RAD for o in selected):
            selected.append(one)
    return selected[:SOLVED]


def _solved(
    candidate: _Candidate, data: WindowData, place_m: NDArray[np.float64], config: CalibrationConfig
) -> tuple[_Candidate, EstimatorResult, WindowData]:
    """The ordinary solution from a candidate. Along translations that the window does not determine, the centre of the
    camera stays at `place_m`."""
    pose = candidate.T_camera_lidar
    rig = replace(data.window.rig, T_camera_lidar_nominal=pose)
    window = replace(data.window, rig=rig, T_camera_lidar_start=pose, start_known_to_rad=inf)
    result = solve(replace(data, window=window), config)
    held = pose.copy()
    held[:3, 3] = -np.einsum("ij,j->i", pose[:3, :3], place_m)
    return candidate, result, replace(data, window=replace(window, T_camera_lidar_start=held))


def _edge_contrast(result: EstimatorResult) -> float:
    return next(metric.value for metric in result.metrics if metric.name == "edge_contrast")


def _contrasts(result: EstimatorResult) -> tuple[float, float]:
    """The edge contrasts on blurred and on the sharpest edges, 0 if negative. A wrong pose whose blurred edges fit by
    chance seldom has sharp ones that do."""
    sharp = result.objective.evaluate(result.search.T_camera_lidar).edge_contrast
    return max(_edge_contrast(result), 0.0), max(sharp, 0.0)


def _with_rivals(result: EstimatorResult, rivals: Sequence[float]) -> EstimatorResult:
    """The result with the edge contrasts of all rivals."""
    of_all = runner_up(_edge_contrast(result), rivals)
    metrics = (
        replace(metric, value=max(metric.value, of_all)) if metric.name == "runner_up" else metric
        for metric in result.metrics
    )
    return replace(result, metrics=tuple(metrics), rivals=())


def _stricter(config: CalibrationConfig) -> CalibrationConfig:
    """The configuration with the limits of significance for all poses, not only those within the reach of a start."""
    reach_rad = radians(config.search.reach_deg)
    # One over the share of all rotations that are no larger than an angle.
    more_poses = pi / (reach_rad - sin(reach_rad))
    if config.search.dof == 6:
        more_poses *= max(FARTHEST_M / config.search.reach_m, 1.0) ** 3
    limits = {
        name: limit_for_more_poses(getattr(config.verdict, name), more_poses)
        for name in ("min_edge_contrast", "min_edges_once")
    }
    return config.model_copy(update={"verdict": config.verdict.model_copy(update=limits)})


def limit_for_more_poses(limit: float, more_poses: float) -> float:
    """The limit of a significance, standard deviations, at which the best of `more_poses` (a factor) times as many
    wrong poses passes as rarely: the tail of a normal deviate falls with half its square."""
    return sqrt(limit * limit + 2.0 * log(more_poses))


def _angle_rad(a: Matrix4, b: Matrix4) -> float:
    return se3.rotation_angle_rad(a @ se3.inverse(b))


class _ImageCache:
    """An image reader that keeps what it has read: the images of a window are used once for every candidate."""

    def __init__(self, images: ImageReader) -> None:
        self._images = images
        self._cache: dict[int, NDArray[np.uint8]] = {}

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        if frame.stamp_ns not in self._cache:
            self._cache[frame.stamp_ns] = self._images.grey(frame)
        return self._cache[frame.stamp_ns]


class _DepthCache:
    """A depth model that keeps what it has inferred."""

    def __init__(self, depth: DepthModel) -> None:
        self._depth = depth
        self._cache: dict[int, DepthMap] = {}

    @property
    def identity(self) -> str:
        return self._depth.identity

    def infer(self, frame: CameraFrame) -> DepthMap:
        if frame.stamp_ns not in self._cache:
            self._cache[frame.stamp_ns] = self._depth.infer(frame)
        return self._cache[frame.stamp_ns]
