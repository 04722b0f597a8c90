"""Two independent cues in one objective: edges, sharp and unbiased, and depth, broad and blind to texture.

Each is counted in standard deviations of its own score over other poses within reach, so neither needs a weight: a
useless network adds only noise of one unit, and so does a scene without edges (METHOD, section 3, "complement").
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from math import hypot, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective import mutual_information
from coec.calibration.objective.edges import KIND_NAMES, KINDS, EdgeCue, in_reach
from coec.calibration.search.global_search import sample_reach
from coec.calibration.types import CueShare, Matrix4
from coec.geometry import se3
from coec.geometry.cameras import in_image
from coec.geometry.edges import alignment
from coec.geometry.edges.charts import charted_significances
from coec.geometry.edges.image_edges import VOID
from coec.geometry.projection import half_field_of_view_rad, project

OTHER_POSES = 64
"""Poses within reach from which the mean and the standard deviation of a score are taken; they are then known to an
eighth."""

OTHER_POSES_RAD = radians(28.0)
"""For the edges these poses come from at least this reach, however small that of the search: nearer to the truth, poses
share too much of the scene's layout with it to stand for wrong ones."""

NEARBY = mutual_information.SearchBox(radians(10.0), 1.0)
"""How far from the pose of their division cells are evaluated: to where the hill certainly drops, and to other summits
of the basin. Edges that come into view only farther off are in no cell."""

BEYOND = mutual_information.SearchBox(radians(8.0), 0.5)
"""How far outside of the reach a polish may end: by its box of four blurs, and by the box of the next level."""


CELL_STEP = 0.25
"""Difference step of the cells, in blurs of the edges: half a pixel on the sharpest. With a step of a whole blur the
differences reach over the rim of the hill. See docs/measured.md."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Mean and standard deviation of a score over other poses."""

    mean: float
    deviation: float

    @classmethod
    def of(cls, scores: NDArray[np.float64]) -> Scale:
        # A score that does not vary at all says nothing, but must not cause a division by zero.
        return cls(float(scores.mean()), max(float(scores.std()), 1e-9))

    def standard(self, score: float) -> float:
        return (score - self.mean) / self.deviation


class FusedObjective:
    """Standardised edge significance at one blur plus standardised mutual information, for each frame and on
    average.

    Attributes:
        edge_scale: of the significance of its edges at other poses.
    """

    def __init__(
        self,
        edges: alignment.EdgeFrames,
        step_rad: float,
        depth: mutual_information.MutualInformation,
        edge_scale: Scale,
        of_depth: Scale,
    ):
        self._edges, self._depth = edges, depth
        self.edge_scale, self._of_depth = edge_scale, of_depth
        self._step_rad = step_rad

    @property
    def step_rad(self) -> float:
        """The blur of the edges, or more, because the hill of the sharpest edges has ripples a pixel wide."""
        return self._step_rad

    def with_depth(self, depth: mutual_information.MutualInformation) -> FusedObjective:
        """The same edges with another depth cue, on the same scale."""
        return FusedObjective(self._edges, self._step_rad, depth, self.edge_scale, self._of_depth)

    def evaluate(self, T_camera_lidar: Matrix4) -> mutual_information.Evaluation:
        """The objective at `T_camera_lidar` (4, 4), in standard deviations."""
        return self._fused(alignment.frame_alignment(self._edges, T_camera_lidar), self._depth.evaluate(T_camera_lidar))

    def evaluate_each(self, poses: NDArray[np.float64]) -> list[mutual_information.Evaluation]:
        """The same at each of many poses (K, 4, 4)."""
        edges, depth = alignment.alignments(self._edges, poses), self._depth.evaluate_each(poses)
        return [self._fused(edges.at(k), of_depth) for k, of_depth in enumerate(depth)]

    def _fused(self, edges: alignment.Alignment, depth: mutual_information.Evaluation) -> mutual_information.Evaluation:
        frame_scores = (edges.of_frames - self.edge_scale.mean) / self.edge_scale.deviation
        frame_scores = frame_scores + (depth.frame_scores - self._of_depth.mean) / self._of_depth.deviation
        return mutual_information.Evaluation(
            score=float(frame_scores.mean()),
            frame_scores=frame_scores,
            mi=depth.mi,
            overlap=depth.overlap,
            points_in_view=depth.points_in_view,
            edge_contrast=self.edge_scale.standard(edges.significance),
        )

    def cells(self, T_camera_lidar: Matrix4) -> mutual_information.Cells:
        """The edges by sectors of the image, and depth, which cannot be divided, as one more sector."""
        every = self._edges
        half_view_rad = half_field_of_view_rad(every.camera, every.maps[0] != VOID)
        edges = in_reach(every, half_view_rad, T_camera_lidar, NEARBY)
        p_camera = (
            np.einsum("ij,jn->ni", T_camera_lidar[:3, :3], edges.xyz_m.astype(np.float64)) + T_camera_lidar[:3, 3]
        )
        uv_px, valid = project(edges.camera, p_camera)
        seen = valid & in_image(edges.camera, uv_px)
        frame = np.repeat(np.arange(len(edges.maps)), np.diff(edges.first_point))
        # Edges outside the image count with the first sector if a step brings them into view.
        sector = np.zeros(len(p_camera), np.uint8)
        sector[seen] = mutual_information.sectors(uv_px[seen])

        def at(poses: NDArray[np.float64]) -> NDArray[np.float64]:
            cells = np.empty((len(poses), len(edges.maps), mutual_information.COLUMNS * mutual_information.ROWS + 1))
            of_sectors = alignment.alignment_of_parts(
                edges, sector, mutual_information.COLUMNS * mutual_information.ROWS, poses
            )
            for k, of_depth in enumerate(self._depth.evaluate_each(poses)):
                square = float(of_sectors.square[k].sum())
                scale = len(edges.maps) / sqrt(max(square, alignment.LEAST_SQUARE)) / self.edge_scale.deviation
                cells[k, :, :-1] = of_sectors.strength[k] * scale
                cells[k, :, -1] = of_depth.frame_scores / self._of_depth.deviation
            return cells

        points = mutual_information.PointsInView(p_camera[seen], edges.weight[seen].astype(np.float64), frame[seen])
        return mutual_information.Cells(at, CELL_STEP * self._step_rad, points)

    def cue_shares(self, cue: EdgeCue, T_camera_lidar: Matrix4, dof: int) -> tuple[CueShare, ...]:
        """What range edges, reflectance edges and depth contribute near a pose (4, 4); `cue` has the edges of this
        objective, `dof` of its axes were searched."""
        moves = np.vstack([np.zeros(6), np.diag(se3.axis_steps(self._step_rad))[:dof]])
        poses = np.array([se3.perturb(T_camera_lidar, sign * move) for sign in (1.0, -1.0) for move in moves])
        sums = alignment.alignment_of_parts(cue.sharp, cue.kinds[0], KINDS, poses)
        scale = sqrt(max(float(sums.square[0].sum()), alignment.LEAST_SQUARE)) * self.edge_scale.deviation
        depth = self._depth.evaluate_each(poses)
        of_depth = np.array([at.score for at in depth]) / self._of_depth.deviation
        scores = np.column_stack([sums.strength.sum(axis=1) / scale, of_depth]).reshape(2, 1 + dof, KINDS + 1)
        curvature = np.maximum(2.0 * scores[0, 0] - scores[0, 1:] - scores[1, 1:], 0.0)
        total = curvature.sum(axis=1)
        shares = np.full((6, KINDS + 1), np.nan)
        shares[:dof][total > 0.0] = curvature[total > 0.0] / total[total > 0.0, None]
        alone = cue.significances(cue.sharp, T_camera_lidar)
        of_edges = tuple(
            CueShare(name, cue.count(kind), float(cue.balance[kind]), float(alone[kind]), shares[:, kind])
            for kind, name in enumerate(KIND_NAMES)
            if cue.count(kind)
        )
        standing_out = self._of_depth.standard(depth[0].score)
        return (*of_edges, CueShare("depth", depth[0].points_in_view, 1.0, standing_out, shares[:, KINDS]))


class Fusion:
    """Both cues of a window, with their scales frozen from poses within reach. Edges that come into view neither
    within the reach nor a little outside are left out.

    Attributes:
        edges, depth: the cues.
        start: (4, 4) the pose from which the reach is counted.
        reach: the half-widths of the search.
        ranking: the objectives on which a basin is polished in turn before it is ranked. The coarsest band is not among
            them, because the charts have settled it.
    """

    ranking: tuple[FusedObjective, ...]

    def __init__(
        self,
        edges: EdgeCue,
        depth: mutual_information.MutualInformation,
        start: Matrix4,
        reach: mutual_information.SearchBox,
    ) -> None:
        self.edges, self.depth, self.start, self.reach = edges, depth, start, reach
        poses = sample_reach(start, reach, OTHER_POSES)
        self._of_depth = Scale.of(np.array([at.score for at in depth.evaluate_each(poses)]))
        self._scale_about(start)
        of_bands = _scale_of_bands(edges, self._poses)
        self.ranking = tuple(
            FusedObjective(band, blur_rad, depth, of_bands, self._of_depth)
            for band, blur_rad in zip(self._visible(*edges.bands[-2::-1]), edges.band_blur_rad[-2::-1], strict=True)
        )

    def _scale_about(self, centre: Matrix4) -> None:
        of_edges = replace(self.reach, rotation_rad=max(self.reach.rotation_rad, OTHER_POSES_RAD))
        self._centre, self._poses = centre, sample_reach(centre, of_edges, OTHER_POSES)
        self._seen = mutual_information.SearchBox(
            of_edges.rotation_rad + BEYOND.rotation_rad, of_edges.translation_m + BEYOND.translation_m
        )
        self._kinds = [(self._visible(*cue.bands), _scale_of_bands(cue, self._poses)) for cue in self.edges.kinds_alone]

    def about(self, pose: Matrix4) -> Fusion:
        """The same with the contrasts of edges from other poses about `pose` (4, 4), where the search ended, instead of
        its start: sixty poses give a deviation to an eighth, and from each start another one."""
        fusion = copy(self)
        fusion._scale_about(pose)
        return fusion

    def settling(self, edges: EdgeCue) -> tuple[FusedObjective, FusedObjective]:
        """The objectives on which the best basin is polished in turn at the end: `edges` are those of this fusion,
        balanced at its pose (`EdgeCue.balanced_at`)."""
        whole, sharp = self._visible(edges.whole, edges.sharp)
        of_whole, of_sharp = (Scale.of(alignment.significances(level, self._poses)) for level in (whole, sharp))
        return (
            FusedObjective(whole, edges.blur_rad, self.depth, of_whole, self._of_depth),
            FusedObjective(sharp, edges.blur_rad, self.depth, of_sharp, self._of_depth),
        )

    def _visible(self, *levels: alignment.EdgeFrames) -> tuple[alignment.EdgeFrames, ...]:
        return tuple(in_reach(level, self.edges.half_view_rad, self._centre, self._seen) for level in levels)

    def edge_contrasts(self, poses: NDArray[np.float64]) -> list[float]:
        """How far the edge cue, averaged over its bands, stands above other poses at each of K poses (K, 4, 4);
        standard deviations. Those of two kinds of edges combine as in `ranks`."""
        by_kind = self.contrasts_by_kind(poses)
        if len(by_kind) == 1:
            return by_kind[0]
        return [hypot(*(max(contrast, 0.0) for contrast in of_pose)) for of_pose in zip(*by_kind, strict=True)]

    def edge_contrast(self, T_camera_lidar: Matrix4) -> float:
        """The same at one pose (4, 4)."""
        return self.edge_contrasts(T_camera_lidar[None])[0]

    def contrasts_by_kind(self, poses: NDArray[np.float64]) -> list[list[float]]:
        """How far each kind of edges by itself stands above other poses."""
        return [_contrasts(bands, scale, poses) for bands, scale in self._kinds]

    def depth_contrasts(self, poses: NDArray[np.float64]) -> list[float]:
        """How far the depth cue stands above other poses at each of K poses (K, 4, 4); standard deviations."""
        return [self._of_depth.standard(at.score) for at in self.depth.evaluate_each(poses)]

    def depth_contrast(self, T_camera_lidar: Matrix4) -> float:
        """The same at one pose (4, 4)."""
        return self.depth_contrasts(T_camera_lidar[None])[0]

    def ranks(self, poses: Sequence[Matrix4]) -> list[float]:
        """How far each of some poses (4, 4) stands out to range edges, reflectance edges and depth, standard
        deviations.

        It is the root of the sum of squares, because that is how improbabilities combine (Fisher 1925: the logarithm of
        a normal tail falls with the square). With a plain sum, two weak results could outdo one that cannot be chance.
        """
        stacked = np.array(poses).reshape(-1, 4, 4)
        contrasts = zip(*self.contrasts_by_kind(stacked), self.depth_contrasts(stacked), strict=True)
        return [hypot(*(max(contrast, 0.0) for contrast in of_pose)) for of_pose in contrasts]

    def rank(self, T_camera_lidar: Matrix4) -> float:
        """The same for one pose (4, 4)."""
        return self.ranks([T_camera_lidar])[0]


def _scale_of_bands(edges: EdgeCue, poses: NDArray[np.float64]) -> Scale:
    """The scale of the significance, averaged over the bands, from other poses (K, 4, 4)."""
    return Scale.of(np.mean([charted_significances(chart, poses) for chart in edges.charts], axis=0))


def _contrasts(bands: Sequence[alignment.EdgeFrames], scale: Scale, poses: NDArray[np.float64]) -> list[float]:
    """How far the significance, averaged over some bands, stands above other poses at each of K poses (K, 4, 4)."""
    of_bands = np.stack([alignment.significances(band, poses) for band in bands], axis=1)
    return [scale.standard(float(np.mean(z))) for z in of_bands]
