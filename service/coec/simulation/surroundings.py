"""The kinds of places through which a vehicle drives, by name: what stands there, what moves, how fast it drives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from coec.simulation import props, traffic
from coec.simulation.highway import OWN_LEFT_M, highway
from coec.simulation.indoors import garage, garage_bore, room_bore, room_half_m, rooms
from coec.simulation.mesh import Mesh, join
from coec.simulation.passages import Passages
from coec.simulation.road import Road
from coec.simulation.site import Site
from coec.simulation.street import STRETCH_M, Stretch, Style, build_stretch, sample_style
from coec.simulation.traffic import Mover, Progress
from coec.simulation.tunnel import Bore, bore


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
    """See `highway`."""

    seed: int

    speed_mps: ClassVar[float] = 25.0
    calmer: ClassVar[float] = 5.0
    poor: ClassVar[bool] = False

    @property
    def left_m(self) -> float:
        """See `Surroundings`: the right lane."""
        return OWN_LEFT_M

    def build(self, index: int, road: Road, passages: Passages) -> Stretch:  # noqa: ARG002
        """See `Surroundings`."""
        return _furnished(self.seed, index, road, highway)

    def sample_model(self, rng: np.random.Generator) -> Mesh:
        """See `Surroundings`."""
        return props.car(rng)

    def movers(self, at_m: float, time_s: float, own: Progress) -> Iterator[Mover]:
        """See `Surroundings`."""
        return traffic.on_highway(self.seed, at_m, time_s, own, OWN_LEFT_M)

    def bores(self, road: Road, begin_m: float, end_m: float, passages: Passages) -> tuple[Bore, ...]:  # noqa: ARG002
        """See `Surroundings`: none."""
        return ()


@dataclass(frozen=True, slots=True)
class Garage:
    """The aisle of a parking garage, see `indoors`."""

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
    """A row of furnished rooms with people in them, see `indoors`."""

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
    return Stretch(site.origin_m, join(site.meshes))
