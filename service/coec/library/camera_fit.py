"""Replaces the camera model of a recording by one that is fitted to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from coec.calibration.confidence.lens_limit import require_fit
from coec.calibration.types import Rig, Window
from coec.config import VerdictConfig
from coec.errors import UsageError
from coec.geometry.cameras import name_of
from coec.geometry.cameras.double_sphere_fit import fit_double_sphere

FITTED = "double_sphere"
"""The only model that can be fitted to another one."""


@dataclass(frozen=True, slots=True)
class CameraFit:
    """How far the fitted camera model `model` is off the original `of`, pixels. `coverage`: share of the original's
    pixels that the fit covers."""

    model: str
    of: str
    residual_rms_px: float
    residual_max_px: float
    coverage: float


def refitted(window: Window, model: str) -> tuple[Window, CameraFit]:
    """The window with another camera model, which is fitted to the window's own.

    Raises:
        UsageError: `model` cannot be fitted.
        LensError: the model does not fit the lens.
    """
    if model != FITTED:
        raise UsageError(f"camera model {model}: only {FITTED} can be fitted")
    rig: Rig = window.rig
    fit = fit_double_sphere(rig.camera)
    require_fit(rig.camera, fit, VerdictConfig().max_sigma_deg)
    quality = CameraFit(FITTED, name_of(rig.camera), fit.residual_rms_px, fit.residual_max_px, fit.coverage)
    fitted = replace(rig, camera=fit.camera, camera_residual_px=fit.residual_max_px)
    return replace(window, rig=fitted), quality
