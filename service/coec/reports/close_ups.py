"""Two extrinsics next to each other, enlarged where they differ most, so that a glance shows which of them is right:
outlines of near objects (range edges of a sweep that are joined from line to line), the area that they sweep
between the two extrinsics, and the rectangles of the image that hold most of it, weighted by how clearly the image
prefers one of the two.

A person compares lines with the image, not dots: the side of a car, a pole, the corner of a house. A range edge is
joined to the nearest one on the scan line above if both are equally far away and in nearly the same direction. A range
edge that is joined to nothing, mostly in foliage, belongs to no outline.

A shift along an outline cannot be seen, and neither can a shift where there is no outline. So what counts is the area
that outlines sweep from one extrinsic to the other.

The range edges of the sweep are drawn over the grey image, joined by lines where they form an outline: this shows an
offset of a few pixels from the edge of a pole, which ten thousand coloured points do not. Both colours are from Okabe
and Ito's palette (2008), distinct in any colour vision, and neither occurs in a grey image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, degrees, radians

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import FramePair, ImageReader, Matrix4, Rig, Window
from coec.config import LimitsConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera, in_image
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID, EdgeScales, Rectangle
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.edges.scan_lines import scan_lines
from coec.geometry.projection import project, unproject
from coec.geometry.sweep_kernels import Bearings, bearings
from coec.io.images import GreyImages, decode_bgr
from coec.reports import drawing
from coec.reports.drawing import LABEL_PX, LINE_PX, TEXT_PX, Pixels
from coec.reports.formatting import count, instant, number

NEXT_LINE_RAD = (radians(0.05), radians(2.2))
"""Elevation from a range edge to the one above it: more than the noise of one scan line, no more than the spacing of a
LiDAR of 16 beams (data sheet of the VLP-16: 2 degrees)."""

SAME_AZIMUTH_RAD = radians(0.6)
"""Azimuth between the two, at most: two columns of a slow sensor."""

ALIKE_SHARE = 0.03
"""Ranges along one outline differ from line to line by no more than this share of the range."""

BEND_RAD = radians(35.0)
"""An outline ends where it bends by more. Range edges jitter by a column, which is a quarter to half of the way to the
next line (HDL-64: 0.17 and 0.4 degrees)."""

COMPARED = 96
"""Each range edge is compared with so many next in azimuth: except in foliage, fewer lie within `SAME_AZIMUTH_RAD`."""


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """The range edges of a sweep.

    Attributes:
        xyz_m: (E, 3) float32, LiDAR frame, at the instant of the exposure.
        weight: (E,) float32, as `SweepEdges` has it.
        pieces: (L, 2) the lower and the upper edge of each piece of an outline.
        outline: (L,) the outline that each piece belongs to, as the index of its lowest edge.
    """

    xyz_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    pieces: NDArray[np.int64]
    outline: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedOutlines:
    """Range edges in an image: (E, 2) pixels, and (E,) whether each lies in the image and not on the mask."""

    uv_px: NDArray[np.float64]
    seen: NDArray[np.bool_]


def outlines_of(pair: FramePair, rig: Rig, *, compensated: bool) -> Outlines:
    """The outlines of the sweep of a pair; none where the sweep has no jump in range."""
    edges = range_edges(scan_lines(pair.lidar.xyz_m, pair.lidar.ring))
    # Found as measured, placed motion-compensated, as the estimator does.
    xyz_m = compensate(pair, rig, enabled=compensated, selection=edges.index) + edges.shift_m
    joined = _joined(xyz_m)
    return Outlines(xyz_m, edges.weight, joined[:, :2], joined[:, 2])


def project_outlines(outlines: Outlines, rig: Rig, T_camera_lidar: Matrix4) -> ProjectedOutlines:
    """The range edges in the image at an extrinsic (4, 4)."""
    return _pixels(outlines.xyz_m, rig.camera, T_camera_lidar, rig.mask)


def _pixels(
    xyz_m: NDArray[np.float32], camera: Camera, T_camera_lidar: Matrix4, mask: NDArray[np.bool_] | None
) -> ProjectedOutlines:
    uv_px, valid = project(camera, xyz_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])
    seen = valid & in_image(camera, uv_px)
    if mask is not None:
        nearest = np.rint(uv_px[seen]).astype(np.int64)
        seen[np.flatnonzero(seen)[~mask[nearest[:, 1], nearest[:, 0]]]] = False
    return ProjectedOutlines(uv_px, seen)


def _joined(xyz_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """(L, 3): the two ends of each piece, and its outline."""
    seen = bearings(xyz_m)
    below, above = _mutual(seen)
    count = len(xyz_m)
    up, down = np.full(count, -1), np.full(count, -1)
    up[below], down[above] = above, below
    # An outline goes on where both its pieces have about the same direction.
    through = np.flatnonzero((up >= 0) & (down >= 0))
    direction = np.zeros((count, 2))
    direction[below, 0] = seen.azimuth[above] - seen.azimuth[below]
    direction[below, 1] = seen.elevation[above] - seen.elevation[below]
    ahead, behind = direction[through], direction[down[through]]
    cosine = (ahead * behind).sum(axis=1) / np.hypot(*ahead.T) / np.hypot(*behind.T)
    goes_on = np.zeros(count, np.bool_)
    goes_on[through[cosine >= cos(BEND_RAD)]] = True
    connected = goes_on[below] | goes_on[above]
    below, above = below[connected], above[connected]
    # The lowest edge of each outline: where no piece arrives from below, or the one that does bends too much.
    lowest = np.arange(count)
    for lower in below[np.argsort(seen.elevation[below], kind="stable")]:
        if goes_on[lower]:
            lowest[lower] = lowest[down[lower]]
    return np.column_stack([below, above, lowest[below]])


def _mutual(seen: Bearings) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (lower, upper) of mutually nearest edges: the upper is the nearest of all above the lower, and the lower
    the nearest of all below the upper."""
    order = np.argsort(seen.azimuth, kind="stable")
    azimuth, elevation, range_m = seen.azimuth[order], seen.elevation[order], seen.range_m[order]
    lower, upper, distances = [], [], []
    for step in range(1, min(COMPARED, len(order) - 1) + 1):
        near = azimuth[step:] - azimuth[:-step] <= SAME_AZIMUTH_RAD
        if not near.any():
            break
        rise = elevation[step:] - elevation[:-step]
        alike = np.abs(range_m[step:] - range_m[:-step]) <= ALIKE_SHARE * range_m[:-step]
        first = np.flatnonzero(near & alike & (np.abs(rise) >= NEXT_LINE_RAD[0]) & (np.abs(rise) <= NEXT_LINE_RAD[1]))
        is_above = rise[first] > 0
        lower.append(np.where(is_above, first, first + step))
        upper.append(np.where(is_above, first + step, first))
        distances.append(np.hypot(rise[first], azimuth[first + step] - azimuth[first]))
    if not lower:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    below, above, distance = np.concatenate(lower), np.concatenate(upper), np.concatenate(distances)
    both = np.intersect1d(_nearest(below, distance), _nearest(above, distance))
    return order[below[both]], order[above[both]]


def _nearest(group: NDArray[np.int64], distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """The index with the least distance in each group."""
    by_distance = np.lexsort((distance, group))
    return by_distance[np.unique(group[by_distance], return_index=True)[1]]


STRIDES = 4
"""Rectangles are tried in steps of a fourth of their width and height."""

BASE_CONTRAST = 0.05
"""Worth of a swept area, standard deviations, where the image tells nothing: if both extrinsics are wrong, neither puts
outlines on edges."""

LEAST_LENGTH_PX = 1e-9
"""Shorter pieces have no direction."""

FRAMES = 12
"""Most pairs of a window that are looked at, evenly chosen: a second of work on a large sweep."""


@dataclass(frozen=True, slots=True, eq=False)
class Swept:
    """What the pieces (L,) of the outlines of a pair sweep between two extrinsics.

    Attributes:
        middle_px: (L, 2) the middle of the piece half-way between the two.
        length_px: (L,) its length there.
        across_px: (L,) its shift, measured across it.
        area_px2: (L,) the area it sweeps, weighted as range edges are.
        strength: (L, 2) of the image's edges under its whole outline, at the one extrinsic and at the other, in
            standard deviations from their mean.
    """

    middle_px: NDArray[np.float64]
    length_px: NDArray[np.float64]
    across_px: NDArray[np.float64]
    area_px2: NDArray[np.float64]
    strength: NDArray[np.float64]

    @property
    def information(self) -> NDArray[np.float64]:
        """(L,) the area times the square of how clearly the image tells the two apart, px² · σ², whichever it prefers.
        Squared, because one clear outline shows more than many vague ones."""
        contrast = np.abs(self.strength[:, 0] - self.strength[:, 1])
        return (
            self.area_px2 * (BASE_CONTRAST + np.where(self.strength.max(axis=1, initial=0.0) > 0.0, contrast, 0.0)) ** 2
        )


@dataclass(frozen=True, slots=True)
class DifferenceRegion:
    """A part of an image, and figures of what is swept there, weighted by worth.

    Attributes:
        information: the sum, px² · σ².
        across_px: the median shift across outlines.
        strength: of the image's edges under the outlines, at the one extrinsic and at the other, standard deviations.
    """

    part: Rectangle
    information: float
    across_px: float
    strength: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class DifferenceRegions:
    """The most telling places of one pair of a window, the best first; none where no outline is in view.

    Attributes:
        index: of the pair.
        outlines: its range edges.
        frames: how many pairs were looked at.
        strength: of the image's edges under all outlines of all pairs looked at, at the one extrinsic and at the other,
            standard deviations; NaN without an outline.
    """

    index: int
    outlines: Outlines
    regions: tuple[DifferenceRegion, ...]
    frames: int
    strength: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Shift:
    """Shift of range edges in the image: the median and the largest, pixels, and the median angle, degrees."""

    median_px: float
    largest_px: float
    median_deg: float


def angles_deg(camera: Camera, from_px: NDArray[np.float64], to_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) angles between the rays of pixels (N, 2) and of others (N, 2); NaN where the lens has no ray."""
    (one, known), (other, also_known) = unproject(camera, from_px), unproject(camera, to_px)
    # The arc cosine would lose angles below a hundredth of a degree.
    sine, cosine = np.linalg.norm(np.cross(one, other), axis=1), np.sum(one * other, axis=1)
    return np.where(known & also_known, np.degrees(np.arctan2(sine, cosine)), np.nan)


STEP = 1e-4
"""Difference step of a pose, radians and metres."""


def spread_px(
    outlines: Outlines, rig: Rig, T_camera_lidar: Matrix4, covariance: NDArray[np.float64], part: Rectangle
) -> float:
    """How far the range edges in a part of an image lie from where they belong, root mean square, pixels, if the error
    of the extrinsic (4, 4) has a `covariance` (6, 6; rad, m; NaN on axes that were not determined, which count as
    known). NaN without a range edge there."""
    at = project_outlines(outlines, rig, T_camera_lidar)
    inside = at.seen & _within(at.uv_px[:, 0], part.left, part.width) & _within(at.uv_px[:, 1], part.top, part.height)
    if not inside.any():
        return float("nan")
    moved = [
        project_outlines(outlines, rig, se3.perturb(T_camera_lidar, STEP * unit)).uv_px[inside] for unit in np.eye(6)
    ]
    jacobian = (np.stack(moved, axis=2) - at.uv_px[inside][:, :, None]) / STEP
    squares = np.einsum("nia,ab,nib->n", jacobian, np.nan_to_num(covariance), jacobian)
    return float(np.sqrt(np.median(squares)))


def swept(outlines: Outlines, edges: NDArray[np.int8], rig: Rig, T_one: Matrix4, T_other: Matrix4) -> Swept:
    """What outlines sweep between two extrinsics (4, 4), where both put them into the image; `edges` (height, width) is
    `EdgePyramid.sharp` of the image."""
    one, other = project_outlines(outlines, rig, T_one), project_outlines(outlines, rig, T_other)
    in_both = (one.seen & other.seen)[outlines.pieces].all(axis=1)
    lower, upper = outlines.pieces[in_both].T
    between = 0.5 * (one.uv_px + other.uv_px)
    along = between[upper] - between[lower]
    length = np.hypot(along[:, 0], along[:, 1])
    shift = other.uv_px - one.uv_px
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(length, LEAST_LENGTH_PX)[:, None]
    across = np.abs((0.5 * (shift[lower] + shift[upper]) * normal).sum(axis=1))
    weight = np.sqrt(outlines.weight[lower].astype(np.float64) * outlines.weight[upper])
    of_outline = np.unique(outlines.outline[in_both], return_inverse=True)[1]
    under = [
        _under_outlines(edges, 0.5 * (at.uv_px[lower] + at.uv_px[upper]), of_outline, length) for at in (one, other)
    ]
    strength = np.column_stack([each[of_outline] for each in under])
    return Swept(0.5 * (between[lower] + between[upper]), length, across, weight * length * across, strength)


def _under_outlines(
    edges: NDArray[np.int8], uv_px: NDArray[np.float64], of_outline: NDArray[np.int64], length: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Mean strength of the image's edges under the pieces of each outline, standard deviations."""
    columns, rows = np.rint(uv_px).astype(np.int64).T
    at = edges[np.clip(rows, 0, edges.shape[0] - 1), np.clip(columns, 0, edges.shape[1] - 1)]
    strength = np.where(at == VOID, 0.0, at / STRENGTH_STEPS)
    outlines = int(of_outline.max(initial=-1)) + 1
    total = np.bincount(of_outline, length, outlines)
    return np.bincount(of_outline, length * strength, outlines) / np.maximum(total, LEAST_LENGTH_PX)


def difference_regions(
    window: Window,
    images: ImageReader,
    T_one: Matrix4,
    T_other: Matrix4,
    size_px: tuple[int, int],
    count: int,
    *,
    compensated: bool,
) -> DifferenceRegions:
    """The pair on which two extrinsics (4, 4) differ most, and at most `count` rectangles of its image, of (width,
    height) `size_px` and without overlap, in which they do.

    Raises:
        DecodeError: an image cannot be decoded.
        CalibrationError: an image is not of the camera's size.
    """
    if not window.pairs:
        raise ValueError("a window without pairs has no places")
    best_information = -1.0
    total, weight = np.zeros(2), 0.0
    rig, camera = window.rig, window.rig.camera
    lit = rig.mask if rig.mask is not None else np.ones((camera.height, camera.width), np.bool_)
    scales = EdgeScales(lit, 0, 0, upright=rig.T_camera_lidar_nominal[:2, 2])
    sampled = evenly(len(window.pairs), FRAMES)
    for index in sampled:
        outlines = outlines_of(window.pairs[index], rig, compensated=compensated)
        grey = images.grey(window.pairs[index].camera)
        if grey.shape != scales.shape:
            (height, width), model = grey.shape, f"{camera.width} x {camera.height}"
            raise CalibrationError(f"an image has {width} x {height} px, the camera model {model} px")
        seen = swept(outlines, scales.pyramid(grey).sharp, rig, T_one, T_other)
        total += seen.length_px @ seen.strength
        weight += float(seen.length_px.sum())
        regions = _largest(seen, (camera.width, camera.height), size_px, count)
        information = sum(place.information for place in regions)
        if information > best_information:
            best, best_information = (index, outlines, regions), information
    strength = total / weight if weight > 0.0 else np.full(2, np.nan)
    return DifferenceRegions(*best, len(sampled), (float(strength[0]), float(strength[1])))


def shift_px(window: Window, T_one: Matrix4, T_other: Matrix4, *, compensated: bool) -> Shift | None:
    """How far apart two extrinsics (4, 4) put the range edges of the middle pair; None where none is in the image at
    both."""
    outlines = outlines_of(window.pairs[len(window.pairs) // 2], window.rig, compensated=compensated)
    one, other = (project_outlines(outlines, window.rig, T) for T in (T_one, T_other))
    both = one.seen & other.seen
    if not both.any():
        return None
    distances_px = np.linalg.norm(one.uv_px[both] - other.uv_px[both], axis=1)
    angles = angles_deg(window.rig.camera, one.uv_px[both], other.uv_px[both])
    return Shift(float(np.median(distances_px)), float(distances_px.max()), float(np.nanmedian(angles)))


def evenly(count: int, at_most: int) -> list[int]:
    """At most `at_most` of `count` indices, each in the middle of its share."""
    return [int((2 * k + 1) * count / (2 * min(at_most, count))) for k in range(min(at_most, count))]


def _largest(
    seen: Swept, image_px: tuple[int, int], size_px: tuple[int, int], count: int
) -> tuple[DifferenceRegion, ...]:
    width, height = (min(size, whole) for size, whole in zip(size_px, image_px, strict=True))
    information = seen.information
    regions: list[DifferenceRegion] = []
    while len(regions) < count and information.any():
        part = _about_its_middle(
            _best(seen.middle_px, information, image_px, (width, height)), seen.middle_px, information, image_px
        )
        inside = _within(seen.middle_px[:, 0], part.left, width) & _within(seen.middle_px[:, 1], part.top, height)
        weight = information[inside]
        strength = weight @ seen.strength[inside] / weight.sum()
        across_px = _weighted_median(seen.across_px[inside], weight)
        regions.append(DifferenceRegion(part, float(weight.sum()), across_px, (float(strength[0]), float(strength[1]))))
        # A rectangle that overlaps this one would show the same again.
        overlapping = np.abs(seen.middle_px - (part.left + width / 2, part.top + height / 2)) < (width, height)
        information[overlapping.all(axis=1)] = 0.0
    return tuple(regions)


def _best(
    middle_px: NDArray[np.float64], area: NDArray[np.float64], image_px: tuple[int, int], size_px: tuple[int, int]
) -> Rectangle:
    """The rectangle of this size in the image with the largest sum of `area`, tried in steps of a fourth of it."""
    steps = [max(1.0, size / STRIDES) for size in size_px]
    bins = [max(STRIDES, int(np.ceil(whole / step))) for whole, step in zip(image_px, steps, strict=True)]
    cells = np.minimum(((middle_px + 0.5) / steps).astype(np.int64), np.array(bins) - 1)
    sums = np.zeros((bins[0] + 1, bins[1] + 1))
    np.add.at(sums, (cells[:, 0] + 1, cells[:, 1] + 1), area)
    sums = sums.cumsum(axis=0).cumsum(axis=1)
    boxes = (
        sums[STRIDES:, STRIDES:] - sums[:-STRIDES, STRIDES:] - sums[STRIDES:, :-STRIDES] + sums[:-STRIDES, :-STRIDES]
    )
    column, row = np.unravel_index(int(np.argmax(boxes)), boxes.shape)
    left = min(round(int(column) * steps[0]), image_px[0] - size_px[0])
    top = min(round(int(row) * steps[1]), image_px[1] - size_px[1])
    return Rectangle(left, top, *size_px)


def _about_its_middle(
    part: Rectangle, middle_px: NDArray[np.float64], information: NDArray[np.float64], image_px: tuple[int, int]
) -> Rectangle:
    """`part`, moved so that its middle is the weighted mean of what it holds, as far as the image allows."""
    inside = _within(middle_px[:, 0], part.left, part.width) & _within(middle_px[:, 1], part.top, part.height)
    u, v = information[inside] @ middle_px[inside] / information[inside].sum()
    left = min(max(round(u - part.width / 2), 0), image_px[0] - part.width)
    top = min(max(round(v - part.height / 2), 0), image_px[1] - part.height)
    return Rectangle(left, top, part.width, part.height)


def _within(values: NDArray[np.float64], first: int, size: int) -> NDArray[np.bool_]:
    """Which values lie in `size` pixels from `first` on; a pixel begins half a pixel before its centre."""
    return (values >= first - 0.5) & (values < first + size - 0.5)


def _weighted_median(values: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


# --- the close-ups ----------------------------------------------------------------------------------------------------

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
    place: DifferenceRegion,
    outlines: Outlines,
    rig: Rig,
    T_after: Matrix4,
    caption: Caption,
) -> tuple[str, str]:
    """Above both pictures of a part: how far the first extrinsic puts its outlines from where the second does, and how
    well the second is known there, each in degrees, pixels and σ of the second; and the strength of the edges."""
    middle_px = np.array([place.part.left + 0.5 * place.part.width, place.part.top + 0.5 * place.part.height])
    (deg_per_px,) = angles_deg(rig.camera, middle_px[None] - (0.5, 0.0), middle_px[None] + (0.5, 0.0))
    spread = np.nan
    if caption.covariance is not None:
        spread = spread_px(outlines, rig, T_after, caption.covariance, place.part)

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
            lines.append(f"σ: standard deviation of {caption.after} at what is shown.")
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


def _overview(picture: Pixels, shown: Rectangle, image_bgr: Pixels, regions: Sequence[DifferenceRegion]) -> None:
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
    outlines: Outlines,
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
    at = project_outlines(outlines, rig, T_camera_lidar)
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
    (angle_deg,) = angles_deg(camera, np.array([[u - 0.5 * length, v]]), np.array([[u + 0.5 * length, v]]))
    angle = f" = {angle_deg:.2f}°" if np.isfinite(angle_deg) else ""
    x, y = round(0.03 * width), round(0.93 * height)
    bar = Rectangle(x, y, round(length * width / part.width), max(4, round(0.025 * height)))
    drawing.tint(panel, bar, drawing.WHITE)
    drawing.outline(panel, bar, drawing.BLACK)
    drawing.write(panel, f"{length} px{angle}", (x + 2, y - 0.02 * height - 3), LABEL_PX, ground=0.85)
