"""Points on images: where they land, which colour wins."""

from __future__ import annotations

import numpy as np
import pytest

from coec.geometry.cameras import build
from coec.io.images import WHOLE_SCALE, RangeScale
from coec.reports.drawing import LINE_SHARE, render_points, titled

WIDTH, HEIGHT = 960, 540
CAMERA = build("pinhole", width=WIDTH, height=HEIGHT, fx=400.0, fy=400.0, cx=480.0, cy=270.0)
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def _rendered(
    *points: tuple[float, float, float], mask: np.ndarray | None = None, scale: RangeScale | None = WHOLE_SCALE
) -> np.ndarray:
    """The picture without its bar, on black."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture = render_points(image, CAMERA, T_CAMERA_LIDAR, np.array(points, np.float32), mask, scale)
    assert not image.any()
    return picture[:HEIGHT]


def test_a_point_lands_where_the_camera_sees_it() -> None:
    # 10 m ahead, 1 m to the left, 0.5 m up: u = 480 - 40, v = 270 - 20.
    rows, columns = np.nonzero(_rendered((10.0, 1.0, 0.5)).any(axis=2))
    assert rows.mean() == pytest.approx(250.0)
    assert columns.mean() == pytest.approx(440.0)
    assert len(rows) < 12


def test_the_nearer_of_two_points_is_on_top_whatever_their_order() -> None:
    near, far = (5.0, 0.0, 0.0), (50.0, 0.0, 0.0)
    np.testing.assert_array_equal(_rendered(near, far), _rendered(far, near))
    np.testing.assert_array_equal(_rendered(near, far), _rendered(near))
    assert (_rendered(near)[270, 480] != _rendered(far)[270, 480]).any()


def test_near_is_yellow_and_far_is_violet() -> None:
    near, far = _rendered((2.5, 0, 0))[270, 480].astype(int), _rendered((79.0, 0, 0))[270, 480].astype(int)
    assert min(near[1], near[2]) > near[0]
    assert far[0] > far[2] > far[1]


def test_colours_follow_the_ranges_in_view_and_not_those_beyond() -> None:
    """What is 10 m away is far in a room, and near on a square; what is behind the camera is not in the picture."""
    room = [(x, -0.5, 0.1) for x in np.linspace(3.0, 10.0, 200)]
    square = [(x, -0.5, 0.1) for x in np.linspace(10.0, 75.0, 200)]
    seen = (10.0, 1.0, 0.5)
    in_room, on_square = _rendered(seen, *room, scale=None), _rendered(seen, *square, scale=None)
    assert in_room[250, 440, 2] < 150 < on_square[250, 440, 2]
    behind = [(-x, 0.0, 0.0) for x in np.linspace(20.0, 75.0, 400)]
    np.testing.assert_array_equal(_rendered(seen, *room, *behind, scale=None), in_room)


def test_a_title_of_two_lines_is_higher_and_a_long_one_no_wider() -> None:
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    one, two = (titled(picture, text) for text in ("a", "a\n" + 400 * "b"))
    np.testing.assert_array_equal(one[-HEIGHT:], picture)
    assert two.shape[0] - one.shape[0] == round(WIDTH * LINE_SHARE)
    assert one.shape[1] == two.shape[1] == WIDTH


def test_points_behind_beyond_and_masked_are_left_out() -> None:
    assert not _rendered((-10.0, 0, 0)).any()
    assert not _rendered((1.9, 0, 0)).any()
    assert not _rendered((10.0, 50.0, 0)).any()
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[:, 470:490] = False
    assert not _rendered((10.0, 0, 0), mask=mask).any()
    assert _rendered((10.0, 1, 0), mask=mask).any()


def test_a_point_on_the_edge_is_cut_off() -> None:
    # u = 480 - 400 · 12 / 10 = 0.
    assert _rendered((10.0, 12.0, 0))[270, 0].any()


def test_small_images_are_enlarged() -> None:
    small = build("pinhole", width=200, height=100, fx=100.0, fy=100.0, cx=99.5, cy=49.5)
    picture = render_points(np.zeros((100, 200, 3), np.uint8), small, T_CAMERA_LIDAR, np.zeros((0, 3)), None)
    assert picture.shape[1] == 1000
    assert picture.shape[0] > 500


@pytest.mark.fault(
    "a name on a picture that is no text: unpaired surrogates, control characters, 100,000 letters",
    "it is drawn in escapes, and cut off",
)
@pytest.mark.parametrize("name", ["\udc80", "a\x1b[31m\x00\n", "\u202e", 100_000 * "x", ""])
def test_any_name_can_be_rendered(name: str) -> None:
    picture = titled(np.zeros((HEIGHT, WIDTH, 3), np.uint8), name)
    assert picture.shape == (picture.shape[0], WIDTH, 3)
    assert (picture[:20] < 128).any() == bool(name)
