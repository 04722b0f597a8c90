"""Sums, differences and grey levels over squares or blocks of an image, and connected groups of cells, each in one
pass."""

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange


@njit(cache=True, parallel=PRANGE)
def square_sums(grey: NDArray[np.uint8], side: int) -> NDArray[np.uint32]:
    """(h // side, w // side): sums of the pixels of each full square of an image `grey` (h, w). Pixels beyond the last
    full square at the right and the bottom are left out."""
    rows, columns = grey.shape[0] // side, grey.shape[1] // side
    sums = np.zeros((rows, columns), np.uint32)
    for row in prange(rows):
        of_column = np.zeros(columns * side, np.uint32)
        for y in range(row * side, (row + 1) * side):
            for x in range(columns * side):
                of_column[x] += np.uint32(grey[y, x])
        for column in range(columns):
            total = np.uint32(0)
            for x in range(column * side, (column + 1) * side):
                total += of_column[x]
            sums[row, column] = total
    return sums


@njit(cache=True, parallel=PRANGE)
def neighbour_differences(grey: NDArray[np.uint8], block_rows: int, block_columns: int) -> NDArray[np.float64]:
    """(block_rows, block_columns): for each block of an image (h, w), the mean over every second row of the sum of the
    absolute differences to the right and the lower neighbour. Blocks are as large as fit; pixels beyond them do not
    count."""
    rows, columns = grey.shape[0] // block_rows, grey.shape[1] // block_columns
    height, width = rows * block_rows, columns * block_columns
    means = np.zeros((block_rows, block_columns))
    for block in prange(block_rows):
        of_column = np.zeros(width, np.int32)
        for y in range(block * rows, (block + 1) * rows, 2):
            here = grey[y]
            for x in range(width - 1):
                of_column[x] += _absolute_difference(here[x + 1], here[x])
            if y + 1 < height:
                below = grey[y + 1]
                for x in range(width):
                    of_column[x] += _absolute_difference(below[x], here[x])
        for column in range(block_columns):
            total = np.int64(0)
            for x in range(column * columns, (column + 1) * columns):
                total += of_column[x]
            means[block, column] = total / ((rows + 1) // 2 * columns)
    return means


@njit(cache=True)
def level_counts(grey: NDArray[np.uint8], step: int) -> NDArray[np.int64]:
    """(256,): how many pixels have each grey value, over every `step`-th pixel of every `step`-th row of an image
    (h, w)."""
    counts = np.zeros(256, np.int64)
    for y in range(0, grey.shape[0], step):
        for x in range(0, grey.shape[1], step):
            counts[grey[y, x]] += 1
    return counts


@njit(cache=True)
def connected_groups(cells: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(h, w): number of the eight-connected group of each True cell of `cells` (h, w), from 1 in the order of their
    first cells; 0 for False. Disjoint sets (Galler, Fischer 1964), whose root is the first cell."""
    rows, columns = cells.shape
    parents = np.arange(rows * columns)
    for y in range(rows):
        for x in range(columns):
            if cells[y, x]:
                if x > 0 and cells[y, x - 1]:
                    _unite(parents, y * columns + x, y * columns + x - 1)
                if y > 0:
                    for above in range(max(x - 1, 0), min(x + 2, columns)):
                        if cells[y - 1, above]:
                            _unite(parents, y * columns + x, (y - 1) * columns + above)
    numbers = np.zeros((rows, columns), np.int64)
    groups = 0
    for y in range(rows):
        for x in range(columns):
            if cells[y, x]:
                first = _first_of(parents, y * columns + x)
                if first == y * columns + x:
                    groups += 1
                    numbers[y, x] = groups
                else:
                    numbers[y, x] = numbers[first // columns, first % columns]
    return numbers


@njit(cache=True)
def _first_of(parents: NDArray[np.int64], cell: int) -> int:
    while parents[cell] != cell:
        parents[cell] = parents[parents[cell]]
        cell = parents[cell]
    return cell


@njit(cache=True)
def _unite(parents: NDArray[np.int64], a: int, b: int) -> None:
    first_a, first_b = _first_of(parents, a), _first_of(parents, b)
    parents[max(first_a, first_b)] = min(first_a, first_b)


@njit(cache=True, inline="always")
def _absolute_difference(a: np.uint8, b: np.uint8) -> np.int32:
    """Absolute difference in eight bits. By default differences are taken in 64 bits, and a vector register holds many
    more values of eight."""
    return np.int32(np.uint8(a - b) if a > b else np.uint8(b - a))
