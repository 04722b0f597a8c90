"""The objective of a window: equation (1) with a guard against poses that turn away from the points, and with all
frozen that may be; and objectives divided into cells: what every frame adds in every sector of the image.

Frames differ by what the vehicle passed, sectors by what stands where. The sum alone does not show what they have in
common: a standing vehicle sees the same corner of a wall in every frame, and a lens that is wrong at its rim is wrong
in every frame. Cells show it.

Frozen for a whole search are the bins of range and depth, the set of points, and the number of points that a frame is
expected to have in view. Only the projection depends on the pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import radians
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import DepthMap, Matrix4, Rig
from coec.config import ObjectiveConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera, in_image, scaled
from coec.geometry.mutual_information import (
    BinnedFrames,
    FrameInformation,
    information_of_each,
    mutual_information,
    share_of_pixels,
)
from coec.geometry.points import lengths, thinned
from coec.geometry.projection import azimuth_order, bundle, half_field_of_view_rad, project, within_cone

COLUMNS, ROWS = 8, 2
"""Sectors of the image, across and down. There are more than degrees of freedom, so that their scatter can be
distinguished from the pose; each is several degrees wide, so that an object lies in one. See docs/measured.md."""


@dataclass(frozen=True, slots=True, eq=False)
class PointsInView:
    """The points in view that settle a pose.

    Attributes:
        p_camera: (N, 3) metres, camera frame.
        weight: (N,) weight of each point in the objective.
        frame: (N,) index of the frame of each point.
    """

    p_camera: NDArray[np.float64]
    weight: NDArray[np.float64]
    frame: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """An objective near one pose, divided.

    Attributes:
        at: (K, F, B) what each of F frames adds in each of B sectors at each of K poses (K, 4, 4). The mean over the
            frames of the sums over the sectors is the objective, up to a constant.
        step_rad: difference step at which the hill still looks like a hill: no wider than its top, no finer than its
            ripples.
        points: those in view at the pose.
    """

    at: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    step_rad: float
    points: PointsInView


def sectors(uv_px: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) the sector of each of N pixels (N, 2): `COLUMNS` columns of equal numbers of pixels, each divided into
    `ROWS` rows of equal numbers."""
    sector = np.empty(len(uv_px), np.int64)
    across = np.argsort(uv_px[:, 0], kind="stable")
    for column, of_column in enumerate(np.array_split(across, COLUMNS)):
        down = of_column[np.argsort(uv_px[of_column, 1], kind="stable")]
        for row, of_row in enumerate(np.array_split(down, ROWS)):
            sector[of_row] = column * ROWS + row
    return sector


GUARD_OVERLAP = 0.5
"""If a frame sees less than this share of the most points that it could see, its MI is reduced in proportion. Plain MI
grows when points leave the view (METHOD, section 3), so a pose that sees less than half of what it could is penalised.
See docs/measured.md."""

QUANTILE_SAMPLES = 65_536
"""Number of values of a frame from which its bin edges are computed. The rank of an edge is then known to 0.2 % (the
binomial deviation of the median), far inside a bin of 1/32."""


GEOMETRY_POINTS = 20_000
"""Number of points that stand for the geometry of a window if every point has the same weight."""


@dataclass(frozen=True, slots=True)
class SearchBox:
    """Half-widths of the perturbations about the start that a search may reach: radians and metres, per axis."""

    rotation_rad: float
    translation_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The objective at one pose.

    Attributes:
        score: what the search maximises: nats; for the fused objective standard deviations.
        frame_scores: (F,) the same per frame.
        mi: mean of equation (1) over the frames, nats.
        overlap: points in view over the most that any pose of the box sees.
        points_in_view: number of points that entered the histograms, over all frames.
        edge_contrast: how far the edges stand above other poses, standard deviations; NaN for an objective without.
    """

    score: float
    frame_scores: NDArray[np.float64]
    mi: float
    overlap: float
    points_in_view: int
    edge_contrast: float = math.nan


class Objective(Protocol):
    """What a search maximises and a diagnosis probes."""

    @property
    def step_rad(self) -> float:
        """Difference step for derivatives on rotations: spans the ripples of the objective, not its hill."""
        ...

    def evaluate(self, T_camera_lidar: Matrix4) -> Evaluation:
        """The objective at `T_camera_lidar` (4, 4)."""
        ...

    def evaluate_each(self, poses: NDArray[np.float64]) -> list[Evaluation]:
        """The same at each of many poses (K, 4, 4), none of which depends on another's result."""
        ...


class Divisible(Objective, Protocol):
    """An objective that can be divided into cells."""

    def cells(self, T_camera_lidar: Matrix4) -> Cells:
        """Its cells, divided at `T_camera_lidar` (4, 4)."""
        ...


class MutualInformation:
    """Mutual information of one window as a function of the pose, guarded."""

    step_rad = radians(0.5)
    """Several cells of a depth map."""

    def __init__(self, frames: BinnedFrames, half_view_rad: float, reference: NDArray[np.floating]) -> None:
        """
        Args:
            frames: the window, binned.
            half_view_rad: largest angle from the optical axis at which the depth maps have a pixel that counts.
            reference: (F,) for the guard: the most points that each frame has in view anywhere in the search.
        """
        self._frames = frames
        self._half_view_rad = half_view_rad
        self._reference = reference

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return self._frames.frames

    @property
    def binned(self) -> BinnedFrames:
        """The binned window that an evaluation uses."""
        return self._frames

    def evaluate(self, T_camera_lidar: Matrix4) -> Evaluation:
        """The objective at `T_camera_lidar` (4, 4)."""
        return self._guarded(mutual_information(self._frames, T_camera_lidar))

    def evaluate_each(self, poses: NDArray[np.float64]) -> list[Evaluation]:
        """The objective at each of many poses (K, 4, 4)."""
        return [self._guarded(at) for at in information_of_each(self._frames, poses)]

    def _guarded(self, at: FrameInformation) -> Evaluation:
        share = at.points / np.maximum(self._reference, 1)
        frame_scores = at.mi * np.minimum(1.0, share / GUARD_OVERLAP)
        return Evaluation(
            score=float(frame_scores.mean()),
            frame_scores=frame_scores,
            mi=float(at.mi.mean()),
            overlap=float(at.points.sum() / self._reference.sum()),
            points_in_view=int(at.points.sum()),
        )

    def may_see(self, xyz_m: NDArray[np.float32], T_camera_lidar: Matrix4, box: SearchBox) -> NDArray[np.int64]:
        """Indices (n,) of the points (N, 3) that may be in view at some pose within a box about `T_camera_lidar`
        (4, 4)."""
        return np.flatnonzero(_Reach(self._half_view_rad, T_camera_lidar, box)(xyz_m))

    def with_points(
        self,
        points: Sequence[Points],
        times: NDArray[np.floating],
        near: Matrix4,
        box: SearchBox,
        config: ObjectiveConfig,
    ) -> MutualInformation:
        """The same depth maps with other points of the same sweeps, for poses within a box about `near` (4, 4).

        Args:
            points: of each frame, in order; points that come into view nowhere in the box may be left out.
            times: (F,) factor by which each frame has more points than in this objective, those left out included; so
                many more are expected in view.

        Raises:
            CalibrationError: no point is left between the range limits.
        """
        frames = self._frames
        reach = _Reach(self._half_view_rad, near, box)
        binned = _binned(points, frames.camera, frames.depth_bin, reach, config)
        return MutualInformation(binned, self._half_view_rad, self._reference * times)

    def cells(self, T_camera_lidar: Matrix4) -> Cells:
        """Cells by frames alone, with one sector: a histogram cannot be divided into parts."""
        frames = self._frames
        indices = thinned(frames.xyz_m.shape[1], GEOMETRY_POINTS)
        xyz_m = frames.xyz_m[:, indices].astype(np.float64)
        p_camera = np.einsum("ij,jn->ni", T_camera_lidar[:3, :3], xyz_m) + T_camera_lidar[:3, 3]
        uv_px, valid = project(frames.camera, p_camera)
        seen = valid & in_image(frames.camera, uv_px)
        frame = np.searchsorted(frames.first_point, indices, side="right") - 1
        return Cells(
            lambda poses: np.array([at.frame_scores[:, None] for at in self.evaluate_each(poses)]),
            self.step_rad,
            PointsInView(p_camera[seen], np.ones(int(seen.sum())), frame[seen]),
        )

    def mi_of_unrelated(self, T_camera_lidar: Matrix4) -> float:
        """Mean MI of every cloud with the depth map of another frame, nats: the MI that the layout of a road scene
        alone gives.

        For a single frame, its own map turned upside down and left to right is used instead.
        """
        depth = self._frames.depth_bin
        others = np.roll(depth, 1, axis=0) if self.frames > 1 else np.hstack([depth[:, -2::-1], depth[:, -1:]])
        unrelated = replace(self._frames, depth_bin=np.ascontiguousarray(others))
        return float(mutual_information(unrelated, T_camera_lidar).mi.mean())


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """The points of one frame with a value for each.

    Attributes:
        xyz_m: (N, 3) float32 points in the LiDAR frame, motion-compensated.
        of_points: (N,) float32 the values, which do not depend on the pose.
    """

    xyz_m: NDArray[np.float32]
    of_points: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Features(Points):
    """What is compared in one frame: a value for every point and a map of the image.

    Attributes:
        of_pixels: (h, w) float32 over the whole field of view of the image; NaN = no value.
    """

    of_pixels: NDArray[np.float32]


def distances(xyz_m: NDArray[np.float32], T_camera_lidar: Matrix4) -> Points:
    """The points (N, 3) with their distance from the camera at `T_camera_lidar` (4, 4).

    The paper uses the range from the LiDAR. Neither distance changes with a rotation of the camera, so either can be
    frozen for a search. But depth is measured from the camera. If the camera sits a metre ahead of the LiDAR, the range
    of the ground before the vehicle is another function of depth than the range of the walls beside it, and the optimum
    moves to make up for that. See docs/measured.md.
    """
    camera_m = se3.inverse(T_camera_lidar)[:3, 3].astype(np.float32)
    return Points(xyz_m, lengths(xyz_m - camera_m).astype(np.float32))


def distance_and_depth(xyz_m: NDArray[np.float32], depth: DepthMap, T_camera_lidar: Matrix4) -> Features:
    """The `distances` of the points (N, 3), and the output of the network as it comes."""
    points = distances(xyz_m, T_camera_lidar)
    return Features(points.xyz_m, points.of_points, depth.values)


def build_mutual_information(
    frames: Sequence[Features], rig: Rig, start: Matrix4, box: SearchBox, config: ObjectiveConfig
) -> MutualInformation:
    """Bins the features of a window.

    Bins hold equal shares of the values of their frame. MI then does not depend on a monotonic code, so inverse depth
    as it comes, metric depth and disparity give the same.

    Raises:
        CalibrationError: no point is left between the range limits, or none can come into view.
    """
    shapes = {frame.of_pixels.shape for frame in frames}
    if len(shapes) != 1:
        raise CalibrationError(f"the maps of a window must have one size, found {sorted(shapes)}")
    (shape,) = shapes
    camera = scaled(rig.camera, shape[1] / rig.camera.width, shape[0] / rig.camera.height)
    lit = _mask_at(rig.mask, shape)
    depth_bin = np.stack([_pixel_bins(frame.of_pixels, lit, config.depth_bins) for frame in frames])
    reach = _Reach(half_field_of_view_rad(camera, lit), start, box)
    binned = _binned(frames, camera, depth_bin, reach, config)
    reference = np.max([at.points for at in information_of_each(binned, _poses_of_box(start, box))], axis=0)
    if not reference.any():
        raise CalibrationError(
            "no LiDAR point falls on the image anywhere in the search box: check the direction of T_camera_lidar "
            "(it maps LiDAR to camera coordinates), the mask and the range limits"
        )
    return MutualInformation(binned, reach.half_view_rad, reference)


def _binned(
    points: Sequence[Points],
    camera: Camera,
    depth_bin: NDArray[np.unsignedinteger],
    reach: _Reach,
    config: ObjectiveConfig,
) -> BinnedFrames:
    """The points of each frame that may come into view, over its depth map (h·w + 1,), already binned."""
    visible = [_visible(frame.xyz_m, reach, config) for frame in points]
    visible = [rows[azimuth_order(f.xyz_m[rows])] for f, rows in zip(points, visible, strict=True)]
    first_point = np.concatenate([[0], np.cumsum([len(rows) for rows in visible])]).astype(np.int64)
    if first_point[-1] == 0:
        raise CalibrationError(
            f"no LiDAR point from {config.min_range_m} m to {config.max_range_m} m can come into view from the start"
        )
    xyz_m = np.ascontiguousarray(np.concatenate([f.xyz_m[rows] for f, rows in zip(points, visible, strict=True)]).T)
    shift_m = float(np.linalg.norm(reach.start[:3, 3])) + reach.shift_m
    return BinnedFrames(
        camera=camera,
        xyz_m=xyz_m,
        range_bin=np.concatenate(
            [_point_bins(f.of_points[rows], config.range_bins) for f, rows in zip(points, visible, strict=True)]
        ),
        first_point=first_point,
        depth_bin=depth_bin,
        depth_bins=config.depth_bins,
        range_bins=config.range_bins,
        bundles=bundle(xyz_m, first_point, reach.half_view_rad, shift_m),
    )


def _poses_of_box(start: Matrix4, box: SearchBox) -> NDArray[np.float64]:
    """(n, 4, 4) the start, and the poses turned to the centres of the faces and to the corners of the box."""
    steps = [s for s in product((-1.0, 0.0, 1.0), repeat=3) if sum(map(abs, s)) != 2]
    rotations = [np.array([*step, 0.0, 0.0, 0.0]) * box.rotation_rad for step in steps]
    return np.array([se3.perturb(start, rotation) for rotation in rotations])


class _Reach:
    """Which points can come into view at any pose of the box: those within an angle about the optical axis, widened by
    the box."""

    def __init__(self, half_view_rad: float, start: Matrix4, box: SearchBox) -> None:
        self.start = start
        # The largest angle between two rotations of the box is that of its corner.
        self.half_view_rad = half_view_rad
        self._angle_rad = half_view_rad + math.sqrt(3.0) * box.rotation_rad
        self.shift_m = math.sqrt(3.0) * box.translation_m

    def __call__(self, xyz_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        return within_cone(xyz_m.T, self.start, self._angle_rad, self.shift_m)


def _visible(xyz_m: NDArray[np.float32], reach: _Reach, config: ObjectiveConfig) -> NDArray[np.int64]:
    range_m = lengths(xyz_m)
    visible = (range_m >= config.min_range_m) & (range_m <= config.max_range_m) & reach(xyz_m)
    return np.flatnonzero(visible)


def _point_bins(values: NDArray[np.float32], bins: int) -> NDArray[np.unsignedinteger]:
    """f^P as a bin index."""
    share = np.searchsorted(_equal_shares(values, bins), values, side="right")
    # The narrowest type that holds 0 to `bins`, because the kernel depends on cache.
    narrow: NDArray[np.unsignedinteger] = share.astype(np.uint8 if bins < 256 else np.uint16)
    return narrow


def _pixel_bins(values: NDArray[np.float32], lit: NDArray[np.bool_], bins: int) -> NDArray[np.unsignedinteger]:
    """f^D at every pixel as a bin index, `bins` where there is no value, with the entry for "outside" at the end."""
    usable = lit & np.isfinite(values)
    edges = _equal_shares(values[usable], bins)
    return share_of_pixels(np.ascontiguousarray(values), usable, edges)


def _equal_shares(values: NDArray[np.floating], bins: int) -> NDArray[np.float32]:
    """The bins - 1 inner edges that divide the values into equal shares."""
    if values.size == 0:
        return np.zeros(bins - 1, np.float32)
    sample = np.sort(values[thinned(values.size, QUANTILE_SAMPLES)])
    rank = np.linspace(0.0, sample.size - 1.0, bins + 1)[1:-1]
    return np.interp(rank, np.arange(sample.size), sample).astype(np.float32)


def _mask_at(mask: NDArray[np.bool_] | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The image mask at the resolution of the depth maps, by the image pixel at each cell's centre."""
    if mask is None:
        return np.ones(shape, np.bool_)
    rows = ((np.arange(shape[0]) + 0.5) * mask.shape[0] / shape[0]).astype(np.int64)
    columns = ((np.arange(shape[1]) + 0.5) * mask.shape[1] / shape[1]).astype(np.int64)
    at_centres: NDArray[np.bool_] = mask[np.ix_(rows, columns)]
    return at_centres
