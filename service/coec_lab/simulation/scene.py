"""The town of a seed and the part of it around the vehicle, against which rays are cast by Embree."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray

from coec.geometry.compiler import njit
from coec_lab.simulation.mesh import Floats, Mesh, join
from coec_lab.simulation.passages import Bore, Passages
from coec_lab.simulation.reflectance import infrared
from coec_lab.simulation.road import MODELS, Mover, Progress, Road, build_road
from coec_lab.simulation.street import NO_PASSAGES, STRETCH_M, Stretch, backdrop
from coec_lab.simulation.surroundings import Street, Surroundings
from coec_lab.simulation.weather import Sky, sample_sky

Doubles = NDArray[np.float64]

BEHIND, AHEAD = 3, 4
"""Stretches kept behind and ahead of the one that the vehicle is in: at least 144 m each way."""
RAYS_AT_ONCE = 1 << 18
"""Rays per call of Embree, which bounds the memory for an image of any size."""
MISSED = -1
NO_LAMPS = np.empty((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """The first surfaces that rays hit.

    Attributes:
        range_m: (N,) float32, inf for the sky.
        triangle: (N,) int32 index into the scene's `colour` and `material`, `MISSED` for the sky.
        normal: (N, 3) float32 unit normal, towards the origin of the ray; 0 for the sky.
    """

    range_m: Floats
    triangle: NDArray[np.int32]
    normal: Floats


class Solid:
    """A mesh that Embree has indexed."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.radius_m = float(np.sqrt((mesh.corners_m.astype(np.float64) ** 2).sum(axis=-1)).max())
        self._scene = EmbreeScene()
        self._geometry = TriangleMesh(self._scene, np.ascontiguousarray(mesh.corners_m))

    def cast(self, origins_m: Floats, directions: Floats, reach_m: float) -> Hits:
        """First hits of rays; origins and directions are in the frame of the mesh."""
        count = len(directions)
        range_m = np.empty(count, np.float32)
        triangle = np.empty(count, np.int32)
        normal = np.empty((count, 3), np.float32)
        for low in range(0, count, RAYS_AT_ONCE):
            part = slice(low, low + RAYS_AT_ONCE)
            embree_hits = self._scene.run(origins_m[part], directions[part], query="INTERSECT", output=1)
            _take(embree_hits["tfar"], embree_hits["primID"], embree_hits["Ng"], directions[part], float(reach_m),
                  range_m[part], triangle[part], normal[part])  # fmt: skip
        return Hits(range_m, triangle, normal)

    def blocked(self, origins_m: Floats, directions: Floats) -> NDArray[np.bool_]:
        """(N,): whether the mesh blocks each ray."""
        result = np.empty(len(directions), bool)
        for low in range(0, len(directions), RAYS_AT_ONCE):
            part = slice(low, low + RAYS_AT_ONCE)
            result[part] = self._scene.run(origins_m[part], directions[part], query="OCCLUDED") != MISSED
        return result


class Scene:
    """The street around one place, at any time.

    Attributes:
        origin_m: (3,) world position that is the origin of its meshes.
        street: everything that stands still, without the models of cars.
        colour, material, infrared: (T, 3) float32, (T,) int8 and (T,) float32 (see `reflectance.infrared`) of all
            triangles: the street, then each model of car.
        sky: light and weather.
        movers: moving cars near the place, at the instant for which the scene was requested.
        headlights: (L, 4, 3) of the vehicle, see `shading.headlights`; none by day.
        lamps_m: (K, 3) street lamps, world; they shine when the headlights do.
        bores: the tunnels of the road.
    """

    def __init__(
        self, road: Road, sky: Sky, origin_m: Doubles, street: Mesh, models: list[Solid], bores: tuple[Bore, ...] = (),
        lamps_m: Doubles = NO_LAMPS,
    ) -> None:  # fmt: skip
        self.road = road
        self.sky = sky
        self.origin_m = origin_m
        self.movers: tuple[Mover, ...] = ()
        self.headlights: Doubles = np.empty((0, 4, 3))
        self.bores = bores
        self.lamps_m = lamps_m
        self.street = street
        self._solid = Solid(street)
        self._models = models
        self._first = np.cumsum([len(street.colour)] + [len(model.mesh.colour) for model in models])
        self.colour = np.concatenate([street.colour, *(model.mesh.colour for model in models)])
        self.material = np.concatenate([street.material, *(model.mesh.material for model in models)])
        self.infrared = infrared(self.colour, self.material)

    def cast(self, origins_m: Doubles, directions: Floats, time_s: ArrayLike, reach_m: float = 400.0) -> Hits:
        """The first surface along each ray.

        Args:
            origins_m: (N, 3) world positions, or (3,).
            directions: (N, 3) unit, world axes.
            time_s: when each ray is cast, (N,) or one.
        """
        local = np.empty(directions.shape, np.float32)
        local[:] = np.asarray(origins_m, np.float64) - self.origin_m
        hits = self._solid.cast(local, directions, reach_m)
        for mover in self.movers:
            self._cast_mover(mover, local, directions, np.asarray(time_s, np.float64), hits)
        return hits

    def shadowed(self, points_m: Floats, time_s: float) -> NDArray[np.bool_]:
        """(N,): whether something keeps the sun from points (N, 3), relative to `origin_m`."""
        sun = np.empty_like(points_m)
        sun[:] = self.sky.towards_sun
        dark = self._solid.blocked(points_m, sun)
        time = np.array([time_s])
        for mover in self.movers:
            model = self._models[mover.model]
            x, y, z, heading = mover.poses(self.road, time)[0]
            centre = np.array([x, y, z]) - self.origin_m
            rays = np.flatnonzero(_near(points_m, sun, centre, model.radius_m) & ~dark)
            if len(rays):
                turn = np.array([-heading])
                start = _turned(points_m[rays] - centre, np.broadcast_to(turn, len(rays)))
                way = _turned(sun[rays].astype(np.float64), np.broadcast_to(turn, len(rays)))
                dark[rays] = model.blocked(start, way)
        return dark

    def _cast_mover(self, mover: Mover, local: Floats, directions: Floats, time_s: Doubles, hits: Hits) -> None:
        """Replaces hits where a moving car is nearer. Each ray meets the car where it is at the ray's time."""
        model = self._models[mover.model]
        ends = mover.poses(self.road, np.array([time_s.min(), time_s.max()]))[:, :3] - self.origin_m
        margin = float(np.linalg.norm(ends[1] - ends[0])) / 2
        near = _near(local, directions, ends.mean(axis=0), model.radius_m + margin)
        rays = np.flatnonzero(near)
        if not len(rays):
            return
        times = time_s[rays] if time_s.ndim else time_s[None]
        poses = np.broadcast_to(mover.poses(self.road, times), (len(rays), 4))
        start = _turned(local[rays] - (poses[:, :3] - self.origin_m), -poses[:, 3])
        way = _turned(directions[rays].astype(np.float64), -poses[:, 3])
        mover_hits = model.cast(start, way, float(np.inf))
        nearer = mover_hits.range_m < hits.range_m[rays]
        nearer_rays = rays[nearer]
        hits.range_m[nearer_rays] = mover_hits.range_m[nearer]
        hits.triangle[nearer_rays] = mover_hits.triangle[nearer] + np.int32(self._first[mover.model])
        hits.normal[nearer_rays] = _turned(mover_hits.normal[nearer].astype(np.float64), poses[nearer, 3])


class Town:
    """The surroundings of one road. Builds what is around a place, and keeps only that."""

    def __init__(
        self,
        seed: int,
        length_m: float = 1000.0,
        passages: Passages = NO_PASSAGES,
        surroundings: Surroundings | None = None,
        *,
        traffic: bool = True,
    ) -> None:
        """A street, unless other surroundings are given; `traffic` says whether anything moves there."""
        self.seed = seed
        self.surroundings: Surroundings = Street(seed) if surroundings is None else surroundings
        self.sky: Sky = sample_sky(seed)
        margin = STRETCH_M * (BEHIND + AHEAD + 2) + 300.0
        self.road = build_road(seed, -margin, length_m + margin, self.surroundings.calmer)
        self._passages = passages
        self._traffic = traffic
        # Almost as far as the road reaches, so that the end of a ceiling is never in sight.
        self._bores = self.surroundings.bores(self.road, -margin + 1.0, length_m + margin - 1.0, passages)
        rng = np.random.default_rng([seed, 103])
        self._models = [Solid(self.surroundings.sample_model(rng)) for _ in range(MODELS)]
        self._stretches: dict[int, Stretch] = {}
        self._scene: tuple[int, Scene] | None = None

    @property
    def stretch_count(self) -> int:
        """How many stretches are in memory."""
        return len(self._stretches)

    def lane_left_m(self) -> float:
        """How far left of the centre line the vehicle drives; negative in the right lane."""
        return self.surroundings.left_m

    def scene(self, at_m: float, time_s: float = 0.0, progress: Progress | None = None) -> Scene:
        """The street around arc length `at_m`, with traffic at `time_s`.

        progress: of the vehicle, from which cars in its lane keep their distance; None: 8 m/s from `at_m`.
        """
        place = int(np.floor(at_m / STRETCH_M))
        if self._scene is None or self._scene[0] != place:
            self._scene = (place, self._build(place))
        scene = self._scene[1]
        own = progress if progress is not None else _steady(at_m, time_s)
        movers = self.surroundings.movers(at_m, time_s, own) if self._traffic else ()
        scene.movers = tuple(mover for mover in movers if not self._on_cleared(mover, time_s))
        return scene

    def _build(self, place: int) -> Scene:
        indices = range(place - BEHIND, place + AHEAD + 1)
        # In the order of the road, wherever the vehicle comes from, because the order of triangles changes the bytes.
        stretches = {
            index: self._stretches.get(index) or self.surroundings.build(index, self.road, self._passages)
            for index in indices
        }
        self._stretches = stretches
        origin = self.road.points(place * STRETCH_M, 0.0, 0.0)
        parts = []
        for stretch in stretches.values():
            shift = (stretch.origin_m - origin).astype(np.float32)
            parts.append(Mesh(stretch.mesh.corners_m + shift, stretch.mesh.colour, stretch.mesh.material))
        lowest = min(float(mesh.corners_m[:, :, 2].min()) for mesh in parts)
        street = join([*parts, backdrop().placed(0, 0, min(lowest, 0.0), 0)])
        lamps_m = np.concatenate([stretch.lamps_m + stretch.origin_m for stretch in stretches.values()])
        return Scene(self.road, self.sky, origin, street, self._models, self._bores, lamps_m)

    def _on_cleared(self, mover: Mover, time_s: float) -> bool:
        place_m = float(mover.progress(np.array([time_s]))[0])
        return any(span.holds(place_m) for span in self._passages.cleared())


def _steady(at_m: float, since_s: float) -> Progress:
    return lambda time_s: at_m + 8.0 * (time_s - since_s)


def _turned(vectors: NDArray[np.floating], angle_rad: Doubles) -> Floats:
    """Vectors (N, 3) turned about the vertical by angles (N,)."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, vectors[:, 2]]).astype(np.float32)


@njit(cache=True, nogil=True)
def _take(
    tfar: Floats,
    triangle: NDArray[np.int32],
    raw: Floats,
    directions: Floats,
    reach_m: float,
    out_range: Floats,
    out_triangle: NDArray[np.int32],
    out_normal: Floats,
) -> None:
    """Turns Embree's answers into those of `Hits`."""
    for i in range(len(tfar)):
        if triangle[i] < 0 or not tfar[i] <= reach_m:
            out_range[i] = np.inf
            out_triangle[i] = -1
            out_normal[i, 0] = out_normal[i, 1] = out_normal[i, 2] = 0.0
            continue
        x, y, z = float(raw[i, 0]), float(raw[i, 1]), float(raw[i, 2])
        length = np.sqrt(x * x + y * y + z * z)
        if x * directions[i, 0] + y * directions[i, 1] + z * directions[i, 2] > 0.0:
            length = -length
        out_range[i] = tfar[i]
        out_triangle[i] = triangle[i]
        out_normal[i, 0] = x / length
        out_normal[i, 1] = y / length
        out_normal[i, 2] = z / length


@njit(cache=True, nogil=True)
def _near(origins: Floats, directions: Floats, centre: Doubles, radius_m: float) -> NDArray[np.bool_]:
    """(N,): whether each ray passes through a sphere."""
    result = np.empty(len(directions), np.bool_)
    for i in range(len(directions)):
        x = centre[0] - origins[i, 0]
        y = centre[1] - origins[i, 1]
        z = centre[2] - origins[i, 2]
        along = x * directions[i, 0] + y * directions[i, 1] + z * directions[i, 2]
        distance2 = x * x + y * y + z * z - along * along
        result[i] = along > -radius_m and distance2 < radius_m * radius_m
    return result
