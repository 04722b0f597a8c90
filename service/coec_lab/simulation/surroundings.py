"""Places that a vehicle drives through, each made from a seed: a street, a highway, a parking garage, furnished
rooms."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from coec_lab.simulation import motorway, props
from coec_lab.simulation import road as traffic
from coec_lab.simulation.mesh import Material, Mesh, box, join, quads, tube
from coec_lab.simulation.passages import Bore, Passages, Site, bore, bore_of
from coec_lab.simulation.road import Mover, Progress, Road
from coec_lab.simulation.street import STRETCH_M, Stretch, Style, build_stretch, sample_style

Doubles = NDArray[np.float64]

STEP_M = 3.0
GARAGE_HALF_M, GARAGE_HIGH_M, BAY_M, BAY_FRONT_M, PILLARS_M = 8.6, 2.9, 2.6, 3.3, 7.8
"""Half the width of a deck with an aisle and a row of bays on either side, its height, the width of a bay, where bays
begin, and the spacing of pillars: common sizes of parking decks."""
ROOM_M, ROOM_HIGH_M, DOORWAY_M, DOORWAY_HIGH_M, AISLE_M = 12.0, 3.3, 2.6, 2.5, 1.7
"""Length and height of a room, width and height of the doorways, and half the aisle that furniture leaves free."""
GARAGE_LIGHT, ROOM_LIGHT = 3.0, 6.0
"""Light of their lamps relative to a tunnel's: a deck has lamps over its bays, too, and people work in a room."""


def room_half_m(seed: int) -> float:
    """Half the width of the rooms of a seed."""
    return float(np.random.default_rng([seed, 108]).uniform(3.4, 6.0))


def garage_bore(road: Road, begin_m: float, end_m: float) -> Bore:
    """The space of a garage between two places."""
    return bore_of(road, begin_m, end_m, GARAGE_HALF_M, GARAGE_HIGH_M, GARAGE_LIGHT)


def room_bore(road: Road, begin_m: float, end_m: float, half_m: float) -> Bore:
    """The space of the rooms between two places."""
    return bore_of(road, begin_m, end_m, half_m, ROOM_HIGH_M, ROOM_LIGHT)


def garage(rng: np.random.Generator, site: Site, length_m: float) -> None:
    """Adds walls, pillars, beams, ducts and parked cars of a stretch of garage."""
    s = np.arange(0.0, length_m + 1e-6, STEP_M)
    half, high = GARAGE_HALF_M, GARAGE_HIGH_M
    _shell(rng, site, s, half, high)
    band = rng.uniform(0.1, 0.7, 3)
    for side in (-1.0, 1.0):
        wall = site.strip(s, (side * (half - 0.005), side * (half - 0.005)), (0.0, 1.1))
        site.meshes.append(quads(wall, band, Material.PAINT))
        duct = rng.uniform(4.0, 7.0)
        pipe = site.strip(s, (side * duct, side * (duct + 0.35)), (high - 0.5, high - 0.5))
        flank = site.strip(s, (side * duct, side * duct), (high - 0.5, high - 0.1))
        site.meshes += [quads(pipe, (0.5, 0.5, 0.5), Material.PAINT), quads(flank, (0.45, 0.45, 0.45), Material.PAINT)]
        for at in np.arange(BAY_M / 2, length_m, BAY_M):
            line = site.strip(np.array([at - 1.35, at - 1.25]), (side * BAY_FRONT_M, side * (half - 0.3)), (0.01, 0.01))
            site.meshes.append(quads(line, (0.72, 0.74, 0.74), Material.MARKING))
            if rng.random() < 0.55:
                left = side * (BAY_FRONT_M + 2.55 + rng.normal(0, 0.1))
                site.put(_low_car(rng), float(at), left, side * np.pi / 2 + np.pi * (rng.random() < 0.5))
        for at in np.arange(PILLARS_M / 2, length_m, PILLARS_M):
            site.put(_pillar(rng, high), float(at), side * (BAY_FRONT_M + 0.2))
        for _ in range(int(rng.integers(1, 4))):
            site.put(_on_wall(rng), rng.uniform(2, length_m - 2), side * (half - 0.06), 0.0 if side > 0 else np.pi)
    for at in np.arange(PILLARS_M / 2, length_m, PILLARS_M):
        beam = box([-0.2, -half, high - 0.4], [0.2, half, high - 0.01], (0.3, 0.3, 0.3), Material.CONCRETE)
        site.put(_closed_below(beam, 0.2, half, high - 0.4), float(at), 0.0)
    if rng.random() < 0.6:
        _cross_wall(rng, site, length_m - 1.3, half, high, 3.1, high - 0.3)
    for _ in range(int(rng.poisson(1.0))):
        site.put(props.person(rng), rng.uniform(1, length_m), rng.choice([-1, 1]) * 2.9, rng.uniform(0, 6.3))


def rooms(rng: np.random.Generator, site: Site, length_m: float, half_m: float) -> None:
    """Adds the rooms of a stretch with their furniture."""
    s = np.arange(0.0, length_m + 1e-6, STEP_M)
    _shell(rng, site, s, half_m, ROOM_HIGH_M)
    for begin in np.arange(0.0, length_m - 1e-6, ROOM_M):
        _cross_wall(rng, site, float(begin), half_m, ROOM_HIGH_M, DOORWAY_M / 2, DOORWAY_HIGH_M)
        _furnish(rng, site, float(begin), half_m)


def _furnish(rng: np.random.Generator, site: Site, begin_m: float, half_m: float) -> None:
    for side in (-1.0, 1.0):
        for _ in range(int(rng.integers(4, 8))):
            at = begin_m + rng.uniform(0.9, ROOM_M - 0.9)
            left = side * rng.uniform(AISLE_M + 0.5, half_m - 0.4)
            mesh = (_work_table, _shelf, _box, _chair, _stand)[int(rng.integers(5))](rng)
            site.put(mesh, at, left, rng.choice([0.0, np.pi / 2]) + rng.normal(0, 0.1))
        for _ in range(int(rng.integers(1, 4))):
            at = begin_m + rng.uniform(1.2, ROOM_M - 1.2)
            site.put(_on_wall(rng), at, side * (half_m - 0.06), 0.0 if side > 0 else np.pi)
    for _ in range(int(rng.integers(1, 4))):
        at, left = begin_m + rng.uniform(1.5, ROOM_M - 1.5), rng.uniform(-half_m + 1, half_m - 1)
        drop = rng.uniform(0.2, 0.6)
        lamp = box(
            [-0.6, -0.1, ROOM_HIGH_M - drop], [0.6, 0.1, ROOM_HIGH_M - drop + 0.1], (0.8, 0.8, 0.8), Material.PAINT
        )
        site.put(_closed_below(lamp, 0.6, 0.1, ROOM_HIGH_M - drop), at, left)
    if rng.random() < 0.6:
        place = begin_m + rng.uniform(2, ROOM_M - 2), rng.choice([-1, 1]) * rng.uniform(1.5, half_m - 0.5)
        site.put(props.person(rng), *place, rng.uniform(0, 6.3))


def _shell(rng: np.random.Generator, site: Site, s: Doubles, half_m: float, high_m: float) -> None:
    """Floor, ceiling with a strip of lamps, and the walls at both sides."""
    floor, walls = rng.uniform(0.15, 0.45), rng.uniform(0.35, 0.75, 3)
    strip = high_m - 0.05
    site.meshes += [
        quads(site.strip(s, (-half_m, half_m), (0.0, 0.0)), np.full(3, floor), Material.CONCRETE),
        quads(site.strip(s, (-half_m, half_m), (high_m, high_m)), (0.5, 0.5, 0.5), Material.PLASTER),
        quads(site.strip(s, (-0.15, 0.15), (strip, strip)), (1.0, 1.0, 1.0), Material.LAMP),
    ]
    for side in (-1.0, 1.0):
        site.meshes.append(quads(site.strip(s, (side * half_m, side * half_m), (0.0, high_m)), walls, Material.PLASTER))


def _cross_wall(
    rng: np.random.Generator, site: Site, at_m: float, half_m: float, high_m: float, gap_m: float, gap_high_m: float
) -> None:
    """A wall across the way, with an opening of ± `gap_m` and a frame around the opening."""
    colour, frame, thick = rng.uniform(0.3, 0.75, 3), rng.uniform(0.05, 0.5, 3), 0.1
    parts = [
        box([-thick, low, 0.0], [thick, up, high_m], colour, Material.PLASTER)
        for low, up in ((-half_m, -gap_m), (gap_m, half_m))
    ]
    parts.append(box([-thick, -gap_m, gap_high_m], [thick, gap_m, high_m], colour, Material.PLASTER))
    for side in (-1.0, 1.0):
        low, up = sorted((side * gap_m, side * (gap_m + 0.1)))
        parts.append(box([-thick - 0.02, low, 0.0], [thick + 0.02, up, gap_high_m], frame, Material.PAINT))
    site.put(join(parts), at_m, 0.0)


def _low_car(rng: np.random.Generator) -> Mesh:
    """A car that fits under the ceiling."""
    while True:
        made = props.car(rng)
        if float(made.corners_m[:, :, 2].max()) < GARAGE_HIGH_M - 0.5:
            return made


def _pillar(rng: np.random.Generator, high_m: float) -> Mesh:
    warning = (0.05, 0.6, 0.75) if rng.random() < 0.5 else (0.7, 0.7, 0.7)
    return join(
        [
            box([-0.3, -0.2, 0.0], [0.3, 0.2, high_m], (0.45, 0.46, 0.46), Material.CONCRETE),
            box([-0.305, -0.205, 0.1], [0.305, 0.205, 1.2], warning, Material.PAINT),
        ]
    )


def _on_wall(rng: np.random.Generator) -> Mesh:
    """A door, a board or a cabinet in the plane y = 0, seen from y < 0."""
    colour = rng.uniform(0.05, 0.85, 3)
    match int(rng.integers(3)):
        case 0:
            return box([-0.5, -0.03, 0.0], [0.5, 0.05, 2.1], colour, Material.PAINT)
        case 1:
            half, low = rng.uniform(0.4, 1.2), rng.uniform(0.8, 1.2)
            return box([-half, -0.03, low], [half, 0.05, low + rng.uniform(0.6, 1.1)], colour, Material.PAINT)
    return box([-0.35, -0.3, 0.0], [0.35, 0.05, rng.uniform(0.9, 2.0)], colour, Material.LACQUER)


def _work_table(rng: np.random.Generator) -> Mesh:
    long, deep, high = rng.uniform(0.6, 1.0), 0.4, rng.uniform(0.7, 0.8)
    top = box([-long, -deep, high - 0.04], [long, deep, high], rng.uniform(0.15, 0.7, 3), Material.BARK)
    legs = [
        box([x - 0.03, y - 0.03, 0.0], [x + 0.03, y + 0.03, high - 0.04], (0.2, 0.2, 0.2), Material.PAINT)
        for x in (-long + 0.05, long - 0.05)
        for y in (-deep + 0.05, deep - 0.05)
    ]
    screen = rng.uniform(-0.5 * long, 0.5 * long)
    monitor = box(
        [screen - 0.3, -0.03, high + 0.1], [screen + 0.3, 0.03, high + 0.5], (0.03, 0.03, 0.03), Material.PAINT
    )
    return join([_closed_below(top, long, deep, high - 0.04), *legs, monitor])


def _shelf(rng: np.random.Generator) -> Mesh:
    """Boards with boxes of all sizes on them."""
    half, deep, high = rng.uniform(0.4, 0.9), 0.22, rng.uniform(1.4, 2.2)
    colour = rng.uniform(0.2, 0.7, 3)
    parts = [box([x - 0.02, -deep, 0.0], [x + 0.02, deep, high], colour, Material.PAINT) for x in (-half, half)]
    for level in np.arange(0.1, high, 0.42):
        board = box([-half, -deep, level], [half, deep, level + 0.03], colour, Material.PAINT)
        parts.append(_closed_below(board, half, deep, level))
        for x in np.arange(-half + 0.12, half - 0.1, 0.25):
            if rng.random() < 0.6:
                top = level + rng.uniform(0.1, 0.33)
                parts.append(
                    box([x - 0.1, -deep + 0.03, level + 0.03], [x + 0.1, deep - 0.03, top], rng.uniform(0.03, 0.8, 3),
                        Material.PAINT)
                )  # fmt: skip
    return join(parts)


def _box(rng: np.random.Generator) -> Mesh:
    half = rng.uniform(0.15, 0.45, 2)
    return box([*-half, 0.0], [*half, rng.uniform(0.3, 1.5)], rng.uniform(0.05, 0.7, 3), Material.PAINT)


def _chair(rng: np.random.Generator) -> Mesh:
    colour = rng.uniform(0.03, 0.5, 3)
    return join(
        [
            tube([0, 0, 0], [0, 0, 0.45], 0.04, 6, (0.2, 0.2, 0.2), Material.PAINT),
            box([-0.22, -0.22, 0.43], [0.22, 0.22, 0.5], colour, Material.CLOTH),
            box([-0.22, 0.2, 0.55], [0.22, 0.25, 1.0], colour, Material.CLOTH),
        ]
    )


def _stand(rng: np.random.Generator) -> Mesh:
    """A board on a tripod."""
    half, low = rng.uniform(0.3, 0.6), rng.uniform(0.7, 1.1)
    return join(
        [
            tube([0, 0, 0], [0, 0, low], 0.025, 6, (0.1, 0.1, 0.1), Material.PAINT),
            box([-half, -0.015, low], [half, 0.015, low + 1.2 * half], rng.uniform(0.3, 0.85, 3), Material.PAINT),
        ]
    )


def _closed_below(mesh: Mesh, x_m: float, y_m: float, z_m: float) -> Mesh:
    """A mesh of `box` with an underside, which `box` leaves open."""
    under = [[-x_m, -y_m, z_m], [x_m, -y_m, z_m], [x_m, y_m, z_m], [-x_m, y_m, z_m]]
    return join([mesh, quads([under], mesh.colour[0], Material(int(mesh.material[0])))])


class Surroundings(Protocol):
    """A place of some kind, made from a seed.

    Attributes:
        speed_mps: default mean speed there.
        calmer: bends and slopes are so many times longer than in a street.
        poor: whether parts of it may be a tunnel or an open road.
    """

    speed_mps: ClassVar[float]
    calmer: ClassVar[float]
    poor: ClassVar[bool]

    @property
    def left_m(self) -> float:
        """How far left of the centre line the vehicle drives."""
        ...

    def build(self, index: int, road: Road, passages: Passages) -> Stretch:
        """The stretch of a number; it does not depend on other stretches."""
        ...

    def sample_model(self, rng: np.random.Generator) -> Mesh:
        """A random model of something that moves there."""
        ...

    def movers(self, at_m: float, time_s: float, own: Progress) -> Iterator[Mover]:
        """What moves around a place along the road at a time; `own` is the progress of the vehicle."""
        ...

    def bores(self, road: Road, begin_m: float, end_m: float, passages: Passages) -> tuple[Bore, ...]:
        """Rooms that keep the sky off the road between two places."""
        ...


@dataclass(frozen=True, slots=True)
class Street:
    """A street of a town (`street`)."""

    seed: int
    style: Style = field(init=False)

    speed_mps: ClassVar[float] = 8.5
    calmer: ClassVar[float] = 1.0
    poor: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "style", sample_style(self.seed))

    @property
    def left_m(self) -> float:
        """See `Surroundings`: the middle of the right lane."""
        return -self.style.lane_m / 2

    def build(self, index: int, road: Road, passages: Passages) -> Stretch:
        """See `Surroundings`."""
        return build_stretch(self.seed, index, road, self.style, passages)

    def sample_model(self, rng: np.random.Generator) -> Mesh:
        """See `Surroundings`."""
        return props.car(rng)

    def movers(self, at_m: float, time_s: float, own: Progress) -> Iterator[Mover]:
        """See `Surroundings`."""
        return traffic.in_street(self.seed, at_m, time_s, own, self.style.lane_m)

    def bores(self, road: Road, begin_m: float, end_m: float, passages: Passages) -> tuple[Bore, ...]:  # noqa: ARG002
        """See `Surroundings`: the tunnels."""
        return tuple(bore(road, span, self.style.lane_m) for span in passages.tunnels)


@dataclass(frozen=True, slots=True)
class Highway:
    """A motorway (`highway`), see `motorway.furnish`."""

    seed: int

    speed_mps: ClassVar[float] = 25.0
    calmer: ClassVar[float] = 5.0
    poor: ClassVar[bool] = False

    @property
    def left_m(self) -> float:
        """See `Surroundings`: the right lane."""
        return motorway.OWN_LEFT_M

    def build(self, index: int, road: Road, passages: Passages) -> Stretch:  # noqa: ARG002
        """See `Surroundings`."""
        seed = self.seed
        return _furnished(seed, index, road, lambda rng, site, length_m: motorway.furnish(rng, site, length_m, seed))

    def sample_model(self, rng: np.random.Generator) -> Mesh:
        """See `Surroundings`."""
        return motorway.vehicle(rng)

    def movers(self, at_m: float, time_s: float, own: Progress) -> Iterator[Mover]:
        """See `Surroundings`."""
        return traffic.on_highway(self.seed, at_m, time_s, own, motorway.OWN_LEFT_M, motorway.FAST_LEFT_M)

    def bores(self, road: Road, begin_m: float, end_m: float, passages: Passages) -> tuple[Bore, ...]:  # noqa: ARG002
        """See `Surroundings`: none."""
        return ()


@dataclass(frozen=True, slots=True)
class Garage:
    """The aisle of a parking garage, see `garage`."""

    seed: int

    speed_mps: ClassVar[float] = 2.5
    calmer: ClassVar[float] = 1.0
    poor: ClassVar[bool] = False

    @property
    def left_m(self) -> float:
        """See `Surroundings`: right of the middle."""
        return -0.6

    def build(self, index: int, road: Road, passages: Passages) -> Stretch:  # noqa: ARG002
        """See `Surroundings`."""
        return _furnished(self.seed, index, road, garage)

    def sample_model(self, rng: np.random.Generator) -> Mesh:
        """See `Surroundings`."""
        return props.car(rng)

    def movers(self, at_m: float, time_s: float, own: Progress) -> Iterator[Mover]:  # noqa: ARG002
        """See `Surroundings`: none."""
        return iter(())

    def bores(self, road: Road, begin_m: float, end_m: float, passages: Passages) -> tuple[Bore, ...]:  # noqa: ARG002
        """See `Surroundings`: the deck."""
        return (garage_bore(road, begin_m, end_m),)


@dataclass(frozen=True, slots=True)
class Room:
    """A row of furnished rooms with people in them, see `rooms`."""

    seed: int

    speed_mps: ClassVar[float] = 0.8
    calmer: ClassVar[float] = 1.0
    poor: ClassVar[bool] = False

    @property
    def left_m(self) -> float:
        """See `Surroundings`: the middle; the vehicle sways less than a doorway allows."""
        return 0.0

    @property
    def half_m(self) -> float:
        """Half the width of the rooms."""
        return room_half_m(self.seed)

    def build(self, index: int, road: Road, passages: Passages) -> Stretch:  # noqa: ARG002
        """See `Surroundings`."""
        half_m = self.half_m
        return _furnished(self.seed, index, road, lambda rng, site, length_m: rooms(rng, site, length_m, half_m))

    def sample_model(self, rng: np.random.Generator) -> Mesh:
        """See `Surroundings`."""
        return props.person(rng)

    def movers(self, at_m: float, time_s: float, own: Progress) -> Iterator[Mover]:  # noqa: ARG002
        """See `Surroundings`."""
        return traffic.in_room(self.seed, own, self.half_m)

    def bores(self, road: Road, begin_m: float, end_m: float, passages: Passages) -> tuple[Bore, ...]:  # noqa: ARG002
        """See `Surroundings`: the rooms."""
        return (room_bore(road, begin_m, end_m, self.half_m),)


SCENES: dict[str, Callable[[int], Surroundings]] = {
    "street": Street,
    "highway": Highway,
    "garage": Garage,
    "room": Room,
}
"""By the names that a user writes."""


def _furnished(
    seed: int, index: int, road: Road, furnish: Callable[[np.random.Generator, Site, float], None]
) -> Stretch:
    site = Site(road, index * STRETCH_M)
    furnish(np.random.default_rng([seed, 102, index + 2**20]), site, STRETCH_M)
    return Stretch(site.origin_m, join(site.meshes), np.empty((0, 3)))
