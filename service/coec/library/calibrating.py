"""From a loaded window to its result: the whole flow on one page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.adapters.depth.maps import open_depth
from coec.adapters.files.conversions import result_of
from coec.adapters.images.codec import GreyImages
from coec.calibration import calibrator
from coec.calibration.frames.time_offset import TimeOffset, estimate_time_offset
from coec.calibration.ports import Progress
from coec.calibration.types import Estimate, Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.library.camera_fit import CameraFit, refitted
from coec.library.choices import Choices, configuration_of
from coec.schemas.replies import CalibrationResult
from coec.sources import windows


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """A result, and what it rests on.

    Attributes:
        window: the window as it was solved: with its start moved and its camera fitted where that was asked for.
        estimate: see `calibration.types`.
        result: the estimate as a document of the wire contract.
        configuration: the settings that decided the result.
        fit: how well the fitted camera model fits; None where the recording's own model was used.
        offset: offset of the camera's clock; None where it was not asked for.
    """

    window: Window
    estimate: Estimate
    result: CalibrationResult
    configuration: CalibrationConfig
    fit: CameraFit | None
    offset: TimeOffset | None


def calibrated(
    loaded: windows.Loaded,
    choices: Choices,
    progress: Progress,
    *,
    perturbation: NDArray[np.float64] | None = None,
    camera_model: str | None = None,
    time_offset: bool = False,
) -> Calibrated:
    """Calibrates a window.

    Args:
        loaded: the window, with the configuration that was recorded with it.
        choices: what the caller chose otherwise.
        progress: is called for the stages `prepare`, those of the calibration, and `time offset`.
        perturbation: ξ (6,), radians and metres about the camera axes, by which the start is moved; None: it is not
            moved.
        camera_model: a model that is fitted to the recording's camera and used in its place; None: the recording's own.
        time_offset: also estimate the offset of the camera's clock.

    Raises:
        UsageError: a value that does not exist.
        ModelError: the depth network cannot be opened.
        CalibrationError: there is no result.
    """
    configuration = configuration_of(choices, loaded.configuration)
    window = loaded.window if perturbation is None else windows.started_at(loaded.window, perturbation)
    window, fit = (window, None) if camera_model is None else refitted(window, camera_model)
    depth = open_depth(configuration.depth, LimitsConfig())
    progress.step("prepare", 1, 1)
    images = GreyImages(LimitsConfig())
    estimate = calibrator.calibrate(window, depth, images, configuration, progress)
    offset = None
    if time_offset:
        offset = estimate_time_offset(window, images, estimate.optimum.T_camera_lidar, configuration)
        progress.step("time offset", 1, 1)
    result = result_of(estimate, window.rig, loaded.vehicle)
    return Calibrated(window, estimate, result, configuration, fit, offset)
