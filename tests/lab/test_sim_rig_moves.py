"""`coec sim rig-moves`: from its words to its tables."""

from __future__ import annotations

import pytest

from cli.conftest import Coec
from coec_lab.experiments import rig_moves
from coec_lab.experiments.rig_evidence import FOUR
from coec_lab.experiments.rig_moves import RigFault
from coec_lab.experiments.simulation_schemas import RigMovesReport


def test_a_displaced_camera_is_named_on_rendered_drives_and_reported_in_tables(
    coec: Coec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig_moves, "FAULTS", ((FOUR, RigFault("one camera 1°", cameras=1)),))
    outcome = coec("sim", "rig-moves", "--drives", 1, "--rigs", 1, "--json")
    report = RigMovesReport.model_validate(outcome.document)
    assert (report.moves[0].right, report.moves[0].undecided, report.moves[0].wrong) == (1, 0, 0)
    assert report.joint[1].rms_ratio_all < 0.9
    assert report.joint[1].biased_found == 1
    star = report.knocked[0]
    assert star.worst_deg < star.worst_of_pairs_deg
    assert star.rms_ratio_without == pytest.approx(1.0, abs=0.02), "alone, a star closes no loop"
    assert star.consistent == 1
    monkeypatch.setattr(rig_moves, "report", lambda *_: report)
    assert "windows combined" in coec("sim", "rig-moves", "--rigs", 1).out
