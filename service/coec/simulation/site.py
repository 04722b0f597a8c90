"""A stretch of road as a building site: meshes are put at places along it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.simulation.mesh import Floats, Mesh
from coec.simulation.passages import RoadSpan
from coec.simulation.road import Road

Doubles = NDArray[np.float64]


class Site:
    """Gathers the meshes of a stretch at places along the road. `left_m` counts from the centre line.

    Attributes:
        origin_m: (3,) world position that is the origin of the meshes.
        meshes: what was put there so far.
    """

    def __init__(self, road: Road, begin_m: float, empty: tuple[RoadSpan, ...] = ()) -> None:
        """`empty`: spans of the road on which nothing is put."""
        self.road = road
        self.begin_m = begin_m
        self.origin_m = road.points(begin_m, 0.0, 0.0)
        self.meshes: list[Mesh] = []
        self._empty = empty

    def put(self, mesh: Mesh, s_m: float, left_m: float, turn_rad: float = 0.0, up_m: float = 0.0) -> None:
        """Puts a mesh at arc length `begin_m + s_m`, its x along the road before it is turned. Does nothing where the
        site has to stay empty."""
        if any(span.holds(self.begin_m + s_m) for span in self._empty):
            return
        x, y, z = self.road.points(self.begin_m + s_m, left_m, up_m) - self.origin_m
        heading = float(self.road.at(self.begin_m + s_m)[3])
        self.meshes.append(mesh.placed(float(x), float(y), float(z), heading + turn_rad))

    def strip(self, s_m: Doubles, left_m: tuple[float, float], up_m: tuple[float, float]) -> Floats:
        """(Q, 4, 3) quads that follow the road between the given arc lengths, counted from `begin_m`."""
        a = self.road.points(self.begin_m + s_m, left_m[0], up_m[0]) - self.origin_m
        b = self.road.points(self.begin_m + s_m, left_m[1], up_m[1]) - self.origin_m
        return np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1).astype(np.float32)
