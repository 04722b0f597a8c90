"""How good a depth network is for calibration: its maps are compared with the sweeps at a known calibration.

Rank correlation shows how well the network orders what it sees by distance, and needs no search. Mutual information and
the place of its maximum show what the paper's method would make of the network (METHOD, section 3: plain mutual
information is as good as its depth).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import degrees, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective import mutual_information
from coec.calibration.objective.landscape import measure_curvature
from coec.calibration.search.local_search import maximise
from coec.calibration.solver import WindowData
from coec.calibration.types import DepthMap, Matrix4, Rig, Silence
from coec.config import CalibrationConfig, ObjectiveConfig
from coec.geometry import se3
from coec.geometry.cameras import in_image
from coec.geometry.points import lengths
from coec.geometry.projection import project
from coec_lab.experiments.objective_scans import ObjectiveLandscape, Scan, ScanSpan, scan
from coec_lab.experiments.solve_statistics import HIT_RAD

SEARCH_DEG = 8.0
"""Half-width of the box in which the optimum is searched: several times the worst bias of a network that was of any use
(3 degrees, METHOD section 3)."""

SPAN = ScanSpan(radians(15.0), 0.0, 91)
"""Span of the curves along the axes: wide enough for the peak of a weak network to fall to half on either side."""

GOOD_RANK, GOOD_BIAS_RAD = 0.85, HIT_RAD
"""With at least this rank correlation and at most this bias, plain mutual information alone reaches a hit: stereo depth
on KITTI-360 has 0.90 and 0.2 degrees, a network trained on such views 0.91 and 0.4."""

USABLE_RANK, USABLE_BIAS_RAD = 0.4, radians(6.0)
"""Within these limits, the peak of the depth cue still holds the true pose (its half-width is 3 to 9 degrees). Of
five recordings and three networks, those beyond had a rank of 0.2 or less in a garage, or a bias of 11 degrees on a
lens that they do not know.

The ratio to unrelated maps is reported but does not decide, because frames a tenth of a second apart are related."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairing:
    """The points of a sweep that fall on a map, at one pose.

    Attributes:
        uv_px: (n, 2) pixels of the image.
        range_m: (n,) from the LiDAR.
        value: (n,) of the map at the nearest of its cells, as the network gives it.
        covered: share of the points in view, n over those that fall on the image and not on its mask.
    """

    uv_px: NDArray[np.float64]
    range_m: NDArray[np.float64]
    value: NDArray[np.float64]
    covered: float

    @property
    def rank_correlation(self) -> float:
        """Spearman's, between value and inverse range: + for inverse depth, - for depth; NaN below two points."""
        return spearman(self.value, 1.0 / self.range_m)

    def residuals(self) -> NDArray[np.float64]:
        """(n,) how far the map ranks each point too near (+) or too far (-), as a share of all points: -1 to 1."""
        sign = -1.0 if self.rank_correlation < 0.0 else 1.0
        count = max(len(self.value) - 1, 1)
        return (ranks(sign * self.value) - ranks(1.0 / self.range_m)) / count


@dataclass(frozen=True, slots=True, eq=False)
class DepthQuality:
    """A network on one window.

    Attributes:
        pairings: per frame, at the reference.
        mi, mi_of_unrelated: nats, at the reference, of each frame with its own map and with maps of other frames.
        bias: (3,) rotation vector from the reference to the optimum of mutual information, rad.
        half_width: (3,) of the peak about the axes through the optimum, half-way down to `mi_of_unrelated`, rad.
        peakedness: (3,) -f''/f at the optimum, per rad².
        scans: mutual information about the reference along the three axes.
        joint: (bins, bins) counts of the points by bin of the map (rows) and of the range, see `joint_histogram`.
    """

    pairings: tuple[Pairing, ...]
    mi: float
    mi_of_unrelated: float
    bias: NDArray[np.float64]
    half_width: NDArray[np.float64]
    peakedness: NDArray[np.float64]
    scans: tuple[Scan, ...]
    joint: NDArray[np.int64]

    @property
    def rank_correlation(self) -> float:
        """Median over the frames that have one; NaN without any."""
        known = [value for value in (pairing.rank_correlation for pairing in self.pairings) if np.isfinite(value)]
        return float(np.median(known)) if known else float("nan")

    @property
    def covered(self) -> float:
        """Median over the frames."""
        return float(np.median([pairing.covered for pairing in self.pairings]))

    @property
    def mi_over_unrelated(self) -> float:
        """Mutual information with a frame's own map over that with maps of other frames."""
        return self.mi / max(self.mi_of_unrelated, 1e-12)


class Suitability(StrEnum):
    """What a network is good for."""

    GOOD = "good"
    FUSED = "usable_in_fused"
    UNSUITED = "do_not_use"


def assess(window_data: WindowData, config: CalibrationConfig, on_progress: Callable[[int, str], None]) -> DepthQuality:
    """The maps of a window against its sweeps, at the calibration of its rig.

    Raises:
        CalibrationError: a frame has no depth, or no point comes into view.
    """
    rig = window_data.window.rig
    reference = rig.T_camera_lidar_nominal
    maps = window_data.depths()
    clouds = [window_data.points(index) for index in range(len(maps))]
    pairings = tuple(
        pair_up(xyz_m, depth, rig, reference, config.objective) for xyz_m, depth in zip(clouds, maps, strict=True)
    )
    on_progress(1, "ranks")
    features = [
        mutual_information.distance_and_depth(xyz_m, depth, reference)
        for xyz_m, depth in zip(clouds, maps, strict=True)
    ]
    box = mutual_information.SearchBox(radians(SEARCH_DEG), 0.0)
    objective = mutual_information.build_mutual_information(features, rig, reference, box, config.objective)
    search = config.search.model_copy(update={"dof": 3, "rotation_deg": SEARCH_DEG})
    optimum = maximise(objective, reference, search, Silence()).T_camera_lidar
    on_progress(2, "optimum")
    landscape = ObjectiveLandscape(objective)
    scans = scan(landscape, reference, 3, SPAN)
    unrelated = objective.mi_of_unrelated(reference)
    through = scan(landscape, optimum, 3, SPAN)
    on_progress(3, "curves")
    curvature = measure_curvature(objective, optimum, 3)
    return DepthQuality(
        pairings=pairings,
        mi=objective.evaluate(reference).mi,
        mi_of_unrelated=unrelated,
        bias=se3.difference(optimum, reference)[:3],
        half_width=np.array([half_width(along, unrelated) for along in through]),
        peakedness=curvature.peakedness(objective.evaluate(optimum).score),
        scans=scans,
        joint=joint_histogram(pairings, config.objective.range_bins),
    )


def suitability(quality: DepthQuality) -> tuple[Suitability, str]:
    """What the network is good for, and the sentence that says why."""
    rank, bias_rad = abs(quality.rank_correlation), float(np.linalg.norm(quality.bias))
    figures = (
        f"rank correlation {rank:.2f}, optimum of MI {degrees(bias_rad):.2f} deg off, "
        f"MI {quality.mi_over_unrelated:.2f} times that of other frames' maps"
    )
    if rank >= GOOD_RANK and bias_rad <= GOOD_BIAS_RAD:
        return Suitability.GOOD, f"good: plain mutual information finds the calibration with it ({figures})"
    if rank >= USABLE_RANK and bias_rad <= USABLE_BIAS_RAD:
        return Suitability.FUSED, f"usable in fused: it tells the basin, edges must settle the rest ({figures})"
    return Suitability.UNSUITED, f"do not use: it tells too little of near and far on this recording ({figures})"


def pair_up(
    xyz_m: NDArray[np.float32], depth: DepthMap, rig: Rig, T_camera_lidar: Matrix4, config: ObjectiveConfig
) -> Pairing:
    """The points (N, 3) of a sweep within the range limits, on the map of its frame, at a pose (4, 4)."""
    points = np.asarray(xyz_m, np.float64)
    range_m = lengths(points)
    within = (range_m >= config.min_range_m) & (range_m <= config.max_range_m)
    points, range_m = points[within], range_m[within]
    uv_px, valid = project(rig.camera, points @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])
    seen = valid & in_image(rig.camera, uv_px)
    uv_px, range_m = uv_px[seen], range_m[seen]
    if rig.mask is not None:
        nearest = np.rint(uv_px).astype(np.int64)
        lit = rig.mask[nearest[:, 1], nearest[:, 0]]
        uv_px, range_m = uv_px[lit], range_m[lit]
    height, width = depth.values.shape
    # Pixel centres lie at integers, so the image begins at -0.5.
    column = ((uv_px[:, 0] + 0.5) * (width / rig.camera.width)).astype(np.int64)
    row = ((uv_px[:, 1] + 0.5) * (height / rig.camera.height)).astype(np.int64)
    value = depth.values[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(np.float64)
    known = np.isfinite(value)
    covered = float(known.mean()) if len(known) else 0.0
    return Pairing(uv_px[known], range_m[known], value[known], covered)


def ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) ranks from 0; equal values share the mean of theirs."""
    _, group, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    middle = last - (counts + 1) / 2.0
    return np.asarray(middle[group.reshape(-1)], np.float64)


def spearman(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Rank correlation: Pearson's of the ranks; NaN where one of them does not vary."""
    rank_a, rank_b = ranks(a), ranks(b)
    if len(rank_a) < 2 or np.ptp(rank_a) == 0.0 or np.ptp(rank_b) == 0.0:
        return float("nan")
    centred_a, centred_b = rank_a - rank_a.mean(), rank_b - rank_b.mean()
    return float((centred_a * centred_b).sum() / np.sqrt((centred_a**2).sum() * (centred_b**2).sum()))


def half_width(along: Scan, floor: float) -> float:
    """Half the distance between the places where a scan about a peak, at offset 0, has fallen half-way to `floor`; on a
    side where it never does, the end of the scan counts. NaN when the peak does not rise above the floor."""
    middle = int(np.argmin(np.abs(along.offsets)))
    level = (along.scores[middle] + floor) / 2.0
    if along.scores[middle] <= floor:
        return float("nan")
    below = np.flatnonzero(along.scores < level)
    left, right = below[below < middle], below[below > middle]
    begin = along.offsets[left[-1]] if len(left) else along.offsets[0]
    end = along.offsets[right[0]] if len(right) else along.offsets[-1]
    return float(end - begin) / 2.0


def joint_histogram(pairings: Sequence[Pairing], bins: int) -> NDArray[np.int64]:
    """(bins, bins) counts over all frames, in bins of equal shares of the map's values (rows, furthest first) and of
    the ranges (columns, furthest first). A perfect network has all points on the diagonal."""
    counts = np.zeros((bins, bins), np.int64)
    for pairing in pairings:
        sign = -1.0 if pairing.rank_correlation < 0.0 else 1.0
        scale = bins / max(len(pairing.value), 1)
        row = (ranks(sign * pairing.value) * scale).astype(np.int64)
        column = (ranks(1.0 / pairing.range_m) * scale).astype(np.int64)
        np.add.at(counts, (np.minimum(row, bins - 1), np.minimum(column, bins - 1)), 1)
    return counts
