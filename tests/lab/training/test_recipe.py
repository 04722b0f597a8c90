"""Frames to learn from: they come from the seed, show what they say, and survive the disk."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex", reason="needs embreex")

from coec.geometry.projection import unproject
from coec_lab.training import training_frames
from coec_lab.training import training_scenes as recipe
from coec_lab.training.training_frames import KINDS, NEAREST_M, SHAPES, SKY, UNKNOWN, TrainingFrame, augment, target
from coec_lab.training.training_scenes import CROWDED, HallScene, JamScene, StreetScene, training_scenes


@pytest.fixture(scope="module")
def some() -> list[TrainingFrame]:
    frames = recipe.frames(5)
    return [next(frames) for _ in range(3)]


def test_a_seed_gives_the_same_frames_again(some: list[TrainingFrame]) -> None:
    again = next(recipe.frames(5))
    assert again.kind == some[0].kind
    np.testing.assert_array_equal(again.bgr, some[0].bgr)
    np.testing.assert_array_equal(again.code, some[0].code)


def test_frames_have_their_kinds_shape_and_something_to_learn(some: list[TrainingFrame]) -> None:
    for shown in some:
        assert shown.code.shape == SHAPES[shown.kind] == shown.bgr.shape[:2]
        surface = shown.code > SKY
        assert surface.mean() > 0.2
        range_m = 65535 * NEAREST_M / shown.code[surface]
        assert np.quantile(range_m, 0.95) > 2 * np.quantile(range_m, 0.05)


def test_crowded_seeds_have_jams_and_halls_and_near_things_high_up() -> None:
    kinds = [type(place) for place, _ in training_scenes(CROWDED)]
    assert kinds == [HallScene, JamScene, HallScene]
    assert [type(place) for place, _ in training_scenes(4)] == [StreetScene] * 3
    (hall, rng), *_ = training_scenes(CROWDED)
    scene, pose = hall.sample_scene(rng), hall.stand(hall.sample_spot(rng), rng)
    up = np.tile(np.array([[0.0, 0.0, 1.0]], np.float32), (5, 1))
    ceiling_m = scene.cast(pose[:3, 3] + [0.0, 0.0, 1.5], up, 0.0).range_m
    assert 0.0 < ceiling_m.max() < 7.0


@pytest.mark.parametrize("kind", SHAPES)
def test_rendered_cameras_see_all_that_they_should(kind: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        eye = recipe.sample_camera(kind, rng)
        height, width = SHAPES[kind]
        assert (eye.camera.height, eye.camera.width) == (height, width)
        middle = np.array([[eye.camera.cx, eye.camera.cy]])
        ray, valid = unproject(eye.camera, middle)
        assert valid.all()
        np.testing.assert_allclose(ray, [[0, 0, 1]], atol=1e-6)


def test_shares_of_the_kinds_sum_to_one() -> None:
    assert sum(share for _, share in KINDS) == pytest.approx(1.0)
    assert {name for name, _ in KINDS} == set(SHAPES)


def test_files_give_back_what_was_written(tmp_path: Path, some: list[TrainingFrame]) -> None:
    path = training_frames.write(tmp_path, 12, some)
    training_frames.write(tmp_path, 3, some[:1])
    assert training_frames.towns(tmp_path) == [training_frames.path_of(tmp_path, 3), path]
    back = training_frames.read(path)
    assert sorted(shown.code.tobytes() for shown in back) == sorted(shown.code.tobytes() for shown in some)
    assert not list(tmp_path.glob("*.part"))


def test_target_orders_by_range_with_the_sky_last_and_holes_open() -> None:
    made = target(np.array([[UNKNOWN, SKY, 655, 6554, 65535]], np.uint16))[0]
    assert np.isnan(made[0])
    np.testing.assert_allclose(made[1:], [0, 0.1, 0.3162, 1.0], atol=1e-3)


def test_augmented_frames_are_seeded_and_keep_picture_and_target_together() -> None:
    code = np.full(SHAPES["wide"], 600, np.uint16)
    code[:, 200:] = 6000
    bgr = np.where(code[:, :, None] > 3000, 220, 30).astype(np.uint8).repeat(3, axis=2)
    for seed in range(20):
        rgb, expected = augment(TrainingFrame("wide", bgr, code), 128, 224, np.random.default_rng(seed))
        again, _ = augment(TrainingFrame("wide", bgr, code), 128, 224, np.random.default_rng(seed))
        np.testing.assert_array_equal(rgb, again)
        assert rgb.shape == (128, 224, 3)
        assert rgb.dtype == np.float32
        assert rgb.min() >= 0
        assert rgb.max() <= 255
        near = expected > 0.2
        if near.any() and not near.all():
            assert rgb[near].mean() > rgb[~near].mean() + 20
