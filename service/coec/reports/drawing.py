"""Drawing on pictures with OpenCV: text, lines, arrows, axes, scales of colours, and LiDAR points on the image they
were taken with, which a person looks at to judge an extrinsic.

A picture is (H, W, 3) uint8 BGR; places are its pixels (x, y) from the upper left corner, and the centre of a pixel is
an integer. A view `picture[rectangle.slices]` is a picture, too: what is drawn on it is cut off at its sides.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.cameras import Camera
from coec.geometry.edges.image_edges import Rectangle
from coec.geometry.projection import points_in_view
from coec.io.images import NEAREST_M, RangeScale, scale_of
from coec.reports.charts import Tick, linear_ticks, tick_label
from coec.untrusted import printable

Pixels = NDArray[np.uint8]
Colour = tuple[int, int, int]

BLACK, GREY, WHITE = (0, 0, 0), (68, 68, 68), (255, 255, 255)

TEXT_PX, LABEL_PX = 15, 13
"""Size of type of sentences, and of labels and figures: the smallest is legible without enlarging."""

LINE_PX = 20
"""Height of a line of text."""

TICK_PX = 5
"""Length of a tick of an axis."""

TICK_SPACING_PX = (62, 44)
"""Least distance between two ticks of an axis, across and down."""

FONT = "uni"
"""The face for all scripts that comes with OpenCV. It has one weight: bold is the same drawn twice."""

SAMPLING = 4
"""Type is drawn so many times as large and shrunk, so that thin strokes and the space between letters are exact."""

BOLD_SHARE = 0.045
"""Distance of both in bold type, as a share of its size."""

SHIFT = 4
"""OpenCV takes places in fractions of a pixel, with so many bits after the point."""

_VIRIDIS = cv2.applyColorMap(np.arange(255, -1, -1, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0]


def blank(width: int, height: int) -> Pixels:
    """A white picture."""
    return np.full((height, width, 3), 255, dtype=np.uint8)


def fitted(width: int, height: int, within: tuple[int, int]) -> tuple[int, int]:
    """The largest width and height of this shape that fit `within`."""
    factor = min(within[0] / width, within[1] / height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def places(uv_px: NDArray[np.floating], part: Rectangle, shown: Rectangle) -> NDArray[np.float64]:
    """(..., 2) places on the view of `shown`, which shows a part of an image, of pixels (..., 2) of that image."""
    scale = np.array([shown.width / part.width, shown.height / part.height])
    return np.asarray((uv_px - np.array([part.left - 0.5, part.top - 0.5])) * scale - 0.5)


def text_width(text: str, size_px: int = TEXT_PX, *, bold: bool = False) -> int:
    """Width of a line of text, px."""
    size = cv2.getTextSize((0, 0), printable(text), (0, 0), cv2.FontFace(FONT), SAMPLING * size_px)
    return -(-size[2] // SAMPLING) + (round(BOLD_SHARE * size_px) if bold else 0)


def write(
    picture: Pixels,
    text: str,
    at: tuple[float, float],
    size_px: int = TEXT_PX,
    *,
    align: float = 0.0,
    bold: bool = False,
    colour: Colour = BLACK,
    ground: float = 0.0,
) -> None:
    """Writes a line of text, as `printable` shows it: an unpaired surrogate ends OpenCV's process.

    Args:
        at: on its baseline.
        align: share of its width that is left of `at`: 0 begins there, 0.5 is centred, 1 ends there.
        ground: opacity of a white ground behind it; 0 for none.
    """
    width, above, below = text_width(text, size_px, bold=bold), size_px, -(-size_px // 3)
    left, top = round(at[0] - align * width), round(at[1]) - above
    if ground:
        tint(picture, Rectangle(left - 2, top + size_px // 5, width + 4, round(1.05 * size_px)), WHITE, ground)
    large = np.zeros((SAMPLING * (above + below), SAMPLING * (width + 1)), dtype=np.uint8)
    for offset in (0, round(SAMPLING * BOLD_SHARE * size_px)) if bold else (0,):
        start = (offset, SAMPLING * above)
        cv2.putText(large, printable(text), start, (255,), cv2.FontFace(FONT), SAMPLING * size_px)
    cover = cv2.resize(large, (width + 1, above + below), interpolation=cv2.INTER_AREA)[..., None]
    tint(picture, Rectangle(left, top, width + 1, above + below), colour, cover.astype(np.float64) / 255.0)


def heading(picture: Pixels, lines: Sequence[str], left: int, top: int) -> None:
    """Writes lines of text below each other, the first one bold."""
    for index, line in enumerate(lines):
        write(picture, line, (left, top + LINE_PX * index + TEXT_PX - 2), bold=index == 0)


def folded(lines: Sequence[str], width_px: int) -> list[str]:
    """The lines wrapped between words so that none is wider than `width_px` as `heading` writes them."""
    parts: list[str] = []
    for index, line in enumerate(lines):
        part = ""
        for word in line.split():
            longer = f"{part} {word}".lstrip()
            if part and text_width(longer, bold=index == 0) > width_px:
                parts.append(part)
                longer = word
            part = longer
        parts.append(part)
    return parts


def tint(picture: Pixels, area: Rectangle, colour: Colour | Pixels, opacity: float | NDArray[np.float64] = 1.0) -> None:
    """Lays a colour over an area; `opacity` is one figure or one for each pixel of the area, (h, w, 1)."""
    rows, columns = slice(max(0, -area.top), area.height), slice(max(0, -area.left), area.width)
    view = picture[
        max(0, area.top) : max(0, area.top + area.height), max(0, area.left) : max(0, area.left + area.width)
    ]
    cover = np.broadcast_to(opacity, (area.height, area.width, 1))[rows, columns][: view.shape[0], : view.shape[1]]
    view[:] = np.rint((1.0 - cover) * view + cover * np.asarray(colour, dtype=np.float64))


def lines(picture: Pixels, pieces: NDArray[np.floating], colour: Colour, width: int) -> None:
    """Draws lines with round ends through places (N, P, 2): N lines of P places. Their width as OpenCV counts it: 1 is
    1.4 px, 2 is 3.4 px, 4 is 5.4 px."""
    fixed = np.rint(pieces * (1 << SHIFT)).astype(np.int32)
    cv2.polylines(picture, list(fixed), False, colour, width, cv2.LINE_AA, SHIFT)


def dots(picture: Pixels, at: NDArray[np.floating], colour: Colour, radius_px: float) -> None:
    """Draws discs with a black rim at places (N, 2)."""
    # A circle of OpenCV's own is a diamond at this size.
    turn = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    for centre in at:
        for filling, radius in ((BLACK, radius_px), (colour, radius_px - 1.0)):
            disc = np.rint((centre + radius * circle) * (1 << SHIFT)).astype(np.int32)
            cv2.fillConvexPoly(picture, disc, filling, cv2.LINE_AA, SHIFT)


def outline(picture: Pixels, area: Rectangle, colour: Colour, width_px: int = 1) -> None:
    """Draws the sides of an area, on its outermost pixels."""
    last = area.left + area.width - 1, area.top + area.height - 1
    cv2.rectangle(picture, (area.left, area.top), last, colour, width_px)


def arrow(
    picture: Pixels,
    tail: NDArray[np.floating],
    head: NDArray[np.floating],
    tip_px: float,
    styles: Sequence[tuple[Colour, int]],
) -> None:
    """Draws an arrow between two places (2,), once in each style, a colour and a width as for `lines`: the first
    lies below. The tip is no longer than the arrow."""
    way = head - tail
    length = float(np.hypot(*way))
    along = way / length if length > 0.0 else np.zeros(2)
    across = np.array([-along[1], along[0]])
    tip_px = min(tip_px, length)
    barbs = np.stack([head - tip_px * (along + 0.5 * across), head, head - tip_px * (along - 0.5 * across)])
    for colour, width in styles:
        lines(picture, np.stack([tail, head])[None], colour, width)
        lines(picture, barbs[None], colour, width)


def axes(picture: Pixels, shown: Rectangle, part: Rectangle, *, labels: tuple[str, str] = ("", "")) -> None:
    """Draws the frame and the axes of a part of an image that lies at `shown`: ticks at round columns and rows of the
    image, and the names of both axes."""
    outline(picture, Rectangle(shown.left - 1, shown.top - 1, shown.width + 2, shown.height + 2), BLACK)
    bottom = shown.top + shown.height
    for value in linear_ticks(part.left - 0.5, part.left + part.width - 0.5, max(2, shown.width // TICK_SPACING_PX[0])):
        x = round(shown.left + float(places(np.array([value, 0.0]), part, shown)[0]))
        cv2.line(picture, (x, bottom), (x, bottom + TICK_PX), BLACK)
        write(picture, tick_label(value), (x, bottom + TICK_PX + 14), LABEL_PX, align=0.5)
    widest = 0
    for value in linear_ticks(part.top - 0.5, part.top + part.height - 0.5, max(2, shown.height // TICK_SPACING_PX[1])):
        y = round(shown.top + float(places(np.array([0.0, value]), part, shown)[1]))
        cv2.line(picture, (shown.left - 1 - TICK_PX, y), (shown.left - 1, y), BLACK)
        write(picture, tick_label(value), (shown.left - TICK_PX - 4, y + 5), LABEL_PX, align=1.0)
        widest = max(widest, text_width(tick_label(value), LABEL_PX))
    across, up = labels
    if across:
        write(picture, across, (shown.left + shown.width / 2, bottom + TICK_PX + 34), align=0.5)
    if up:
        strip = blank(text_width(up) + 2, LINE_PX)
        write(strip, up, (0, TEXT_PX))
        turned = cv2.rotate(strip, cv2.ROTATE_90_COUNTERCLOCKWISE)
        top, left = shown.top + (shown.height - turned.shape[0]) // 2, shown.left - TICK_PX - 6 - widest - LINE_PX
        picture[top : top + turned.shape[0], left : left + LINE_PX] = turned


def colours(share: NDArray[np.floating] | float) -> NDArray[np.uint8]:
    """Colours (..., 3) BGR at places (...) of a scale from 0, yellow, to 1, violet (viridis, reversed)."""
    return np.asarray(_VIRIDIS[np.rint(255.0 * np.clip(share, 0.0, 1.0)).astype(np.int64)], dtype=np.uint8)


def colour_scale(
    picture: Pixels, area: Rectangle, ticks: Sequence[Tick], label: str, *, open_end: bool = False
) -> None:
    """Draws the scale of `colours` with its ticks, at shares of its length, and its name below it. With an open end it
    ends in a tip: there may be more than it shows."""
    right, bottom = area.left + area.width, area.top + area.height
    picture[area.slices] = colours(np.linspace(0.0, 1.0, area.width))
    around = [(area.left - 1, area.top - 1), (right, area.top - 1)]
    if open_end:
        tip = (right + area.height + area.height // 2, area.top + area.height // 2)
        inside = np.array([(right, area.top), tip, (right, bottom - 1)])
        cv2.fillConvexPoly(picture, inside, colours(1.0).tolist(), cv2.LINE_AA)
        around.append(tip)
    around += [(right, bottom), (area.left - 1, bottom)]
    cv2.polylines(picture, [np.array(around)], True, BLACK, 1, cv2.LINE_AA)
    for tick in ticks:
        x = round(area.left + tick.at * (area.width - 1))
        cv2.line(picture, (x, bottom), (x, bottom + (TICK_PX if tick.label else TICK_PX // 2)), BLACK)
        centre = min(x, picture.shape[1] - text_width(tick.label, LABEL_PX) / 2 - 1)
        write(picture, tick.label, (centre, bottom + TICK_PX + 14), LABEL_PX, align=0.5)
    write(picture, label, (area.left + area.width / 2, bottom + TICK_PX + 34), align=0.5)


# --- points on an image -----------------------------------------------------------------------------------------------

MIN_WIDTH_PX = 960
"""Narrower images are enlarged by a whole factor, so that the title is legible."""

LINES = 2
"""Most lines of a title."""

POINT_SHARE = 1 / 1200
"""Radius of a point as a share of the width: 1.2 px on 1408, so that neighbouring rings stay apart."""

LINE_SHARE, BAR_SHARE = 1 / 44, 1 / 36
"""Height of a line of the title, and of the bar of ranges, as shares of the width."""

INK, PAPER = (24, 24, 24), (250, 250, 250)
TYPE_SHARE = 0.85
"""Size of type as a share of the height of its line."""


def render_points(
    image_bgr: Pixels,
    camera: Camera,
    T_camera_lidar: Matrix4,
    xyz_m: NDArray[np.floating],
    mask: NDArray[np.bool_] | None,
    scale: RangeScale | None = None,
) -> Pixels:
    """The image with the points of a sweep on it, coloured by range, near ones on top of far ones.

    Args:
        image_bgr: (height, width, 3) uint8, the size of `camera`. It is not changed.
        T_camera_lidar: (4, 4).
        xyz_m: (N, 3) LiDAR frame, compensated to the instant of the image.
        mask: (height, width) or None; points on pixels that are False are left out.
        scale: of the colours; None: that of the points in view.

    Returns:
        (height', width', 3) uint8: the picture above a bar of ranges. Small images are enlarged by a whole factor.
    """
    factor = max(1, -(-MIN_WIDTH_PX // image_bgr.shape[1]))
    picture = np.asarray(np.repeat(np.repeat(image_bgr, factor, axis=0), factor, axis=1), dtype=np.uint8)
    uv_px, range_m, _ = points_in_view(camera, T_camera_lidar, xyz_m, mask, NEAREST_M)
    # Pixel centres are integers: the middle of an enlarged pixel is not at factor · u.
    centres = np.rint((uv_px + 0.5) * factor - 0.5).astype(np.int64)
    shown = scale_of(range_m) if scale is None else scale
    _stamp(picture, centres, range_m, shown, radius_px=picture.shape[1] * POINT_SHARE)
    return np.vstack([picture, _bar(picture.shape[1], shown)])


def titled(picture: Pixels, title: str) -> Pixels:
    """The picture with one or two title lines above it, cut off where they are too long. For a picture that stands
    alone; on a page its caption says the same."""
    return np.vstack([_title(picture.shape[1], title), picture])


def _stamp(
    picture: Pixels,
    centres: NDArray[np.int64],
    range_m: NDArray[np.float64],
    scale: RangeScale,
    radius_px: float,
) -> None:
    """Draws a coloured disc for every point. All pixels of all discs are written at once, far to near."""
    reach = int(radius_px)
    offsets = [
        (u, v)
        for v in range(-reach, reach + 1)
        for u in range(-reach, reach + 1)
        if u * u + v * v <= radius_px * radius_px
    ]
    height, width = picture.shape[:2]
    at = (centres[:, None, :] + np.array(offsets, dtype=np.int64)[None]).reshape(-1, 2)
    inside = (at[:, 0] >= 0) & (at[:, 0] < width) & (at[:, 1] >= 0) & (at[:, 1] < height)
    point = np.repeat(np.arange(len(centres)), len(offsets))[inside]
    at = at[inside]
    # Where indices are equal, NumPy keeps the last value assigned.
    order = np.argsort(-range_m[point], kind="stable")
    picture[at[order, 1], at[order, 0]] = scale.colours_bgr(range_m)[point[order]]


def _title(width: int, title: str) -> Pixels:
    height = round(width * LINE_SHARE)
    lines = title.split("\n")[:LINES]
    strip = np.full((height * len(lines) + height // 4, width, 3), PAPER, dtype=np.uint8)
    for number, line in enumerate(lines):
        place = (0.01 * width, (number + 0.8) * height)
        write(strip, line, place, round(TYPE_SHARE * height), colour=INK)
    return strip


def _bar(width: int, scale: RangeScale) -> Pixels:
    """A bar of the colours of ranges, labelled at round ranges. What lies beyond an end has the end's colour."""
    height, left, right = round(width * BAR_SHARE), round(0.02 * width), round(0.96 * width)
    strip = np.full((height, width, 3), PAPER, dtype=np.uint8)
    ramp = scale.colours_bgr(scale.range_at(np.linspace(0.0, 1.0, right - left)))
    strip[height // 8 : height // 2 - 1, left:right] = ramp
    for tick_m in scale.ticks_m():
        place = left + float(scale.share_of(tick_m)) * (right - left - 1)
        strip[height // 8 : height // 2 + 2, round(place)] = INK
        write(strip, f"{tick_m:g} m", (place - 0.012 * width, 0.9 * height), round(TYPE_SHARE * height / 2), colour=INK)
    return strip
