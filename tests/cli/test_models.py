"""`coec models`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cli.conftest import SMALL, Coec
from coec.schemas.evaluation import ModelAssessment


def test_lists_the_cards_of_the_contract(coec: Coec) -> None:
    names = {card["name"] for card in coec("models", "--json").document["models"]}
    assert {"dpt_beit_large_512", "midas_small", "tcmonodepth_small", "meter_xxs_kitti"} <= names
    assert "dpt_beit_large_512" in coec("models").out


def test_shows_the_card_that_a_file_is_recognised_by(coec: Coec, sample_data: Path) -> None:
    outcome = coec("models", "show", sample_data / "depth" / "tcsmallnet_dyn.onnx", "--json")
    assert outcome.document["card"]["name"] == "tcmonodepth_small"


def test_unknown_file_has_no_card(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "mystery.onnx"
    path.write_bytes(b"nothing known")
    outcome = coec("models", "show", path)
    assert outcome.status == 1
    assert "no model card" in outcome.err


def test_other_words_are_a_usage_error(coec: Coec) -> None:
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


def test_assessment_in_words(coec: Coec) -> None:
    outcome = coec("models", "assess", "stereo", SMALL, "--frames", "2")
    assert "good: plain mutual information finds the calibration with it" in outcome.out
    assert "rank correlation with inverse range" in outcome.out
    assert not outcome.err


@pytest.mark.parametrize(
    ("model", "source", "suitability", "rank"),
    [
        ("stereo", "kitti360:{}/kitti360?camera=image_00", "good", 0.90),
        ("tcsmallnet_dyn.onnx", "kitti360:{}/kitti360?camera=image_00", "usable_in_fused", 0.90),
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
