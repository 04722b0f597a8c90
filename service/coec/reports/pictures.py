"""Pictures of a window for people: points on the image before and after, close-ups, and maps of what is left over the
image: where range edges and image edges agree at an extrinsic, and how far a camera model is from the one that it
was fitted to. Colours go from pale to dark, so that they can be read in grey, too.

The picture is cut into cells. In each cell the range edges of all pairs are shifted together by a few pixels, and the
shift at which they fit the image best is reported: zero where extrinsic and lens are right. A rotation of the camera
shifts all cells alike, a wrong lens those at the rim, a translation those with near objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, floor, log10
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import FramePair, ImageReader, Matrix4, Rig, Window
from coec.calibration.verdict import saw_one_scene
from coec.config import LimitsConfig
from coec.errors import CalibrationError
from coec.geometry.cameras import Camera, name_of, pixel_rad
from coec.geometry.cameras.double_sphere_fit import residual
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID, EdgeScales, Rectangle
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.edges.scan_lines import scan_lines
from coec.geometry.projection import points_in_view, project, unproject
from coec.io.images import NEAREST_M, GreyImages, decode_bgr, decode_grey, encode_jpeg, encode_png, scale_of
from coec.io.user_files import write_output
from coec.reports import drawing
from coec.reports.charts import Tick, linear_ticks, tick_label
from coec.reports.close_ups import Caption, angles_deg, close_ups, difference_text, evenly
from coec.reports.drawing import LABEL_PX, LINE_PX, Pixels, render_points, titled
from coec.reports.formatting import count, instant, number
from coec.reports.page import Block, Compare, Picture, Pictures, Text
from coec.reports.page_parts import file_picture

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
        deg_per_px: the angle that a pixel covers along the shift, at the middle of the cell; NaN where unknown.
    """

    edges: NDArray[np.int64]
    shift_px: NDArray[np.float64]
    strength: NDArray[np.float64]
    frames: int
    reach_px: int
    deg_per_px: NDArray[np.float64]

    @property
    def known(self) -> NDArray[np.bool_]:
        """(R, C) cells that tell where their range edges belong."""
        return np.asarray(np.isfinite(self.shift_px).all(axis=2))

    @property
    def size_px(self) -> NDArray[np.float64]:
        """(R, C) lengths of the shifts."""
        return np.hypot(self.shift_px[..., 0], self.shift_px[..., 1])

    @property
    def size_deg(self) -> NDArray[np.float64]:
        """(R, C) angles of the shifts."""
        return self.size_px * self.deg_per_px


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
    v, u = np.indices((rows, columns)).reshape(2, -1) + 0.5
    middle_px = np.column_stack([u * camera.width / columns, v * camera.height / rows]) - 0.5
    way = shift / np.maximum(np.hypot(*shift.T), 1e-9)[:, None]
    deg_per_px = angles_deg(camera, middle_px - 0.5 * way, middle_px + 0.5 * way)
    return LocalShifts(
        edges.reshape(rows, columns),
        shift.reshape(rows, columns, 2),
        np.where(edges > 0, mean, np.nan).reshape(rows, columns),
        len(sampled),
        reach,
        deg_per_px.reshape(rows, columns),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _ImageEdgePoints:
    """The range edges of a pair in its image: (n, 2) the pixels nearest to them, and (n,) their weights."""

    uv_px: NDArray[np.int64]
    weight: NDArray[np.float64]


def _placed(pair: FramePair, rig: Rig, T_camera_lidar: Matrix4, *, compensated: bool) -> _ImageEdgePoints:
    edges = range_edges(scan_lines(pair.lidar.xyz_m, pair.lidar.ring))
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

MARGIN_PX, BAR_PX, BAR_AXIS_PX = 12, 16, 46
"""Margin about the picture, height of the colour scale, room for its figures."""

FADED = 0.45
"""How much of the image's contrast is left as it fades to white."""

COVER = 0.6
"""Opacity of a cell's colour over the image."""

MOST = 0.9
"""This share of the cells that tell lies within the colour scale."""

LEAST_END_PX = 3.0
"""Least end of the colour scale: smaller shifts are the scatter of range edges."""

ARROW_SHARE = 0.42
"""The longest arrow, as a share of a cell's shorter side."""


def residual_map(
    window: Window,
    T_camera_lidar: Matrix4,
    *,
    compensated: bool = True,
    name: str = "",
    sigma: NDArray[np.float64] | None = None,
) -> Pixels:
    """The map of a window at an extrinsic (4, 4), which is called `name` and known to `sigma` (6,) radians and metres.

    Returns:
        (H, W, 3) uint8 BGR on white: in each cell how many degrees and pixels its range edges are off the edges of the
        image, and how many range edges there are.

    Raises:
        DecodeError: an image cannot be decoded.
        CalibrationError: an image is not of the camera's size.
    """
    shifts = local_shifts(window, GreyImages(LimitsConfig()), T_camera_lidar, compensated=compensated)
    pair = window.pairs[len(window.pairs) // 2]
    text = drawing.folded(sentences(window, shifts, name, sigma), PICTURE_PX[0])
    pixel_deg = degrees(pixel_rad(window.rig.camera))
    return _render(decode_grey(pair.camera.image, LimitsConfig()), shifts, text, pixel_deg)


def sentences(window: Window, shifts: LocalShifts, name: str, sigma: NDArray[np.float64] | None = None) -> list[str]:
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
    known_deg = shifts.shift_px[shifts.known] * shifts.deg_per_px[shifts.known][:, None]
    right, down = np.nanmedian(known_deg, axis=0).tolist()
    right_px, down_px = np.median(shifts.shift_px[shifts.known], axis=0).tolist()
    spread = float(np.nanmedian(np.hypot(*(known_deg - (right, down)).T)))
    away = f"{np.nanmedian(shifts.size_deg[shifts.known]):.2f}° = {np.median(shifts.size_px[shifts.known]):.1f} px"
    turns = [
        f"{number(deg, 2, sign=True)}° {way} ({number(px, 1, sign=True)} px{_in_sigma(deg, axis, sigma)})"
        for deg, px, way, axis in ((right, right_px, "right", 1), (down, down_px, "down", 0))
    ]
    lines += [
        f"{known} of {eligible} parts of the image are measured, from {pairs}. Their range edges lie {away} beside the "
        f"edges of the image (median; a pixel is {degrees(pixel_rad(window.rig.camera)):.3f}° on the axis).",
        f"In common to all: {', '.join(turns)}. That much the extrinsic may be off.",
        f"Half of the parts are within {spread:.2f}° of that: a part alone has few range edges.",
        "Arrows: where range edges would lie best, enlarged. Figures: how far that is, and of how many range edges. "
        "No colour: not measured.",
    ]
    return lines


def _in_sigma(deg: float, axis: int, sigma: NDArray[np.float64] | None) -> str:
    """A turn in standard deviations of the result about the axis that shifts the image that way; empty if unknown."""
    if sigma is None or not sigma[axis] > 0.0:
        return ""
    return f", {abs(deg) / degrees(sigma[axis]):.1f} σ of {('pitch', 'yaw')[axis]}"


def _render(grey: Pixels, shifts: LocalShifts, text: list[str], pixel_deg: float) -> Pixels:
    shown_px = drawing.fitted(grey.shape[1], grey.shape[0], PICTURE_PX)
    top = MARGIN_PX + LINE_PX * len(text) + MARGIN_PX
    picture = drawing.blank(PICTURE_PX[0] + 2 * MARGIN_PX, top + shown_px[1] + MARGIN_PX + BAR_PX + BAR_AXIS_PX)
    drawing.heading(picture, text, MARGIN_PX, MARGIN_PX)
    shown = Rectangle(MARGIN_PX + (PICTURE_PX[0] - shown_px[0]) // 2, top, *shown_px)
    view = picture[shown.slices]
    view[:] = np.rint(255.0 - FADED * (255.0 - cv2.resize(grey, shown_px, interpolation=cv2.INTER_AREA)))[..., None]
    # A quantile, so that a cell that matches a wrong edge does not pale all others.
    sizes_deg, least_deg = shifts.size_deg[shifts.known], LEAST_END_PX * pixel_deg
    end_deg = max(least_deg, float(np.nanquantile(sizes_deg, MOST)) if np.isfinite(sizes_deg).any() else 0.0)
    for row, column in np.ndindex(shifts.edges.shape):
        _cell(view, shifts, (row, column), end_deg)
    bar = Rectangle(MARGIN_PX + PICTURE_PX[0] // 4, top + shown_px[1] + MARGIN_PX, PICTURE_PX[0] // 2, BAR_PX)
    ticks = [Tick(value / end_deg, tick_label(value)) for value in linear_ticks(0.0, end_deg, 8)]
    drawing.colour_scale(picture, bar, ticks, "range edges beside edges of the image, degrees", open_end=True)
    return picture


def _cell(view: Pixels, shifts: LocalShifts, place: tuple[int, int], end_deg: float) -> None:
    """Draws a cell; nothing where it has no range edge."""
    if shifts.edges[place] == 0:
        return
    ends = (
        [round(length * index / parts) for index in (k, k + 1)]
        for length, parts, k in zip(view.shape[:2], shifts.edges.shape, place, strict=True)
    )
    (top, bottom), (left, right) = ends
    cell = Rectangle(left, top, right - left, bottom - top)
    sides = Rectangle(left, top, right - left + 1, bottom - top + 1)  # shared with the next cells
    middle = np.array([0.5 * (left + right), top + 0.3 * cell.height])
    figures, ink = [str(shifts.edges[place])], drawing.GREY
    if shifts.known[place]:
        length, ink = float(np.nan_to_num(shifts.size_deg[place])), drawing.BLACK
        figures[:0] = [f"{number(float(shifts.size_deg[place]), 2)}°", f"{shifts.size_px[place]:.1f} px"]
        drawing.tint(view, cell, drawing.colours(length / end_deg), COVER)
        drawing.outline(view, sides, drawing.WHITE)
        way = shifts.shift_px[place] / max(float(shifts.size_px[place]), 1e-9)
        head = middle + ARROW_SHARE * min(cell.width, cell.height) * length / max(end_deg, length) * way
        drawing.arrow(view, middle, head, TIP_PX, ((drawing.WHITE, 5), (drawing.BLACK, 2)))
    else:
        drawing.outline(view, sides, drawing.WHITE)
    for above, figure in enumerate(reversed(figures)):
        baseline = bottom - 6 - (LABEL_PX + 2) * above
        drawing.write(view, figure, (middle[0], baseline), LABEL_PX, align=0.5, colour=ink, ground=0.7)


# --- a fitted lens ----------------------------------------------------------------------------------------------------

SAMPLES = 200
"""Samples along the longer side of the image; so few suffice because a lens is a smooth function."""

ARROWS = 14
"""Arrows along the longer side."""

LENS_PICTURE_PX = (800, 620)
"""Largest width and height of the picture of a lens."""

AXIS_PX = 56
"""Room for the figures and the name of an axis."""

TIP_PX, LENS_TIP_PX = 8.0, 5.0
"""Length of the tip of an arrow in a cell, and over a lens."""

NOTHING = 221
"""Grey where the lens or the model has no pixel."""

DECADES, LEAST_PX = 1000.0, 1e-6
"""The logarithmic colour scale spans this factor below the largest residual; below `LEAST_PX` all is rounding."""


def residuals_px(camera: Camera, fitted: Camera, uv_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) how much further right and down `fitted` puts what `camera` has at pixels (N, 2); NaN where either model
    has no pixel for it."""
    rays, seen = unproject(camera, uv_px)
    at, has_pixel = project(fitted, rays)
    return np.where((seen & has_pixel)[:, None], at - uv_px, np.nan)


def lens_residual(camera: Camera, fitted: Camera) -> Pixels:
    """(H, W, 3) uint8 BGR on white: the distance in pixels, and arrows from where the lens puts a point towards where
    the fitted model puts it."""
    step = max(camera.width, camera.height) / SAMPLES
    columns, rows = (max(2, round(length / step)) for length in (camera.width, camera.height))
    u = np.linspace(0.0, camera.width - 1.0, columns)
    v = np.linspace(0.0, camera.height - 1.0, rows)
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    residuals = residuals_px(camera, fitted, grid.reshape(-1, 2)).reshape(rows, columns, 2)
    size = np.hypot(residuals[..., 0], residuals[..., 1])
    text = lens_sentences(camera, fitted, size)

    shown_px = drawing.fitted(camera.width, camera.height, LENS_PICTURE_PX)
    top = 2 * MARGIN_PX + LINE_PX * len(text)
    picture = drawing.blank(
        2 * MARGIN_PX + AXIS_PX + max(shown_px[0], LENS_PICTURE_PX[0]), top + shown_px[1] + AXIS_PX + BAR_PX + AXIS_PX
    )
    drawing.heading(picture, text, MARGIN_PX, MARGIN_PX)
    shown = Rectangle(MARGIN_PX + AXIS_PX, top, *shown_px)
    view = picture[shown.slices]
    largest = float(np.nanmax(size)) if np.isfinite(size).any() else 0.0
    end_px = max(largest, LEAST_PX)
    share = 1.0 + np.log10(np.maximum(size / end_px, 1.0 / DECADES)) / log10(DECADES)
    field = np.where(np.isfinite(size)[..., None], drawing.colours(np.nan_to_num(share)), np.uint8(NOTHING))
    view[:] = cv2.resize(field, shown_px, interpolation=cv2.INTER_NEAREST)
    every = max(1, SAMPLES // ARROWS)
    middle = (slice(every // 2, None, every), slice(every // 2, None, every))
    whole = Rectangle(0, 0, camera.width, camera.height)
    at, shift = drawing.places(grid[middle].reshape(-1, 2), whole, shown), residuals[middle].reshape(-1, 2)
    reach = 0.3 * every * step * shown.width / camera.width
    for centre, way in zip(at, shift, strict=True):
        if np.isfinite(way).all():
            half = reach * way / max(float(np.hypot(*way)), LEAST_PX)
            drawing.arrow(view, centre - half, centre + half, LENS_TIP_PX, ((drawing.BLACK, 1),))
    drawing.axes(picture, shown, whole, labels=("column, px", "row, px"))
    bar = Rectangle(shown.left, top + shown_px[1] + AXIS_PX, shown_px[0], BAR_PX)
    drawing.colour_scale(picture, bar, _decades(end_px), "px beside the lens")
    return picture


def _decades(end_px: float) -> list[Tick]:
    """Ticks of the logarithmic scale of colours up to `end_px`, those at powers of ten with a label."""
    first = floor(log10(end_px / DECADES))
    values = [step * 10.0**decade for decade in range(first, first + 5) for step in range(1, 10)]
    shares = [1.0 + log10(value / end_px) / log10(DECADES) for value in values]
    return [
        Tick(share, tick_label(value) if k % 9 == 0 else "")
        for k, (value, share) in enumerate(zip(values, shares, strict=True))
        if -1e-9 <= share <= 1.0 + 1e-9
    ]


def lens_sentences(camera: Camera, fitted: Camera, size_px: NDArray[np.float64]) -> list[str]:
    """The lines above the picture; `size_px` are distances over the image, NaN where there is none."""
    known = size_px[np.isfinite(size_px)]
    names = f"{name_of(fitted)} fitted to {name_of(camera)}"
    if len(known) == 0:
        return [f"{names}: the two have no pixel in common"]
    fit_residual = residual(camera, fitted)
    rms, largest = (
        f"{value if value >= LEAST_PX else 0.0:.3g}" for value in (fit_residual.rms_px, fit_residual.max_px)
    )
    return [
        f"{names}: {rms} px rms, {largest} px at most",
        f"Over {100 * len(known) / size_px.size:.0f} % of the image; grey: the lens or the model has no pixel there. "
        "Arrows: the direction.",
    ]


# --- files, and blocks of a page --------------------------------------------------------------------------------------

PAGE_JPEG_QUALITY = 95
"""JPEG quality of pictures for a page, which shrinks large ones again."""

SLID_ALTS = ("LiDAR points on the camera image, before", "The same LiDAR points on the same image, after")
"""Alternative texts of two pictures that a slider compares."""


def middle(window: Window) -> FramePair:
    """The pair that overlays show."""
    return window.pairs[len(window.pairs) // 2]


def write_overlay(folder: Path, name: str, picture: NDArray[np.uint8], title: str) -> Path:
    """Writes `<name>.png`: a picture of `overlays` with a title.

    Raises:
        OutputError: the folder or the file cannot be written.
    """
    return write_output(folder / f"{name}.png", encode_png(titled(picture, title)))


def overlays(window: Window, poses: Sequence[Matrix4], compensated: bool) -> list[NDArray[np.uint8]]:
    """(height, width, 3) BGR for each pose (4, 4): points on the image of the middle pair. The points in view at the
    first pose set the colour scale of all pictures.

    Raises:
        DecodeError: the image cannot be decoded.
    """
    pair, rig = middle(window), window.rig
    image = decode_bgr(pair.camera.image, LimitsConfig())
    cloud = compensate(pair, rig, enabled=compensated)
    scale = scale_of(points_in_view(rig.camera, poses[0], cloud, rig.mask, NEAREST_M).range_m)
    return [render_points(image, rig.camera, T_camera_lidar, cloud, rig.mask, scale) for T_camera_lidar in poses]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Pictures of two extrinsics: the files, the blocks of a page that show them, and what was left out, one sentence
    each."""

    files: tuple[Path, ...]
    blocks: tuple[Block, ...]
    left_out: tuple[str, ...]


def write_comparison(
    folder: Path,
    window: Window,
    T_before: Matrix4,
    T_after: Matrix4,
    caption: Caption,
    compensated: bool,
    independent_samples: float | None,
) -> Comparison:
    """Draws two extrinsics (4, 4) of a window: overlay_before.png, overlay_after.png, close_ups.png, and residuals.png
    at the second. The residuals are left out if they could not be trusted, because the pairs are worth too few
    independent `looks` (None: not known).

    Raises:
        OutputError: the folder or a file cannot be written.
        DecodeError: an image cannot be decoded.
        CalibrationError: an image is not of the camera's size.
    """
    where = f"{window.rig.pair}  {instant(middle(window).stamp_ns)}"
    difference = difference_text(T_before, T_after)
    before, after = overlays(window, (T_before, T_after), compensated)
    near = close_ups(window, T_before, T_after, compensated=compensated, caption=caption)
    files = [
        write_overlay(
            folder, "overlay_before", before, f"{where}  {caption.before}\n{difference} from {caption.after}"
        ),
        write_overlay(folder, "overlay_after", after, f"{where}  {caption.after}\n{difference} from {caption.before}"),
        write_output(folder / "close_ups.png", encode_png(near)),
    ]
    captions = (
        f"Before: {caption.before}, {difference} from the other. LiDAR points, coloured by range.",
        f"After: {caption.after}.",
    )
    slid = slid_pictures((before, after), captions)
    one_scene = independent_samples is not None and saw_one_scene(independent_samples, len(window.pairs))
    if one_scene:
        why = (
            f"No map of residuals: {len(window.pairs)} pairs that are worth {independent_samples:.1f} independent "
            "looks show the same edges again and again, as those of a vehicle that stands do, and a part of the image "
            "would look right or wrong by chance."
        )
        return Comparison(tuple(files), (slid, Pictures((file_picture(files[-1]),)), Text((why,), quiet=True)), (why,))
    left = residual_map(window, T_after, compensated=compensated, name=caption.after, sigma=caption.sigma)
    files.append(write_output(folder / "residuals.png", encode_png(left)))
    return Comparison(tuple(files), (slid, Pictures(tuple(map(file_picture, files[2:])))), ())


def slid_pictures(pictures: tuple[NDArray[np.uint8], NDArray[np.uint8]], captions: tuple[str, str]) -> Compare:
    """Two pictures (height, width, 3) BGR of one size for a slider. The words stand beside them, so that the slider
    moves over no text."""
    before, after = (
        Picture(encode_jpeg(picture, PAGE_JPEG_QUALITY), alt, caption)
        for picture, alt, caption in zip(pictures, SLID_ALTS, captions, strict=True)
    )
    return Compare(before, after, "Before and after")


def write_lens(folder: Path, camera: Camera, fitted: Camera) -> Path:
    """Writes lens_residual.png: how far a fitted camera model is from the one that it stands for.

    Raises:
        OutputError: the folder or the file cannot be written.
    """
    return write_output(folder / "lens_residual.png", encode_png(lens_residual(camera, fitted)))


def network_text(model: str, identity: str) -> str:
    """A depth network for people: its name without the folder, and the beginning of its `identity`."""
    return f"{Path(model).name} ({identity[:12]})"
