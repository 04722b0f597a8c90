"""An objective divided into cells: what every frame says in every sector of the image.

Frames differ by what the vehicle passed, sectors by what stands where. The sum alone does not show what they have in
common: a standing vehicle sees the same corner of a wall in every frame, and a lens that is wrong at its rim is wrong
in every frame. Cells show it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

COLUMNS, ROWS = 8, 2
"""Sectors of the image, across and down. There are more than degrees of freedom, so that their scatter can be
distinguished from the pose; each is several degrees wide, so that an object lies in one. 4 x 4, 4 x 2 with near and far
apart, and 16 x 1 give the same standard deviations within a tenth (two simulated drives of 32 beams, 16 windows)."""


@dataclass(frozen=True, slots=True, eq=False)
class PointsInView:
    """The points in view that settle a pose.

    Attributes:
        p_camera: (N, 3) metres, camera frame.
        weight: (N,) weight of each point in the objective.
        frame: (N,) index of the frame of each point.
    """

    p_camera: NDArray[np.float64]
    weight: NDArray[np.float64]
    frame: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """An objective near one pose, divided.

    Attributes:
        at: (K, F, B) what each of F frames adds in each of B sectors at each of K poses (K, 4, 4). The mean over the
            frames of the sums over the sectors is the objective, up to a constant.
        step_rad: difference step at which the hill still looks like a hill: no wider than its top, no finer than its
            ripples.
        sight: the points in view at the pose.
    """

    at: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    step_rad: float
    points: PointsInView


def sectors(uv_px: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) the sector of each of N pixels (N, 2): `COLUMNS` columns of equal numbers of pixels, each divided into
    `ROWS` rows of equal numbers."""
    sector = np.empty(len(uv_px), np.int64)
    across = np.argsort(uv_px[:, 0], kind="stable")
    for column, of_column in enumerate(np.array_split(across, COLUMNS)):
        down = of_column[np.argsort(uv_px[of_column, 1], kind="stable")]
        for row, of_row in enumerate(np.array_split(down, ROWS)):
            sector[of_row] = column * ROWS + row
    return sector
