"""Where in the image range edges and image edges agree at an extrinsic, and in which direction they differ. The image
is cut into cells. In each cell the range edges of all pairs are shifted together by a few pixels, and the shift at
which they fit the image best is reported: zero where extrinsic and lens are right. If all arrows point one way, the
extrinsic is wrong; arrows only at the rim mean a wrong lens, arrows only on near objects a wrong translation.
Colours go from pale to dark (reversed viridis), so that they can be read in grey, too.

The picture is cut into cells. In each cell the range edges of all pairs are shifted together by a few pixels, and the
shift at which they fit the image best is reported: zero where extrinsic and lens are right, not zero where they are
wrong. A turn of the camera shifts all cells alike, a wrong lens those at the rim, a step those with near objects.

If all arrows point one way, the extrinsic is wrong; arrows only at the rim mean a wrong lens, arrows only on near
objects a wrong translation. Colours go from pale to dark (reversed viridis), so that they can be read in grey, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import FramePair, ImageReader, Matrix4, Rig, Window
from coec.config import LimitsConfig
from coec.errors import CalibrationError
from coec.geometry.cameras import Camera, pixel_rad
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID, EdgeScales
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.projection import points_in_view
from coec.io.images import GreyImages, decode_grey
from coec.reports.close_ups import DPI, bgr_of, box, folded
from coec.reports.difference_regions import evenly
from coec.reports.formatting import count, instant, number

FRAMES = 25
"""Pairs that are looked at, at most: those of a window."""

CELLS = (12, 8, 6, 4)
"""Cells along the longer side of the image: the most with which enough range edges lie in well-filled cells."""

ENOUGH, MOST_SHARE = 150, 0.8
"""A cell is well filled with so many range edges, and so large a share of all range edges must lie in such cells."""

REACH_SHARE, LEAST_REACH_PX = 0.008, 6
"""How far range edges are shifted, as a share of the longer side: 11 px on 1408, which is more than a degree."""

LEAST_EDGES = 100
"""A cell with fewer range edges tells nothing: with a few dozen, which repeat while the vehicle stands, some shift
looks best by chance."""

TELLING = 4.0
"""Standard deviations by which the best shift must stand out from the median of all. Chance reaches 3, because some
hundred shifts are no more than a few dozen independent ones."""

CLEARER = 1.0
"""Standard deviations by which the best shift must lie above every shift that is not next to it; otherwise there are
two candidates. See docs/measured.md."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalShifts:
    """Figures of the cells of a picture, row by row (R, C).

    Attributes:
        edges: number of range edges in the cell, over all pairs.
        shift_px: (R, C, 2) right and down, by which they would have to be shifted to fit best; NaN where they do not
            tell.
        strength: of the image's edges under the unshifted range edges, standard deviations from the mean over the
            image.
        frames: how many pairs were looked at.
        reach_px: how far range edges were shifted.
    """

    edges: NDArray[np.int64]
    shift_px: NDArray[np.float64]
    strength: NDArray[np.float64]
    frames: int
    reach_px: int

    @property
    def known(self) -> NDArray[np.bool_]:
        """(R, C) cells that tell where their range edges belong."""
        return np.asarray(np.isfinite(self.shift_px).all(axis=2))

    @property
    def size_px(self) -> NDArray[np.float64]:
        """(R, C) lengths of the shifts."""
        return np.hypot(self.shift_px[..., 0], self.shift_px[..., 1])


def local_shifts(window: Window, images: ImageReader, T_camera_lidar: Matrix4, *, compensated: bool) -> LocalShifts:
    """The shifts of a window at an extrinsic (4, 4).

    Raises:
        DecodeError: an image cannot be decoded.
        CalibrationError: an image is not of the camera's size.
    """
    rig, camera = window.rig, window.rig.camera
    lit = rig.mask if rig.mask is not None else np.ones((camera.height, camera.width), np.bool_)
    scales = EdgeScales(lit, 0, 0, upright=rig.T_camera_lidar_nominal[:2, 2])
    side = max(camera.width, camera.height)
    reach = max(LEAST_REACH_PX, round(REACH_SHARE * side))
    sampled = [window.pairs[index] for index in evenly(len(window.pairs), FRAMES)]
    placed = [_placed(pair, rig, T_camera_lidar, compensated=compensated) for pair in sampled]
    rows, columns = _grid(np.concatenate([each.uv_px for each in placed]), camera)
    cells = rows * columns
    moves = np.arange(-reach, reach + 1)
    sums = np.zeros((len(moves), len(moves), cells))
    squares, edges, spread = np.zeros(cells), np.zeros(cells, np.int64), np.zeros(cells)
    for pair, each in zip(sampled, placed, strict=True):
        grey = images.grey(pair.camera)
        if grey.shape != scales.shape:
            (height, width), model = grey.shape, f"{camera.width} x {camera.height}"
            raise CalibrationError(f"an image has {width} x {height} px, the camera model {model} px")
        strength = _padded(scales.pyramid(grey).sharp, reach)
        cell = _cells(each.uv_px, camera, rows, columns)
        u, v = each.uv_px.T
        flat, stride = strength.ravel(), strength.shape[1]
        base = (v + reach) * stride + u + reach
        for down, move_down in enumerate(moves):
            for right, move_right in enumerate(moves):
                at = flat[base + (move_down * stride + move_right)]
                sums[down, right] += np.bincount(cell, each.weight * at, cells)
        squares += np.bincount(cell, each.weight**2, cells)
        edges += np.bincount(cell, minlength=cells)
        spread += np.bincount(cell, each.weight, cells)
    z = sums / np.sqrt(np.maximum(squares, 1e-9))
    shift = np.full((cells, 2), np.nan)
    for k in np.flatnonzero(edges >= LEAST_EDGES):
        shift[k] = _best(z[:, :, k], reach)
    mean = sums[reach, reach] / np.maximum(spread, 1e-9)
    return LocalShifts(
        edges.reshape(rows, columns),
        shift.reshape(rows, columns, 2),
        np.where(edges > 0, mean, np.nan).reshape(rows, columns),
        len(sampled),
        reach,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _ImageEdgePoints:
    """The range edges of a pair in its image: (n, 2) the pixels nearest to them, and (n,) their weights."""

    uv_px: NDArray[np.int64]
    weight: NDArray[np.float64]


def _placed(pair: FramePair, rig: Rig, T_camera_lidar: Matrix4, *, compensated: bool) -> _ImageEdgePoints:
    edges = range_edges(pair.lidar.xyz_m, pair.lidar.ring)
    xyz_m = compensate(pair, rig, enabled=compensated, selection=edges.index) + edges.shift_m
    seen = points_in_view(rig.camera, T_camera_lidar, xyz_m, rig.mask, 0.0)
    nearest = np.clip(np.rint(seen.uv_px).astype(np.int64), 0, (rig.camera.width - 1, rig.camera.height - 1))
    return _ImageEdgePoints(nearest, edges.weight[seen.which].astype(np.float64))


def _grid(uv_px: NDArray[np.int64], camera: Camera) -> tuple[int, int]:
    """Rows and columns of cells for range edges at these pixels (n, 2)."""
    side = max(camera.width, camera.height)
    for along in CELLS:
        columns, rows = (max(1, round(along * length / side)) for length in (camera.width, camera.height))
        held = np.bincount(_cells(uv_px, camera, rows, columns), minlength=1)
        if held[held >= ENOUGH].sum() >= MOST_SHARE * len(uv_px):
            break
    return rows, columns


def _cells(uv_px: NDArray[np.int64], camera: Camera, rows: int, columns: int) -> NDArray[np.int64]:
    """(n,) the number of the cell that holds each of the pixels (n, 2)."""
    u, v = uv_px.T
    return np.asarray((v * rows // camera.height) * columns + u * columns // camera.width, dtype=np.int64)


def _padded(edges: NDArray[np.int8], reach: int) -> NDArray[np.float32]:
    """Edge strengths, padded by `reach`; zero in the padding and where the image is masked."""
    strength = np.where(edges == VOID, np.float32(0.0), edges.astype(np.float32) / STRENGTH_STEPS)
    return np.pad(strength, reach)


def _best(z: NDArray[np.float64], reach: int) -> tuple[float, float]:
    """The shift, right and down, at the peak of a cell's significances, to a fraction of a step; NaN if none stands
    out."""
    nothing = (np.nan, np.nan)
    row, column = (int(k) for k in np.unravel_index(int(np.argmax(z)), z.shape))
    # With the best shift at the rim of those tried, the peak lies beyond.
    if not (0 < row < 2 * reach and 0 < column < 2 * reach):
        return nothing
    top = float(z[row, column])
    elsewhere = z.copy()
    elsewhere[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3] = -np.inf
    if top - float(np.median(z)) < TELLING or top - float(elsewhere.max()) < CLEARER:
        return nothing
    down = _summit(z[row - 1, column], top, z[row + 1, column])
    right = _summit(z[row, column - 1], top, z[row, column + 1])
    return column - reach + right, row - reach + down


def _summit(before: float, top: float, after: float) -> float:
    """Place of the summit of the parabola through three values at -1, 0 and 1."""
    bend = 2.0 * top - before - after
    return 0.5 * (after - before) / bend if bend > 0.0 else 0.0


PICTURE_PX = (1060, 900)
"""Largest width and height of the image: with twelve cells in a row, each has room for its figures."""

MARGIN_PX, LINE_PX, BAR_PX, BAR_AXIS_PX = 12, 20, 16, 46
"""Margin about the picture, height of a line of text, height of the colour bar, room for its figures."""

COLOURS = "viridis_r"

FADED = 0.45
"""How much of the image's contrast is left as it fades to white."""

COVER = 0.6
"""Opacity of a cell's colour over the image."""

MOST = 0.9
"""This share of the cells that tell lies within the colour scale."""

LEAST_END_PX = 3.0
"""Least end of the colour scale: smaller shifts are the scatter of range edges."""

QUIET = "#444444"
"""Colour of the figure in a cell that does not tell."""

ARROW_SHARE = 0.42
"""The longest arrow, as a share of a cell's shorter side."""


def residual_map(
    window: Window, T_camera_lidar: Matrix4, *, compensated: bool = True, name: str = ""
) -> NDArray[np.uint8]:
    """The map of a window at an extrinsic (4, 4), which is called `name`.

    Returns:
        (H, W, 3) uint8 BGR on white: in each cell how many pixels its range edges are off the edges of the image, and
        how many range edges there are.

    Raises:
        DecodeError: an image cannot be decoded.
        CalibrationError: an image is not of the camera's size.
    """
    shifts = local_shifts(window, GreyImages(LimitsConfig()), T_camera_lidar, compensated=compensated)
    pair = window.pairs[len(window.pairs) // 2]
    lines = folded(sentences(window, shifts, name), PICTURE_PX[0])
    return _render(decode_grey(pair.camera.image, LimitsConfig()), shifts, lines)


def sentences(window: Window, shifts: LocalShifts, name: str) -> list[str]:
    """The lines above the picture."""
    first, last = (instant(window.pairs[index].stamp_ns) for index in (0, -1))
    when = first if len(window.pairs) == 1 else f"{first} to {last}"
    at = f" at {name}" if name else ""
    known, eligible = int(shifts.known.sum()), int((shifts.edges >= LEAST_EDGES).sum())
    pairs = count(shifts.frames, "pair")
    lines = [f"{window.rig.pair}, {when}: range edges on edges of the image{at}"]
    if known == 0:
        lines.append(
            f"No part of the image tells where its range edges belong ({eligible} have enough of them, of {pairs})."
        )
        return lines
    right, down = np.median(shifts.shift_px[shifts.known], axis=0).tolist()
    deviation = shifts.shift_px[shifts.known] - (right, down)
    spread = float(np.median(np.hypot(*deviation.T)))
    pixel_deg = degrees(pixel_rad(window.rig.camera))
    in_common = f"{number(right, 1, sign=True)} px right, {number(down, 1, sign=True)} px down"
    lines += [
        f"{known} of {eligible} parts tell, from {pairs}. They lie {np.median(shifts.size_px[shifts.known]):.1f} px "
        f"beside (median; a pixel is {pixel_deg:.3f}° on the axis).",
        f"In common to all: {in_common}; half of them are within {spread:.1f} px of it.",
        "Arrows: where range edges would lie best, enlarged. Figures: how far that is, and of how many range edges. "
        "No colour: not told.",
    ]
    return lines


def _render(grey: NDArray[np.uint8], shifts: LocalShifts, lines: list[str]) -> NDArray[np.uint8]:
    height, width = grey.shape
    factor = min(PICTURE_PX[0] / width, PICTURE_PX[1] / height)
    shown = max(1, round(width * factor)), max(1, round(height * factor))
    top = MARGIN_PX + LINE_PX * len(lines) + MARGIN_PX
    total = (PICTURE_PX[0] + 2 * MARGIN_PX, top + shown[1] + MARGIN_PX + BAR_PX + BAR_AXIS_PX)
    figure = Figure(figsize=(total[0] / DPI, total[1] / DPI), dpi=DPI, facecolor="white")
    for index, line in enumerate(lines):
        place = (MARGIN_PX / total[0], 1.0 - (MARGIN_PX + LINE_PX * index) / total[1])
        figure.text(*place, line, va="top", size=10, weight="bold" if index == 0 else "normal")
    axes = box(figure, MARGIN_PX + (PICTURE_PX[0] - shown[0]) // 2, top, *shown)
    pale = 255.0 - FADED * (255.0 - cv2.resize(grey, shown, interpolation=cv2.INTER_AREA))
    axes.imshow(pale, cmap="gray", vmin=0, vmax=255, extent=(-0.5, width - 0.5, height - 0.5, -0.5))
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_axis_off()
    # A quantile, so that a cell that matches a wrong edge does not pale all others.
    large = float(np.quantile(shifts.size_px[shifts.known], MOST)) if shifts.known.any() else 0.0
    end_px = max(LEAST_END_PX, large)
    colours = ScalarMappable(Normalize(0.0, end_px), COLOURS)
    for row, column in np.ndindex(shifts.edges.shape):
        _cell(axes, shifts, (row, column), (width, height), colours, end_px)
    bar = box(figure, MARGIN_PX + PICTURE_PX[0] // 4, top + shown[1] + MARGIN_PX, PICTURE_PX[0] // 2, BAR_PX)
    label = "range edges beside edges of the image, px"
    figure.colorbar(colours, cax=bar, orientation="horizontal", extend="max", label=label)
    return bgr_of(figure)


def _cell(
    axes: Axes,
    shifts: LocalShifts,
    place: tuple[int, int],
    image_px: tuple[int, int],
    colours: ScalarMappable,
    end_px: float,
) -> None:
    """Draws a cell; nothing where it has no range edge."""
    row, column = place
    if shifts.edges[row, column] == 0:
        return
    rows, columns = shifts.edges.shape
    width, height = image_px[0] / columns, image_px[1] / rows
    left, top = column * width - 0.5, row * height - 0.5
    u, v = left + 0.5 * width, top + 0.5 * height
    ink, size = QUIET, ""
    if shifts.known[row, column]:
        ink, length = "black", float(shifts.size_px[row, column])
        size = f"{length:.1f} px\n"
        colour = colours.to_rgba(np.array(length))
        axes.add_patch(Rectangle((left, top), width, height, facecolor=colour, edgecolor="none", alpha=COVER))
        longest = ARROW_SHARE * min(width, height) / max(end_px, length)
        right, down = (longest * shifts.shift_px[row, column]).tolist()
        for line_width, line_colour in ((4.0, "white"), (1.8, "black")):
            arrow = {"arrowstyle": "->", "color": line_colour, "linewidth": line_width, "shrinkA": 0, "shrinkB": 0}
            middle = (u, v - 0.15 * height)
            axes.annotate("", (u + right, middle[1] + down), middle, arrowprops=arrow, zorder=5)
    axes.add_patch(Rectangle((left, top), width, height, fill=False, edgecolor="white", linewidth=0.8))
    axes.text(
        u, top + 0.97 * height, f"{size}{shifts.edges[row, column]}", ha="center", va="bottom", size=9, color=ink,
        linespacing=1.0, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.7},
    )  # fmt: skip
