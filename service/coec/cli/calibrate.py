"""`coec calibrate`: one recording, one result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coec.adapters.files import output
from coec.calibration.frames.time_offset import TimeOffset
from coec.cli.chosen import choices_of
from coec.cli.commands.calibrate import Options
from coec.cli.lens_refusal import drawn_if_refused
from coec.config import WindowConfig
from coec.errors import OutputError
from coec.geometry.cameras import Camera
from coec.library.calibrating import Calibrated, calibrated
from coec.library.camera_fit import CameraFit
from coec.reports import calibration, console, page, provenance
from coec.reports.calibration_page import calibration_page
from coec.reports.page import Pictures
from coec.reports.page_parts import file_picture
from coec.reports.stage_times import StageTimes
from coec.schemas.base import to_json
from coec.schemas.replies import CalibrationReport, CalibrationResult
from coec.sources import windows


def run(options: Options) -> int:
    """Prints the result; returns 1 if its verdict is negative.

    Raises:
        CoecError: there is no result, or the output folder cannot be written.
    """
    if options.output is not None:
        output.try_folder(options.output)
    xi = None if options.perturb is None else windows.vector_of("--perturb", options.perturb)
    with console.progress() as bars:
        times = StageTimes(bars)
        loaded = windows.load(
            options.source, options.frames, WindowConfig().pairs, lambda done, total: times.step("load", done, total)
        )
        with drawn_if_refused(options.output, loaded.window.rig.camera):
            done = calibrated(
                loaded,
                choices_of(options),
                times,
                perturbation=xi,
                camera_model=options.camera_model,
                time_offset=options.time_offset,
            )
    document = _document(done.result, times.elapsed_s(), done.fit, done.offset)
    written: list[Path] = []
    left_out: tuple[str, ...] = ()
    not_written = None
    if options.output is not None:
        try:
            written, left_out = _write(options.output, loaded.window.rig.camera, done, document)
        except OutputError as error:
            not_written = error
            document["not_written"] = str(error)
    if options.as_json:
        console.print_json(document)
    else:
        calibration.show(
            done.window,
            done.result,
            configuration=done.configuration,
            camera_fit=document.get("camera_fit"),
            time_offset=document.get("time_offset"),
            elapsed_s=document["elapsed_s"],
        )
    if not_written is not None:
        console.say(f"coec: {not_written}")
    elif options.output is not None and not options.as_json:
        calibration.show_written(options.output, written, left_out)
    if loaded.unpaired:
        causes = ", ".join(f"{count} {cause}" for cause, count in sorted(loaded.unpaired.items()))
        console.say(f"coec: frames without a partner: {causes}")
    return 0 if done.result.verdict.decision == "accepted" and not_written is None else 1


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
    """The value, or None if it is not finite, because JSON has no NaN."""
    return float(value) if np.isfinite(value) else None


def _write(
    folder: Path, camera: Camera, done: Calibrated, document: dict[str, Any]
) -> tuple[list[Path], tuple[str, ...]]:
    """Writes the files; returns them, and what was left out. `camera` is the recording's, to which another may have
    been fitted."""
    # matplotlib takes a second to import.
    from coec.reports import pictures
    from coec.reports.close_ups import Caption

    window, result, compensated = done.window, done.result, done.configuration.motion_compensation
    caption = Caption(
        before="start",
        after=f"result ({result.verdict.decision})",
        sigma=_sigma_of(result),
        network=pictures.network_text(done.configuration.depth.model, result.depth_identity),
    )
    T_found = np.array(result.camera_from_lidar.matrix)
    drawn = pictures.write_comparison(
        folder, window, window.T_camera_lidar_start, T_found, caption, compensated, result.independent_looks
    )
    files, blocks = list(drawn.files), drawn.blocks
    if done.fit is not None:
        files.append(pictures.write_lens(folder, camera, window.rig.camera))
        blocks = (*blocks, Pictures((file_picture(files[-1]),)))
    report = CalibrationReport.model_validate(document)
    written = output.write(folder / "result.json", to_json(report))
    said = calibration.remarks(document.get("camera_fit"), document.get("time_offset"))
    of_result = calibration_page(report, window, calibration.start_of(window), blocks, said, provenance.here())
    return [*files, written, page.write(folder / "report.html", of_result)], drawn.left_out


def _sigma_of(result: CalibrationResult) -> NDArray[np.float64]:
    """(6,) in radians and metres; NaN where there is none."""
    sigma = np.array([np.nan if value is None else value for value in result.sigma], dtype=np.float64)
    sigma[:3] = np.radians(sigma[:3])
    return np.where(np.array(result.solved), sigma, np.nan)
