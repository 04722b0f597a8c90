"""An objective taken apart into cells: what every frame says in every sector of the image.

Frames differ by what the vehicle passed, sectors by what stands where. What both have in common cannot be told from the
sum alone: a standing vehicle sees the same corner of a wall in every frame, and a lens that is wrong at its rim is so
in every frame, too. Cells show it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

COLUMNS, ROWS = 8, 2
"""Sectors of the image, across and down. More than there are degrees of freedom, so that their scatter can be told from
the pose; each several degrees wide, so that an object lies in one. 4 x 4, 4 x 2 and near from far apart, and 16 x 1
give the same standard deviations within a tenth (two simulated drives of 32 beams, 16 windows)."""


@dataclass(frozen=True, slots=True, eq=False)
class SightLines:
    """The points in view that settle a pose.

    Attributes:
        p_camera: (N, 3) metres, camera frame.
        weight: (N,) in the objective.
        frame: (N,) which frame of the window.
    """

    p_camera: NDArray[np.float64]
    weight: NDArray[np.float64]
    frame: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """An objective near one pose, taken apart.

    Attributes:
        at: (K, F, B) what each of F frames adds in each of B sectors at each of K poses (K, 4, 4): the mean over the
            frames of the sums over the sectors is the objective, but for a constant.
        step_rad: difference step at which its hill is still a hill: not wider than its top, not finer than its ripples.
        sight: what is in view at that pose.
    """

    at: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    step_rad: float
    sight: SightLines


def sectors(uv_px: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) the sector of pixels (N, 2): as many of them in each of `COLUMNS`, and of those in each of `ROWS`."""
    sector = np.empty(len(uv_px), np.int64)
    across = np.argsort(uv_px[:, 0], kind="stable")
    for column, of_column in enumerate(np.array_split(across, COLUMNS)):
        down = of_column[np.argsort(uv_px[of_column, 1], kind="stable")]
        for row, of_row in enumerate(np.array_split(down, ROWS)):
            sector[of_row] = column * ROWS + row
    return sector
