"""When a fitted camera model may stand for a lens: by the turn that its misses feign, wherever the edges lie."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.uncertainty.systematic import require_fit
from coec.errors import LensError
from coec.geometry.cameras import Camera, build
from coec.geometry.cameras.double_sphere_fit import DoubleSphereFit, fit_double_sphere
from coec.geometry.projection import unproject

LIMIT_DEG = 0.3


def lens(seed: int) -> Camera:
    """Of 60 to 150 degrees, with a distortion as real ones have it, and a little more."""
    random = np.random.default_rng(seed)
    k1, k2, k3, k4 = random.normal(0.0, [0.08, 0.06, 0.05, 0.02])
    half_rad = np.radians(random.uniform(30.0, 75.0))
    return build(
        "kannala_brandt", width=640, height=480, fx=320.0 / half_rad, fy=320.0 / half_rad, cx=320.0, cy=240.0,
        k1=k1, k2=k2, k3=k3, k4=k4,
    )  # fmt: skip


def feigned_deg(camera: Camera, fit: DoubleSphereFit) -> float:
    """The largest turn that the rays of the fit show against those of the lens, over quarters of the image's sides:
    what a scene whose edges gather there would be turned by."""
    u, v = np.meshgrid(np.arange(5.0, 640.0, 10.0), np.arange(5.0, 480.0, 10.0))
    uv_px = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, seen = unproject(camera, uv_px)
    fitted, also = unproject(fit.camera, uv_px)
    both = seen & also
    result = [
        np.linalg.norm(_turn(rays[here], fitted[here]))
        for left in range(0, 640, 160)
        for top in range(0, 480, 120)
        if (here := both & (np.abs(uv_px - [left + 80, top + 60]) < [80, 60]).all(axis=1)).sum() > 100
    ]
    return float(np.degrees(max(result)))


def _turn(rays: NDArray[np.float64], fitted: NDArray[np.float64]) -> NDArray[np.float64]:
    """ω (3,) with rays ≈ fitted + ω × fitted, least squares; about the viewing direction, of which a small patch tells
    nothing, none."""
    middle = fitted.mean(axis=0)
    middle /= np.linalg.norm(middle)
    normal = len(fitted) * np.eye(3) - fitted.T @ fitted + 1e9 * np.outer(middle, middle)
    turn: NDArray[np.float64] = np.linalg.solve(normal, np.cross(fitted, rays - fitted).sum(axis=0))
    return turn


# A fit takes a second or two.
@pytest.mark.parametrize("seeds", [range(1, 3), pytest.param(range(40), marks=pytest.mark.slow)])
def test_what_is_let_through_turns_no_result_by_more_than_is_accepted(seeds: range) -> None:
    let_through, refused = [], []
    for seed in seeds:
        camera = lens(seed)
        fit = fit_double_sphere(camera)
        try:
            require_fit(camera, fit, LIMIT_DEG)
        except LensError:
            refused.append(feigned_deg(camera, fit))
        else:
            let_through.append(feigned_deg(camera, fit))
    # Both sorts are among the lenses, or nothing is shown.
    assert let_through
    assert refused
    assert max(let_through) < LIMIT_DEG
    assert np.median(refused) > 3.0 * np.median(let_through)


def test_the_limit_is_that_of_the_result() -> None:
    camera = lens(2)
    fit = fit_double_sphere(camera)
    with pytest.raises(LensError) as refused:
        require_fit(camera, fit, 0.0)
    reported = refused.value.details["camera_fit"]
    assert isinstance(reported, dict)
    error_deg = reported["error_deg"]
    require_fit(camera, fit, 1.001 * error_deg)
    with pytest.raises(LensError, match="leave --camera-model out"):
        require_fit(camera, fit, 0.999 * error_deg)
