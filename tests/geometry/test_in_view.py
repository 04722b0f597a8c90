"""Which points lie in the image: those that the projection of each model puts there, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from coec.geometry.cameras import Camera, in_image
from coec.geometry.projection import points_in_view, project
from support.scenes import BOARD_LENSES, BOARD_NOMINAL

NEAREST_M = 2.0


def cloud() -> np.ndarray:
    return np.random.default_rng(7).normal(scale=15.0, size=(2000, 3)).astype(np.float32)


@pytest.mark.parametrize("camera", BOARD_LENSES.values(), ids=BOARD_LENSES)
def test_points_in_view_are_where_the_projection_puts_them(camera: Camera) -> None:
    xyz_m = cloud()
    seen = points_in_view(camera, BOARD_NOMINAL, xyz_m, None, NEAREST_M)
    uv_px, valid = project(camera, xyz_m.astype(np.float64) @ BOARD_NOMINAL[:3, :3].T + BOARD_NOMINAL[:3, 3])
    range_m = np.linalg.norm(xyz_m.astype(np.float64), axis=1)
    expected = np.flatnonzero(valid & in_image(camera, uv_px) & (range_m >= NEAREST_M))
    assert 0 < len(expected) < len(xyz_m)
    np.testing.assert_array_equal(seen.which, expected)
    np.testing.assert_array_equal(seen.uv_px, uv_px[expected])
    np.testing.assert_allclose(seen.range_m, range_m[expected])


def test_a_mask_leaves_out_the_points_on_its_pixels() -> None:
    camera = BOARD_LENSES["pinhole"]
    mask = np.ones((camera.height, camera.width), np.bool_)
    mask[:, : camera.width // 2] = False
    everywhere = points_in_view(camera, BOARD_NOMINAL, cloud(), None, NEAREST_M)
    right = points_in_view(camera, BOARD_NOMINAL, cloud(), mask, NEAREST_M)
    np.testing.assert_array_equal(right.which, everywhere.which[np.rint(everywhere.uv_px[:, 0]) >= camera.width // 2])
    assert 0 < len(right.which) < len(everywhere.which)


def test_what_no_sensor_measures_is_not_in_view_and_nothing_overflows() -> None:
    wild = np.array([[3e38, 0.0, 0.0], [3e38, -3e38, 3e38], [0.5, 0.0, 0.0], [10.0, 0.0, 0.0]], np.float32)
    assert points_in_view(BOARD_LENSES["pinhole"], BOARD_NOMINAL, wild, None, NEAREST_M).which.tolist() == [3]
