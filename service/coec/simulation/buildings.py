"""Houses with real windows: panes set back in the wall, sills, doors, roofs.

Local frame: x along the street, y away from it, z up; the front wall stands on y = 0 from x = 0 to `width_m`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.simulation.mesh import Colour, Material, Mesh, box, join, quads, triangles, tube

DoublesOfHouses = NDArray[np.float64]
Floating = NDArray[np.floating]

FOOT_M = -2.5
"""Walls reach this far down, so that no gap opens where the ground falls away beside the road."""
REVEAL_M = 0.16
"""How far a pane is set back in the wall."""
WALL_COLOURS: tuple[Colour, ...] = (
    (0.55, 0.65, 0.72), (0.40, 0.55, 0.66), (0.70, 0.72, 0.74), (0.28, 0.36, 0.52), (0.20, 0.26, 0.42),
    (0.62, 0.62, 0.58), (0.45, 0.58, 0.72), (0.35, 0.38, 0.40), (0.62, 0.58, 0.45), (0.80, 0.82, 0.84),
)  # fmt: skip
ROOF_COLOURS: tuple[Colour, ...] = ((0.10, 0.13, 0.32), (0.12, 0.12, 0.14), (0.18, 0.20, 0.28), (0.22, 0.22, 0.22))


@dataclass(frozen=True, slots=True)
class HousePlan:
    """Dimensions of a house, metres."""

    width_m: float
    depth_m: float
    floors: int
    floor_m: float
    bay_m: float
    gabled: bool
    shop: bool

    @property
    def height_m(self) -> float:
        """Height of the eaves."""
        return self.floors * self.floor_m + 0.4


def house(rng: np.random.Generator, plan: HousePlan) -> Mesh:
    """A house of a plan, in random colours."""
    colour = np.asarray(WALL_COLOURS[rng.integers(len(WALL_COLOURS))]) * rng.uniform(0.75, 1.1)
    wall = Material.BRICK if rng.random() < 0.4 else Material.PLASTER
    frame = np.full(3, rng.choice([0.75, 0.6, 0.12, 0.25])) * np.array([0.95, 1.0, 1.0])
    high = plan.height_m
    width, depth = plan.width_m, plan.depth_m
    front = _wall(rng, plan, width, colour, wall, frame, door=True)
    parts = [
        front,
        _turned(_wall(rng, plan, depth, colour, wall, frame, door=False), (0.0, depth), -np.pi / 2),
        _turned(_wall(rng, plan, depth, colour, wall, frame, door=False), (width, 0.0), np.pi / 2),
        quads([[0, depth, FOOT_M], [width, depth, FOOT_M], [width, depth, high], [0, depth, high]], colour, wall),
    ]
    parts.append(_roof(rng, plan, colour, wall))
    if rng.random() < 0.35 and plan.floors > 1:
        parts.append(_balconies(rng, plan, frame))
    if rng.random() < 0.5:
        x = rng.uniform(0.2, plan.width_m - 0.2)
        parts.append(tube([x, -0.07, 0.0], [x, -0.07, high], 0.05, 6, (0.3, 0.3, 0.3), Material.PAINT))
    return join(parts)


def _wall(
    rng: np.random.Generator,
    plan: HousePlan,
    width_m: float,
    colour: DoublesOfHouses,
    kind: Material,
    frame: DoublesOfHouses,
    *,
    door: bool,
) -> Mesh:
    """A wall in the plane y = 0, seen from y < 0, of bays with a window each."""
    bays = max(1, round(width_m / plan.bay_m))
    bay = width_m / bays
    share_u, share_v = rng.uniform(0.38, 0.62), rng.uniform(0.45, 0.62)
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(bays), np.arange(plan.floors)))
    u0, v0 = column * bay, row * plan.floor_m
    u1 = u0 + bay
    v1 = np.where(row == plan.floors - 1, plan.height_m, v0 + plan.floor_m)
    low = v0 + 0.28 * plan.floor_m
    high = low + share_v * plan.floor_m
    left, right = u0 + (0.5 - share_u / 2) * bay, u0 + (0.5 + share_u / 2) * bay
    entrance = np.zeros(len(column), dtype=bool)
    if door:
        ground = row == 0
        if plan.shop:
            left, right = np.where(ground, u0 + 0.25, left), np.where(ground, u1 - 0.25, right)
            low, high = np.where(ground, 0.5, low), np.where(ground, plan.floor_m - 0.5, high)
        entrance = ground & (column == rng.integers(bays))
        left = np.where(entrance, u0 + bay / 2 - 0.55, left)
        right = np.where(entrance, u0 + bay / 2 + 0.55, right)
        low, high = np.where(entrance, 0.02, low), np.where(entrance, 2.2, high)
    v0 = np.where(row == 0, FOOT_M, v0)
    zero, deep = np.zeros_like(u0), np.full_like(u0, REVEAL_M)

    def face(*corners: tuple[Floating, Floating, Floating]) -> Floating:
        return np.stack([np.stack(corner, axis=-1) for corner in corners], axis=1)

    walls = np.concatenate([
        face((u0, zero, v0), (u1, zero, v0), (u1, zero, low), (u0, zero, low)),
        face((u0, zero, high), (u1, zero, high), (u1, zero, v1), (u0, zero, v1)),
        face((u0, zero, low), (left, zero, low), (left, zero, high), (u0, zero, high)),
        face((right, zero, low), (u1, zero, low), (u1, zero, high), (right, zero, high)),
    ])  # fmt: skip
    reveals = np.concatenate([
        face((left, zero, low), (right, zero, low), (right, deep, low), (left, deep, low)),
        face((left, zero, high), (right, zero, high), (right, deep, high), (left, deep, high)),
        face((left, zero, low), (left, deep, low), (left, deep, high), (left, zero, high)),
        face((right, zero, low), (right, deep, low), (right, deep, high), (right, zero, high)),
    ])  # fmt: skip
    panes = face((left, deep, low), (right, deep, low), (right, deep, high), (left, deep, high))
    shade = rng.uniform(0.02, 0.12, (len(u0), 1)) * np.array([1.1, 1.0, 0.95])
    curtained = rng.random(len(u0)) < 0.25
    shade[curtained] = np.array([0.42, 0.45, 0.47]) * rng.uniform(0.6, 1.2)
    leaf = np.asarray(WALL_COLOURS[rng.integers(len(WALL_COLOURS))]) * 0.5
    slim, wide = (left + right) / 2 - 0.04, (left + right) / 2 + 0.04
    near = np.full_like(u0, REVEAL_M - 0.04)
    bars = np.concatenate([
        face((slim, near, low), (wide, near, low), (wide, near, high), (slim, near, high)),
        face((left, near, low), (right, near, low), (right, near, low + 0.07), (left, near, low + 0.07)),
        face((left, near, high - 0.07), (right, near, high - 0.07), (right, near, high), (left, near, high)),
        face((left, near, low), (left + 0.07, near, low), (left + 0.07, near, high), (left, near, high)),
        face((right - 0.07, near, low), (right, near, low), (right, near, high), (right - 0.07, near, high)),
    ])  # fmt: skip
    out = np.full_like(u0, -0.08)
    sills = np.concatenate([
        face((left, out, low), (right, out, low), (right, zero, low), (left, zero, low)),
        face((left, out, low - 0.06), (right, out, low - 0.06), (right, out, low), (left, out, low)),
    ])[np.tile(~entrance, 2)]  # fmt: skip
    parts = [
        quads(walls, colour, kind),
        quads(reveals, colour * 0.9, Material.PLASTER),
        quads(panes[~entrance], shade[~entrance], Material.GLASS),
        quads(bars, frame, Material.PAINT),
        quads(sills, frame * 0.9, Material.PAINT),
    ]
    if entrance.any():
        parts.append(quads(panes[entrance], leaf, Material.PAINT))
    return join(parts)


def _turned(mesh: Mesh, at_m: tuple[float, float], angle_rad: float) -> Mesh:
    return mesh.placed(at_m[0], at_m[1], 0.0, angle_rad)


def _roof(rng: np.random.Generator, plan: HousePlan, colour: DoublesOfHouses, wall: Material) -> Mesh:
    w, d, h = plan.width_m, plan.depth_m, plan.height_m
    if not plan.gabled:
        top, rim = h + rng.uniform(0.3, 0.9), 0.3
        parts = [
            quads([[0, 0, h], [w, 0, h], [w, d, h], [0, d, h]], (0.2, 0.2, 0.2), Material.CONCRETE),
            box([-0.05, -0.05, h], [w + 0.05, rim, top], colour * 0.85, wall),
            box([-0.05, d - rim, h], [w + 0.05, d + 0.05, top], colour * 0.85, wall),
        ]
        if rng.random() < 0.5:
            x, y = rng.uniform(0.2, 0.7) * w, rng.uniform(0.4, 0.7) * d
            parts.append(box([x, y, h], [x + 1.8, y + 1.5, h + 1.8], (0.5, 0.5, 0.5), Material.CONCRETE))
        return join(parts)
    over, ridge = 0.45, h + rng.uniform(0.28, 0.5) * d
    tiles = np.asarray(ROOF_COLOURS[rng.integers(len(ROOF_COLOURS))]) * rng.uniform(0.8, 1.3)
    eave = h - over * (ridge - h) / (d / 2)
    slopes = [
        [[-0.3, -over, eave], [w + 0.3, -over, eave], [w + 0.3, d / 2, ridge], [-0.3, d / 2, ridge]],
        [[-0.3, d + over, eave], [w + 0.3, d + over, eave], [w + 0.3, d / 2, ridge], [-0.3, d / 2, ridge]],
    ]
    gables = [[[x, 0, h], [x, d, h], [x, d / 2, ridge]] for x in (0.0, w)]
    parts = [quads(slopes, tiles, Material.TILES), triangles(gables, colour, wall)]
    for _ in range(rng.integers(1, 3)):
        x = rng.uniform(0.15, 0.8) * w
        parts.append(box([x, d * 0.4, h], [x + 0.6, d * 0.4 + 0.6, ridge + 0.7], (0.2, 0.25, 0.4), Material.BRICK))
    if w > 7 and rng.random() < 0.5:  # a dormer
        x, rise = rng.uniform(0.25, 0.6) * w, ridge - h
        parts.append(box([x, 0.6, h], [x + 1.8, d / 2, h + 0.75 * rise], tiles, Material.TILES))
        pane = [[x + 0.3, 0.58, h + 0.4], [x + 1.5, 0.58, h + 0.4]]
        pane += [[x + 1.5, 0.58, h + 0.65 * rise], [x + 0.3, 0.58, h + 0.65 * rise]]
        parts.append(quads([pane], (0.08, 0.07, 0.06), Material.GLASS))
    return join(parts)


def _balconies(rng: np.random.Generator, plan: HousePlan, frame: DoublesOfHouses) -> Mesh:
    width = rng.uniform(2.0, 3.5)
    x = rng.uniform(0.3, max(0.4, plan.width_m - width - 0.3))
    out = rng.uniform(0.9, 1.4)
    parts = []
    for floor in range(1, plan.floors):
        z = floor * plan.floor_m + 0.1
        parts.append(box([x, -out, z], [x + width, 0.0, z + 0.16], (0.5, 0.52, 0.52), Material.CONCRETE))
        parts.append(box([x, -out, z + 0.95], [x + width, -out + 0.05, z + 1.0], frame, Material.PAINT))
        for post in np.linspace(x, x + width - 0.03, 9):
            parts.append(box([post, -out, z + 0.16], [post + 0.03, -out + 0.03, z + 0.95], frame, Material.PAINT))
    return join(parts)
