"""A motorway: two lanes each way with markings, rails, posts and signs; now and then a gantry, a bridge, a barrier
against noise, trees; and the vehicles on it.
"""

import numpy as np
from numpy.typing import NDArray

from coec_lab.simulation import props
from coec_lab.simulation.mesh import Colour, Material, Mesh, box, join, quads, tube
from coec_lab.simulation.passages import Site

Doubles = NDArray[np.float64]
Sheet = tuple[Doubles, Colour]
"""Corners (1, 4, 3) and colour."""

MEDIAN_M, LANE_M, SHOULDER_M = 1.5, 3.75, 2.5
"""Half the median, the width of a lane (two each way) and of the hard shoulder: German motorways (RAA 2008)."""
OUTER_M = MEDIAN_M + 2 * LANE_M + SHOULDER_M
OWN_LEFT_M, FAST_LEFT_M = -(MEDIAN_M + 1.5 * LANE_M), -(MEDIAN_M + 0.5 * LANE_M)
"""Middle of the right lane, and of the left one, in which others overtake."""
RAIL_LOW_M, RAIL_HIGH_M, POSTS_M = 0.45, 0.78, 4.0
GROUND_HALF_M = 60.0
STEP_M = 3.0
DELINEATORS_M = 50.0
REGION = 6
"""Barriers and rows of trees are as long as so many stretches."""
BARRIER_M, PANEL_M = OUTER_M + 2.6, 4.0
"""Where barriers stand, and the length of their panels."""
GANTRIES, BOARDS, BRIDGES, ARROWS = 0.08, 0.2, 0.05, 0.1
"""Share of the stretches with a gantry, a large sign beside the road, a bridge across, and arrows on the lanes."""
CLEARANCE_M = 5.2
"""Height of the lowest sign over the road."""
STEEL: Colour = (0.45, 0.46, 0.46)
WHITE: Colour = (0.72, 0.74, 0.74)
SHEET: Colour = (0.80, 0.80, 0.80)
BOARD_COLOURS: tuple[Colour, ...] = ((0.45, 0.18, 0.04), (0.12, 0.30, 0.03), (0.80, 0.80, 0.80))
"""Ground of large signs: blue, green, or white with black print."""


def furnish(rng: np.random.Generator, site: Site, length_m: float, seed: int) -> None:
    """Adds a stretch of motorway."""
    more = rng.spawn(1)[0]
    s = np.arange(0.0, length_m + 1e-6, STEP_M)
    grey = np.array([0.19, 0.19, 0.19]) * rng.uniform(0.9, 1.1)
    site.meshes.append(quads(site.strip(s, (-OUTER_M, OUTER_M), (0.0, 0.0)), grey, Material.ASPHALT))
    for side in (-1.0, 1.0):
        meadow = site.strip(s, (side * OUTER_M, side * GROUND_HALF_M), (-0.05, -0.05))
        site.meshes.append(quads(meadow, np.array([0.09, 0.23, 0.16]) * rng.uniform(0.8, 1.2), Material.GRASS))
        for left in (MEDIAN_M + 0.2, OUTER_M - SHOULDER_M):
            line = site.strip(s, (side * left, side * (left + 0.15)), (0.008, 0.008))
            site.meshes.append(quads(line, WHITE, Material.BEADED))
        for at in np.arange(0.0, length_m, 18.0):
            middle = side * (MEDIAN_M + LANE_M)
            dash = site.strip(np.array([at, at + 3.0, at + 6.0]), (middle - 0.07, middle + 0.07), (0.008, 0.008))
            site.meshes.append(quads(dash, WHITE, Material.BEADED))
        _rail(site, s, side * (OUTER_M + 0.6), length_m)
        if rng.random() < length_m / DELINEATORS_M:
            site.put(_delineator(side), rng.uniform(0, length_m), side * (OUTER_M + 0.3))
        for _ in range(int(rng.poisson(0.5))):
            mesh = props.tree(rng) if rng.random() < 0.4 else props.bush(rng)
            site.put(mesh, rng.uniform(1, length_m - 1), side * rng.uniform(OUTER_M + 6, 50.0))
        if rng.random() < 0.12:
            site.put(props.sign(rng), rng.uniform(1, length_m - 1), side * (OUTER_M + 1.8), 0.0 if side < 0 else np.pi)
    _rail(site, s, 0.0, length_m)
    _worn(more, site, s, grey)
    for side in (-1.0, 1.0):
        _roadside(more, site, length_m, side, seed)
    _across(more, site, length_m)


def _rail(site: Site, s: Doubles, left_m: float, length_m: float) -> None:
    site.meshes.append(quads(site.strip(s, (left_m, left_m), (RAIL_LOW_M, RAIL_HIGH_M)), STEEL, Material.STEEL))
    post = box([-0.05, -0.06, -0.2], [0.05, 0.06, RAIL_HIGH_M - 0.03], STEEL, Material.STEEL)
    for at in np.arange(POSTS_M / 2, length_m, POSTS_M):
        site.put(post, float(at), left_m)


def _delineator(facing: float) -> Mesh:
    """A post with a black band and a reflector that faces x (1) or against it (-1)."""
    front = facing * 0.058
    reflector = [[front, -0.025, 0.72], [front, 0.025, 0.72], [front, 0.025, 0.90], [front, -0.025, 0.90]]
    return join(
        [
            box([-0.05, -0.05, -0.1], [0.05, 0.05, 1.05], SHEET, Material.PAINT),
            box([-0.055, -0.055, 0.68], [0.055, 0.055, 0.94], (0.03, 0.03, 0.03), Material.PAINT),
            quads([reflector], SHEET, Material.RETRO),
        ]
    )


def _worn(rng: np.random.Generator, site: Site, s: Doubles, grey: Doubles) -> None:
    """Mended places, sealed joints and arrows."""
    length_m = float(s[-1])
    for side in (-1.0, 1.0):
        seal = side * (MEDIAN_M + LANE_M + 0.2)
        site.meshes.append(
            quads(site.strip(s, (seal, seal + side * 0.08), (0.004, 0.004)), grey * 0.45, Material.ASPHALT)
        )
        for _ in range(int(rng.poisson(0.6))):
            at, long = rng.uniform(0, length_m - 13), rng.uniform(2.0, 12.0)
            low = MEDIAN_M + 0.3 + LANE_M * rng.integers(2)
            place = site.strip(np.linspace(at, at + long, 4), (side * low, side * (low + 3.2)), (0.003, 0.003))
            site.meshes.append(quads(place, grey * rng.uniform(0.55, 1.35), Material.ASPHALT))
    if rng.random() < ARROWS:
        at = rng.uniform(2.0, length_m - 8.0)
        for left in (OWN_LEFT_M, FAST_LEFT_M, -OWN_LEFT_M, -FAST_LEFT_M):
            shaft = site.strip(np.array([at, at + 3.5]), (left - 0.08, left + 0.08), (0.01, 0.01))
            tip = site.strip(np.array([at + 3.5, at + 5.0]), (left - 0.35, left + 0.35), (0.01, 0.01))
            tip[:, 1:3] = tip[:, 1:3].mean(axis=1, keepdims=True)
            site.meshes += [quads(shaft, WHITE, Material.BEADED), quads(tip, WHITE, Material.BEADED)]


def _roadside(rng: np.random.Generator, site: Site, length_m: float, side: float, seed: int) -> None:
    """Barriers, trees, large signs and emergency telephones of one side."""
    region = round(site.begin_m / length_m) // REGION
    kind = np.random.default_rng([seed, 110, region + 2**20, int(side > 0)]).random()
    if kind < 0.25:
        _barrier(rng, site, length_m, side, seed)
    elif kind < 0.5:
        for _ in range(6):
            site.put(props.tree(rng), rng.uniform(1, length_m - 1), side * rng.uniform(OUTER_M + 7, OUTER_M + 16))
    turn = 0.0 if side < 0 else np.pi
    if rng.random() < BOARDS and kind >= 0.25:
        wide, high = rng.uniform(2.0, 3.6), rng.uniform(1.6, 3.0)
        panel = board(rng, wide, high).placed(0, 0, 1.8, 0)
        posts = [tube([0.05, y, -0.3], [0.05, y, 1.8 + high], 0.07, 8, STEEL, Material.STEEL)
                 for y in (-0.3 * wide, 0.3 * wide)]  # fmt: skip
        site.put(join([panel, *posts]), rng.uniform(3, length_m - 3), side * (OUTER_M + 2.2 + wide / 2), turn)
    if rng.random() < 0.04:
        phone = box([-0.25, -0.25, -0.1], [0.25, 0.25, 1.6], (0.02, 0.35, 0.75), Material.PAINT)
        site.put(phone, rng.uniform(2, length_m - 2), side * (OUTER_M + 1.2))


def _barrier(rng: np.random.Generator, site: Site, length_m: float, side: float, seed: int) -> None:
    """A wall of panels between posts. Its panels differ a little, as the wood and concrete of real ones do."""
    kinds = np.random.default_rng([seed, 111])
    high = float(kinds.uniform(2.5, 4.5))
    colour, other = kinds.uniform(0.15, 0.6, 3), kinds.uniform(0.15, 0.6, 3)
    material = Material.CONCRETE if kinds.random() < 0.5 else Material.PAINT
    post = box([-0.1, -0.12, -0.3], [0.1, 0.12, high + 0.1], STEEL, Material.STEEL)
    for at in np.arange(0.0, length_m - 1e-6, PANEL_M):
        place = np.array([at, at + PANEL_M])
        tint = rng.uniform(0.75, 1.15) * (other if rng.random() < 0.25 else colour)
        low = site.strip(place, (side * BARRIER_M, side * BARRIER_M), (-0.3, 0.5))
        wall = site.strip(place, (side * BARRIER_M, side * BARRIER_M), (0.5, high))
        site.meshes += [quads(low, (0.4, 0.41, 0.41), Material.CONCRETE), quads(wall, tint, material)]
        site.put(post, float(at), side * BARRIER_M)


def _across(rng: np.random.Generator, site: Site, length_m: float) -> None:
    """A gantry or a bridge over the road."""
    chance = rng.random()
    at = float(rng.uniform(8, length_m - 8))
    if chance < GANTRIES:
        high, reach = CLEARANCE_M + 2.6, OUTER_M + 1.2
        parts = [
            box([-0.2, side * reach - 0.2, -0.3], [0.2, side * reach + 0.2, high], STEEL, Material.STEEL)
            for side in (-1, 0, 1)
        ]
        for low in (high - 0.9, high - 0.2):
            parts.append(box([-0.12, -reach, low], [0.12, reach, low + 0.2], STEEL, Material.STEEL))
        for middle in (OWN_LEFT_M, FAST_LEFT_M, -OWN_LEFT_M, -FAST_LEFT_M):
            if rng.random() < 0.75:
                panel = board(rng, rng.uniform(2.4, 3.5), rng.uniform(1.6, 2.4))
                ours = middle < 0
                parts.append(panel.placed(-0.25 if ours else 0.25, middle, CLEARANCE_M, 0.0 if ours else np.pi))
        site.put(join(parts), at, 0.0)
    elif chance < GANTRIES + BRIDGES:
        grey, half = np.full(3, rng.uniform(0.3, 0.5)), rng.uniform(3.0, 6.0)
        rail = box([-half, -45, 6.4], [-half + 0.1, 45, 7.4], STEEL, Material.STEEL)
        under = [[-half, -45, 5.2], [half, -45, 5.2], [half, 45, 5.2], [-half, 45, 5.2]]
        parts = [box([-half, -45, 5.2], [half, 45, 6.4], grey, Material.CONCRETE), rail]
        parts += [quads([under], grey * 0.9, Material.CONCRETE), rail.placed(2 * half - 0.1, 0, 0, 0)]
        for y in (-(OUTER_M + 2.5), 0.0, OUTER_M + 2.5):
            parts.append(box([-half + 0.5, y - 0.4, -0.3], [half - 0.5, y + 0.4, 5.2], grey, Material.CONCRETE))
        site.put(join(parts), at, 0.0)


def board(rng: np.random.Generator, wide_m: float, high_m: float) -> Mesh:
    """A large sign of retro-reflective sheeting with rows of print, in the plane x = 0, seen from x < 0; z from 0."""
    ground = BOARD_COLOURS[rng.choice(3, p=[0.6, 0.1, 0.3])]
    ink = (0.03, 0.03, 0.03) if ground == SHEET else SHEET
    half = wide_m / 2
    edge = 0.06
    sheets = [_sheet(0.0, -half, half, 0.0, high_m, ink), _sheet(-0.01, edge - half, half - edge, edge, high_m - edge,
                                                                 ground)]  # fmt: skip
    letter = min(0.42, 0.2 * high_m)
    for row in np.arange(high_m - 2.0 * letter, letter, -1.7 * letter):
        begin = half - 0.25 - rng.uniform(0, 0.4)
        for place in np.arange(begin, -half + 0.25 + rng.uniform(0, 0.4 * wide_m), -0.75 * letter):
            if rng.random() < 0.85:
                sheets += _letter(rng, float(place), float(row), letter, ink)
    return quads(np.concatenate([s[0] for s in sheets]), np.array([s[1] for s in sheets]), Material.RETRO)


def _sheet(x_m: float, right_m: float, left_m: float, low_m: float, high_m: float, colour: Colour) -> Sheet:
    corners = [[x_m, right_m, low_m], [x_m, left_m, low_m], [x_m, left_m, high_m], [x_m, right_m, high_m]]
    return np.array([corners]), colour


def _letter(rng: np.random.Generator, left_m: float, low_m: float, size_m: float, ink: Colour) -> list[Sheet]:
    """Some of the strokes of a letter."""
    wide, stroke = 0.5 * size_m, 0.17 * size_m
    strokes = [(0.0, stroke, 0.0, size_m), (wide - stroke, wide, 0.0, size_m)]
    strokes += [(0.0, wide, up, up + stroke) for up in (0.0, (size_m - stroke) / 2, size_m - stroke)]
    visible = [one for one in strokes if rng.random() < 0.65]
    return [_sheet(-0.02, left_m - b, left_m - a, low_m + low, low_m + up, ink) for a, b, low, up in visible]


def vehicle(rng: np.random.Generator) -> Mesh:
    """A car, or an articulated lorry, with its lights on."""
    if rng.random() < 0.3:
        return _articulated(rng)
    car = props.car(rng)
    front, back = float(car.corners_m[:, :, 0].max()), float(car.corners_m[:, :, 0].min())
    half = float(np.abs(car.corners_m[:, :, 1]).max()) - 0.2
    parts = [car]
    for y in (-half + 0.1, half - 0.35):
        parts.append(_lamp(front + 0.01, y, 0.58, 0.14, (1.0, 1.0, 1.0)))
        parts.append(_lamp(back - 0.01, y, 0.78, 0.12, (0.02, 0.03, 0.6)))
    return join(parts)


def _lamp(x_m: float, y_m: float, low_m: float, high_m: float, colour: Colour) -> Mesh:
    corners = [
        [x_m, y_m, low_m],
        [x_m, y_m + 0.25, low_m],
        [x_m, y_m + 0.25, low_m + high_m],
        [x_m, y_m, low_m + high_m],
    ]
    return quads([corners], colour, Material.LIT)


def _articulated(rng: np.random.Generator) -> Mesh:
    """A lorry of 16 m: its trailer has print on its sides, contour marking along its edges, and doors behind."""
    paint = np.asarray(props.LACQUERS[rng.integers(len(props.LACQUERS))])
    load, print_colour = rng.uniform(0.3, 0.8, 3), rng.uniform(0.02, 0.6, 3)
    front, back, half, top, floor = 8.2, -8.2, 1.26, 3.95, 1.15
    nose, join_m = front - 2.2, front - 2.8
    parts = [
        box([nose, -half, 0.45], [front, half, 3.4], paint, Material.LACQUER),
        box([back, -half, floor], [join_m, half, top], load, Material.PAINT),
        box([back + 0.3, -0.5, 0.5], [nose, 0.5, floor], (0.05, 0.05, 0.05), Material.PAINT),
    ]
    x = front + 0.01
    screen = [[x, -half + 0.1, 1.7], [x, half - 0.1, 1.7], [x, half - 0.1, 2.6], [x, -half + 0.1, 2.6]]
    parts.append(quads([screen], (0.05, 0.05, 0.04), Material.GLASS))
    for x in (front - 1.3, join_m - 1.2, back + 2.0, back + 3.3, back + 4.6):
        for side in (-1.0, 1.0):
            y = side * (half - 0.35)
            parts.append(tube([x, y, 0.5], [x, side * half, 0.5], 0.5, 12, (0.03, 0.03, 0.03), Material.RUBBER))
    for side in (-1.0, 1.0):
        y = side * (half + 0.01)
        for low, high in ((floor + 0.02, floor + 0.07), (top - 0.07, top - 0.02)):
            tape = [[back, y, low], [join_m, y, low], [join_m, y, high], [back, y, high]]
            parts.append(quads([tape], SHEET, Material.RETRO))
        for _ in range(int(rng.integers(1, 4))):
            begin, low = rng.uniform(back + 0.5, join_m - 4), rng.uniform(floor + 0.3, top - 1.4)
            end, up = begin + rng.uniform(1.0, 3.5), low + rng.uniform(0.4, 1.1)
            patch = [[begin, y, low], [end, y, low], [end, y, up], [begin, y, up]]
            parts.append(quads([patch], print_colour, Material.PAINT))
    x = back - 0.01
    for y in (-half + 0.04, -0.03, half - 0.09):
        seam = [[x, y, floor], [x, y + 0.05, floor], [x, y + 0.05, top], [x, y, top]]
        parts.append(quads([seam], (0.1, 0.1, 0.1) if y == -0.03 else SHEET, Material.PAINT if y == -0.03 else
                           Material.RETRO))  # fmt: skip
    parts.append(box([back, -half, 0.45], [back + 0.1, half, 0.6], SHEET, Material.SIGN))
    for y in (-half + 0.15, half - 0.4):
        parts += [
            _lamp(back - 0.02, y, 0.7, 0.14, (0.02, 0.03, 0.6)),
            _lamp(front + 0.02, y, 0.7, 0.16, (1.0, 1.0, 1.0)),
        ]
    plate = [[x, -0.26, 0.75], [x, 0.26, 0.75], [x, 0.26, 0.86], [x, -0.26, 0.86]]
    return join([*parts, quads([plate], SHEET, Material.SIGN)])
