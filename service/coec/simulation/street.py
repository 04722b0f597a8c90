"""Stretches of street along a road: ground, kerbs, marks, houses, gardens, parked cars, trees, lamps, signs, people.

Every stretch follows from the seed and its number alone, so a drive of any length needs only those around the vehicle.
Traffic keeps to the right; `left_m` counts from the centre line; sidewalks begin beyond `Style.half_road_m`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.simulation import props
from coec.simulation.buildings import HousePlan, house
from coec.simulation.mesh import Material, Mesh, join, quads
from coec.simulation.passages import Passages
from coec.simulation.road import Road
from coec.simulation.site import Site
from coec.simulation.tunnel import dig

Doubles = NDArray[np.float64]

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
    """One stretch; its mesh is relative to `origin_m` (3,), so that float32 stays exact far along the road."""

    origin_m: Doubles
    mesh: Mesh


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
    return Stretch(site.origin_m, join(site.meshes))


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
        site.put(props.lamp(rng), float(at), side * (walk + 0.35), turn, KERB_M)
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
