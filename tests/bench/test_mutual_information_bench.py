"""One evaluation of equation (1) over frames of 114,000 points, beside the plain forms in the same run.

    tests/run --all -k mutual_information_bench        the table of pytest-benchmark
The ratios are what is held; the milliseconds are for the reader.
"""

from collections.abc import Callable
from dataclasses import replace
from time import thread_time
from typing import Any

import numba
import numpy as np
import pytest

from coec.geometry.cameras import build
from coec.geometry.mutual_information import BinnedFrames, mutual_information
from coec.geometry.plain_forms import by_numpy, by_scalar_loop

POINTS, BINS, SIZE = 114_000, 32, 512

RATIO_TO_NUMPY, RATIO_TO_SCALAR = 15.0, 3.0
"""On one core of the machine of the README's table, with every core busy: how many times as fast as the plain forms the
kernel is. Idle it is 40 and 6; wide registers suffer more from a neighbour than plain loops do."""

REGRESSION = 0.8
"""A fifth of a ratio may be lost to another machine or compiler; more is a regression."""

ROUNDS = 60
"""Rounds of all three, interleaved, until the least times of all show the ratio: a neighbour on the same core slows
them by up to two, and not alike."""


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


def fastest_s(call: Callable[[], Any], times: int) -> float:
    """The least processor time of this thread: what else the machine does counts little."""
    least = np.inf
    for _ in range(times):
        start = thread_time()
        call()
        least = min(least, thread_time() - start)
    return least


@pytest.mark.ratio
def test_ratios_to_the_plain_forms() -> None:
    """On one thread each, over a frame that stays in the cache: the ratio is that of the code, not of the cores and the
    memory bandwidth that other processes leave."""
    frames, pose = spinning_lidar_window(1), np.eye(4)
    fast = mutual_information(frames, pose).mi  # compiles or loads from the cache
    assert fast == pytest.approx(by_numpy(frames, pose), abs=1e-9)
    assert fast == pytest.approx(by_scalar_loop(frames, pose), abs=1e-9)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        kernel_s = numpy_s = scalar_s = np.inf
        limit_numpy, limit_scalar = REGRESSION * RATIO_TO_NUMPY, REGRESSION * RATIO_TO_SCALAR
        for _ in range(ROUNDS):
            kernel_s = min(kernel_s, fastest_s(lambda: mutual_information(frames, pose), 40))
            scalar_s = min(scalar_s, fastest_s(lambda: by_scalar_loop(frames, pose), 2))
            numpy_s = min(numpy_s, fastest_s(lambda: by_numpy(frames, pose), 1))
            if numpy_s >= limit_numpy * kernel_s and scalar_s >= limit_scalar * kernel_s:
                break
    finally:
        numba.set_num_threads(threads)
    to_numpy, to_scalar = numpy_s / kernel_s, scalar_s / kernel_s
    print(f"\n{kernel_s * 1e3:.2f} ms; NumPy takes {to_numpy:.1f}, a scalar loop {to_scalar:.1f} times as long")
    assert to_numpy >= limit_numpy
    assert to_scalar >= limit_scalar


@pytest.mark.parametrize("count", [5, 25, 50, 200])
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
