"""Two extrinsics next to each other, enlarged where they differ most, so that a glance shows which of them is right.
The range edges of the sweep are drawn over the grey image, joined by lines where they form an outline: this shows
an offset of a few pixels from the edge of a pole, which ten thousand coloured points do not. Both colours are from
Okabe and Ito's palette (2008), distinct in any colour vision, and neither occurs in a grey image. Axes are laid out
to the pixel.

The range edges of the sweep are drawn over the grey image, joined by lines where they form an outline: this shows an
offset of a few pixels from the edge of a pole, which ten thousand coloured points do not. Both colours are from Okabe
and Ito's palette (2008), distinct in any colour vision, and neither occurs in a grey image.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle as Patch
from numpy.typing import NDArray

from coec.calibration.types import Matrix4, Rig, Window
from coec.config import LimitsConfig
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.geometry.edges.image_edges import Rectangle
from coec.geometry.projection import unproject
from coec.io.images import GreyImages, decode_bgr
from coec.reports.difference_regions import (
    DifferenceRegion,
    DifferenceRegions,
    Outlines,
    Shift,
    difference_regions,
    project_outlines,
    shift_px,
)
from coec.reports.formatting import count, instant, number

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


COLOURS = ("#E69F00", "#56B4E9")
"""Colours of the two extrinsics: orange, sky blue."""

PLACES = 3
"""Most close-ups."""

NAMES = "ABC"

PANEL_PX = (490, 350)
"""Width and height of a panel."""

SHOWN_PX = 20.0
"""Wanted distance between the two extrinsics on the screen: several times the width of a line."""

ENLARGED = (1.5, 10.0)
"""Least and largest enlargement: the image must not shrink, and one pixel must not fill the picture."""

OVERVIEW_PX = 340
"""Largest height of the whole image."""

GAP_PX, AXIS_PX, TITLE_PX, LINE_PX = 12, 44, 26, 20
"""Gap between panels; room left of and below a panel for its axes; room above it; height of a line of text."""

SAME_PX = 0.05
"""Extrinsics that differ by less, everywhere in the image, look the same at any enlargement."""

CONTRAST_SHARE = 0.3
"""Greys of the image keep this share of their range away from black and white, so that lines stand out on all."""


@dataclass(frozen=True, slots=True, eq=False)
class Caption:
    """What the picture says about the two extrinsics.

    Attributes:
        before, after: their names.
        sigma: (6,) standard deviations of the second one, radians and metres, NaN where there is none; None: not known.
        network: the depth network that took part; empty: none, or not known.
    """

    before: str = "before"
    after: str = "after"
    sigma: NDArray[np.float64] | None = None
    network: str = ""


PLAIN = Caption()


def close_ups(
    window: Window,
    T_before: Matrix4,
    T_after: Matrix4,
    *,
    compensated: bool = True,
    caption: Caption = PLAIN,
    limits: LimitsConfig | None = None,
) -> NDArray[np.uint8]:
    """The image of a pair, and the parts of it in which two extrinsics (4, 4) differ most, drawn at each of them.

    Args:
        window: with at least one pair; the most telling pair is shown.
        compensated: whether sweeps are compensated for motion.
        limits: of images that are decoded; None: the usual ones.

    Returns:
        (H, W, 3) uint8 BGR, about 1080 px wide, on white.

    Raises:
        DecodeError: an image cannot be decoded.
        CalibrationError: an image is not of the camera's size.
    """
    shift = shift_px(window, T_before, T_after, compensated=compensated)
    enlarged = (
        ENLARGED[0] if shift is None else min(max(SHOWN_PX / max(shift.median_px, SAME_PX), ENLARGED[0]), ENLARGED[1])
    )
    camera = window.rig.camera
    size = (max(8, round(PANEL_PX[0] / enlarged)), max(8, round(PANEL_PX[1] / enlarged)))
    bounds = LimitsConfig() if limits is None else limits
    images = GreyImages(bounds)
    telling = difference_regions(window, images, T_before, T_after, size, PLACES, compensated=compensated)
    pair = window.pairs[telling.index]
    image = decode_bgr(pair.camera.image, bounds)
    width = 2 * (AXIS_PX + PANEL_PX[0]) + 3 * GAP_PX
    lines = folded(sentences(window, telling, shift, T_before, T_after, caption), width - 2 * GAP_PX)
    overview = _fitted(camera.width, camera.height, (width - 2 * GAP_PX, OVERVIEW_PX))
    row_px = TITLE_PX + PANEL_PX[1] + AXIS_PX
    height = GAP_PX + LINE_PX * len(lines) + GAP_PX + overview[1] + GAP_PX + row_px * len(telling.regions)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    for index, line in enumerate(lines):
        weight = "bold" if index == 0 else "normal"
        figure.text(GAP_PX / width, 1 - (GAP_PX + LINE_PX * index) / height, line, va="top", weight=weight, size=10)
    top = GAP_PX + LINE_PX * len(lines) + GAP_PX
    _overview(box(figure, (width - overview[0]) // 2, top, *overview), image, telling.regions)
    for row, place in enumerate(telling.regions):
        below = top + overview[1] + GAP_PX + row_px * row + TITLE_PX
        for column, (T, name) in enumerate(((T_before, caption.before), (T_after, caption.after))):
            left = GAP_PX + AXIS_PX + column * (PANEL_PX[0] + GAP_PX + AXIS_PX)
            axes = box(figure, left, below, *_fitted(place.part.width, place.part.height, PANEL_PX))
            _panel(axes, image, window.rig, telling.outlines, T, place.part, COLOURS[column])
            strength = number(place.strength[column], 1, sign=True)
            axes.set_title(f"{NAMES[row]}  {name}: {strength} σ", loc="left", size=10, pad=5, color="black")
    return bgr_of(figure)


def difference_text(T_before: Matrix4, T_after: Matrix4) -> str:
    """How far apart two extrinsics (4, 4) are: the angle, and the way between the two centres of the camera."""
    angle_deg = degrees(se3.rotation_angle_rad(T_after @ se3.inverse(T_before)))
    moved_m = float(np.linalg.norm(se3.inverse(T_after)[:3, 3] - se3.inverse(T_before)[:3, 3]))
    return f"{angle_deg:.2f}° and {100 * moved_m:.1f} cm"


def sentences(
    window: Window,
    telling: DifferenceRegions,
    shift: Shift | None,
    T_before: Matrix4,
    T_after: Matrix4,
    caption: Caption,
) -> list[str]:
    """The lines above the picture."""
    where = f"{window.rig.pair}, {instant(window.pairs[telling.index].stamp_ns)}"
    names = f"{caption.before} and {caption.after}"
    if shift is not None and shift.largest_px < SAME_PX:
        lines = [f"{where}: no difference between {names}: less than {SAME_PX:g} px anywhere in the image"]
    else:
        on_image = "" if shift is None else f", {shift.median_px:.1f} px in the image (median)"
        lines = [f"{where}: {names} are {difference_text(T_before, T_after)} apart{on_image}"]
        lines.append(
            f"{caption.after} − {caption.before}: {_axes_text(se3.difference(T_after, T_before), caption.sigma)}"
        )
    if caption.network:
        lines.append(f"depth network: {caption.network}")
    if telling.regions:
        lines.append(
            "Lines: outlines of near things that the LiDAR saw; dots: its other range edges. They belong on edges of "
            "the image."
        )
        lines.append("σ: how much stronger these are under the outlines than on average, 0 is chance. Axes: pixels.")
        before, after = telling.strength
        lines.append(
            f"All outlines of {count(telling.frames, 'image')}, not only those shown: {caption.before} "
            f"{number(before, 2, sign=True)} σ, {caption.after} {number(after, 2, sign=True)} σ."
        )
    else:
        lines.append("No outline of a near thing is in view at both extrinsics: there is nothing to enlarge.")
    return lines


def _axes_text(difference: NDArray[np.float64], sigma: NDArray[np.float64] | None) -> str:
    """The shift by axis, with its standard deviation where that is known; translations only where there are any."""
    spread = np.full(6, np.nan) if sigma is None else sigma
    parts = []
    for axis, name in enumerate(("pitch", "yaw", "roll", "right", "down", "forward")):
        factor, unit, digits = (degrees(1.0), "°", 2) if axis < 3 else (100.0, " cm", 1)
        if axis < 3 or np.isfinite(spread[axis]) or np.abs(difference[3:]).max() * factor >= 0.05:
            known = f" ± {factor * spread[axis]:.{digits}f}" if np.isfinite(spread[axis]) else ""
            parts.append(f"{name} {number(factor * difference[axis], digits, sign=True)}{known}{unit}")
    return ", ".join(parts)


def _fitted(width: int, height: int, within: tuple[int, int]) -> tuple[int, int]:
    """The largest size of this shape that fits `within`."""
    factor = min(within[0] / width, within[1] / height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def _overview(axes: Axes, image_bgr: NDArray[np.uint8], regions: Sequence[DifferenceRegion]) -> None:
    height, width = image_bgr.shape[:2]
    axes.imshow(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2RGB), extent=(-0.5, width - 0.5, height - 0.5, -0.5))
    axes.set_axis_off()
    for name, place in zip(NAMES, regions, strict=False):
        part = place.part
        for colour, line_width in (("black", 3.5), ("white", 1.5)):
            corner = (part.left - 0.5, part.top - 0.5)
            axes.add_patch(Patch(corner, part.width, part.height, fill=False, ec=colour, lw=line_width))
        axes.text(
            part.left, part.top, name, size=11, weight="bold", va="bottom" if part.top > 0.1 * height else "top",
            bbox={"facecolor": "white", "edgecolor": "black", "pad": 2}, clip_on=True,
        )  # fmt: skip


def _panel(
    axes: Axes,
    image_bgr: NDArray[np.uint8],
    rig: Rig,
    outlines: Outlines,
    T_camera_lidar: Matrix4,
    part: Rectangle,
    colour: str,
) -> None:
    left, right = part.left - 0.5, part.left + part.width - 0.5
    top, bottom = part.top - 0.5, part.top + part.height - 0.5
    grey = cv2.cvtColor(np.ascontiguousarray(image_bgr[part.slices]), cv2.COLOR_BGR2GRAY)
    darkest, brightest = np.percentile(grey, (1.0, 99.0))
    margin = CONTRAST_SHARE * max(1.0, brightest - darkest)
    axes.imshow(
        grey, cmap="gray", vmin=darkest - margin, vmax=brightest + margin, extent=(left, right, bottom, top),
        interpolation="bicubic",
    )  # fmt: skip
    at = project_outlines(outlines, rig, T_camera_lidar)
    pieces = at.uv_px[outlines.pieces[at.seen[outlines.pieces].all(axis=1)]]
    for colour_of_line, line_width in (("black", 4.5), (colour, 2.5)):
        axes.add_collection(
            LineCollection(list(pieces), colors=colour_of_line, linewidths=line_width, capstyle="round")
        )
    alone = at.seen.copy()
    alone[outlines.pieces.ravel()] = False
    u, v = at.uv_px[alone].T
    axes.scatter(u, v, s=14, c=colour, edgecolors="black", linewidths=0.7, zorder=2)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.tick_params(labelsize=9)
    scale_bar(axes, rig.camera, part)
