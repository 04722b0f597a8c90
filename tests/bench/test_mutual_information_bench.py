"""One evaluation of equation (1) over 25 frames of 114,000 points, beside the plain NumPy form in the same run.

    tests/run --all -k mutual_information_bench        the table of pytest-benchmark
The ratio is what is held; the milliseconds are for the reader.
"""

from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import pytest

from coec.geometry.cameras import build
from coec.geometry.mutual_information import BinnedFrames, mutual_information
from coec.geometry.projection import project
from oracles import mutual_information_of_frame

FRAMES, POINTS, BINS, SIZE = 25, 114_000, 32, 512
MIN_RATIO_TO_NUMPY = 25.0


def spinning_lidar_window(frames: int) -> BinnedFrames:
    """A 64-beam sweep in a room of wavy walls, before a smooth depth map: memory is visited as on a real window."""
    rng = np.random.default_rng(0)
    azimuth = np.resize(np.linspace(-np.pi, np.pi, POINTS // 64), POINTS)
    elevation = np.repeat(np.linspace(-0.43, 0.03, 64), POINTS // 64 + 1)[:POINTS]
    range_m = 10.0 + 5.0 * np.sin(3.0 * azimuth) + rng.random(POINTS)
    xyz = (
        np.stack([-np.sin(azimuth) * np.cos(elevation), -np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        * range_m
    )
    edges = np.quantile(range_m, np.linspace(0.0, 1.0, BINS + 1)[1:-1])
    rows, columns = np.mgrid[:SIZE, :SIZE] / SIZE
    depth = np.clip(BINS * (0.7 * rows + 0.3 * np.sin(9.0 * columns) ** 2), 0, BINS - 1).astype(np.uint8)
    return BinnedFrames(
        camera=build("double_sphere", **SENSOR, xi=-0.2, alpha=0.6),
        xyz_m=np.ascontiguousarray(np.tile(xyz, (1, frames)).astype(np.float32)),
        range_bin=np.tile(np.searchsorted(edges, range_m), frames).astype(np.uint8),
        first_point=np.arange(frames + 1, dtype=np.int64) * POINTS,
        depth_bin=np.tile(np.append(depth.ravel(), np.uint8(BINS)), (frames, 1)),
        depth_bins=BINS,
        range_bins=BINS,
    )


def by_numpy(frames: BinnedFrames, pose: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    total = 0.0
    for f, (a, b) in enumerate(zip(frames.first_point[:-1], frames.first_point[1:], strict=True)):
        uv_px, valid = project(frames.camera, frames.xyz_m[:, a:b].T @ pose[:3, :3].T + pose[:3, 3])
        depth = frames.depth_bin[f, :-1].reshape(SIZE, SIZE)
        total += mutual_information_of_frame(uv_px, valid, frames.range_bin[a:b], depth, (BINS, BINS))[0]
    return total / frames.frames


@pytest.mark.ratio
def test_ratio_to_numpy() -> None:
    frames, pose = spinning_lidar_window(5), np.eye(4)
    fast = mutual_information(frames, pose).mi.mean()  # compiles or loads from the cache
    start = perf_counter()
    slow = by_numpy(frames, pose)
    numpy_s = perf_counter() - start
    best_s = np.inf
    for _ in range(100):
        start = perf_counter()
        mutual_information(frames, pose)
        best_s = min(best_s, perf_counter() - start)
    print(
        f"\n{frames.frames} frames: {best_s * 1e3:.2f} ms, NumPy {numpy_s * 1e3:.0f} ms, ratio {numpy_s / best_s:.0f}"
    )
    assert fast == pytest.approx(slow, abs=1e-9)
    assert numpy_s / best_s >= MIN_RATIO_TO_NUMPY


@pytest.mark.parametrize("count", [5, 25, 50])
def test_one_evaluation(benchmark: Any, count: int) -> None:
    frames, pose = spinning_lidar_window(count), np.eye(4)
    benchmark(mutual_information, frames, pose)


SENSOR = {"width": SIZE, "height": SIZE, "fx": 160.0, "fy": 160.0, "cx": 255.5, "cy": 255.5}
OTHER_MODELS: dict[str, dict[str, float]] = {
    "pinhole": {},
    "radtan": {"k1": -0.3, "k2": 0.1, "p1": 1e-4, "p2": 1e-4, "k3": 0.0},
    "kannala_brandt": {"k1": -0.01, "k2": 0.01, "k3": -0.01, "k4": 0.001},
    "mei": {"fx": 450.0, "fy": 450.0, "xi": 2.2, "k1": 0.016, "k2": 1.65, "p1": 4e-4, "p2": 4e-4},
    "eucm": {"alpha": 0.6, "beta": 1.1},
}


@pytest.mark.parametrize("model", OTHER_MODELS)
def test_every_camera_model(benchmark: Any, model: str) -> None:
    camera = build(model, **(SENSOR | OTHER_MODELS[model]))
    benchmark(mutual_information, replace(spinning_lidar_window(25), camera=camera), np.eye(4))
