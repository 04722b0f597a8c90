"""LiDARs: patterns of their beams, and sweeps by ray casting with the width of a beam, noise, lost echoes and rain.
What is detected follows `REFLECTANCE` alone, so that the ranges of a drive do not depend on the kind of its intensity.

LiDAR axes: x forward, y left, z up. The stamp of a sweep is its middle.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from coec_lab.simulation import reflectance
from coec_lab.simulation.mesh import Floats, Material
from coec_lab.simulation.reflectance import INTENSITIES, IntensityModel, Surfaces
from coec_lab.simulation.scene import Hits, Scene
from coec_lab.simulation.weather import CLEAR, DROP_M, DROP_REFLECTANCE, Air

Doubles = NDArray[np.float64]


PRISM_HZ = (121.57, -77.73)
"""Turns of the two prisms, 7294 and -4664 a minute, as in the first Livox sensors. Their ratio is not one of small
whole numbers, so that no sweep repeats the last one."""
PRISM_RAD = 0.307
"""How far one prism bends the beam: 17.6°; both together fill a circle of 70.4°."""


class Fired(NamedTuple):
    """The rays of a sweep.

    Attributes:
        rays: (columns, beams, 3) unit.
        offset_s: (columns,) when each column is fired, relative to the stamp.
    """

    rays: Doubles
    offset_s: Doubles


class Pattern(Protocol):
    """The rays of a kind of sensor."""

    @property
    def beams(self) -> int:
        """How many beams are fired at once."""
        ...

    @property
    def ringed(self) -> bool:
        """Whether the cloud tells the beam of each point."""
        ...

    def fired(self, time_s: float, period_s: float) -> Fired:
        """The sweep whose middle is at a time."""
        ...


@dataclass(frozen=True, slots=True)
class Turn:
    """A head that turns clockwise from the rear, so that it looks forward in the middle of its turn. Beams are numbered
    from the lowest up."""

    elevations_rad: tuple[float, ...]
    columns: int

    ringed = True

    @property
    def beams(self) -> int:
        """See `Pattern`."""
        return len(self.elevations_rad)

    def fired(self, time_s: float, period_s: float) -> Fired:  # noqa: ARG002 - the same at any time
        """See `Pattern`."""
        return _columns(2 * np.pi, self.columns, self.elevations_rad, period_s)


@dataclass(frozen=True, slots=True)
class Raster:
    """A mirror that sweeps a fan of beams (numbered from the lowest up) from left to right, once per sweep."""

    width_rad: float
    elevations_rad: tuple[float, ...]
    columns: int

    ringed = False

    @property
    def beams(self) -> int:
        """See `Pattern`."""
        return len(self.elevations_rad)

    def fired(self, time_s: float, period_s: float) -> Fired:  # noqa: ARG002 - the same at any time
        """See `Pattern`."""
        return _columns(self.width_rad, self.columns, self.elevations_rad, period_s)


@dataclass(frozen=True, slots=True)
class Rosette:
    """Two prisms that turn in opposite directions bend a row of beams into loops that fill a circle over time.

    Attributes:
        columns: firings in a sweep.
        beams: number in the upright row.
        spacing_rad: angle between neighbouring beams.
    """

    columns: int = 4000
    beams: int = 6
    spacing_rad: float = 0.005

    ringed = False

    def fired(self, time_s: float, period_s: float) -> Fired:
        """See `Pattern`."""
        offset_s = period_s * ((np.arange(self.columns) + 0.5) / self.columns - 0.5)
        first, second = (2 * np.pi * hertz * (time_s + offset_s) for hertz in PRISM_HZ)
        left = PRISM_RAD * (np.cos(first) + np.cos(second))
        up = PRISM_RAD * (np.sin(first) + np.sin(second))
        row = self.spacing_rad * (np.arange(self.beams) - (self.beams - 1) / 2)
        left, up = np.broadcast_arrays(left[:, None], up[:, None] + row)
        away = np.hypot(left, up)
        share = np.sinc(away / np.pi)  # sin(x)/x: from the angle to the unit vector
        return Fired(np.stack([np.cos(away), left * share, up * share], axis=-1), offset_s)


def even_deg(low_deg: float, high_deg: float, beams: int) -> tuple[float, ...]:
    """Evenly spaced elevations, given in degrees, returned in radians."""
    return tuple(float(angle) for angle in np.deg2rad(np.linspace(low_deg, high_deg, beams)))


def _columns(width_rad: float, columns: int, elevations_rad: tuple[float, ...], period_s: float) -> Fired:
    """A sweep of upright fans from left to right over a width."""
    azimuth = width_rad / 2 - width_rad * (np.arange(columns) + 0.5) / columns
    up = np.asarray(elevations_rad)
    rays = np.stack(
        [
            np.outer(np.cos(azimuth), np.cos(up)),
            np.outer(np.sin(azimuth), np.cos(up)),
            np.broadcast_to(np.sin(up), (columns, len(up))),
        ],
        axis=-1,
    )
    return Fired(rays, -period_s * azimuth / width_rad)


WEAKEST = 4.0e-6
"""Returns below this (reflectance · cosine / range², 1/m²) are not detected: a reflectance of 0.05 at 110 m
or of 0.1 at 158 m, head on."""
CLUSTER_M = 0.35
"""Length of the pulse: echoes nearer to each other than this come back as one, at their mean range."""
SPREAD: tuple[tuple[float, float], ...] = ((1.0, 0.0), (-0.5, 0.866), (-0.5, -0.866))
"""Directions of the outer rays of a beam, in units of its half angle."""
JUMP = 0.03
"""A beam is treated as a cone where the ranges of its neighbours differ by more than this share."""

REFLECTANCE = np.full(len(Material), np.nan)
"""Reflectance of each material at the laser's 905 nm; NaN: as bright as its visible colour."""
REFLECTANCE[[Material.ASPHALT, Material.GRASS, Material.FOLIAGE, Material.RUBBER]] = [0.17, 0.45, 0.5, 0.06]
REFLECTANCE[[Material.MARKING, Material.SIGN, Material.GLASS, Material.LAMP]] = [0.75, 1.0, 0.03, 0.3]
REFLECTANCE[[Material.BEADED, Material.RETRO, Material.LIT]] = [0.75, 1.0, 0.3]


@dataclass(frozen=True, slots=True)
class LidarModel:
    """Data of a sensor: lengths in metres. `divergence_rad` is half the opening angle of a beam; `dropout` is the share
    of its measurements that fail without a reason; `intensity` says what it writes of a return's strength, if at all.
    """

    pattern: Pattern
    period_s: float = 0.1
    reach_m: float = 120.0
    nearest_m: float = 1.0
    noise_m: float = 0.02
    divergence_rad: float = 0.0015
    dropout: float = 0.01
    intensity: IntensityModel | None = INTENSITIES["calibrated"]


LIDARS: dict[str, LidarModel] = {
    "64": LidarModel(Turn(even_deg(-24.8, 2.0, 64), columns=1800)),
    "32": LidarModel(
        Turn(even_deg(-25.0, 15.0, 32), columns=1800), reach_m=100.0, intensity=INTENSITIES["reflectivity"]
    ),
    "16": LidarModel(
        Turn(even_deg(-15.0, 15.0, 16), columns=1800), reach_m=100.0, intensity=INTENSITIES["reflectivity"]
    ),
    "128": LidarModel(Turn(even_deg(-25.0, 15.0, 128), columns=1800), noise_m=0.015, intensity=INTENSITIES["raw"]),
    "raster": LidarModel(
        Raster(np.radians(120.0), even_deg(-12.5, 12.5, 126), columns=600), intensity=INTENSITIES["coarse"]
    ),
    "rosette": LidarModel(Rosette(), intensity=INTENSITIES["coarse"]),
}
"""By number of beams, with angles of HDL-64E, a common 32-beam sensor, VLP-16 and a common 128-beam sensor. Two more do
not turn and number no rings: a mirror's raster of 120° x 25° at 0.2°, as in long-range automotive sensors, and the
rosette of two turning prisms."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Points of a turn, in the LiDAR's axes at each point's own instant.

    Attributes:
        xyz_m: (N, 3) float32.
        intensity: (N,) float32, see `IntensityModel`; None for a sensor that writes none.
        ring: (N,) uint16, 0 the lowest beam; None for a sensor that does not number its beams.
        time_offset_s: (N,) float32, from the stamp of the turn.
    """

    xyz_m: Floats
    intensity: Floats | None
    ring: NDArray[np.uint16] | None
    time_offset_s: Floats


def sweep(
    scene: Scene,
    model: LidarModel,
    poses: Callable[[Doubles], Doubles],
    time_s: float,
    rng: np.random.Generator,
    dead: NDArray[np.bool_] | None = None,
    air: Air = CLEAR,
    gains: Doubles | None = None,
) -> Sweep:
    """One sweep whose middle is at `time_s`.

    Args:
        poses: (N, 4, 4) from the LiDAR to the world at times (N,).
        dead: (beams,) beams that measure nothing.
        air: between the LiDAR and what it hits.
        gains: (beams,) see `reflectance.beam_gains`; None: all are 1.
    """
    beams = model.pattern.beams
    rays = _Rays.of(model, poses, time_s)
    columns = len(rays.offset_s)
    hits = scene.cast(rays.origins, rays.turned.astype(np.float32), rays.times, model.reach_m)
    cosine: Doubles = np.abs(np.einsum("ni,ni->n", rays.turned, hits.normal.astype(np.float64)))
    echoes = _Echoes(hits.range_m.astype(np.float64), _reflectance(scene, hits) * cosine, _light(scene, hits, cosine))
    edge = np.flatnonzero(_jumps(echoes.range_m.reshape(columns, beams)).ravel())
    if len(edge):
        echoes.put(edge, _cones(model, scene, rays, edge, echoes.part(edge)))
    range_m = echoes.range_m
    with np.errstate(invalid="ignore"):
        echo = echoes.strength / range_m**2 * np.exp(-2.0 * air.extinction_per_m * range_m)
        seen = np.isfinite(range_m) & (range_m > model.nearest_m) & (echo > WEAKEST)
    working = np.ones(beams, bool) if dead is None else ~dead
    alive = (rng.random(len(range_m)) >= model.dropout) & np.tile(working, columns)
    seen &= alive
    noise = rng.normal(0.0, model.noise_m, len(range_m))
    water, values = rng.spawn(2)  # streams of their own, so that they change no range
    lit = seen & (hits.triangle >= 0)
    at = Surfaces(rays.origins, rays.turned, hits.range_m, hits.normal, cosine, scene.material[hits.triangle])
    reflectance.shade(echoes.light, lit, at, model.divergence_rad, air.wetness, values)
    if air.wetness:
        seen &= ~(lit & reflectance.lost_on_water(at, air.wetness, water))
    if air.drops:
        _rained(air, model, echoes, seen, rng)
    _bloom(echoes, seen, alive, columns)
    intensity = None
    if model.intensity is not None:
        gain = np.tile(np.ones(beams) if gains is None else gains, columns)[seen]
        intensity = reflectance.values(model.intensity, echoes.light[seen], range_m[seen], gain, values)
    return Sweep(
        (rays.local[seen] * (range_m + noise)[seen, None]).astype(np.float32),
        intensity,
        np.tile(np.arange(beams, dtype=np.uint16), columns)[seen] if model.pattern.ringed else None,
        np.repeat(rays.offset_s, beams)[seen].astype(np.float32),
    )


class _Rays(NamedTuple):
    """N rays of a sweep, column after column.

    Attributes:
        local, turned: (N, 3) float64 directions in the axes of the LiDAR and of the world.
        origins: (N, 3) world.
        times: (N,) when each is cast, seconds.
        pose, offset_s: (columns, 4, 4) and (columns,), see `sweep` and `Fired`.
    """

    local: Doubles
    turned: Doubles
    origins: Doubles
    times: Doubles
    pose: Doubles
    offset_s: Doubles

    @classmethod
    def of(cls, model: LidarModel, poses: Callable[[Doubles], Doubles], time_s: float) -> "_Rays":
        beams = model.pattern.beams
        rays, offset_s = model.pattern.fired(time_s, model.period_s)
        times = time_s + offset_s
        pose, local = poses(times), rays.reshape(-1, 3)
        turned = np.einsum("nij,nj->ni", np.repeat(pose[:, :3, :3], beams, axis=0), local)
        return cls(local, turned, np.repeat(pose[:, :3, 3], beams, axis=0), np.repeat(times, beams), pose, offset_s)

    def cast_offset(self, scene: Scene, model: LidarModel, selected: NDArray[np.intp], local: Doubles) -> Hits:
        """As if the selected rays had these directions."""
        turned = np.einsum("nij,nj->ni", self.pose[selected // model.pattern.beams, :3, :3], local).astype(np.float32)
        return scene.cast(self.origins[selected], turned, self.times[selected], model.reach_m)


class _Echoes(NamedTuple):
    """(N,) each, float64: ranges, inf without an echo; the strength that decides what is detected; and the light that a
    sensor's intensity is made of, see `reflectance.strength`."""

    range_m: Doubles
    strength: Doubles
    light: Doubles

    def part(self, selected: NDArray[np.intp]) -> "_Echoes":
        return _Echoes(*(values[selected] for values in self))

    def put(self, selected: NDArray[np.intp], others: "_Echoes") -> None:
        for values, other in zip(self, others, strict=True):
            values[selected] = other


def _rained(air: Air, model: LidarModel, echoes: _Echoes, seen: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Puts drops in the way of some rays, in place; these rays return from the drop instead of what lies behind it."""
    drop_m = model.nearest_m + rng.exponential(DROP_M, len(seen))
    hit = (rng.random(len(seen)) < air.drops) & (drop_m < echoes.range_m)
    echoes.range_m[hit] = drop_m[hit]
    echoes.light[hit] = DROP_REFLECTANCE
    seen[hit] = True


def _bloom(echoes: _Echoes, seen: NDArray[np.bool_], alive: NDArray[np.bool_], columns: int) -> None:
    """Lets light fall on neighbouring firings, in place: see `reflectance.spill` and `bloom`."""
    range_m = echoes.range_m.reshape(columns, -1)
    light = reflectance.spill(np.where(seen, echoes.light, 0.0).reshape(columns, -1), range_m, CLUSTER_M)
    echoes.light[:] = light.ravel()
    halo = reflectance.bloom(light, range_m, CLUSTER_M)
    np.add.at(echoes.light, halo.raised, halo.by)
    echoes.range_m[halo.ghosts] = echoes.range_m[halo.sources]
    echoes.light[halo.ghosts] = halo.ghost_light
    seen[halo.ghosts] = alive[halo.ghosts]


def _reflectance(scene: Scene, hits: Hits) -> Doubles:
    own = scene.colour[hits.triangle].mean(axis=1, dtype=np.float64)
    fixed = REFLECTANCE[scene.material[hits.triangle]]
    return np.where(hits.triangle < 0, 0.0, np.where(np.isnan(fixed), own, fixed))


def _light(scene: Scene, hits: Hits, cosine: Doubles) -> Doubles:
    light = reflectance.strength(scene.infrared[hits.triangle], scene.material[hits.triangle], cosine)
    return np.where(hits.triangle < 0, 0.0, light)


def _jumps(range_m: Doubles) -> NDArray[np.bool_]:
    """(columns, beams): whether the range of a neighbour differs."""
    result = np.zeros(range_m.shape, dtype=bool)
    held = np.where(np.isfinite(range_m), range_m, 1e4)
    across = np.abs(np.diff(held, axis=0, append=held[:1])) > JUMP * np.minimum(held, np.roll(held, -1, axis=0))
    result |= across | np.roll(across, 1, axis=0)
    difference = np.abs(np.diff(held, axis=1))
    # Neighbouring beams also differ on level ground: only a much larger difference is an edge.
    up = difference > 0.12 * np.minimum(held[:, 1:], held[:, :-1])
    result[:, 1:] |= up
    result[:, :-1] |= up
    return result


def _cones(model: LidarModel, scene: Scene, rays: _Rays, selected: NDArray[np.intp], middle: _Echoes) -> _Echoes:
    """Echoes of beams as cones: the strongest echo, mixed with the echoes within a pulse's length of it."""
    ranges, strengths, lights = [middle.range_m], [middle.strength], [middle.light]
    flat = rays.local[selected]
    side = np.column_stack([-flat[:, 1], flat[:, 0], np.zeros(len(flat))])
    side /= np.linalg.norm(side, axis=1)[:, None]
    above = np.cross(flat, side)
    slant = np.full(len(flat), 0.7)
    for across, over in SPREAD:
        ray = flat + model.divergence_rad * (across * side + over * above)
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        hits = rays.cast_offset(scene, model, selected, ray)
        ranges.append(hits.range_m.astype(np.float64))
        strengths.append(_reflectance(scene, hits) * np.where(np.isfinite(hits.range_m), 0.7, 0.0))
        lights.append(_light(scene, hits, slant))
    echo, weight, light = (np.stack(values, axis=1) for values in (ranges, strengths, lights))
    power = np.where(np.isfinite(echo), weight / np.maximum(echo, 0.1) ** 2, 0.0)
    held_m = np.where(np.isfinite(echo), echo, 1e6)  # no echo: together with nothing
    together = np.abs(held_m[:, :, None] - held_m[:, None, :]) < CLUSTER_M
    cluster = np.where(together, power[:, None, :], 0.0).sum(axis=2)
    best = cluster.argmax(axis=1)
    rows = np.arange(len(echo))
    member = np.where(together[rows, best], power, 0.0)
    total = member.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mixed = (member * held_m).sum(axis=1) / total
        held = (member * weight).sum(axis=1) / total
    inside = member > 0
    share = inside.sum(axis=1) / echo.shape[1]
    returned = total > 0
    return _Echoes(
        np.where(returned, mixed, np.inf),
        np.where(returned, held * share, 0.0),
        (light * inside).sum(axis=1) / echo.shape[1],
    )
