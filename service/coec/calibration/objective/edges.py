"""The second cue: edges of the sweeps, of range and of reflectance, laid on edges of the images, at several scales;
and how many independent frames those of a window are worth.

Both kinds of edges add to one significance. Their weights follow from what they are worth in this window: before a pose
is known, reflectance edges have at most as much weight in all as range edges; at a pose, each kind has the weight that
makes the significance highest there (`EdgeCue.balanced_at`). So edges that fit nothing count for nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import radians
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import Evaluation, SearchBox
from coec.calibration.types import FramePair, Matrix4, Rig
from coec.errors import CalibrationError
from coec.geometry.cameras import Camera, pixel_rad, scaled
from coec.geometry.edges.alignment import (
    LEAST_SQUARE,
    Alignment,
    EdgeFrames,
    alignment_of_parts,
    alignments,
    frame_alignment,
    strengths_on_each_map,
)
from coec.geometry.edges.charts import EdgeCharts, edge_charts
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, STRENGTH_STEPS, EdgeScales
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.edges.reflectance_edges import (
    ReflectanceSteps,
    learn_noise,
    reflectance_edges,
    reflectance_steps,
)
from coec.geometry.edges.scan_lines import SweepEdges, scan_lines
from coec.geometry.points import thinned
from coec.geometry.projection import half_field_of_view_rad, within_cone
from coec.geometry.sweep_kernels import bearings

BANDS = 3
"""Bands of about 0.8, 0.4 and 0.2 degrees: the coarsest feels a pose 0.9 degrees away, the finest is sharp enough to
tell a true basin from a layout that happens to fit."""

MAX_PIXELS = 2_500_000
"""Before the last search images are halved until they have no more pixels than this, which bounds the time for any
camera."""

COARSEST_BLUR_RAD = radians(0.6)
"""Least blur of the coarsest level, an angle about the optical axis and so the same for any lens. Levels double, so the
blur is below twice that. With a wider blur the layout of a scene hides the true pose; with a narrower one the cover of
the global stage has to be finer. See docs/measured.md."""

RANKED_POINTS = 60_000
"""Most range edges of the window that rank basins: bounds the time for a window of many frames."""

MOST_STRENGTH = 2.0
"""Standard deviations at which the strength of an image edge is cut off. That a range edge falls on an image edge is
evidence, but not ten times as much because the edge stands alone before the sky: a row of range edges on the rim of a
bridge would outweigh everything that fits at the true pose. See docs/measured.md."""

CELL_RAD = radians(1.0)
"""Side of the cells of azimuth and elevation in which range edges count as neighbours. Neighbours lie along the same
rim, fall on the same image edge or miss it together, and so are one piece of evidence: with n in a cell each has
1/√n of its weight. See docs/measured.md."""

THINNED_POINTS = 3_000
"""Edges of the window that score the cover; significance falls only with the square root of their number."""


Edges = TypeVar("Edges", EdgeFrames, EdgeCharts)

RANGE, REFLECTANCE = 0, 1
"""Kinds of edges of a sweep."""

KIND_NAMES = ("range_edges", "reflectance_edges")
KINDS = len(KIND_NAMES)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeCue:
    """One cue in four forms: exact and sharp, exact and blurred, bands, and charts.

    Attributes:
        kinds: of the edges of `sharp`, of those of a band, and of those of a thinned chart: uint8 each.
        balance: (KINDS,) factors of the weights of each kind, the largest one 1.
        sharp: every edge on the sharpest image edges, through the lens model: settles a pose.
        whole: the same on blurred edges that keep the layout of the scene: leads to `sharp`. It is biased to where
            edges are dense, but its hills are wide; those of an equally fine band are not. It has half as many pixels a
            side, because the blur is a pixel wide.
        blur_rad: the blur of `whole`, an angle about the optical axis.
        bands: from fine to coarse, `RANKED_POINTS` of the edges on one band each, through the lens model: rank
            basins.
        band_blur_rad: the blur of each band, an angle likewise.
        half_view_rad: largest angle from the optical axis at which the images have a pixel that counts.
        charts: the coarsest and the next finer band with the same edges: fast.
        thinned: the charts with `THINNED_POINTS` of those edges: faster.
    """

    kinds: tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]
    balance: NDArray[np.float64]
    sharp: EdgeFrames
    whole: EdgeFrames
    blur_rad: float
    bands: tuple[EdgeFrames, ...]
    band_blur_rad: tuple[float, ...]
    half_view_rad: float
    charts: tuple[EdgeCharts, EdgeCharts]
    thinned: tuple[EdgeCharts, EdgeCharts]

    @property
    def to_the_sharpest(self) -> tuple[EdgeFrames, ...]:
        """Levels that lead from a few degrees away to the sharpest edges: the bands, from coarse to fine, and those."""
        return (*reversed(self.bands), self.sharp)

    def count(self, kind: int) -> int:
        """How many edges of a kind the window has."""
        return int(np.count_nonzero(self.kinds[0] == kind))

    @property
    def effective_count(self) -> float:
        """The number of range edges, and of reflectance edges as far as they weigh as much."""
        share = min(1.0, float(self.balance[REFLECTANCE] / max(self.balance[RANGE], 1e-9)))
        return self.count(RANGE) + share**2 * self.count(REFLECTANCE)

    @property
    def kinds_alone(self) -> list[EdgeCue]:
        """One cue for each kind of edges that the window has."""
        present = [kind for kind in range(KINDS) if self.count(kind)]
        return [self] if len(present) == 1 else [self._of_kind(kind) for kind in present]

    def _of_kind(self, kind: int) -> EdgeCue:
        every, ranked = (np.flatnonzero(kinds == kind) for kinds in self.kinds[:2])
        subset = thinned(len(ranked), THINNED_POINTS)
        coarse, fine = (chart.of_points(ranked) for chart in self.charts)
        return replace(
            self,
            kinds=(self.kinds[0][every], self.kinds[1][ranked], self.kinds[1][ranked[subset]]),
            sharp=self.sharp.of_points(every),
            whole=self.whole.of_points(every),
            bands=tuple(band.of_points(ranked) for band in self.bands),
            charts=(coarse, fine),
            thinned=(coarse.of_points(subset), fine.of_points(subset)),
        )

    def significances(self, level: EdgeFrames, T_camera_lidar: Matrix4) -> NDArray[np.float64]:
        """(KINDS,) z of the edges of each kind alone on `sharp`, `whole` or a band, at a pose (4, 4)."""
        strength, square = self._sums(level, T_camera_lidar)
        return np.asarray(strength / np.sqrt(square))

    def balanced_at(self, T_camera_lidar: Matrix4) -> EdgeCue:
        """The cue with the weights that make it most significant at a pose (4, 4): in proportion to the mean strength
        of the image's edges under each kind, none where it is below the average (linear discriminant of independent
        samples of equal variance). Measured on the finest band, whose hills are wider than a pose is uncertain."""
        if not self.count(REFLECTANCE):
            return self
        strength, square = self._sums(self.bands[0], T_camera_lidar)
        gain = np.maximum(strength / square, 0.0)
        return self._weighted(gain / gain.max()) if gain.any() else self

    def balanced_by_power(self) -> EdgeCue:
        """The cue with the weights of each kind multiplied by `power_balance`."""
        factors = power_balance(self.sharp.weight, self.kinds[0])
        return self if (factors == 1.0).all() else self._weighted(factors)

    def _sums(self, level: EdgeFrames, T_camera_lidar: Matrix4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        kinds = self.kinds[0] if len(self.kinds[0]) == len(level.weight) else self.kinds[1]
        sums = alignment_of_parts(level, kinds, KINDS, T_camera_lidar[None])
        return sums.strength[0].sum(axis=0), np.maximum(sums.square[0].sum(axis=0), LEAST_SQUARE)

    def _weighted(self, factors: NDArray[np.float64]) -> EdgeCue:
        """The cue with the weight of each edge multiplied by the factor of its kind."""
        every, ranked, few = (factors.astype(np.float32)[kinds] for kinds in self.kinds)
        balance = self.balance * factors
        return replace(
            self,
            balance=balance / balance.max(),
            sharp=replace(self.sharp, weight=self.sharp.weight * every),
            whole=replace(self.whole, weight=self.whole.weight * every),
            bands=tuple(replace(band, weight=band.weight * ranked) for band in self.bands),
            charts=_reweighted(self.charts, ranked),
            thinned=_reweighted(self.thinned, few),
        )


def power_balance(weight: NDArray[np.float32], kinds: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(KINDS,) factors of the weights (E,) of edges of some kinds (E,) before a pose is known: those of reflectance
    edges are reduced until their squares add to no more than those of the range edges. So if they fit nothing at all,
    the significance of the true pose falls by a root of two."""
    square = [float((weight[kinds == kind] ** 2).sum(dtype=np.float64)) for kind in range(KINDS)]
    if square[RANGE] == 0.0 or square[REFLECTANCE] <= square[RANGE]:
        return np.ones(KINDS)
    return np.array([1.0, math.sqrt(square[RANGE] / square[REFLECTANCE])])


def _reweighted(charts: tuple[EdgeCharts, EdgeCharts], factors: NDArray[np.float32]) -> tuple[EdgeCharts, EdgeCharts]:
    coarse, fine = (replace(chart, weight=np.rint(chart.weight * factors).astype(np.int32)) for chart in charts)
    return coarse, fine


ROUNDING_RAD = radians(0.1)
"""Added to the angle within which edges may come into view: many times the error of single precision."""


def in_reach(edges: Edges, half_view_rad: float, pose: Matrix4, reach: SearchBox) -> Edges:
    """The edges with only those range edges that may come into view at some pose within a reach of `pose` (4, 4). The
    others do not change the significance at any of these poses, not even in the last bit."""
    angle_rad = half_view_rad + reach.rotation_rad + ROUNDING_RAD
    return edges.of_points(np.flatnonzero(within_cone(edges.xyz_m, pose, angle_rad, reach.translation_m)))


class EdgesAlone:
    """The edge cue as an objective by itself, at one blur."""

    def __init__(self, frames: EdgeFrames, blur_rad: float) -> None:
        """`blur_rad` is the blur of the edge maps, an angle about the optical axis."""
        self._frames = frames
        self._blur_rad = blur_rad

    @property
    def step_rad(self) -> float:
        """The blur of the edges."""
        return self._blur_rad

    def evaluate(self, T_camera_lidar: Matrix4) -> Evaluation:
        """Significance at `T_camera_lidar` (4, 4), 0 if nothing is in view; depth and overlap are not computed."""
        return self._evaluation(frame_alignment(self._frames, T_camera_lidar))

    def evaluate_each(self, poses: NDArray[np.float64]) -> list[Evaluation]:
        """The same at each of many poses (K, 4, 4)."""
        at = alignments(self._frames, poses)
        return [self._evaluation(at.at(k)) for k in range(len(poses))]

    @staticmethod
    def _evaluation(at: Alignment) -> Evaluation:
        return Evaluation(at.significance, at.of_frames, mi=math.nan, overlap=math.nan, points_in_view=0)


Points = Callable[[int, NDArray[np.int64]], NDArray[np.float32]]
"""The chosen points of the sweep of a pair: (N, 3), motion-compensated."""


def build_edges(pairs: Sequence[FramePair], points: Points, greys: Iterable[NDArray[np.uint8]], rig: Rig) -> EdgeCue:
    """Edges of the sweeps (found as measured, placed motion-compensated) and edge maps of the images. Sweeps without
    reflectance have range edges only.

    Args:
        pairs: those of the window.
        points: places the chosen points of the sweep of a pair: motion-compensated, (N, 3) float32.
        greys: (height, width) uint8, the images of the pairs.

    Raises:
        CalibrationError: no sweep has an edge, or an image is not of the camera's size.
    """
    detected = detected_edges(pairs)
    first_point = np.concatenate([[0], np.cumsum([len(edges.weight) for edges in detected])]).astype(np.int64)
    if first_point[-1] == 0:
        raise CalibrationError(
            "no edge of range or reflectance in any sweep: the edge objective has nothing to align with the edges of "
            "the images"
        )
    # The shift is not compensated: motion compensation turns this tenth of a degree by two degrees at most.
    xyz_m = np.concatenate([points(frame, edges.index) + edges.shift_m for frame, edges in enumerate(detected)])
    weight, kind = (np.concatenate([getattr(edges, of) for edges in detected]) for of in ("weight", "kind"))
    finest, coarsest = _finest_level(rig.camera), _coarsest_level(rig.camera)
    finest = min(finest, coarsest + 1 - BANDS)
    sharp, whole, *of_bands = _maps(rig, finest, coarsest, greys, len(pairs))
    points_m = np.ascontiguousarray(xyz_m.T)

    def frames(level: int, maps: NDArray[np.int8], indices: NDArray[np.int64]) -> EdgeFrames:
        # Halving drops a last odd row or column, but the scale is still a half.
        _, height, width = maps.shape
        camera = scaled(rig.camera, 0.5**level, 0.5**level)._replace(width=width, height=height)
        first_index = np.searchsorted(indices, first_point)
        return EdgeFrames(camera, np.ascontiguousarray(points_m[:, indices]), weight[indices], first_index, maps)

    every, ranked = np.arange(len(weight)), thinned(len(weight), RANKED_POINTS)
    levels = range(coarsest + 1 - BANDS, coarsest + 1)
    bands = tuple(frames(level, maps, ranked) for level, maps in zip(levels, of_bands, strict=True))
    blur_rad = tuple(_blur_rad(rig.camera, level) for level in levels)
    of_points = np.repeat(np.arange(len(pairs)), np.diff(first_point))[ranked]
    coarse, fine = (
        edge_charts(bands[k].camera, bands[k].maps, blur_rad[k], points_m[:, ranked], weight[ranked], of_points)
        for k in (-1, -2)
    )
    subset = thinned(len(ranked), THINNED_POINTS)
    cue = EdgeCue(
        kinds=(kind, kind[ranked], kind[ranked[subset]]),
        balance=np.ones(KINDS),
        sharp=frames(finest, sharp, every),
        whole=frames(finest + 1, whole, every),
        blur_rad=_blur_rad(rig.camera, finest),
        bands=bands,
        band_blur_rad=blur_rad,
        half_view_rad=half_field_of_view_rad(rig.camera, _lit(rig)),
        charts=(coarse, fine),
        thinned=(coarse.of_points(subset), fine.of_points(subset)),
    )
    return cue.balanced_by_power()


@dataclass(frozen=True, slots=True, eq=False)
class DetectedEdges:
    """Edges of a sweep, those of range before those of reflectance: as in `SweepEdges`, and the kind of each, uint8."""

    index: NDArray[np.int64]
    shift_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    kind: NDArray[np.uint8]


def detected_edges(pairs: Sequence[FramePair]) -> list[DetectedEdges]:
    """The edges of each sweep; those in one cell share their weight."""
    of_range: list[SweepEdges] = []
    steps: list[ReflectanceSteps | None] = []
    for pair in pairs:
        lines = scan_lines(pair.lidar.xyz_m, pair.lidar.ring)
        of_range.append(range_edges(lines))
        reflectance = pair.lidar.intensity
        steps.append(None if reflectance is None else reflectance_steps(lines, reflectance))
    noise = learn_noise([one for one in steps if one is not None])
    detected = []
    for pair, edges, step in zip(pairs, of_range, steps, strict=True):
        kinds = [edges] if step is None or noise is None else [edges, reflectance_edges(step, noise)]
        detected.append(
            DetectedEdges(
                np.concatenate([one.index for one in kinds]),
                np.concatenate([one.shift_m for one in kinds]),
                np.concatenate(
                    [one.weight / np.sqrt(_neighbours(pair.lidar.xyz_m[one.index])) for one in kinds]
                ).astype(np.float32),
                np.repeat(np.arange(len(kinds), dtype=np.uint8), [len(one.index) for one in kinds]),
            )
        )
    return detected


def _neighbours(xyz_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """(N,) the number of points (N, 3) in the cell of each."""
    seen = bearings(xyz_m)
    columns = math.ceil(math.tau / CELL_RAD) + 1
    row, column = (np.floor(angle / CELL_RAD).astype(np.int64) for angle in (seen.elevation, seen.azimuth))
    cell = (row - row.min(initial=0)) * columns + column - column.min(initial=0)
    return np.asarray(np.bincount(cell)[cell])


def _maps(
    rig: Rig, finest: int, coarsest: int, greys: Iterable[NDArray[np.uint8]], frames: int
) -> list[NDArray[np.int8]]:
    """The sharpest map, the whole one and the last `BANDS` bands of all images, each (F, h, w).

    Images are read one at a time, so none is in memory twice, nor longer than its turn if `greys` decodes them one by
    one. The buffers of a pyramid, as large as five maps, are freed before the charts are made.
    """
    # The third column of a rotation is where it takes the third axis.
    scales = EdgeScales(_lit(rig), finest, coarsest, upright=rig.T_camera_lidar_nominal[:2, 2])
    stacks: list[NDArray[np.int8]] = []
    for frame, grey in enumerate(greys):
        if grey.shape != scales.shape:
            (height, width), (rows, columns) = grey.shape, scales.shape
            raise CalibrationError(f"an image has {width} x {height} px, the camera model {columns} x {rows} px")
        pyramid = scales.pyramid(grey)
        maps = (pyramid.sharp, pyramid.whole, *pyramid.bands[-BANDS:])
        stacks = stacks or [np.empty((frames, *level.shape), np.int8) for level in maps]
        for stack, level in zip(stacks, maps, strict=True):
            # Masked pixels stay as they are: they are below every strength.
            np.minimum(level, np.int8(MOST_STRENGTH * STRENGTH_STEPS), out=stack[frame])
    return stacks


def _lit(rig: Rig) -> NDArray[np.bool_]:
    """(height, width) the pixels that count."""
    return rig.mask if rig.mask is not None else np.ones((rig.camera.height, rig.camera.width), np.bool_)


def _finest_level(camera: Camera) -> int:
    """The first level of the pyramid that has no more than `MAX_PIXELS`."""
    return math.ceil(math.log2(max(1.0, camera.width * camera.height / MAX_PIXELS)) / 2.0)


def _coarsest_level(camera: Camera) -> int:
    """The first level of the pyramid that is blurred by `COARSEST_BLUR_RAD`, and no less than `BANDS` - 1."""
    return max(BANDS - 1, math.ceil(math.log2(COARSEST_BLUR_RAD / _blur_rad(camera, 0))))


def _blur_rad(camera: Camera, level: int) -> float:
    """Blur of a level, an angle about the optical axis."""
    return 2.0**level * BLUR_SIGMA_PX * pixel_rad(camera)


EXCHANGED_POINTS = 20_000
"""Most range edges that change partners: with F images that is the work of F evaluations, of which a search takes
hundreds."""


@dataclass(frozen=True, slots=True)
class IndependentSamples:
    """How many independent frames F frames are worth at one pose.

    The lane markings, guard rails and horizon of a straight motorway lie on the same pixels in every image, and the
    range edges of its sweeps among the same beams. Frames that agree on such things count as one sample, however many
    they are. To find them, sweeps and images change partners: passing things fit only in their own frame, still ones in
    every frame.

    Attributes:
        count: 1 to F.
        significance: of the edges, with what frames have in common counted once, and as it would be of `FEWEST_FRAMES`
            such frames if there are fewer; standard deviations. z grows with the root of the independent part, so that
            it is z·√(count of so many frames / F).
    """

    count: float
    significance: float


FEWEST_FRAMES = 10
"""Frames that the significance of fewer is extrapolated to. See docs/measured.md."""


def independent_samples_at(edges: EdgeFrames, T_camera_lidar: Matrix4) -> IndependentSamples:
    """How many independent frames put the camera at `T_camera_lidar` (4, 4), and how significantly."""
    frames, some = len(edges.maps), edges.of_points(thinned(len(edges.weight), EXCHANGED_POINTS))
    alike = intraclass_correlation(strengths_on_each_map(some, T_camera_lidar))
    whole = frame_alignment(edges, T_camera_lidar).significance
    return IndependentSamples(
        effective_sample_size(alike, frames),
        whole * math.sqrt(effective_sample_size(alike, max(frames, FEWEST_FRAMES)) / frames),
    )


def intraclass_correlation(agreement: NDArray[np.float64]) -> float:
    """ρ, 0 to 1: mean agreement with other frames over mean agreement with the own one, from how well each sweep (rows)
    agrees with each image (columns), (F, F). The order of the frames does not change it. It is 1 of a single frame, and
    of frames that do not agree with themselves."""
    frames = len(agreement)
    own = math.fsum(np.diag(agreement).tolist())
    if own <= 0.0 or frames == 1:
        return 1.0
    others = (math.fsum(agreement.ravel().tolist()) - own) / (frames - 1)
    return min(max(others / own, 0.0), 1.0)


def effective_sample_size(alike: float, frames: int) -> float:
    """The number of independent samples of F frames whose intraclass correlation is `alike`: F over the design effect
    (Kish 1965), F / (1 + (F - 1)·ρ)."""
    return frames / (1.0 + (frames - 1) * alike)
