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
from coec.geometry.edges.displaced_alignment import DisplacedEdges, linearised
from coec.geometry.edges.image_edges import VOID
from coec.geometry.points import thinned
from coec.geometry.projection import half_field_of_view_rad, project

TURNS, SHIFTS, CLOCKS, LENS = range(3), range(3, 6), range(6, 9), range(9, 13)
"""Places in a deviation (13,). Turns and shifts: the perturbation ξ of the pose, rad and m. Clocks, s: by how much the
camera was exposed later than assumed, by how much more at the end of the window than at its beginning, and by how much
more in the last row than in the first. Lens: by how much the principal point lies further right and down, in focal
lengths; the share by which the focal length is longer; and the share by which a corner of the image lies further out
(first radial term)."""

SIZE = 13

LEADING_POINTS, SETTLING_POINTS = 2_500, 30_000
"""Most edges, of those that may come into view, that are used on a level that leads to the next one, and on the
sharpest. See docs/measured.md."""

SEEN = SearchBox(radians(15.0), 4.0)
"""How far from the assumed pose range edges are kept: what a wrong lens turns the camera by, and what passes at 40 m/s
while a clock is late. The edge of the coarsest map is known only to some degrees."""

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
        frame: (E,) int32 the frame of each.
    """

    frames: EdgeFrames
    pose: Matrix4
    passing: NDArray[np.float32]
    share: NDArray[np.float32]
    frame: NDArray[np.int32]

    def at(self, deviation: NDArray[np.float64], places: Sequence[int]) -> DisplacedEdges:
        """The edges as a linear function of some places of a deviation (13,), about that deviation."""
        camera, pose = self._camera(deviation), se3.perturb(self.pose, deviation[: SHIFTS.stop])
        uv_px, jacobian = linearised(
            camera,
            self.frames.camera,
            pose,
            deviation[SHIFTS],
            self.frames.xyz_m,
            self.passing,
            self.share,
            deviation[CLOCKS],
            float(deviation[LENS[3]]),
            tuple(places),
        )
        return DisplacedEdges(uv_px, jacobian, self.frames.weight, self.frame, self.frames.maps)

    def _camera(self, deviation: NDArray[np.float64]) -> Camera:
        camera, (right, down, longer, _) = self.frames.camera, deviation[LENS].tolist()
        return camera._replace(
            cx=camera.cx + right * camera.fx,
            cy=camera.cy + down * camera.fy,
            fx=camera.fx * (1.0 + longer),
            fy=camera.fy * (1.0 + longer),
        )


def assumed_levels(edges: Sequence[EdgeFrames], window: Window, pose: Matrix4) -> list[AssumedEdges]:
    """The levels of a window at `pose` (4, 4), from `edges` of coarser levels that lead there to the sharpest one.
    Edges that no deviation brings into view are left out."""
    counts = [*([LEADING_POINTS] * (len(edges) - 1)), SETTLING_POINTS]
    half_view_rad = half_field_of_view_rad(edges[0].camera, edges[0].maps[0] != VOID)
    seen = [in_reach(level, half_view_rad, pose, SEEN) for level in edges]
    some = [level.of_points(thinned(len(level.weight), count)) for level, count in zip(seen, counts, strict=True)]
    return [_assumed_edges(level, window, pose) for level in some]


def _assumed_edges(frames: EdgeFrames, window: Window, pose: Matrix4) -> AssumedEdges:
    """The range edges of one level of a window at `pose` (4, 4)."""
    counts, pairs = np.diff(frames.first_point), window.pairs
    frame = np.repeat(np.arange(len(pairs), dtype=np.int32), counts)
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
    return AssumedEdges(frames, pose, passing.T.astype(np.float32, order="C"), share.astype(np.float32), frame)


def moves(window: Window) -> bool:
    """Whether the vehicle moves enough for the error of a clock to show."""
    return any(pair.motion is not None and pair.motion.reaches(SLOWEST_MPS) for pair in window.pairs)
