"""What a person reads of one check: the mount, the data, or that it cannot be told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensor_faults import Cause
from coec.calibration.types import Metric
from coec.io.serialise import metric_of
from coec.reports import console, diagnosis
from coec.reports.page_parts import figures_block

SIGMA = (0.12, 0.12, 0.13, 0.03, 0.03, 0.03)
NOWHERE = (0.02, -0.01, 0.05, 0.0, 0.01, 0.0)
RIGHT = Observation(
    stamp_ns=5,
    pair_stamps_ns=(1, 5),
    metrics=(),
    offset=np.zeros(6),
    sigma=np.ones(6),
    noise=np.ones(6),
    place=np.zeros(6),
    dispersion=1.0,
    distance2=0.1,
    flagged=False,
    weak=False,
    flagged_by_paper=None,
    causes=(),
)


def test_a_mount_that_moved_is_named_by_its_axes_farthest_first() -> None:
    off = (-1.0, 0.4, 0.1, 0.0, -0.2, 0.0)
    result = diagnosis.finding_of(replace(RIGHT, flagged=True), off, SIGMA)
    assert result.state == "moved"
    assert result.sentence == "mount moved: pitch −1.0° ± 0.12°, down −0.20 m ± 0.03 m, yaw +0.4° ± 0.12°"
    assert any("coec calibrate" in comment for comment in result.remarks)
    assert any("camera or the LiDAR" in comment for comment in result.remarks)


def test_where_no_axis_is_beyond_chance_the_farthest_is_named() -> None:
    assert diagnosis.moved_text((0.1, 0.2, 0.0, 0.0, 0.0, 0.0), SIGMA) == "yaw +0.2° ± 0.12°"


def test_wrong_data_accuse_no_mount() -> None:
    cause = Cause("image_frozen", "every picture is the same.", "Look at the camera.")
    result = diagnosis.finding_of(replace(RIGHT, flagged=True, causes=(cause,)), (9.0,) * 6, SIGMA)
    assert result.state == "bad_data"
    assert "mount moved" not in result.sentence
    assert result.remarks[0] == "image_frozen: every picture is the same."


def test_what_cannot_be_determined_is_reported() -> None:
    result = diagnosis.finding_of(replace(RIGHT, undecided=True), (0.5, 0.0, 0.0, 0.0, 0.0, 0.0), SIGMA)
    assert result.state == "unclear"
    assert "cannot tell" in result.sentence
    assert "pitch +0.5°" in result.sentence


def test_a_right_one_says_what_would_not_be_seen(capsys: pytest.CaptureFixture[str]) -> None:
    result = diagnosis.finding_of(replace(RIGHT, weak=True), NOWHERE, SIGMA)
    assert result.state == "right"
    diagnosis.show(result)
    shown = capsys.readouterr().out
    assert "less than 0.39°" in shown
    assert "faint" in shown


def metric(name: str, value: float, limit: float = 1.0, *, at_least: bool = False) -> Metric:
    return Metric(name, value, limit, at_least=at_least)


FIGURES = (
    metric("mi", 0.5, at_least=True),
    metric("distance_rotation", 0.4),
    metric("distance_pose", 0.6),
    metric("edges_kept_rotation", 0.5, at_least=True),
    metric("certainty_pose", 0.2),
    metric("overlap", 2.0, at_least=True),
)


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({}, {"distance_rotation", "distance_pose"}),
        ({"flagged": True}, {"distance_rotation", "distance_pose", "edges_kept_rotation"}),
        ({"weak": True}, {"distance_rotation", "distance_pose", "edges_per_pair"}),
        ({"causes": (Cause("image_frozen", "every picture is the same.", "Look at the camera."),)}, set()),
    ],
)
def test_the_figures_on_which_a_finding_rests(changes: dict[str, Any], names: set[str]) -> None:
    assert diagnosis.deciding(replace(RIGHT, metrics=FIGURES, **changes)) == names


def test_figures_that_did_not_decide_are_visibly_secondary(capsys: pytest.CaptureFixture[str]) -> None:
    replies = {one.name: metric_of(one) for one in FIGURES}
    deciding = diagnosis.deciding(replace(RIGHT, metrics=FIGURES))
    console.show_metrics(replies, deciding)
    marks = {line.split()[0]: line.split()[-1] for line in capsys.readouterr().out.splitlines()}
    assert (marks["distance_pose"], marks["overlap"], marks["mi"]) == ("✓", "(✓)", "(✗)")
    lines = figures_block("", replies, deciding=deciding).lines
    assert [line.code for line in lines[:2]] == ["distance_rotation", "distance_pose"]
    assert not any(line.decided or line.advice for line in lines[2:])


MEASURED = diagnosis.SolvedOffset(
    (-1.02, 0.01, 0.02, 0.0, 0.0, 0.0), (0.05, 0.04, 0.06, None, None, None), accepted=True, reasons=(), pairs=25
)
OFF = (-0.7, 0.0, 0.1, 0.0, 0.0, 0.0)


def test_what_a_solve_has_measured_comes_before_the_nearest_place_that_a_check_finds() -> None:
    result = diagnosis.finding_of(replace(RIGHT, flagged=True), OFF, SIGMA, MEASURED)
    assert result.sentence == "mount moved: pitch −1.02° ± 0.05°"
    assert any("all 25 pairs" in comment for comment in result.remarks)
    assert any("Only turns were searched" in comment for comment in result.remarks)
    shifted = replace(MEASURED, sigma=(0.05, 0.04, 0.06, 0.01, 0.01, 0.01))
    result = diagnosis.finding_of(replace(RIGHT, flagged=True), OFF, SIGMA, shifted)
    assert not any("Only turns" in comment for comment in result.remarks)
    assert not any("nearest place" in comment for comment in result.remarks)


def test_of_a_mount_whose_solve_is_refused_no_sigma_is_claimed() -> None:
    refused = replace(MEASURED, accepted=False, reasons=("The runner-up is as good",))
    result = diagnosis.finding_of(replace(RIGHT, flagged=True), OFF, SIGMA, refused)
    assert result.state == "moved"
    assert result.sentence.endswith("the nearest place at which the edges fit is pitch −0.7°")
    assert "±" not in result.sentence
    assert any("The runner-up is as good" in comment for comment in result.remarks)
