"""`coec lidars`: where one LiDAR of a vehicle sits from another."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cli.conftest import Coec
from support.recordings import Bag, drive_messages

pytest.importorskip("embreex", reason="needs embreex")

RIG = "sim:rig=four-fisheyes&seed=61&seconds=3&camera=fisheye32&start_m=40"
HAS_SEARCH = importlib.util.find_spec("small_gicp") is not None
needs_search = pytest.mark.skipif(not HAS_SEARCH, reason="needs the optional extra `lidars`")


@needs_search
@pytest.mark.fault("a LiDAR is knocked by 1°", "the edge to another LiDAR shows it, with its size")
def test_a_displaced_lidar_is_reported_by_its_size(coec: Coec, record_property: Callable[[str, object], None]) -> None:
    outcome = coec("lidars", f"{RIG}&faults=near_left:step:0:rz=1", "roof", "near_left", "--pairs", 4, "--json")
    assert outcome.status == 0, outcome.err
    reported = outcome.document
    result_deg = float(np.linalg.norm(reported["correction"][:3]))
    record_property("figure", f"{result_deg:.2f}°")
    assert result_deg == pytest.approx(1.0, abs=0.15)
    assert np.abs(np.array(reported["error"]) / reported["sigma"]).max() < 4.0
    assert np.abs(reported["error"][:3]).max() < 0.15
    assert result_deg > 6.0 * max(reported["sigma"][:3])
    assert reported["reasons"] == []


@needs_search
def test_lidars_that_see_nothing_in_common_say_so(coec: Coec) -> None:
    source = f"{RIG}&faults=near_left:beams:0:share=0.97"
    outcome = coec("lidars", source, "roof", "near_left", "--pairs", 1)
    assert outcome.status == 1
    assert "overlap too little" in outcome.out
    assert "sigma" in outcome.out


@needs_search
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((RIG, "roof", "roof"), "name two LiDARs"),
        ((RIG, "roof", "front"), "no LiDAR front; it has roof, near_left, near_right"),
        ((f"{RIG}&pair=front-roof", "roof", "near_left"), "without `pair`"),
    ],
)
def test_what_does_not_fit_is_refused(coec: Coec, arguments: tuple[str, ...], message: str) -> None:
    outcome = coec("lidars", *arguments)
    assert outcome.status == 2
    assert message in outcome.err


@needs_search
def test_a_bag_without_the_topic_names_those_that_it_has(coec: Coec, tmp_path: Path) -> None:
    bag = Bag(drive_messages()).write(tmp_path / "b.mcap")
    outcome = coec("lidars", bag, "/points", "/others")
    assert outcome.status == 1
    assert "no topic /others for points; there: /points" in outcome.err


def test_without_the_extra_it_says_what_to_install(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    outcome = coec("lidars", RIG, "roof", "near_left")
    assert outcome.status == 1
    assert "pip install 'coec[lidars]'" in outcome.err
