"""`coec models`."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import pytest

from cli.conftest import SMALL, Coec
from coec.config import DepthConfig, LimitsConfig
from coec.io.depth.depth_maps import open_depth
from coec_lab.experiments.evaluation_schema import ModelAssessment
from support.recordings import first_channel_network


def test_lists_the_cards_of_the_contract(coec: Coec) -> None:
    names = {card["name"] for card in coec("models", "--json").document["models"]}
    assert {"dpt_beit_large_512", "midas_small", "tcmonodepth_small", "meter_xxs_kitti"} <= names
    assert "dpt_beit_large_512" in coec("models").out


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where networks are looked for."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path / "data" / "coec" / "models"


def test_says_whose_file_is_present_and_where_the_others_come_from(coec: Coec, folder: Path) -> None:
    models = {card["name"]: card for card in coec("models", "--json").document["models"]}
    street, dpt = models["street"], models["dpt_beit_large_512"]
    assert (street["present"], Path(street["path"]).name) == (True, "street.onnx")
    assert (dpt["present"], dpt["path"], dpt["sha256"], dpt["licence"]) == (False, None, None, "MIT")
    assert dpt["looked_for"][0] == str(folder / "dpt_beit_large_512.onnx")
    rows = {line.split()[0]: line for line in coec("models").out.splitlines() if line.strip()}
    assert "present" in rows["street"]
    assert "absent" in rows["dpt_beit_large_512"]
    assert "isl-org/MiDaS" in rows["dpt_beit_large_512"]
    assert all(card["obtain"] != "its authors" for card in models.values())


def test_a_known_network_without_its_file_is_refused_with_the_way_out(coec: Coec, folder: Path) -> None:
    err = coec("calibrate", SMALL, "--depth", "dpt_beit_large_512").err
    assert f"looked for as {folder / 'dpt_beit_large_512.onnx'}" in err
    assert "isl-org/MiDaS" in err
    assert "coec models add FILE" in err
    unknown = coec("calibrate", SMALL, "--depth", "nosuch").err
    assert "on this machine: street." in unknown
    assert "dpt_beit_large_512" not in unknown


def test_adds_an_export_of_a_network_once_and_then_uses_it(coec: Coec, folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "dpt_beit_large_512.onnx"
    file.write_bytes(first_channel_network())
    before = os.umask(0o077)
    try:
        outcome = coec("models", "add", file)
    finally:
        os.umask(before)
    place = folder / file.name
    assert outcome.status == 0
    assert str(place) in outcome.out
    assert place.read_bytes() == file.read_bytes()
    assert place.stat().st_mode & 0o777 == 0o644
    assert [path.name for path in folder.iterdir()] == [file.name]
    assert coec("models", "add", file, "--json").document == {
        "name": "dpt_beit_large_512", "path": str(place), "copied": False,
    }  # fmt: skip
    depth = open_depth(DepthConfig(model="dpt_beit_large_512"), LimitsConfig())
    assert depth.identity == hashlib.sha256(file.read_bytes()).hexdigest()


def test_another_file_in_its_place_is_replaced_only_on_request(coec: Coec, folder: Path, tmp_path: Path) -> None:
    file, place = tmp_path / "any.onnx", folder / "midas_small.onnx"
    file.write_bytes(first_channel_network())
    folder.mkdir(parents=True)
    place.write_bytes(b"another export")
    refused = coec("models", "add", file, "--as", "midas_small")
    assert refused.status == 1
    assert "--force" in refused.err
    assert place.read_bytes() == b"another export"
    assert coec("models", "add", file, "--as", "midas_small", "--force").status == 0
    assert place.read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    ("name", "content", "more", "status", "reported"),
    [
        ("mine.onnx", first_channel_network(), (), 1, "docs/own-network.md"),
        ("mine.onnx", first_channel_network(), ("--as", "nosuch"), 2, "no built-in card of this name"),
        ("street.onnx", first_channel_network(), (), 1, "another file, or a damaged one"),
        ("midas_small.onnx", b"rubbish", (), 1, "midas_small.onnx"),
        ("midas_small.onnx", first_channel_network((1, 4, "h", "w")), (), 1, "midas_small.onnx"),
        ("midas_small.onnx", None, (), 1, "there is no file"),
    ],
    ids=["unknown", "unknown name", "another file", "damaged", "another input", "absent"],
)
def test_what_is_no_known_network_is_not_added(
    coec: Coec,
    folder: Path,
    tmp_path: Path,
    name: str,
    content: bytes | None,
    more: tuple[str, ...],
    status: int,
    reported: str,
) -> None:
    file = tmp_path / name
    if content is not None:
        file.write_bytes(content)
    outcome = coec("models", "add", file, *more)
    assert outcome.status == status
    assert reported in outcome.err
    assert not folder.exists()


def test_weights_in_other_files_are_refused_with_the_way_out(coec: Coec, folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "midas_small.onnx"
    file.write_bytes(first_channel_network())
    (tmp_path / "midas_small.onnx.data").write_bytes(b"weights")
    outcome = coec("models", "add", file)
    assert outcome.status == 1
    assert "onnx.save(onnx.load(FILE), OTHER)" in outcome.err
    assert not folder.exists()


def test_shows_the_card_that_a_file_is_recognised_by(coec: Coec, sample_data: Path) -> None:
    outcome = coec("models", "show", sample_data / "depth" / "tcsmallnet_dyn.onnx", "--json")
    assert outcome.document["card"]["name"] == "tcmonodepth_small"


def test_unknown_file_has_no_card(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "mystery.onnx"
    path.write_bytes(b"nothing known")
    outcome = coec("models", "show", path)
    assert outcome.status == 1
    assert "no model card" in outcome.err


def test_other_text_are_a_usage_error(coec: Coec) -> None:
    assert coec("models", "burn").status == 2


def test_assesses_a_network_against_the_lidar(coec: Coec, tmp_path: Path) -> None:
    outcome = coec("models", "assess", "stereo", SMALL, "--frames", "3", "--output", tmp_path / "out", "--json")
    report = outcome.document
    assert outcome.status == 0
    assert ModelAssessment.model_validate(report).model_dump(mode="json") == report
    assert report["suitability"] == "good"
    assert report["rank_correlation"] > 0.9
    assert report["inference_ms"] is None
    assert max(map(abs, report["bias_deg"])) < 0.5
    assert len(report["frames"]) == report["pairs"] == 3
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == report
    for name in ("curves", "joint", "frame"):
        assert (tmp_path / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_assessment_as_text(coec: Coec) -> None:
    outcome = coec("models", "assess", "stereo", SMALL, "--frames", "2")
    assert "good: plain mutual information finds the calibration with it" in outcome.out
    assert "rank correlation with inverse range" in outcome.out
    assert not outcome.err


def test_the_verdict_on_three_frames_of_a_recording(coec: Coec, sample_data: Path) -> None:
    network, source = sample_data / "depth" / "tcsmallnet_dyn.onnx", f"kitti360:{sample_data}/kitti360?camera=image_00"
    outcome = coec("models", "assess", network, source, "--frames", "3", "--json")
    assert outcome.document["suitability"] == "usable_in_fused"
    assert outcome.document["rank_correlation"] == pytest.approx(0.90, abs=0.02)
    assert outcome.status == 0


@pytest.mark.parametrize(
    ("model", "source", "suitability", "rank"),
    [
        pytest.param("stereo", "kitti360:{}/kitti360?camera=image_00", "good", 0.90, marks=pytest.mark.slow),
        pytest.param(
            "tcsmallnet_dyn.onnx",
            "kitti360:{}/kitti360?camera=image_00",
            "usable_in_fused",
            0.90,
            marks=pytest.mark.slow,
        ),
        ("meter_xxs_kitti_192x640.onnx", "{}/fisheye_garage/dataset.yaml", "do_not_use", 0.08),
    ],
)
def test_verdicts_on_recordings(
    coec: Coec, sample_data: Path, model: str, source: str, suitability: str, rank: float
) -> None:
    path = model if model == "stereo" else sample_data / "depth" / model
    outcome = coec("models", "assess", path, source.format(sample_data), "--json")
    assert outcome.document["suitability"] == suitability
    assert outcome.document["rank_correlation"] == pytest.approx(rank, abs=0.02)
    assert outcome.status == (1 if suitability == "do_not_use" else 0)
