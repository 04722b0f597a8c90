"""`coec calibrate`: one recording, one result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from coec.adapters.files import output
from coec.calibration.frames.time_offset import TimeOffset
from coec.calibration.types import Window
from coec.cli.commands.calibrate import Options
from coec.config import WindowConfig
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.library.calibrating import Calibrated, calibrated
from coec.library.camera_fit import CameraFit
from coec.library.choices import Choices
from coec.reports import console, page, pictures, provenance
from coec.reports.calibration_page import calibration_page
from coec.reports.close_ups import Caption
from coec.reports.stage_times import StageTimes
from coec.schemas.base import to_json
from coec.schemas.replies import CalibrationReport, CalibrationResult, Vector6
from coec.sources import windows


def run(options: Options) -> int:
    """Prints the result; 1 if its verdict is negative.

    Raises:
        CoecError: there is no result.
    """
    xi = None if options.perturb is None else windows.vector_of("--perturb", options.perturb)
    with console.progress() as bars:
        times = StageTimes(bars)
        loaded = windows.load(
            options.source, options.frames, WindowConfig().pairs, lambda done, total: times.step("load", done, total)
        )
        done = calibrated(
            loaded,
            choices_of(options),
            times,
            perturbation=xi,
            camera_model=options.camera_model,
            time_offset=options.time_offset,
        )
    document = _document(done.result, times.elapsed_s(), done.fit, done.offset)
    if options.output is not None:
        lens = None if done.fit is None else (loaded.window.rig.camera, done.window.rig.camera)
        _write(options.output, done, document, _remarks(done.fit, done.offset), lens)
    if options.as_json:
        console.print_json(document)
    else:
        _show(done.window, done.result, document, done.fit, done.offset)
    if loaded.unpaired:
        causes = ", ".join(f"{count} {cause}" for cause, count in sorted(loaded.unpaired.items()))
        console.say(f"coec: frames without a partner: {causes}")
    return 0 if done.result.verdict.decision == "accepted" else 1


def choices_of(options: Options) -> Choices:
    """What was given on the command line."""
    return Choices(
        depth=options.depth,
        objective=options.objective,
        dof=None if options.dof is None else int(options.dof),
        motion_compensation=False if options.no_motion_compensation else None,
    )


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
    folder: Path,
    done: Calibrated,
    document: dict[str, Any],
    remarks: Sequence[str],
    lens: tuple[Camera, Camera] | None,
) -> None:
    """`lens`: the recording's camera and the one that was fitted to it."""
    window, result, configuration = done.window, done.result, done.configuration
    caption = Caption(
        before="start",
        after=f"result, {result.verdict.decision}",
        sigma=_sigma_of(result),
        network=pictures.network_text(configuration.depth.model, result.depth_identity),
    )
    T_found = np.array(result.camera_from_lidar.matrix)
    drawn = pictures.write_comparison(
        folder, window, window.T_camera_lidar_start, T_found, caption, configuration.motion_compensation
    )
    if lens is not None:
        drawn.append(pictures.write_lens(folder, *lens))
    report = CalibrationReport.model_validate(document)
    output.write(folder / "result.json", to_json(report))
    page.write(
        folder / "report.html",
        calibration_page(report, window, _start(window), drawn, remarks, provenance.here()),
    )


def _sigma_of(result: CalibrationResult) -> NDArray[np.float64]:
    """(6,) in radians and metres; NaN where there is none."""
    sigma = np.array([np.nan if value is None else value for value in result.sigma], dtype=np.float64)
    sigma[:3] = np.radians(sigma[:3])
    return np.where(np.array(result.solved), sigma, np.nan)


def _show(
    window: Window,
    result: CalibrationResult,
    document: dict[str, Any],
    fit: CameraFit | None,
    offset: TimeOffset | None,
) -> None:
    start = _start(window)
    console.show(f"{window.window_id}: {result.pairs} pairs, {result.points_in_view} points in view")
    axes = console.table("axis", "start", "correction", "± σ", "unit", right=(1, 2, 3))
    for axis, name in enumerate(console.AXIS_NAMES):
        unsolved = "not observable" if result.unobservable[axis] else "not searched"
        found = console.figure(result.correction[axis], sign=True) if result.solved[axis] else unsolved
        spread = console.figure(result.sigma[axis]) if result.solved[axis] else ""
        axes.add_row(name, console.figure(start[axis], sign=True), found, spread, console.UNITS[axis])
    console.out.print(axes)
    console.show_verdict(result)
    for remark in _remarks(fit, offset):
        console.show(remark)
    if result.independent_looks is not None:
        console.show(
            f"{result.pairs} pairs are worth {result.independent_looks:.1f} independent looks{_together(result)}"
        )
    stages = "  ".join(f"{stage} {seconds:.2f} s" for stage, seconds in document["elapsed_s"].items())
    console.show(f"{result.evaluations} evaluations, {result.stop_reason}; {stages}")


def _start(window: Window) -> Vector6:
    """Where the search began, from the recording's own calibration: degrees and metres."""
    start = se3.difference(window.T_camera_lidar_start, window.rig.T_camera_lidar_nominal)
    start[:3] = np.degrees(start[:3])
    return cast("Vector6", tuple(float(value) for value in start))


def _remarks(fit: CameraFit | None, offset: TimeOffset | None) -> list[str]:
    said = []
    if fit is not None:
        said.append(
            f"{fit.model} fitted to {fit.of}: {fit.residual_rms_px:.4f} px rms, {fit.residual_max_px:.4f} px at most"
        )
    if offset is not None:
        said.append(f"camera after its stamp: {_offset_text(offset)}")
    return said


def _together(result: CalibrationResult) -> str:
    """How the errors of turns and shifts go together, where both were solved."""
    pairs = {"pitch and height": result.correlation_pitch_height, "yaw and side": result.correlation_yaw_side}
    told = ", ".join(f"{names} {value:+.2f}" for names, value in pairs.items() if value is not None)
    return f"; correlation of errors: {told}" if told else ""


def _offset_text(offset: TimeOffset) -> str:
    fitted = f"{1e3 * offset.offset_s:+.1f} ± {1e3 * offset.sigma_s:.1f} ms"
    return f"{fitted}, {offset.reason}" if offset.observable else f"not observable, {offset.reason}"
