"""Where in the picture range edges and image edges agree at an extrinsic, and in which direction they are apart.

If all arrows point one way, the extrinsic is wrong; arrows only at the rim mean a wrong lens, arrows only on near
objects a wrong translation. Colours go from pale to dark (reversed viridis), so that they can be read in grey, too.
"""

from __future__ import annotations

from math import degrees

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from coec.adapters.images.codec import GreyImages, decode_grey
from coec.calibration.types import Matrix4, Window
from coec.config import LimitsConfig
from coec.evaluation.local_shifts import LEAST_EDGES, LocalShifts, local_shifts
from coec.geometry.cameras import pixel_rad
from coec.reports.canvas import DPI, bgr_of, box, folded
from coec.reports.instants import instant
from coec.reports.page.words import count, number

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
        f"{known} of {eligible} parts tell, from {pairs}. They lie {np.median(shifts.size_px[shifts.known]):.1f} px beside "
        f"(median; a pixel is {pixel_deg:.3f}° on the axis).",
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
