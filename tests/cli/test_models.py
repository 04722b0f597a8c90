"""`coec models`."""

from __future__ import annotations

from pathlib import Path

from cli.conftest import Coec


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
