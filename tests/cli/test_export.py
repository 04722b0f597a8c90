"""`coec export`: a calibration out of whatever holds one, into the files of other programs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from cli.conftest import Coec
from coec.calibration.state import PairRules, PairState, after_estimate, initial_state
from coec.calibration.types import Decision, Reason, Verdict
from coec.config import MonitorConfig, PolicyConfig, TrackerConfig
from coec.geometry import cameras, se3
from coec.io.serialise import result_of
from coec.schemas.message import to_json
from coec.service.api.reply_builders import extrinsic_of
from coec.service.records.state_store import Clocks, StateStore
from support.estimates import ESTIMATE_RIG, estimate

RULES = PairRules(PolicyConfig(apply="always"), TrackerConfig(), MonitorConfig())
CLOCKS = Clocks(None, None, None)
SERVED = after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, RULES)


def retained(folder: Path, state: PairState) -> None:
    store = StateStore(folder, "v7")
    store.update(ESTIMATE_RIG, state, CLOCKS, dict)
    store.flush()


@pytest.fixture
def result(tmp_path: Path) -> Path:
    path = tmp_path / "result.json"
    path.write_bytes(to_json(result_of(estimate(1), ESTIMATE_RIG, "v7")))
    return path


@pytest.fixture
def state(tmp_path: Path) -> Path:
    folder = tmp_path / "state"
    folder.mkdir()
    retained(folder, SERVED)
    return folder


def test_a_result_is_printed_as_a_file(coec: Coec, result: Path) -> None:
    outcome = coec("export", result, "--format", "json")
    assert outcome.status == 0
    np.testing.assert_array_equal(outcome.document["T_child_parent"], estimate(1).optimum.T_camera_lidar)
    np.testing.assert_array_equal(
        np.array(outcome.document["covariance_rad_m"], dtype=float), estimate(1).uncertainty.covariance
    )
    assert (outcome.document["parent"], outcome.document["child"]) == ("lidar", "camera")


@pytest.mark.parametrize("inside", ["", "state.json"])
def test_a_state_directory_gives_what_is_served(coec: Coec, state: Path, inside: str) -> None:
    outcome = coec("export", state / inside, "--format", "json")
    np.testing.assert_array_equal(outcome.document["T_child_parent"], SERVED.T_camera_lidar)
    assert outcome.document["vehicle"] == "v7"
    assert outcome.document["window_id"] == "front-1"


def test_a_reply_of_a_service_gives_what_it_reports(coec: Coec, tmp_path: Path) -> None:
    accepted = result_of(estimate(1), ESTIMATE_RIG, "v7")
    reply = extrinsic_of("v7", ESTIMATE_RIG, SERVED, accepted, 0.0, "hash")
    path = tmp_path / "extrinsic.json"
    path.write_bytes(to_json(reply))
    document = coec("export", path, "--format", "json").document
    np.testing.assert_array_equal(document["T_child_parent"], SERVED.T_camera_lidar)
    reported = np.array(document["covariance_rad_m"], dtype=float)
    np.testing.assert_allclose(reported.diagonal(), estimate(1).uncertainty.covariance.diagonal(), rtol=1e-12)
    np.testing.assert_allclose(reported[0, 4], estimate(1).uncertainty.covariance[0, 4], rtol=1e-9)


def holders(folder: Path) -> dict[str, Path]:
    """Everything but a window that holds a calibration: the file or folder by its kind."""
    accepted = result_of(estimate(1), ESTIMATE_RIG, "v7")
    files = {"result": accepted, "reply": extrinsic_of("v7", ESTIMATE_RIG, SERVED, accepted, 0.0, "hash")}
    for name, model in files.items():
        (folder / f"{name}.json").write_bytes(to_json(model))
    (folder / "state").mkdir()
    retained(folder / "state", SERVED)
    return {**{name: folder / f"{name}.json" for name in files}, "state": folder / "state"}


@pytest.mark.parametrize("source", ["result", "reply", "state"])
def test_the_intrinsics_that_it_was_estimated_with_come_along(coec: Coec, tmp_path: Path, source: str) -> None:
    path = holders(tmp_path)[source]
    camera = ESTIMATE_RIG.camera
    K = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    chain = YAML(typ="safe").load(coec("export", path, "--format", "kalibr").out)["cam0"]
    assert (chain["camera_model"], chain["distortion_model"]) == ("pinhole", "none")
    assert chain["intrinsics"] == [camera.fx, camera.fy, camera.cx, camera.cy]
    assert chain["resolution"] == [camera.width, camera.height]
    assert coec("export", path, "--format", "nuscenes").document[0]["camera_intrinsic"] == K
    reported = coec("export", path, "--format", "json").document["camera"]
    assert reported == {"model": "pinhole", **cameras.intrinsics_of(camera)}


@pytest.mark.parametrize(
    "intrinsics",
    [
        None,
        {"model": "a_lens_of_tomorrow", "width": 640, "height": 400, "parameters": {"fx": 1.0}},
        {"model": "pinhole", "width": 640, "height": 400, "parameters": {"fx": 1.0}},
    ],
)
def test_intrinsics_that_are_absent_or_unknown_are_needed_only_where_they_are_written(
    coec: Coec, result: Path, intrinsics: dict[str, object] | None
) -> None:
    document = json.loads(result.read_bytes())
    result.write_text(json.dumps({**document, "intrinsics": intrinsics}))
    assert coec("export", result, "--format", "tf").status == 0
    outcome = coec("export", result, "--format", "kalibr")
    assert outcome.status == 1
    assert "give --config" in outcome.err


def test_the_parent_may_be_another_frame_than_the_lidar(coec: Coec, result: Path) -> None:
    pose = "0.5,0,1.7,0,0,0.7071067811865476,0.7071067811865476"
    outcome = coec("export", result, "--format", "json", "--parent", "base_link", "--parent-pose", pose)
    T_parent_lidar = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 1.7], [0, 0, 0, 1]])
    expected = estimate(1).optimum.T_camera_lidar @ se3.inverse(T_parent_lidar)
    np.testing.assert_allclose(outcome.document["T_child_parent"], expected, atol=1e-12)


def test_what_is_not_accepted_is_refused_and_forced(coec: Coec, tmp_path: Path) -> None:
    bad = estimate(2, Decision.FAILED)
    refused = replace(bad, verdict=Verdict(Decision.FAILED, (), (Reason("edges", "The edges are faint."),)))
    path, file = tmp_path / "result.json", tmp_path / "camera.urdf"
    path.write_bytes(to_json(result_of(refused, ESTIMATE_RIG, "v7")))
    outcome = coec("export", path, "--format", "urdf", "--output", file)
    assert outcome.status == 1
    assert "The edges are faint." in outcome.err
    assert "--force" in outcome.err
    assert not file.exists()
    assert coec("export", path, "--format", "urdf", "--output", file, "--force").status == 0
    assert "REFUSED - do not use. NOT ACCEPTED, exported by force: The edges are faint." in file.read_text()
    document = coec("export", path, "--format", "json", "--force").document
    assert (document["accepted"], document["objections"]) == (False, ["The edges are faint."])


def test_a_nominal_state_is_refused(coec: Coec, tmp_path: Path) -> None:
    retained(tmp_path, initial_state(ESTIMATE_RIG))
    outcome = coec("export", tmp_path, "--format", "tf")
    assert outcome.status == 2
    assert "nothing was accepted yet" in outcome.err


def test_a_file_is_replaced_whole_and_stays_what_it_was(coec: Coec, result: Path, tmp_path: Path) -> None:
    real, link = tmp_path / "real.sh", tmp_path / "link.sh"
    real.write_text("#!/bin/sh\nwait\n")
    real.chmod(0o750)
    link.symlink_to(real)
    assert coec("export", result, "--format", "tf", "--output", link).status == 0
    assert link.is_symlink()
    assert real.stat().st_mode & 0o777 == 0o750
    assert "--child-frame-id camera" in real.read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.sh", "real.sh", "result.json"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--format", "ros"), "known are autoware, colmap, json"),
        (("--format", "tf", "--parent-pose", "1,2"), "seven finite numbers"),
        (("--format", "tf", "--parent", "a b"), "names no frame"),
    ],
)
def test_what_does_not_fit_is_reported(coec: Coec, result: Path, arguments: tuple[str, ...], message: str) -> None:
    outcome = coec("export", result, *arguments)
    assert outcome.status in (1, 2)
    assert message in outcome.err
    assert outcome.out == ""


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b"\xff", b'{"verdict": 1}', b"[" * 100_000])
def test_what_is_no_calibration_is_reported(coec: Coec, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(content)
    outcome = coec("export", path, "--format", "tf")
    assert outcome.status == 1
    assert "is neither the result of" in outcome.err


def test_a_damaged_state_says_what_is_wrong(coec: Coec, state: Path) -> None:
    (state / "state.json").write_text("{")
    outcome = coec("export", state, "--format", "tf")
    assert outcome.status == 1
    assert "cannot be used" in outcome.err


def test_json_says_what_was_written(coec: Coec, result: Path, tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    outcome = coec("export", result, "--format", "opencv", "--output", file, "--json")
    assert outcome.document == {"format": "opencv", "text": file.read_text(), "written": str(file)}
    assert json.loads(outcome.out)
