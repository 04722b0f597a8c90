"""Cameras as viewers describe them, against OpenCV, whose models they name."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from boards import LENSES
from coec.adapters.foxglove.intrinsics import counterpart_of
from coec.geometry.projection import project

POINTS_M = np.random.default_rng(3).uniform([-1.0, -0.6, 1.0], [1.0, 0.6, 3.0], size=(200, 3))


@pytest.mark.parametrize("name", ["pinhole", "radtan", "kannala_brandt"])
def test_the_counterpart_projects_as_the_camera_does(name: str) -> None:
    camera = LENSES[name]
    counterpart = counterpart_of(camera)
    assert counterpart is not None
    told = counterpart.camera
    K = np.array([[told.fx, 0, told.cx], [0, told.fy, told.cy], [0, 0, 1]])
    D = np.array(counterpart.coefficients)
    still = np.zeros(3)
    if counterpart.distortion_model == "kannala_brandt":
        uv_px = cv2.fisheye.projectPoints(POINTS_M[:, None], still, still, K, D)[0]
    else:
        assert counterpart.distortion_model == "plumb_bob"
        uv_px = cv2.projectPoints(POINTS_M, still, still, K, D)[0]
    np.testing.assert_allclose(project(camera, POINTS_M)[0], np.asarray(uv_px).reshape(-1, 2), atol=1e-8)


def test_a_model_that_viewers_do_not_know_has_none() -> None:
    assert counterpart_of(LENSES["double_sphere"]) is None
