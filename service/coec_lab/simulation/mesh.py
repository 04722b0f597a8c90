"""Triangles, each with a colour and a material, and the simple solids of which a street is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]
Colour = tuple[float, float, float]
"""Reflectance in blue, green and red, 0 to 1, linear."""


class Material(IntEnum):
    """Kind of surface: decides its texture (`shading`) and how it reflects a laser (`reflectance`).

    RETRO is prismatic sheeting, which SIGN is not; BEADED is MARKING with glass beads; LIT is a lamp of a vehicle.
    """

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
    RETRO = 17
    BEADED = 18
    LIT = 19
    STEEL = 20


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
        corners = self.corners_m.astype(np.float64)
        x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
        moved = np.empty_like(self.corners_m)
        moved[..., 0] = cosine * x - sine * y + x_m
        moved[..., 1] = sine * x + cosine * y + y_m
        moved[..., 2] = z + z_m
        return Mesh(moved, self.colour, self.material)


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
    paint = np.empty((len(shape), 3), dtype=np.float32)
    paint[:] = colour
    return Mesh(shape, paint, np.full(len(shape), int(material), dtype=np.int8))


def quads(corners_m: ArrayLike, colour: ArrayLike, material: Material) -> Mesh:
    """A mesh of quads. corners_m: (Q, 4, 3) around each, or one (4, 3); colour: one, or (Q, 3)."""
    four = np.asarray(corners_m, dtype=np.float32).reshape(-1, 4, 3)
    halves = np.empty((len(four), 2, 3, 3), dtype=np.float32)
    halves[:, 0] = four[:, :3]
    halves[:, 1, 0] = four[:, 0]
    halves[:, 1, 1:] = four[:, 2:]
    shade = np.asarray(colour)
    paint = np.empty((len(four), 2, 3), dtype=np.float32)
    paint[:] = shade[:, None] if shade.ndim == 2 else shade
    return triangles(halves, paint.reshape(-1, 3), material)


def solid(
    ring0_m: ArrayLike, ring1_m: ArrayLike, colour: ArrayLike, material: Material, *, open_below: bool = False
) -> Mesh:
    """What lies between two convex rings of as many corners, (K, 3) each, with a lid on both or on the second alone."""
    corners = np.concatenate([ring0_m, ring1_m]).astype(np.float32)
    return triangles(corners[_faces_of_solid(len(corners) // 2, open_below)], colour, material)


@cache
def _faces_of_solid(corners: int, open_below: bool) -> NDArray[np.intp]:
    """(T, 3) indices into both rings, one after the other: two triangles for each side, then the lids as fans."""
    low = np.arange(corners)
    after = np.roll(low, -1)
    sides = np.stack([low, after, after + corners, low, after + corners, low + corners], axis=1).reshape(-1, 3)
    fan = np.arange(1, corners - 1)
    lid = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    return np.concatenate([sides, lid + corners] if open_below else [sides, lid, lid + corners])


def box(low_m: ArrayLike, high_m: ArrayLike, colour: ArrayLike, material: Material) -> Mesh:
    """An upright box without its bottom."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low_m, dtype=float), np.asarray(high_m, dtype=float)
    return prism([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], z0, z1, colour, material)


def prism(
    outline_m: ArrayLike, low_m: float, high_m: float, colour: ArrayLike, material: Material, taper: float = 1.0
) -> Mesh:
    """A convex outline (K, 2) in x, y raised from low to high, with a lid scaled by `taper` about its centre."""
    base = np.asarray(outline_m, dtype=float)
    centre = base.mean(axis=0)
    ring0, ring1 = np.empty((2, len(base), 3))
    ring0[:, :2], ring0[:, 2] = base, low_m
    ring1[:, :2], ring1[:, 2] = centre + taper * (base - centre), high_m
    return solid(ring0, ring1, colour, material, open_below=True)


def circle(radius_m: float, sides: int, centre_m: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """(sides, 2) outline of a circle."""
    return np.asarray(centre_m) + radius_m * _unit_circle(sides)


@cache
def _unit_circle(sides: int) -> NDArray[np.float64]:
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.column_stack([np.cos(angle), np.sin(angle)])


def tube(start_m: ArrayLike, end_m: ArrayLike, radius_m: float, sides: int, colour: ArrayLike, kind: Material) -> Mesh:
    """A round bar with lids between two points."""
    start, end = np.asarray(start_m, dtype=float), np.asarray(end_m, dtype=float)
    along = (end - start) / np.linalg.norm(end - start)
    across = _cross(along, np.array([0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0.0, 0.0]))
    across /= np.linalg.norm(across)
    ring = circle(radius_m, sides)
    offsets = ring[:, :1] * across + ring[:, 1:] * _cross(along, across)
    return solid(start + offsets, end + offsets, colour, kind)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of two vectors (3,): numpy's takes ten times as long."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


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
