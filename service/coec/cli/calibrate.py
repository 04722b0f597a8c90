"""`coec calibrate`: one recording, one result."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from rich.progress import Progress, TaskID

from coec.adapters.depth.maps import open_depth
from coec.adapters.files import output
from coec.adapters.files.conversions import result_of
from coec.adapters.files.output import OutputError
from coec.adapters.images.codec import GreyImages
from coec.calibration.calibrator import calibrate
from coec.calibration.confidence.lens_limit import require_fit
from coec.calibration.frames.time_offset import TimeOffset, estimate_time_offset
from coec.calibration.types import Rig, Window
from coec.cli.commands.calibrate import Options
from coec.config import CalibrationConfig, LimitsConfig, VerdictConfig, WindowConfig, describe
from coec.errors import UsageError
from coec.geometry.cameras import name_of
from coec.geometry.cameras.double_sphere_fit import fit_double_sphere
from coec.reports import calibration, console, pictures
from coec.schemas.base import to_json
from coec.schemas.replies import CalibrationReport, CalibrationResult
from coec.sources import windows

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


class StageTimes:
    """Progress bars and the seconds that each stage took. A stage ends with its last step."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._tasks: dict[str, TaskID] = {}
        self._mark_s = self._start_s = time.perf_counter()
        self._elapsed_s: dict[str, float] = {}

    def step(self, stage: str, done: int, total: int) -> None:
        """See `ports.Progress`. The number of evaluations of a search is not known before it ends."""
        now_s = time.perf_counter()
        self._elapsed_s[stage] = self._elapsed_s.get(stage, 0.0) + now_s - self._mark_s
        self._mark_s = now_s
        if stage not in self._tasks:
            open_end = stage == "search"
            self._tasks[stage] = self._bars.add_task(stage, total=None if open_end else total, note="")
        note = f"{done} evaluations" if stage == "search" else ""
        self._bars.update(self._tasks[stage], completed=done, note=note)

    def elapsed_s(self) -> dict[str, float]:
        """By stage, and `total`."""
        return {**self._elapsed_s, "total": time.perf_counter() - self._start_s}


def run(options: Options) -> int:
    """Prints the result; 1 if its verdict is negative.

    Raises:
        CoecError: there is no result, or nothing can be written where it is to be.
    """
    if options.output is not None:
        output.try_folder(options.output)
    xi = None if options.perturb is None else windows.vector_of("--perturb", options.perturb)
    with console.progress() as bars:
        times = StageTimes(bars)
        loaded = windows.load(
            options.source, options.frames, WindowConfig().pairs, lambda done, total: times.step("load", done, total)
        )
        configuration = configuration_of(options, loaded.configuration)
        window = loaded.window if xi is None else windows.started_at(loaded.window, xi)
        window, fit = (window, None) if options.camera_model is None else refitted(window, options.camera_model)
        depth = open_depth(configuration.depth, LimitsConfig())
        times.step("prepare", 1, 1)
        images = GreyImages(LimitsConfig())
        estimate = calibrate(window, depth, images, configuration, times)
        offset = None
        if options.time_offset:
            offset = estimate_time_offset(window, images, estimate.optimum.T_camera_lidar, configuration)
            times.step("time offset", 1, 1)
    result = result_of(estimate, window.rig, loaded.vehicle)
    document = _document(result, times.elapsed_s(), fit, offset)
    written, not_written = [], None
    if options.output is not None:
        try:
            written = _write(options.output, window, result, configuration, document)
        except OutputError as error:
            not_written = error
            document["not_written"] = str(error)
    if options.as_json:
        console.print_json(document)
    else:
        calibration.show(
            window,
            result,
            configuration=configuration,
            camera_fit=document.get("camera_fit"),
            time_offset=document.get("time_offset"),
            elapsed_s=document["elapsed_s"],
        )
    if not_written is not None:
        console.say(f"coec: {not_written}")
    elif options.output is not None and not options.as_json:
        calibration.show_written(options.output, written)
    if loaded.unpaired:
        causes = ", ".join(f"{count} {cause}" for cause, count in sorted(loaded.unpaired.items()))
        console.say(f"coec: frames without a partner: {causes}")
    return 0 if result.verdict.decision == "accepted" and not_written is None else 1


def configuration_of(options: Options, recorded: CalibrationConfig | None) -> CalibrationConfig:
    """The recorded configuration, or the defaults, with what was given on the command line.

    Raises:
        UsageError: a value that does not exist.
    """
    values: dict[str, Any] = (recorded or CalibrationConfig()).model_dump()
    if options.depth is not None:
        values["depth"]["model"] = options.depth
    if options.objective is not None:
        values["objective"]["kind"] = options.objective
    if options.dof is not None:
        values["search"]["dof"] = int(options.dof)
    if options.no_motion_compensation:
        values["motion_compensation"] = False
    try:
        return CalibrationConfig.model_validate(values)
    except ValidationError as error:
        raise UsageError(f"the options do not fit: {describe(error)}") from error


def refitted(window: Window, model: str) -> tuple[Window, CameraFit]:
    """The window seen through another camera model that was fitted to its own.

    Raises:
        UsageError: there is no such model to fit.
        LensError: it does not fit the lens.
    """
    if model != FITTED:
        raise UsageError(f"--camera-model {model}: only {FITTED} can be fitted")
    rig: Rig = window.rig
    fit = fit_double_sphere(rig.camera)
    require_fit(rig.camera, fit, VerdictConfig().max_sigma_deg)
    quality = CameraFit(FITTED, name_of(rig.camera), fit.residual_rms_px, fit.residual_max_px, fit.coverage)
    fitted = replace(rig, camera=fit.camera, camera_residual_px=fit.residual_max_px)
    return replace(window, rig=fitted), quality


def _document(
    result: CalibrationResult, elapsed_s: dict[str, float], fit: CameraFit | None, offset: TimeOffset | None
) -> dict[str, Any]:
    report = CalibrationReport(**dict(result), elapsed_s=elapsed_s)
    document: dict[str, Any] = report.model_dump(mode="json")
    if fit is not None:
        document["camera_fit"] = {
            "model": fit.model,
            "of": fit.of,
            "residual_rms_px": fit.residual_rms_px,
            "residual_max_px": fit.residual_max_px,
            "coverage": fit.coverage,
        }
    if offset is not None:
        document["time_offset"] = {
            "offset_s": _finite(offset.offset_s),
            "sigma_s": _finite(offset.sigma_s),
            "turn_spread_deg_per_s": _finite(np.degrees(offset.turn_spread_radps)),
            "observable": offset.observable,
            "reason": offset.reason,
        }
    return document


def _finite(value: float) -> float | None:
    """JSON has no word for what is not a number."""
    return float(value) if np.isfinite(value) else None


def _write(
    folder: Path, window: Window, result: CalibrationResult, configuration: CalibrationConfig, document: dict[str, Any]
) -> list[Path]:
    T_found = np.array(result.camera_from_lidar.matrix)
    moved_deg = windows.rotation_error_deg(T_found, window.T_camera_lidar_start)
    where = f"{window.rig.pair}  {pictures.middle(window).stamp_ns} ns"
    poses = {
        "overlay_before": (window.T_camera_lidar_start, f"{where}  start"),
        "overlay_after": (T_found, f"{where}  {result.verdict.decision}, {moved_deg:.2f} deg from the start"),
    }
    overlays = pictures.write_overlays(folder, window, poses, configuration.motion_compensation)
    return [*overlays, output.write(folder / "result.json", to_json(CalibrationReport.model_validate(document)))]
