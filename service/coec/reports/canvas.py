"""Pictures with axes, laid out to the pixel. Drawn in memory: no display, no global state of matplotlib."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from math import degrees

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle as Patch
from numpy.typing import NDArray

from coec.geometry.cameras import Camera
from coec.geometry.edges.image_edges import Rectangle
from coec.geometry.projection import unproject

DPI = 100
"""A point of type is 1.4 px: type of 9 points, the smallest, is legible without enlarging."""

LETTER_PX = 8.4
"""Average width of a letter of bold 10-point type, in lines with many figures."""

BAR_SHARE = 0.3
"""A scale bar takes at most this share of the width."""

BAR_LENGTHS_PX = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def box(figure: Figure, left: int, top: int, width: int, height: int) -> Axes:
    """Axes at these pixels of the figure, counted from its upper left corner."""
    across, down = figure.get_size_inches() * figure.dpi
    return figure.add_axes((left / across, 1.0 - (top + height) / down, width / across, height / down))


def scale_bar(axes: Axes, camera: Camera, part: Rectangle) -> None:
    """Draws a scale bar in the lower left corner of a part of an image, with its length in pixels and degrees."""
    length = max((bar for bar in BAR_LENGTHS_PX if bar <= BAR_SHARE * part.width), default=BAR_LENGTHS_PX[0])
    x, y = part.left - 0.5 + 0.03 * part.width, part.top - 0.5 + 0.93 * part.height
    u, v = part.left + 0.5 * part.width, part.top + 0.5 * part.height
    rays, valid = unproject(camera, np.array([[u - 0.5 * length, v], [u + 0.5 * length, v]]))
    angle = f" = {degrees(np.arccos(np.clip(rays[0] @ rays[1], -1.0, 1.0))):.2f}°" if valid.all() else ""
    axes.add_patch(Patch((x, y), length, 0.025 * part.height, facecolor="white", edgecolor="black", zorder=4))
    axes.text(
        x, y - 0.02 * part.height, f"{length} px{angle}", size=9, va="bottom", zorder=4,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.85},
    )  # fmt: skip


def folded(lines: Sequence[str], width_px: int) -> list[str]:
    """The lines wrapped so that none is wider than `width_px` in 10-point type."""
    return [part for line in lines for part in textwrap.wrap(line, int(width_px / LETTER_PX))]


def bgr_of(figure: Figure) -> NDArray[np.uint8]:
    """The drawn figure, (H, W, 3) uint8 BGR."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    rgba = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return np.asarray(cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGR), dtype=np.uint8)
