"""One evaluation of equation (1) over frames of 114,000 points, beside the plain forms in the same run.

    tests/run --all -k mutual_information_bench        the table of pytest-benchmark
The ratios are what is held; the milliseconds are for the reader.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from time import thread_time
from typing import Any

import numba
import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from coec.geometry.cameras import build
from coec.geometry.cameras.double_sphere import DoubleSphere
from coec.geometry.mutual_information import BinnedFrames, mutual_information
from coec.geometry.projection import BUNDLE, moved
from coec_lab.bench.kernels import by_numpy, by_scalar_loop

POINTS, BINS, SIZE = 114_000, 32, 512

USUAL_RATIOS = {"numpy": 30.0, "scalar": 5.9}
"""On one core of the machine of the README's table: how many times as long the plain forms take as the kernel."""

USUAL_SHARE = 0.51
"""What the bare loop takes of the time of the kernel there."""

REGRESSION = 0.8
"""A fifth of a ratio may be lost to another machine or compiler; more is a regression."""

ROUNDS = 60
"""Rounds of all, interleaved, of which the least times count: a neighbour on the same core slows them by up to two, and
not alike."""


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


@njit(cache=False, error_model="numpy", fastmath=True)
def bare_loop(
    xyz: NDArray[np.float32], range_bin: NDArray[np.uint8], depth_bin: NDArray[np.uint8], camera: DoubleSphere,
    counts: NDArray[np.int32],
) -> None:  # fmt: skip
    """What the kernel cannot do without, in wide registers: a pose, equations (40) to (42) of the double sphere, a
    look-up, an increment. No doubt about borders, no second precision, whole bundles only."""
    half, one, pixel = np.float32(0.5), np.float32(1.0), np.empty(BUNDLE, np.int32)
    pose = np.eye(4).astype(np.float32)
    f, c, xi, alpha = np.float32(camera.fx), np.float32(camera.cx), np.float32(camera.xi), np.float32(camera.alpha)
    size = np.float32(camera.width)
    for begin in range(0, xyz.shape[1] - BUNDLE, BUNDLE):
        xs, ys, zs = xyz[0, begin : begin + BUNDLE], xyz[1, begin : begin + BUNDLE], xyz[2, begin : begin + BUNDLE]
        for i in range(BUNDLE):
            x, y, z = moved(pose, xs[i], ys[i], zs[i])
            d1 = math.sqrt(x * x + y * y + z * z)
            shifted_z = xi * d1 + z
            scale = f / (alpha * math.sqrt(x * x + y * y + shifted_z * shifted_z) + (one - alpha) * shifted_z)
            u, v = x * scale + c + half, y * scale + c + half
            seen = (u >= 0) & (v >= 0) & (u < size) & (v < size) & (z > -half * d1)
            pixel[i] = np.int32(np.floor(v) * size + np.floor(u)) if seen else np.int32(-1)
        bins = range_bin[begin : begin + BUNDLE]
        for i in range(np.uint64(BUNDLE)):
            if pixel[i] >= 0:
                counts[depth_bin[np.uint64(pixel[i])], bins[i]] += np.int32(1)


def test_ratios_to_the_plain_forms() -> None:
    """On one thread each, over a frame that stays in the cache: the ratio is that of the code, not of the cores and the
    memory bandwidth that other processes leave.

    A neighbour on the same core slows wide registers more than plain loops. So what a plain form says against the
    kernel counts only where the bare loop, which lives on the same registers, says so too.
    """
    frames, pose = spinning_lidar_window(1), np.eye(4)
    camera = frames.camera
    assert isinstance(camera, DoubleSphere)
    fast = mutual_information(frames, pose)  # compiles or loads from the cache
    assert fast.mi == pytest.approx(by_numpy(frames, pose), abs=1e-9)
    assert fast.mi == pytest.approx(by_scalar_loop(frames, pose), abs=1e-9)
    counts = np.zeros((BINS + 1, BINS), np.int32)
    calls: dict[str, tuple[Callable[[], Any], int]] = {
        "kernel": (lambda: mutual_information(frames, pose), 40),
        "bare": (lambda: bare_loop(frames.xyz_m, frames.range_bin, frames.depth_bin[0], camera, counts), 80),
        "scalar": (lambda: by_scalar_loop(frames, pose), 2),
        "numpy": (lambda: by_numpy(frames, pose), 1),
    }
    calls["bare"][0]()
    assert counts.sum() == pytest.approx(fast.points[0], rel=0.01)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        least_s = dict.fromkeys(calls, np.inf)
        for _ in range(ROUNDS):
            least_s = {name: min(least_s[name], fastest_s(*call)) for name, call in calls.items()}
    finally:
        numba.set_num_threads(threads)
    retained = {name: least_s[name] / least_s["kernel"] / usual for name, usual in USUAL_RATIOS.items()}
    retained_of_bare = least_s["bare"] / least_s["kernel"] / USUAL_SHARE
    print(f"\n{least_s} s; of the usual ratios are left: {retained}, to the bare loop {retained_of_bare:.2f}")
    assert max(min(retained.values()), retained_of_bare) >= REGRESSION


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
