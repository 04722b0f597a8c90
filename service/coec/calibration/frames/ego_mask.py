"""Finds regions of the image that show nothing of the world: the vehicle's own body, the black ring around a fisheye's
image circle, dirt. In frames taken in motion the edges of the world come and go, while those of such regions stay.

Statistics are kept on a coarse grid, as sums over the frames, so that memory does not grow with their number. An edge
is tested by its signed gradient (as for watermarks in image collections: Dekel, Rubinstein, Liu, Freeman 2017, "On the
effectiveness of visible watermarks"): over a moving scene the gradient averages out, on a fixed structure it has one
direction. The gradient of an outline against the world changes sign with the background, but keeps its axis.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import log

import numpy as np
from numpy.typing import NDArray

from coec.geometry.images import connected_groups, square_sums

Grid = NDArray[np.float64]
Cells = NDArray[np.bool_]

GRID_WIDTH = 200
"""About how many cells the grid has across the image. A cell is 7 px of a 1400 px image, wider than shake and rounding
move an edge of the body."""

MIN_FRAMES = 5
"""Fewer frames in motion say nothing, because chance may repeat itself."""

MIN_SPEED_MPS = 0.5
"""Frames of a vehicle known to be slower do not count, because things that stand before it would pass for its body."""

MIN_CHANGE_LEVELS = 8.0
"""Least mean absolute difference, grey levels, from the last frame that counted; below it the vehicle hardly moved.
Measured: 4 between consecutive frames of slow traffic and in a room, 18 and more between frames a second apart."""

MOVED_LEVELS, MIN_MOVED_SHARE = 10.0, 0.4
"""Standard deviation from which a cell saw the world move, and the least share of such cells, of those that are not
black; with fewer the scene itself stood still. See docs/measured.md."""

CHANCE = 1e-4
"""Probability that a cell of a moving scene passes for a fixed edge if its gradients are normally distributed."""

MIN_STEADINESS = 2.0
"""Least mean gradient of a fixed edge over its standard deviation. It is needed because with many frames roofs and
kerbs of a straight road, which are alike but not the same, pass the test of chance. See docs/measured.md."""

MIN_GRADIENT_LEVELS = 3.0
"""Least gradient of an edge, grey levels per cell. Less is shading, on which nothing could be aligned anyway."""

MIN_PRESENCE, MIN_AXIS_AGREEMENT = 0.8, 0.9
"""An outline shows in at least this share of the frames, and the mean of its axes (unit vectors of twice the angle) is
at least so long. See docs/measured.md."""

MIN_BOUND_AGREEMENT = 0.8
"""Least length of the mean of the axes around still cells. It may be lower because whole groups are judged there, and
the 2 to 8 % of such cells in the world never bound a group."""

STILL_SHARE = 0.2
"""A cell whose standard deviation is below this share of the median of those that moved is still."""

BLACK_LEVELS = 24.0
"""Mean grey value outside the image circle, glow of the lens included. See docs/measured.md."""

ENCLOSED_SHARE = 0.35
"""Still cells show no world if at least this share of their outline is fixed. It is a share because the outline of a
dark spot is lost before dark trees; the outline of a sky moves with the roofs. See docs/measured.md."""

MIN_CELLS = 6
"""Smaller groups of fixed edges are ignored: two cells across are chance, or not worth a hole in the mask."""


@dataclass(frozen=True, slots=True, eq=False)
class DeadRegions:
    """Sums over the frames in motion so far, each over a grid of cells.

    Attributes:
        cell_px: side of a cell.
        frames: number of frames that counted.
        last: the last of them, grey levels; the other grids are sums over all of them.
        grey, grey_squared: sums of the levels and of their squares.
        gradient_x, gradient_y, gradient_squared: sums of the gradient, levels per cell, and of its square.
        axis_x, axis_y: sums of the cosine and sine of twice the gradient's angle, over frames with an edge there.
        edges: number of frames with an edge there.
    """

    cell_px: int
    frames: int
    last: Grid
    grey: Grid
    grey_squared: Grid
    gradient_x: Grid
    gradient_y: Grid
    gradient_squared: Grid
    axis_x: Grid
    axis_y: Grid
    edges: Grid

    @classmethod
    def begin(cls, grey: NDArray[np.uint8]) -> DeadRegions:
        """The sums after the first frame, (height, width) uint8."""
        cell_px = max(1, round(grey.shape[1] / GRID_WIDTH))
        none = np.zeros_like(cell_means(grey, cell_px))
        return cls(cell_px, 0, none, none, none, none, none, none, none, none, none)._with(cell_means(grey, cell_px))

    def after(self, grey: NDArray[np.uint8]) -> DeadRegions:
        """The sums after one more frame of the same size; unchanged if the vehicle hardly moved since the last one."""
        reduced = cell_means(grey, self.cell_px)
        return self._with(reduced) if np.abs(reduced - self.last).mean() >= MIN_CHANGE_LEVELS else self

    def mask(self, width: int, height: int) -> Cells | None:
        """(height, width) bool, False = shows nothing of the world. None if no region is dead, or if that cannot be
        told yet because of too few frames or a scene that stood still."""
        if self.frames < MIN_FRAMES:
            return None
        mean, deviation = self._grey()
        moved = deviation > MOVED_LEVELS
        lit = mean > BLACK_LEVELS
        if moved.sum() < MIN_MOVED_SHARE * max(int(lit.sum()), 1):
            return None
        still = deviation < STILL_SHARE * np.median(deviation[moved])
        ring = _ring(still & ~lit)
        shown, agreement = self._axes()
        least = np.maximum(MIN_AXIS_AGREEMENT**2, -log(CHANCE) / np.maximum(self.edges, 1.0))
        fixed = _without_specks(self._fixed_edges() | (shown & (agreement >= least)))
        dead = fixed | ring
        bound = fixed | (shown & (agreement >= MIN_BOUND_AGREEMENT**2))
        # The rim of the image circle is a fixed edge, too, but encloses the world, not the body.
        dead |= _without_specks(_enclosed(still & ~dead, bound & ~_grown(_grown(ring)), dead))
        if not dead.any():
            return None
        return _at_pixels(~_grown(dead), self.cell_px, width, height)

    def _with(self, reduced: Grid) -> DeadRegions:
        along_y, along_x = np.gradient(reduced)
        squared = along_x**2 + along_y**2
        edge = squared >= MIN_GRADIENT_LEVELS**2
        weight = np.where(edge, 1.0 / np.maximum(squared, MIN_GRADIENT_LEVELS**2), 0.0)
        return replace(
            self,
            frames=self.frames + 1,
            last=reduced,
            grey=self.grey + reduced,
            grey_squared=self.grey_squared + reduced**2,
            gradient_x=self.gradient_x + along_x,
            gradient_y=self.gradient_y + along_y,
            gradient_squared=self.gradient_squared + squared,
            axis_x=self.axis_x + weight * (along_x**2 - along_y**2),
            axis_y=self.axis_y + weight * (2.0 * along_x * along_y),
            edges=self.edges + edge,
        )

    def _grey(self) -> tuple[Grid, Grid]:
        """Mean and standard deviation of every cell, grey levels."""
        mean = self.grey / self.frames
        return mean, np.sqrt(np.maximum(self.grey_squared / self.frames - mean**2, 0.0))

    def _fixed_edges(self) -> Cells:
        """Cells whose gradient is the same in every frame.

        F = N·|ḡ|²/s² of two components and 2·(N - 1) degrees of freedom (Hotelling 1931, with one variance for both)
        exceeds f with probability (1 + f/(N - 1))^-(N - 1), the closed form for two numerator degrees of freedom.
        """
        n = self.frames
        squared = (self.gradient_x / n) ** 2 + (self.gradient_y / n) ** 2
        variance = np.maximum(self.gradient_squared / n - squared, 0.0) * n / (n - 1)
        by_chance = (n - 1) * (CHANCE ** (-1.0 / (n - 1)) - 1.0) / n
        least = max(by_chance, MIN_STEADINESS**2)
        return np.asarray((squared >= MIN_GRADIENT_LEVELS**2) & (squared >= least * variance))

    def _axes(self) -> tuple[Cells, Grid]:
        """Cells in which an edge shows in nearly every frame, and the squared length R² of the mean of its axes. Random
        axes of n frames exceed R² with probability exp(-n·R²) (Rayleigh 1880)."""
        shown = self.edges >= MIN_PRESENCE * self.frames
        return shown, (self.axis_x**2 + self.axis_y**2) / np.maximum(self.edges, 1.0) ** 2


def lit_pixels(greys: Iterable[NDArray[np.uint8]]) -> Cells | None:
    """`DeadRegions.mask` of the frames of one window, (height, width) uint8 each; None also if their sizes differ."""
    regions: DeadRegions | None = None
    shape: tuple[int, ...] | None = None
    for grey in greys:
        if shape is not None and grey.shape != shape:
            return None
        regions = DeadRegions.begin(grey) if regions is None else regions.after(grey)
        shape = grey.shape
    return None if regions is None or shape is None else regions.mask(shape[1], shape[0])


def cell_means(grey: NDArray[np.uint8], cell_px: int) -> Grid:
    """Mean of every full cell; a remainder at the right and the bottom is left out."""
    return np.asarray(square_sums(grey, cell_px) / cell_px**2)


def _at_pixels(cells: Cells, cell_px: int, width: int, height: int) -> Cells:
    rows = np.minimum(np.arange(height) // cell_px, cells.shape[0] - 1)
    columns = np.minimum(np.arange(width) // cell_px, cells.shape[1] - 1)
    return np.asarray(cells[rows][:, columns])


def _grown(cells: Cells) -> Cells:
    """The cells and the eight neighbours of each."""
    padded = np.pad(cells, 1)
    columns = padded[:, :-2] | padded[:, 1:-1] | padded[:, 2:]
    return np.asarray(columns[:-2] | columns[1:-1] | columns[2:])


def _ring(black: Cells) -> Cells:
    """The black cells that are connected to the corners, if at least three of the four corners are black: then it is an
    image circle, not a night sky."""
    rows, columns = black.shape
    corners = [(0, 0), (0, columns - 1), (rows - 1, 0), (rows - 1, columns - 1)]
    labels = connected_groups(black)
    of_corners = [int(labels[corner]) for corner in corners if labels[corner]]
    return np.isin(labels, of_corners) if len(of_corners) >= 3 else np.zeros_like(black)


def _without_specks(cells: Cells) -> Cells:
    labels = connected_groups(cells)
    return np.asarray((np.bincount(labels.ravel()) >= MIN_CELLS)[labels] & cells)


def _enclosed(still: Cells, body: Cells, dead: Cells) -> Cells:
    """Groups of still cells whose outline belongs to the body. Parts of the outline at other dead cells or at the
    border of the image do not count."""
    labels = connected_groups(still)
    bounding = np.pad(np.where(body, 1, np.where(dead | still, 0, 2)), 1)
    by_body, by_world = np.zeros((2, int(labels.max()) + 1))
    for window in (bounding[:-2, 1:-1], bounding[2:, 1:-1], bounding[1:-1, :-2], bounding[1:-1, 2:]):
        by_body += np.bincount(labels[window == 1], minlength=len(by_body))
        by_world += np.bincount(labels[window == 2], minlength=len(by_world))
    enclosed = (by_body > 0) & (by_body >= ENCLOSED_SHARE * (by_body + by_world))
    return np.asarray(enclosed[labels] & still)
