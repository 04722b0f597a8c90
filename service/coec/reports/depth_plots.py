"""Figures of an assessed depth network, as PNG bytes."""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coec.evaluation.depth_quality import DepthQuality, Pairing
from coec.reports.curves import AXIS_TITLES
from coec.reports.plots import png

RESIDUAL_LIMIT = 0.5
"""Residual rank at the ends of the colours: half of all points lie between a point's rank and the one by the map."""


def joint(counts: NDArray[np.int64], title: str) -> bytes:
    """The joint histogram (bins, bins) of the shares of a map and of the ranges. A perfect network fills the diagonal
    alone; one that tells nothing fills the square evenly."""
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    axes = figure.add_subplot()
    shown = axes.imshow(np.maximum(counts, 0.5), norm=LogNorm(), origin="lower", extent=(0, 100, 0, 100))
    figure.colorbar(shown, ax=axes, label="points")
    axes.set_xlabel("rank of the inverse range, % of the points: near is right")
    axes.set_ylabel("rank of the network's output, %: what it takes for near is above")
    axes.set_title(title, fontsize="medium")
    return png(figure)


def curves(quality: DepthQuality, title: str) -> bytes:
    """Mutual information along the three axes about the calibration, the level of unrelated maps, and the optimum."""
    figure = Figure(figsize=(15.0, 4.6), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(1, 3, sharey=True)
    for axes, scan in zip(panels, quality.scans, strict=True):
        bias_deg, half_deg = degrees(quality.bias[scan.axis]), degrees(quality.half_width[scan.axis])
        axes.plot(np.degrees(scan.offsets), scan.scores, label=f"half-width of the peak {half_deg:.1f} deg")
        axes.axhline(quality.mi_of_unrelated, color="tab:red", linewidth=0.9, linestyle=":", label="unrelated maps")
        axes.axvline(0.0, color="grey", linewidth=0.8, linestyle="--", label="calibration")
        axes.axvline(
            bias_deg, color="tab:green", linewidth=0.9, label=f"optimum of all three axes, {bias_deg:+.2f} deg"
        )
        axes.set_xlabel(f"{AXIS_TITLES[scan.axis]}, deg")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    panels[0].set_ylabel("mutual information, nats")
    return png(figure)


def frame(image_bgr: NDArray[np.uint8], values: NDArray[np.float32], pairing: Pairing, title: str) -> bytes:
    """The image (height, width, 3) with the points of the sweep, and the map (h, w) of the same view beside it.

    Red points are nearer to the network than to the LiDAR, blue ones further, pale ones agree.
    """
    height, width = image_bgr.shape[:2]
    wide = width > 1.6 * height
    rows, columns = (2, 1) if wide else (1, 2)
    panel_width = 13.0 if wide else 8.0
    panel_height = panel_width * height / width + 0.5
    figure = Figure(figsize=(panel_width * columns + 1.2, panel_height * rows + 0.6), layout="constrained")
    figure.suptitle(title)
    panels: Sequence[object] = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    seen, output = panels
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    grey = np.repeat(image_bgr.mean(axis=2, keepdims=True).astype(np.uint8), 3, axis=2)
    seen.imshow(grey, extent=extent)  # type: ignore[attr-defined]
    points = seen.scatter(  # type: ignore[attr-defined]
        pairing.uv_px[:, 0], pairing.uv_px[:, 1], c=pairing.residuals(), s=2.0, cmap="coolwarm",
        vmin=-RESIDUAL_LIMIT, vmax=RESIDUAL_LIMIT, linewidths=0.0,
    )  # fmt: skip
    figure.colorbar(points, ax=seen, label="residual rank: + the network says nearer")  # type: ignore[arg-type]
    shown = output.imshow(values, extent=extent, cmap="magma")  # type: ignore[attr-defined]
    figure.colorbar(shown, ax=output, label="output as it comes")  # type: ignore[arg-type]
    return png(figure)
