"""The parameters of a window beside its pose, and how they displace its range edges: clocks and lens.

A deviation (13,) counts from what was assumed: pose, clocks, lens. Most of it looks nearly like a turn of the camera: a
principal point further right like a camera turned to the left, a late clock like a place elsewhere on the way. Only
what the turn does not explain shows the parameter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.objective.edges import in_reach
from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.types import Matrix4, Window
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.geometry.edges.alignment import EdgeFrames
from coec.geometry.edges.displaced_alignment import DisplacedEdges
from coec.geometry.edges.image_edges import VOID
from coec.geometry.points import lengths, thinned
from coec.geometry.projection import half_field_of_view_rad, project

TURNS, SHIFTS, CLOCKS, LENS = range(3), range(3, 6), range(6, 9), range(9, 13)
"""Places in a deviation (13,). Turns and shifts: the perturbation ξ of the pose, rad and m. Clocks, s: by how much the
camera was exposed later than assumed, by how much more at the end of the window than at its beginning, and by how much
more in the last row than in the first. Lens: by how much the principal point lies further right and down, in focal
lengths; the share by which the focal length is longer; and the share by which a corner of the image lies further out
(first radial term)."""

SIZE = 13

STEP_RAD = 1e-3
"""Difference step, as a share of the range by which a point is shifted: about a pixel or less."""

LEADING_POINTS, SETTLING_POINTS = 4_000, 20_000
"""Most range edges that are used on a level that leads to the next one, and on the sharpest."""

SEEN = SearchBox(radians(15.0), 4.0)
"""How far from the assumed pose range edges are kept: what a wrong lens turns the camera by, and what passes at 40 m/s
while a clock is late. The edge of the coarsest map is known only to some degrees."""

SLOWEST_MPS = 1.0
"""Below this speed a clock that is off by a tenth of a second moves nothing by more than 10 cm, and everything
alike."""

MARGIN = 0.25
"""Range edges are followed this share of an image beyond its border. Beside the camera they move by any number of
pixels for a small turn."""

OUT_OF_VIEW_PX = -1e6


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

    def at(self, deviation: NDArray[np.float64], places: Sequence[int]) -> DisplacedEdges:
        """The edges as a linear function of some places of a deviation (13,), about that deviation."""
        camera, T = self._camera(deviation), se3.perturb(self.pose, deviation[: SHIFTS.stop])
        xyz_m = self.frames.xyz_m.T.astype(np.float64) + np.einsum(
            "k,ke,ie->ei", deviation[CLOCKS], self.share, self.passing
        )
        p_camera = np.einsum("ij,nj->ni", T[:3, :3], xyz_m) + T[:3, 3]
        uv_px, seen = project(camera, p_camera)
        # A deviation first turns about the camera as assumed, and then shifts.
        turned_m, step_m = p_camera - deviation[SHIFTS], STEP_RAD * lengths(p_camera)
        follows = np.empty((len(uv_px), 2, 3))
        for axis, unit in enumerate(np.eye(3)):
            (ahead, seen_ahead), (behind, seen_behind) = (
                project(camera, p_camera + sign * step_m[:, None] * unit) for sign in (1.0, -1.0)
            )
            follows[:, :, axis] = (ahead - behind) / np.maximum(2.0 * step_m, 1e-9)[:, None]
            seen = seen & seen_ahead & seen_behind
        from_centre = uv_px - [camera.cx, camera.cy]
        outward = np.sum(from_centre * from_centre, axis=1, keepdims=True) / (
            0.25 * (camera.width**2 + camera.height**2)
        )
        jacobian = np.zeros((len(uv_px), 2, len(places)), np.float32)
        for column, place in enumerate(places):
            if place in LENS:
                jacobian[:, :, column] = _moved_by_lens(self.frames.camera, camera, from_centre, outward, place)
            else:
                by_m = self._moved_by(place, turned_m, T)
                jacobian[:, :, column] = np.sum(follows * by_m[:, None, :], axis=2)
        height, width = self.frames.maps.shape[1:]
        size = np.array([width, height], np.float64)
        seen = seen & (uv_px >= -MARGIN * size).all(axis=1) & (uv_px <= (1.0 + MARGIN) * size).all(axis=1)
        displaced = uv_px + deviation[LENS[3]] * outward * from_centre
        jacobian[~seen], displaced[~seen] = 0.0, OUT_OF_VIEW_PX
        return DisplacedEdges(
            displaced.astype(np.float32), jacobian, self.frames.weight, self.frames.first_point, self.frames.maps
        )

    def _camera(self, deviation: NDArray[np.float64]) -> Camera:
        camera, (right, down, longer, _) = self.frames.camera, deviation[LENS].tolist()
        return camera._replace(
            cx=camera.cx + right * camera.fx,
            cy=camera.cy + down * camera.fy,
            fx=camera.fx * (1.0 + longer),
            fy=camera.fy * (1.0 + longer),
        )

    def _moved_by(self, place: int, turned_m: NDArray[np.float64], T: Matrix4) -> NDArray[np.float64]:
        """(E, 3) how points move with one place of a deviation, per unit, at a pose (4, 4). `turned_m` (E, 3) are the
        points in the camera frame, turned and not yet shifted."""
        if place in TURNS:
            return np.cross(np.eye(3)[place], turned_m)
        if place in SHIFTS:
            return np.broadcast_to(np.eye(3)[place - SHIFTS.start], turned_m.shape)
        passing_m = (self.passing * self.share[place - CLOCKS.start]).astype(np.float64)
        return np.asarray(np.einsum("ij,jn->ni", T[:3, :3], passing_m))


def _moved_by_lens(
    assumed: Camera, camera: Camera, from_centre: NDArray[np.float64], outward: NDArray[np.float64], place: int
) -> NDArray[np.float64]:
    """(E, 2) how pixels of a camera move with one place of the lens, in units of the deviation."""
    if place == LENS[0]:
        return np.broadcast_to([assumed.fx, 0.0], from_centre.shape)
    if place == LENS[1]:
        return np.broadcast_to([0.0, assumed.fy], from_centre.shape)
    if place == LENS[2]:
        return from_centre * [assumed.fx / camera.fx, assumed.fy / camera.fy]
    return outward * from_centre


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
    p_camera = np.einsum("ij,nj->ni", pose[:3, :3], xyz_m) + pose[:3, 3]
    row = np.clip(project(frames.camera, p_camera)[0][:, 1] / frames.camera.height - 0.5, -0.5, 0.5)
    share = moves[frame] * np.stack([np.ones(len(frame)), elapsed[frame], row])
    return AssumedEdges(frames, pose, passing.T.astype(np.float32, order="C"), share.astype(np.float32))


def moves(window: Window) -> bool:
    """Whether the vehicle moves enough for the error of a clock to show."""
    return any(pair.motion is not None and pair.motion.reaches(SLOWEST_MPS) for pair in window.pairs)
