"""The errors that all frames of a window share, and that no number of them averages away: one line a term.

Each term is a displacement of the sight lines by its standard deviation; the pose answers it by the least squares of
that displacement over the points that settled it. What an error does alike to all things in view it does to a rotation
whole; what it does to near things alone, to a translation. Errors that differ from edge to edge, as the place of an
edge within a beam or a column does, are in the scatter of the noise and have no line here.

A translation that is held is such an error, too: it was measured once, and not to the last millimetre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.grain import Grain
from coec.calibration.objective.cells import SightLines
from coec.geometry.linear import inverted
from coec.geometry.thinning import thinned

POINTS = 5_000
"""Sight lines that stand for all: a least squares over six unknowns needs no more."""

EDGE_PX = 0.1
"""How far the edges of near things may lie aside of those of far ones, together: an image edge is drawn to the brighter
side by blur and gamma by about that much, and which side is near is a matter of the scene."""

COLUMN_SHARE = 0.05
"""The same of range edges, in columns: they lie within the near thing by half a column on average, on either side; what
is left is where more left sides than right ones are in view, and was up to a fifth of the half on simulated drives."""

STAMP_S = 1e-3 / sqrt(12.0)
"""Stamps that are rounded to the millisecond are off by so much, s."""


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Sight lines (N, 3), unit vectors, with what the terms need of them.

    Attributes:
        towards: the unit vectors.
        p_camera: (N, 3) the points, metres.
        range_m: (N,).
        near: (N, 1) 1 for the nearer half, by weight of numbers, else 0.
        frame: (N,).
        axis_of_sweep: (3,) about which the LiDAR turns, camera frame.
    """

    towards: NDArray[np.float64]
    p_camera: NDArray[np.float64]
    range_m: NDArray[np.float64]
    near: NDArray[np.float64]
    frame: NDArray[np.int64]
    axis_of_sweep: NDArray[np.float64]

    def beside(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) what of a direction (3,) or (N, 3) lies across each line of sight."""
        along = np.sum(self.towards * direction, axis=1, keepdims=True)
        return np.asarray(direction - self.towards * along)


Term = Callable[[_Lines, Grain], NDArray[np.float64]]
"""The displacement (N, 3) of the sight lines by one standard deviation of an error, radians."""

RIGHT, DOWN, FORWARD = np.eye(3)

TERMS: MappingProxyType[str, Term] = MappingProxyType(
    {
        "lens_across": lambda lines, grain: grain.lens_px * grain.pixel_rad * lines.beside(RIGHT),
        "lens_down": lambda lines, grain: grain.lens_px * grain.pixel_rad * lines.beside(DOWN),
        "lens_scale": lambda lines, grain: grain.lens_px * grain.pixel_rad * _of_mean_one(lines.beside(-FORWARD)),
        "near_edges_across": lambda lines, grain: EDGE_PX * grain.pixel_rad * lines.near * lines.beside(RIGHT),
        "near_edges_down": lambda lines, grain: EDGE_PX * grain.pixel_rad * lines.near * lines.beside(DOWN),
        "columns": lambda lines, grain: (
            COLUMN_SHARE * grain.column_rad * lines.near * np.cross(lines.axis_of_sweep, lines.towards)
        ),
        "stamps": lambda lines, grain: STAMP_S * _passing(lines, grain),
    }
)
"""By name, in a fixed order. The lens is displaced to the right, down and outwards (its principal point and focal
length); what is finer than that differs from sector to sector of the image and is in the scatter."""

HELD: MappingProxyType[int, str] = MappingProxyType({3: "held_across", 4: "held_down", 5: "held_forward"})
"""Further terms, of each translation that was not searched, by its place in ξ."""


def systematic(
    sight: SightLines, grain: Grain, moved: tuple[int, ...], axis_of_sweep: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """What each term does to a pose, by its name: (6,) radians and metres, zero on axes that were not `moved`.

    `axis_of_sweep` (3,) is the axis about which the LiDAR turns, camera frame. Empty where the points in view do not
    determine the pose.
    """
    chosen = thinned(len(sight.p_camera), POINTS)
    p_camera, weight = sight.p_camera[chosen], sight.weight[chosen]
    range_m = np.sqrt(np.sum(p_camera * p_camera, axis=1))
    towards = p_camera / range_m[:, None]
    near = (range_m < np.median(range_m)).astype(np.float64)[:, None] if len(range_m) else np.zeros((0, 1))
    lines = _Lines(towards, p_camera, range_m, near, sight.frame[chosen], axis_of_sweep)
    answers = np.stack([_answer(lines, axis) for axis in moved], axis=2)  # (N, 3, n)
    # Sums without a BLAS product: to the bit the same in every process.
    weighted = answers * weight[:, None, None]
    each = range(len(moved))
    normal = [[float(np.sum(weighted[:, :, i] * answers[:, :, j])) for j in each] for i in each]
    try:
        inverse = np.array(inverted(normal))
    except ValueError:
        return {}
    displacements = {name: term(lines, grain) for name, term in TERMS.items()}
    for axis, name in HELD.items():
        if axis not in moved:
            displacements[name] = grain.held_m * _answer(lines, axis)
    shifts = {}
    for name, displaced in displacements.items():
        right = np.array([float(np.sum(weighted[:, :, i] * displaced)) for i in each])
        shift = np.zeros(6)
        shift[list(moved)] = np.sum(inverse * right[None], axis=1)
        shifts[name] = shift
    return shifts


def _answer(lines: _Lines, axis: int) -> NDArray[np.float64]:
    """(N, 3) how the sight lines move with one axis of ξ, per radian or metre."""
    unit = np.eye(3)[axis % 3]
    if axis < 3:
        return np.asarray(np.cross(unit, lines.towards))
    return lines.beside(unit) / lines.range_m[:, None]


def _of_mean_one(displaced: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scaled to a displacement of one, root mean square."""
    mean = np.sqrt(np.mean(np.sum(displaced * displaced, axis=1)))
    return np.asarray(displaced / max(float(mean), 1e-12))


def _passing(lines: _Lines, grain: Grain) -> NDArray[np.float64]:
    """(N, 3) how fast the sight lines move as the vehicle passes, radians per second."""
    # What stands still moves against the vehicle.
    speed = grain.velocity_mps[lines.frame] + np.cross(grain.turn_radps[lines.frame], lines.p_camera)
    return lines.beside(-speed) / lines.range_m[:, None]
