"""`coec calibrate` on a small simulated drive."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cli.conftest import SMALL, Coec
from coec.adapters.depth.maps import open_depth
from coec.calibration.ports import DepthModel
from coec.config import DepthConfig, LimitsConfig
from coec.errors import UsageError
from coec.sources.windows import evenly, vector_of

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


def test_failed_verdict_is_1_and_still_a_document(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--perturb", "0,40,0", "--json")
    assert outcome.status == 1
    assert outcome.document["verdict"]["decision"] == "failed"
    assert outcome.document["verdict"]["reasons"]


def test_text_names_axes_verdict_and_reasons(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--perturb", "0,40,0")
    assert "ry yaw" in outcome.out
    assert "+40.000" in outcome.out
    assert "verdict failed" in outcome.out
    assert not outcome.err


def test_output_folder_holds_pictures_and_the_report(coec: Coec, tmp_path: Path) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--output", tmp_path / "out", "--json")
    written = tmp_path / "out"
    assert json.loads((written / "result.json").read_text())["correction"] == outcome.document["correction"]
    for name in ("overlay_before.png", "overlay_after.png", "close_ups.png", "residuals.png"):
        assert (written / name).read_bytes().startswith(b"\x89PNG")
    page = (written / "report.html").read_text()
    assert json.dumps(outcome.document["camera_from_lidar"]["matrix"]).replace("[", "").split("]")[0] in page
    assert page.count("data:image/") == 2


def test_fitted_double_sphere_reports_its_residual(coec: Coec, tmp_path: Path) -> None:
    fitted = ("--camera-model", "double_sphere", "--output", tmp_path)
    outcome = coec("calibrate", SMALL, "--depth", "stereo", *fitted, "--json")
    assert (tmp_path / "lens_residual.png").read_bytes().startswith(b"\x89PNG")
    fit = outcome.document["camera_fit"]
    assert fit["model"] == "double_sphere"
    assert 0 <= fit["residual_rms_px"] <= fit["residual_max_px"] < 1e-6


def test_frames_bounds_the_window(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--frames", "3", "--json")
    assert outcome.document["pairs"] == 3


def test_without_motion_compensation(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--no-motion-compensation", "--json")
    assert outcome.document["compensation"]["disabled"] == 6


def test_time_offset_is_reported_when_asked_for(coec: Coec) -> None:
    arguments = ("calibrate", SMALL, "--depth", "stereo", "--objective", "mi")
    asked = coec(*arguments, "--time-offset", "--json").document["time_offset"]
    assert set(asked) == {"offset_s", "sigma_s", "turn_spread_deg_per_s", "observable", "reason"}
    assert asked["reason"]
    assert "camera after its stamp" in coec(*arguments, "--time-offset").out
    assert "time_offset" not in coec(*arguments, "--json").document


def test_without_a_network_the_one_that_comes_with_coec_is_used(coec: Coec) -> None:
    options = ("calibrate", SMALL, "--objective", "mi", "--frames", "2", "--json")
    ours = open_depth(DepthConfig(), LimitsConfig())
    assert coec(*options).document["depth_identity"] == ours.identity
    assert coec(*options, "--depth", "stereo").document["depth_identity"] != ours.identity


@pytest.mark.parametrize(
    ("arguments", "module"),
    [
        (("evaluate", SMALL, "--rotation-deg", 1), "library.evaluating"),
        (("commission", SMALL), "cli.commission"),
        (("diagnose", SMALL), "cli.commission"),
        (("paper", SMALL), "cli.paper"),
    ],
)
def test_so_do_the_other_commands(
    coec: Coec, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], module: str
) -> None:
    asked: list[DepthConfig] = []

    def enough(config: DepthConfig, _: LimitsConfig) -> DepthModel:
        asked.append(config)
        raise UsageError("enough")

    monkeypatch.setattr(f"coec.{module}.open_depth", enough)
    assert coec(*arguments).status == 2
    assert asked == [DepthConfig()]


def test_unknown_objective_is_a_usage_error(coec: Coec) -> None:
    outcome = coec("calibrate", SMALL, "--depth", "stereo", "--objective", "beauty")
    assert outcome.status == 2
    assert "objective.kind" in outcome.err


def test_unknown_camera_model_is_a_usage_error(coec: Coec) -> None:
    assert coec("calibrate", SMALL, "--depth", "stereo", "--camera-model", "eucm").status == 2


@pytest.mark.parametrize("text", ["1,2", "1,2,3,4", "a,b,c", "1,2,inf", ""])
def test_malformed_perturbation(text: str) -> None:
    with pytest.raises(UsageError):
        vector_of("--perturb", text)


@pytest.mark.parametrize(
    ("count", "wanted", "chosen"),
    [(3, 25, [0, 1, 2]), (10, 1, [0]), (10, 2, [0, 9]), (101, 5, [0, 25, 50, 75, 100]), (4, 3, [0, 2, 3])],
)
def test_evenly_spreads_over_the_recording(count: int, wanted: int, chosen: list[int]) -> None:
    assert evenly(count, wanted) == chosen
