"""Triangles, each with a colour and a material, and the simple solids of which a street is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]
Colour = tuple[float, float, float]
"""Reflectance in blue, green and red, 0 to 1, linear."""


class Material(IntEnum):
    """Kind of surface: decides its texture (`shading`) and how it reflects a laser (`lidar`)."""

    PAINT = 0
    ASPHALT = 1
    PAVING = 2
    GRASS = 3
    BRICK = 4
    PLASTER = 5
    GLASS = 6
    LACQUER = 7
    FOLIAGE = 8
    BARK = 9
    TILES = 10
    MARKING = 11
    SIGN = 12
    RUBBER = 13
    CONCRETE = 14
    CLOTH = 15
    LAMP = 16


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles without order or winding: normals are turned towards the viewer when a ray hits.

    Attributes:
        corners_m: (T, 3, 3) float32, triangle by corner by coordinate.
        colour: (T, 3) float32, see `Colour`.
        material: (T,) int8, see `Material`.
    """

    corners_m: Floats
    colour: Floats
    material: NDArray[np.int8]

    def placed(self, x_m: float, y_m: float, z_m: float, heading_rad: float) -> Mesh:
        """The mesh turned about the vertical, then moved."""
        cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
        x, y, z = np.moveaxis(self.corners_m.astype(np.float64), -1, 0)
        moved = np.stack([cosine * x - sine * y + x_m, sine * x + cosine * y + y_m, z + z_m], axis=-1)
        return Mesh(moved.astype(np.float32), self.colour, self.material)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several, in their order."""
    return Mesh(
        np.concatenate([mesh.corners_m for mesh in meshes]),
        np.concatenate([mesh.colour for mesh in meshes]),
        np.concatenate([mesh.material for mesh in meshes]),
    )


def triangles(corners_m: ArrayLike, colour: ArrayLike, material: Material) -> Mesh:
    """A mesh of triangles. corners_m: (T, 3, 3) or one (3, 3); colour: one, or (T, 3)."""
    shape = np.asarray(corners_m, dtype=np.float32).reshape(-1, 3, 3)
    paint = np.broadcast_to(np.asarray(colour, dtype=np.float32), (len(shape), 3)).copy()
    return Mesh(shape, paint, np.full(len(shape), int(material), dtype=np.int8))


def quads(corners_m: ArrayLike, colour: ArrayLike, material: Material) -> Mesh:
    """A mesh of quads. corners_m: (Q, 4, 3) around each, or one (4, 3); colour: one, or (Q, 3)."""
    four = np.asarray(corners_m, dtype=np.float32).reshape(-1, 4, 3)
    paint = np.broadcast_to(np.asarray(colour, dtype=np.float32), (len(four), 3))
    return triangles(four[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3), np.repeat(paint, 2, axis=0), material)


def box(low_m: ArrayLike, high_m: ArrayLike, colour: ArrayLike, material: Material) -> Mesh:
    """An upright box without its bottom."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low_m, dtype=float), np.asarray(high_m, dtype=float)
    return prism([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], z0, z1, colour, material)


def prism(
    outline_m: ArrayLike, low_m: float, high_m: float, colour: ArrayLike, material: Material, taper: float = 1.0
) -> Mesh:
    """A convex outline (K, 2) in x, y raised from low to high, with a lid scaled by `taper` about its centre."""
    base = np.asarray(outline_m, dtype=float)
    top = base.mean(axis=0) + taper * (base - base.mean(axis=0))
    ring0 = np.column_stack([base, np.full(len(base), low_m)])
    ring1 = np.column_stack([top, np.full(len(base), high_m)])
    sides = np.stack([ring0, np.roll(ring0, -1, axis=0), np.roll(ring1, -1, axis=0), ring1], axis=1)
    fan = np.arange(1, len(base) - 1)
    lid = np.stack([np.broadcast_to(ring1[0], (len(fan), 3)), ring1[fan], ring1[fan + 1]], axis=1)
    return join([quads(sides, colour, material), triangles(lid, colour, material)])


def circle(radius_m: float, sides: int, centre_m: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """(sides, 2) outline of a circle."""
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.asarray(centre_m) + radius_m * np.column_stack([np.cos(angle), np.sin(angle)])


def tube(start_m: ArrayLike, end_m: ArrayLike, radius_m: float, sides: int, colour: ArrayLike, kind: Material) -> Mesh:
    """A round bar with lids between two points."""
    start, end = np.asarray(start_m, dtype=float), np.asarray(end_m, dtype=float)
    along = (end - start) / np.linalg.norm(end - start)
    across = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    ring = circle(radius_m, sides)
    offsets = ring[:, :1] * across + ring[:, 1:] * np.cross(along, across)
    near, far = start + offsets, end + offsets
    sides_m = np.stack([near, np.roll(near, -1, axis=0), np.roll(far, -1, axis=0), far], axis=1)
    fan = np.arange(1, sides - 1)
    lids = [np.stack([np.broadcast_to(e[0], (len(fan), 3)), e[fan], e[fan + 1]], axis=1) for e in (near, far)]
    return join([quads(sides_m, colour, kind), triangles(np.concatenate(lids), colour, kind)])


def ball(centre_m: ArrayLike, radii_m: ArrayLike, colour: ArrayLike, kind: Material, sides: int = 8) -> Mesh:
    """An ellipsoid of `sides` meridians and half as many parallels."""
    rows = max(sides // 2, 3)
    polar = np.pi * np.arange(rows + 1) / rows
    turn = 2 * np.pi * np.arange(sides + 1) / sides
    grid = np.stack(
        [
            np.outer(np.sin(polar), np.cos(turn)),
            np.outer(np.sin(polar), np.sin(turn)),
            np.outer(np.cos(polar), np.ones(sides + 1)),
        ],
        axis=-1,
    ) * np.asarray(radii_m, dtype=float) + np.asarray(centre_m, dtype=float)
    corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2)
    return quads(corners.reshape(-1, 4, 3), colour, kind)
