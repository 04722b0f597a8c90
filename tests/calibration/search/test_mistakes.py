"""Classical mistakes in the inputs: each is named, right inputs are not accused, and the correction is the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.conftest import window_of
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.search import mistakes
from coec.calibration.search.mistake_ranking import probable_mistake
from coec.calibration.search.mistakes import changed, suppositions
from coec.calibration.solver import WindowData
from coec.calibration.types import CameraFrame, CloudFrame, Mistake, Rig, Window
from coec.config import DepthConfig, LimitsConfig
from coec.geometry import cameras, se3
from coec.io.depth.depth_maps import open_depth
from coec.io.images import GreyImages
from coec.io.recordings.layouts import open_source
from coec.recording import CallbackProgress
from support.simulated_drives import rendered_source

Image = NDArray[np.uint8]
Edit = Callable[[Image], Image]

STREET = "sim:seed=5&seconds=48&camera_hz=0.17&lidar_hz=0.17&camera=pinhole640x320&lidar=32&depth=yes"
"""Eight frames, six seconds apart: a 90° lens, wider than high."""

DEPTH = open_depth(DepthConfig(model="stereo"), LimitsConfig())

POSES = (
    mistakes.QUATERNION_ORDER,
    mistakes.INVERSE_POSE,
    mistakes.CAMERA_AXES,
    mistakes.INVERSE_AND_AXES,
    mistakes.LIDAR_AXES,
)
LENSES = (mistakes.FOCAL_LENGTH, mistakes.IMAGE_SCALE, mistakes.CENTRE_SWAPPED)

BODY = se3.transform_from(mistakes.OPTICAL_FROM_BODY.T, np.zeros(3))
"""T_body_optical."""


def first_and_slow(values: Sequence[object]) -> list[object]:
    """What a whole search tries: the first, and in the long form the others, which differ in a line of a table."""
    of_test = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*one, marks=[pytest.mark.slow] if number else []) for number, one in enumerate(of_test)]


class EditedImages(GreyImages):
    """Images that a driver, or a person, has turned or mirrored."""

    def __init__(self, edit: Edit | None = None) -> None:
        super().__init__(LimitsConfig())
        self._edit = edit

    def grey(self, frame: CameraFrame) -> Image:
        grey = super().grey(frame)
        return grey if self._edit is None else np.ascontiguousarray(self._edit(grey))


def named(window: Window, edit: Edit | None = None) -> Mistake | None:
    return probable_mistake(WindowData(window, True, DEPTH, EditedImages(edit), CallbackProgress(None)), None)


def given(window: Window, rig: Rig) -> Window:
    return replace(window, rig=rig)


@pytest.fixture(scope="module")
def street() -> Window:
    return window_of(rendered_source(STREET))


@pytest.fixture(scope="module")
def few(street: Window) -> Window:
    """Pairs enough for a pose, a lens or turned images; of motion and clocks they tell too little."""
    return replace(street, pairs=street.pairs[:5])


def approximate(rig: Rig) -> Rig:
    """What a person knows of the pose: a degree and some centimetres off."""
    off = se3.perturb(rig.T_camera_lidar_nominal, np.array([0.012, -0.008, 0.01, 0.02, -0.03, 0.02]))
    return replace(rig, T_camera_lidar_nominal=off)


def wrong_pose(code: str, rig: Rig) -> Rig:
    T = rig.T_camera_lidar_nominal
    quaternion = se3.quaternion_xyzw_from_rotation(T[:3, :3])
    read = se3.rotation_from_quaternion_xyzw(np.roll(quaternion, 1))
    poses = {
        mistakes.INVERSE_POSE: se3.inverse(T),
        mistakes.QUATERNION_ORDER: se3.transform_from(read, T[:3, 3]),
        mistakes.CAMERA_AXES: BODY @ T,
        mistakes.INVERSE_AND_AXES: se3.inverse(BODY @ T),
        mistakes.LIDAR_AXES: T @ se3.perturbation(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])),
    }
    return replace(rig, T_camera_lidar_nominal=poses[code])


def wrong_lens(code: str, rig: Rig) -> Rig:
    camera = rig.camera
    lenses = {
        mistakes.FOCAL_LENGTH: {"fx": 1.5 * camera.fx, "fy": 1.5 * camera.fy},
        mistakes.IMAGE_SCALE: {
            "fx": 2.0 * camera.fx,
            "fy": 2.0 * camera.fy,
            "cx": 2.0 * camera.cx + 0.5,
            "cy": 2.0 * camera.cy + 0.5,
        },
        mistakes.CENTRE_SWAPPED: {"cx": camera.cy, "cy": camera.cx},
    }
    return replace(rig, camera=changed(camera, **lenses[code]))


@pytest.mark.slow
def test_right_inputs_are_not_accused(few: Window) -> None:
    assert named(few) is None
    assert named(given(few, approximate(few.rig))) is None


def test_a_window_that_fits_nothing_accuses_nothing(few: Window) -> None:
    rng = np.random.default_rng(1)
    assert named(few, lambda grey: rng.integers(0, 255, grey.shape, dtype=np.uint8)) is None
    assert named(replace(few, pairs=few.pairs[:2])) is None


@pytest.mark.slow
def test_images_that_show_nothing_accuse_nothing(few: Window) -> None:
    assert named(few, np.zeros_like) is None


@pytest.mark.parametrize("code", POSES)
def test_what_undoes_a_wrong_pose_is_supposed(few: Window, code: str) -> None:
    right = approximate(few.rig)
    supposed = [one for one in suppositions(wrong_pose(code, right)) if one.code == code]
    assert any(np.allclose(one.T_camera_lidar, right.T_camera_lidar_nominal, atol=1e-9) for one in supposed)


@pytest.mark.parametrize("code", LENSES)
def test_what_undoes_a_wrong_lens_is_supposed(few: Window, code: str) -> None:
    right = few.rig.camera
    supposed = [one.camera for one in suppositions(wrong_lens(code, few.rig)) if one.code == code]
    near = [camera for camera in supposed if camera.fx == pytest.approx(right.fx, rel=0.1)]
    assert any((camera.cx, camera.cy) == pytest.approx((right.cx, right.cy), abs=1e-6) for camera in near)


@pytest.mark.parametrize("code", first_and_slow(POSES))
def test_a_wrong_pose_is_named_and_corrected(few: Window, code: str) -> None:
    right = approximate(few.rig)
    mistake = named(given(few, wrong_pose(code, right)))
    assert mistake is not None
    assert mistake.code == code
    assert mistake.correctable
    assert mistake.T_camera_lidar == pytest.approx(right.T_camera_lidar_nominal, abs=1e-9)
    assert mistake.significance > mistake.significance_as_given / 0.7
    assert mistakes.KINDS[code].advice in mistake.text


def of_held_centre(window: Window, T_camera_lidar: NDArray[np.float64]) -> Mistake | None:
    """What is named if a pose is given and a search of rotations ends there."""
    rig = replace(window.rig, T_camera_lidar_nominal=T_camera_lidar)
    moved = replace(window, rig=rig, T_camera_lidar_start=T_camera_lidar)
    data = WindowData(moved, True, DEPTH, EditedImages(), CallbackProgress(None))
    return probable_mistake(data, T_camera_lidar)


def test_a_wrong_translation_that_was_held_is_named_with_the_one_that_fits(few: Window) -> None:
    right = few.rig.T_camera_lidar_nominal
    displaced = of_held_centre(few, se3.perturb(right, np.array([0.01, 0.0, 0.0, 0.6, -0.2, 0.0])))
    assert displaced is not None
    assert (displaced.code, displaced.correctable) == (mistakes.TRANSLATION, False)
    assert "right +0.6" in displaced.text
    centre = se3.transform_from(right[:3, :3], se3.inverse(right)[:3, 3])
    inverse = of_held_centre(few, centre)
    assert inverse is not None
    assert inverse.code == mistakes.INVERSE_TRANSLATION


def test_a_shift_along_the_way_of_a_vehicle_is_no_wrong_translation(few: Window) -> None:
    ahead = of_held_centre(few, se3.perturb(few.rig.T_camera_lidar_nominal, np.array([0, 0, 0, 0, 0, 0.8])))
    assert ahead is None or ahead.code != mistakes.TRANSLATION


def test_a_crop_that_is_missing_in_the_principal_point_is_named(few: Window) -> None:
    right = approximate(few.rig)
    cut_px = right.camera.width // 8
    cropped = replace(right, mask=None, camera=right.camera._replace(width=right.camera.width - cut_px))
    mistake = named(given(few, cropped), lambda grey: grey[:, cut_px:])
    assert mistake is not None
    assert mistake.code == mistakes.PRINCIPAL_POINT
    assert mistake.camera.cx == pytest.approx(right.camera.cx - cut_px, abs=0.06 * right.camera.width)


def test_a_pose_of_a_camera_that_is_not_turned_is_named(few: Window) -> None:
    right = approximate(few.rig)
    camera = right.camera
    upright = camera._replace(
        width=camera.height,
        height=camera.width,
        fx=camera.fy,
        fy=camera.fx,
        cx=camera.cy,
        cy=camera.width - 1 - camera.cx,
    )
    mistake = named(given(few, replace(right, mask=None, camera=upright)), np.rot90)
    assert mistake is not None
    assert (mistake.code, mistake.camera) == (mistakes.TURNED_90, upright)


def test_raw_images_with_intrinsics_that_have_no_distortion_are_named(few: Window) -> None:
    right = approximate(few.rig)
    camera = right.camera
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    straight = cv2.undistortPoints(pixels[:, None], matrix, np.array([-0.3, 0.1, 0.0, 0.0]), P=matrix)
    across, down = straight.astype(np.float32).reshape(camera.height, camera.width, 2).transpose(2, 0, 1)
    mistake = named(
        given(few, right), lambda grey: np.asarray(cv2.remap(grey, across, down, cv2.INTER_LINEAR), np.uint8)
    )
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.DISTORTION, False)


def test_rectified_images_are_supposed_of_every_model_with_the_scale_of_its_centre(few: Window) -> None:
    size = {"width": few.rig.camera.width, "height": few.rig.camera.height, "cx": 320.0, "cy": 160.0}
    double_sphere = cameras.build("double_sphere", **size, fx=180.0, fy=181.0, xi=-0.2, alpha=0.6)
    supposed = mistakes.suppositions(replace(few.rig, camera=double_sphere))
    rectified = [one.camera for one in supposed if one.code == mistakes.RECTIFIED]
    assert all(cameras.name_of(camera) == "pinhole" for camera in rectified)
    assert (rectified[0].fx, rectified[0].fy) == pytest.approx((180.0 / 0.8, 181.0 / 0.8), rel=1e-6)
    assert min(camera.fx for camera in rectified) < 180.0


RADII: tuple[Callable[[float], float], ...] = (
    lambda angle: angle,
    lambda angle: float(2.0 * np.sin(0.5 * angle)),
    lambda angle: float(2.0 * np.tan(0.5 * angle)),
)


@pytest.mark.parametrize(("terms", "radius"), list(zip(mistakes.FISHEYES, RADII, strict=True)))
def test_fisheyes_without_distortion_are_the_classical_ones(
    terms: tuple[float, float, float], radius: Callable[[float], float]
) -> None:
    k1, k2, k3 = terms
    lens = cameras.build(
        "kannala_brandt", width=200, height=200, fx=100.0, fy=100.0, cx=0.0, cy=0.0, k1=k1, k2=k2, k3=k3, k4=0.0
    )
    for angle in np.radians([10.0, 45.0, 70.0]):
        seen_px = cameras.project_point(lens, np.sin(angle), 0.0, np.cos(angle))[0]
        assert seen_px == pytest.approx(100.0 * radius(angle), rel=2e-3)


def test_an_inverse_pose_with_another_focal_length_is_named(few: Window) -> None:
    wrong = wrong_pose(mistakes.INVERSE_POSE, wrong_lens(mistakes.FOCAL_LENGTH, approximate(few.rig)))
    mistake = named(given(few, wrong))
    assert mistake is not None
    assert mistake.code == mistakes.INVERSE_POSE


def test_two_mistakes_at_once_are_named(few: Window) -> None:
    right = approximate(few.rig)
    mistake = named(given(few, wrong_pose(mistakes.INVERSE_POSE, right)), lambda grey: grey[::-1, ::-1])
    assert mistake is not None
    assert mistake.code == mistakes.INVERSE_POSE
    for code in (mistakes.INVERSE_POSE, mistakes.TURNED_180):
        assert mistakes.KINDS[code].advice in mistake.text


@pytest.mark.parametrize("later", first_and_slow((1, -1)))
def test_images_that_are_listed_off_by_one_are_named(street: Window, later: int) -> None:
    images = [pair.camera.image for pair in street.pairs]
    shifted = tuple(
        replace(pair, camera=replace(pair.camera, image=images[(index + later) % len(images)]))
        for index, pair in enumerate(street.pairs)
    )
    mistake = named(given(replace(street, pairs=shifted), approximate(street.rig)))
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.OFF_BY_ONE, False)


@pytest.mark.parametrize("code", first_and_slow(LENSES))
def test_a_wrong_lens_is_named_and_corrected(few: Window, code: str) -> None:
    mistake = named(given(few, wrong_lens(code, approximate(few.rig))))
    assert mistake is not None
    assert mistake.code == code
    right = few.rig.camera
    assert mistake.camera.fx == pytest.approx(right.fx, rel=0.06)
    assert (mistake.camera.cx, mistake.camera.cy) == pytest.approx((right.cx, right.cy), abs=1e-6)


@pytest.mark.parametrize(
    ("code", "edit"),
    [
        pytest.param(
            mistakes.TURNED_180, lambda grey: grey[::-1, ::-1], marks=pytest.mark.slow
        ),  # also one of two at once
        (mistakes.MIRRORED, lambda grey: grey[:, ::-1]),
    ],
)
def test_images_that_are_turned_or_mirrored_are_named(few: Window, code: str, edit: Edit) -> None:
    mistake = named(given(few, approximate(few.rig)), edit)
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (code, code == mistakes.TURNED_180)


def test_a_pose_from_the_frame_of_the_cloud_is_named(few: Window) -> None:
    T_cloud_lidar = se3.perturbation(np.array([0.0, 0.0, 0.6, 1.0, 0.0, 1.8]))
    right = few.rig.T_camera_lidar_nominal
    meant = replace(
        few.rig,
        cloud=CloudFrame("base_link", T_cloud_lidar),
        T_camera_lidar_nominal=right @ se3.inverse(T_cloud_lidar),
    )
    mistake = named(given(few, meant))
    assert mistake is not None
    assert mistake.code == mistakes.CLOUD_FRAME
    assert mistake.T_camera_lidar == pytest.approx(right, abs=1e-9)


def test_clouds_that_are_compensated_already_are_named() -> None:
    # At a lower speed a slightly longer focal length explains nearly as much.
    street = window_of(rendered_source(f"{STREET}&speed_mps=14"))
    still = tuple(
        replace(pair, lidar=replace(pair.lidar, xyz_m=compensate(pair, street.rig, enabled=True)))
        for pair in street.pairs
    )
    mistake = named(replace(street, pairs=still))
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.COMPENSATED, False)


def test_motion_that_is_given_backwards_is_named(street: Window) -> None:
    reversed_pairs = tuple(
        replace(pair, motion=None if pair.motion is None else pair.motion.in_axes(-np.eye(3))) for pair in street.pairs
    )
    mistake = named(replace(street, pairs=reversed_pairs))
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.BACKWARDS, False)


@pytest.mark.parametrize("has_rings", first_and_slow((False, True)))
def test_clouds_in_optical_axes_are_named_and_corrected(street: Window, has_rings: bool) -> None:
    axes = mistakes.OPTICAL_FROM_BODY.astype(np.float32)
    optical = tuple(
        replace(
            pair,
            lidar=replace(pair.lidar, xyz_m=pair.lidar.xyz_m @ axes.T, ring=pair.lidar.ring if has_rings else None),
        )
        for pair in street.pairs
    )
    mistake = named(replace(street, pairs=optical))
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.LIDAR_AXES, True)
    assert mistake.text.startswith("the clouds turn about their y axis, not about z")
    assert mistake.T_camera_lidar == pytest.approx(street.rig.T_camera_lidar_nominal @ BODY, abs=1e-9)


def test_motion_in_other_axes_is_named(street: Window) -> None:
    sideways = tuple(
        replace(pair, motion=None if pair.motion is None else pair.motion.in_axes(mistakes.QUARTER_TURN))
        for pair in street.pairs
    )
    mistake = named(replace(street, pairs=sideways))
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.MOTION_AXES, False)


@pytest.mark.parametrize(("linear", "angular"), first_and_slow([(3.6, 1.0), (1.0, 180.0 / np.pi)]))
def test_velocities_and_turns_in_other_units_are_named(street: Window, linear: float, angular: float) -> None:
    fast = tuple(
        replace(pair, motion=None if pair.motion is None else pair.motion.in_axes(np.eye(3), linear, angular))
        for pair in street.pairs
    )
    mistake = named(replace(street, pairs=fast))
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.MOTION_UNIT, False)


def test_stamps_with_jitter_accuse_neither_driver_nor_motion(street: Window) -> None:
    rng = np.random.default_rng(5)
    jittered = tuple(
        replace(pair, camera=replace(pair.camera, stamp_ns=pair.camera.stamp_ns + int(rng.uniform(-8e7, 8e7))))
        for pair in street.pairs
    )
    mistake = named(replace(street, pairs=jittered))
    assert mistake is None or mistake.code == mistakes.CLOCK_OFFSET


def test_clouds_that_are_stamped_a_sweep_late_are_named(street: Window) -> None:
    late = tuple(
        replace(pair, lidar=replace(pair.lidar, stamp_ns=pair.lidar.stamp_ns + 100_000_000)) for pair in street.pairs
    )
    mistake = named(replace(street, pairs=late))
    assert mistake is not None
    assert mistake.code == mistakes.CLOCK_OFFSET
    assert mistake.text.endswith("(the clouds -0.100 s; of a bag, ?lidar_offset=-0.100)")


def test_images_of_another_size_are_named_without_a_search(few: Window) -> None:
    mistake = named(few, lambda grey: grey[::2, ::2])
    assert mistake is not None
    assert mistake.code == mistakes.IMAGE_SCALE
    assert "the images have 320 x 160 px, the intrinsics are for 640 x 320 px" in mistake.text
    assert mistake.camera.width == 320
    assert mistake.camera.fx == pytest.approx(few.rig.camera.fx / 2)


def test_images_of_another_shape_are_named_without_a_search(few: Window) -> None:
    mistake = named(few, lambda grey: grey[:, 80:])
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.IMAGE_SIZE, False)
    assert "the images have 560 x 320 px, the intrinsics are for 640 x 320 px" in mistake.text


def test_a_principal_point_shows_the_size_of_the_image_without_edges(few: Window) -> None:
    mistake = named(given(replace(few, pairs=few.pairs[:2]), wrong_lens(mistakes.IMAGE_SCALE, few.rig)))
    assert mistake is not None
    assert (mistake.code, mistake.correctable) == (mistakes.IMAGE_SCALE, True)
    assert mistake.camera.fx == pytest.approx(few.rig.camera.fx, rel=1e-3)


def test_a_real_street_is_not_accused(sample_data: Path) -> None:
    window = window_of(open_source(f"kitti360:{sample_data}/kitti360?camera=image_00"))
    assert named(window) is None


@pytest.mark.slow
def test_an_inverse_pose_on_a_real_street_is_named(sample_data: Path) -> None:
    window = window_of(open_source(f"kitti360:{sample_data}/kitti360?camera=image_00"))
    mistake = named(given(window, wrong_pose(mistakes.INVERSE_POSE, approximate(window.rig))))
    assert mistake is not None
    assert mistake.code == mistakes.INVERSE_POSE
