"""The compiled kernels that checks and windows use, and how many of them are there: the progress of a first start.

A kernel counts once it can run, whether it was compiled or read from the cache. Those that are only called from other
kernels do not count, because they come with these. Kernels are compiled for the types of their arguments, which differ
only by the model of the lens.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module

COMMON: Mapping[str, tuple[str, ...]] = {
    "bearings": ("_bearings", "grid_counts"),
    "cover": ("moved_by", "unit_ball"),
    "deskew": ("_deskew",),
    "edges.charts": ("_cells", "_charted_z", "_climb", "keep_apart"),
    "edges.image_edges": (
        "_eroded_by", "_gain_over", "_gradient", "_less", "_over_local_mean", "_row_sums", "_smoothed", "_stepped",
        "halved",
    ),
    "edges.range_edges": ("_along_the_rows", "_jumps"),
    "mutual_information": ("_information", "_informations", "_tasks"),
    "picture": ("level_counts", "neighbour_differences", "square_sums"),
    "shares": ("_count_reached",),
}  # fmt: skip
"""Kernels that are the same for every lens, by their module in `coec.geometry`."""

OF_A_LENS: Mapping[str, tuple[str, ...]] = {
    "edges.alignment": (
        "_late_sums", "_nearest_pixel_z", "_smooth_sums", "_smooth_sums_of_parts", "_sums_on_each_map",
    ),
    "edges.charts": ("_pixels",),
    "edges.climbs": ("_climb",),
    "mutual_information": ("_count",),
    "pixel_lookup": ("_largest_error_px",),
    "projection": ("_project", "_unproject"),
}  # fmt: skip
"""Kernels that are compiled for each model of a lens."""


@dataclass(frozen=True, slots=True)
class Compiled:
    """`done` of `total` kernels are there."""

    done: int
    total: int

    def __str__(self) -> str:
        return f"{self.done} of {self.total}"


def compiled(lenses: int) -> Compiled:
    """How many kernels of so many lens models are there in this process. Loads the compiler."""
    total = sum(map(len, COMMON.values())) + lenses * sum(map(len, OF_A_LENS.values()))
    return Compiled(_present(COMMON, 1) + _present(OF_A_LENS, lenses), total)


def _present(kernels: Mapping[str, tuple[str, ...]], most: int) -> int:
    """Number of the kernels that are there, each at most so many times."""
    return sum(
        min(len(getattr(import_module(f"coec.geometry.{module}"), name).overloads), most)
        for module, names in kernels.items()
        for name in names
    )
