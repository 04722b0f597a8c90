"""How far a fitted camera model is from the model it was fitted to, over the image."""

from __future__ import annotations

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, name_of
from coec.geometry.cameras.double_sphere_fit import residual
from coec.geometry.projection import project, unproject
from coec.reports.close_ups import DPI, bgr_of, box

SAMPLES = 200
"""Samples along the longer side of the image; so few suffice because a lens is a smooth function."""

ARROWS = 14
"""Arrows along the longer side."""

PICTURE_PX = (800, 620)
"""Largest width and height of the image."""

MARGIN_PX, LINE_PX, AXIS_PX, BAR_PX = 12, 20, 56, 16
"""Margin about the picture, height of a line of text, room for the figures of an axis, height of the colour bar."""

COLOURS = "viridis_r"

DECADES, LEAST_PX = 1000.0, 1e-6
"""The logarithmic colour scale spans this factor below the largest residual; below `LEAST_PX` all is rounding."""


def residuals_px(camera: Camera, fitted: Camera, uv_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) how much further right and down `fitted` puts what `camera` has at pixels (N, 2); NaN where either model
    has no pixel for it."""
    rays, seen = unproject(camera, uv_px)
    at, has_pixel = project(fitted, rays)
    return np.where((seen & has_pixel)[:, None], at - uv_px, np.nan)


def lens_residual(camera: Camera, fitted: Camera) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR on white: the distance in pixels, and arrows from where the lens puts a point towards where
    the fitted model puts it."""
    step = max(camera.width, camera.height) / SAMPLES
    columns, rows = (max(2, round(length / step)) for length in (camera.width, camera.height))
    u = np.linspace(0.0, camera.width - 1.0, columns)
    v = np.linspace(0.0, camera.height - 1.0, rows)
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    residuals = residuals_px(camera, fitted, grid.reshape(-1, 2)).reshape(rows, columns, 2)
    size = np.hypot(residuals[..., 0], residuals[..., 1])
    lines = sentences(camera, fitted, size)

    factor = min(PICTURE_PX[0] / camera.width, PICTURE_PX[1] / camera.height)
    shown = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
    top = 2 * MARGIN_PX + LINE_PX * len(lines)
    total = (
        2 * MARGIN_PX + AXIS_PX + max(shown[0], PICTURE_PX[0]),
        top + shown[1] + AXIS_PX + BAR_PX + AXIS_PX,
    )
    figure = Figure(figsize=(total[0] / DPI, total[1] / DPI), dpi=DPI, facecolor="white")
    for index, line in enumerate(lines):
        place = (MARGIN_PX / total[0], 1.0 - (MARGIN_PX + LINE_PX * index) / total[1])
        figure.text(*place, line, va="top", size=10, weight="bold" if index == 0 else "normal")
    axes = box(figure, MARGIN_PX + AXIS_PX, top, *shown)
    axes.set_facecolor("#dddddd")
    largest = float(np.nanmax(size)) if np.isfinite(size).any() else 0.0
    end_px = max(largest, LEAST_PX)
    scale = LogNorm(end_px / DECADES, end_px, clip=True)
    extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
    axes.imshow(np.ma.masked_invalid(size), extent=extent, norm=scale, cmap=COLOURS)
    every = max(1, SAMPLES // ARROWS)
    middle = (slice(every // 2, None, every), slice(every // 2, None, every))
    at, shift = grid[middle].reshape(-1, 2), residuals[middle].reshape(-1, 2)
    known = np.isfinite(shift).all(axis=1)
    unit = shift[known] / np.maximum(np.hypot(*shift[known].T), LEAST_PX)[:, None]
    axes.quiver(
        *at[known].T, *(0.6 * every * step * unit).T, angles="xy", scale_units="xy", scale=1.0, pivot="mid", width=0.002
    )
    axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="column, px", ylabel="row, px")
    bar = box(figure, MARGIN_PX + AXIS_PX, top + shown[1] + AXIS_PX, shown[0], BAR_PX)
    figure.colorbar(ScalarMappable(scale, COLOURS), cax=bar, orientation="horizontal", label="px beside the lens")
    return bgr_of(figure)


def sentences(camera: Camera, fitted: Camera, size_px: NDArray[np.float64]) -> list[str]:
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
