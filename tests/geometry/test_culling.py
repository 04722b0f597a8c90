"""A bundle that is left out must not hold a point of the image, at any pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry import se3
from coec.geometry.cameras import build, in_image
from coec.geometry.mutual_information import BinnedFrames, joint_histograms
from coec.geometry.projection import (
    BUNDLE,
    Bundles,
    azimuth_order,
    bundle,
    half_field_of_view_rad,
    project,
    within_cone,
)

CAMERA = build("pinhole", width=200, height=160, fx=90.0, fy=90.0, cx=99.5, cy=79.5)
HALF_VIEW_RAD, SHIFT_M = np.arctan(np.hypot(100.0, 80.0) / 90.0), 1.2
COUNTS = (60_000, 3, 20_000)
FIRST = np.concatenate([[0], np.cumsum(COUNTS)]).astype(np.int64)


def sweeps(seed: int) -> NDArray[np.float32]:
    """(3, N): frames of points at 3 to 60 m, each in azimuth order."""
    rng = np.random.default_rng(seed)
    frames = []
    for count in COUNTS:
        azimuth = rng.uniform(-np.pi, np.pi, count)
        rays = np.column_stack([np.cos(azimuth), np.sin(azimuth), rng.uniform(-0.4, 0.05, count)])
        xyz = (rays * 3.0 * 20.0 ** rng.random((count, 1)) / np.linalg.norm(rays, axis=1)[:, None]).astype(np.float32)
        frames.append(xyz[azimuth_order(xyz)])
    return np.ascontiguousarray(np.concatenate(frames).T)


def poses(count: int) -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(7)
    xi = np.column_stack([rng.normal(scale=2.0, size=(count, 3)), rng.uniform(-0.6, 0.6, (count, 3))])
    return [se3.perturbation(each) for each in xi]


def frames_of(xyz: NDArray[np.float32]) -> BinnedFrames:
    rng = np.random.default_rng(1)
    range_bin = rng.integers(0, 8, (xyz.shape[1],)).astype(np.uint8)
    depth_bin = rng.integers(0, 8, (len(COUNTS), 200 * 160 + 1)).astype(np.uint8)
    return BinnedFrames(
        CAMERA, xyz, range_bin, FIRST, depth_bin, 8, 8,
        bundle(xyz, FIRST, HALF_VIEW_RAD, SHIFT_M),
    )  # fmt: skip


def retained_at(bundles: Bundles, pose: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(B,) whether a bundle may be in view at a pose (4, 4)."""
    return np.asarray(bundles.axis @ pose[2, :3] >= bundles.least_cosine_at(pose))


def test_no_point_of_the_image_is_left_out_and_much_else_is() -> None:
    xyz = sweeps(0)
    bundles = bundle(xyz, FIRST, HALF_VIEW_RAD, SHIFT_M)
    within = [np.arange(count) // BUNDLE for count in COUNTS]
    offsets = np.concatenate([[0], np.cumsum([each[-1] + 1 for each in within])])
    owner = np.concatenate([each + offset for each, offset in zip(within, offsets, strict=False)])
    assert len(bundles.axis) == offsets[-1]
    shares = []
    for pose in poses(40):
        uv_px, valid = project(CAMERA, xyz.T.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])
        retained = retained_at(bundles, pose)
        assert retained[owner[valid & in_image(CAMERA, uv_px)]].all()
        shares.append(retained.mean())
    assert np.mean(shares) < 0.9


def test_the_histograms_are_the_same_with_and_without() -> None:
    frames = frames_of(sweeps(2))
    for pose in poses(10):
        np.testing.assert_array_equal(
            joint_histograms(frames, pose), joint_histograms(replace(frames, bundles=None), pose)
        )


def test_a_pose_that_shifts_farther_than_was_allowed_for_leaves_nothing_out() -> None:
    bundles = bundle(sweeps(3), FIRST, HALF_VIEW_RAD, SHIFT_M)
    far = np.eye(4)
    far[0, 3] = SHIFT_M + 0.01
    assert retained_at(bundles, far).all()
    assert not retained_at(bundles, np.eye(4)).all()


def test_points_that_are_not_numbers_keep_their_bundle() -> None:
    xyz = sweeps(4)
    xyz[:, ::BUNDLE] = np.nan
    retained = retained_at(bundle(xyz, FIRST, HALF_VIEW_RAD, SHIFT_M), np.eye(4))
    assert retained[: -(-COUNTS[0] // BUNDLE)].all()


@pytest.mark.parametrize("scale_m", [0.0, 1e-12, 1e6])
def test_the_order_is_stable_and_complete(scale_m: float) -> None:
    xyz = (np.random.default_rng(5).normal(size=(500, 3)) * scale_m).astype(np.float32)
    order = azimuth_order(xyz)
    assert sorted(order) == list(range(500))
    azimuth = np.arctan2(xyz[order, 1], xyz[order, 0])
    assert (np.diff(azimuth) > -0.1).all()


def test_no_point_that_a_pose_of_a_reach_brings_into_the_image_is_beyond_the_cone() -> None:
    xyz, start, rng = sweeps(6), se3.perturbation(np.array([0.4, -1.1, 0.3, 0.2, -0.5, 0.4])), np.random.default_rng(8)
    half_view_rad = half_field_of_view_rad(CAMERA, np.ones((CAMERA.height, CAMERA.width), np.bool_))
    retained = within_cone(xyz, start, half_view_rad + 0.3, 0.5)
    assert 0.05 < retained.mean() < 0.8
    for _ in range(30):
        turn, shift = rng.normal(size=(2, 3))
        xi = np.concatenate([0.3 * turn / np.linalg.norm(turn), 0.5 * shift / np.linalg.norm(shift)])
        pose = se3.perturb(start, xi)
        uv_px, valid = project(CAMERA, xyz.T.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])
        assert retained[valid & in_image(CAMERA, uv_px)].all()


def test_what_is_no_number_is_never_left_out() -> None:
    xyz = np.full((3, 2), np.nan, np.float32)
    assert within_cone(xyz, np.eye(4), 0.1, 0.0).all()
