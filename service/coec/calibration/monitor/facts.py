"""Measures what one image and one sweep show of the sensors themselves; `sensor_faults` judges that.

It is a module of its own because measuring takes compiled kernels, and the process that serves queries needs the faults
but loads no compiler.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.ego_mask import cell_means
from coec.calibration.monitor.sensor_faults import (
    BAND_RANGE_RAD,
    BANDS,
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    SECTORS,
    PictureFacts,
    SweepFacts,
)
from coec.geometry.bearings import Bearings, grid_counts
from coec.geometry.picture import level_counts, neighbour_differences

BRIGHT_SHARE, BRIGHT_STEP = 0.9, 4
"""Share of the pixels below the grey value `bright`, and the sampling: every fourth pixel of every fourth row."""

THUMBNAIL_CELL_PX = 8
"""Side, in pixels of the image, of one pixel of the thumbnail by which pictures are compared."""


def picture_facts(grey: NDArray[np.uint8]) -> PictureFacts:
    """The facts of an image, (h, w)."""
    thumbnail = cell_means(grey, THUMBNAIL_CELL_PX).astype(np.float32)
    levels = np.cumsum(level_counts(grey, BRIGHT_STEP))
    return PictureFacts(
        gradient=neighbour_differences(grey, BLOCK_ROWS, BLOCK_COLUMNS),
        bright=float(np.searchsorted(levels, BRIGHT_SHARE * levels[-1])),
        thumbnail=thumbnail,
        digest=zlib.crc32(thumbnail.data),
    )


def sweep_facts(xyz_m: NDArray[np.float32], seen: Bearings, range_edges: int) -> SweepFacts:
    """The facts of a sweep, from its points (N, 3), their bearings and the number of its range edges."""
    low, high = BAND_RANGE_RAD
    bands, sectors = grid_counts(seen.elevation, seen.azimuth, low, high, BANDS, SECTORS)
    return SweepFacts(bands, sectors, range_edges, zlib.crc32(np.ascontiguousarray(xyz_m).data))
