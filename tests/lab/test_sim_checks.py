"""`coec sim checks`: what is done stays done, and one drive from its words to its row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

pytest.importorskip("embreex", reason="needs embreex")

from cli.conftest import Coec
from coec_lab.experiments import check_drives
from coec_lab.experiments.check_drives import CheckDrive
from coec_lab.experiments.simulation_schemas import CheckedDrive
from lab.experiments.test_check_statistics import driven, judged


def test_a_drive_that_has_a_result_is_not_checked_again(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked: list[str] = []

    def run(drives: Sequence[CheckDrive], baselines: Mapping[str, object]) -> list[CheckedDrive]:
        assert not any(baselines.values())
        checked.extend(drive.name for drive in drives)
        return [
            driven(drive.place, drive.seed, (judged(0.0),), (judged(1.0),)).model_copy(update={"name": drive.name})
            for drive in drives
        ]

    monkeypatch.setattr(check_drives, "PLACES", {"street": "", "highway": "scene=highway"})
    monkeypatch.setattr(check_drives, "run", run)
    monkeypatch.setattr(check_drives, "commissioned", lambda _: None)
    first = coec("sim", "checks", "--output", tmp_path, "--rounds", 1, "--jobs", 1, "--hours", 0.1, "--json")
    assert (first.status, first.document["drives"], len(checked)) == (0, len(checked), len(set(checked)))
    (tmp_path / "drives" / f"{checked[0]}.json").write_text("half of a fi")
    again = coec("sim", "checks", "--output", tmp_path, "--rounds", 1, "--jobs", 1, "--hours", 0.1)
    assert checked[-1] == checked[0]  # the damaged one
    assert len(checked) == first.document["drives"] + 1
    assert "resampled" in again.out


def test_a_single_observation_of_a_highway_is_faint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where guard rails, markings and horizon fit nearly as well most of a degree beside."""
    monkeypatch.setitem(check_drives.RIGS, "wide", "lidar=64&camera=pinhole640x400")
    monkeypatch.setattr(check_drives, "CHECKS", 1)
    (row,) = check_drives.run([CheckDrive("wide", "highway", 700_001)], {})
    assert row.failure is None
    assert row.poses[0].moved == check_drives.RIGHT
    (check,) = row.poses[0].uncommissioned
    assert (check.faint, check.causes) == (("looks",), ())  # one frame says what the other says


def test_a_drive_that_cannot_be_rendered_is_a_row_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(check_drives.RIGS, "box", "camera=box")
    (row,) = check_drives.run([CheckDrive("box", "street", 1)], {})
    assert row.failure is not None
    assert "unknown camera 'box'" in row.failure
