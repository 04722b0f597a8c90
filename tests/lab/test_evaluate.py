"""`coec evaluate` on a small simulated drive."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cli.conftest import SMALL, Coec
from coec.calibration import commissioning
from coec.calibration.types import LidarFrame
from coec.geometry import se3
from coec.io.recordings.recording_source import FramewiseRecording
from coec_lab.experiments import evaluation_pictures, mount_steps, plots, solve_experiments
from coec_lab.experiments.evaluation_pictures import EvaluationBlocks
from coec_lab.experiments.evaluation_schema import ClosureReport, ComparisonReport, EvaluationReport
from coec_lab.experiments.solve_experiments import perturbations
from coec_lab.experiments.solve_statistics import SolveOutcome
from support.simulated_drives import rendered_drive

CONTRACT = {
    "starts", "hits", "hit_rate", "rotation_deg", "translation_m", "bias", "std", "solve_s", "classified_correctly",
}  # fmt: skip


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody looks at them."""
    monkeypatch.setattr(plots, "DPI", 20)


@pytest.fixture
def without_pictures_of_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `test_output_folder_holds_table_report_and_pictures` has them."""
    monkeypatch.setattr(evaluation_pictures, "write", lambda *_: EvaluationBlocks((), ()))


def without_intensity(recording: FramewiseRecording) -> FramewiseRecording:
    """The recording of a LiDAR that tells no reflectance."""

    def bare(load: Callable[[], LidarFrame]) -> LidarFrame:
        return replace(load(), intensity=None)

    frames = tuple(replace(frame, load_lidar=partial(bare, frame.load_lidar)) for frame in recording.frames)
    return replace(recording, frames=frames)


def test_report_has_the_figures_of_the_contract(coec: Coec) -> None:
    outcome = coec(
        "evaluate",
        SMALL,
        "--depth",
        "stereo",
        "--rotation-deg",
        "3",
        "--directions",
        "6",
        "--objective",
        "mi",
        "--json",
    )
    report = outcome.document
    assert outcome.status == 0
    assert set(report) >= CONTRACT
    assert EvaluationReport.model_validate(report).model_dump(mode="json") == report
    assert report["starts"] == sum(report["verdicts"].values()) == sum(report["stop_reasons"].values()) == 6
    assert report["hits"] == 6
    assert report["hit_rate"] == 1.0
    assert 0 < report["rotation_deg"]["median"] <= report["rotation_deg"]["p95"] <= report["rotation_deg"]["max"] < 0.5
    assert report["translation_m"]["max"] == pytest.approx(0.0, abs=1e-9)
    assert report["hit_translation_m"] is None
    assert max(map(abs, report["bias"])) < 0.5
    assert report["frames"] == report["slices"] == []
    assert report["halves"] is None


def test_starts_that_cannot_be_solved_are_counted_and_the_exit_is_0(coec: Coec) -> None:
    report = coec(
        "evaluate",
        SMALL,
        "--depth",
        "stereo",
        "--objective",
        "mi",
        "--rotation-deg",
        "40",
        "--directions",
        "4",
        "--json",
    ).document
    assert report["starts"] == 4
    assert report["hits"] < 4
    assert report["rotation_deg"]["max"] > 0.5
    assert report["search_rotation_deg"] == 45.0


def test_output_folder_holds_table_report_and_pictures(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solve_experiments, "SUBSETS", 2)
    outcome = coec(
        "evaluate", SMALL, "--depth", "stereo", "--rotation-deg", "2", "--translation-m", "0.1", "--directions", "3",
        "--dof", "3", "--objective", "mi", "--frames", "2", "--against-frames", "--against-slice",
        "--output", tmp_path / "out", "--json",
    )  # fmt: skip
    written = tmp_path / "out"
    assert json.loads((written / "report.json").read_text()) == outcome.document
    for name in ("bullseye", "profiles", "frames", "slices", "overlay_before", "overlay_after", "close_ups"):
        assert (written / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert [point["frames"] for point in outcome.document["frames"]] == [1, 2]
    page = (written / "report.html").read_text()
    pictures = sum((written / f"{name}.png").is_file() for name in ("close_ups", "residuals"))
    assert page.count("data:image/") == 2 + pictures
    assert page.count('class="disc"') == 3, "of turns, of shifts, and the target"
    assert "How many frames it takes" in page

    rows = list(csv.DictReader((written / "starts.csv").read_text().splitlines()))
    expected = perturbations(3, np.radians(2.0), 0.1)
    for row, xi in zip(rows, expected, strict=True):
        assert np.radians(float(row["start_ry_deg"])) == pytest.approx(xi[1], abs=1e-9)
        assert float(row["start_tz_m"]) == pytest.approx(xi[5], abs=1e-9)
    errors = [float(row["rotation_deg"]) for row in rows]
    assert max(errors) == outcome.document["rotation_deg"]["max"]
    assert sum(int(row["hit"]) for row in rows) == outcome.document["hits"]


@pytest.mark.usefixtures("without_pictures_of_starts")
def test_methods_side_by_side(coec: Coec, tmp_path: Path) -> None:
    arguments = (
        "evaluate", SMALL, "--depth", "stereo", "--rotation-deg", "2", "--directions", "1", "--frames", "2",
        "--objective", "all",
    )  # fmt: skip
    outcome = coec(*arguments, "--output", tmp_path / "out", "--json")
    report = outcome.document
    assert outcome.status == 0
    assert ComparisonReport.model_validate(report).model_dump(mode="json") == report
    assert set(report["methods"]) == {"fused", "mi", "intensity"}
    assert report["not_evaluated"] == {}
    for name, method in report["methods"].items():
        assert method["objective"] == name
        assert set(method) >= CONTRACT
        assert json.loads((tmp_path / "out" / name / "report.json").read_text()) == method
        assert (tmp_path / "out" / name / "report.html").is_file()
        assert f'href="{name}/report.html"' in (tmp_path / "out" / "report.html").read_text()
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == report
    assert (tmp_path / "out" / "bullseye.png").read_bytes().startswith(b"\x89PNG")


def test_methods_side_by_side_as_text(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coec_lab.simulation.source.open_sim", lambda query: without_intensity(rendered_drive(query)))
    outcome = coec(
        "evaluate", SMALL, "--depth", "stereo", "--rotation-deg", "2", "--directions", "1", "--frames", "2",
        "--objective", "all",
    )  # fmt: skip
    header = next(line for line in outcome.out.splitlines() if "fused" in line)
    assert header.split() == ["fused", "mi", "Unit"]
    assert "intensity was not evaluated: " in outcome.out
    assert not outcome.err


def test_slices_and_halves(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solve_experiments, "SUBSETS", 4)
    report = coec(
        "evaluate", SMALL, "--depth", "stereo", "--rotation-deg", "2", "--directions", "2", "--objective", "mi",
        "--against-slice", "--halves", "3", "--json",
    ).document  # fmt: skip
    slices = report["slices"]
    lengths_s = [point["length_s"] for point in slices]
    assert lengths_s == pytest.approx([10.0 / 16, 10.0 / 8, 10.0 / 4, 10.0 / 2, 10.0])
    assert all(point["solves"] == 4 for point in slices)
    assert [point["pairs"] for point in slices] == [1, 1, 1.5, 3, 6]
    assert slices[-1]["slices"] == 1
    assert slices[-1]["hit_rate"] == 1.0
    halves = report["halves"]
    assert (halves["splits"], halves["pairs"], halves["solved"]) == (3, 3, 3)
    assert all(0 < difference < 0.5 for difference in halves["rms"][:3])
    assert halves["rms"][3:] == [None] * 3


def test_six_degrees_of_freedom_are_searched_and_judged(coec: Coec) -> None:
    report = coec(
        "evaluate", SMALL, "--depth", "stereo", "--rotation-deg", "1", "--translation-m", "0.3", "--directions", "2",
        "--frames", "2", "--objective", "mi", "--json",
    ).document  # fmt: skip
    assert report["dof"] == 6
    assert report["search_translation_m"] == 0.5
    assert report["hit_translation_m"] == 0.2
    assert 0 < report["translation_m"]["max"] < 0.7


def test_equal_evaluations_are_equal_but_for_the_time(coec: Coec) -> None:
    arguments = (
        "evaluate", SMALL, "--depth", "stereo", "--objective", "mi", "--rotation-deg", "4",
        "--directions", "2", "--json",
    )  # fmt: skip
    first, second = coec(*arguments).document, coec(*arguments).document
    for report in (first, second):
        report.pop("elapsed_s")
        report.pop("solve_s")
    assert first == second


def test_text_separates_bias_from_noise_and_counts_verdicts(coec: Coec) -> None:
    outcome = coec(
        "evaluate", SMALL, "--depth", "stereo", "--objective", "mi", "--rotation-deg", "3", "--directions", "3",
        "--halves", "1",
    )  # fmt: skip
    assert "1 split into halves of 3 frames:" in outcome.out
    assert "3 of 3 starts 3° away end within 0.5° of the source’s calibration (100.0 %)" in outcome.out
    assert "100.0 % of the verdicts are right" in outcome.out
    assert "Std of hits" in outcome.out
    assert "Starts by verdict and by truth" in outcome.out
    assert not outcome.err


def test_fitted_camera_and_uncompensated_clouds(coec: Coec) -> None:
    report = coec(
        "evaluate", SMALL, "--depth", "stereo", "--rotation-deg", "2", "--directions", "1",
        "--objective", "mi", "--camera-model", "double_sphere", "--no-motion-compensation", "--json",
    ).document  # fmt: skip
    assert report["camera_model"] == "double_sphere"
    assert report["std"] == [None] * 6


def test_what_was_finished_before_ctrl_c_is_printed_and_written(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve, solved = solve_experiments.Bench.solve, count()

    def interrupted(self: solve_experiments.Bench, *arguments: Any) -> SolveOutcome:
        if next(solved) == 3:  # of the reference, and two starts
            raise KeyboardInterrupt
        return solve(self, *arguments)

    monkeypatch.setattr(solve_experiments.Bench, "solve", interrupted)
    options = ("--depth", "stereo", "--objective", "mi", "--rotation-deg", "1", "--directions", "50")
    outcome = coec("evaluate", SMALL, *options, "--halves", "2", "--output", tmp_path, "--json")
    assert outcome.status == 130
    assert outcome.document["interrupted"]
    assert outcome.document["starts"] == 2
    assert outcome.document["halves"] is None
    assert json.loads((tmp_path / "report.json").read_text()) == outcome.document
    with (tmp_path / "starts.csv").open() as table:
        assert len(list(csv.reader(table))) == 1 + 2
    assert "interrupted: the figures are of what was finished" in outcome.err


def test_ctrl_c_before_the_first_result_leaves_none(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(solve_experiments, "inferred", interrupted)
    outcome = coec("evaluate", SMALL, "--depth", "stereo", "--rotation-deg", "1", "--json")
    assert outcome.status == 130
    assert outcome.document["error"]["code"] == "interrupted"
    assert "Traceback" not in outcome.err


def test_needs_a_radius(coec: Coec) -> None:
    assert coec("evaluate", SMALL, "--depth", "stereo").status == 2


def test_detection_is_the_table_of_diagnose(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CHECKS", "FAR_CHECKS", "HALVES"):
        monkeypatch.setattr(commissioning, name, 2)
    monkeypatch.setattr(solve_experiments, "CHECKS", 1)
    arguments = (SMALL.replace("seconds=12", "seconds=18"), "--depth", "stereo", "--detection", "1")
    report = coec("evaluate", *arguments, "--rotation-deg", "2", "--directions", "1", "--objective", "mi", "--json")
    diagnosed = coec("diagnose", *arguments, "--checks", "1", "--json").document
    detection = report.document["detection"]
    assert detection == {key: diagnosed[key] for key in ("splits", "pairs", "moves")}
    assert [row["name"] for row in detection["moves"]][:4] == ["right", "0.5 deg", "1 deg", "3 deg"]
    assert all(row["checks"] == 1 for row in detection["moves"])


def test_displacements_are_projected_into_the_recording(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        solve_experiments,
        "MOUNT_STEPS",
        (mount_steps.MountStep("none", 0.0), mount_steps.MountStep("3 deg", radians(3.0))),
    )
    outcome = coec(
        "evaluate", SMALL, "--depth", "stereo", "--objective", "mi", "--rotation-deg", "2", "--directions", "1",
        "--steps", "2",
    )  # fmt: skip
    assert outcome.status == 0
    assert "Accepted and wrong" in " ".join(outcome.out.split())
    assert any("3 deg" in line and " 2 " in line for line in outcome.out.splitlines()), "two windows"


def test_a_recording_too_short_for_detection_is_refused_before_the_work(coec: Coec) -> None:
    outcome = coec("evaluate", SMALL, "--depth", "stereo", "--detection", "1", "--rotation-deg", "2")
    assert outcome.status != 0
    assert "needs 9 pairs" in outcome.err


@pytest.mark.usefixtures("without_pictures_of_starts")
def test_normalised_errors_of_windows_and_halves(coec: Coec, tmp_path: Path) -> None:
    outcome = coec(
        "evaluate", SMALL, "--depth", "stereo", "--rotation-deg", "2", "--directions", "1", "--objective", "mi",
        "--nees", "2", "--output", tmp_path / "out", "--json",
    )  # fmt: skip
    windows, halves = outcome.document["normalised"]
    assert EvaluationReport.model_validate(outcome.document).model_dump(mode="json") == outcome.document
    assert windows["judged"] + windows["refused"] == halves["judged"] + halves["refused"] == 2
    assert (halves["against"], halves["independent"] <= 1) == ("the other half of the frames", True)
    for result in (windows, halves):
        assert [sum(counts) for counts in result["histogram"]][:3] == [result["judged"]] * 3
    assert outcome.document["halves"] is None
    assert (tmp_path / "out" / "normalised.png").read_bytes().startswith(b"\x89PNG")


def test_a_simulated_drive_is_held_against_its_truth(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    class Known(FramewiseRecording):
        def truth(self, stamp_ns: int) -> NDArray[np.float64]:
            assert stamp_ns in self.camera_stamps_ns
            return se3.perturb(self.rig.T_camera_lidar_nominal, np.radians([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]))

    def known(query: dict[str, str]) -> FramewiseRecording:
        recording = rendered_drive(query)
        return Known(recording.name, recording.rig, recording.T_camera_lidar_start, recording.frames, recording.motions)

    monkeypatch.setattr("coec_lab.simulation.source.open_sim", known)
    arguments = (SMALL, "--depth", "stereo", "--rotation-deg", "1", "--directions", "1", "--objective", "mi")
    result = coec("evaluate", *arguments, "--nees", "1", "--json").document["normalised"][0]
    assert result["against"] == "the simulated truth"
    assert (result["judged"], result["refused"]) == (1, 0)
    assert result["rms"][0] == pytest.approx(3.0, abs=0.5)
    assert result["within_3_sigma"][0] == 0.0


CLOSURE = ("evaluate", "--closure", SMALL, SMALL, "--depth", "stereo", "--objective", "mi", "--rotation-deg", "1")


def test_closure_misses_a_pose_by_what_it_is_off(coec: Coec, tmp_path: Path) -> None:
    outcome = coec(*CLOSURE, "--directions", "1", "--relative", "1,0,0", "--output", tmp_path / "out", "--json")
    report = outcome.document
    assert ClosureReport.model_validate(report).model_dump(mode="json") == report
    assert (report["from_recordings"], report["known"][0]) == (False, pytest.approx(1.0))
    assert [group["frames"] for group in report["groups"]] == ["all frames", "the same half", "other halves"]
    assert report["groups"][0]["errors"]["rms"][:3] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert report["groups"][0]["translation_m"]["median"] is None
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == report
    assert (tmp_path / "out" / "normalised.png").read_bytes().startswith(b"\x89PNG")


def test_closure_as_text(coec: Coec) -> None:
    outcome = coec(*CLOSURE, "--directions", "1", "--frames", "2")
    assert "two cameras, one LiDAR; A in the frame of B, as the recordings tell: 0.000 deg" in outcome.out
    assert "Errors against the known pose between both" in outcome.out
    assert not outcome.err


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("evaluate", "--rotation-deg", "1"), "give a SOURCE, or --closure A B"),
        (("evaluate", SMALL, "--closure", SMALL, SMALL, "--rotation-deg", "1"), "not both"),
        (("evaluate", SMALL, "--relative", "0,0,0", "--rotation-deg", "1"), "it needs --closure A B"),
        ((*CLOSURE, "--relative", "1,2"), "--relative 1,2: give three finite numbers"),
        ((*CLOSURE, "--nees", "2"), "an experiment of its own"),
    ],
)
def test_what_does_not_go_together_is_refused_before_the_work(
    coec: Coec, arguments: tuple[str, ...], reported: str
) -> None:
    outcome = coec(*arguments)
    assert outcome.status == 2
    assert reported in outcome.err


def test_a_user_without_a_home_gets_plots_without_text_of_the_library_that_draws(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    env = {"PYTHONPATH": ":".join(sys.path), "HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", "import coec_lab, matplotlib.figure"]
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert (done.returncode, done.stderr) == (0, "")
