"""`coec calibrate`: one recording, one result."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

import typer

from coec.calibration_options import CalibrationOptions
from coec.cli.options import Fix, Json, Source, show_correction, with_calibration_options
from coec.errors import LensError, OutputError
from coec.reports import console
from coec.reports.console import StageTimes

if TYPE_CHECKING:
    from coec.geometry.cameras import Camera
    from coec.io.recordings.window_cutting import LoadedWindow
    from coec.recording import Solution


OutputFolder = Annotated[
    Path | None,
    typer.Option(
        "--output",
        help="Write report.html, overlay_before.png, overlay_after.png, close_ups.png, residuals.png and "
        "result.json; with --camera-model also lens_residual.png, even if the model is refused.",
        metavar="DIR",
    ),
]
ShowIntrinsics = Annotated[
    bool,
    typer.Option(
        "--intrinsics",
        help="Also show focal length, principal point and radial distortion as the window has them, with σ. In "
        "JSON they are always there (`lens`).",
    ),
]


@with_calibration_options(CalibrationOptions)
def calibrate(
    source: Source,
    output: OutputFolder = None,
    intrinsics: ShowIntrinsics = False,
    as_json: Json = False,
    fix: Fix = False,
    **options: Unpack[CalibrationOptions],
) -> int:
    """Calibrate from a recording: exit 0 if the result is accepted, 1 if the self-diagnosis refuses it."""
    from coec.config import WindowConfig
    from coec.io import user_files as files
    from coec.io.recordings import window_cutting
    from coec.io.recordings.manifest import has_manifest, manifest_of
    from coec.recording import perturbation_of
    from coec.reports import calibration

    if output is not None:
        files.try_folder(output)
    if options.get("perturb") is not None:
        perturbation_of(options["perturb"] or ())
    manifest = manifest_of(source) if fix else None
    with console.progress() as bars:
        times = StageTimes(bars)
        loaded = window_cutting.load_window(
            source, options.get("frames"), WindowConfig().pairs, lambda done, total: times.step("load", done, total)
        )
        with picture_of_lens_error(output, loaded.window.rig.camera):
            solution = _solved(loaded, options, times, manifest)
    document = _document(solution, times.elapsed_s())
    written: list[Path] = []
    left_out: tuple[str, ...] = ()
    not_written = None
    if output is not None:
        try:
            written, left_out = _write(output, loaded.window.rig.camera, solution, document, intrinsics=intrinsics)
        except OutputError as error:
            not_written = error
            document["not_written"] = str(error)
    console.report(
        document,
        lambda: calibration.show(
            solution.window, solution.result, solution.configuration, document, intrinsics=intrinsics
        ),
        as_json=as_json,
    )
    if manifest is not None and solution.mistake is not None:
        show_correction(manifest, solution.mistake, loaded.window.rig)
    elif solution.mistake is not None and solution.mistake.correctable and has_manifest(source):
        console.say("coec: the same command with --fix writes a corrected dataset.yaml")
    if not_written is not None:
        console.say(f"coec: {not_written}")
    elif output is not None and not as_json:
        calibration.show_written(output, written, left_out)
    if loaded.unpaired:
        causes = ", ".join(f"{count} {cause}" for cause, count in sorted(loaded.unpaired.items()))
        console.say(f"coec: frames without a partner: {causes}")
    return 0 if solution.result.verdict.decision == "accepted" and not_written is None else 1


def _solved(loaded: LoadedWindow, options: CalibrationOptions, progress: StageTimes, manifest: Path | None) -> Solution:
    """The solution; if there is none because of a mistake in `manifest`, a corrected one is written before the error
    goes on."""
    from coec.recording import MistakenInputError, solve

    try:
        return solve(loaded, options, progress)
    except MistakenInputError as error:
        if manifest is not None:
            show_correction(manifest, error.mistake, loaded.window.rig)
        raise


def _document(solution: Solution, elapsed_s: dict[str, float]) -> dict[str, Any]:
    import numpy as np

    from coec.io.serialise import mistake_of
    from coec.reports.page_parts import finite_or_none
    from coec.schemas.replies import CalibrationReport, Reason, WeighedPoses

    fit, offset = solution.fit, solution.offset
    weighed = None if solution.weighed is None else WeighedPoses(**asdict(solution.weighed))
    mistake = None if solution.mistake is None else mistake_of(solution.mistake)
    recognised = tuple(Reason(code=one.code, text=one.text) for one in solution.recognitions)
    report = CalibrationReport(
        **dict(solution.result), elapsed_s=elapsed_s, mistake=mistake, recognitions=recognised, weighed=weighed
    )
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
            "offset_s": finite_or_none(offset.offset_s),
            "sigma_s": finite_or_none(offset.sigma_s),
            "turn_spread_deg_per_s": finite_or_none(np.degrees(offset.turn_spread_radps)),
            "observable": offset.observable,
            "reason": offset.reason,
        }
    return document


def _write(
    folder: Path, camera: Camera, solution: Solution, document: dict[str, Any], *, intrinsics: bool
) -> tuple[list[Path], tuple[str, ...]]:
    """Writes the files; returns their paths, and what was left out. `camera` is the recording's, to which another may
    have been fitted."""
    import numpy as np

    from coec.io import user_files as files
    from coec.reports import calibration, page, pictures
    from coec.reports.calibration import calibration_page
    from coec.reports.close_ups import Caption
    from coec.reports.page import Pictures
    from coec.reports.page_parts import Provenance, file_picture
    from coec.schemas.message import to_json
    from coec.schemas.replies import CalibrationReport

    window, result, compensated = solution.window, solution.result, solution.configuration.motion_compensation
    caption = Caption(
        before="start" if solution.weighed is None else "recording",
        after=f"result ({result.verdict.decision})",
        covariance=solution.estimate.uncertainty.covariance,
        network=pictures.network_text(solution.configuration.depth.model, result.depth_identity),
    )
    T_result = np.array(result.camera_from_lidar.matrix)
    comparison = pictures.write_comparison(
        folder, window, window.T_camera_lidar_start, T_result, caption, compensated, result.independent_looks
    )
    paths, blocks = list(comparison.files), comparison.blocks
    if solution.fit is not None:
        paths.append(pictures.write_lens(folder, camera, window.rig.camera))
        blocks = (*blocks, Pictures((file_picture(paths[-1]),)))
    report = CalibrationReport.model_validate(document)
    written = files.write_output(folder / "result.json", to_json(report))
    mistake = [] if document["mistake"] is None else [document["mistake"]["text"]]
    remarks = [*mistake, *calibration.remarks(document)]
    of_result = calibration_page(
        report, window, calibration.start_of(window), blocks, remarks, Provenance.here(), intrinsics=intrinsics
    )
    return [*paths, written, page.write(folder / "report.html", of_result)], comparison.left_out


@contextmanager
def picture_of_lens_error(folder: Path | None, camera: Camera) -> Iterator[None]:
    """If a fit to the camera is refused within, writes a picture of the residuals into the folder, and adds its path to
    the error.

    Raises:
        LensError: the one from within, plus the path of the picture; without a folder, plus how to get a picture.
        OutputError: the picture cannot be written.
    """
    from coec.geometry.cameras.double_sphere_fit import fit_double_sphere

    try:
        yield
    except LensError as error:
        if folder is None:
            raise LensError(
                f"{error}; with --output DIR a picture shows where in the image it is off", error.details
            ) from error
        from coec.reports import pictures

        path = pictures.write_lens(folder, camera, fit_double_sphere(camera).camera)
        details = {**error.details, "picture": str(path)}
        raise LensError(f"{error}. Where in the image it is off: {path}", details) from error
