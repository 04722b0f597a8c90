"""Fit of the double sphere model to other models, and what it leaves."""

import numpy as np
import pytest

from coec.geometry import cameras
from coec.geometry.cameras import Camera
from coec.geometry.cameras.double_sphere import DoubleSphere
from coec.geometry.cameras.double_sphere_fit import fit_double_sphere
from coec.geometry.projection import project, unproject

SMALL = {"width": 640, "height": 480, "fx": 300.0, "fy": 310.0, "cx": 320.0, "cy": 235.0}


def test_a_pinhole_is_met_exactly() -> None:
    pinhole = cameras.build(
        "pinhole", width=1408, height=376, fx=552.554261, fy=552.554261, cx=682.049453, cy=238.769549
    )
    fit = fit_double_sphere(pinhole)
    assert (fit.camera.xi, fit.camera.alpha) == (0.0, 0.0)
    assert fit.camera[:6] == pytest.approx(tuple(pinhole), rel=1e-12)
    assert fit.residual_max_px < 1e-9
    assert fit.coverage == 1.0


@pytest.mark.parametrize(
    ("xi", "alpha"),
    [
        (-0.2, 0.59),
        (0.6, 0.75),
        *(
            pytest.param(*lens, marks=pytest.mark.slow)
            for lens in ((0.1, 0.6), (-0.3, 0.52), (-0.05, 0.3), (0.0, 0.65))
        ),
    ],
)
def test_a_double_sphere_is_recovered(xi: float, alpha: float) -> None:
    source = cameras.build("double_sphere", **SMALL, xi=xi, alpha=alpha)
    fit = fit_double_sphere(source)
    assert fit.residual_max_px < 1e-6
    assert isinstance(source, DoubleSphere)
    # To first order in xi, focal length and alpha can undo it: pixels pin the parameters less than each other.
    assert fit.camera == pytest.approx(source, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("xi", [0.9, pytest.param(0.4, marks=pytest.mark.slow)])
def test_the_unified_model_without_distortion_is_a_double_sphere(xi: float) -> None:
    """It is one twice: with alpha = 0 and the same xi, and with xi = 0, alpha = xi/(1 + xi) and fx/(1 + xi)."""
    fit = fit_double_sphere(cameras.build("mei", **SMALL, xi=xi, k1=0.0, k2=0.0, p1=0.0, p2=0.0))
    assert fit.residual_max_px < 1e-6


# Real lenses, and the residual (px) that is known to remain: the corners of a distorted image are what two numbers do
# not describe. Measured; the tolerance is that of the grid, not of the machine.
REAL: list[tuple[Camera, float, float]] = [
    (
        cameras.build(
            "radtan",
            width=1392,
            height=512,
            fx=788.629315,
            fy=786.382230,
            cx=687.158398,
            cy=317.752196,
            k1=-0.344441,
            k2=0.141678,
            p1=0.000414,
            p2=-0.000222,
            k3=-0.029608,
        ),
        0.860,
        14.5,
    ),
    (
        cameras.build(
            "kannala_brandt",
            width=1920,
            height=1208,
            fx=959.554,
            fy=960.194,
            cx=940.789,
            cy=670.737,
            k1=-0.097824,
            k2=0.141429,
            k3=-0.148385,
            k4=0.055918,
        ),
        1.56,
        33.7,
    ),
    (
        cameras.build(
            "mei",
            width=1400,
            height=1400,
            fx=1336.3220825849971,
            fy=1335.7883350012958,
            cx=716.9432351012632,
            cy=705.7649830822158,
            xi=2.213404750785489,
            k1=0.01679823566011368,
            k2=1.6548773243373522,
            p1=0.00042223943394772046,
            p2=0.00042462134260997584,
        ),
        1.87,
        16.9,
    ),
]


@pytest.mark.parametrize(
    ("source", "rms_px", "max_px"),
    [*(pytest.param(*lens, marks=pytest.mark.slow) for lens in REAL[:-1]), REAL[-1]],
    ids=lambda value: type(value).__name__,
)
def test_what_is_left_of_a_real_lens_is_reported(source: Camera, rms_px: float, max_px: float) -> None:
    fit = fit_double_sphere(source)
    assert fit.residual_rms_px == pytest.approx(rms_px, rel=0.02)
    assert fit.residual_max_px == pytest.approx(max_px, rel=0.02)
    assert (fit.camera.width, fit.camera.height) == (source.width, source.height)
    # The report against other pixels than those of the fit.
    uv_px = np.random.default_rng(7).uniform([0, 0], [source.width - 1, source.height - 1], (20_000, 2))
    rays, seen = unproject(source, uv_px)
    fitted_px, valid = project(fit.camera, rays[seen])
    error_px = np.linalg.norm(fitted_px - uv_px[seen], axis=1)[valid]
    assert np.sqrt(np.mean(error_px**2)) == pytest.approx(fit.residual_rms_px, rel=0.1)
    assert error_px.max() <= fit.residual_max_px * 1.3  # it is steep towards the edge of a domain
    assert valid.mean() == pytest.approx(fit.coverage, abs=0.01)


def test_no_other_double_sphere_is_closer() -> None:
    """A brute force over xi and alpha around and away from the fit finds nothing better."""
    source = REAL[1][0]
    fit = fit_double_sphere(source)
    fraction = (np.arange(64) + 0.5) / 64
    u, v = np.meshgrid(fraction * source.width - 0.5, fraction * source.height - 0.5)
    uv_px = np.stack([u, v], axis=-1).reshape(-1, 2)
    rays, _ = unproject(source, uv_px)
    for xi in np.linspace(-0.9, 1.0, 20):
        for alpha in np.linspace(0.0, 1.0, 41):
            rival = cameras.build(
                "double_sphere",
                width=source.width,
                height=source.height,
                fx=1.0,
                fy=1.0,
                cx=0.0,
                cy=0.0,
                xi=xi,
                alpha=alpha,
            )
            m, valid = project(rival, rays)
            if valid.all():
                squares = sum(
                    np.linalg.lstsq(np.stack([m[:, i], np.ones(len(m))], axis=1), uv_px[:, i], rcond=None)[1][0]
                    for i in (0, 1)
                )
                assert np.sqrt(squares / len(m)) > fit.residual_rms_px


def test_the_fit_is_deterministic() -> None:
    assert fit_double_sphere(REAL[0][0]) == fit_double_sphere(REAL[0][0])


def test_a_camera_that_sees_none_of_its_pixels_is_refused() -> None:
    blind = cameras.build("eucm", **SMALL | {"cx": 1e6}, alpha=1.0, beta=1.0)
    with pytest.raises(ValueError, match="only 0 pixels of the camera have a ray"):
        fit_double_sphere(blind)
