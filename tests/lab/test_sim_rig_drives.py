"""`coec sim rig-drives`: from its words to its tables."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("embreex", reason="needs embreex")

from cli.conftest import Coec
from coec_lab.experiments import rig_drives
from coec_lab.experiments.rig_drives import FIRST_SEED, DisplacedRigDrive
from coec_lab.experiments.simulation_schemas import RigDriveRow, RigDrivesReport


def test_what_was_rendered_is_retained_and_what_is_damaged_is_rendered_again(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered: list[str] = []

    def driven(drive: DisplacedRigDrive) -> RigDriveRow:
        rendered.append(drive.name)
        return RigDriveRow(name=drive.name, seed=FIRST_SEED + drive.number, camera=drive.camera)

    monkeypatch.setattr(rig_drives, "driven", driven)
    text = ("sim", "rig-drives", "--output", tmp_path, "--camera", "fisheye128", "--jobs", 1)
    report = RigDrivesReport.model_validate(coec(*text, "--drives", 1, "--json").document)
    assert report.drives == 1
    assert [(row.fault, row.right, row.undecided, row.wrong) for row in report.moves] == [
        ("nobody", 1, 0, 0), ("one camera 1°", 0, 1, 0), ("the LiDAR 1°", 0, 1, 0), ("two cameras 1°", 0, 1, 0)
    ]  # fmt: skip
    reported = coec(*text, "--drives", 2).out
    assert "roof not named" in reported
    assert len(rendered) == 2, "the first was kept"
    (tmp_path / "drives" / f"{rendered[0]}.json").write_text("{")
    assert coec(*text, "--drives", 2).status == 0
    assert rendered == [rendered[0], rendered[1], rendered[0]]
