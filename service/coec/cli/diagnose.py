"""`coec diagnose`: whether a recording's extrinsic is right, or how well a wrong one is detected on it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from coec.adapters.files.baseline_file import load_baseline
from coec.adapters.files.conversions import metric_of
from coec.calibration.calibrator import calibrate
from coec.calibration.commissioning.baseline import learned_hash, mismatch
from coec.calibration.commissioning.learning import FAR_RAD
from coec.calibration.estimators import sight_of
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.check import gather
from coec.calibration.monitor.check_verdict import diagnose
from coec.calibration.ports import Silence
from coec.calibration.types import Decision, Window
from coec.cli import commission
from coec.cli.commands import commission as commission_options
from coec.cli.commands.diagnose import Options
from coec.config import config_hash
from coec.errors import CalibrationError, UsageError
from coec.evaluation.detection import try_detection
from coec.geometry import se3
from coec.reports import console, diagnosis, evaluation_tables, page, pictures, provenance
from coec.reports.check_page import check_page, detection_page
from coec.reports.evaluation_documents import detection_of
from coec.reports.stage_times import StageTimes
from coec.sources import windows

REACH_DEG = 8.0
"""How far from the given pose a mount is searched: as far as a knock, not any pose. Beyond that, `coec calibrate` finds
it."""


MAX_SIGMA_DEG = 1.0
"""Above this standard deviation of a rotation, a result is not reported. The limit is looser than for serving, because
a knock is reported with its σ."""


def run(options: Options) -> int:
    """One check at the recording's extrinsic; returns 1 if it is flagged or cannot tell. With `detection`, prints the
    table of detection instead.

    Raises:
        CoecError: no check is possible.
    """
    with console.progress() as bars:
        times = StageTimes(bars)
        of_source = commission_options.Options(
            sources=[options.source], output=Path(), depth=options.depth, frames=options.frames
        )
        rigged = commission.load((options.source,), of_source, times)
        if options.detection > 0:
            return _tabulate(rigged, options, times)
        return _check(rigged, options)


def _tabulate(rigged: commission.Rigged, options: Options, times: StageTimes) -> int:
    window = rigged.windows[0]
    evidence = gather(sight_of(window, rigged.depth, rigged.images, rigged.configuration, times), FAR_RAD)
    tried = try_detection(
        evidence,
        window.T_camera_lidar_start,
        rigged.configuration,
        options.detection,
        options.checks,
        lambda done, total: times.step("splits", done, total),
    )
    report = detection_of(tried, options.detection, len(evidence.pairs))
    if options.output is not None:
        page.write(options.output / "report.html", detection_page(report, options.source, provenance.here()))
    if options.as_json:
        console.print_json({"source": options.source, **report.model_dump(mode="json")})
    else:
        evaluation_tables.show_detection(report)
    return 0


def _check(rigged: commission.Rigged, options: Options) -> int:
    window = rigged.windows[0]
    if options.perturb is not None:
        moved = se3.perturb(window.T_camera_lidar_start, windows.vector_of("--perturb", options.perturb))
        window = replace(window, T_camera_lidar_start=moved)
    baseline = None
    if options.rig is not None:
        if not options.rig.is_file():
            raise UsageError(f"--rig {options.rig}: there is no such file; `coec commission` writes one")
        baseline = load_baseline(options.rig, window.rig.pair)
        if baseline is None:
            raise UsageError(f"{options.rig} holds no baseline of the pair {window.rig.pair}: run `coec commission`")
        against = mismatch(baseline, window.rig, rigged.depth.identity, learned_hash(rigged.configuration))
        if against is not None:
            raise UsageError(f"{options.rig} does not hold for this recording: {against}")
    seen = diagnose(window, rigged.depth, rigged.images, rigged.configuration, baseline)
    # For a commissioned rig, the bias is known for checks only, not for a solve.
    asks = seen.flagged and not seen.causes and baseline is None
    measured = _measured(rigged, window, seen) if asks else None
    if options.output is not None:
        _write(options.output, seen, window, rigged, measured)
    metrics = {metric.name: metric_of(metric) for metric in seen.metrics}
    offset, sigma = _in_degrees(seen.offset), _in_degrees(seen.sigma)
    finding = diagnosis.finding_of(seen, offset, sigma, measured)
    if options.as_json:
        document: dict[str, Any] = {
            "finding": finding.state,
            "text": finding.sentence,
            "flagged": seen.flagged,
            "undecided": seen.undecided,
            "flagged_by_paper": seen.flagged_by_paper,
            "causes": [{"code": cause.code, "text": cause.text} for cause in seen.causes],
            "offset": offset,
            "sigma": sigma,
            "measured": None if measured is None else asdict(measured),
            "drift": None if seen.drift is None else _in_degrees(seen.drift.value),
            "drift_sigma": None if seen.drift is None else _in_degrees(seen.drift.sigma),
            "first_derivative": seen.first_derivative.tolist(),
            "second_derivative": seen.second_derivative.tolist(),
            "metrics": {name: metric.model_dump(mode="json") for name, metric in metrics.items()},
        }
        console.print_json(document)
        return int(finding.state != "right")
    axes = console.table("axis", "offset", "± σ", "unit", "f'", "f''", right=(1, 2, 4, 5))
    for axis, name in enumerate(console.AXIS_NAMES):
        axes.add_row(
            name,
            console.figure(offset[axis], sign=True),
            console.figure(sigma[axis]),
            console.UNITS[axis],
            console.figure(float(seen.first_derivative[axis]), sign=True),
            console.figure(float(seen.second_derivative[axis]), sign=True),
        )
    diagnosis.show(finding)
    console.out.print(axes)
    console.show_metrics({name: metric for name, metric in metrics.items() if metric.value is not None})
    return int(finding.state != "right")


def _measured(rigged: commission.Rigged, window: Window, seen: Observation) -> diagnosis.Measured | None:
    """How far off an accused mount is, by a solve of all pairs within reach of its old pose; None without a result.
    Translations are searched if the check sees one. If not, the camera's centre counts as known only as well as the
    check knows it, because what turned the mount may also have shifted it."""
    shifted = np.abs(seen.offset[3:]) >= diagnosis.TELLING * seen.sigma[3:]
    chosen = {"dof": 6 if shifted.any() else 3, "reach_deg": REACH_DEG}
    search = rigged.configuration.search.model_copy(update=chosen)
    known_m = max(rigged.configuration.verdict.held_translation_sigma_m, float(np.max(seen.sigma[3:])))
    verdict = rigged.configuration.verdict.model_copy(
        update={"held_translation_sigma_m": known_m, "max_sigma_deg": MAX_SIGMA_DEG}
    )
    configuration = rigged.configuration.model_copy(update={"search": search, "verdict": verdict})
    try:
        estimate = calibrate(window, rigged.depth, rigged.images, configuration, Silence())
    except CalibrationError:
        return None
    apart = se3.difference(estimate.optimum.T_camera_lidar, window.T_camera_lidar_start)
    sigma = _in_degrees(estimate.uncertainty.sigma)
    return diagnosis.Measured(
        offset=tuple(_in_degrees(apart)),
        sigma=tuple(value if solved else None for value, solved in zip(sigma, estimate.solved, strict=True)),
        accepted=estimate.verdict.decision is Decision.ACCEPTED,
        reasons=tuple(reason.text for reason in estimate.verdict.reasons),
        pairs=estimate.pairs,
    )


def _write(
    folder: Path, seen: Observation, window: Window, rigged: commission.Rigged, measured: diagnosis.Measured | None
) -> None:
    (seen_at,) = pictures.overlays(window, (window.T_camera_lidar_start,), rigged.configuration.motion_compensation)
    title = f"{window.rig.pair}  the extrinsic that was checked"
    drawn = [pictures.write_overlay(folder, "overlay", seen_at, title)]
    of_check = check_page(
        seen, measured, window, rigged.depth.identity, config_hash(rigged.configuration), drawn, provenance.here()
    )
    page.write(folder / "report.html", of_check)


def _in_degrees(rad_m: Any) -> list[float]:
    values = np.array(rad_m, dtype=np.float64)
    values[:3] = np.degrees(values[:3])
    return [float(value) for value in values]
