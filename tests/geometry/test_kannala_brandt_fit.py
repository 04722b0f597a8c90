"""Fit of the Kannala-Brandt model to other models, and what it leaves."""

from functools import partial

import cv2
import numpy as np
import pytest

from coec.geometry import cameras
from coec.geometry.cameras import Camera, unproject_point
from coec.geometry.cameras.kannala_brandt import KannalaBrandt, KannalaBrandtFit, fit_kannala_brandt
from coec.geometry.projection import project, unproject

SMALL = {"width": 640, "height": 480, "fx": 300.0, "fy": 310.0, "cx": 320.0, "cy": 235.0}
TANGENTIAL = {"xi": 2.2134, "k1": 0.0168, "k2": 1.6549, "p1": 0.05, "p2": 0.0004}


def fitted(source: Camera) -> KannalaBrandtFit:
    return fit_kannala_brandt(source, partial(unproject_point, source))


def round_image(xi: float, alpha: float, field_deg: float) -> Camera:
    """A double sphere whose square image ends, in its corners, at an angle from the axis."""
    camera = {"width": 2000, "height": 2000, "fx": 500.0, "fy": 500.0, "cx": 999.5, "cy": 999.5}
    source = cameras.build("double_sphere", **camera, xi=xi, alpha=alpha)
    angle = np.radians(field_deg)
    uv_px, valid = project(source, np.array([[np.sin(angle) / np.sqrt(2), np.sin(angle) / np.sqrt(2), np.cos(angle)]]))
    assert valid.all()
    size = int(uv_px[0, 0] - 999.5) * 2
    assert size > 500
    centred = camera | {"width": size, "height": size, "cx": (size - 1) / 2, "cy": (size - 1) / 2}
    return cameras.build("double_sphere", **centred, xi=xi, alpha=alpha)


@pytest.mark.parametrize(
    ("xi", "alpha", "at_most_px"),
    [(-0.2, 0.59, 0.0075), (-0.17, 0.58, 0.0075), (0.05, 0.62, 0.0075), (-0.27, 0.55, 0.035), (-0.3, 0.6, 0.065)],
)
def test_a_double_sphere_is_met_within_hundredths_of_a_pixel(xi: float, alpha: float, at_most_px: float) -> None:
    fit = fitted(round_image(xi, alpha, 92.5))
    assert fit.residual_rms_px < fit.residual_max_px <= at_most_px
    assert fit.camera.fx != pytest.approx(500.0, rel=0.01)  # a focal length means what its model says


def test_a_kannala_brandt_is_recovered() -> None:
    source = cameras.build("kannala_brandt", **SMALL, k1=-0.0978, k2=0.1414, k3=-0.1484, k4=0.0559)
    fit = fitted(source)
    assert isinstance(source, KannalaBrandt)
    assert fit.camera == pytest.approx(source, rel=1e-8)
    assert fit.residual_max_px < 1e-9


@pytest.mark.parametrize(
    "source",
    [
        cameras.build("double_sphere", **SMALL, xi=-0.2, alpha=0.59),
        cameras.build("eucm", **SMALL, alpha=0.6, beta=1.1),
        cameras.build("mei", **SMALL | {"fx": 700.0, "fy": 710.0}, xi=1.4, k1=-0.1, k2=0.1, p1=1e-4, p2=-2e-4),
    ],
    ids=lambda camera: type(camera).__name__,
)
def test_what_is_left_is_reported_as_it_is_between_the_pixels_of_the_fit(source: Camera) -> None:
    fit = fitted(source)
    uv_px = np.random.default_rng(7).uniform([0, 0], [source.width - 1, source.height - 1], (20_000, 2))
    rays, seen = unproject(source, uv_px)
    fitted_px, valid = project(fit.camera, rays[seen])
    assert valid.all()
    error_px = np.linalg.norm(fitted_px - uv_px[seen], axis=1)
    assert np.sqrt(np.mean(error_px**2)) <= fit.residual_rms_px * 1.1  # the borders weigh more in the fit's own
    assert error_px.max() <= fit.residual_max_px * 1.02


def test_opencv_projects_by_the_fitted_camera_to_the_pixels_of_the_source() -> None:
    source = round_image(-0.2, 0.59, 80.0)
    fit = fitted(source)
    own = fit.camera
    rays, _ = unproject(source, np.random.default_rng(3).uniform(0, source.width - 1, (1000, 2)))
    uv_px, _ = project(source, rays)
    matrix = np.array([[own.fx, 0.0, own.cx], [0.0, own.fy, own.cy], [0.0, 0.0, 1.0]])
    coefficients = np.array([own.k1, own.k2, own.k3, own.k4])
    by_opencv, _ = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)
    assert np.abs(by_opencv[:, 0] - uv_px).max() <= fit.residual_max_px * 1.02 + 1e-9


def test_a_lens_that_is_not_round_leaves_what_it_is() -> None:
    """Decentred elements bend rays sideways, which no radial polynomial does."""
    source = cameras.build("mei", **SMALL | {"fx": 700.0, "fy": 700.0}, **TANGENTIAL)
    assert fitted(source).residual_max_px > 1.0


def test_the_fit_is_deterministic() -> None:
    source = cameras.build("double_sphere", **SMALL, xi=-0.2, alpha=0.59)
    assert fitted(source) == fitted(source)


def test_a_camera_that_sees_none_of_its_pixels_is_refused() -> None:
    blind = cameras.build("eucm", **SMALL | {"cx": 1e6}, alpha=1.0, beta=1.0)
    with pytest.raises(ValueError, match="only 0 pixels of the camera have a ray"):
        fitted(blind)
