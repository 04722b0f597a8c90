"""What stands and drives in a street: cars, trees, hedges, lamps, signs, people.

Local frames: x forward (cars) or along the street, y left, z up, origin on the ground in the middle.
"""

import numpy as np
from numpy.typing import NDArray

from coec_lab.simulation.mesh import (
    Colour,
    Material,
    Mesh,
    ball,
    box,
    circle,
    join,
    prism,
    quads,
    solid,
    triangles,
    tube,
)

Doubles = NDArray[np.float64]

LACQUERS: tuple[Colour, ...] = (
    (0.75, 0.76, 0.77), (0.03, 0.03, 0.03), (0.35, 0.36, 0.37), (0.10, 0.09, 0.45), (0.40, 0.16, 0.06),
    (0.62, 0.62, 0.60), (0.12, 0.14, 0.14), (0.22, 0.28, 0.06), (0.12, 0.52, 0.66), (0.55, 0.35, 0.16),
)  # fmt: skip
GREY: Colour = (0.35, 0.36, 0.36)


def car(rng: np.random.Generator) -> Mesh:
    """A saloon, hatchback, estate, van or small lorry."""
    kind = rng.choice(5, p=[0.3, 0.3, 0.15, 0.17, 0.08])
    paint = np.asarray(LACQUERS[rng.integers(len(LACQUERS))]) * rng.uniform(0.8, 1.15)
    if kind == 4:
        return _lorry(rng, paint)
    length = (rng.uniform(4.4, 4.9), rng.uniform(3.7, 4.3), rng.uniform(4.5, 4.9), rng.uniform(4.8, 5.6))[kind]
    half = (0.9, 0.86, 0.91, 0.98)[kind] * rng.uniform(0.97, 1.03)
    top = (1.45, 1.48, 1.50, 2.1)[kind] * rng.uniform(0.96, 1.05)
    belt = (0.92, 0.92, 0.93, 1.15)[kind]
    # x of bonnet end, windscreen top, roof end, rear window foot, as shares of the length from the front.
    bonnet, screen, roof, rear = ((0.28, 0.42, 0.70, 0.84), (0.27, 0.40, 0.86, 0.97), (0.27, 0.40, 0.92, 0.985),
                                  (0.14, 0.26, 0.96, 0.99))[kind]  # fmt: skip
    front, back = length / 2, -length / 2
    nose = belt - (0.22 if kind != 3 else 0.35)
    lower = [(front, 0.35), (front, nose - 0.05), (front - 0.08, nose), (front - bonnet * length, belt)]
    lower += [(front - rear * length, belt), (back + 0.02, belt - 0.08), (back, 0.4)]
    xz = np.asarray(lower)
    parts = [_extruded(xz, half, half, paint, Material.LACQUER)]
    cabin = np.asarray(
        [
            (front - bonnet * length, belt),
            (front - screen * length, top),
            (front - roof * length, top),
            (front - rear * length, belt),
        ]
    )
    inner = half - 0.16
    parts.append(_cabin(cabin, half - 0.03, inner, paint))
    for x in (front - 0.19 * length, back + 0.2 * length):
        for y in (-half + 0.1, half - 0.1):
            out = y + np.sign(y) * 0.11
            parts.append(tube([x, y, 0.32], [x, out, 0.32], 0.32, 14, (0.03, 0.03, 0.03), Material.RUBBER))
            rim = out + np.sign(y) * 0.01
            parts.append(tube([x, y, 0.32], [x, rim, 0.32], 0.2, 10, (0.5, 0.5, 0.5), Material.LACQUER))
    for y in (-half + 0.12, half - 0.42):
        lamp, tail = front + 0.01, back - 0.01
        z = nose - 0.22
        parts.append(
            quads([[[lamp, y, z], [lamp, y + 0.3, z], [lamp, y + 0.3, z + 0.15], [lamp, y, z + 0.15]]],
                  (0.8, 0.8, 0.8), Material.SIGN)
        )  # fmt: skip
        z = belt - 0.3
        parts.append(
            quads([[[tail, y, z], [tail, y + 0.3, z], [tail, y + 0.3, z + 0.2], [tail, y, z + 0.2]]],
                  (0.05, 0.05, 0.5), Material.SIGN)
        )  # fmt: skip
    for x, z in ((front + 0.012, 0.5), (back - 0.012, 0.62)):
        plate = [[x, -0.26, z], [x, 0.26, z], [x, 0.26, z + 0.11], [x, -0.26, z + 0.11]]
        parts.append(quads([plate], (0.8, 0.8, 0.8), Material.SIGN))
    mirror = front - (bonnet + 0.05) * length
    for y in (-half - 0.1, half):
        parts.append(box([mirror, y, belt], [mirror + 0.1, y + 0.1, belt + 0.13], paint, Material.LACQUER))
    return join(parts)


def _extruded(xz_m: Doubles, half_m: float, half_top_m: float, colour: Doubles, kind: Material) -> Mesh:
    """A side profile (K, 2), counter-clockwise or clockwise, drawn out to both sides."""
    right = np.column_stack([xz_m[:, 0], np.full(len(xz_m), -half_m), xz_m[:, 1]])
    left = np.column_stack([xz_m[:, 0], np.full(len(xz_m), half_top_m), xz_m[:, 1]])
    return solid(right, left, colour, kind)


def _cabin(xz_m: Doubles, low_half_m: float, top_half_m: float, paint: Doubles) -> Mesh:
    """Windscreen, roof, rear window and side windows between painted pillars."""
    (x0, z0), (x1, z1), (x2, z2), (x3, z3) = xz_m
    glass = (0.05, 0.045, 0.04)
    parts = [
        quads([[x1, -top_half_m, z1], [x2, -top_half_m, z2], [x2, top_half_m, z2], [x1, top_half_m, z1]],
              paint, Material.LACQUER),
        quads([[x0, -low_half_m, z0], [x0, low_half_m, z0], [x1, top_half_m, z1], [x1, -top_half_m, z1]],
              glass, Material.GLASS),
        quads([[x3, -low_half_m, z3], [x3, low_half_m, z3], [x2, top_half_m, z2], [x2, -top_half_m, z2]],
              glass, Material.GLASS),
    ]  # fmt: skip
    for side in (-1.0, 1.0):
        a, b = side * low_half_m, side * top_half_m
        parts.append(quads([[x0, a, z0], [x3, a, z3], [x2, b, z2], [x1, b, z1]], paint, Material.LACQUER))
        e = side * 0.012
        middle = (x1 + x2) / 2
        for front, rear, foot_front, foot_rear in (
            (x1 - 0.1, middle + 0.04, x0 - 0.35, middle + 0.04),
            (middle - 0.04, x2 + 0.14, middle - 0.04, x3 + 0.35),
        ):
            pane = [[foot_front, a + e, z0 + 0.04], [foot_rear, a + e, z0 + 0.04]]
            pane += [[rear, b + e, z1 - 0.07], [front, b + e, z1 - 0.07]]
            parts.append(quads([pane], glass, Material.GLASS))
    return join(parts)


def _lorry(rng: np.random.Generator, paint: Doubles) -> Mesh:
    length, half, high = rng.uniform(6.5, 9.0), 1.15, rng.uniform(2.9, 3.5)
    front, back = length / 2, -length / 2
    load = np.asarray(LACQUERS[rng.integers(len(LACQUERS))])
    parts = [
        box([front - 1.9, -half, 0.5], [front, half, 2.3], paint, Material.LACQUER),
        box([back, -half, 0.9], [front - 2.1, half, high], load, Material.PAINT),
        box([back, -0.5, 0.5], [front - 1.9, 0.5, 0.9], (0.05, 0.05, 0.05), Material.PAINT),
    ]
    x = front + 0.01
    pane = [[x, -half + 0.1, 1.35], [x, half - 0.1, 1.35], [x, half - 0.1, 2.15], [x, -half + 0.1, 2.15]]
    parts.append(quads([pane], (0.05, 0.05, 0.04), Material.GLASS))
    for x in (front - 0.9, back + 1.1, back + 2.1):
        for y in (-half + 0.05, half - 0.05):
            out = y + np.sign(y) * 0.06
            parts.append(tube([x, y * 0.8, 0.48], [x, out, 0.48], 0.48, 14, (0.03, 0.03, 0.03), Material.RUBBER))
    return join(parts)


def tree(rng: np.random.Generator) -> Mesh:
    """A conifer now and then, else a broad-leaved tree."""
    return conifer(rng) if rng.random() < 0.2 else broadleaf(rng)


def conifer(rng: np.random.Generator) -> Mesh:
    """A trunk and six skirts."""
    height = rng.uniform(5.0, 12.0)
    leaf = np.array([0.06, 0.18, 0.09]) * rng.uniform(0.6, 1.4)
    parts = [tube([0, 0, -1], [0, 0, height * 0.3], 0.16, 7, _bark(rng), Material.BARK)]
    for tier in np.linspace(0.12, 0.85, 6):
        outline = circle((1 - tier) * height * 0.2, 9)
        parts.append(prism(outline, tier * height, (tier + 0.24) * height, leaf, Material.FOLIAGE, taper=0.12))
    return join(parts)


def broadleaf(rng: np.random.Generator) -> Mesh:
    """A trunk, branches and loose leaves."""
    bark = _bark(rng)
    leaf = np.array([0.05, 0.22, 0.12]) * rng.uniform(0.6, 1.5) + np.array([0.0, 0.0, rng.uniform(0, 0.12)])
    height = rng.uniform(5.0, 12.0)
    trunk = rng.uniform(0.25, 0.4) * height
    lean = rng.uniform(-0.25, 0.25, 2)
    thick = 0.025 * height * rng.uniform(0.6, 1.2)
    parts = [tube([0, 0, -1], [*lean, trunk * 1.25], thick, 8, bark, Material.BARK)]
    crown = np.array([0.27, 0.27, 0.36]) * height * rng.uniform(0.75, 1.15, 3)
    centre = np.array([*lean, trunk + 0.75 * crown[2]])
    for _ in range(5):
        end = centre + rng.uniform(-0.6, 0.6, 3) * crown
        parts.append(tube([*lean, trunk], end, thick * 0.4, 5, bark, Material.BARK))
    parts.append(_leaves(rng, centre, crown, int(650 * rng.uniform(0.7, 1.5)), 0.045 * height, leaf))
    return join(parts)


def _bark(rng: np.random.Generator) -> Doubles:
    colour: Doubles = np.array([0.10, 0.14, 0.18]) * rng.uniform(0.7, 1.3)
    return colour


def _leaves(
    rng: np.random.Generator,
    centre_m: Doubles,
    radii_m: Doubles,
    count: int,
    size_m: float,
    colour: Doubles,
) -> Mesh:
    """Triangles strewn through the outer part of an ellipsoid."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    lumps = 1 + 0.18 * np.sin(3.1 * direction[:, :1] + 2.3 * direction[:, 1:2] + 4 * direction[:, 2:])
    middle = centre_m + direction * rng.uniform(0.45, 1.0, (count, 1)) * lumps * radii_m
    corners = middle[:, None] + rng.uniform(-size_m, size_m, (count, 3, 3))
    tint = colour * rng.uniform(0.65, 1.35, (count, 1))
    return triangles(corners, tint, Material.FOLIAGE)


def bush(rng: np.random.Generator) -> Mesh:
    """A shrub of loose leaves."""
    radii = rng.uniform([0.4, 0.4, 0.4], [1.1, 1.1, 0.9])
    leaf = np.array([0.06, 0.2, 0.12]) * rng.uniform(0.6, 1.4)
    return _leaves(rng, np.array([0, 0, radii[2] * 0.8]), radii, 110, 0.2, leaf)


def hedge(rng: np.random.Generator, length_m: float) -> Mesh:
    """A clipped hedge along x, from 0 to its length."""
    high, deep = rng.uniform(0.7, 1.7), rng.uniform(0.4, 0.8)
    leaf = np.array([0.05, 0.18, 0.10]) * rng.uniform(0.7, 1.3)
    solid = box([0, -deep / 2, -1], [length_m, deep / 2, high], leaf * 0.8, Material.FOLIAGE)
    count = int(14 * length_m)
    middle = rng.uniform([0, -deep / 2 - 0.05, 0.1], [length_m, deep / 2 + 0.05, high + 0.05], (count, 3))
    loose = triangles(
        middle[:, None] + rng.normal(0, 0.09, (count, 3, 3)), leaf * rng.uniform(0.6, 1.4, (count, 1)), Material.FOLIAGE
    )
    return join([solid, loose])


def fence(rng: np.random.Generator, length_m: float) -> Mesh:
    """A garden wall with pillars, or pales, along x."""
    if rng.random() < 0.4:
        colour = np.array([0.4, 0.45, 0.5]) * rng.uniform(0.6, 1.2)
        high = rng.uniform(0.5, 1.2)
        parts = [box([0, -0.12, -1], [length_m, 0.12, high], colour, Material.BRICK)]
        for x in np.arange(0, length_m, 3.0):
            parts.append(box([x, -0.2, -1], [x + 0.4, 0.2, high + 0.25], colour * 0.8, Material.BRICK))
        return join(parts)
    colour = np.full(3, rng.uniform(0.15, 0.75))
    high = rng.uniform(0.8, 1.3)
    parts = [box([0, -0.02, z], [length_m, 0.02, z + 0.06], colour, Material.PAINT) for z in (0.25, high - 0.2)]
    x = np.arange(0, length_m - 0.08, 0.22)
    zero, wide, foot, head = np.zeros_like(x), x + 0.08, np.full_like(x, 0.05), np.full_like(x, high)
    y = zero - 0.03
    pales = np.stack([np.stack(c, axis=-1) for c in ((x, y, foot), (wide, y, foot), (wide, y, head), (x, y, head))], 1)
    return join([*parts, quads(pales, colour, Material.PAINT)])


def lamp(rng: np.random.Generator) -> Mesh:
    """A street lamp whose arm reaches over y > 0."""
    high, reach = rng.uniform(5.0, 8.5), rng.uniform(0.4, 2.0)
    grey = np.full(3, rng.uniform(0.1, 0.5))
    return join(
        [
            tube([0, 0, -1], [0, 0, high], rng.uniform(0.06, 0.1), 8, grey, Material.PAINT),
            tube([0, 0, high], [0, reach, high + 0.25], 0.045, 6, grey, Material.PAINT),
            box([-0.15, reach - 0.3, high + 0.18], [0.15, reach + 0.4, high + 0.32], grey, Material.PAINT),
            tube([0, 0, 0], [0, 0, 1.0], 0.12, 8, grey * 0.8, Material.PAINT),
        ]
    )


def sign(rng: np.random.Generator) -> Mesh:
    """A traffic sign facing -x."""
    high = rng.uniform(2.1, 2.8)
    post = tube([0, 0, -1], [0, 0, high + 0.3], 0.035, 6, (0.5, 0.5, 0.5), Material.PAINT)
    x = -0.06
    if rng.random() < 0.5:
        rim, face, size = (0.08, 0.07, 0.62), (0.8, 0.8, 0.8), 0.34
        corners = circle(1.0, 14) if rng.random() < 0.6 else circle(1.15, 3)[:, ::-1]
    else:
        rim, face, size = (0.7, 0.7, 0.7), (0.5, 0.2, 0.05), 0.36
        corners = circle(1.25, 4) @ np.array([[0.7071, 0.7071], [-0.7071, 0.7071]])
    parts = [post]
    for scale, colour, lift in ((size, rim, 0.0), (size * 0.76, face, 0.008)):
        plate = np.column_stack([np.full(len(corners), x - lift), scale * corners + np.array([0.0, high])])
        fan = np.arange(1, len(corners) - 1)
        parts.append(
            triangles(np.stack([np.broadcast_to(plate[0], (len(fan), 3)), plate[fan], plate[fan + 1]], 1), colour,
                      Material.SIGN)
        )  # fmt: skip
    return join(parts)


def person(rng: np.random.Generator) -> Mesh:
    """Somebody on foot, facing x."""
    scale = rng.uniform(0.85, 1.08)
    top, legs = rng.uniform(0.03, 0.6, 3), rng.uniform(0.02, 0.3, 3)
    skin = np.array([0.3, 0.42, 0.6]) * rng.uniform(0.4, 1.2)
    stride = rng.uniform(0.05, 0.25)
    parts = [
        ball([0, 0, 1.2], [0.15, 0.23, 0.36], top, Material.CLOTH),
        ball([0.02, 0, 1.66], [0.1, 0.09, 0.13], skin, Material.CLOTH),
        tube([stride, 0.1, 0.0], [0, 0.09, 0.92], 0.085, 6, legs, Material.CLOTH),
        tube([-stride, -0.1, 0.0], [0, -0.09, 0.92], 0.085, 6, legs, Material.CLOTH),
        tube([-stride, 0.24, 0.85], [0, 0.22, 1.42], 0.055, 5, top, Material.CLOTH),
        tube([stride, -0.24, 0.85], [0, -0.22, 1.42], 0.055, 5, top, Material.CLOTH),
    ]
    whole = join(parts)
    return Mesh((whole.corners_m * scale).astype(np.float32), whole.colour, whole.material)


def clutter(rng: np.random.Generator) -> Mesh:
    """A bin, a bollard, a cabinet or a bench on the pavement."""
    match int(rng.integers(4)):
        case 0:
            colour = rng.uniform(0.03, 0.4, 3)
            return prism(circle(0.3, 8), 0, 1.05, colour, Material.PAINT, taper=1.1)
        case 1:
            return tube([0, 0, -0.5], [0, 0, 0.95], 0.07, 8, (0.12, 0.12, 0.12), Material.PAINT)
        case 2:
            return box([-0.5, -0.2, -0.5], [0.5, 0.2, 1.2], (0.45, 0.5, 0.48), Material.PAINT)
    wood = (0.12, 0.22, 0.36)
    seat = box([-0.8, -0.2, 0.42], [0.8, 0.2, 0.47], wood, Material.BARK)
    back = box([-0.8, 0.2, 0.5], [0.8, 0.24, 0.9], wood, Material.BARK)
    legs = [box([x, -0.2, -0.3], [x + 0.06, 0.2, 0.42], GREY, Material.PAINT) for x in (-0.7, 0.64)]
    return join([seat, back, *legs])
