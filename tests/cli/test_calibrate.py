"""`coec calibrate` on a small simulated drive."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli.conftest import SMALL, Coec
from coec import recording
from coec.calibration.search.without_start import Weighed
from coec.calibration.types import DepthModel, Estimate
from coec.config import DepthConfig, LimitsConfig, VerdictConfig
from coec.errors import OutputError, UsageError
from coec.io import user_files
from coec.io.depth.depth_maps import open_depth
from coec.io.images import encode_png
from coec.io.recordings.recording_source import evenly_spread
from coec.io.recordings.window_cutting import parse_perturbation
from coec.reports.calibration import remarks
from golden.scene import Drive, write

TOLERANCE_DEG = 0.35


def test_recovers_the_truth_from_a_perturbed_start(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--objective", "mi", "--perturb", "-2,1.5,1", "--json")
    report = outcome.document
    assert outcome.status == 0
    assert report["verdict"]["decision"] == "accepted"
    assert report["pairs"] == 6
    assert max(abs(angle) for angle in report["correction"][:3]) < TOLERANCE_DEG
    assert set(report["elapsed_s"]) >= {"load", "depth", "search", "diagnosis", "total"}
    assert report["solved"] == [True, True, True, False, False, False]


def weighed_at_once(*arguments: Any) -> tuple[Estimate, Weighed]:
    """Stands for a search of all rotations."""
    estimate, _ = recording.calibrated(*arguments)
    return estimate, Weighed(200_000, 40, 9, 3)


@pytest.mark.parametrize("searches", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_without_a_start_it_says_how_many_poses_were_weighed(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, searches: bool
) -> None:
    if not searches:
        monkeypatch.setattr("coec.recording.calibrate_without_start", weighed_at_once)
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--start", "none", "--output", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "result.json").read_text())
    weighed = report["weighed"]
    # Six coarse frames carry too little to choose among all rotations.
    assert outcome.status == 1
    assert report["verdict"]["decision"] == "failed"
    assert weighed["rotations"] > weighed["ascended"] >= weighed["ranked"] >= weighed["solved"] > 0
    sentence = f"without a start, {weighed['rotations']} rotations were weighed"
    assert sentence in " ".join(outcome.out.split())
    assert sentence in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("--perturb", "1,1,1"), "--perturb"), (("--objective", "mi"), "--objective fused"), ((), "")],
)
def test_no_start_cannot_be_moved_and_takes_the_fused_objective(
    coec: Coec, arguments: tuple[str, ...], message: str
) -> None:
    start = "none" if message else "nowhere"
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--start", start, *arguments)
    assert outcome.status != 0
    assert message in outcome.err


def test_failed_verdict_is_1_and_still_a_document(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--objective", "mi", "--perturb", "0,40,0", "--json")
    assert outcome.status == 1
    assert outcome.document["verdict"]["decision"] == "failed"
    assert outcome.document["verdict"]["reasons"]


def test_text_names_axes_verdict_and_reasons(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--objective", "mi", "--perturb", "0,40,0")
    assert "ry yaw" in outcome.out
    assert "+40.000" in outcome.out
    assert "verdict failed" in outcome.out
    assert "not to be used" in outcome.out
    lines = outcome.out.splitlines()
    poses = [k for k, line in enumerate(lines) if line.startswith(("T_camera_lidar", "translation x y z"))]
    assert [lines[k - 1] for k in poses] == ["REFUSED - do not use"] * 2
    assert not outcome.err


def test_text_is_what_one_copies(coec: Coec, tmp_path: Path) -> None:
    arguments = ("calibrate", SMALL, "--depth", "stereo", "--objective", "mi", "--output", tmp_path / "out")
    text = coec(*arguments).out
    result = json.loads((tmp_path / "out" / "result.json").read_text())["camera_from_lidar"]
    matrix = re.search(r"\[\[.*?\]\]", text, re.DOTALL)
    quaternion = re.search(r"quaternion x y z w: (\[.*\])", text)
    assert matrix is not None
    assert quaternion is not None
    np.testing.assert_allclose(json.loads(matrix.group()), result["matrix"], atol=1e-9)
    np.testing.assert_allclose(json.loads(quaternion.group(1)), result["quaternion_xyzw"], atol=1e-9)
    assert "objective mi, 3 degrees of freedom (rotation only), depth from stereo" in text
    assert "REFUSED" not in text
    names = "close_ups.png, overlay_after.png, overlay_before.png, report.html, residuals.png, result.json"
    assert f"written to {tmp_path / 'out'}: {names}" in text


def test_a_folder_that_cannot_be_written_to_is_refused_before_the_work(coec: Coec, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    outcome = coec("calibrate", tmp_path / "no such recording", "--output", tmp_path / "file" / "out", "--json")
    assert outcome.status == 1
    assert outcome.document["error"]["code"] == "output_failed"
    assert "--output" in outcome.err


def test_a_result_that_cannot_be_written_in_the_end_is_printed(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, _: bytes) -> Path:
        raise OutputError(f"cannot write {path}: No space left on device")

    monkeypatch.setattr(user_files, "write_output", full)
    arguments = ("calibrate", SMALL, "--depth", "stereo", "--objective", "mi", "--output", tmp_path)
    outcome = coec(*arguments, "--json")
    assert outcome.status == 1
    assert outcome.document["verdict"]["decision"] == "accepted"
    assert "No space left" in outcome.document["not_written"]
    text = coec(*arguments)
    assert "verdict accepted" in text.out
    assert "No space left" in text.err


def test_a_lens_that_the_fitted_model_does_not_hold_is_refused(coec: Coec, tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", np.array([[5.0, 0.1 * y, 0.0, 0.5] for y in range(-9, 10)], np.float32))
    (tmp_path / "image.png").write_bytes(encode_png(np.zeros((1208, 1920, 3), np.uint8)))
    # A lens of 120 degrees whose distortion turns back on itself in the corners.
    lens = "fx: 959.5, fy: 960.2, cx: 940.8, cy: 670.7, k1: -0.0978, k2: 0.1414, k3: -0.1484, k4: 0.0559"
    (tmp_path / "dataset.yaml").write_text(
        f"pair: front\ncamera: {{model: kannala_brandt, width: 1920, height: 1208, {lens}}}\n"
        "T_camera_lidar: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]\n"
        "frames: [{image: image.png, cloud: cloud.npy, stamp_ns: 0}]\n"
    )
    outcome = coec("calibrate", tmp_path, "--camera-model", "double_sphere", "--json")
    assert outcome.status == 1
    assert outcome.document["error"]["code"] == "lens_does_not_fit"
    fit = outcome.document["camera_fit"]
    assert fit["error_deg"] > fit["limit_deg"] == VerdictConfig().max_sigma_deg
    assert "--camera-model" in outcome.err
    assert "--output" in outcome.err
    # Where there is a folder, a picture in it shows where the model is off.
    rendered = tmp_path / "out" / "lens_residual.png"
    reported = coec("calibrate", tmp_path, "--camera-model", "double_sphere", "--output", tmp_path / "out", "--json")
    assert reported.document["picture"] == str(rendered)
    assert rendered.read_bytes().startswith(b"\x89PNG")
    assert str(rendered) in reported.err


def test_output_folder_holds_pictures_and_the_report(coec: Coec, tmp_path: Path) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--output", tmp_path / "out", "--json")
    written = tmp_path / "out"
    assert json.loads((written / "result.json").read_text())["correction"] == outcome.document["correction"]
    for name in ("overlay_before.png", "overlay_after.png", "close_ups.png", "residuals.png"):
        assert (written / name).read_bytes().startswith(b"\x89PNG")
    page = (written / "report.html").read_text()
    assert json.dumps(outcome.document["camera_from_lidar"]["matrix"]).replace("[", "").split("]")[0] in page
    assert page.count("data:image/") == 4


def test_fitted_double_sphere_reports_its_residual(coec: Coec, tmp_path: Path) -> None:
    fitted = ("--objective", "mi", "--camera-model", "double_sphere", "--output", tmp_path)
    outcome = coec("calibrate", SMALL, "--depth", "stereo", *fitted, "--json")
    assert (tmp_path / "lens_residual.png").read_bytes().startswith(b"\x89PNG")
    fit = outcome.document["camera_fit"]
    assert fit["model"] == "double_sphere"
    assert 0 <= fit["residual_rms_px"] <= fit["residual_max_px"] < 1e-6


def test_the_lens_is_reported_on_request(coec: Coec, tmp_path: Path) -> None:
    drive = write(Drive(), tmp_path / "drive")
    shown = coec("calibrate", drive, "--depth", "stereo", "--intrinsics", "--output", tmp_path / "out").out
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["lens"]["estimated"].keys() == {"fx", "fy", "cx", "cy"}
    assert abs(result["lens"]["focal_length"]["difference"]) < 3.0 * result["lens"]["focal_length"]["sigma"]
    assert "radial, at a corner" in shown
    assert "radial, at a corner" in (tmp_path / "out" / "report.html").read_text()
    assert result["intrinsics"]["sha256"] in (tmp_path / "out" / "report.html").read_text()
    without = coec("calibrate", drive, "--depth", "stereo", "--objective", "mi", "--intrinsics").out
    assert "The lens was not estimated" in without
    assert "radial" not in coec("calibrate", drive, "--depth", "stereo", "--objective", "mi").out


def test_frames_bounds_the_window(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--objective", "mi", "--frames", "3", "--json")
    assert outcome.document["pairs"] == 3


def test_without_motion_compensation(coec: Coec) -> None:
    options = ("--depth", "stereo", "--objective", "mi", "--no-motion-compensation", "--json")
    outcome = coec("calibrate", SMALL, *options)
    assert outcome.document["compensation"]["disabled"] == 6


def test_time_offset_is_reported_on_request(coec: Coec) -> None:
    arguments = ("calibrate", SMALL, "--depth", "stereo", "--objective", "mi")
    requested = coec(*arguments, "--time-offset", "--json").document["time_offset"]
    assert set(requested) == {"offset_s", "sigma_s", "turn_spread_deg_per_s", "observable", "reason"}
    assert requested["reason"]
    assert "camera after its stamp" in coec(*arguments, "--time-offset").out
    assert "time_offset" not in coec(*arguments, "--json").document


@pytest.mark.parametrize(
    ("offset_s", "text"),
    [
        (-0.0304, "not observable, a straight drive; the best fit is -30.4 ± 4.5 ms"),
        (None, "not observable, a straight drive"),
    ],
)
def test_an_offset_that_is_not_observable_is_reported_with_its_size(offset_s: float | None, text: str) -> None:
    offset = {"observable": False, "reason": "a straight drive", "offset_s": offset_s, "sigma_s": 0.0045}
    document: dict[str, Any] = {"recognitions": [], "weighed": None, "time_offset": offset}
    assert remarks(document) == [f"camera after its stamp: {text}"]


def test_without_a_network_the_one_that_comes_with_coec_is_used(coec: Coec) -> None:
    options = ("calibrate", SMALL, "--objective", "mi", "--frames", "2", "--json")
    ours = open_depth(DepthConfig(), LimitsConfig())
    assert coec(*options).document["depth_identity"] == ours.identity
    assert coec(*options, "--depth", "stereo").document["depth_identity"] != ours.identity


@pytest.mark.parametrize(
    ("arguments", "module"),
    [
        (("evaluate", SMALL, "--rotation-deg", 1), "coec_lab.experiments.evaluation_run"),
        (("commission", SMALL), "coec.io.depth.depth_maps"),
        (("diagnose", SMALL), "coec.io.depth.depth_maps"),
        (("paper", SMALL), "coec_lab.commands.paper_experiments"),
    ],
)
def test_so_do_the_other_commands(
    coec: Coec, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], module: str
) -> None:
    requested: list[DepthConfig] = []

    def enough(config: DepthConfig, _: LimitsConfig) -> DepthModel:
        requested.append(config)
        raise UsageError("enough")

    monkeypatch.setattr(f"{module}.open_depth", enough)
    assert coec(*arguments).status == 2
    assert requested == [DepthConfig()]


def test_unknown_objective_is_a_usage_error(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--objective", "beauty")
    assert outcome.status == 2
    assert "objective.kind" in outcome.err


def test_unknown_camera_model_is_a_usage_error(coec: Coec) -> None:
    assert coec("calibrate", SMALL, "--depth", "stereo", "--camera-model", "eucm").status == 2


@pytest.mark.parametrize("text", ["1,2", "1,2,3,4", "a,b,c", "1,2,inf", "", "200,0,0", "0,0,0,120,-30,0"])
def test_malformed_perturbation(text: str) -> None:
    with pytest.raises(UsageError):
        parse_perturbation("--perturb", text)


@pytest.mark.parametrize(
    ("count", "expected", "selected"),
    [(3, 25, [0, 1, 2]), (10, 1, [0]), (10, 2, [0, 9]), (101, 5, [0, 25, 50, 75, 100]), (4, 3, [0, 2, 3])],
)
def test_evenly_spreads_over_the_recording(count: int, expected: int, selected: list[int]) -> None:
    assert evenly_spread(count, expected) == selected
