"""`coec diagnose`: whether a recording's extrinsic is right, or how well a wrong one is detected on it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coec.calibration_options import SolverOptions
from coec.cli.commission import RigWindows, load
from coec.cli.options import Depth, Frames, Json, Source
from coec.errors import CalibrationError, UsageError
from coec.reports import console
from coec.reports.console import StageTimes

if TYPE_CHECKING:
    from coec.calibration.baseline import Baseline
    from coec.calibration.monitor.change_detector import Observation
    from coec.calibration.types import Window
    from coec.reports import diagnosis

REACH_DEG = 8.0
"""How far around the given pose the pose is searched: as far as a knock moves a mount. Beyond that, use
`coec calibrate`."""

MAX_SIGMA_DEG = 1.0
"""Above this standard deviation of a rotation, a result is not reported. The limit is looser than for serving, because
a knock is reported with its σ."""


def diagnose(
    source: Source,
    depth: Depth = None,
    rig: Annotated[
        Path | None, typer.Option(help="Baseline from `coec commission`.", metavar="FILE", show_default=False)
    ] = None,
    perturb: Annotated[
        str | None,
        typer.Option(help="Move the extrinsic: degrees and metres.", metavar="RX,RY,RZ[,TX,TY,TZ]"),
    ] = None,
    detection: Annotated[
        int,
        typer.Option(
            help="Instead, print how well moved extrinsics are detected, over N splits of the pairs.",
            metavar="N",
            min=0,
        ),
    ] = 0,
    checks: Annotated[int, typer.Option(help="Checks per split and move, with --detection.", min=1)] = 10,
    frames: Frames = None,
    output: Annotated[
        Path | None, typer.Option(help="Write report.html and overlay.png.", metavar="DIR", show_default=False)
    ] = None,
    as_json: Json = False,
) -> int:
    """Check the extrinsic of a recording, as the service does every few seconds: exit 1 if it is wrong or undecided."""
    from coec.calibration.monitor.check_verdict import diagnose as check_extrinsic
    from coec.io.serialise import in_degrees
    from coec.reports import diagnosis

    experiment = _detection_experiment() if detection > 0 else None
    with console.progress() as bars:
        times = StageTimes(bars)
        rigged = load((source,), SolverOptions(depth=depth, frames=frames), times)
        if experiment is not None:
            report = experiment.measure(rigged, detection, checks, times)
        else:
            window = _moved(rigged.windows[0], perturb)
            seen = check_extrinsic(
                window, rigged.depth, rigged.images, rigged.configuration, _baseline(rig, window, rigged)
            )
            # For a commissioned rig, the bias is known for checks only, not for a solve.
            needs_solve = seen.flagged and not seen.causes and rig is None
            measured = _measured(rigged, window, seen) if needs_solve else None
    if experiment is not None:
        experiment.show(report, source, output, as_json=as_json)
        return 0
    if output is not None:
        _write(output, seen, window, rigged, measured)
    finding = diagnosis.finding_of(seen, in_degrees(seen.offset).tolist(), in_degrees(seen.sigma).tolist(), measured)
    console.report(_document(seen, finding, measured), lambda: _show(seen, finding), as_json=as_json)
    return int(finding.state != "right")


def _detection_experiment() -> Any:
    """The module behind `--detection`, which another package registers by the entry points of `coec.experiments`."""
    from coec.extensions import EXPERIMENTS, added_by_packages

    experiment = added_by_packages(EXPERIMENTS).get("detection")
    if experiment is not None:
        return experiment()
    raise UsageError("--detection is an experiment of the laboratory: `pip install coec-lab`")


def _moved(window: Window, perturb: str | None) -> Window:
    from coec.geometry import se3
    from coec.io.recordings import window_cutting

    if perturb is None:
        return window
    moved = se3.perturb(window.T_camera_lidar_start, window_cutting.parse_perturbation("--perturb", perturb))
    return replace(window, T_camera_lidar_start=moved)


def _baseline(file: Path | None, window: Window, rigged: RigWindows) -> Baseline | None:
    """The baseline of the pair in a file of `coec commission`.

    Raises:
        UsageError: the file has none, or it does not hold for this recording.
    """
    from coec.calibration.baseline import learned_hash, mismatch
    from coec.io.rig_files import load_baseline

    if file is None:
        return None
    if not file.is_file():
        raise UsageError(f"--rig {file}: there is no such file; `coec commission` writes one")
    baseline = load_baseline(file, window.rig.pair)
    if baseline is None:
        raise UsageError(f"{file} holds no baseline of the pair {window.rig.pair}: run `coec commission`")
    against = mismatch(baseline, window.rig, rigged.depth.identity, learned_hash(rigged.configuration))
    if against is not None:
        raise UsageError(f"{file} does not hold for this recording: {against}")
    return baseline


def _document(
    seen: Observation, finding: diagnosis.ExtrinsicFinding, measured: diagnosis.SolvedOffset | None
) -> dict[str, Any]:
    from coec.io.serialise import in_degrees, metric_of
    from coec.reports import diagnosis

    return {
        "finding": finding.state,
        "text": finding.sentence,
        "flagged": seen.flagged,
        "undecided": seen.undecided,
        "flagged_by_paper": seen.flagged_by_paper,
        "causes": [{"code": cause.code, "text": cause.text} for cause in seen.causes],
        "offset": in_degrees(seen.offset).tolist(),
        "sigma": in_degrees(seen.sigma).tolist(),
        "measured": None if measured is None else asdict(measured),
        "drift": None if seen.drift is None else in_degrees(seen.drift.value).tolist(),
        "drift_sigma": None if seen.drift is None else in_degrees(seen.drift.sigma).tolist(),
        "first_derivative": seen.first_derivative.tolist(),
        "second_derivative": seen.second_derivative.tolist(),
        "decided_by": sorted(diagnosis.deciding(seen)),
        "metrics": {metric.name: metric_of(metric).model_dump(mode="json") for metric in seen.metrics},
    }


def _show(seen: Observation, finding: diagnosis.ExtrinsicFinding) -> None:
    from rich.text import Text

    from coec.io.serialise import in_degrees, metric_of
    from coec.reports import diagnosis

    offset, sigma = in_degrees(seen.offset).tolist(), in_degrees(seen.sigma).tolist()
    axes = console.table("axis", "offset", "± σ", "unit", "f'", "f''", right=(1, 2, 4, 5))
    for axis, name in enumerate(console.AXIS_NAMES):
        axes.add_row(
            name,
            console.figure(offset[axis], sign=True),
            console.figure(sigma[axis]),
            console.UNITS[axis],
            # The paper's derivatives decide nothing.
            Text(console.figure(float(seen.first_derivative[axis]), sign=True), "dim"),
            Text(console.figure(float(seen.second_derivative[axis]), sign=True), "dim"),
            style="dim" if seen.causes else "",
        )
    diagnosis.show(finding)
    console.out.print(axes)
    metrics = {metric.name: metric_of(metric) for metric in seen.metrics if metric.value is not None}
    console.show_metrics(metrics, diagnosis.deciding(seen))


def _measured(rigged: RigWindows, window: Window, seen: Observation) -> diagnosis.SolvedOffset | None:
    """How far off a flagged extrinsic is, by a solve of all pairs within reach of it; None without a result.
    Translations are searched if the check sees one. If not, the camera's centre counts as known only as well as the
    check knows it, because what turned the mount may also have shifted it."""
    import numpy as np

    from coec.calibration.pipeline import calibrate
    from coec.calibration.types import Decision, Silence
    from coec.geometry import se3
    from coec.io.serialise import in_degrees
    from coec.reports import diagnosis

    shifted = np.abs(seen.offset[3:]) >= diagnosis.TELLING * seen.sigma[3:]
    searched = {"dof": 6 if shifted.any() else 3, "reach_deg": REACH_DEG}
    search = rigged.configuration.search.model_copy(update=searched)
    known_m = max(rigged.configuration.verdict.held_translation_sigma_m, float(np.max(seen.sigma[3:])))
    verdict = rigged.configuration.verdict.model_copy(
        update={"held_translation_sigma_m": known_m, "max_sigma_deg": MAX_SIGMA_DEG}
    )
    configuration = rigged.configuration.model_copy(update={"search": search, "verdict": verdict})
    try:
        estimate = calibrate(window, rigged.depth, rigged.images, configuration, Silence())
    except CalibrationError:
        return None
    difference = se3.difference(estimate.optimum.T_camera_lidar, window.T_camera_lidar_start)
    sigma = in_degrees(estimate.uncertainty.sigma).tolist()
    return diagnosis.SolvedOffset(
        offset=tuple(in_degrees(difference).tolist()),
        sigma=tuple(value if solved else None for value, solved in zip(sigma, estimate.solved, strict=True)),
        accepted=estimate.verdict.decision is Decision.ACCEPTED,
        reasons=tuple(reason.text for reason in estimate.verdict.reasons),
        pairs=estimate.pairs,
    )


def _write(
    folder: Path, seen: Observation, window: Window, rigged: RigWindows, measured: diagnosis.SolvedOffset | None
) -> None:
    from coec.config import config_hash
    from coec.reports import page, pictures
    from coec.reports.diagnosis import check_page
    from coec.reports.page_parts import Provenance

    (image,) = pictures.overlays(window, (window.T_camera_lidar_start,), rigged.configuration.motion_compensation)
    title = f"{window.rig.pair}  the extrinsic that was checked"
    written = [pictures.write_overlay(folder, "overlay", image, title)]
    of_check = check_page(
        seen, measured, window, rigged.depth.identity, config_hash(rigged.configuration), written, Provenance.here()
    )
    page.write(folder / "report.html", of_check)
