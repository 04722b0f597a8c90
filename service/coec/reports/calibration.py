"""The result of `coec calibrate`: on the console, and as a page."""

from collections.abc import Mapping, Sequence
from math import isinf
from pathlib import Path
from typing import Any, cast

import numpy as np

from coec.calibration.types import Compensation, Window
from coec.config import CalibrationConfig
from coec.geometry import se3
from coec.geometry.points import distinct_rings
from coec.io.depth.depth_maps import STEREO
from coec.io.exported_extrinsic import REFUSED
from coec.reports import console, lens_report, page_parts
from coec.reports.formatting import count, number, percent, second, significant, size
from coec.reports.page import AxesTable, Block, Facts, Page, Section, Table, Text, VerdictBanner
from coec.schemas.replies import CalibrationReport, CalibrationResult, Cue, Transform, Vector6

DIGITS = 9
"""Decimal places of a matrix and a quaternion to copy: a rotation is then exact to 1e-9 rad, far below any σ. `--json`
and `result.json` have all digits."""

HASH_DIGITS = 12
"""Digits of a network's hash, as in `coec models`."""

NOT_COMPENSATED: Mapping[Compensation, str] = {
    Compensation.NO_EGO_MOTION: "no ego motion in the source",
    Compensation.NO_POINT_TIME: "the points carry no time, and the LiDAR's sweep is not described",
    Compensation.DISABLED: "switched off",
}


def show(
    window: Window,
    result: CalibrationResult,
    configuration: CalibrationConfig,
    document: Mapping[str, Any],
    *,
    intrinsics: bool = False,
) -> None:
    """Prints the result of a window, which was calibrated with this configuration; `document` is what `--json` prints,
    `intrinsics` says whether the lens is shown, too."""
    console.show(f"{window.window_id}: {count(result.pairs, 'pair')}, {result.points_in_view} points in view")
    _show_axes(window, result)
    refused = not _accepted(result)
    console.show_verdict(result, document["mistake"]["text"] if refused and document["mistake"] is not None else "")
    if refused:
        console.show("what follows was not accepted: it is the best guess, and not to be used on a vehicle", "yellow")
    show_pose(
        result.camera_from_lidar, result.lidar_frame, result.camera_frame, warning="" if _accepted(result) else REFUSED
    )
    if intrinsics:
        lens_report.show(result.lens, result.intrinsics)
    console.show(settings_text(configuration, result.depth_identity))
    console.show(compensation_text(result.compensation))
    if any(pair.lidar.ring is not None and distinct_rings(pair.lidar.ring) is None for pair in window.pairs):
        console.show(
            "the field `ring` holds one number and was ignored: beams were told apart by their elevation", "yellow"
        )
    for note in remarks(document):
        console.show(note)
    if result.independent_looks is not None and result.pairs > 1:
        console.show(
            f"{result.pairs} pairs are worth {result.independent_looks:.1f} independent samples{_together(result)}"
        )
    if result.cues is not None:
        console.show(_cues_text(result.cues))
    stages = "  ".join(f"{stage} {seconds:.2f} s" for stage, seconds in document["elapsed_s"].items())
    console.show(f"{result.evaluations} evaluations, {result.stop_reason}; {stages}")


def remarks(document: Mapping[str, Any]) -> list[str]:
    """What else was found out beside a mistake in the inputs, one sentence each, from what `--json` prints."""
    sentences = [str(one["text"]) for one in document["recognitions"]]
    if (weighed := document["weighed"]) is not None:
        sentences.append(
            f"without a start, {weighed['rotations']} rotations were weighed: {weighed['ascended']} maxima climbed, "
            f"{count(weighed['ranked'], 'basin')} ranked by edges and depth, {weighed['solved']} solved"
        )
    if (camera_fit := document.get("camera_fit")) is not None:
        sentences.append(
            f"{camera_fit['model']} fitted to {camera_fit['of']}: {camera_fit['residual_rms_px']:.4f} px rms, "
            f"{camera_fit['residual_max_px']:.4f} px at most"
        )
    if (time_offset := document.get("time_offset")) is not None:
        sentences.append(f"camera after its stamp: {_offset_text(time_offset)}")
    return sentences


def start_of(window: Window) -> Vector6 | None:
    """Start of a window's search, relative to the recording's own calibration: rx ry rz (deg), tx ty tz (m); None
    without a start."""
    if isinf(window.start_known_to_rad):
        return None
    start = se3.difference(window.T_camera_lidar_start, window.rig.T_camera_lidar_nominal)
    start[:3] = np.degrees(start[:3])
    return cast("Vector6", tuple(float(value) for value in start))


def show_pose(camera_from_lidar: Transform, lidar_frame: str, camera_frame: str, *, warning: str = "") -> None:
    """Prints the pose in a form to copy: a matrix that Python, YAML and JSON read as it stands. A `warning` stands
    above each form."""
    if warning:
        console.show(warning, "bold red")
    console.show(f"T_camera_lidar: p_camera = T · p_lidar, from frame {lidar_frame} to frame {camera_frame}, metres:")
    rows = [f"[{', '.join(f'{value + 0.0:.{DIGITS}f}' for value in row)}]" for row in camera_from_lidar.matrix]
    for before, row, after in zip(("[", " ", " ", " "), rows, (",", ",", ",", "]"), strict=True):
        console.show(f"  {before}{row}{after}")
    if warning:
        console.show(warning, "bold red")
    console.show(f"translation x y z, m: {_numbers(camera_from_lidar.translation_m)}")
    console.show(f"quaternion x y z w: {_numbers(camera_from_lidar.quaternion_xyzw)}")


def show_written(folder: Path, written: Sequence[Path], left_out: Sequence[str] = ()) -> None:
    """Prints which files a command wrote and where, and what it left out, one sentence each."""
    console.show(f"written to {folder}: {', '.join(sorted(str(path.relative_to(folder)) for path in written))}")
    for sentence in left_out:
        console.show(sentence)


def settings_text(configuration: CalibrationConfig, depth_identity: str) -> str:
    """What was maximised over which axes, and where depth came from."""
    searched = "6 degrees of freedom" if configuration.search.dof == 6 else "3 degrees of freedom (rotation only)"
    model = configuration.depth.model
    # Maps that came with the frames have no hash.
    network = model if model == STEREO else f"{Path(model).name} (sha256 {depth_identity[:HASH_DIGITS]})"
    return f"objective {configuration.objective.kind}, {searched}, depth from {network}"


def compensation_text(pairs_by_outcome: Mapping[str, int]) -> str:
    """What became of motion compensation, from the number of pairs of each outcome (`Compensation`)."""
    total = sum(pairs_by_outcome.values())
    compensated = pairs_by_outcome.get(Compensation.DONE, 0)
    turned = pairs_by_outcome.get(Compensation.ROTATION_ONLY, 0)
    why = [
        (f"{some} of {total} pairs: " if some < total else "") + reason
        for outcome, reason in NOT_COMPENSATED.items()
        if (some := pairs_by_outcome.get(outcome, 0))
    ]
    if not why:
        return "motion-compensated" + (", turns only: the source tells no speed" if turned and not compensated else "")
    return f"not motion-compensated: {'; '.join(why)}"


def _show_axes(window: Window, result: CalibrationResult) -> None:
    start = start_of(window)
    axes = console.table("axis", "start", "correction", "± σ", "unit", right=(1, 2, 3))
    for axis, name in enumerate(console.AXIS_NAMES):
        unsolved = "not observable" if result.unobservable[axis] else "not searched"
        correction = console.figure(result.correction[axis], sign=True) if result.solved[axis] else unsolved
        spread = console.figure(result.sigma[axis]) if result.solved[axis] else ""
        began = "none" if start is None else console.figure(start[axis], sign=True)
        axes.add_row(name, began, correction, spread, console.UNITS[axis])
    console.out.print(axes)


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value + 0.0:.{DIGITS}f}' for value in values)}]"


def _together(result: CalibrationResult) -> str:
    """How the errors of turns and shifts correlate, where both were solved."""
    pairs = {"pitch and height": result.correlation_pitch_height, "yaw and side": result.correlation_yaw_side}
    correlations = ", ".join(f"{names} {value:+.2f}" for names, value in pairs.items() if value is not None)
    return f"; correlation of errors: {correlations}" if correlations else ""


REFLECTANCE_EDGES = "reflectance_edges"
NO_REFLECTANCE = "no reflectance edges: the sweeps carry no intensity, a constant one, or one without steps"


def _cues_text(cues: Mapping[str, Cue]) -> str:
    """Which cues the result rests on, and why one is missing."""
    present = ", ".join(f"{name.replace('_', ' ')} {significant(cue.significance)} σ" for name, cue in cues.items())
    return f"cues, each by itself: {present}" + ("" if REFLECTANCE_EDGES in cues else f"; {NO_REFLECTANCE}")


def _cues_table(cues: Mapping[str, Cue]) -> Table:
    caption = (
        "What each cue contributed: its significance by itself, the weight of its samples, and its share of the "
        "curvature of the objective along each axis."
    )
    rows = tuple(
        (
            name.replace("_", " "),
            str(cue.samples),
            f"{significant(cue.significance)} σ",
            number(cue.weight, 2),
            *("–" if share is None else percent(share) for share in cue.share),
        )
        for name, cue in cues.items()
    )
    return Table(
        caption if REFLECTANCE_EDGES in cues else f"{caption} There are {NO_REFLECTANCE}.",
        ("cue", "samples", "significance", "weight", *console.AXIS_NAMES),
        rows,
        numbers=frozenset(range(1, 10)),
    )


def _offset_text(offset: Mapping[str, Any]) -> str:
    offset_s, sigma_s = offset["offset_s"], offset["sigma_s"]
    fitted = f"{1e3 * offset_s:+.1f} ± {1e3 * sigma_s:.1f} ms" if None not in (offset_s, sigma_s) else ""
    if offset["observable"]:
        return f"{fitted}, {offset['reason']}"
    return f"not observable, {offset['reason']}" + (f"; the best fit is {fitted}" if fitted else "")


USE = (
    "Copy the matrix below into your stack, or have `coec export` write the file that it reads.",
    "Look at the pictures: points should end where things end.",
)
"""What to do with an accepted result."""


def calibration_page(
    report: CalibrationReport,
    window: Window,
    start: Vector6 | None,
    pictures: Sequence[Block],
    remarks: Sequence[str],
    made: page_parts.Provenance,
    *,
    intrinsics: bool = False,
) -> Page:
    """The page of a result.

    Args:
        start: of the search, relative to the recording's own calibration: rx ry rz (deg), tx ty tz (m); None without.
        pictures: of the result.
        remarks: what else was found out, one sentence each.
        intrinsics: whether the lens has a section.
    """
    sections = (
        Section("Result", (_axes(report, start), *(Text((each,)) for each in remarks))),
        _copies(report),
        *((lens_report.section(report.lens, report.intrinsics),) if intrinsics else ()),
        *((Section("Pictures", tuple(pictures)),) if pictures else ()),
        Section(
            "Why it was " + ("accepted" if _accepted(report) else "refused"),
            (
                Text(
                    ("A result is accepted if every figure keeps its limit. None of them knows the truth.",), quiet=True
                ),
                page_parts.figures_block("Figures of self-diagnosis", report.metrics),
            ),
        ),
        Section("How it was found", (_search(report), *((_cues_table(report.cues),) if report.cues else ()))),
        made.section(_origin(report, window)),
    )
    verdict = _verdict(report)
    return Page("coec calibrate", f"Calibration of {report.vehicle} / {report.pair}", (verdict,), sections)


def _copies(report: CalibrationReport) -> Section:
    pose = report.camera_from_lidar, report.camera_frame, report.lidar_frame
    if _accepted(report):
        return Section("To copy", (page_parts.copies_of(*pose),))
    sentence = f"{REFUSED}: this is the best guess of a refused result. What is copied says so in its first line."
    return Section("The refused estimate", (Text((sentence,)), page_parts.copies_of(*pose, warning=REFUSED)))


def _accepted(result: CalibrationResult) -> bool:
    return result.verdict.decision == "accepted"


def _verdict(report: CalibrationReport) -> VerdictBanner:
    if not _accepted(report):
        first = report.verdict.reasons[0].text if report.verdict.reasons else "no reason was given"
        more = len(report.verdict.reasons) - 1
        rest = f" (and {count(more, 'reason')} more, below)" if more > 0 else ""
        advice = page_parts.advice_of(report.verdict.reasons) or ("Take another window.",)
        return VerdictBanner("bad", "Refused:", f"{first}{rest}. Do not use this result.", advice)
    moved = page_parts.turn_and_shift(_solved(report))
    sentence = f"The camera is {moved} from the recording’s own calibration{_known_to(report)}."
    return VerdictBanner("good", "Accepted.", sentence, USE)


def _solved(report: CalibrationResult) -> list[float]:
    return [value if solved else 0.0 for value, solved in zip(report.correction, report.solved, strict=True)]


def _known_to(report: CalibrationResult) -> str:
    turn, shift = size(report.sigma[:3]), size(report.sigma[3:])
    if turn is None:
        return ""
    return (
        f", known to {number(turn, 2)}°" + ("" if shift is None else f" and {number(100.0 * shift, 1)} cm") + " (1 σ)"
    )


def _axes(report: CalibrationReport, start: Vector6 | None) -> AxesTable:
    unsolved_labels = {
        axis: "not observable" if report.unobservable[axis] else "not searched"
        for axis, solved in enumerate(report.solved)
        if not solved
    }
    return page_parts.axes_table(
        "Correction of the recording’s own calibration about and along the camera’s axes (x right, y down, z forward). "
        "“Not observable”: searched, but this window does not tell it, so it is kept as it was.",
        "Correction",
        report.correction,
        report.sigma,
        unsolved_labels,
        {} if start is None else {"Search began at": [page_parts.axis_value(v, axis) for axis, v in enumerate(start)]},
    )


def _search(report: CalibrationReport) -> Facts:
    together = {
        "Correlation of errors, pitch and height": report.correlation_pitch_height,
        "Correlation of errors, yaw and side": report.correlation_yaw_side,
    }
    compensation = ", ".join(
        f"{outcome.replace('_', ' ')} {pairs}" for outcome, pairs in report.compensation.items() if pairs
    )
    rows = (
        ("Pairs of image and sweep", str(report.pairs)),
        ("Worth so many independent samples", significant(report.independent_looks)),
        ("Points in view", significant(float(report.points_in_view), 9)),
        ("Overlap", percent(report.overlap)),
        ("Motion compensation, pairs", compensation or "–"),
        ("Objective, start → result", f"{significant(report.score_at_start, 4)} → {significant(report.score, 4)}"),
        ("Mutual information, nats", number(report.mi)),
        *((name, number(value, 2, sign=True)) for name, value in together.items() if value is not None),
        ("Evaluations", str(report.evaluations)),
        ("The search ended as", report.stop_reason.replace("_", " ")),
        *((f"Time, {stage}", f"{number(seconds, 2)} s") for stage, seconds in report.elapsed_s.items()),
    )
    return Facts(rows)


def _origin(report: CalibrationReport, window: Window) -> tuple[tuple[str, str], ...]:
    first, last = window.pairs[0].stamp_ns, window.pairs[-1].stamp_ns
    return (
        ("Window", report.window_id),
        ("Sensor time", f"{second(first)} to {second(last)}"),
        ("Window, sha256 of images, points and stamps", page_parts.content_hash(window)),
        *page_parts.intrinsics_items(report.intrinsics),
        *page_parts.depth_items(report.depth_identity),
        ("Configuration, hash", report.config_hash),
    )
