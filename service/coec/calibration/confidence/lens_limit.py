"""Whether a camera model that was fitted to another one may replace it."""

from __future__ import annotations

from math import degrees, sqrt

from coec.errors import LensError
from coec.geometry.cameras import Camera, name_of, pixel_rad
from coec.geometry.cameras.double_sphere_fit import DoubleSphereFit


def lens_error_px(residual_max_px: float) -> float:
    """Standard deviation of a fitted camera at the edges of a scene, pixels.

    There every error up to the largest is equally likely, because edges gather on the horizon and at the rim, while the
    fit was best for the whole image.
    """
    return residual_max_px / sqrt(3.0)


def require_fit(camera: Camera, fit: DoubleSphereFit, max_sigma_deg: float) -> None:
    """Refuse a fit with which no result could be certain enough to be accepted.

    More frames do not reduce the error of a lens, because all frames share it. As an angle on the optical axis it is
    the least σ that a rotation may claim. If that alone exceeds `max_sigma_deg`, above which results are refused
    (`verdict.max_sigma_deg`), a search is useless.

    Raises:
        LensError: the fit is refused. Its details are those of the fit.
    """
    error_deg = degrees(lens_error_px(fit.residual_max_px) * pixel_rad(camera))
    if error_deg <= max_sigma_deg:
        return
    name = name_of(camera)
    raise LensError(
        f"double_sphere does not fit this {name} lens: it is off by {fit.residual_max_px:.1f} px at most "
        f"({fit.residual_rms_px:.2f} px rms), by which a rotation may be {error_deg:.2f}° wrong; a result is accepted "
        f"up to {max_sigma_deg:g}°. Calibrate with the lens's own model: leave --camera-model out",
        {
            "camera_fit": {
                "model": "double_sphere",
                "of": name,
                "residual_rms_px": fit.residual_rms_px,
                "residual_max_px": fit.residual_max_px,
                "coverage": fit.coverage,
                "error_deg": error_deg,
                "limit_deg": max_sigma_deg,
            }
        },
    )
