"""Values as the number of the share that they are in: how what is compared becomes whole numbers, once for a search."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange


def share_of_pixels(
    values: NDArray[np.float32], usable: NDArray[np.bool_], edges: NDArray[np.float32]
) -> NDArray[np.unsignedinteger]:
    """(h·w + 1,) how many of the ascending edges (n,) the value of each pixel reaches, row by row: 0 to n; n + 1 where
    a pixel is not `usable`, and once more at the end, for what lies outside of the map (h, w).

    In the narrowest type that holds n + 1: what looks it up lives on cache.
    """
    none = len(edges) + 1
    share: NDArray[np.unsignedinteger] = np.empty(values.size + 1, np.uint8 if none < 256 else np.uint16)
    share.fill(none)
    _count_reached(values, usable, edges, share)
    return share


@njit(cache=True, parallel=PRANGE)
def _count_reached(
    values: NDArray[np.float32],
    usable: NDArray[np.bool_],
    edges: NDArray[np.float32],
    share: NDArray[np.unsignedinteger],
) -> None:
    """`share` (h·w + 1,) at the pixels that are usable."""
    h, w = values.shape
    for y in prange(h):
        row, reached = values[y], np.zeros(w, np.uint16)
        # Edge by edge, not pixel by pixel: the loop over the pixels runs in vector registers.
        for edge in edges:
            for x in range(w):
                reached[x] += np.uint16(row[x] >= edge)
        for x in range(w):
            if usable[y, x]:
                share[y * w + x] = reached[x]
