"""The significance of range edges on edge maps against its plain form."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry import se3
from coec.geometry.cameras import Camera, build
from coec.geometry.edges.alignment import (
    LEAST_SQUARE,
    EdgeFrames,
    alignment_of_each,
    alignment_of_parts,
    alignments,
    frame_alignment,
    significances,
    strengths_on_each_map,
)
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID
from coec.geometry.projection import project
from support.oracles import alignment_sums

WIDTH, HEIGHT = 96, 64
SENSOR = {"width": WIDTH, "height": HEIGHT, "fx": 60.0, "fy": 61.0, "cx": 47.2, "cy": 30.9}
CAMERAS = {
    "pinhole": build("pinhole", **SENSOR),
    "kannala_brandt": build("kannala_brandt", **(SENSOR | {"fx": 30.0, "fy": 31.0}), k1=-0.02, k2=0.01, k3=0.0, k4=0.0),
    "double_sphere": build("double_sphere", **(SENSOR | {"fx": 30.0, "fy": 31.0}), xi=-0.2, alpha=0.6),
}
POSE = se3.perturbation(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))


def frames_of(camera: Camera, counts: tuple[int, ...], seed: int = 0, blank: float = 0.1) -> EdgeFrames:
    """Points all around, a part of them behind the camera, on maps of noise; `blank` is the share of masked pixels."""
    rng = np.random.default_rng(seed)
    maps = np.rint(STRENGTH_STEPS * rng.normal(size=(len(counts), HEIGHT, WIDTH))).astype(np.int8)
    maps[rng.random(maps.shape) < blank] = VOID
    return EdgeFrames(
        camera=camera,
        xyz_m=rng.normal(scale=10.0, size=(3, sum(counts))).astype(np.float32),
        weight=rng.uniform(0.5, 1.8, sum(counts)).astype(np.float32),
        first_point=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        maps=maps,
    )


def by_oracle(frames: EdgeFrames, pose: NDArray[np.float64], between_pixels: bool) -> NDArray[np.float64]:
    """(F, 2): Σ w·e and Σ w² of every frame."""
    strengths = np.where(frames.maps == VOID, np.nan, frames.maps / STRENGTH_STEPS)
    uv_px, valid = project(frames.camera, frames.xyz_m.T.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])
    return np.array(
        [
            alignment_sums(uv_px[a:b], valid[a:b], frames.weight[a:b], strengths[f], between_pixels)
            for f, (a, b) in enumerate(zip(frames.first_point[:-1], frames.first_point[1:], strict=True))
        ]
    )


@pytest.mark.parametrize("model", CAMERAS)
def test_every_camera_model_agrees_with_the_plain_form_between_pixels(model: str) -> None:
    frames = frames_of(CAMERAS[model], (2000, 0, 1, 1501))
    expected = by_oracle(frames, POSE, between_pixels=True)
    assert expected[0, 1] > 50.0
    at = frame_alignment(frames, POSE)
    np.testing.assert_allclose(at.strength, expected[:, 0], atol=1e-3)
    np.testing.assert_allclose(at.square, expected[:, 1], rtol=1e-6)
    strength, square = expected.sum(axis=0)
    assert at.significance == pytest.approx(strength / np.sqrt(square), abs=1e-4)
    assert at.of_frames.mean() == pytest.approx(at.significance)
    assert at.of_frames[1] == 0.0


def test_sweeps_on_the_maps_of_other_frames_are_those_of_maps_that_changed_places() -> None:
    frames = frames_of(CAMERAS["double_sphere"], (2000, 0, 1501))
    strengths = strengths_on_each_map(frames, POSE)
    for on in range(3):
        other = replace(frames, maps=np.ascontiguousarray(np.broadcast_to(frames.maps[on], frames.maps.shape)))
        np.testing.assert_array_equal(strengths[:, on], frame_alignment(other, POSE).strength)
    np.testing.assert_array_equal(np.diag(strengths), frame_alignment(frames, POSE).strength)


def test_a_part_is_what_its_points_are_by_themselves() -> None:
    frames = frames_of(CAMERAS["double_sphere"], (2000, 0, 1, 1501))
    part = np.random.default_rng(1).integers(0, 4, len(frames.weight)).astype(np.uint8)
    at = alignment_of_parts(frames, part, 5, POSE[None])
    for number in range(5):
        # Nothing but weight makes a point count.
        alone = frame_alignment(replace(frames, weight=np.where(part == number, frames.weight, np.float32(0.0))), POSE)
        np.testing.assert_allclose(at.strength[0, :, number], alone.strength, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(at.square[0, :, number], alone.square, rtol=1e-6)
    assert (at.square[0, :, :4].sum(axis=0) > 50.0).all()
    assert not at.square[0, :, 4].any()


@pytest.mark.parametrize("model", CAMERAS)
def test_every_camera_model_agrees_with_the_plain_form_at_the_nearest_pixel(model: str) -> None:
    frames = frames_of(CAMERAS[model], (2000, 0, 1, 1501))
    poses = np.stack([POSE, np.eye(4), se3.inverse(POSE)])
    # Single precision puts the one in a thousand that lies on the border of two pixels into either.
    weight = frames.weight.copy()
    for pose in poses:
        uv_px, _ = project(frames.camera, frames.xyz_m.T.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])
        weight[(np.abs(uv_px - np.floor(uv_px) - 0.5) < 1e-3).any(axis=1)] = 0.0
    assert np.count_nonzero(weight) > 0.97 * len(weight)
    frames = replace(frames, weight=weight)
    sums = [by_oracle(frames, pose, between_pixels=False).sum(axis=0) for pose in poses]
    expected = [strength / np.sqrt(square) for strength, square in sums]
    np.testing.assert_allclose(significances(frames, poses), expected, atol=1e-4)


def test_each_frame_may_have_a_pose_of_its_own() -> None:
    frames = frames_of(CAMERAS["double_sphere"], (2000, 0, 1501))
    poses = np.stack([POSE, np.eye(4), se3.perturb(POSE, np.array([0.02, -0.01, 0.03, 0.1, 0.0, -0.1]))])
    at = alignment_of_each(frames, poses)
    for number, pose in enumerate(poses):
        alone = frame_alignment(frames, pose)
        assert at.strength[number] == alone.strength[number]
        assert at.square[number] == alone.square[number]


def test_many_poses_at_once_are_each_by_itself() -> None:
    frames = frames_of(CAMERAS["double_sphere"], (2000, 0, 1501))
    poses = np.stack([POSE, np.eye(4), se3.perturb(POSE, np.array([0.02, -0.01, 0.03, 0.1, 0.0, -0.1]))])
    at = alignments(frames, poses)
    for number, pose in enumerate(poses):
        alone = frame_alignment(frames, pose)
        np.testing.assert_array_equal(at.strength[number], alone.strength)
        np.testing.assert_array_equal(at.square[number], alone.square)
        of_alone = alone.strength / np.sqrt(np.maximum(alone.square, LEAST_SQUARE))
        np.testing.assert_array_equal(at.of_single_frames[number], of_alone)


def test_points_behind_the_camera_and_masked_pixels_count_for_nothing() -> None:
    frames = frames_of(CAMERAS["pinhole"], (500,))
    behind = EdgeFrames(
        frames.camera, -np.abs(frames.xyz_m), frames.weight, frames.first_point, np.ones_like(frames.maps)
    )
    nothing = frame_alignment(behind, np.eye(4))
    assert (nothing.strength.tolist(), nothing.square.tolist(), nothing.significance) == ([0.0], [0.0], 0.0)
    assert significances(behind, np.eye(4)[None]).tolist() == [0.0]
    masked = EdgeFrames(frames.camera, frames.xyz_m, frames.weight, frames.first_point, np.full_like(frames.maps, VOID))
    nothing = frame_alignment(masked, np.eye(4))
    assert (nothing.strength.tolist(), nothing.square.tolist(), nothing.significance) == ([0.0], [0.0], 0.0)
    assert significances(masked, np.eye(4)[None]).tolist() == [0.0]


def test_edges_projected_at_random_have_a_significance_of_about_one_however_many_are_in_view() -> None:
    for count in (300, 30_000):
        z = [
            significances(frames_of(CAMERAS["double_sphere"], (count,), seed, blank=0.0), POSE[None])[0]
            for seed in range(60)
        ]
        assert np.mean(z) == pytest.approx(0.0, abs=4.0 / np.sqrt(60))
        # Points share pixels when there are more of them than pixels: the deviation of many is above one.
        assert 0.7 < np.std(z) < 2.5
