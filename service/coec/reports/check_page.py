"""The page of `coec diagnose`: one check of an extrinsic, or how well wrong ones are detected."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coec.adapters.files.conversions import metric_of
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.types import Reason as Found
from coec.calibration.types import Window
from coec.reports.diagnosis import SolvedOffset
from coec.reports.evaluation_documents import in_degrees
from coec.reports.evaluation_page import detection_table
from coec.reports.instants import second
from coec.reports.page import Page, Pictures, Section, Text, VerdictBanner
from coec.reports.page.words import NONE, count, number
from coec.reports.page_parts import advice_of, axes_table, axis_value, figures_block, file_picture, turn_and_shift
from coec.reports.provenance import Provenance, content_hash, depth_items
from coec.schemas.evaluation import DetectionReport
from coec.schemas.replies import Reason

OF_PAPER = frozenset({"mi", "f1", "f2"})
"""Figures that are shown for comparison and decide nothing."""


def check_page(
    seen: Observation,
    measured: SolvedOffset | None,
    window: Window,
    depth_identity: str,
    config_hash: str,
    pictures: Sequence[Path],
    made: Provenance,
) -> Page:
    """The page of one check.

    Args:
        measured: by a solve of all pairs; None: there was none.
        window: its `T_camera_lidar_start` was checked.
        pictures: files that show the check.

    Raises:
        OutputError: a picture can no longer be read.
    """
    offset, sigma = in_degrees(seen.offset), in_degrees(seen.sigma)
    slopes = {
        "f′": [number(float(value), sign=True) for value in seen.first_derivative],
        "f″": [number(float(value), sign=True) for value in seen.second_derivative],
    }
    table = axes_table(
        "From the extrinsic to where this check puts the camera, about and along its axes (x right, y down, z "
        "forward). f′ and f″ are the paper’s derivatives of mutual information, per radian or metre.",
        "Offset",
        offset,
        sigma,
        more=slopes if measured is None else {"By a solve of all pairs": _by_axis(measured), **slopes},
    )
    shown = tuple(file_picture(path) for path in pictures)
    sections = (
        *((Section("Pictures", (Pictures(shown),)),) if shown else ()),
        Section("Where the check puts the camera", (table,)),
        Section(
            "What it rests on",
            (
                Text(
                    ("One check is a look, not a verdict for good: the service adds many of them up before it raises "
                     "an alarm.",),
                    quiet=True,
                ),
                figures_block("Figures of the check", {m.name: metric_of(m) for m in seen.metrics}, compared=OF_PAPER),
            ),
        ),
        made.section(
            (
                ("Window", window.window_id),
                ("Sensor time", f"{second(seen.pair_stamps_ns[0])} to {second(seen.stamp_ns)}"),
                ("Window, sha256 of images, points and stamps", content_hash(window)),
                *depth_items(depth_identity),
                ("Configuration, hash", config_hash),
            )
        ),
    )  # fmt: skip
    return Page("coec diagnose", f"Check of {window.rig.pair}", (_verdict(seen, measured),), sections)


def detection_page(detection: DetectionReport, source: str, made: Provenance) -> Page:
    """How well wrong extrinsics are detected on a recording."""
    checks = sum(row.checks for row in detection.moves)
    sentence = f"{count(checks, 'check')} at the right extrinsic and at moved ones; see which of them are flagged."
    sections = (
        Section("Checks by move", (detection_table(detection),)),
        made.section((("Source", source),)),
    )
    return Page(
        "coec diagnose", "How well a wrong extrinsic is seen", (VerdictBanner("none", "Tried.", sentence),), sections
    )


def _by_axis(measured: SolvedOffset) -> list[str]:
    return [
        NONE if sigma is None else f"{axis_value(value, axis)} ± {axis_value(sigma, axis, sign=False)}"
        for axis, (value, sigma) in enumerate(zip(measured.offset, measured.sigma, strict=True))
    ]


def _verdict(seen: Observation, measured: SolvedOffset | None) -> VerdictBanner:
    if seen.causes:
        reasons = [_reason(cause.as_reason()) for cause in seen.causes]
        sentence = " ".join(cause.text for cause in seen.causes) + " Such a check says nothing of the extrinsic."
        return VerdictBanner("poor", "Cannot tell:", sentence, advice_of(reasons))
    if seen.flagged:
        todo = (
            "See that the mount is tight.",
            "Calibrate: `coec calibrate` on a window of this mount tells where the camera is.",
        )
        return VerdictBanner(
            "bad", "Wrong:", f"the camera is not where this extrinsic has it. {_where(seen, measured)}", todo
        )
    if seen.undecided:
        again = ("Take another window, in motion, past objects at different distances.",)
        return VerdictBanner("unsure", "Undecided:", "this window neither accuses the extrinsic nor acquits it.", again)
    return VerdictBanner("good", "Right.", "The edges fit this extrinsic as well as a right one.")


def _where(seen: Observation, measured: SolvedOffset | None) -> str:
    """How far the extrinsic is off, by the solve if it can tell, else by the check."""
    near = f"The nearest place at which the edges fit is {turn_and_shift(in_degrees(np.nan_to_num(seen.offset)))}"
    if measured is None:
        return f"{near}."
    if not measured.accepted:
        return f"{near}; a solve of all {measured.pairs} pairs is refused, so how far it is off is not sure."
    solved = [0.0 if s is None else value for value, s in zip(measured.offset, measured.sigma, strict=True)]
    return f"A solve of all {measured.pairs} pairs puts it {turn_and_shift(solved)} from there."


def _reason(reason: Found) -> Reason:
    return Reason(code=reason.code, text=reason.text)
