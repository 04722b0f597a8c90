"""Two independent witnesses in one objective: edges, sharp and unbiased, and depth, broad and blind to texture.

Each is counted in standard deviations of its own score over other poses within reach, so that neither needs a weight: a
network that tells nothing adds noise of one unit, a scene without edges likewise (METHOD, section 3, "complement").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.basins import sample_reach
from coec.calibration.edges import EdgeWitness
from coec.calibration.objective import Evaluation, MutualInformation, SearchBox
from coec.calibration.values import Matrix4
from coec.geometry.alignment import frame_alignment, significances

OTHER_POSES = 64
"""Poses within reach from which the mean and the standard deviation of a score are taken: known to an eighth."""

UNRELATED_ROLLS = 4
"""Other frames that each sweep is laid on to find what unrelated images give."""

RANKED_LEVELS = 3
"""Levels of the edge witness that rank basins: a pose that is right is right at every blur."""


@dataclass(frozen=True, slots=True)
class _Scale:
    """Mean and standard deviation of a score over other poses."""

    mean: float
    deviation: float

    @classmethod
    def of(cls, scores: NDArray[np.float64]) -> _Scale:
        # A score that does not vary at all tells nothing; it must not divide by zero either.
        return cls(float(scores.mean()), max(float(scores.std()), 1e-9))

    def standard(self, score: float) -> float:
        return (score - self.mean) / self.deviation


class FusedObjective:
    """Standardised edge significance plus standardised mutual information, both per frame and in sum."""

    step_rad = radians(0.2)
    """The blur of the finest level, two pixels of a camera of 600 px focal length."""

    def __init__(self, edges: EdgeWitness, depth: MutualInformation, start: Matrix4, reach: SearchBox) -> None:
        """Freezes the scales from poses within `reach` of `start`."""
        self._edges = edges
        self._depth = depth
        poses = sample_reach(start, reach, OTHER_POSES)
        self._edge_scales = [_Scale.of(significances(level, poses)) for level in edges.levels[:RANKED_LEVELS]]
        self._depth_scale = _Scale.of(np.array([depth.evaluate(pose).score for pose in poses]))

    def evaluate(self, T_camera_lidar: Matrix4) -> Evaluation:
        """The objective at `T_camera_lidar` (4, 4), on the finest level; in standard deviations."""
        depth = self._depth.evaluate(T_camera_lidar)
        strength, square = frame_alignment(self._edges.levels[0], T_camera_lidar)
        # Σ w·e of a frame over the root of all frames' Σ w²: the sum over the frames is the significance of the window.
        of_frames = len(strength) * strength / np.sqrt(max(float(square.sum()), 1e-9))
        edge_scale, depth_scale = self._edge_scales[0], self._depth_scale
        frame_scores = (of_frames - edge_scale.mean) / edge_scale.deviation
        frame_scores = frame_scores + (depth.frame_scores - depth_scale.mean) / depth_scale.deviation
        return Evaluation(
            score=float(frame_scores.mean()),
            frame_scores=frame_scores,
            mi=depth.mi,
            overlap=depth.overlap,
            points_in_view=depth.points_in_view,
        )

    def rank(self, T_camera_lidar: Matrix4) -> float:
        """How outstanding a pose is: the edge witness averaged over its levels, plus depth, in standard deviations."""
        pose = T_camera_lidar[None]
        edges = [
            scale.standard(float(significances(level, pose)[0]))
            for scale, level in zip(self._edge_scales, self._edges.levels, strict=False)
        ]
        return float(np.mean(edges)) + self._depth_scale.standard(self._depth.evaluate(T_camera_lidar).score)

    def edges_over_unrelated(self, T_camera_lidar: Matrix4) -> float:
        """Significance of the edges on the finest level over that of the same sweeps on the images of other frames:
        what the layout of a road scene alone gives. Not a number for a single frame."""
        level, pose = self._edges.levels[0], T_camera_lidar[None]
        rolls = range(1, min(len(level.maps), UNRELATED_ROLLS + 1))
        if not rolls:
            return float("nan")
        others = [replace(level, maps=np.ascontiguousarray(np.roll(level.maps, k, axis=0))) for k in rolls]
        unrelated = float(np.mean([significances(other, pose)[0] for other in others]))
        return float(significances(level, pose)[0]) / max(unrelated, 1.0)
