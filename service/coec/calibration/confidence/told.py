"""The assumptions of a window (what it is told beside its frames): where the camera is, when its exposures were, and
through which lens they were taken; and where its range edges would lie in the images if these were otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.objective.edges import in_reach
from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.types import Matrix4, Window
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.geometry.culling import half_field_of_view_rad
from coec.geometry.edges.alignment import EdgeFrames, alignments, alignments_of_late
from coec.geometry.edges.image_edges import VOID
from coec.geometry.projection import project
from coec.geometry.thinning import thinned
from coec.geometry.vectors import lengths

TURNS, SHIFTS, CLOCKS, LENS = range(3), range(3, 6), range(6, 9), range(9, 12)
"""Places in a deviation (12,). Turns and shifts: the perturbation ξ of the pose, rad and m. Clocks, s: by how much the
camera was exposed later than assumed, by how much more at the end of the window than at its beginning, and by how much
more in the last row than in the first. Lens: by how much the principal point lies further right and down, in focal
lengths, and the share by which the focal length is longer."""

LATE, PRINCIPAL_POINT = CLOCKS[:2], LENS[:2]
"""Places that a move of the pose answers almost entirely: on a straight way a late camera looks like one elsewhere on
the way, and a principal point further right looks like a camera that is turned to the left."""

SIZE = 12

REACH = np.array([radians(3.0)] * 3 + [0.4] * 3 + [0.08, 0.08, 0.06] + [0.04, 0.04, 0.05])
"""How far each place may be from what was assumed. The mount: as far as the edges of the coarsest band lead back.
Clocks: most of a frame at 10 Hz, and the readout of the slowest rolling shutters. The lens: beyond what a focus ring or
another unit of the same type does."""

STEP_RAD = 1e-3
"""Difference step, as a share of the range by which a point is shifted: about a pixel or less."""

LEADING_POINTS, SETTLING_POINTS = 4_000, 20_000
"""Most range edges that are used on a level that leads to the next one, and on the sharpest: some four hundred
evaluations of them cost as much as ten of the search's. With half as many, the sharpest level is a third less certain
of a principal point that is four pixels off in a fisheye."""

SEEN = SearchBox(radians(15.0), 4.0)
"""How far from the assumed pose range edges are kept: twice the reach of its turns about three axes at once, and what
passes at 40 m/s within the reach of the clocks. The edge of the coarsest map is known only to some degrees."""

SLOWEST_MPS = 1.0
"""Below this speed a clock that is off by a tenth of a second moves nothing by more than 10 cm, and everything
alike."""


@dataclass(frozen=True, slots=True, eq=False)
class AssumedEdges:
    """The range edges of a window on the image edges of one level, as assumed, and what it takes to move them to where
    they lie under other assumptions.

    Attributes:
        frames: the edges as assumed.
        pose: (4, 4) from which deviations are counted.
        passing: (3, E) how fast standing things pass the LiDAR, m/s, LiDAR frame.
        share: (3, E) the share of each clock's error at each range edge; 0 without ego-motion.
    """

    frames: EdgeFrames
    pose: Matrix4
    passing: NDArray[np.float32]
    share: NDArray[np.float32]

    def otherwise(self, deviation: NDArray[np.float64]) -> tuple[EdgeFrames, Matrix4]:
        """The edges and the pose (4, 4) after a deviation (12,)."""
        frames, later_s = self._through_lens(deviation), deviation[CLOCKS].astype(np.float32)
        if later_s.any():
            late = later_s[0] * self.share[0] + later_s[1] * self.share[1] + later_s[2] * self.share[2]
            frames = replace(frames, xyz_m=frames.xyz_m + self.passing * late)
        return frames, se3.perturb(self.pose, deviation[: SHIFTS.stop])

    def _through_lens(self, deviation: NDArray[np.float64]) -> EdgeFrames:
        frames = self.frames
        if not deviation[LENS].any():
            return frames
        return replace(frames, camera=_through(frames.camera, deviation[LENS]))

    def thinned(self, at_most: int) -> AssumedEdges:
        """The same with at most about this many range edges."""
        indices = thinned(len(self.frames.weight), at_most)
        return replace(
            self, frames=self.frames.of_points(indices), passing=self.passing[:, indices], share=self.share[:, indices]
        )

    def significances(self, deviations: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K,) of the alignment at each of K deviations (K, 12)."""
        values = np.empty(len(deviations))
        for through in _of_one_lens(deviations):
            some = deviations[through]
            poses = np.array([se3.perturb(self.pose, deviation[: SHIFTS.stop]) for deviation in some])
            frames, late_s = self._through_lens(some[0]), some[:, CLOCKS].astype(np.float32)
            if late_s.any():
                at = alignments_of_late(frames, self.passing, self.share, late_s, poses)
            else:
                at = alignments(frames, poses)
            values[through] = [at.at(k).significance for k in range(len(some))]
        return values

    def pixels(self, deviation: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(E, 2) the pixels at which the range edges lie at a deviation (12,), and (E,) whether they have one."""
        frames, T = self.otherwise(deviation)
        p_camera = np.einsum("ij,jn->ni", T[:3, :3], frames.xyz_m.astype(np.float64)) + T[:3, 3]
        return project(frames.camera, p_camera)

    def moved(
        self, deviation: NDArray[np.float64], places: tuple[int, ...]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(n, E, 2) how far each of n places of a deviation moves the range edges, at a deviation (12,), pixels per
        unit; and (E,) for which of the range edges that is known.

        It multiplies how the pixel follows the point, by differences, with how the point follows a place.
        """
        frames, T = self.otherwise(deviation)
        p_camera = np.einsum("ij,jn->ni", T[:3, :3], frames.xyz_m.astype(np.float64)) + T[:3, 3]
        uv_px, seen = project(frames.camera, p_camera)
        height, width = self.frames.maps.shape[1:]
        seen = seen & (uv_px >= 0.0).all(axis=1) & (uv_px <= [width - 1.0, height - 1.0]).all(axis=1)
        # A deviation first turns about the camera as assumed, and then shifts.
        turned_m = p_camera - deviation[SHIFTS]
        step_m = STEP_RAD * lengths(p_camera)
        follows = np.empty((len(uv_px), 2, 3))
        for axis, unit in enumerate(np.eye(3)):
            (ahead, seen_ahead), (behind, seen_behind) = (
                project(frames.camera, p_camera + sign * step_m[:, None] * unit) for sign in (1.0, -1.0)
            )
            follows[:, :, axis] = (ahead - behind) / np.maximum(2.0 * step_m, 1e-9)[:, None]
            seen = seen & seen_ahead & seen_behind
        columns = np.empty((len(places), len(uv_px), 2))
        for column, place in zip(columns, places, strict=True):
            if place in LENS:
                column[:] = _moved_by_lens(self.frames.camera, frames.camera, uv_px, place)
            else:
                column[:] = np.sum(follows * self._moved_by(place, turned_m, T)[:, None, :], axis=2)
        return columns, seen

    def _moved_by(self, place: int, turned_m: NDArray[np.float64], T: Matrix4) -> NDArray[np.float64]:
        """(E, 3) how points move with one place of a deviation, per unit, at a pose (4, 4). `turned_m` (E, 3) are the
        points in the camera frame, turned and not yet shifted."""
        if place in TURNS:
            return np.cross(np.eye(3)[place], turned_m)
        if place in SHIFTS:
            return np.broadcast_to(np.eye(3)[place - SHIFTS.start], turned_m.shape)
        passing_m = (self.passing * self.share[place - CLOCKS.start]).astype(np.float64)
        return np.asarray(np.einsum("ij,jn->ni", T[:3, :3], passing_m))


def _of_one_lens(deviations: NDArray[np.float64]) -> list[list[int]]:
    """For each lens, the indices of those of K deviations (K, 12) that have that lens."""
    places: dict[bytes, list[int]] = {}
    for place, lens in enumerate(deviations[:, LENS]):
        places.setdefault(lens.tobytes(), []).append(place)
    return list(places.values())


def assumed_levels(edges: Sequence[EdgeFrames], window: Window, pose: Matrix4) -> list[AssumedEdges]:
    """The levels of a window at `pose` (4, 4), from `edges` of coarser levels that lead there to the sharpest one.
    Edges that no deviation brings into view are left out."""
    counts = [*([LEADING_POINTS] * (len(edges) - 1)), SETTLING_POINTS]
    half_view_rad = half_field_of_view_rad(edges[0].camera, edges[0].maps[0] != VOID)
    levels = [level.of_points(thinned(len(level.weight), count)) for level, count in zip(edges, counts, strict=True)]
    return [_assumed_edges(in_reach(level, half_view_rad, pose, SEEN), window, pose) for level in levels]


def _assumed_edges(frames: EdgeFrames, window: Window, pose: Matrix4) -> AssumedEdges:
    """The range edges of one level of a window at `pose` (4, 4)."""
    counts, pairs = np.diff(frames.first_point), window.pairs
    frame = np.repeat(np.arange(len(pairs)), counts)
    velocity, turn, moves = np.zeros((len(pairs), 3)), np.zeros((len(pairs), 3)), np.zeros(len(pairs))
    for index, pair in enumerate(pairs):
        if pair.motion is not None:
            turn[index], velocity[index] = sensor_twist(pair.motion, window.rig.T_lidar_ego)
            moves[index] = 1.0
    xyz_m = frames.xyz_m.T.astype(np.float64)
    passing = -(velocity[frame] + np.cross(turn[frame], xyz_m))
    begin_ns, end_ns = pairs[0].stamp_ns, pairs[-1].stamp_ns
    elapsed = np.array([(pair.stamp_ns - begin_ns) / max(end_ns - begin_ns, 1) - 0.5 for pair in pairs])
    assumed = AssumedEdges(frames, pose, passing.T.astype(np.float32, order="C"), np.zeros((3, len(frame)), np.float32))
    uv_px, _ = assumed.pixels(np.zeros(SIZE))
    row = np.clip(uv_px[:, 1] / frames.camera.height - 0.5, -0.5, 0.5)
    share = moves[frame] * np.stack([np.ones(len(frame)), elapsed[frame], row])
    return replace(assumed, share=share.astype(np.float32))


def moves(window: Window) -> bool:
    """Whether the vehicle moves enough for the error of a clock to show."""
    return any(pair.motion is not None and pair.motion.reaches(SLOWEST_MPS) for pair in window.pairs)


def _moved_by_lens(assumed: Camera, camera: Camera, uv_px: NDArray[np.float64], place: int) -> NDArray[np.float64]:
    """(E, 2) how pixels (E, 2) of a camera move with one place of the lens, in units of the lens `told`."""
    moved = np.zeros_like(uv_px)
    if place == LENS.start:
        moved[:, 0] = assumed.fx
    elif place == LENS.start + 1:
        moved[:, 1] = assumed.fy
    else:
        moved[:, 0] = (uv_px[:, 0] - camera.cx) * assumed.fx / camera.fx
        moved[:, 1] = (uv_px[:, 1] - camera.cy) * assumed.fy / camera.fy
    return moved


def _through(camera: Camera, lens: NDArray[np.float64]) -> Camera:
    right, down, longer = lens.tolist()
    return camera._replace(
        cx=camera.cx + right * camera.fx,
        cy=camera.cy + down * camera.fy,
        fx=camera.fx * (1.0 + longer),
        fy=camera.fy * (1.0 + longer),
    )
