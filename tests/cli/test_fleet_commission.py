"""`coec fleet commission`: the baselines of vehicles become that of their model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli.conftest import Coec
from coec.io.rig_files import load_baseline, save_baseline
from support.estimates import a_baseline


@pytest.fixture
def rigs(tmp_path: Path) -> list[Path]:
    paths = []
    for number in range(3):
        path = tmp_path / f"vehicle-{number}" / "rig.json"
        one = a_baseline()
        moved = replace(one.pose, bias=one.pose.bias + 0.001 * np.arange(6) * number)
        save_baseline(path, replace(one, pose=moved))
        paths.append(path)
    return paths


def test_writes_the_baseline_of_the_model(coec: Coec, rigs: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "model.json"
    outcome = coec("fleet", "commission", *rigs, "--output", output, "--json")
    assert outcome.status == 0
    assert outcome.document["vehicles"] == 3
    model = load_baseline(output, "front")
    assert model is not None
    assert model.pose.bias[5] == pytest.approx(0.001 + 0.005)
    shown = coec("fleet", "commission", *rigs, "--output", output)
    assert "front: 3 vehicles, 120 pairs of 6 windows" in shown.out


def test_what_cannot_be_used_is_reported(coec: Coec, rigs: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "model.json"
    for named, says in (
        ([*rigs, rigs[0]], "named twice"),
        ([*rigs, tmp_path / "nothing.json"], "holds no baseline"),
        (rigs[:2], "at least 3 vehicles"),
    ):
        outcome = coec("fleet", "commission", *named, "--output", output)
        assert outcome.status != 0
        assert says in outcome.err
    assert not output.exists()
