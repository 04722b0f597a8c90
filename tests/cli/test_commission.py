"""`coec commission`, `coec diagnose` and `coec paper`, as they are called."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

Coec = Callable[..., Any]

RIG = "sim:seed=1&seconds=16&camera_hz=0.5&lidar_hz=0.5&camera=fisheye320&lidar=32&depth=yes"
"""Eight frames, two seconds apart, with edges enough for a check."""

MOVED = ("--depth", "stereo", "--perturb", "2,-2,1", "--json")


def test_one_check_at_a_right_and_at_a_wrong_extrinsic(coec: Coec, tmp_path: Path) -> None:
    right = coec("diagnose", RIG, "--depth", "stereo", "--json")
    assert right.status == 0
    assert right.document["causes"] == []
    assert right.document["decided_by"] == ["distance_pose", "distance_rotation"]
    assert right.document["flagged_by_paper"] is None
    assert right.document["drift"] is None
    assert [len(right.document[name]) for name in ("first_derivative", "second_derivative")] == [6, 6]
    assert right.document["measured"] is None
    wrong = coec("diagnose", RIG, *MOVED, "--output", tmp_path)
    assert wrong.status == 1
    assert wrong.document["flagged"]
    assert wrong.document["metrics"]["distance_rotation"]["value"] > 1.0
    measured = wrong.document["measured"]
    assert measured["pairs"] == 8
    assert measured["accepted"]
    error = np.subtract(measured["offset"][:3], [-2.0, 2.0, -1.0])
    assert (np.abs(error) < 3.0 * np.array(measured["sigma"][:3])).all()
    page = (tmp_path / "report.html").read_text()
    assert "the camera is not where this extrinsic has it" in page
    assert page.count("data:image/") == 1


@pytest.mark.slow
def test_range_edges_of_eight_small_frames_show_a_displacement_and_not_its_size(coec: Coec) -> None:
    wrong = coec("diagnose", f"{RIG}&intensity=none", *MOVED)
    assert wrong.status == 1
    assert wrong.document["flagged"]
    assert wrong.document["metrics"]["distance_rotation"]["value"] > 1.0
    assert wrong.document["measured"]["pairs"] == 8
    assert not wrong.document["measured"]["accepted"]
    assert wrong.document["measured"]["reasons"]
    assert "±" not in wrong.document["text"]


def test_a_baseline_that_is_not_there(coec: Coec, tmp_path: Path) -> None:
    outcome = coec("diagnose", RIG, "--depth", "stereo", "--rig", tmp_path / "rig.json")
    assert outcome.status == 2
    assert "`coec commission` writes one" in outcome.err


def test_serials_have_a_form(coec: Coec) -> None:
    outcome = coec("commission", RIG, "--depth", "stereo", "--sensor", "radar=7")
    assert outcome.status == 2
    assert "camera=SERIAL" in outcome.err


def test_the_published_experiments(coec: Coec, tmp_path: Path) -> None:
    outcome = coec(
        "paper", RIG, "--depth", "stereo", "--runs", 2, "--samples", 3, "--frames", 6, "--output", tmp_path, "--json"
    )
    assert outcome.status == 0
    assert outcome.document == json.loads((tmp_path / "report.json").read_text())
    assert [row["start_deg"] for row in outcome.document["drive"]] == [5.0, 10.0]
    assert outcome.document["bullseye"]["runs"] == 2
    assert [row["moved_deg"] for row in outcome.document["failure_metrics"]["moves"]] == [0.0, 1.0, 3.0]
    assert [row["frames"] for row in outcome.document["run_times"]] == [5, 8]
    assert all(0 < row["mi_ms"] < row["solve_ms"] for row in outcome.document["run_times"])
    assert outcome.document["published"]["run_times_ms"]["25"] == [21.5, 4222.0]
    for name in ("metrics.png", "bullseye.png", "drive.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/") == 0, "plots are drawn in the page"
    assert page.count('class="disc"') == 2
    assert page.count('class="plot small"') == 3
    assert page.count('class="plot wide"') == 3


@pytest.mark.slow
def test_the_published_experiments_on_every_window_of_a_drive(coec: Coec, tmp_path: Path) -> None:
    options = ("--depth", "stereo", "--runs", 4, "--samples", 3, "--slice-s", 7, "--output", tmp_path)
    outcome = coec("paper", RIG, *options, "--json")
    assert outcome.status == 0
    for row in outcome.document["drive"]:
        assert [window["middle_s"] for window in row["windows"]] == [3.5, 3.5, 10.5, 10.5]
        assert all(len(window["error_deg"]) == 3 for window in row["windows"])
    shown = coec("paper", RIG, *options)
    assert "published" in shown.out
    assert "windows, from 10°" in shown.out
