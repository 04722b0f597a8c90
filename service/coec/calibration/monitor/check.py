"""A short check of a few pairs: where both witnesses put the extrinsic near a pose, and how good the pose itself is.

What a full calibration does within tens of degrees, a check does within `REACH_RAD` of the pose it is asked about, and
in all six degrees of freedom whatever the calibration searches: a shifted mount must be seen even where only rotations
are estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.landscape import Landscape
from coec.calibration.confidence.noise import measure_noise
from coec.calibration.estimators import DEPTH_POINTS, Sight, depth_features
from coec.calibration.monitor.sensor_faults import SceneFacts, scene_facts
from coec.calibration.objective.curvature import axis_derivatives
from coec.calibration.objective.edges import THINNED_POINTS, EdgesAlone, EdgeWitness, build_edges
from coec.calibration.objective.fused import Fusion
from coec.calibration.objective.mutual_information import (
    Features,
    Objective,
    SearchBox,
    build_mutual_information,
)
from coec.calibration.ports import Silence
from coec.calibration.search.global_search import find_basins
from coec.calibration.search.local_search import near, polish_in_turn
from coec.calibration.types import FramePair, Matrix4, Rig
from coec.config import CalibrationConfig, SearchConfig
from coec.geometry import se3
from coec.geometry.cameras import in_image
from coec.geometry.edges.alignment import EdgeFrames, significances
from coec.geometry.edges.charts import EdgeCharts
from coec.geometry.projection import project
from coec.geometry.thinning import thinned

REACH_RAD = radians(4.0)
"""How far about the pose a check searches. A pose further off leaves the local optimum at the rim, or nowhere: both are
far beyond any limit."""

BASINS = 2
"""Maxima that both witnesses rank: what a few pairs have two of, all blurs together have one of."""

NEAR_SHARE = 0.9
"""Of the significance of the best maximum within reach on the sharpest edges, from which the one next to the pose is
believed instead: a mount that is as it was is far likelier than one that moved to a place which fits hardly better.
Between guard rails, lane markings and a horizon, all of which run to one point, edges fit nearly as well a degree
beside. Of 180 checks of right mounts on simulated drives 27 with clear edges ended more than 0.45° off, most of them on
highways; with this 15, of which 14 have few edges in view. From 0.8 to 0.95 it is 14 to 16."""

ROTATION_DOF, POSE_DOF = 3, 6
"""Axes of ξ that the two optima of a check are searched over: rotations, and all."""

NO_BIAS = np.zeros(6)
"""Of a rig that was not commissioned: its optimum is expected at the pose itself."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckInput:
    """Some pairs with all that a check at any pose needs, decoded and inferred. Entries are per pair, in order."""

    rig: Rig
    pairs: tuple[FramePair, ...]
    features: tuple[Features, ...]
    edges: EdgeWitness
    scenes: tuple[SceneFacts, ...]

    def of(self, indices: Sequence[int]) -> CheckInput:
        """That of some of the pairs alone, by their indices."""
        return CheckInput(
            self.rig,
            tuple(self.pairs[i] for i in indices),
            tuple(self.features[i] for i in indices),
            _witness_of(self.edges, indices),
            tuple(self.scenes[i] for i in indices),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """What a check at a pose tells. Derivatives are those of mutual information (Borer et al. 2023), at the pose, over
    rx ry rz tx ty tz; equation (2) takes those of the rotations.

    Attributes:
        T_rotation: (4, 4) local optimum of both witnesses over rotations, the camera's centre being that of the pose.
        T_pose: (4, 4) local optimum over all six degrees of freedom.
        offset_rotation, offset_pose: (6,) ξ from the pose to these (rad, m).
        mi: equation (1), nats.
        first_derivative: (6,) ∂MI/∂ξ, nats per radian or metre.
        second_derivative: (6,) -∂²MI/∂ξ², nats per radian² or metre²; positive at a maximum.
        edges: significance of the edges at the pose.
        edges_at_best: that at the local optimum over rotations.
        edges_in_view: range edges that lie in the images there, of all pairs.
        looks: how many independent looks the pairs are worth over rotations, see `Noise`; 1 where they do not tell.
        edges_kept: that of the finest band where the optimum is expected, over that where it is.
        contrast: how far the edges at the local optimum stand above other poses within reach, standard deviations.
        agreement_rad: angle between the local optima of the two witnesses.
        overlap: points in view over the most that any pose within reach sees.
        deficit: score of the local optimum less that of the pose, in standard deviations of the score.
    """

    pairs: int
    T_rotation: Matrix4
    T_pose: Matrix4
    offset_rotation: NDArray[np.float64]
    offset_pose: NDArray[np.float64]
    mi: float
    first_derivative: NDArray[np.float64]
    second_derivative: NDArray[np.float64]
    edges: float
    edges_at_best: float
    edges_in_view: int
    looks: float
    edges_kept: float
    contrast: float
    agreement_rad: float
    overlap: float
    deficit: float

    @property
    def f1(self) -> float:
        """Largest slope of the rotations, nats per radian."""
        return float(np.max(np.abs(self.first_derivative[:ROTATION_DOF])))

    @property
    def f2(self) -> float:
        """Least peakedness of the rotations, nats per radian²."""
        return float(np.min(self.second_derivative[:ROTATION_DOF]))


def gather(sight: Sight) -> CheckInput:
    """Decodes and infers everything that checks of the pairs of `sight` need.

    Raises:
        CalibrationError: an image cannot be decoded, a frame has no depth, no sweep has a range edge.
    """
    window, greys = sight.window, list(sight.greys())
    # Edges first: depth may be inferred meanwhile.
    edges = build_edges(window.pairs, sight.points, greys, window.rig)
    features = depth_features(sight, window.T_camera_lidar_start, DEPTH_POINTS)
    counts = np.diff(edges.whole.first_point)
    scenes = [
        scene_facts(pair, grey, int(count)) for pair, grey, count in zip(window.pairs, greys, counts, strict=True)
    ]
    return CheckInput(window.rig, window.pairs, tuple(features), edges, tuple(scenes))


def check_at(
    evidence: CheckInput, pose: Matrix4, config: CalibrationConfig, bias: NDArray[np.float64] = NO_BIAS
) -> Check:
    """A check at `pose` (4, 4), from which the optimum over rotations is expected at ξ = `bias` (6,).

    Raises:
        CalibrationError: no point can come into view.
    """
    reach = SearchBox(REACH_RAD, 0.0)
    depth = build_mutual_information(evidence.features, evidence.rig, pose, reach, config.objective)
    fusion = Fusion(evidence.edges, depth, pose, reach)
    rotation = config.search.model_copy(update={"dof": ROTATION_DOF})

    def polished(objectives: Sequence[Objective], start: Matrix4, search: SearchConfig = rotation) -> Matrix4:
        return polish_in_turn(objectives, start, search, Silence()).T_camera_lidar

    basins = [basin.T_camera_lidar for basin in find_basins(evidence.edges, pose, reach)]
    ranked = sorted(basins, key=fusion.rank, reverse=True)[:BASINS]
    to_rank = near(rotation, fusion.ranking[-1])
    best = max((polished(fusion.ranking, basin, to_rank) for basin in ranked), key=fusion.rank)
    farther, nearer = polished(fusion.settling, best), polished(fusion.settling[-1:], pose)
    T_rotation = nearer if _as_significant(evidence.edges.sharp, nearer, farther) else farther
    in_all = config.search.model_copy(update={"dof": POSE_DOF})
    # By two ways, as blurred edges can lead six degrees of freedom astray.
    ways = (fusion.settling, (fusion.ranking[-1], *fusion.settling[1:]))
    ends = [polished(way, T_rotation, in_all) for way in ways]
    farther, nearer = (
        max(ends, key=lambda end: fusion.settling[-1].evaluate(end).score),
        polished(fusion.settling[-1:], pose, in_all),
    )
    T_pose = nearer if _as_significant(evidence.edges.sharp, nearer, farther) else farther
    of_edges = EdgesAlone(evidence.edges.whole, evidence.edges.blur_rad)
    T_edges, T_depth = polished([of_edges], T_rotation), polished([depth], T_rotation)
    landscape = Landscape.about(fusion.settling[-1].cells(T_rotation), T_rotation, tuple(range(ROTATION_DOF)))
    noise = measure_noise(landscape)
    at_pose = fusion.settling[0].evaluate(pose)
    first_derivative, second_derivative = axis_derivatives(depth, pose)
    return Check(
        pairs=len(evidence.pairs),
        T_rotation=T_rotation,
        T_pose=T_pose,
        offset_rotation=se3.difference(T_rotation, pose),
        offset_pose=se3.difference(T_pose, pose),
        mi=at_pose.mi,
        first_derivative=first_derivative,
        second_derivative=second_derivative,
        edges=of_edges.evaluate(pose).score,
        edges_at_best=of_edges.evaluate(T_rotation).score,
        edges_in_view=_in_view(evidence.edges.sharp, T_rotation),
        looks=1.0 if noise is None else noise.looks,
        edges_kept=_kept(evidence.edges.bands[0], se3.perturb(pose, bias), T_rotation),
        contrast=fusion.edge_contrast(T_rotation),
        agreement_rad=se3.rotation_angle_rad(T_edges @ se3.inverse(T_depth)),
        overlap=at_pose.overlap,
        deficit=fusion.settling[0].evaluate(T_rotation).score - at_pose.score,
    )


def _as_significant(sharp: EdgeFrames, nearer: Matrix4, farther: Matrix4) -> bool:
    """Whether the edges at a pose are nearly as significant as at another."""
    near, far = significances(sharp, np.stack([nearer, farther])).tolist()
    return bool(near >= NEAR_SHARE * far)


def _in_view(edges: EdgeFrames, T_camera_lidar: Matrix4) -> int:
    """How many range edges lie in the images."""
    p_camera = np.einsum("ij,jn->ni", T_camera_lidar[:3, :3], edges.xyz_m.astype(np.float64)) + T_camera_lidar[:3, 3]
    uv_px, valid = project(edges.camera, p_camera)
    return int(np.count_nonzero(valid & in_image(edges.camera, uv_px)))


def _kept(band: EdgeFrames, T_expected: Matrix4, T_best: Matrix4) -> float:
    expected, best = significances(band, np.stack([T_expected, T_best])).tolist()
    return float(expected / best) if best > 0.0 else 1.0  # an optimum without edges has none to lose


def _witness_of(edges: EdgeWitness, indices: Sequence[int]) -> EdgeWitness:
    coarse, fine = (_charts_of(charts, indices) for charts in edges.charts)
    kept = thinned(len(coarse.weight), THINNED_POINTS)
    return replace(
        edges,
        sharp=_frames_of(edges.sharp, indices),
        whole=_frames_of(edges.whole, indices),
        bands=tuple(_frames_of(band, indices) for band in edges.bands),
        charts=(coarse, fine),
        thinned=(coarse.of_points(kept), fine.of_points(kept)),
    )


def _charts_of(charts: EdgeCharts, indices: Sequence[int]) -> EdgeCharts:
    """The range edges of some frames; the charts of the others stay where they are."""
    return charts.of_points(np.flatnonzero(np.isin(charts.frame, np.asarray(indices))))


def _frames_of(frames: EdgeFrames, indices: Sequence[int]) -> EdgeFrames:
    first = frames.first_point
    rows = np.concatenate([np.arange(first[i], first[i + 1]) for i in indices])
    counts = [first[i + 1] - first[i] for i in indices]
    return replace(
        frames,
        xyz_m=np.ascontiguousarray(frames.xyz_m[:, rows]),
        weight=frames.weight[rows],
        first_point=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        maps=np.ascontiguousarray(frames.maps[list(indices)]),
    )
