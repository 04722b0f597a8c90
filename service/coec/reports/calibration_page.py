"""The page of `coec calibrate`: one recording, one result, and whether it may be used."""

from __future__ import annotations

from collections.abc import Sequence

from coec.calibration.types import Window
from coec.reports.instants import second
from coec.reports.page import AxesTable, Block, Facts, Page, Section, Text, VerdictBanner
from coec.reports.page.words import count, number, percent, significant, size
from coec.reports.page_parts import (
    advice_of,
    axes_table,
    axis_value,
    copies_of,
    figures_block,
    turn_and_shift,
)
from coec.reports.provenance import Provenance, content_hash, depth_items
from coec.schemas.replies import CalibrationReport, CalibrationResult, Vector6

USE = (
    "Copy the matrix below into your stack, or have `coec export` write the file that it reads.",
    "Look at the pictures: points should end where things end.",
)
"""What to do with an accepted result."""


def calibration_page(
    report: CalibrationReport,
    window: Window,
    start: Vector6,
    pictures: Sequence[Block],
    remarks: Sequence[str],
    made: Provenance,
) -> Page:
    """The page of a result.

    Args:
        start: of the search, relative to the recording's own calibration: rx ry rz (deg), tx ty tz (m).
        pictures: of the result.
        remarks: what else was found out, one sentence each.
    """
    sections = (
        Section("Result", (_axes(report, start), *(Text((each,)) for each in remarks))),
        Section("To copy", (copies_of(report.camera_from_lidar, report.camera_frame, report.lidar_frame),)),
        *((Section("Pictures", tuple(pictures)),) if pictures else ()),
        Section(
            "Why it was " + ("accepted" if _accepted(report) else "refused"),
            (
                Text(
                    ("A result is accepted if every figure keeps its limit. None of them knows the truth.",), quiet=True
                ),
                figures_block("Figures of self-diagnosis", report.metrics),
            ),
        ),
        Section("How it was found", (_search(report),)),
        made.section(_origin(report, window)),
    )
    verdict = _verdict(report)
    return Page("coec calibrate", f"Calibration of {report.vehicle} / {report.pair}", (verdict,), sections)


def _accepted(result: CalibrationResult) -> bool:
    return result.verdict.decision == "accepted"


def _verdict(report: CalibrationReport) -> VerdictBanner:
    if not _accepted(report):
        first = report.verdict.reasons[0].text if report.verdict.reasons else "no reason was given"
        more = len(report.verdict.reasons) - 1
        rest = f" (and {count(more, 'reason')} more, below)" if more > 0 else ""
        advice = advice_of(report.verdict.reasons) or ("Take another window.",)
        return VerdictBanner("bad", "Refused:", f"{first}{rest}. Do not use this result.", advice)
    return VerdictBanner("good", "Accepted.", f"The camera is {turn_and_shift(_solved(report))} from the recording’s own "
                   f"calibration{_known_to(report)}.", USE)  # fmt: skip


def _solved(report: CalibrationResult) -> list[float]:
    return [value if solved else 0.0 for value, solved in zip(report.correction, report.solved, strict=True)]


def _known_to(report: CalibrationResult) -> str:
    turn, shift = size(report.sigma[:3]), size(report.sigma[3:])
    if turn is None:
        return ""
    return (
        f", known to {number(turn, 2)}°" + ("" if shift is None else f" and {number(100.0 * shift, 1)} cm") + " (1 σ)"
    )


def _axes(report: CalibrationReport, start: Vector6) -> AxesTable:
    unsolved_labels = {
        axis: "not observable" if report.unobservable[axis] else "not searched"
        for axis, solved in enumerate(report.solved)
        if not solved
    }
    return axes_table(
        "Correction of the recording’s own calibration about and along the camera’s axes (x right, y down, z forward). "
        "“Not observable”: searched, but this window does not tell it, so it is kept as it was.",
        "Correction",
        report.correction,
        report.sigma,
        unsolved_labels,
        {"Search began at": [axis_value(value, axis) for axis, value in enumerate(start)]},
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
        ("Worth so many independent looks", significant(report.independent_looks)),
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
        ("Window, sha256 of images, points and stamps", content_hash(window)),
        *depth_items(report.depth_identity),
        ("Configuration, hash", report.config_hash),
    )
