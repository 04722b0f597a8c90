"""What of the image shows nothing of the world: found in moving frames, never in standing ones."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.ego_mask import GRID_WIDTH, MIN_FRAMES, DeadRegions, lit_pixels
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import CameraFrame, DepthModel, Silence, Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.io.images import GreyImages
from coec.io.recordings import window_cutting
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import IMAGE
from support import degradations

Grey = NDArray[np.uint8]
Mask = NDArray[np.bool_]
WIDTH, HEIGHT = 400, 240
GREY = GreyImages(LimitsConfig())


def world(rng: np.random.Generator, sky: float = 200.0) -> Grey:
    """A frame of a drive: a bright sky over roofs, walls and cars of any grey, another in each frame."""
    pixels = np.full((HEIGHT, WIDTH), sky)
    left = 0
    while left < WIDTH:
        across = int(rng.integers(15, 60))
        pixels[int(rng.integers(40, 120)) :, left : left + across] = rng.uniform(20, 235)
        left += across
    for _ in range(40):
        x, y, w, h = rng.integers([0, 90, 8, 8], [WIDTH, HEIGHT, 60, 50])
        pixels[y : y + h, x : x + w] = rng.uniform(20, 235)
    return noisy(pixels, rng)


def noisy(pixels: NDArray[np.float64], rng: np.random.Generator) -> Grey:
    return np.asarray(np.clip(pixels + rng.normal(0.0, 2.0, pixels.shape), 0, 255), np.uint8)


def drive(frames: int, seed: int = 0) -> list[Grey]:
    rng = np.random.default_rng(seed)
    return [world(rng) for _ in range(frames)]


def bonnet() -> Mask:
    """Where the vehicle's own body is in the picture."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray(((x - 200) / 180) ** 2 + ((y - 280) / 90) ** 2 < 1.0)


def with_body(frames: list[Grey], light: float = 0.0) -> list[Grey]:
    """A grey bonnet with a dark crease; `light`: by how much it brightens and darkens, as a share."""
    rng = np.random.default_rng(99)
    y = np.mgrid[:HEIGHT, :WIDTH][0]
    paint = np.where((y > 215) & (y < 225), 50.0, 120.0)
    return [np.where(bonnet(), noisy(paint * (1.0 + rng.uniform(-light, light)), rng), frame) for frame in frames]


def in_a_circle(frames: list[Grey]) -> tuple[list[Grey], Mask]:
    """Black outside the image circle of a fisheye, and where that is."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    context = np.hypot(x - WIDTH / 2, y - HEIGHT / 2) > 135
    rng = np.random.default_rng(98)
    return [np.where(context, noisy(np.full(frame.shape, 6.0), rng), frame) for frame in frames], context


def shares(mask: Mask, dead: Mask) -> tuple[float, float]:
    """How much of what is dead was found, and how much of the rest was taken with it."""
    return float((~mask & dead).sum() / dead.sum()), float((~mask & ~dead).sum() / (~dead).sum())


# ------------------------------------------------------------------------------------------- what must be found
@pytest.mark.parametrize("frames", [5, 10, 25])
@pytest.mark.parametrize("seed", range(3))
def test_the_body_is_detected(frames: int, seed: int) -> None:
    mask = lit_pixels(with_body(drive(frames, seed)))
    assert mask is not None
    result, taken = shares(mask, bonnet())
    assert result > 0.97
    assert taken < 0.05


def test_edges_of_a_body_in_sun_and_shade_are_detected() -> None:
    mask = lit_pixels(with_body(drive(12), light=0.3))
    assert mask is not None
    crease = bonnet()
    crease[:212], crease[228:] = False, False
    assert shares(mask, crease)[0] > 0.9


@pytest.mark.parametrize("seed", range(3))
def test_the_ring_around_an_image_circle_is_detected_and_the_sky_in_it_is_not(seed: int) -> None:
    frames, context = in_a_circle(drive(8, seed))
    mask = lit_pixels(frames)
    assert mask is not None
    result, taken = shares(mask, context)
    assert result > 0.97
    assert taken < 0.08
    assert mask[10:30, 150:250].mean() > 0.9


# -------------------------------------------------------------------------------------------- what must be kept
@pytest.mark.parametrize("frames", [5, 10, 25])
@pytest.mark.parametrize("seed", range(5))
def test_a_drive_with_nothing_in_the_way_has_no_mask(frames: int, seed: int) -> None:
    mask = lit_pixels(drive(frames, seed))
    assert mask is None or mask.mean() > 0.99


def test_too_few_frames_are_uninformative() -> None:
    assert lit_pixels(with_body(drive(MIN_FRAMES - 1))) is None


def test_a_standing_vehicle_is_uninformative() -> None:
    rng = np.random.default_rng(1)
    scene = world(rng).astype(np.float64)
    assert lit_pixels([noisy(scene, rng) for _ in range(30)]) is None


def test_a_standing_vehicle_that_people_pass_is_uninformative() -> None:
    rng = np.random.default_rng(2)
    scene = world(rng).astype(np.float64)
    frames = []
    for k in range(10):
        passing = scene.copy()
        passing[120:200, 30 * k : 30 * k + 90] = 235.0 * (k % 2)
        frames.append(noisy(passing, rng))
    assert lit_pixels(frames) is None


def test_a_night_sky_is_no_ring() -> None:
    rng = np.random.default_rng(5)
    mask = lit_pixels([world(rng, sky=4.0) for _ in range(8)])
    assert mask is None or mask[:30].mean() > 0.9


def test_images_of_different_sizes_have_no_mask() -> None:
    frames = with_body(drive(6))
    assert lit_pixels([*frames, frames[0][:100]]) is None


def test_no_images_have_no_mask() -> None:
    assert lit_pixels([]) is None


# ----------------------------------------------------------------------------------------------- the accumulator
def test_frames_one_by_one_are_frames_at_once() -> None:
    frames = with_body(drive(9))
    regions = DeadRegions.begin(frames[0])
    for frame in frames[1:]:
        regions = regions.after(frame)
    one_by_one, at_once = regions.mask(WIDTH, HEIGHT), lit_pixels(frames)
    assert regions.frames == 9
    assert one_by_one is not None
    assert at_once is not None
    assert one_by_one.tobytes() == at_once.tobytes()


def test_a_frame_like_the_last_does_not_count() -> None:
    frames = drive(2)
    regions = DeadRegions.begin(frames[0])
    assert regions.after(frames[0]) is regions
    assert regions.after(frames[1]).frames == 2


def test_memory_does_not_grow_with_the_frames() -> None:
    regions = DeadRegions.begin(drive(1)[0])
    cells = regions.grey.size
    for frame in drive(6, 1):
        regions = regions.after(frame)
    assert regions.grey.size == cells <= 250 * 200


@pytest.mark.parametrize(("width", "height"), [(401, 239), (37, 23), (1003, 250)])
def test_the_mask_has_the_size_of_the_image(width: int, height: int) -> None:
    rng = np.random.default_rng(3)
    frames = [np.asarray(rng.integers(0, 255, (height, width)), np.uint8) for _ in range(6)]
    frames = [np.where(np.arange(height)[:, None] // 12 % 2 * (np.arange(width) < width // 2), 90, f) for f in frames]
    mask = lit_pixels([np.asarray(frame, np.uint8) for frame in frames])
    assert mask is None or mask.shape == (height, width)


# ------------------------------------------------------------------------------------------------------- in a window
def test_a_window_without_a_mask_gets_the_one_its_frames_report(sharp_street: Window, stereo: DepthModel) -> None:
    bare = replace(sharp_street, rig=replace(sharp_street.rig, mask=None))
    window_data = prepare_window_data(bare, stereo, GREY, CalibrationConfig(), Silence())
    assert window_data.window.rig.mask is not None
    camera = bare.rig.camera
    assert window_data.window.rig.mask.shape == (camera.height, camera.width)
    assert not window_data.window.rig.mask[0, 0]
    assert window_data.window.rig.mask[camera.height // 2, camera.width // 2]


def test_frames_of_a_vehicle_that_is_known_to_stand_do_not_count(sharp_street: Window, stereo: DepthModel) -> None:
    bare = replace(sharp_street, rig=replace(sharp_street.rig, mask=None))
    standing = degradations.with_motion(bare, lambda motion: replace(motion, linear_mps=(0.0, 0.0, 0.0)))
    assert prepare_window_data(standing, stereo, GREY, CalibrationConfig(), Silence()).window.rig.mask is None


def test_without_odometry_the_sweeps_show_whether_the_vehicle_stands(sharp_street: Window, stereo: DepthModel) -> None:
    unknown = [replace(pair, motion=None) for pair in sharp_street.pairs]
    moving = replace(sharp_street, rig=replace(sharp_street.rig, mask=None), pairs=tuple(unknown))
    assert prepare_window_data(moving, stereo, GREY, CalibrationConfig(), Silence()).window.rig.mask is not None
    standing = replace(moving, pairs=tuple(replace(pair, lidar=unknown[0].lidar) for pair in unknown))
    assert prepare_window_data(standing, stereo, GREY, CalibrationConfig(), Silence()).window.rig.mask is None


def test_the_mask_of_the_rig_is_left_alone(sharp_street: Window, stereo: DepthModel) -> None:
    given = np.ones((sharp_street.rig.camera.height, sharp_street.rig.camera.width), np.bool_)
    masked = replace(sharp_street, rig=replace(sharp_street.rig, mask=given))
    assert prepare_window_data(masked, stereo, GREY, CalibrationConfig(), Silence()).window.rig.mask is given


def test_a_bonnet_painted_over_the_street_is_masked(sharp_street: Window, stereo: DepthModel) -> None:
    bare = replace(sharp_street, rig=replace(sharp_street.rig, mask=None))
    painted = degradations.body(bare, np.random.default_rng(4))
    mask = prepare_window_data(painted, stereo, GREY, CalibrationConfig(), Silence()).window.rig.mask
    assert mask is not None
    camera = bare.rig.camera
    assert not mask[int(0.85 * camera.height) :, camera.width // 2].any()
    # Above the painted bonnet and five cells off the vehicle's own body, the street is left alone.
    assert sharp_street.rig.mask is not None
    rim_px = 5 * camera.width // GRID_WIDTH
    clear = cv2.erode(sharp_street.rig.mask.astype(np.uint8), np.ones((2 * rim_px + 1, 2 * rim_px + 1), np.uint8)) > 0
    above = slice(int(0.45 * camera.height), int(0.7 * camera.height)), slice(camera.width // 4, 3 * camera.width // 4)
    assert mask[above][clear[above]].all()
    assert clear[above].mean() > 0.8


# ----------------------------------------------------------------------------------------------------- recordings
def recorded(source: str) -> list[Grey]:
    return [
        GREY.grey(frame) for frame in open_source(source).messages(None, (IMAGE,)) if isinstance(frame, CameraFrame)
    ]


@pytest.mark.parametrize("camera", ["image_00", "image_01"])
def test_a_real_drive_with_nothing_in_the_way_has_no_mask(sample_data: Path, camera: str) -> None:
    assert lit_pixels(recorded(f"kitti360:{sample_data / 'kitti360'}?camera={camera}")) is None


def test_a_real_room_with_a_standing_car_has_no_mask(sample_data: Path) -> None:
    assert lit_pixels(recorded(str(sample_data / "fisheye_garage"))) is None


@pytest.mark.parametrize("recording", ["tamu_right_os", "tamu_right_vlp"])
def test_a_dark_garage_behind_a_moving_board_is_not_masked(
    sample_data: Path, stereo: DepthModel, recording: str
) -> None:
    window = window_cutting.load_window(str(sample_data / recording / "dataset.yaml"), None, 25, lambda *_: None).window
    assert prepare_window_data(window, stereo, GREY, CalibrationConfig(), Silence()).window.rig.mask is None


def test_a_second_of_slow_traffic_has_no_mask(sample_data: Path) -> None:
    assert lit_pixels(recorded(f"kitti-raw:{sample_data / 'kitti_raw_2011_09_26'}")) is None


@pytest.mark.parametrize("frames", [5, 10])
def test_a_real_body_and_the_rim_of_a_real_fisheye_are_detected(
    sample_data: Path, rng: np.random.Generator, frames: int
) -> None:
    """Body and rim of one exposure over the frames of a drive, 10 % brighter and darker: mask_02.png knows the body."""
    folder = sample_data / "kitti360_fisheye"
    exposure = cv2.imread(str(folder / "image_02.png"), cv2.IMREAD_GRAYSCALE)
    known = cv2.imread(str(folder / "mask_02.png"), cv2.IMREAD_GRAYSCALE)
    assert exposure is not None
    assert known is not None
    y, x = np.mgrid[:1400, :1400]
    context = np.hypot(x - 716, y - 700) > 690
    dead = (known == 0) | context
    painted = []
    for grey in recorded(f"kitti360:{sample_data / 'kitti360'}?camera=image_00")[:frames]:
        scene = cv2.resize(grey[:, :752], (1400, 1400))
        lit = exposure * rng.uniform(0.9, 1.1) + rng.normal(0.0, 2.0, scene.shape)
        painted.append(np.asarray(np.clip(np.where(dead, lit, scene), 0, 255), np.uint8))
    mask = lit_pixels(painted)
    assert mask is not None
    result, taken = shares(mask, dead)
    assert result > 0.99
    assert taken < 0.03
