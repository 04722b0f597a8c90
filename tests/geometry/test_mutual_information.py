"""Equation (1) against its plain form, and what must hold of any mutual information."""

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry import mutual_information as kernels
from coec.geometry import se3
from coec.geometry.cameras import Camera, build
from coec.geometry.mutual_information import (
    TASK,
    BinnedFrames,
    information_of_each,
    joint_histograms,
    mutual_information,
)
from coec.geometry.projection import project
from support.oracles import entropy, mutual_information_of_frame

WIDTH, HEIGHT = 96, 64
SENSOR = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 47.2, "cy": 30.9}
CAMERAS = {
    "pinhole": build("pinhole", **SENSOR),
    "radtan": build("radtan", **SENSOR, k1=-0.05, k2=0.01, p1=1e-3, p2=-1e-3, k3=0.0),
    "kannala_brandt": build("kannala_brandt", **SENSOR, k1=-0.02, k2=0.01, k3=-0.003, k4=0.0),
    "mei": build("mei", **(SENSOR | {"fx": 70.0, "fy": 71.0}), xi=1.3, k1=0.01, k2=0.02, p1=1e-4, p2=1e-4),
    "eucm": build("eucm", **SENSOR, alpha=0.6, beta=1.1),
    "double_sphere": build("double_sphere", **SENSOR, xi=-0.2, alpha=0.6),
}
MODELS = [pytest.param(model, marks=pytest.mark.slow) if model == "radtan" else model for model in CAMERAS]
"""A kernel is compiled for each, before the tests but for this one, of which no other test has need."""
POSE = se3.perturbation(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))


def frames_of(
    camera: Camera, counts: tuple[int, ...], depth_bins: int, range_bins: int, seed: int = 0, blank: float = 0.2
) -> BinnedFrames:
    """Random frames; `blank` is the share of pixels without a value."""
    rng = np.random.default_rng(seed)
    points = sum(counts)
    depth_bin = rng.integers(0, depth_bins, (len(counts), WIDTH * HEIGHT + 1))
    depth_bin[rng.random(depth_bin.shape) < blank] = depth_bins
    depth_bin[:, -1] = depth_bins
    return BinnedFrames(
        camera=camera,
        xyz_m=rng.normal(scale=10.0, size=(3, points)).astype(np.float32),
        range_bin=rng.integers(0, range_bins, points).astype(np.uint8 if range_bins < 256 else np.uint16),
        first_point=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        depth_bin=depth_bin.astype(np.uint8 if depth_bins < 256 else np.uint16),
        depth_bins=depth_bins,
        range_bins=range_bins,
    )


def by_oracle(frames: BinnedFrames, pose: NDArray[np.float64]) -> list[tuple[float, int]]:
    with np.errstate(invalid="ignore"):  # points that are not numbers belong to the input
        p_camera = frames.xyz_m.T.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    uv_px, valid = project(frames.camera, p_camera)
    return [
        mutual_information_of_frame(
            uv_px[a:b],
            valid[a:b],
            frames.range_bin[a:b],
            frames.depth_bin[f, :-1].reshape(HEIGHT, WIDTH),
            (frames.depth_bins, frames.range_bins),
        )
        for f, (a, b) in enumerate(zip(frames.first_point[:-1], frames.first_point[1:], strict=True))
    ]


@pytest.mark.parametrize("model", MODELS)
def test_every_camera_model_agrees_with_the_plain_form(model: str) -> None:
    frames = frames_of(CAMERAS[model], (5000, 1, 3001), 32, 32)
    result = mutual_information(frames, POSE)
    expected = by_oracle(frames, POSE)
    assert result.points.tolist() == [points for _, points in expected]
    assert result.points[0] > 500
    assert result.mi == pytest.approx([mi for mi, _ in expected], abs=1e-9)


OF_TWO_BYTES = (pytest.param(256, 300, marks=pytest.mark.slow), pytest.param(1000, 5, marks=pytest.mark.slow))
"""So many bins have kernels of their own."""


@pytest.mark.parametrize(("depth_bins", "range_bins"), [(2, 2), (7, 64), (255, 16), *OF_TWO_BYTES])
def test_any_number_of_bins(depth_bins: int, range_bins: int) -> None:
    frames = frames_of(CAMERAS["double_sphere"], (4000, 2500), depth_bins, range_bins)
    assert mutual_information(frames, POSE).mi == pytest.approx([mi for mi, _ in by_oracle(frames, POSE)], abs=1e-9)


@pytest.mark.parametrize("points", [1, 1023, 1024, 1025, TASK - 1, TASK, TASK + 1, 2 * TASK + 7])
def test_no_point_is_lost_at_the_edges_of_blocks_and_tasks(points: int) -> None:
    frames = frames_of(CAMERAS["pinhole"], (points, 10), 4, 4)
    assert mutual_information(frames, POSE).points.tolist() == [count for _, count in by_oracle(frames, POSE)]


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    frames = frames_of(CAMERAS["double_sphere"], (40_000, 20_000, 7), 32, 32)
    threads = numba.get_num_threads()
    try:
        results = []
        for count in (1, numba.config.NUMBA_NUM_THREADS):  # type: ignore[attr-defined]
            numba.set_num_threads(count)
            results.append(mutual_information(frames, POSE).mi.tobytes())
    finally:
        numba.set_num_threads(threads)
    assert results[0] == results[1]


def test_depth_that_reports_the_range_gives_the_entropy_of_the_range() -> None:
    frames = frames_of(CAMERAS["pinhole"], (5000,), 8, 8, blank=0.0)
    joint = joint_histograms(frames, POSE)[0]
    reported = np.diag(joint.sum(axis=0)).astype(float)
    p = reported / reported.sum()
    assert entropy(p.sum(axis=0)) + entropy(p.sum(axis=1)) - entropy(p.ravel()) == pytest.approx(
        entropy(joint.sum(axis=0) / joint.sum())
    )
    assert 0.0 <= mutual_information(frames, POSE).mi[0] < entropy(joint.sum(axis=0) / joint.sum())


def test_a_flat_depth_map_is_uninformative() -> None:
    frames = frames_of(CAMERAS["pinhole"], (5000,), 8, 8)
    frames.depth_bin[:, :-1] = 3
    assert mutual_information(frames, POSE).mi[0] == pytest.approx(0.0, abs=1e-12)


def test_points_that_are_not_numbers_are_not_counted() -> None:
    frames = frames_of(CAMERAS["double_sphere"], (3000,), 8, 8)
    frames.xyz_m[:, ::3] = np.nan
    frames.xyz_m[:, 1::3] = np.inf
    assert mutual_information(frames, POSE).points[0] == by_oracle(frames, POSE)[0][1] < 1000


def test_many_poses_at_once_are_each_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = frames_of(CAMERAS["pinhole"], (5000, 1, TASK + 7), 32, 32)
    # The last one shifts by more than single precision tells near points with.
    poses = [se3.perturb(POSE, np.array([0.02 * k, 0.0, 0.0, 0.0, 0.3 * k, 0.0])) for k in range(5)]
    # Two of them at a time.
    monkeypatch.setattr(kernels, "MOST_COUNTS", 2 * 4 * 33 * 32)
    for at, pose in zip(information_of_each(frames, np.stack(poses)), poses, strict=True):
        alone = mutual_information(frames, pose)
        np.testing.assert_array_equal(at.mi, alone.mi)
        np.testing.assert_array_equal(at.points, alone.points)


def test_nothing_in_view_is_no_information() -> None:
    frames = frames_of(CAMERAS["pinhole"], (100, 50), 8, 8)
    behind = se3.perturbation(np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1e4]))
    assert mutual_information(frames, behind).mi.tolist() == [0.0, 0.0]
    assert mutual_information(frames, behind).points.tolist() == [0, 0]
