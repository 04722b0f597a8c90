"""The errors that all frames of a window share, so that no number of frames averages them away: one line for each.

Each term is a displacement of the sight lines by the standard deviation of an error. The pose moves by the
least-squares answer to that displacement, over the points that settled it. An error that is the same for all things in
view acts on a rotation; one that only near things have acts on a translation. Errors that differ from edge to edge,
such as the place of an edge within a beam or a column, are in the scatter of the noise and have no term here.

A held translation is such an error, too: it was measured once, and not to the last millimetre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.grain import SensorResolution
from coec.calibration.objective.cells import PointsInView
from coec.geometry.linear import inverted
from coec.geometry.thinning import thinned

POINTS = 5_000
"""Number of sight lines that stand for all: least squares over six unknowns needs no more."""

EDGE_PX = 0.1
"""How far the edges of near things together may be displaced against those of far ones: blur and gamma move an image
edge to the brighter side by about that much, and which side is nearer depends on the scene."""

COLUMN_SHARE = 0.05
"""The same for range edges, in columns. On either side they lie half a column inside the near thing on average. An
error is left if more left sides than right ones are in view; it was up to a fifth of that half on simulated drives."""

STAMP_S = 1e-3 / sqrt(12.0)
"""Standard deviation of stamps that are rounded to the millisecond, s."""


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Sight lines, with all that the terms need.

    Attributes:
        towards: (N, 3) unit vectors.
        p_camera: (N, 3) the points, metres.
        range_m: (N,) ranges of the points.
        near: (N, 1) 1 for the points nearer than the median range, else 0.
        frame: (N,) index of the frame of each point.
        axis_of_sweep: (3,) the axis about which the LiDAR turns, camera frame.
    """

    towards: NDArray[np.float64]
    p_camera: NDArray[np.float64]
    range_m: NDArray[np.float64]
    near: NDArray[np.float64]
    frame: NDArray[np.int64]
    axis_of_sweep: NDArray[np.float64]

    def perpendicular(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) the part of a direction (3,) or (N, 3) that lies across each sight line."""
        along = np.sum(self.towards * direction, axis=1, keepdims=True)
        return np.asarray(direction - self.towards * along)


Term = Callable[[_Rays, SensorResolution], NDArray[np.float64]]
"""The displacement (N, 3) of the sight lines by one standard deviation of an error, radians."""

RIGHT, DOWN, FORWARD = np.eye(3)

TERMS: MappingProxyType[str, Term] = MappingProxyType(
    {
        "lens_across": lambda lines, grain: grain.lens_px * grain.pixel_rad * lines.perpendicular(RIGHT),
        "lens_down": lambda lines, grain: grain.lens_px * grain.pixel_rad * lines.perpendicular(DOWN),
        "lens_scale": lambda lines, grain: (
            grain.lens_px * grain.pixel_rad * _of_mean_one(lines.perpendicular(-FORWARD))
        ),
        "near_edges_across": lambda lines, grain: EDGE_PX * grain.pixel_rad * lines.near * lines.perpendicular(RIGHT),
        "near_edges_down": lambda lines, grain: EDGE_PX * grain.pixel_rad * lines.near * lines.perpendicular(DOWN),
        "columns": lambda lines, grain: (
            COLUMN_SHARE * grain.column_rad * lines.near * np.cross(lines.axis_of_sweep, lines.towards)
        ),
        "stamps": lambda lines, grain: STAMP_S * _passing(lines, grain),
    }
)
"""The terms by name, in a fixed order. The lens is displaced to the right, down and outwards (principal point and focal
length); finer errors of it differ from sector to sector of the image and are in the scatter."""

HELD: MappingProxyType[int, str] = MappingProxyType({3: "held_across", 4: "held_down", 5: "held_forward"})
"""Names of further terms, one for each translation that was not searched, by its place in ξ."""


def systematic_shifts(
    points: PointsInView, resolution: SensorResolution, moved: tuple[int, ...], axis_of_sweep: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """By how much each term moves a pose, by name: (6,) radians and metres, zero on axes that were not `moved`. Empty
    if the points in view do not determine the pose.

    `axis_of_sweep` (3,) is the axis about which the LiDAR turns, camera frame.
    """
    indices = thinned(len(points.p_camera), POINTS)
    p_camera, weight = points.p_camera[indices], points.weight[indices]
    range_m = np.sqrt(np.sum(p_camera * p_camera, axis=1))
    towards = p_camera / range_m[:, None]
    near = (range_m < np.median(range_m)).astype(np.float64)[:, None] if len(range_m) else np.zeros((0, 1))
    lines = _Rays(towards, p_camera, range_m, near, points.frame[indices], axis_of_sweep)
    answers = np.stack([_answer(lines, axis) for axis in moved], axis=2)  # (N, 3, n)
    # Sums without a BLAS product are the same to the bit in every process.
    weighted = answers * weight[:, None, None]
    each = range(len(moved))
    normal = [[float(np.sum(weighted[:, :, i] * answers[:, :, j])) for j in each] for i in each]
    try:
        inverse = np.array(inverted(normal))
    except ValueError:
        return {}
    displacements = {name: term(lines, resolution) for name, term in TERMS.items()}
    for axis, name in HELD.items():
        if axis not in moved:
            displacements[name] = resolution.held_m * _answer(lines, axis)
    shifts = {}
    for name, displaced in displacements.items():
        right = np.array([float(np.sum(weighted[:, :, i] * displaced)) for i in each])
        shift = np.zeros(6)
        shift[list(moved)] = np.sum(inverse * right[None], axis=1)
        shifts[name] = shift
    return shifts


def _answer(lines: _Rays, axis: int) -> NDArray[np.float64]:
    """(N, 3) how the sight lines move with one axis of ξ, per radian or metre."""
    unit = np.eye(3)[axis % 3]
    if axis < 3:
        return np.asarray(np.cross(unit, lines.towards))
    return lines.perpendicular(unit) / lines.range_m[:, None]


def _of_mean_one(displaced: NDArray[np.float64]) -> NDArray[np.float64]:
    """The displacement scaled to a root mean square of one."""
    mean = np.sqrt(np.mean(np.sum(displaced * displaced, axis=1)))
    return np.asarray(displaced / max(float(mean), 1e-12))


def _passing(lines: _Rays, resolution: SensorResolution) -> NDArray[np.float64]:
    """(N, 3) how fast the sight lines move as the vehicle passes, radians per second."""
    # Standing things move against the motion of the vehicle.
    speed = resolution.velocity_mps[lines.frame] + np.cross(resolution.turn_radps[lines.frame], lines.p_camera)
    return lines.perpendicular(-speed) / lines.range_m[:, None]
