"""Converts values to the number of the share (bin) that they fall in, so that a search compares whole numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange


def share_of_pixels(
    values: NDArray[np.float32], usable: NDArray[np.bool_], edges: NDArray[np.float32]
) -> NDArray[np.unsignedinteger]:
    """(h·w + 1,): for each pixel, row by row, how many of the ascending edges (n,) its value reaches, 0 to n. It is n +
    1 for a pixel that is not `usable`, and in the last entry, which stands for points outside of the map (h, w).

    The type is the narrowest that holds n + 1, because look-ups are bound by the cache.
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
    """Fills `share` (h·w + 1,) at the usable pixels."""
    h, w = values.shape
    for y in prange(h):
        row, reached = values[y], np.zeros(w, np.uint16)
        # The loop over the pixels is the inner one, so that it runs in vector registers.
        for edge in edges:
            for x in range(w):
                reached[x] += np.uint16(row[x] >= edge)
        for x in range(w):
            if usable[y, x]:
                share[y * w + x] = reached[x]
