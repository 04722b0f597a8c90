"""What is shown of a pair, against the projection: where points lie, which, how many, in which order and colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.types import EncodedImage, FramePair, ImageFormat, LidarFrame, Rig
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.geometry.cameras import Camera
from coec.io import viewer_scene
from coec.io.images import decode_bgr, encode_jpeg
from coec.io.viewer_scene import (
    MAX_CLOUD_POINTS,
    MAX_POINTS,
    MAX_SILHOUETTES,
    PICTURE_TOPICS,
    STAMP_END_NS,
    DisplayedPose,
    PointMarks,
    marks_of,
    picture_of,
    silhouettes_of,
)
from support.scenes import (
    BOARD_LENSES,
    BOARD_M,
    BOARD_MOVED,
    BOARD_NOMINAL,
    BOARD_RINGS,
    BOARD_WALL_M,
    HALF_WIDTH_M,
    board_frame_pair,
    board_rig,
    board_sweep,
)
from support.viewer import EXTRINSICS, places, projected


def pixels(marks: PointMarks) -> np.ndarray:
    """Of all points, by our count: centres at integers."""
    return np.concatenate([band.uv_corner_px for band in marks.bands]) - 0.5


def shown(pair: FramePair, rig: Rig, required: frozenset[str] = PICTURE_TOPICS) -> dict[DisplayedPose, PointMarks]:
    picture = picture_of(pair, rig, EXTRINSICS, required, LimitsConfig(), compensated=True)
    return dict(picture.marks)


@pytest.mark.parametrize("camera", BOARD_LENSES.values(), ids=BOARD_LENSES)
def test_points_lie_where_the_camera_sees_them_at_each_extrinsic(camera: Camera) -> None:
    few = replace(board_sweep(), xyz_m=board_sweep().xyz_m[::16], ring=None)
    marks = shown(replace(board_frame_pair(camera), lidar=few), board_rig(camera))
    for pose, T_camera_lidar in ((DisplayedPose.SERVED, BOARD_MOVED), (DisplayedPose.NOMINAL, BOARD_NOMINAL)):
        expected = projected(camera, T_camera_lidar, few.xyz_m)
        assert 1000 < len(expected) <= MAX_POINTS
        assert places(pixels(marks[pose])) == places(expected)


def test_many_points_are_thinned_and_silhouettes_are_not_the_ones_that_go() -> None:
    pair, rig = board_frame_pair(BOARD_LENSES["pinhole"]), board_rig(BOARD_LENSES["pinhole"])
    rendered = pixels(shown(pair, rig)[DisplayedPose.NOMINAL])
    edges = projected(rig.camera, BOARD_NOMINAL, pair.lidar.xyz_m[silhouettes_of(pair.lidar)])
    everything = projected(rig.camera, BOARD_NOMINAL, pair.lidar.xyz_m)
    assert len(rendered) == MAX_POINTS < len(everything)
    assert 30 < len(edges) < MAX_SILHOUETTES
    assert places(edges) <= places(rendered) <= places(everything)


def test_silhouettes_are_the_sides_of_the_board() -> None:
    cloud = board_sweep()
    side = cloud.xyz_m[silhouettes_of(cloud)]
    assert len(side) == 2 * BOARD_RINGS
    np.testing.assert_allclose(side[:, 0], BOARD_M, rtol=1e-6)
    np.testing.assert_allclose(np.abs(side[:, 1]), HALF_WIDTH_M, atol=0.02)


def test_silhouettes_beyond_their_share_are_thinned_too() -> None:
    rig = board_rig(BOARD_LENSES["pinhole"])
    cloud = board_sweep()
    all_of_them = marks_of(rig, cloud.xyz_m, np.ones(len(cloud.xyz_m), np.bool_), EXTRINSICS[DisplayedPose.NOMINAL])
    assert len(pixels(all_of_them)) == MAX_SILHOUETTES


def test_the_near_is_rendered_over_the_far_and_in_another_colour() -> None:
    pair, rig = board_frame_pair(BOARD_LENSES["pinhole"]), board_rig(BOARD_LENSES["pinhole"])
    plain = replace(pair, lidar=LidarFrame(0, "velo", np.array([[BOARD_WALL_M, 0, 0], [BOARD_M, 1, 0]], np.float32)))
    far, near = shown(plain, rig)[DisplayedPose.NOMINAL].bands
    assert near.rgb[1] > far.rgb[1], "near is more yellow"
    assert far.rgb[2] > near.rgb[2], "far is more violet"
    np.testing.assert_array_equal(far.uv_corner_px - 0.5, projected(rig.camera, BOARD_NOMINAL, plain.lidar.xyz_m[:1]))


def test_an_extrinsic_that_there_is_none_of_is_a_title() -> None:
    pair, rig = board_frame_pair(BOARD_LENSES["pinhole"]), board_rig(BOARD_LENSES["pinhole"])
    marks = shown(pair, rig)[DisplayedPose.CANDIDATE]
    assert (marks.title, marks.bands) == ("none", ())


def test_nothing_is_made_that_nobody_checks() -> None:
    pair, rig = board_frame_pair(BOARD_LENSES["pinhole"]), board_rig(BOARD_LENSES["pinhole"])
    picture = picture_of(
        pair, rig, EXTRINSICS, {viewer_scene.POINTS_TOPICS[DisplayedPose.NOMINAL]}, LimitsConfig(), compensated=True
    )
    assert (list(picture.marks), picture.image, picture.cloud) == ([DisplayedPose.NOMINAL], None, None)
    picture = picture_of(
        pair, rig, EXTRINSICS, {viewer_scene.CLOUD_TOPIC, viewer_scene.IMAGE_TOPIC}, LimitsConfig(), compensated=True
    )
    assert not picture.marks
    assert picture.image is pair.camera.image, "JPEG goes through as it came"
    assert picture.cloud is not None
    assert len(picture.cloud) == MAX_CLOUD_POINTS
    np.testing.assert_allclose(picture.cloud[:, 3], np.linalg.norm(picture.cloud[:, :3], axis=1), rtol=1e-6)


def test_raw_pixels_are_sent_as_jpeg() -> None:
    camera = BOARD_LENSES["pinhole"]
    ramp = np.tile(np.linspace(0, 255, camera.width).astype(np.uint8)[None, :, None], (camera.height, 1, 3))
    ramp[:, :, 2] = 40  # red, in OpenCV's order
    raw = EncodedImage(ImageFormat.RGB8, camera.width, camera.height, ramp[:, :, ::-1].tobytes())
    pair = board_frame_pair(camera)
    pair = replace(pair, camera=replace(pair.camera, image=raw))
    image = picture_of(
        pair, board_rig(camera), EXTRINSICS, {viewer_scene.IMAGE_TOPIC}, LimitsConfig(), compensated=True
    ).image
    assert image is not None
    assert image.format is ImageFormat.JPEG
    assert np.abs(decode_bgr(image, LimitsConfig()).astype(int) - ramp).mean() < 3.0
    assert image.data == encode_jpeg(ramp)


@pytest.mark.parametrize("stamp_ns", [-1, STAMP_END_NS])
def test_a_stamp_that_viewers_have_no_word_for_is_refused(stamp_ns: int) -> None:
    camera = BOARD_LENSES["pinhole"]
    with pytest.raises(DecodeError) as refusal:
        picture_of(
            board_frame_pair(camera, stamp_ns),
            board_rig(camera),
            EXTRINSICS,
            PICTURE_TOPICS,
            LimitsConfig(),
            compensated=True,
        )
    assert refusal.value.reason == "stamp_invalid"
