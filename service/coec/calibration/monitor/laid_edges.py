"""The edges of a check: range edges of some sweeps, laid onto the edge maps of the images of one camera.

Both are prepared for each sensor by itself (`sensors`). All that is left for each pair is to place some thousand points
at the instants of its exposures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.monitor.sensors import MapLevel, PreparedImages, PreparedSweep
from coec.calibration.objective.cells import COLUMNS, ROWS, Cells, PointsInView, sectors
from coec.calibration.types import FramePair, Matrix4, Rig
from coec.geometry.cameras import in_image
from coec.geometry.edges.alignment import LEAST_SQUARE, EdgeFrames, alignment_of_parts
from coec.geometry.projection import project

CELL_STEP = 0.25
"""Difference step of the cells, in blurs of the finest band: half a pixel of the sharpest map."""


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedLevel:
    """Range edges on the maps of one level, and the blur of these maps, an angle about the optical axis."""

    frames: EdgeFrames
    blur_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedEdges:
    """The range edges that can come into view, on maps of several levels: the same points in the same order on each.

    Attributes:
        sharp: on the sharpest edges, which settle a pose.
        whole: on blurred edges that keep the layout of the scene.
        bands: from fine to coarse; at least two.
        measured: the pairs, their sweeps reduced to these range edges, before motion compensation.
    """

    sharp: ProjectedLevel
    whole: ProjectedLevel
    bands: tuple[ProjectedLevel, ...]
    measured: tuple[FramePair, ...]

    @property
    def frame(self) -> NDArray[np.int64]:
        """(E,) the frame of each range edge."""
        first = self.sharp.frames.first_point
        return np.repeat(np.arange(len(first) - 1), np.diff(first))

    def of(self, indices: Sequence[int]) -> ProjectedEdges:
        """The edges of some of the pairs alone, by their indices."""
        return ProjectedEdges(
            _level_of(self.sharp, indices),
            _level_of(self.whole, indices),
            tuple(_level_of(band, indices) for band in self.bands),
            tuple(self.measured[i] for i in indices),
        )

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
            of_sectors = alignment_of_parts(frames, sector, COLUMNS * ROWS, poses)
            squares = np.array([float(square.sum()) for square in of_sectors.square])
            scales = len(frames.maps) / np.sqrt(np.maximum(squares, LEAST_SQUARE))
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
) -> ProjectedEdges:
    """Lays the range edges that come within the prepared part of the images at a pose (4, 4), or within `reach_rad` of
    it.

    Args:
        sweeps: those of the pairs, in order.
        images: those of the pairs, in order.
        compensated: whether the sweeps are to be motion-compensated.
    """
    margin_px = reach_rad / images.sharp.blur_rad * _PIXELS_PER_BLUR
    measured, points_m, weights = [], [], []
    for pair, sweep in zip(pairs, sweeps, strict=True):
        of_edges = replace(pair, lidar=sweep.edges)
        xyz_m = compensate(of_edges, rig, enabled=compensated)
        near = np.flatnonzero(_may_be_seen(images.sharp, xyz_m, pose, margin_px))
        offsets_s = None if sweep.edges.time_offset_s is None else sweep.edges.time_offset_s[near]
        of_near = replace(sweep.edges, xyz_m=sweep.edges.xyz_m[near], time_offset_s=offsets_s)
        measured.append(replace(pair, lidar=of_near))
        points_m.append(xyz_m[near])
        weights.append(sweep.weight[near])
    first_point = np.concatenate([[0], np.cumsum([len(weight) for weight in weights])]).astype(np.int64)
    xyz_m, weight = np.ascontiguousarray(np.concatenate(points_m).T), np.concatenate(weights)

    def projected(level: MapLevel) -> ProjectedLevel:
        return ProjectedLevel(EdgeFrames(level.camera, xyz_m, weight, first_point, level.maps), level.blur_rad)

    bands = tuple(projected(band) for band in images.bands)
    return ProjectedEdges(projected(images.sharp), projected(images.whole), bands, tuple(measured))


_PIXELS_PER_BLUR = 2.0
"""Pixels per blur of the finest band, see `BLUR_SIGMA_PX`."""


def placed(frames: EdgeFrames, T_camera_lidar: Matrix4) -> NDArray[np.float64]:
    """(E, 3) the range edges in the frame of the camera at a pose (4, 4)."""
    xyz_m = frames.xyz_m.astype(np.float64)
    return np.asarray(xyz_m.T @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])


def _may_be_seen(level: MapLevel, xyz_m: NDArray[np.float32], pose: Matrix4, margin_px: float) -> NDArray[np.bool_]:
    uv_px, valid = project(level.camera, xyz_m.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])
    (u, v), camera = uv_px.T, level.camera
    across = (u >= -margin_px) & (u < camera.width + margin_px)
    return np.asarray(valid & across & (v >= -margin_px) & (v < camera.height + margin_px))


def _level_of(level: ProjectedLevel, indices: Sequence[int]) -> ProjectedLevel:
    frames = level.frames
    first = frames.first_point
    rows = np.concatenate([np.arange(first[i], first[i + 1]) for i in indices])
    counts = [first[i + 1] - first[i] for i in indices]
    of_some = replace(
        frames,
        xyz_m=np.ascontiguousarray(frames.xyz_m[:, rows]),
        weight=frames.weight[rows],
        first_point=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        maps=np.ascontiguousarray(frames.maps[list(indices)]),
    )
    return replace(level, frames=of_some)
