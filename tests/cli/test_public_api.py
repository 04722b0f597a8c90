"""`import coec`: what it costs, what it names, and that it says what the command line says, to the byte."""

from __future__ import annotations

import doctest
import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import assert_type

import numpy as np
import pytest

import coec as package
from cli.conftest import SMALL, Coec, unsought
from coec import api
from coec.config import CalibrationConfig, DepthConfig, ObjectiveConfig
from coec.errors import NotAcceptedError, OutputError, SourceError, UsageError
from coec.io.mcap.windows import WindowWriter
from coec.schemas.message import to_json
from coec.schemas.replies import CalibrationResult
from coec_lab.experiments.evaluation_schema import EvaluationReport
from conftest import REPOSITORY
from e2e.processes import environment
from support.simulated_drives import rendered_drive

HEAVY = ("asyncio", "cv2", "matplotlib", "numba", "numpy", "onnxruntime", "pydantic", "rich", "typing", "zenoh")
TEN_LINES = REPOSITORY / "docs" / "examples" / "calibrate.py"
LAST_DIGIT = 1e-12


@pytest.fixture
def drive() -> package.Recording:
    """Six frames with exact depth."""
    return package.open(SMALL)


@pytest.fixture(scope="module")
def results() -> dict[float, package.Result]:
    """Of the drive, by how far the start is off in yaw: right, and beyond what can be found."""
    with pytest.MonkeyPatch.context() as patch:  # as `drawn_once`, which comes later
        patch.setattr("coec_lab.simulation.source.open_sim", rendered_drive)
        patch.setattr("coec.recording.probable_mistake", unsought)
        window = package.open(SMALL).window()
        return {yaw: window.calibrate(depth="stereo", objective="mi", perturb=(0, yaw, 0)) for yaw in (1.0, 40.0)}


@pytest.fixture
def right(results: dict[float, package.Result]) -> package.Result:
    """An accepted result."""
    return results[1.0]


@pytest.fixture
def wrong(results: dict[float, package.Result]) -> package.Result:
    """A result with a negative verdict."""
    return results[40.0]


# ---------------------------------------------------------------------------------------------------- the package
def test_to_import_it_imports_nothing_heavy() -> None:
    # `-I -S`: what the environment imports at its start is none of ours.
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import coec; print(sorted(set(sys.modules) & set(sys.argv[2:])))"
    )
    command = [sys.executable, "-I", "-S", "-c", code, str(REPOSITORY / "service"), *HEAVY]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_client_loads_no_compiler() -> None:
    code = "import sys, coec; coec.client.Vehicle; print(sorted(set(sys.modules) & set(sys.argv[1:])))"
    command = [sys.executable, "-c", code, "cv2", "llvmlite", "matplotlib", "nlopt", "numba", "onnxruntime"]
    ran = subprocess.run(command, capture_output=True, text=True, check=True, env=environment())
    assert ran.stdout == "[]\n"


def test_every_public_name_is_there_and_is_documented() -> None:
    assert set(package.__all__) <= set(dir(package))
    for name in package.__all__:
        if name != "__version__":
            assert getattr(package, name).__doc__, name
    with pytest.raises(AttributeError, match="nonsense"):
        _ = package.nonsense  # type: ignore[attr-defined]


@pytest.mark.parametrize("module", [api], ids=lambda module: str(module.__name__))
def test_the_examples_in_docstrings_do_what_they_say(module: object) -> None:
    outcome = doctest.testmod(module)  # type: ignore[arg-type]
    assert outcome.attempted > 0
    assert outcome.failed == 0


def test_ten_lines_calibrate_and_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert len([line for line in TEN_LINES.read_text().splitlines() if line]) <= 10
    runpy.run_path(str(TEN_LINES))
    assert "accepted" in capsys.readouterr().out
    document = json.loads((tmp_path / "calibration.json").read_text())
    assert document["accepted"] is True


# ------------------------------------------------------------------------------------------------- recordings
def test_a_recording_reports_what_it_holds(drive: package.Recording) -> None:
    assert_type(drive, package.Recording)
    reported = drive.describe()
    assert (reported.pair, reported.camera.frames, reported.lidar.frames) == ("sim", 6, 6)
    assert reported.camera.rate_hz == pytest.approx(0.5)
    assert (reported.intrinsics["width"], reported.camera_model) == (160, "double_sphere")
    assert drive.T_camera_lidar.shape == (4, 4)
    drive.T_camera_lidar[:] = 0.0
    assert drive.T_camera_lidar.any()


def test_windows_follow_each_other_and_leave_no_frame_out(drive: package.Recording) -> None:
    cut = list(drive.windows(seconds=4.0))
    assert [window.pairs for window in cut] == [2, 4]  # 0, 2 | 4, 6, 8, 10 s: half of a third is left
    assert sorted(stamp for window in cut for stamp in window.stamps_ns) == list(drive.window().stamps_ns)
    assert [window.pairs for window in drive.windows(seconds=1000.0)] == [6]
    assert [window.pairs for window in drive.windows(seconds=5.0, frames=1)] == [1, 1]


@pytest.mark.parametrize(
    "wrong", [{"frames": 0}, {"between_s": (3.0, 1.0)}, {"between_s": (-1.0, 1.0)}, {"between_s": (float("nan"), 1.0)}]
)
def test_a_window_that_cannot_be_is_refused(drive: package.Recording, wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        drive.window(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("inf"), float("nan")])
def test_windows_of_no_length_are_refused(drive: package.Recording, seconds: float) -> None:
    with pytest.raises(UsageError, match="seconds"):
        next(drive.windows(seconds=seconds))


def test_a_slice_without_frames_says_so(drive: package.Recording) -> None:
    with pytest.raises(SourceError, match="none of 0 camera frames"):
        drive.window(between_s=(2.5, 3.5))


# --------------------------------------------------------------------------------- the same as the command line
def test_calibrate_says_what_the_command_says_to_the_byte(coec: Coec, drive: package.Recording) -> None:
    message = coec(
        "calibrate", SMALL, "--depth", "stereo", "--objective", "mi", "--perturb", "-2,1.5,1", "--camera-model",
        "double_sphere", "--frames", "5", "--time-offset", "--no-motion-compensation", "--json",
    ).document  # fmt: skip
    stages: list[str] = []
    result = package.calibrate(
        drive.window(frames=5),
        depth="stereo",
        objective="mi",
        perturb=(-2, 1.5, 1),
        camera_model="double_sphere",
        time_offset=True,
        motion_compensation=False,
        progress=lambda stage, *_: stages.append(stage),
    )
    reported_fit, reported_offset = message.pop("camera_fit"), message.pop("time_offset")
    assert {"prepare", "depth", "search", "diagnosis", "time offset"} <= set(stages)
    assert set(message.pop("elapsed_s")) == {*stages, "load", "total"}
    assert result.to_json().encode() == to_json(CalibrationResult.model_validate(message))
    assert result.camera_fit is not None
    assert reported_fit["residual_max_px"] == result.camera_fit.residual_max_px
    assert result.time_offset is not None
    assert reported_offset["reason"] == result.time_offset.reason


def test_a_recorded_window_is_calibrated_as_it_was_recorded(
    coec: Coec, drive: package.Recording, tmp_path: Path
) -> None:
    window = drive.window().loaded.window
    path = tmp_path / f"{window.window_id}.mcap"
    recorded = CalibrationConfig(depth=DepthConfig(model="stereo"), objective=ObjectiveConfig(kind="mi", depth_bins=24))
    writer = WindowWriter(path, window.rig, window.T_camera_lidar_start, window.window_id, recorded, {"vehicle": "v7"})
    for pair in window.pairs:
        writer.add(pair)
    writer.finish()
    message = coec("calibrate", path, "--json").document
    message.pop("elapsed_s")
    opened = package.open(path)
    result = opened.calibrate()
    assert opened.configuration == recorded
    assert result.configuration == recorded
    assert result.to_json().encode() == to_json(CalibrationResult.model_validate(message))
    other = opened.calibrate(configuration=CalibrationConfig(depth=DepthConfig(model="stereo")), objective="mi")
    assert other.document.config_hash != result.document.config_hash


def test_evaluate_says_what_the_command_says(coec: Coec, drive: package.Recording) -> None:
    message = coec(
        "evaluate",
        SMALL,
        "--depth",
        "stereo",
        "--objective",
        "mi",
        "--rotation-deg",
        "3",
        "--directions",
        "2",
        "--json",
    ).document
    report = package.evaluate(drive, rotation_deg=3.0, directions=2, depth="stereo", objective="mi")
    timed = {"elapsed_s", "solve_s"}
    expected = EvaluationReport.model_validate(message)
    assert report.model_dump(exclude=timed) == expected.model_dump(exclude=timed)
    with pytest.raises(UsageError, match="directions"):
        package.evaluate(drive, rotation_deg=3.0, directions=0)


# ---------------------------------------------------------------------------------------------------- results
def test_a_result_is_one_pose_in_all_its_forms(right: package.Result) -> None:
    assert right.accepted
    assert right.reasons == ()
    T = right.T_camera_lidar
    x, y, z, w = right.quaternion_xyzw
    rotated = 2.0 * np.array([x * y - w * z, w * w + y * y - 0.5, y * z + w * x])  # second column of the rotation
    np.testing.assert_allclose(T[:3, 1], rotated, atol=LAST_DIGIT)
    np.testing.assert_array_equal(T[:3, 3], right.translation_m)
    sigma = np.sqrt(right.covariance.diagonal())
    np.testing.assert_allclose(np.degrees(sigma[:3]), right.sigma[:3], rtol=1e-9)
    assert np.isnan(right.sigma[3:]).all()
    assert json.loads(right.to_json())["correction"] == right.correction.tolist()
    assert right.figures
    assert all(figure.passed for figure in right.figures.values())
    assert repr(right) == f"<coec.Result {right.document.window_id}: accepted>"


def test_what_is_not_accepted_is_not_exported_unless_somebody_insists(wrong: package.Result, tmp_path: Path) -> None:
    assert not wrong.accepted
    assert wrong.reasons
    path = tmp_path / "calibration.json"
    with pytest.raises(NotAcceptedError, match="force=True"):
        wrong.export(path, format="json")
    assert not path.exists()
    assert wrong.export(path, format="json", force=True) == path
    assert json.loads(path.read_text())["accepted"] is False


def test_an_export_is_the_one_of_the_command(coec: Coec, right: package.Result, tmp_path: Path) -> None:
    document = tmp_path / "result.json"
    document.write_text(right.to_json())
    pose = np.eye(4)
    pose[:3, 3] = (1.0, 2.0, 3.0)
    written = right.export(tmp_path / "new" / "tf.py", format="tf", parent="base_link", T_parent_lidar=pose)
    message = coec("export", document, "--format", "tf", "--parent", "base_link", "--parent-pose", "1,2,3,0,0,0,1").out
    assert written.read_text() == message


def test_what_cannot_be_exported_says_why(right: package.Result, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="known are autoware, colmap"):
        right.export(tmp_path / "a", format="xls")
    with pytest.raises(UsageError, match="T_parent_lidar"):
        right.export(tmp_path / "a", format="tf", T_parent_lidar=np.eye(3))
    with pytest.raises(OutputError, match="no frame"):
        right.export(tmp_path / "a", format="tf", child="<script>")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        right.export(tmp_path / "file" / "a", format="tf")


def test_overlays_differ_where_the_poses_do(right: package.Result) -> None:
    detected, start, nominal = right.overlay(), right.overlay("start"), right.overlay("nominal")
    assert detected.dtype == np.uint8
    assert detected.shape == start.shape == nominal.shape
    assert detected.shape[2] == 3
    assert not np.array_equal(detected, start)
    with pytest.raises(UsageError, match="known are result, start, nominal"):
        right.overlay("end")  # type: ignore[arg-type]


@pytest.mark.parametrize("perturb", [(1.0,), (1.0, 2.0, float("nan")), ()])
def test_a_perturbation_that_is_none_is_refused(drive: package.Recording, perturb: tuple[float, ...]) -> None:
    with pytest.raises(UsageError, match="give three finite numbers"):
        drive.calibrate(depth="stereo", perturb=perturb)
