"""Another camera model in place of the one that a recording came with."""

from __future__ import annotations

from dataclasses import dataclass, replace

from coec.calibration.confidence.lens_limit import require_fit
from coec.calibration.types import Rig, Window
from coec.config import VerdictConfig
from coec.errors import UsageError
from coec.geometry.cameras import name_of
from coec.geometry.cameras.double_sphere_fit import fit_double_sphere

FITTED = "double_sphere"
"""The one model that can be fitted to the others."""


@dataclass(frozen=True, slots=True)
class CameraFit:
    """What a fitted camera model misses of the one it stands for, pixels. `coverage`: share of the source's pixels."""

    model: str
    of: str
    residual_rms_px: float
    residual_max_px: float
    coverage: float


def refitted(window: Window, model: str) -> tuple[Window, CameraFit]:
    """The window seen through another camera model that was fitted to its own.

    Raises:
        UsageError: no model that can be fitted.
        LensError: it does not fit the lens.
    """
    if model != FITTED:
        raise UsageError(f"camera model {model}: only {FITTED} can be fitted")
    rig: Rig = window.rig
    fit = fit_double_sphere(rig.camera)
    require_fit(rig.camera, fit, VerdictConfig().max_sigma_deg)
    quality = CameraFit(FITTED, name_of(rig.camera), fit.residual_rms_px, fit.residual_max_px, fit.coverage)
    fitted = replace(rig, camera=fit.camera, camera_residual_px=fit.residual_max_px)
    return replace(window, rig=fitted), quality
