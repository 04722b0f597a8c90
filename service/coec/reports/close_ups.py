"""Two extrinsics next to each other, enlarged where they differ most, so that a glance shows which of them is right.

The range edges of the sweep are drawn over the grey image, joined by lines where they form an outline: this shows an
offset of a few pixels from the edge of a pole, which ten thousand coloured points do not. Both colours are from Okabe
and Ito's palette (2008), distinct in any colour vision, and neither occurs in a grey image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4, Rig, Window
from coec.config import LimitsConfig
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.geometry.edges.image_edges import Rectangle
from coec.io.images import GreyImages, decode_bgr
from coec.reports import difference_regions, drawing
from coec.reports.drawing import LABEL_PX, LINE_PX, TEXT_PX, Pixels
from coec.reports.formatting import count, instant, number

BAR_SHARE = 0.3
"""A scale bar takes at most this share of the width."""

BAR_LENGTHS_PX = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)

COLOURS = ((0, 159, 230), (233, 180, 86))
"""Colours of the two extrinsics, BGR: orange, sky blue."""

PLACES = 3
"""Most close-ups."""

NAMES = "ABC"

PANEL_PX = (490, 350)
"""Width and height of a panel."""

DOT_PX = 2.7
"""Radius of a dot."""

SHOWN_PX = 20.0
"""Wanted distance between the two extrinsics on the screen: several times the width of a line."""

ENLARGED = (1.5, 10.0)
"""Least and largest enlargement: the image must not shrink, and one pixel must not fill the picture."""

OVERVIEW_PX = 340
"""Largest height of the whole image."""

GAP_PX, AXIS_PX, TITLE_PX = 12, 44, 26
"""Gap between panels; room left of and below a panel for its axes; room above it."""

SAME_PX = 0.05
"""Extrinsics that differ by less, everywhere in the image, look the same at any enlargement."""

CONTRAST_SHARE = 0.3
"""Greys of the image keep this share of their range away from black and white, so that lines stand out on all."""


@dataclass(frozen=True, slots=True, eq=False)
class Caption:
    """What the picture says about the two extrinsics.

    Attributes:
        before, after: their names.
        covariance: (6, 6) of the error of the second one, radians and metres, NaN where there is none; None: not known.
        network: the depth network that took part; empty: none, or not known.
    """

    before: str = "before"
    after: str = "after"
    covariance: NDArray[np.float64] | None = None
    network: str = ""

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviations of the second one, radians and metres; NaN where there is none."""
        return np.full(6, np.nan) if self.covariance is None else np.sqrt(self.covariance.diagonal())


PLAIN = Caption()


def close_ups(
    window: Window,
    T_before: Matrix4,
    T_after: Matrix4,
    *,
    compensated: bool = True,
    caption: Caption = PLAIN,
    limits: LimitsConfig | None = None,
) -> Pixels:
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
    shift = difference_regions.shift_px(window, T_before, T_after, compensated=compensated)
    enlarged = (
        ENLARGED[0] if shift is None else min(max(SHOWN_PX / max(shift.median_px, SAME_PX), ENLARGED[0]), ENLARGED[1])
    )
    camera = window.rig.camera
    size = (max(8, round(PANEL_PX[0] / enlarged)), max(8, round(PANEL_PX[1] / enlarged)))
    bounds = LimitsConfig() if limits is None else limits
    images = GreyImages(bounds)
    telling = difference_regions.difference_regions(
        window, images, T_before, T_after, size, PLACES, compensated=compensated
    )
    pair = window.pairs[telling.index]
    image = decode_bgr(pair.camera.image, bounds)
    width = 2 * (AXIS_PX + PANEL_PX[0]) + 3 * GAP_PX
    text = drawing.folded(sentences(window, telling, shift, T_before, T_after, caption), width - 2 * GAP_PX)
    overview = drawing.fitted(camera.width, camera.height, (width - 2 * GAP_PX, OVERVIEW_PX))
    row_px = TITLE_PX + PANEL_PX[1] + AXIS_PX
    top = GAP_PX + LINE_PX * len(text) + GAP_PX
    picture = drawing.blank(width, top + overview[1] + GAP_PX + row_px * len(telling.regions))
    drawing.heading(picture, text, GAP_PX, GAP_PX)
    _overview(picture, Rectangle((width - overview[0]) // 2, top, *overview), image, telling.regions)
    for row, place in enumerate(telling.regions):
        below = top + overview[1] + GAP_PX + row_px * row + TITLE_PX
        titles = _titles(NAMES[row], place, telling.outlines, window.rig, T_after, caption)
        for column, (T, title) in enumerate(zip((T_before, T_after), titles, strict=True)):
            left = GAP_PX + AXIS_PX + column * (PANEL_PX[0] + GAP_PX + AXIS_PX)
            shown = Rectangle(left, below, *drawing.fitted(place.part.width, place.part.height, PANEL_PX))
            panel = picture[shown.slices]
            _panel(panel, image, window.rig, telling.outlines, T, place.part, COLOURS[column])
            drawing.axes(picture, shown, place.part)
            drawing.write(picture, title, (left, below - 8))
    return picture


def _titles(
    letter: str,
    place: difference_regions.DifferenceRegion,
    outlines: difference_regions.Outlines,
    rig: Rig,
    T_after: Matrix4,
    caption: Caption,
) -> tuple[str, str]:
    """Above both pictures of a part: how far the first extrinsic puts its outlines from where the second does, and how
    well the second is known there, each in degrees, pixels and σ of the second; and the strength of the edges."""
    middle_px = np.array([place.part.left + 0.5 * place.part.width, place.part.top + 0.5 * place.part.height])
    (deg_per_px,) = difference_regions.angles_deg(
        rig.camera, middle_px[None] - (0.5, 0.0), middle_px[None] + (0.5, 0.0)
    )
    spread = np.nan
    if caption.covariance is not None:
        spread = difference_regions.spread_px(outlines, rig, T_after, caption.covariance, place.part)

    def size(px: float) -> str:
        return f"{number(px * deg_per_px, 2)}° = {px:.1f} px"

    away = size(place.across_px) + (f" = {place.across_px / spread:.1f} σ" if spread > 0.0 else "")
    known = f"σ {size(spread)}, " if spread > 0.0 else ""
    before, after = (number(strength, 1, sign=True) for strength in place.strength)
    return (
        f"{letter}  {caption.before}: {away} beside, edges {before}",
        f"{letter}  {caption.after}: {known}edges {after}",
    )


def difference_text(T_before: Matrix4, T_after: Matrix4) -> str:
    """How far apart two extrinsics (4, 4) are: the angle, and the way between the two centres of the camera."""
    angle_deg = degrees(se3.rotation_angle_rad(T_after @ se3.inverse(T_before)))
    moved_m = float(np.linalg.norm(se3.inverse(T_after)[:3, 3] - se3.inverse(T_before)[:3, 3]))
    return f"{angle_deg:.2f}° and {100 * moved_m:.1f} cm"


def sentences(
    window: Window,
    telling: difference_regions.DifferenceRegions,
    shift: difference_regions.Shift | None,
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
        on_image = (
            "" if shift is None else f", {shift.median_deg:.2f}° = {shift.median_px:.1f} px in the image (median)"
        )
        lines = [f"{where}: {names} are {difference_text(T_before, T_after)} apart{on_image}"]
        lines.append(
            f"{caption.after} − {caption.before}: {_axes_text(se3.difference(T_after, T_before), caption.sigma)}"
        )
    if caption.network:
        lines.append(f"depth network: {caption.network}")
    if telling.regions:
        lines.append(
            "Lines: outlines of near things that the LiDAR saw; dots: its other range edges. They belong on edges of "
            "the image. Axes: pixels."
        )
        if caption.covariance is not None:
            lines.append(f"σ: standard deviation to which {caption.after} is known, at what is shown.")
        before, after = telling.strength
        lines.append(
            "Edges: mean strength of the image's edges under the outlines; 0 as anywhere in the image, 1 as its "
            f"stronger sixth. On all outlines of {count(telling.frames, 'image')}: {caption.before} "
            f"{number(before, 2, sign=True)}, {caption.after} {number(after, 2, sign=True)}."
        )
    else:
        lines.append("No outline of a near thing is in view at both extrinsics: there is nothing to enlarge.")
    return lines


def _axes_text(difference: NDArray[np.float64], spread: NDArray[np.float64]) -> str:
    """The shift by axis, with its standard deviation where that is known; translations only where there are any."""
    parts = []
    for axis, name in enumerate(("pitch", "yaw", "roll", "right", "down", "forward")):
        factor, unit, digits = (degrees(1.0), "°", 2) if axis < 3 else (100.0, " cm", 1)
        if axis < 3 or np.isfinite(spread[axis]) or np.abs(difference[3:]).max() * factor >= 0.05:
            known = f" ± {factor * spread[axis]:.{digits}f}" if np.isfinite(spread[axis]) else ""
            parts.append(f"{name} {number(factor * difference[axis], digits, sign=True)}{known}{unit}")
    return ", ".join(parts)


def _overview(
    picture: Pixels, shown: Rectangle, image_bgr: Pixels, regions: Sequence[difference_regions.DifferenceRegion]
) -> None:
    view = picture[shown.slices]
    smaller = shown.width < image_bgr.shape[1]
    view[:] = cv2.resize(
        image_bgr, (shown.width, shown.height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    )
    whole = Rectangle(0, 0, image_bgr.shape[1], image_bgr.shape[0])
    for name, place in zip(NAMES, regions, strict=False):
        part = place.part
        corners = np.array([(part.left, part.top), (part.left + part.width, part.top + part.height)]) - 0.5
        (left, top), (right, bottom) = np.rint(drawing.places(corners, whole, shown) + 0.5).astype(int).tolist()
        sides = Rectangle(left, top, right - left, bottom - top)
        drawing.outline(view, sides, drawing.BLACK, 5)
        drawing.outline(view, sides, drawing.WHITE, 2)
        box = Rectangle(left, top - 20 if top > 20 else top, 19, 20)
        drawing.tint(view, box, drawing.WHITE)
        drawing.outline(view, box, drawing.BLACK)
        drawing.write(view, name, (box.left + 9.5, box.top + 15.5), TEXT_PX, align=0.5, bold=True)


def _panel(
    panel: Pixels,
    image_bgr: Pixels,
    rig: Rig,
    outlines: difference_regions.Outlines,
    T_camera_lidar: Matrix4,
    part: Rectangle,
    colour: drawing.Colour,
) -> None:
    height, width = panel.shape[:2]
    grey = cv2.cvtColor(np.ascontiguousarray(image_bgr[part.slices]), cv2.COLOR_BGR2GRAY).astype(np.float32)
    darkest, brightest = np.percentile(grey, (1.0, 99.0))
    margin = CONTRAST_SHARE * max(1.0, brightest - darkest)
    stretched = (grey - darkest + margin) * (255.0 / (brightest - darkest + 2.0 * margin))
    enlarged = cv2.resize(stretched, (width, height), interpolation=cv2.INTER_CUBIC)
    panel[:] = np.clip(np.rint(enlarged), 0.0, 255.0)[..., None]
    at = difference_regions.project_outlines(outlines, rig, T_camera_lidar)
    on_panel = drawing.places(at.uv_px, part, Rectangle(0, 0, width, height))
    pieces = on_panel[outlines.pieces[at.seen[outlines.pieces].all(axis=1)]]
    for colour_of_line, line_width in ((drawing.BLACK, 4), (colour, 2)):
        drawing.lines(panel, pieces, colour_of_line, line_width)
    alone = at.seen.copy()
    alone[outlines.pieces.ravel()] = False
    drawing.dots(panel, on_panel[alone], colour, DOT_PX)
    _scale_bar(panel, rig.camera, part)


def _scale_bar(panel: Pixels, camera: Camera, part: Rectangle) -> None:
    """Draws a scale bar in the lower left corner of a part of an image, with its length in pixels and degrees."""
    height, width = panel.shape[:2]
    length = max((bar for bar in BAR_LENGTHS_PX if bar <= BAR_SHARE * part.width), default=BAR_LENGTHS_PX[0])
    u, v = part.left + 0.5 * part.width, part.top + 0.5 * part.height
    (angle_deg,) = difference_regions.angles_deg(
        camera, np.array([[u - 0.5 * length, v]]), np.array([[u + 0.5 * length, v]])
    )
    angle = f" = {angle_deg:.2f}°" if np.isfinite(angle_deg) else ""
    x, y = round(0.03 * width), round(0.93 * height)
    bar = Rectangle(x, y, round(length * width / part.width), max(4, round(0.025 * height)))
    drawing.tint(panel, bar, drawing.WHITE)
    drawing.outline(panel, bar, drawing.BLACK)
    drawing.write(panel, f"{length} px{angle}", (x + 2, y - 0.02 * height - 3), LABEL_PX, ground=0.85)
