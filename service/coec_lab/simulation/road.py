"""The road, and what moves along it: cars on the road, people in a room. Everything follows from the seed."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Doubles = NDArray[np.float64]

STEP_M = 0.1
"""Spacing of the table of positions; between its entries the road is straight to 0.02 mm at the tightest bend."""
LONGEST_BEND_M, SHORTEST_BEND_M = 900.0, 260.0
"""Wavelengths of the heading. With `HEADING_RAD` the radius stays above 90 m, wider than the ground strip."""
HEADING_RAD = (0.30, 0.18, 0.10)
"""Amplitudes of the waves of the heading, radians. Their sum is below a right angle, so the road goes on in x."""
GRADE = (0.012, 0.008)
"""Amplitudes of the waves of the slope, metres per metre."""


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A road along arc length s, from `begin_m` on, at every `STEP_M`.

    Attributes:
        table: (K, 5): x, y, z in metres, heading and slope angle (positive uphill) in radians.
    """

    begin_m: float
    table: Doubles

    def at(self, s_m: ArrayLike) -> Doubles:
        """(..., 5) rows of the table at arc length s (held at its ends)."""
        place = (np.asarray(s_m, dtype=np.float64) - self.begin_m) / STEP_M
        place = np.clip(place, 0.0, len(self.table) - 1.000001)
        low = place.astype(np.int64)
        share = (place - low)[..., None]
        return (1 - share) * self.table[low] + share * self.table[low + 1]

    def points(self, s_m: ArrayLike, left_m: ArrayLike, up_m: ArrayLike) -> Doubles:
        """(..., 3) world points: along the road, to its left, above its surface."""
        s, left, up = np.broadcast_arrays(s_m, left_m, up_m)
        x, y, z, heading, _ = np.moveaxis(self.at(s), -1, 0)
        return np.stack([x - left * np.sin(heading), y + left * np.cos(heading), z + up], axis=-1)


def build_road(seed: int, begin_m: float, end_m: float, calmer: float = 1.0) -> Road:
    """The road of a seed between two arc lengths; its bends and slopes are `calmer` times longer."""
    rng = np.random.default_rng([seed, 100])
    s: Doubles = begin_m + STEP_M * np.arange(int(np.ceil((end_m - begin_m) / STEP_M)) + 2, dtype=np.float64)
    length = calmer * rng.uniform(SHORTEST_BEND_M, LONGEST_BEND_M, 3) * np.array([1.3, 1.0, 0.7])
    heading = _waves(rng, s, HEADING_RAD, length)
    slope = _waves(rng, s, GRADE, calmer * rng.uniform(150.0, 400.0, 2))
    middle = (heading[1:] + heading[:-1]) / 2
    flat = STEP_M * np.column_stack([np.cos(middle), np.sin(middle), (slope[1:] + slope[:-1]) / 2])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(flat, axis=0)])
    position -= position[int(-begin_m / STEP_M)]
    return Road(begin_m, np.column_stack([position, heading, np.arctan(slope)]))


def _waves(rng: np.random.Generator, s_m: Doubles, sizes: tuple[float, ...], lengths_m: Doubles) -> Doubles:
    total = np.zeros_like(s_m)
    for size, length_m in zip(sizes, lengths_m, strict=True):
        total += size * np.sin(2 * np.pi * s_m / length_m + rng.uniform(0, 2 * np.pi))
    return total


Progress = Callable[[Doubles], Doubles]
"""Arc length in metres at times in seconds."""

MODELS = 10
"""Number of different looks of what moves."""
ONCOMING_MPS, ONCOMING_GAP_M = 9.0, 55.0
OWN_GAPS_M = (34.0, 71.0, 113.0, -27.0)
"""Places of the other cars in the own lane, ahead of the vehicle."""
FAR_GAPS_M = (62.0, 118.0, -48.0)
"""The same on a highway: two seconds and a half apart."""
HIGHWAY_MPS, HIGHWAY_GAP_M = 27.0, 130.0
"""Speed and spacing of the oncoming traffic on a highway."""
FAST_MPS, FAST_GAP_M = 34.0, 80.0
"""The same of those that overtake."""
WALKERS, WALK_M, WALK_S = 3, 1.8, 7.0
"""People in a room: how many, how far they go to and fro, and how long that takes."""


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """Something that moves: its model, its place along the road over time, and how far left of the centre line."""

    model: int
    progress: Progress
    left_m: float
    oncoming: bool

    def poses(self, road: Road, time_s: Doubles) -> Doubles:
        """(N, 4): x, y, z in metres and heading in radians."""
        s = self.progress(time_s)
        xyz = road.points(s, self.left_m, 0.0)
        heading = road.at(s)[:, 3] + (np.pi if self.oncoming else 0.0)
        return np.column_stack([xyz, heading])


def in_street(seed: int, at_m: float, time_s: float, own: Progress, lane_m: float) -> Iterator[Mover]:
    """Cars in the vehicle's lane and oncoming cars, in lanes of this width."""
    left = lane_m / 2
    yield from _ahead(seed, own, OWN_GAPS_M, -left)
    yield from _coming(seed, at_m, time_s, left, ONCOMING_MPS, ONCOMING_GAP_M)


def on_highway(
    seed: int, at_m: float, time_s: float, own: Progress, own_left_m: float, fast_left_m: float
) -> Iterator[Mover]:
    """Few vehicles, far apart, in the vehicle's lane and beyond the median; faster ones in the lane to its left."""
    yield from _ahead(seed, own, FAR_GAPS_M, own_left_m)
    yield from _coming(seed, at_m, time_s, -own_left_m, HIGHWAY_MPS, HIGHWAY_GAP_M)
    middle = int(np.floor((at_m - FAST_MPS * time_s) / FAST_GAP_M))
    for number in range(middle - 1, middle + 2):
        rng = np.random.default_rng([seed, 109, number + 2**20])
        if rng.random() < 0.7:
            start = number * FAST_GAP_M + rng.uniform(0, FAST_GAP_M - 25)
            model = int(rng.integers(MODELS))
            yield Mover(model, _against(float(start), -FAST_MPS), fast_left_m, oncoming=False)


def in_room(seed: int, own: Progress, half_m: float) -> Iterator[Mover]:
    """People who walk to and fro ahead of the vehicle, between the walls at ± `half_m`."""
    for number in range(WALKERS):
        rng = np.random.default_rng([seed, 107, number])
        ahead, phase = float(rng.uniform(2.5, 7.0)), float(rng.uniform(0, 2 * np.pi))
        left = float(rng.uniform(-1, 1)) * (half_m - 1.0)
        yield Mover(
            int(rng.integers(MODELS)), _to_and_fro(_shifted(own, ahead), phase), left, oncoming=bool(number % 2)
        )


def _ahead(seed: int, own: Progress, gaps_m: tuple[float, ...], left_m: float) -> Iterator[Mover]:
    for place, gap in enumerate(gaps_m):
        rng = np.random.default_rng([seed, 104, place])
        if rng.random() < 0.75:
            yield Mover(int(rng.integers(MODELS)), _shifted(own, gap), left_m, oncoming=False)


def _coming(seed: int, at_m: float, time_s: float, left_m: float, speed_mps: float, every_m: float) -> Iterator[Mover]:
    middle = int(np.floor((at_m + speed_mps * time_s) / every_m))
    for number in range(middle - 1, middle + 3):
        rng = np.random.default_rng([seed, 105, number + 2**20])
        if rng.random() < 0.6:
            start = number * every_m + rng.uniform(0, every_m - 12)
            yield Mover(int(rng.integers(MODELS)), _against(float(start), speed_mps), left_m, oncoming=True)


def _shifted(progress: Progress, gap_m: float) -> Progress:
    return lambda time_s: progress(time_s) + gap_m


def _against(start_m: float, speed_mps: float) -> Progress:
    return lambda time_s: start_m - speed_mps * time_s


def _to_and_fro(about: Progress, phase: float) -> Progress:
    return lambda time_s: about(time_s) + WALK_M * np.sin(2 * np.pi * time_s / WALK_S + phase)
