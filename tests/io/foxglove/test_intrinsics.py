"""Cameras as viewers describe them, against OpenCV, whose models they name."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coec.geometry.cameras import build
from coec.geometry.projection import project
from coec.io.viewer_scene import viewer_camera
from support.scenes import BOARD_LENSES

POINTS_M = np.random.default_rng(3).uniform([-1.0, -0.6, 1.0], [1.0, 0.6, 3.0], size=(200, 3))
RATIONAL = build(
    "rational", width=640, height=400, fx=320.0, fy=321.0, cx=319.5, cy=199.5,
    k1=0.3, k2=0.05, p1=1e-3, p2=-1e-3, k3=0.01, k4=0.35, k5=0.08, k6=0.02,
)  # fmt: skip


@pytest.mark.parametrize("name", ["pinhole", "radtan", "rational", "kannala_brandt"])
def test_the_counterpart_projects_as_the_camera_does(name: str) -> None:
    camera = RATIONAL if name == "rational" else BOARD_LENSES[name]
    counterpart = viewer_camera(camera)
    assert counterpart is not None
    reported = counterpart.camera
    K = np.array([[reported.fx, 0, reported.cx], [0, reported.fy, reported.cy], [0, 0, 1]])
    D = np.array(counterpart.coefficients)
    still = np.zeros(3)
    if counterpart.distortion_model == "kannala_brandt":
        uv_px = cv2.fisheye.projectPoints(POINTS_M[:, None], still, still, K, D)[0]
    else:
        assert counterpart.distortion_model == ("rational_polynomial" if name == "rational" else "plumb_bob")
        uv_px = cv2.projectPoints(POINTS_M, still, still, K, D)[0]
    np.testing.assert_allclose(project(camera, POINTS_M)[0], np.asarray(uv_px).reshape(-1, 2), atol=1e-8)
