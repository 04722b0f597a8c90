"""A street of a town: its style, the ground, and what stands next to it, houses included, in stretches of equal length
that follow from the seed and their number alone.

Local frame: x along the street, y away from it, z up; the front wall stands on y = 0 from x = 0 to `width_m`.

Every stretch follows from the seed and its number alone, so a drive of any length needs only those around the vehicle.
Traffic keeps to the right; `left_m` counts from the centre line; sidewalks begin beyond `Style.half_road_m`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec_lab.simulation import props
from coec_lab.simulation.mesh import Colour, Material, Mesh, box, join, quads, triangles, tube
from coec_lab.simulation.passages import Passages, Site, dig
from coec_lab.simulation.road import Road

Doubles = NDArray[np.float64]


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


@dataclass(frozen=True, slots=True, eq=False)
class _Openings:
    """The bays of a wall in the plane y = 0, one window or door each: (N,) metres.

    Attributes:
        u0, u1, v0, v1: the bay.
        left, right, low, high: its opening.
        entrance: (N,) bool, whether that is the door.
    """

    u0: Floating
    u1: Floating
    v0: Floating
    v1: Floating
    left: Floating
    right: Floating
    low: Floating
    high: Floating
    entrance: NDArray[np.bool_]


def _openings(rng: np.random.Generator, plan: HousePlan, width_m: float, *, door: bool) -> _Openings:
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
    return _Openings(u0, u1, np.where(row == 0, FOOT_M, v0), v1, left, right, low, high, entrance)


def _wall(
    rng: np.random.Generator,
    plan: HousePlan,
    width_m: float,
    colour: Doubles,
    kind: Material,
    frame: Doubles,
    *,
    door: bool,
) -> Mesh:
    """A wall in the plane y = 0, seen from y < 0, of bays with a window each."""
    of = _openings(rng, plan, width_m, door=door)
    u0, u1, v0, v1, left, right, low, high = of.u0, of.u1, of.v0, of.v1, of.left, of.right, of.low, of.high
    entrance = of.entrance
    zero, deep = np.zeros_like(u0), np.full_like(u0, REVEAL_M)

    walls = np.concatenate([
        _faces((u0, zero, v0), (u1, zero, v0), (u1, zero, low), (u0, zero, low)),
        _faces((u0, zero, high), (u1, zero, high), (u1, zero, v1), (u0, zero, v1)),
        _faces((u0, zero, low), (left, zero, low), (left, zero, high), (u0, zero, high)),
        _faces((right, zero, low), (u1, zero, low), (u1, zero, high), (right, zero, high)),
    ])  # fmt: skip
    reveals = np.concatenate([
        _faces((left, zero, low), (right, zero, low), (right, deep, low), (left, deep, low)),
        _faces((left, zero, high), (right, zero, high), (right, deep, high), (left, deep, high)),
        _faces((left, zero, low), (left, deep, low), (left, deep, high), (left, zero, high)),
        _faces((right, zero, low), (right, deep, low), (right, deep, high), (right, zero, high)),
    ])  # fmt: skip
    panes = _faces((left, deep, low), (right, deep, low), (right, deep, high), (left, deep, high))
    shade = rng.uniform(0.02, 0.12, (len(u0), 1)) * np.array([1.1, 1.0, 0.95])
    curtained = rng.random(len(u0)) < 0.25
    shade[curtained] = np.array([0.42, 0.45, 0.47]) * rng.uniform(0.6, 1.2)
    leaf = np.asarray(WALL_COLOURS[rng.integers(len(WALL_COLOURS))]) * 0.5
    slim, wide = (left + right) / 2 - 0.04, (left + right) / 2 + 0.04
    near = np.full_like(u0, REVEAL_M - 0.04)
    bars = np.concatenate([
        _faces((slim, near, low), (wide, near, low), (wide, near, high), (slim, near, high)),
        _faces((left, near, low), (right, near, low), (right, near, low + 0.07), (left, near, low + 0.07)),
        _faces((left, near, high - 0.07), (right, near, high - 0.07), (right, near, high), (left, near, high)),
        _faces((left, near, low), (left + 0.07, near, low), (left + 0.07, near, high), (left, near, high)),
        _faces((right - 0.07, near, low), (right, near, low), (right, near, high), (right - 0.07, near, high)),
    ])  # fmt: skip
    out = np.full_like(u0, -0.08)
    sills = np.concatenate([
        _faces((left, out, low), (right, out, low), (right, zero, low), (left, zero, low)),
        _faces((left, out, low - 0.06), (right, out, low - 0.06), (right, out, low), (left, out, low)),
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


def _faces(*corners: tuple[Floating, Floating, Floating]) -> Floating:
    """(N, 4, 3) from the coordinates (N,) of four corners."""
    return np.array(corners).transpose(2, 0, 1)


def _turned(mesh: Mesh, at_m: tuple[float, float], angle_rad: float) -> Mesh:
    return mesh.placed(at_m[0], at_m[1], 0.0, angle_rad)


def _roof(rng: np.random.Generator, plan: HousePlan, colour: Doubles, wall: Material) -> Mesh:
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


def _balconies(rng: np.random.Generator, plan: HousePlan, frame: Doubles) -> Mesh:
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


STRETCH_M = 48.0
GROUND_STEP_M = 3.0
GROUND_HALF_M = 60.0
"""The ground reaches this far to each side: less than the tightest radius of the road."""
KERB_M, KERB_WIDTH_M = 0.12, 0.15
MOUTH_M = 9.0
"""Width of a side street where it opens."""
MEADOW = (0.09, 0.23, 0.16)
"""Colour of the ground beside an open road."""
NO_PASSAGES = Passages()
BACKDROP_M, BACKDROP_DOWN_M = 500.0, 3.0
"""A plane below everything, so that no ray falls through beside the ground."""


@dataclass(frozen=True, slots=True)
class Style:
    """What the streets of one seed have in common."""

    lane_m: float
    parking_m: float
    sidewalk_m: float
    kinds: tuple[float, float, float, float]
    """Shares of row houses, detached houses, blocks of flats, parks."""
    floors: tuple[int, int]
    gabled: float
    trees: float
    parked: float
    mouths: float
    people: float

    @property
    def half_road_m(self) -> float:
        """From the centre line to the kerb."""
        return self.lane_m + self.parking_m

    @property
    def front_m(self) -> float:
        """From the centre line to the outer edge of the sidewalk."""
        return self.half_road_m + KERB_WIDTH_M + self.sidewalk_m


def sample_style(seed: int) -> Style:
    """The style of a seed."""
    rng = np.random.default_rng([seed, 101])
    low = int(rng.integers(1, 4))
    shares = rng.dirichlet([1.2, 1.6, 0.9, 0.5])
    return Style(
        lane_m=float(rng.uniform(2.9, 3.6)),
        parking_m=float(rng.choice([0.0, 2.2], p=[0.3, 0.7])),
        sidewalk_m=float(rng.uniform(1.6, 3.4)),
        kinds=(float(shares[0]), float(shares[1]), float(shares[2]), float(shares[3])),
        floors=(low, low + int(rng.integers(1, 3))),
        gabled=float(rng.uniform(0.2, 1.0)),
        trees=float(rng.uniform(0.2, 1.0)),
        parked=float(rng.uniform(0.2, 0.8)),
        mouths=float(rng.uniform(0.15, 0.5)),
        people=float(rng.uniform(0.5, 3.0)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """One stretch; its mesh and `lamps_m` (L, 3), its street lamps, are relative to `origin_m` (3,), so that float32
    stays exact far along the road."""

    origin_m: Doubles
    mesh: Mesh
    lamps_m: Doubles


def build_stretch(seed: int, index: int, road: Road, style: Style, passages: Passages = NO_PASSAGES) -> Stretch:
    """Stretch `index`, from `index * STRETCH_M` on. Passages remove objects, but do not change the random draws."""
    rng = np.random.default_rng([seed, 102, index + 2**20])
    begin_m, end_m = index * STRETCH_M, (index + 1) * STRETCH_M
    site = Site(road, begin_m, passages.empty())
    bare = any(span.part(begin_m, end_m) for span in passages.cleared())
    _road(rng, site, style)
    for side in (1.0, -1.0):
        mouth = bool(rng.random() < style.mouths)
        _ground(rng, site, style, side, mouth, bare)
        _row(rng, site, style, side, MOUTH_M if mouth else 0.0)
        _furniture(rng, site, style, side, MOUTH_M + 2.0 if mouth else 0.0)
    for span in passages.tunnels:
        if part := span.part(begin_m, end_m):
            dig(site, span, part, style.lane_m)
    return Stretch(site.origin_m, join(site.meshes), np.array(site.lamps_m).reshape(-1, 3))


def backdrop() -> Mesh:
    """A wide plane below the ground, around the origin."""
    r, z = BACKDROP_M, -BACKDROP_DOWN_M
    return quads([[-r, -r, z], [r, -r, z], [r, r, z], [-r, r, z]], (0.10, 0.20, 0.17), Material.GRASS)


def _road(rng: np.random.Generator, site: Site, style: Style) -> None:
    s = np.arange(0.0, STRETCH_M + 1e-6, GROUND_STEP_M)
    grey = np.array([0.19, 0.19, 0.19]) * rng.uniform(0.75, 1.25)
    half = style.half_road_m
    site.meshes.append(quads(site.strip(s, (-half, half), (0.0, 0.0)), grey, Material.ASPHALT))
    for _ in range(rng.integers(0, 5)):  # mended places, manholes
        at, left = rng.uniform(0, STRETCH_M - 6), rng.uniform(-half + 0.5, half - 2.5)
        span, wide = rng.uniform(0.6, 6.0), rng.uniform(0.6, 2.0)
        patch = site.strip(np.array([at, at + span]), (left, left + wide), (0.004, 0.004))
        site.meshes.append(quads(patch, grey * rng.uniform(0.5, 1.3), Material.ASPHALT))
    white = (0.72, 0.74, 0.74)
    for at in np.arange(0.0, STRETCH_M, 9.0):
        dash = site.strip(np.array([at, at + 1.5, at + 3.0]), (-0.07, 0.07), (0.008, 0.008))
        site.meshes.append(quads(dash, white, Material.MARKING))
    for side in (-1.0, 1.0):
        inner = side * (style.lane_m - (0.0 if style.parking_m else 0.25))
        line = site.strip(s, (inner, inner + side * 0.1), (0.008, 0.008))
        site.meshes.append(quads(line, white, Material.MARKING))
    if rng.random() < 0.3:  # a zebra crossing
        at = rng.uniform(10.0, STRETCH_M - 6.0)
        for left in np.arange(-half + 0.3, half - 0.5, 1.0):
            bar = site.strip(np.array([at, at + 3.0]), (left, left + 0.5), (0.01, 0.01))
            site.meshes.append(quads(bar, white, Material.MARKING))


def _ground(rng: np.random.Generator, site: Site, style: Style, side: float, mouth: bool, bare: bool) -> None:
    """The ground beside the road: kerb, sidewalk and yards, or where `bare` a meadow up to the asphalt."""
    half, front = style.half_road_m, style.front_m
    kerb, up = np.array([0.42, 0.43, 0.43]) * rng.uniform(0.8, 1.2), KERB_M
    paving = np.array([0.34, 0.36, 0.37]) * rng.uniform(0.7, 1.3)
    green = bool(rng.random() < 0.6)
    yard = np.array([0.09, 0.24, 0.16]) * rng.uniform(0.7, 1.3) if green else paving * 0.9
    asphalt = np.array([0.17, 0.17, 0.17])
    s = np.arange(0.0, STRETCH_M + 1e-6, GROUND_STEP_M)
    if bare:
        site.meshes.append(
            quads(site.strip(s, (side * half, side * GROUND_HALF_M), (0.0, 0.0)), MEADOW, Material.GRASS)
        )
        return
    parts = [(s[s >= MOUTH_M], kerb, paving, yard, Material.GRASS if green else Material.PAVING)] if mouth else []
    if mouth:
        opening = s[s <= MOUTH_M]
        parts.append((opening, asphalt, asphalt, asphalt, Material.ASPHALT))
    else:
        parts.append((s, kerb, paving, yard, Material.GRASS if green else Material.PAVING))
    for place, edge, walk, beyond, kind in parts:
        opened = kind is Material.ASPHALT
        rise = quads(site.strip(place, (side * half, side * half), (0.0, up)), edge, Material.CONCRETE)
        top = site.strip(place, (side * half, side * (half + KERB_WIDTH_M)), (up, up))
        flat = site.strip(place, (side * (half + KERB_WIDTH_M), side * front), (up, up))
        outer = site.strip(place, (side * front, side * GROUND_HALF_M), (up, up))
        site.meshes += [
            rise,
            quads(top, edge, Material.CONCRETE),
            quads(flat, walk, Material.ASPHALT if opened else Material.PAVING),
            quads(outer, beyond, kind),
        ]


def _row(rng: np.random.Generator, site: Site, style: Style, side: float, begin_m: float) -> None:
    """The buildings of one side, none beyond the end of the stretch, and what stands before and behind them."""
    kind = int(rng.choice(4, p=np.asarray(style.kinds) / np.sum(style.kinds)))
    at = begin_m + rng.uniform(0.0, 1.0)
    setback = (rng.uniform(0.0, 3.5), rng.uniform(3.5, 8.0), rng.uniform(2.0, 9.0), 0.0)[kind]
    shop = bool(kind == 0 and setback < 1.5 and rng.random() < 0.6)
    while kind != 3:
        plan = _plan(rng, style, kind, shop)
        if at + plan.width_m > STRETCH_M:
            break
        _stand(rng, site, plan, side, at, style.front_m + setback + rng.uniform(0, (0.0, 1.5, 1.0)[kind] + 1e-9))
        at += plan.width_m + (0.0 if kind == 0 and rng.random() < 0.8 else rng.uniform(2.0, 8.0))
    far = style.front_m + (20.0 if kind == 3 else setback + 24.0)
    at = begin_m + rng.uniform(0, 6)
    while far < 46.0:  # a second row shows through the gaps
        plan = _plan(rng, style, 1, False)
        if at + plan.width_m > STRETCH_M:
            break
        _stand(rng, site, plan, side, at, far)
        at += plan.width_m + rng.uniform(2.0, 12.0)
    trees = int(rng.poisson(style.trees * (10 if kind == 3 else 3)))
    for _ in range(trees):
        low = style.front_m + 2.0 if kind == 3 else style.front_m + setback + 14.0
        site.put(props.tree(rng), rng.uniform(begin_m + 2, STRETCH_M - 1), side * rng.uniform(low, low + 16), 0.0)
    if (kind != 0 and setback > 3.0) or kind == 3:
        _border(rng, site, style, side, begin_m)
    if setback > 3.0:
        for _ in range(rng.integers(0, 7)):
            place = rng.uniform(begin_m + 1, STRETCH_M - 1), side * rng.uniform(style.front_m + 0.8, style.front_m + 3)
            mesh = props.tree(rng) if rng.random() < 0.25 * style.trees else props.bush(rng)
            site.put(mesh, *place, up_m=KERB_M)


def _plan(rng: np.random.Generator, style: Style, kind: int, shop: bool) -> HousePlan:
    floors = int(rng.integers(style.floors[0], style.floors[1] + 1))
    width = (rng.uniform(6, 14), rng.uniform(8, 14), rng.uniform(16, 30))[kind]
    return HousePlan(
        width_m=float(width),
        depth_m=float(rng.uniform(8, 13)),
        floors=(max(floors, 2), min(floors, 2), floors + int(rng.integers(1, 4)))[kind],
        floor_m=float(rng.uniform(2.7, 3.4)),
        bay_m=float(rng.uniform(2.0, 3.6)),
        gabled=bool(kind != 2 and rng.random() < style.gabled),
        shop=shop,
    )


def _stand(rng: np.random.Generator, site: Site, plan: HousePlan, side: float, at_m: float, front_m: float) -> None:
    mesh = house(rng, plan)
    half = plan.width_m / 2
    centred = Mesh(mesh.corners_m - np.array([half, 0, 0], dtype=np.float32), mesh.colour, mesh.material)
    site.put(centred, at_m + half, side * front_m, 0.0 if side > 0 else np.pi, KERB_M)


def _border(rng: np.random.Generator, site: Site, style: Style, side: float, begin_m: float) -> None:
    """Hedges and fences between gardens and sidewalk, with gaps for gates."""
    at = begin_m + 0.5
    while at < STRETCH_M - 4.0:
        length = float(min(rng.uniform(4.0, 12.0), STRETCH_M - 0.5 - at))
        choice = rng.random()
        if choice < 0.8:
            mesh = props.hedge(rng, length) if choice < 0.4 else props.fence(rng, length)
            centred = Mesh(mesh.corners_m - np.array([length / 2, 0, 0], np.float32), mesh.colour, mesh.material)
            site.put(centred, at + length / 2, side * (style.front_m + 0.5), 0.0, KERB_M)
        at += length + rng.uniform(1.0, 3.0)


def _furniture(rng: np.random.Generator, site: Site, style: Style, side: float, begin_m: float) -> None:
    """Parked cars, lamps, street trees, signs and people of one side."""
    half = style.half_road_m
    if style.parking_m:
        at = begin_m + 3.5
        while at < STRETCH_M - 3.0:
            if rng.random() < style.parked:
                along = 0.0 if side < 0 else np.pi
                site.put(props.car(rng), at, side * (half - 1.08 + rng.normal(0, 0.06)), along + rng.normal(0, 0.015))
            at += rng.uniform(5.8, 7.2)
    walk = half + KERB_WIDTH_M
    turn = 0.0 if side < 0 else np.pi
    for at in np.arange(begin_m + rng.uniform(1, 12), STRETCH_M, rng.uniform(18, 30)):
        site.put_lamp(props.lamp(rng), float(at), side * (walk + 0.35), turn, KERB_M)
    if rng.random() < style.trees:
        for at in np.arange(begin_m + rng.uniform(3, 9), STRETCH_M - 1, rng.uniform(7, 14)):
            site.put(props.broadleaf(rng), float(at), side * (walk + 0.55), 0.0, KERB_M)
    for _ in range(rng.poisson(1.0)):
        site.put(
            props.sign(rng), rng.uniform(begin_m, STRETCH_M), side * (walk + 0.3), turn + rng.normal(0, 0.1), KERB_M
        )
    for _ in range(rng.poisson(1.5)):
        site.put(props.clutter(rng), rng.uniform(begin_m, STRETCH_M), side * (style.front_m - 0.4), turn, KERB_M)
    for _ in range(rng.poisson(style.people)):
        left = rng.uniform(walk + 0.7, style.front_m - 0.3)
        site.put(props.person(rng), rng.uniform(begin_m, STRETCH_M), side * left, rng.choice([0.0, np.pi]), KERB_M)
