"""The global stage without a start: finds the basins of the edge cue over all rotations, and over all places of the
camera within some metres.

The range edges and the edge maps of the coarsest band are correlated at every rotation (`rotation_correlation`), as
seen from a place of the camera. The highest maxima climb on ever finer levels, with their translation where that is
searched. Nothing is random: the same input gives the same basins.
"""

from dataclasses import dataclass
from math import pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.edges import EdgeCue
from coec.calibration.search.global_search import COARSE, FINE, TURNED_FOR, separated, shifted
from coec.geometry import se3
from coec.geometry.cameras import in_image
from coec.geometry.edges.alignment import EdgeFrames
from coec.geometry.edges.charts import charted_significances, pattern_search
from coec.geometry.edges.image_edges import VOID
from coec.geometry.points import lengths
from coec.geometry.projection import project
from coec.geometry.rotation_correlation import RotationGrid, local_maxima

BANDWIDTH = 128
"""Bandwidth of the correlation: 1.4° between rotations, about the blur of the coarsest band. A climb closes the gap."""

VIEW_BANDWIDTH = 32
"""Bandwidth of how much of a cloud is in view, which varies slowly."""

LEAST_IN_VIEW = 0.05
"""A pose that has less than this share of the range edges in view that another pose has, by weight, is no candidate.
The cloud of a solid-state LiDAR covers only a part of the sphere, and its edge fits any image edge somewhere."""

PLACE_KNOWN_M = 0.3
"""How far a camera usually is from the LiDAR if its place is unknown. Range edges nearer than this over the blur count
less, because their directions are uncertain."""

FARTHEST_M = 3.0
"""How far from the LiDAR the camera may be."""

MAXIMA = 30_000
"""Maxima of the correlation that are compared."""

IN_VIEW_POWER = 0.75
"""Maxima are compared by Σ w·e over this power of the weight in view, Σ w². With ½ it would be the significance, which
ranks poses with much in view too high: a layout that happens to fit adds more than noise."""


@dataclass(frozen=True, slots=True)
class _Round:
    """One round of climbing: how many poses begin it, how far they lie apart at least, on which chart and with how many
    of its edges they climb at most, the first step, and how often it is halved."""

    poses: int
    separation_rad: float
    chart: int
    points: int
    step_rad: float
    halvings: int


ROUNDS = (
    _Round(6_000, radians(1.0), COARSE, 6_000, radians(0.9), 1),
    _Round(600, radians(0.8), FINE, 12_000, radians(0.45), 1),
    _Round(100, radians(2.5), FINE, 30_000, radians(0.2), 1),
)
"""More poses than in `global_search`, as there are more rotations, and more edges, as most are out of view. The last
ones lie far apart, because one wrong basin with a free translation has many poses."""

SHIFTED, SHIFTS_M = _Round(100, radians(2.5), FINE, 8_000, radians(0.3), 1), (0.5, 0.25)
"""If translation is searched, so many best poses are shifted by these distances, and the shifted poses climb again."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeBasins:
    """Basins over all rotations.

    Attributes:
        poses: (K, 4, 4), the most significant first.
        rotations: how many rotations with enough in view were compared.
        ascended: how many of their maxima ascended.
    """

    poses: NDArray[np.float64]
    rotations: int
    ascended: int


def find_free_basins(edges: EdgeCue, place_m: NDArray[np.float64], *, turns_only: bool) -> FreeBasins:
    """The basins of the edges at any rotation, with the camera at `place_m` (3,) in the LiDAR frame if `turns_only`,
    and else anywhere within `FARTHEST_M` of it."""
    grid, coarsest = RotationGrid(BANDWIDTH), edges.bands[-1]
    signal = _edges_on_sphere(coarsest, grid)
    poses, rotations = _correlated(coarsest, signal, grid, place_m, edges.band_blur_rad[-1], known=turns_only)
    ascended, centre, reach = len(poses), np.eye(4), np.array([pi, 0.0 if turns_only else FARTHEST_M])
    centre[:3, 3] = -place_m
    z = np.zeros(len(poses))
    for number in ROUNDS:
        charts, best = edges.charts[number.chart].at_most(number.points), np.arange(len(poses))
        if number is not ROUNDS[0]:
            # A maximum may lie so far from its rotation of the grid that it does not show on the chart there.
            best = separated(poses, charted_significances(charts, poses), number.poses, number.separation_rad)
        steps = se3.axis_steps(number.step_rad)
        steps[3:] = 0.0 if turns_only else steps[3:]
        poses, z = pattern_search(charts, poses[best], steps, number.halvings, centre, reach)
        for shift_m in () if turns_only or number.chart == COARSE else SHIFTS_M:
            best = separated(poses, z, SHIFTED.poses, SHIFTED.separation_rad)
            moved = shifted(poses[best], shift_m, TURNED_FOR * se3.METRES_PER_RADIAN)
            more, _ = pattern_search(charts.at_most(SHIFTED.points), moved, steps, number.halvings, centre, reach)
            poses = np.concatenate([poses, more])
            z = charted_significances(charts, poses)
    best = separated(poses, z, ROUNDS[-1].poses, ROUNDS[-1].separation_rad)
    return FreeBasins(poses[best], rotations, ascended)


def _edges_on_sphere(frames: EdgeFrames, grid: RotationGrid) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Harmonics of the edge maps (B, F, B) and of the field of view (b, 1, b)."""
    uv_px, valid = project(frames.camera, grid.directions)
    seen = np.flatnonzero(valid & in_image(frames.camera, uv_px))
    column, row = np.rint(uv_px[seen]).astype(np.int64).T
    maps = frames.maps[:, row, column]
    values = np.zeros((len(frames.maps), len(grid.directions)))
    values[:, seen] = np.where(maps == VOID, 0, maps) * grid.solid_angles[seen]
    view = np.zeros((1, len(grid.directions)))
    view[0, seen] = (maps[0] != VOID) * grid.solid_angles[seen]
    return grid.harmonics(values), grid.harmonics(view)[:VIEW_BANDWIDTH, :, :VIEW_BANDWIDTH]


def _correlated(
    frames: EdgeFrames,
    signal: tuple[NDArray[np.complex128], NDArray[np.complex128]],
    grid: RotationGrid,
    place_m: NDArray[np.float64],
    blur_rad: float,
    *,
    known: bool,
) -> tuple[NDArray[np.float64], int]:
    """(K, 4, 4) the highest maxima over all rotations that lie apart, the highest first, for a camera at `place_m`
    (3,), and how many rotations have enough in view."""
    from_place = frames.xyz_m.T.astype(np.float64) - place_m
    weight = frames.weight.astype(np.float64)
    if not known:
        weight /= np.sqrt(1.0 + (PLACE_KNOWN_M / (lengths(from_place) * blur_rad)) ** 2)
    cells, count = grid.cells(from_place), len(grid.directions)
    frame = np.repeat(np.arange(len(frames.maps)), np.diff(frames.first_point))
    of_frames = np.bincount(frame * count + cells, weight, len(frames.maps) * count).astype(np.float64)
    squares = np.bincount(cells, weight**2, count).astype(np.float64)
    score = grid.correlation(signal[0], grid.harmonics(of_frames.reshape(-1, count)))
    of_squares = grid.harmonics(squares[None])[:VIEW_BANDWIDTH, :, :VIEW_BANDWIDTH]
    square = grid.correlation(signal[1], of_squares)
    least = LEAST_IN_VIEW * float(square.max())
    enough = square > least
    score /= np.maximum(square, np.float32(least)) ** np.float32(IN_VIEW_POWER)
    score[~enough] = -1.0
    maxima = local_maxima(score, 0.0)
    maxima = maxima[np.argsort(-score.ravel()[maxima], kind="stable")[:MAXIMA]]
    poses = np.tile(np.eye(4), (len(maxima), 1, 1))
    poses[:, :3, :3] = grid.rotations(maxima)
    poses[:, :3, 3] = -np.einsum("kij,j->ki", poses[:, :3, :3], place_m)
    descending = -np.arange(len(poses), dtype=np.float64)
    return poses[separated(poses, descending, ROUNDS[0].poses, ROUNDS[0].separation_rad)], int(enough.sum())
