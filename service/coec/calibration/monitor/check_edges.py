"""The edges of a check. Every sweep and every image is prepared once, however many pairs of a rig use it, and measured
for what it shows of the sensor (`sensor_faults` judges that); range edges of some sweeps are projected onto the
edge maps of the images of one camera; and the local optima of their significance near a pose are searched.

It is a module of its own because measuring takes compiled kernels, and the process that serves queries needs the faults
but loads no compiler.

Resolutions: the sharpest edges decide and are read at the camera's own resolution (halved only above `MAX_PIXELS`), so
images are decoded in full. Bands are two pixels wide and read at full, half and quarter resolution. A depth network
reads fewer pixels and decodes for itself. Edges of an image are needed only where range edges can lie: a thousand of
the 114,000 points of a sweep, in a strip of a fifth of a fisheye's image.

Both are prepared for each sensor by itself (`sensors`). All that is left for each pair is to place some thousand points
at the instants of its exposures.

One climb goes straight up from the pose on the sharpest edges. Others go from coarse to fine: by the finest band from
the end of that climb, and from every other hill of the coarsest band that a cover of all rotations within reach shows.
The optimum next to the pose is believed unless another place is clearly better and stands out. Nothing is random.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import cos, pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.ego_mask import cell_means
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.monitor import sensor_faults
from coec.calibration.objective.mutual_information import COLUMNS, ROWS, Cells, PointsInView, sectors
from coec.calibration.search.local_search import POLISH_METRES_PER_RADIAN, Box, maximum_in
from coec.calibration.types import FramePair, LidarFrame, Matrix4, Rig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera, cropped, in_image, pixel_rad, scaled
from coec.geometry.edges import alignment
from coec.geometry.edges.charts import moved_by, select_separated, unit_ball
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, MEAN_RADIUS_PX, EdgeScales, Rectangle
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.edges.reflectance_edges import learn_noise, reflectance_edges, reflectance_steps
from coec.geometry.edges.scan_lines import ScanLines, SweepEdges, scan_lines
from coec.geometry.images import level_counts, neighbour_differences
from coec.geometry.points import thinned
from coec.geometry.projection import project
from coec.geometry.sweep_kernels import Bearings, bearings, grid_counts

BRIGHT_SHARE, BRIGHT_STEP = 0.9, 4
"""Share of the pixels below the grey value `bright`, and the sampling: every fourth pixel of every fourth row."""

THUMBNAIL_CELL_PX = 8
"""Side, in pixels of the image, of one pixel of the thumbnail by which pictures are compared."""


def picture_facts(grey: NDArray[np.uint8]) -> sensor_faults.PictureFacts:
    """The facts of an image, (h, w)."""
    thumbnail = cell_means(grey, THUMBNAIL_CELL_PX).astype(np.float32)
    levels = np.cumsum(level_counts(grey, BRIGHT_STEP))
    return sensor_faults.PictureFacts(
        gradient=neighbour_differences(grey, sensor_faults.BLOCK_ROWS, sensor_faults.BLOCK_COLUMNS),
        bright=float(np.searchsorted(levels, BRIGHT_SHARE * levels[-1])),
        thumbnail=thumbnail,
        digest=zlib.crc32(thumbnail.data),
    )


def sweep_facts(xyz_m: NDArray[np.float32], seen: Bearings, range_edges: int) -> sensor_faults.SweepFacts:
    """The facts of a sweep, from its points (N, 3), their bearings and the number of its range edges."""
    low, high = sensor_faults.BAND_RANGE_RAD
    bands, sectors = grid_counts(seen.elevation, seen.azimuth, low, high, sensor_faults.BANDS, sensor_faults.SECTORS)
    return sensor_faults.SweepFacts(bands, sectors, range_edges, zlib.crc32(np.ascontiguousarray(xyz_m).data))


MAX_PIXELS = 2_500_000
"""Images are halved until they have no more pixels than this, which bounds the time for any camera."""

COARSEST_BLUR_RAD = radians(0.6)
"""Least blur of the coarsest band, an angle about the optical axis; the blur is below twice that. The hills of the band
are then wide enough for a cover of some hundred poses within reach."""

OUTLINE_RAD = radians(2.0)
"""Within this turn of the camera the range edges have to stay on the prepared part of its images, all but a few. After
a larger turn some of them lie beyond its rim, but enough lie on it to show the turn."""

OUTLINE_POINTS, OUTLINE_SHARE = 1_500, 0.01
"""Range edges from which the prepared part is found, and the share of them that may lie beyond it on each side: without
that share a post next to the vehicle would double the part."""

MARGIN_PX = MEAN_RADIUS_PX + 8
"""Margin by which the prepared part is larger: the reach of a local mean, and of a blur."""


@dataclass(frozen=True, slots=True, eq=False)
class PreparedSweep:
    """A sweep of one LiDAR.

    Attributes:
        sweep: as measured.
        edges: the sweep reduced to its range edges.
        weight: (E,) float32, weight of each range edge; see `SweepEdges`.
        lines: its scan lines.
        facts: what the sweep shows of the sensor itself.
    """

    sweep: LidarFrame
    edges: LidarFrame
    weight: NDArray[np.float32]
    lines: ScanLines
    facts: sensor_faults.SweepFacts


@dataclass(frozen=True, slots=True, eq=False)
class MapLevel:
    """Edge maps of the images of one camera at one level: `maps` (F, h, w) int8 as in `EdgePyramid`, `camera` the
    intrinsics of what they cover, `blur_rad` their blur, an angle about the optical axis."""

    camera: Camera
    blur_rad: float
    maps: NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class PreparedImages:
    """The images of one camera.

    Attributes:
        facts: what each shows of the camera itself.
        sharp, whole: as in `EdgePyramid`.
        bands: likewise, from fine to coarse; at least two.
    """

    facts: tuple[sensor_faults.PictureFacts, ...]
    sharp: MapLevel
    whole: MapLevel
    bands: tuple[MapLevel, ...]


def prepare_sweep(sweep: LidarFrame) -> PreparedSweep:
    """The range edges of a sweep, and what the sweep shows of the LiDAR. Only these points are placed, and only later,
    because every pair places them at the instant of another exposure."""
    seen = bearings(sweep.xyz_m)
    lines = scan_lines(sweep.xyz_m, sweep.ring, seen)
    detected = range_edges(lines)
    facts = sweep_facts(sweep.xyz_m, seen, len(detected.index))
    return PreparedSweep(sweep, _reduced(sweep, detected), detected.weight, lines, facts)


def _reduced(sweep: LidarFrame, edges: SweepEdges) -> LidarFrame:
    """The sweep reduced to some of its edges."""
    offsets_s = None if sweep.time_offset_s is None else sweep.time_offset_s[edges.index]
    # The shift may come before motion compensation, which turns this tenth of a degree by two degrees at most.
    xyz_m = sweep.xyz_m[edges.index] + edges.shift_m
    return LidarFrame(sweep.stamp_ns, sweep.frame_id, xyz_m, time_offset_s=offsets_s)


def outline(camera: Camera, edges: Sequence[LidarFrame], pose: Matrix4, reach_rad: float) -> Rectangle | None:
    """The part of the image in which range edges can lie at poses within `reach_rad` of a pose (4, 4); None if none
    can."""
    xyz_m = np.concatenate([sweep.xyz_m for sweep in edges])
    xyz_m = xyz_m[thinned(len(xyz_m), OUTLINE_POINTS)].astype(np.float64)
    turns_rad = reach_rad * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    # A point that can reach the rim of the strip is at the rim at one of these poses.
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for turned in moved_by(np.ascontiguousarray(pose), turns_rad, np.zeros_like(turns_rad)):
        uv_px, valid = project(camera, xyz_m @ turned[:3, :3].T + turned[:3, 3])
        uv_px = uv_px[valid]
        uv_px = np.sort(uv_px[in_image(camera, uv_px)], axis=0)
        if len(uv_px):
            beyond = int(OUTLINE_SHARE * len(uv_px))
            low, high = np.minimum(low, uv_px[beyond]), np.maximum(high, uv_px[-1 - beyond])
    if not np.isfinite(low).all():
        return None
    left, top = np.maximum(np.floor(low).astype(int), 0).tolist()
    right, bottom = np.minimum(np.ceil(high).astype(int) + 1, (camera.width, camera.height)).tolist()
    return Rectangle(left, top, right - left, bottom - top)


def prepare_images(
    greys: Iterable[NDArray[np.uint8]],
    frames: int,
    camera: Camera,
    mask: NDArray[np.bool_] | None,
    upright: NDArray[np.float64],
    counted: Rectangle,
    required: Rectangle,
) -> PreparedImages:
    """Edge maps of the images of a camera, and what they show of the camera. Images are read one at a time, so `greys`
    (height, width) may decode each when it is asked for.

    Args:
        frames: how many images there are.
        mask: (height, width), False = ignore this pixel; None: all count.
        upright: (2,) direction of the LiDAR's axis in the image, see `EdgeScales`; with several LiDARs, that of any.
        counted: the part of the image in which range edges lie: its mean and deviation are the units of the maps.
        required: the part on which edges are needed; it contains `counted`.

    Raises:
        CalibrationError: an image is not of the camera's size.
    """
    finest = math.ceil(math.log2(max(1.0, camera.width * camera.height / MAX_PIXELS)) / 2.0)
    coarsest = max(finest + 1, math.ceil(math.log2(COARSEST_BLUR_RAD / (BLUR_SIGMA_PX * pixel_rad(camera)))))
    part = _aligned(required, camera, 2 << coarsest)
    lit = np.ones((part.height, part.width), np.bool_) if mask is None else np.ascontiguousarray(mask[part.slices])
    scales = EdgeScales(lit, finest, coarsest, upright, counted.within(part))
    facts: list[sensor_faults.PictureFacts] = []
    stacks: list[NDArray[np.int8]] = []
    for frame, grey in enumerate(greys):
        if grey.shape != (camera.height, camera.width):
            (height, width) = grey.shape
            raise CalibrationError(
                f"an image has {width} x {height} px, the camera model {camera.width} x {camera.height} px"
            )
        facts.append(picture_facts(grey))
        pyramid = scales.pyramid(np.ascontiguousarray(grey[part.slices]))
        maps = (pyramid.sharp, pyramid.whole, *pyramid.bands)
        stacks = stacks or [np.empty((frames, *level.shape), np.int8) for level in maps]
        for stack, level_map in zip(stacks, maps, strict=True):
            stack[frame] = level_map
    of_part = cropped(camera, part.left, part.top, part.width, part.height)

    def level(number: int, blurred: int, maps: NDArray[np.int8]) -> MapLevel:
        # Halving drops a last odd row or column, but the scale is still a half.
        _, height, width = maps.shape
        seen_by = scaled(of_part, 0.5**number, 0.5**number)._replace(width=width, height=height)
        return MapLevel(seen_by, 2.0**blurred * BLUR_SIGMA_PX * pixel_rad(camera), maps)

    sharp, whole, *bands = stacks
    return PreparedImages(
        facts=tuple(facts),
        sharp=level(finest, finest, sharp),
        whole=level(finest + 1, finest, whole),
        bands=tuple(level(finest + k, finest + k, maps) for k, maps in enumerate(bands)),
    )


def union(parts: Sequence[Rectangle]) -> Rectangle:
    """The smallest part that contains all of the given parts, for several LiDARs that use one camera."""
    left, top = min(part.left for part in parts), min(part.top for part in parts)
    right = max(part.left + part.width for part in parts)
    bottom = max(part.top + part.height for part in parts)
    return Rectangle(left, top, right - left, bottom - top)


def _aligned(part: Rectangle, camera: Camera, step_px: int) -> Rectangle:
    """The part with a margin, within the image, begun at a pixel at which a pixel of every level begins."""
    left, top = (max(begin - MARGIN_PX, 0) // step_px * step_px for begin in (part.left, part.top))
    right = min(part.left + part.width + MARGIN_PX, camera.width)
    bottom = min(part.top + part.height + MARGIN_PX, camera.height)
    return Rectangle(left, top, right - left, bottom - top)


CELL_STEP = 0.25
"""Difference step of the cells, in blurs of the finest band: half a pixel of the sharpest map."""


RANGE, REFLECTANCE = 0, 1
KINDS = 2
"""Kinds of edges of a sweep."""

KIND_COUNTS = np.array([1.0, 2.0])
"""What an edge of each kind counts as. Neighbouring range edges lie along one silhouette, and fall on the same image
edge or miss it together. See docs/measured.md."""


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedLevel:
    """Edges of sweeps on the maps of one level, and the blur of these maps, an angle about the optical axis."""

    frames: alignment.EdgeFrames
    blur_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedEdges:
    """The edges of sweeps that can come into view, on maps of several levels: the same points in the same order on
    each.

    Attributes:
        kind: (E,) uint8 kind of each edge.
        balance: (KINDS,) factors by which the weights of each kind were multiplied, the largest one 1.
        sharp: on the sharpest edges, which settle a pose.
        whole: on blurred edges that keep the layout of the scene.
        bands: from fine to coarse; at least two.
        measured: the pairs, their sweeps reduced to these edges, before motion compensation.
    """

    kind: NDArray[np.uint8]
    balance: NDArray[np.float64]
    sharp: ProjectedLevel
    whole: ProjectedLevel
    bands: tuple[ProjectedLevel, ...]
    measured: tuple[FramePair, ...]

    @property
    def frame(self) -> NDArray[np.int64]:
        """(E,) the frame of each edge."""
        first = self.sharp.frames.first_point
        return np.repeat(np.arange(len(first) - 1), np.diff(first))

    def of(self, indices: Sequence[int]) -> ProjectedEdges:
        """The edges of some of the pairs alone, by their indices."""
        return ProjectedEdges(
            self.kind[_rows_of(self.sharp.frames, indices)],
            self.balance,
            _level_of(self.sharp, indices),
            _level_of(self.whole, indices),
            tuple(_level_of(band, indices) for band in self.bands),
            tuple(self.measured[i] for i in indices),
        )

    def weighted(self, factors: NDArray[np.float64]) -> ProjectedEdges:
        """The edges with the weight of each multiplied by the factor of its kind, (KINDS,), the largest one 1."""
        of_edges = factors.astype(np.float32)[self.kind]

        def level(of: ProjectedLevel) -> ProjectedLevel:
            return replace(of, frames=replace(of.frames, weight=of.frames.weight * of_edges))

        balance = self.balance * factors
        return replace(
            self,
            balance=balance / balance.max(),
            sharp=level(self.sharp),
            whole=level(self.whole),
            bands=tuple(level(band) for band in self.bands),
        )

    def count(self, T_camera_lidar: Matrix4 | None = None) -> float:
        """The effective number of edges (Kish 1965, by the weights of their kinds): of those in the images at a pose
        (4, 4), or of all."""
        kind, frames = self.kind, self.sharp.frames
        if T_camera_lidar is not None:
            uv_px, valid = project(frames.camera, placed(frames, T_camera_lidar))
            kind = kind[valid & in_image(frames.camera, uv_px)]
        numbers = np.bincount(kind, minlength=KINDS) * KIND_COUNTS
        return float((numbers @ self.balance) ** 2 / max(float(numbers @ self.balance**2), 1e-9))

    def cells(self, T_camera_lidar: Matrix4) -> Cells:
        """The sharpest edges by sectors of the image, cut at a pose (4, 4)."""
        frames = self.sharp.frames
        p_camera = placed(frames, T_camera_lidar)
        uv_px, valid = project(frames.camera, p_camera)
        seen = valid & in_image(frames.camera, uv_px)
        # Edges outside the image count with the first sector if a step brings them into view.
        sector = np.zeros(len(p_camera), np.uint8)
        sector[seen] = sectors(uv_px[seen])

        def at(poses: NDArray[np.float64]) -> NDArray[np.float64]:
            of_sectors = alignment.alignment_of_parts(frames, sector, COLUMNS * ROWS, poses)
            squares = np.array([float(square.sum()) for square in of_sectors.square])
            scales = len(frames.maps) / np.sqrt(np.maximum(squares, alignment.LEAST_SQUARE))
            return np.asarray(of_sectors.strength * scales[:, None, None])

        points = PointsInView(p_camera[seen], frames.weight[seen].astype(np.float64), self.frame[seen])
        return Cells(at, CELL_STEP * self.bands[0].blur_rad, points)


def project_edges(
    rig: Rig,
    pairs: Sequence[FramePair],
    sweeps: Sequence[PreparedSweep],
    images: PreparedImages,
    pose: Matrix4,
    reach_rad: float,
    *,
    compensated: bool,
    with_reflectance: bool = False,
) -> ProjectedEdges:
    """Lays the edges of the sweeps that come within the prepared part of the images at a pose (4, 4), or within
    `reach_rad` of it: those of range, and those of reflectance if they are wanted and the sweeps have it.

    Args:
        sweeps: those of the pairs, in order.
        images: those of the pairs, in order.
        compensated: whether the sweeps are to be motion-compensated.
    """
    margin_px = reach_rad / images.sharp.blur_rad * _PIXELS_PER_BLUR
    measured, points_m, weights, kinds = [], [], [], []
    detected = reflectance_edges_of(sweeps) if with_reflectance else [None] * len(sweeps)
    for pair, sweep, more in zip(pairs, sweeps, detected, strict=True):
        edges, weight, kind = sweep.edges, sweep.weight, np.full(len(sweep.weight), RANGE, np.uint8)
        if more is not None:
            edges = _joined(edges, _reduced(sweep.sweep, more))
            weight = np.concatenate([weight, more.weight])
            kind = np.concatenate([kind, np.full(len(more.weight), REFLECTANCE, np.uint8)])
        of_edges = replace(pair, lidar=edges)
        xyz_m = compensate(of_edges, rig, enabled=compensated)
        near = np.flatnonzero(_may_be_seen(images.sharp, xyz_m, pose, margin_px))
        offsets_s = None if edges.time_offset_s is None else edges.time_offset_s[near]
        of_near = replace(edges, xyz_m=edges.xyz_m[near], time_offset_s=offsets_s)
        measured.append(replace(pair, lidar=of_near))
        points_m.append(xyz_m[near])
        weights.append(weight[near])
        kinds.append(kind[near])
    first_point = np.concatenate([[0], np.cumsum([len(weight) for weight in weights])]).astype(np.int64)
    xyz_m, weight = np.ascontiguousarray(np.concatenate(points_m).T), np.concatenate(weights)

    def projected(level: MapLevel) -> ProjectedLevel:
        return ProjectedLevel(
            alignment.EdgeFrames(level.camera, xyz_m, weight, first_point, level.maps), level.blur_rad
        )

    bands = tuple(projected(band) for band in images.bands)
    return ProjectedEdges(
        np.concatenate(kinds),
        (np.bincount(np.concatenate(kinds), minlength=KINDS) > 0).astype(np.float64),
        projected(images.sharp),
        projected(images.whole),
        bands,
        tuple(measured),
    )


def reflectance_edges_of(sweeps: Sequence[PreparedSweep]) -> list[SweepEdges | None]:
    """The reflectance edges of each sweep of one LiDAR, against the noise that these sweeps show; None of a sweep
    without reflectance, or of all if there are too few steps to learn its noise."""
    steps = [
        None if sweep.sweep.intensity is None else reflectance_steps(sweep.lines, sweep.sweep.intensity)
        for sweep in sweeps
    ]
    noise = learn_noise([one for one in steps if one is not None])
    return [None if one is None or noise is None else reflectance_edges(one, noise) for one in steps]


def _joined(one: LidarFrame, other: LidarFrame) -> LidarFrame:
    """The points of both."""
    offsets_s = (
        None
        if one.time_offset_s is None or other.time_offset_s is None
        else np.concatenate([one.time_offset_s, other.time_offset_s])
    )
    return replace(one, xyz_m=np.concatenate([one.xyz_m, other.xyz_m]), time_offset_s=offsets_s)


_PIXELS_PER_BLUR = 2.0
"""Pixels per blur of the finest band, see `BLUR_SIGMA_PX`."""


def placed(frames: alignment.EdgeFrames, T_camera_lidar: Matrix4) -> NDArray[np.float64]:
    """(E, 3) the range edges in the frame of the camera at a pose (4, 4)."""
    xyz_m = frames.xyz_m.astype(np.float64)
    return np.asarray(xyz_m.T @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])


def _may_be_seen(level: MapLevel, xyz_m: NDArray[np.float32], pose: Matrix4, margin_px: float) -> NDArray[np.bool_]:
    uv_px, valid = project(level.camera, xyz_m.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])
    (u, v), camera = uv_px.T, level.camera
    across = (u >= -margin_px) & (u < camera.width + margin_px)
    return np.asarray(valid & across & (v >= -margin_px) & (v < camera.height + margin_px))


def _level_of(level: ProjectedLevel, indices: Sequence[int]) -> ProjectedLevel:
    frames, rows = level.frames, _rows_of(level.frames, indices)
    first = frames.first_point
    counts = [first[i + 1] - first[i] for i in indices]
    of_some = replace(
        frames,
        xyz_m=np.ascontiguousarray(frames.xyz_m[:, rows]),
        weight=frames.weight[rows],
        first_point=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        maps=np.ascontiguousarray(frames.maps[list(indices)]),
    )
    return replace(level, frames=of_some)


def _rows_of(frames: alignment.EdgeFrames, indices: Sequence[int]) -> NDArray[np.int64]:
    """The indices of the edges of some frames."""
    first = frames.first_point
    return np.concatenate([np.arange(first[i], first[i + 1]) for i in indices])


REACH_RAD = radians(4.0)
"""How far about the pose a check searches. If the truth is farther off, the local optimum is at the rim or anywhere,
and either is far beyond any limit."""

COVER_SPACING = 0.9
"""Distance between the poses of the cover, in blurs of the coarsest band."""

MOST_POSES = 1_500
"""Most poses of the cover: as many as with the finest spacing that `COARSEST_BLUR_RAD` allows."""

COVER_POINTS = 2_000
"""Most range edges that score the cover; significance falls only with the root of their number."""

BEGINNINGS, MIN_SEPARATION = 2, 1.5
"""How many of the best poses of the cover begin a climb, and how many blurs they are apart."""

FAIR_SHARE = 0.8
"""Share of the best score of the cover that a beginning must have."""

OTHER_POSES, OTHER_POSES_RAD = 32, (radians(3.0), radians(28.0))
"""Number of poses either way, and the range of their turns about the LiDAR's axis, that give the mean and the standard
deviation of a significance. After such turns range edges stay on the prepared strip of the image and in its layout:
they lie as high as before, but on other things."""

BALANCE_POSES = 16
"""The same number for the weights of the kinds of edges."""

LEAST_CONTRAST = 3.0
"""Least contrast of a kind of edges that has any weight, standard deviations: of useless ones one in a thousand."""

SELECTION = 2.0
"""By how much the choice of weights raises the contrast where nothing fits, standard deviations. See
docs/measured.md."""

MIN_CONTRAST = 4.0
"""If an optimum stands out from other poses by fewer standard deviations, its edges count as faint, and no place other
than the one next to the pose is believed. See docs/measured.md."""

SAME = 0.25
"""Two climbs whose ends are nearer than this share of the finest band's blur have the same end."""

NEAR_SHARE = 0.9
"""The maximum next to the pose is believed if it has at least this share of the significance of the best maximum within
reach, on the sharpest edges: a mount that did not move is far likelier than one that moved to a place which fits hardly
better. Between guard rails, lane markings and a horizon, which all run to one point, edges fit nearly as well a degree
beside. See docs/measured.md."""

HOPELESS_SHARE = 0.7
"""A climb is not followed to the sharpest edges if on the finest band it has less than this share of the significance
of the optimum next to the pose."""

ASCENT_STEPS = 4.0
"""Half-width of the box of a climb, in blurs."""

TOLERANCE, LEADING_TOLERANCE = 0.01, 0.1
"""Last trust region of a climb, in blurs of its level: for a climb that settles a pose, and for one that leads to a
finer level."""

MAX_EVALUATIONS = 400
"""Most evaluations of a climb, so that it ends whatever the edges are like."""

ROTATION_DOF, POSE_DOF = 3, 6
"""Number of axes of ξ over which the two optima of a check are searched: rotations, and all."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalOptima:
    """What was found near a pose.

    Attributes:
        edges: those by which it was found, with the weights of their kinds.
        T_rotation: (4, 4) local optimum over rotations, with the camera's centre of the pose.
        T_pose: (4, 4) local optimum over all six degrees of freedom.
        contrast: how far the finest band at `T_rotation` stands above other poses, standard deviations; less
            `SELECTION` if weights were chosen.
    """

    edges: ProjectedEdges
    T_rotation: Matrix4
    T_pose: Matrix4
    contrast: float


@dataclass(frozen=True, slots=True, eq=False)
class _End:
    pose: Matrix4
    significance: float


def search_local_optima(edges: ProjectedEdges, pose: Matrix4) -> LocalOptima:
    """The neighbourhood of a pose (4, 4)."""
    pose = np.ascontiguousarray(pose)
    step = se3.axis_steps(edges.bands[0].blur_rad, POLISH_METRES_PER_RADIAN)[:ROTATION_DOF]
    near = _ascend(edges.sharp.frames, pose, step, TOLERANCE)
    return _best_of(edges, near, _ends(edges, pose, near, step), step)


def search_with_reflectance(edges: ProjectedEdges, pose: Matrix4, of_range: Matrix4) -> LocalOptima | None:
    """The same with both kinds of edges, each with the weight that it is worth here; None if reflectance edges are
    worth nothing, and so change nothing. `of_range` (4, 4) is the optimum of range edges."""
    if not (edges.kind == REFLECTANCE).any():
        return None
    pose = np.ascontiguousarray(pose)
    step = se3.axis_steps(edges.bands[0].blur_rad, POLISH_METRES_PER_RADIAN)[:ROTATION_DOF]
    edges = _balanced_by_power(edges)
    near = _ascend(edges.sharp.frames, pose, step, TOLERANCE)
    ends = _ends(edges, pose, near, step)
    # What each kind is worth shows where they fit best.
    edges = _balanced(edges, [near.pose, *(end.pose for end in ends), of_range])
    if edges.balance[REFLECTANCE] == 0.0:
        return None
    best = _best_of(edges, _ascend(edges.sharp.frames, near.pose, step, TOLERANCE), ends, step)
    return replace(best, contrast=best.contrast - SELECTION)


def _best_of(edges: ProjectedEdges, near: _End, ends: Sequence[_End], step: NDArray[np.float64]) -> LocalOptima:
    """The optima at the maximum next to a pose, or where one of some climbs leads if that is clearly better."""
    finest = edges.bands[0]
    fair = HOPELESS_SHARE * float(alignment.smooth_significances(finest.frames, near.pose[None])[0])
    best = near
    for end in ends:
        z = float(alignment.smooth_significances(finest.frames, end.pose[None])[0])
        if z >= fair and _angle_between(end.pose, near.pose) >= SAME * finest.blur_rad:
            end = _ascend(edges.sharp.frames, end.pose, step, TOLERANCE)
            best = max(best, end, key=lambda one: one.significance)
    there = _contrast(finest, best.pose)
    if best is not near and (there < MIN_CONTRAST or near.significance >= NEAR_SHARE * best.significance):
        best, there = near, _contrast(finest, near.pose)
    return LocalOptima(edges, best.pose, _pose_of(edges, best), there)


def _ends(edges: ProjectedEdges, pose: Matrix4, near: _End, step: NDArray[np.float64]) -> list[_End]:
    """The ends of climbs on the bands, from the maximum next to a pose and from other hills within reach."""
    coarsest, finest = edges.bands[-1], edges.bands[0]
    cover = _cover(pose, coarsest.blur_rad)
    thin = coarsest.frames.of_points(thinned(len(coarsest.frames.weight), COVER_POINTS))
    z = alignment.significances(thin, cover)
    z_best = float(z.max())
    # The maximum of the sharpest edges next to the pose may be a ripple on a hill that is whole on the finest band.
    ends = [_ascend(finest.frames, near.pose, step, LEADING_TOLERANCE)]
    separation = MIN_SEPARATION * coarsest.blur_rad
    z_near = float(alignment.significances(thin, near.pose[None])[0])
    for number in select_separated(cover, np.argsort(-z, kind="stable"), BEGINNINGS, _trace_of(separation)):
        # A nearer beginning is on the same hill, unless it is higher than the maximum next to the pose. That maximum is
        # then a ripple on the slope, and the finest band, whose reach is a few tenths of a degree, may not lead off it.
        if z[number] >= FAIR_SHARE * z_best and (
            _angle_between(cover[number], near.pose) > separation or z[number] > z_near
        ):
            ends.append(_led(edges.bands, cover[number]))
    return ends


def _balanced_by_power(edges: ProjectedEdges) -> ProjectedEdges:
    """The edges with the weights of the more numerous kind reduced until the squares of both add to the same: if one of
    them fits nothing at all, the significance of the true pose falls by a root of two."""
    square = np.bincount(edges.kind, edges.sharp.frames.weight.astype(np.float64) ** 2, KINDS)
    return edges.weighted(np.sqrt(max(square.min(), 1e-9) / np.maximum(square, 1e-9)))


def _balanced(edges: ProjectedEdges, poses: Sequence[Matrix4]) -> ProjectedEdges:
    """The edges with the weights by which one of some poses stands out most from other poses: each kind in proportion
    to how far it stands out by itself, in units of its variance (linear discriminant, Fisher 1936). A kind that stands
    out by less than `LEAST_CONTRAST` standard deviations weighs nothing."""
    band = edges.bands[0].frames
    kinds = [band.of_points(np.flatnonzero(edges.kind == kind)) for kind in range(KINDS)]
    nothing = np.array([1.0, 0.0])
    best, balance = 0.0, nothing
    for pose in poses:
        there = np.concatenate([pose[None], pose @ _other_turns(BALANCE_POSES)])
        sums = np.stack([alignment.alignments(of_kind, there).strength.sum(axis=1) for of_kind in kinds])
        excess = sums[:, 0] - sums[:, 1:].mean(axis=1)
        variance = np.maximum(sums[:, 1:].var(axis=1), 1e-9)
        contrast = excess / np.sqrt(variance)
        evidence = float((np.maximum(contrast, 0.0) ** 2).sum())
        if evidence > best:
            gain = np.where(contrast >= LEAST_CONTRAST, excess / variance, 0.0)
            best, balance = evidence, gain / gain.max() if gain.any() else nothing
    return edges.weighted(balance)


def _other_turns(each_way: int) -> NDArray[np.float64]:
    """(2·each_way, 4, 4) turns about the LiDAR's axis, after which the same sweeps lie on other parts of the images."""
    turns = np.tile(np.eye(4), (2 * each_way, 1, 1))
    one_way = np.linspace(*OTHER_POSES_RAD, each_way)
    angle_rad = np.concatenate([one_way, -one_way])
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angle_rad)
    turns[:, 1, 0] = np.sin(angle_rad)
    turns[:, 0, 1] = -turns[:, 1, 0]
    return turns


def _contrast(band: ProjectedLevel, pose: Matrix4) -> float:
    """How far a pose stands above others at which the same sweeps lie on other parts of the images; standard
    deviations."""
    z = alignment.significances(band.frames, np.concatenate([pose[None], pose @ _other_turns(OTHER_POSES)]))
    return float((z[0] - z[1:].mean()) / max(float(z[1:].std()), 1e-9))


def _pose_of(edges: ProjectedEdges, rotation: _End) -> Matrix4:
    """The optimum over six degrees of freedom next to the one over three, climbed to directly or by way of the finest
    band."""
    finest = edges.bands[0]
    settled = se3.axis_steps(finest.blur_rad, POLISH_METRES_PER_RADIAN)
    near = _ascend(edges.sharp.frames, rotation.pose, settled, TOLERANCE)
    led = _ascend(finest.frames, rotation.pose, settled, LEADING_TOLERANCE)
    if float(np.abs(se3.difference(led.pose, near.pose) / settled).max()) < SAME:
        return near.pose  # the way by the finest band leads to the same end
    far = _ascend(edges.sharp.frames, led.pose, settled, TOLERANCE)
    return near.pose if near.significance >= NEAR_SHARE * far.significance else far.pose


def _led(bands: tuple[ProjectedLevel, ...], pose: Matrix4) -> _End:
    """The end of a climb on the bands, from coarse to fine."""
    end = _End(pose, 0.0)
    for band in reversed(bands):
        end = _ascend(
            band.frames,
            end.pose,
            se3.axis_steps(band.blur_rad, POLISH_METRES_PER_RADIAN)[:ROTATION_DOF],
            LEADING_TOLERANCE,
        )
    return end


def _ascend(frames: alignment.EdgeFrames, start: Matrix4, step: NDArray[np.float64], tolerance: float) -> _End:
    """The maximum next to a pose, along the first `len(step)` axes of ξ."""
    dof = len(step)

    def at(points: NDArray[np.float64]) -> NDArray[np.float64]:
        xi = np.zeros((len(points), 6))
        xi[:, :dof] = points
        return moved_by(start, np.ascontiguousarray(xi[:, :3]), np.ascontiguousarray(xi[:, 3:]))

    def scores(points: NDArray[np.float64]) -> list[float]:
        values: list[float] = alignment.smooth_significances(frames, at(points)).tolist()
        return values

    reach = ASCENT_STEPS * step
    best, _ = maximum_in(Box(-reach, reach, step, tolerance * step), scores, np.zeros(dof), MAX_EVALUATIONS)
    end = at(best[None])
    return _End(end[0], float(alignment.smooth_significances(frames, end)[0]))


def _cover(pose: Matrix4, blur_rad: float) -> NDArray[np.float64]:
    """(K, 4, 4) poses that cover all rotations within reach."""
    volume = 4.0 / 3.0 * pi * (REACH_RAD / (COVER_SPACING * blur_rad)) ** 3
    ball = unit_ball(min(max(round(volume), 64), MOST_POSES))
    return moved_by(pose, REACH_RAD * ball, np.zeros_like(ball))


def _trace_of(angle_rad: float) -> float:
    return 1.0 + 2.0 * cos(angle_rad)


def _angle_between(one: Matrix4, other: Matrix4) -> float:
    return se3.rotation_angle_rad(one @ se3.inverse(other))
