"""How the cells of an objective scatter over frames and sectors about an optimum: the significance of a difference
between two poses, and how many independent samples the frames of a window are worth. All that stands still in the
vehicle's frame is one sample.

The lane markings, guard rails and horizon of a straight motorway lie on the same pixels in every image, and the range
edges of its sweeps among the same beams. Frames that agree on such things count as one look, however many they are. To
find them, sweeps and images change partners: passing things fit only in their own frame, still ones in every frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import Cells
from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.geometry.edges.alignment import EdgeFrames, frame_alignment, strengths_on_each_map
from coec.geometry.points import thinned


@dataclass(frozen=True, slots=True, eq=False)
class Landscape:
    """Cells as a function of the offset from an optimum.

    Attributes:
        cells: cut at the optimum.
        pose: (4, 4) the optimum.
        moved: the n axes of ξ that were searched.
        centre: (F, B) the cells at the optimum.
    """

    cells: Cells
    pose: Matrix4
    moved: tuple[int, ...]
    centre: NDArray[np.float64]

    @classmethod
    def about(cls, cells: Cells, pose: Matrix4, moved: tuple[int, ...]) -> Landscape:
        """The landscape about a pose (4, 4)."""
        return cls(cells, pose, moved, cells.at(pose[None])[0])

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.centre)

    def at(self, offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, F, B) the cells at each of K offsets (K, n) along the axes moved."""
        xi = np.zeros((len(offsets), 6))
        xi[:, list(self.moved)] = offsets
        return self.cells.at(np.array([se3.perturb(self.pose, one) for one in xi]))

    def certainty(self, cells: NDArray[np.float64]) -> float:
        """How surely the optimum stands above another pose whose cells (F, B) are given: the difference in standard
        deviations, from the scatter of that difference over frames and sectors.

        On a paraboloid it is half the distance from the optimum in standard deviations of the optimum.
        """
        return certainty(self.centre - cells)


def certainty(gained: NDArray[np.float64]) -> float:
    """How surely one pose gains over another in all, from the gain in each cell (F, B): the sum in its standard
    deviations, from the scatter over frames and sectors. It is 0 if no cell gains anything."""
    noise = scatter(gained[None])[0][0]
    total = fsum(gained.ravel().tolist())
    if noise > 0.0:
        return total / sqrt(noise)
    return float(np.copysign(np.inf, total)) if total != 0.0 else 0.0


def scatter(cells: NDArray[np.float64], fitted: int = 0) -> list[list[float]]:
    """(n, n) covariance of the sums of n figures (n, F, B) over their cells, from how frames and sectors differ.

    Cluster-robust both ways (Cameron, Gelbach, Miller 2011), with `fitted` degrees of freedom used up (MacKinnon, White
    1985, "HC1"). The term of single cells, which would be subtracted, is left in. So no variance is negative, and if
    frames and sectors are independent the standard deviation is √2 too wide, which the few sectors need for their
    tails. A single sector contributes nothing.
    """
    figures = len(cells)
    of_frames, of_sectors = cells.sum(axis=2).tolist(), cells.sum(axis=1).tolist()
    covariance = [[0.0] * figures for _ in range(figures)]
    for groups in (of_frames, of_sectors):
        count = len(groups[0])
        if count <= max(fitted, 1):
            continue
        means = [fsum(row) / count for row in groups]
        centred = [[value - mean for value in row] for row, mean in zip(groups, means, strict=True)]
        factor = count / (count - max(fitted, 1))
        for i in range(figures):
            for j in range(figures):
                covariance[i][j] += factor * fsum(a * b for a, b in zip(centred[i], centred[j], strict=True))
    return covariance


POINTS = 20_000
"""Most range edges that change partners: with F images that is the work of F evaluations, of which a search takes
hundreds."""


@dataclass(frozen=True, slots=True)
class IndependentSamples:
    """The looks at one pose.

    Attributes:
        count: how many independent looks the F frames are worth, 1 to F.
        significance: of the edges, with what frames have in common counted once: z·√(count / F), because z grows with
            the root of the independent part; standard deviations.
    """

    count: float
    significance: float


def independent_samples_at(edges: EdgeFrames, T_camera_lidar: Matrix4) -> IndependentSamples:
    """How many independent looks put the camera at `T_camera_lidar` (4, 4), and how significantly."""
    some = edges.of_points(thinned(len(edges.weight), POINTS))
    count = effective_sample_size(strengths_on_each_map(some, T_camera_lidar))
    whole = frame_alignment(edges, T_camera_lidar).significance
    return IndependentSamples(count, whole * sqrt(count / len(edges.maps)))


def effective_sample_size(agreement: NDArray[np.float64]) -> float:
    """The number of independent looks of F frames, from how well each sweep (rows) agrees with each image (columns),
    (F, F). It is F over the design effect (Kish 1965) of as many repetitions,

        F / (1 + (F - 1)·ρ),  ρ = mean agreement with other frames / mean agreement with the own one,

    where ρ is the intraclass correlation, 0 to 1. Neither the order of the frames nor repeating all of them changes it.
    Frames that do not agree with themselves count as one look.
    """
    frames = len(agreement)
    own = fsum(np.diag(agreement).tolist())
    if own <= 0.0 or frames == 1:
        return 1.0
    others = (fsum(agreement.ravel().tolist()) - own) / (frames - 1)
    alike = min(max(others / own, 0.0), 1.0)
    return frames / (1.0 + (frames - 1) * alike)
