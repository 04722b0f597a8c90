"""The plain forms against the oracle: a ratio to something wrong would be worth nothing."""

from dataclasses import replace

import numpy as np
import pytest

from coec.geometry.cameras import build
from coec.geometry.mutual_information import BinnedFrames
from coec.geometry.projection import project
from coec_lab.bench.kernels import by_numpy, by_scalar_loop
from support.oracles import mutual_information_of_frame

WIDTH, HEIGHT, BINS, POINTS = 90, 70, 8, 4000
CAMERA = build("double_sphere", width=WIDTH, height=HEIGHT, fx=30.0, fy=31.0, cx=44.0, cy=35.0, xi=-0.2, alpha=0.6)


@pytest.fixture
def frames() -> BinnedFrames:
    rng = np.random.default_rng(3)
    depth_bin = rng.integers(0, BINS + 1, (2, WIDTH * HEIGHT + 1)).astype(np.uint8)
    depth_bin[:, -1] = BINS
    return BinnedFrames(
        camera=CAMERA,
        xyz_m=rng.normal(scale=8.0, size=(3, 2 * POINTS)).astype(np.float32),
        range_bin=rng.integers(0, BINS, 2 * POINTS).astype(np.uint8),
        first_point=np.array([0, POINTS, 2 * POINTS]),
        depth_bin=depth_bin,
        depth_bins=BINS,
        range_bins=BINS,
    )


def test_both_agree_with_the_oracle(frames: BinnedFrames) -> None:
    expected = []
    for f in range(2):
        rows = slice(f * POINTS, (f + 1) * POINTS)
        uv_px, valid = project(CAMERA, frames.xyz_m[:, rows].T)
        depth = frames.depth_bin[f, :-1].reshape(HEIGHT, WIDTH)
        expected.append(mutual_information_of_frame(uv_px, valid, frames.range_bin[rows], depth, (BINS, BINS))[0])
    assert by_numpy(frames, np.eye(4)) == pytest.approx(expected, abs=1e-12)
    assert by_scalar_loop(frames, np.eye(4)) == pytest.approx(expected, abs=1e-12)


def test_nothing_in_view_is_no_information(frames: BinnedFrames) -> None:
    away = np.eye(4)
    away[2, 3] = -1e4
    assert by_numpy(frames, away).tolist() == by_scalar_loop(frames, away).tolist() == [0.0, 0.0]


def test_numpy_knows_one_camera_model(frames: BinnedFrames) -> None:
    pinhole = build("pinhole", width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=44.0, cy=35.0)
    with pytest.raises(TypeError, match="Pinhole"):
        by_numpy(replace(frames, camera=pinhole), np.eye(4))
