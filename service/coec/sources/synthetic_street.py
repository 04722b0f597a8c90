"""A street of boxes: what the rays of a synthetic camera or LiDAR meet, and in which colour.

World: x along the street, y left, z up, metres; the ground is z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

GROUND, SKY = -1, -2  # instead of the index of a box
HAZE_M = 120.0
"""Range at which 60 % of a surface's colour is lost to haze: what a camera takes for far checks far."""


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """Axis-aligned boxes: corners `low_m`, `high_m` (B, 3), `colour` (B, 3) 0 to 1, `windows` (B,) for
    buildings."""

    low_m: Floats
    high_m: Floats
    colour: Floats
    windows: NDArray[np.bool_]

    def cast(self, origins_m: Floats, directions: Floats, reach_m: float) -> tuple[Floats, NDArray[np.int32]]:
        """Range to the first surface along each ray (inf for none), and what was hit: a box, `GROUND` or
        `SKY`.

        origins_m: (N, 3), all near each other; directions: (N, 3) unit.
        """
        with np.errstate(divide="ignore"):
            inverse = np.float32(1) / directions
        range_m = np.where(directions[:, 2] < 0, -origins_m[:, 2] * inverse[:, 2], np.float32(np.inf))
        range_m[range_m > reach_m] = np.inf
        hit = np.where(np.isfinite(range_m), np.int32(GROUND), np.int32(SKY))
        spread_m = np.ptp(origins_m, axis=0).max()
        middle_m = origins_m.mean(axis=0)
        centre_m = (self.low_m + self.high_m) / 2 - middle_m
        radius_m = np.linalg.norm(self.high_m - self.low_m, axis=1) / 2 + spread_m
        nearest_m = np.linalg.norm(np.maximum(np.abs(centre_m) - (self.high_m - self.low_m) / 2, 0), axis=1) - spread_m
        distance_m = np.linalg.norm(centre_m, axis=1)
        for box in np.argsort(nearest_m):
            if nearest_m[box] > reach_m:
                break
            # Rays inside the cone about the box's bounding sphere, where nothing nearer has been hit yet.
            sine = min(radius_m[box] / distance_m[box], 1.0)
            least = np.sqrt(1 - sine * sine) * distance_m[box] if sine < 1 else -np.inf
            # einsum, not @: BLAS threads would wait for each other here, and their number would show in the bytes.
            along = np.einsum("ni,i->n", directions, centre_m[box])
            rays = np.flatnonzero((along >= least) & (range_m > nearest_m[box]))
            near = (self.low_m[box] - origins_m[rays]) * inverse[rays]
            far = (self.high_m[box] - origins_m[rays]) * inverse[rays]
            enter = np.minimum(near, far).max(axis=1)
            leave = np.maximum(near, far).min(axis=1)
            through = (enter <= leave) & (enter > 0) & (enter < np.minimum(range_m[rays], reach_m))
            range_m[rays[through]] = enter[through]
            hit[rays[through]] = box
        return range_m, hit

    def shade(self, points_m: Floats, directions: Floats, range_m: Floats, hit: NDArray[np.int32]) -> Floats:
        """Colour (N, 3), 0 to 1: windows, paint, paving and grain, lit from one side, paler with distance."""
        x, y, z = points_m.T
        fine = np.float32(1) / (1 + range_m / 25)
        grain = 0.25 * fine * (_hash(points_m * 4) - 0.5) + 0.25 * fine * (_hash(points_m * 1.3) - 0.5)
        paving = np.where(np.abs(y) > 6.4, 0.55 - 0.2 * ((x % 1.5 < 0.1) | (y % 1.5 < 0.1)) * fine, 0.28)
        painted = (np.abs(y) < 0.1) & (x % 6 < 3) | (np.abs(np.abs(y) - 3.4) < 0.08)
        colour = np.repeat(np.where(painted, np.float32(0.85), paving)[:, None], 3, axis=1)
        boxes = np.flatnonzero(hit >= 0)
        low, high = self.low_m[hit[boxes]], self.high_m[hit[boxes]]
        surface = points_m[boxes]
        axis = np.minimum(np.abs(surface - low), np.abs(surface - high)).argmin(axis=1)
        light = np.array([0.75, 1.0, 1.15], dtype=np.float32)[axis] * np.where(surface[:, 1] > 0, 0.8, 1.0)
        along = np.where(axis == 0, y[boxes], x[boxes])
        pane = (along % 2.8 > 0.8) & (along % 2.8 < 2.1) & (z[boxes] % 3.1 > 1.0) & (z[boxes] % 3.1 < 2.5) & (axis < 2)
        glazed = pane & self.windows[hit[boxes]]
        colour[boxes] = self.colour[hit[boxes]] * (light * np.where(glazed, 0.35, 1.0))[:, None]
        colour = np.clip(colour * (1 + 2 * grain[:, None]), 0, 1)
        haze = (range_m / HAZE_M)[:, None] ** 2 * 0.6
        sky = np.array([0.95, 0.8, 0.65], dtype=np.float32) * (1 - 0.3 * np.clip(directions[:, 2:], 0, 1))
        return np.where(hit[:, None] == SKY, sky, colour * (1 - haze) + haze * 0.85).astype(np.float32)


def _hash(cells: Floats) -> Floats:
    """A number in 0 to 1 for each integer cell (N, 3): grain that stays on its surface. Wrapping is meant."""
    whole = np.rint(np.nan_to_num(cells, posinf=0, neginf=0)).astype(np.int64).astype(np.uint64)
    mixed = whole @ np.array([73856093, 19349663, 83492791], dtype=np.uint64)
    mixed = (mixed ^ (mixed >> np.uint64(13))) * np.uint64(0x9E3779B97F4A7C15)
    return ((mixed >> np.uint64(40)) / np.float64(2**24)).astype(np.float32)


def build_street(rng: np.random.Generator, length_m: float) -> Street:
    """Buildings, parked cars and poles on both sides of x = 0 to `length_m`, and 130 m beyond at each end."""
    boxes: list[tuple[float, float, float, float, float, float]] = []  # x, y, sizes along x and y, height, is building
    for side in (-1.0, 1.0):
        for gap_m, length, width, height, inner_m, building in (
            ((0.5, 9.0), (8.0, 22.0), (8.0, 12.0), (3.5, 16.0), (8.0, 13.0), 1.0),
            ((1.0, 22.0), (3.8, 4.8), (1.7, 1.9), (1.3, 2.0), (4.0, 4.4), 0.0),
            ((14.0, 26.0), (0.15, 0.4), (0.15, 0.4), (4.0, 8.0), (6.5, 7.2), 0.0),
        ):
            x = -130.0
            while x < length_m + 130.0:
                x += rng.uniform(*gap_m)
                size_x, size_y = rng.uniform(*length), rng.uniform(*width)
                y = side * (rng.uniform(*inner_m) + size_y / 2)
                boxes.append((x + size_x / 2, y, size_x, size_y, rng.uniform(*height), building))
                x += size_x
    table = np.array(boxes, dtype=np.float32)
    low = np.column_stack([table[:, :2] - table[:, 2:4] / 2, np.zeros(len(table))])
    high = np.column_stack([table[:, :2] + table[:, 2:4] / 2, table[:, 4]])
    colour = rng.uniform(0.35, 0.85, (len(table), 1)) + rng.uniform(-0.15, 0.15, (len(table), 3))
    return Street(low.astype(np.float32), high.astype(np.float32), colour.astype(np.float32), table[:, 5] > 0)
