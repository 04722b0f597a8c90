"""`coec sim matrix`: what is done stays done, and one drive from its words to its row."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import pytest

pytest.importorskip("embreex", reason="needs embreex")

from cli.conftest import Coec
from coec_lab.experiments import matrix_drives
from coec_lab.experiments.matrix_drives import MatrixDrive, Settings
from coec_lab.experiments.simulation_schemas import MatrixRow
from lab.experiments.test_matrix import row, solved, watch

PAIR = "street_wide_64_day_*_s1"


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the drives that are run, in place of running them."""
    names: list[str] = []

    def run(drive: MatrixDrive, settings: Settings) -> MatrixRow:
        names.append(drive.name)
        windows = {str(dof): (solved(), solved(accepted=False, reasons=("runner_up",))) for dof in settings.dofs}
        made = row(drive.name, watched=(watch("right", 0), watch("1 deg", 1, flagged=4, delay=3)))
        return made.model_copy(update={"settings": settings.fingerprint, "windows": windows})

    monkeypatch.setattr(matrix_drives, "run", run)
    return names


def test_a_drive_that_has_a_result_is_not_run_again(coec: Coec, tmp_path: Path, ran: list[str]) -> None:
    selected = [drive.name for drive in matrix_drives.selected_drives(1, PAIR)]
    first = coec("sim", "matrix", "--output", tmp_path, "--only", PAIR, "--dof", 3, "--jobs", 1, "--json")
    assert (first.status, ran, first.document["drives"]) == (0, selected, len(selected))
    assert (tmp_path / "normalised.png").read_bytes()[:4] == b"\x89PNG"
    (tmp_path / "drives" / f"{selected[0]}.json").write_text("half of a fi")
    again = coec("sim", "matrix", "--output", tmp_path, "--only", PAIR, "--dof", 3, "--jobs", 1, "--json")
    assert ran[len(selected) :] == selected[:1]  # the damaged one
    assert again.document == first.document
    other = coec("sim", "matrix", "--output", tmp_path, "--only", PAIR, "--frames", 7, "--dof", 3, "--jobs", 1)
    assert ran[len(selected) + 1 :] == selected  # another question
    assert f"{selected[0]}" in other.out
    assert "refused hit: runner_up" in other.out
    assert "accepted and wrong" in other.out


def test_what_does_not_fit_is_refused(coec: Coec, tmp_path: Path) -> None:
    outcome = coec("sim", "matrix", "--output", tmp_path, "--only", "moon*")
    assert (outcome.status, "street_fisheye_64_day_none_s1" in outcome.err) == (2, True)


@pytest.mark.parametrize("dofs", [(3,), pytest.param((3, 6), marks=pytest.mark.slow)])
def test_a_drive_is_rendered_solved_and_watched(monkeypatch: pytest.MonkeyPatch, dofs: tuple[int, ...]) -> None:
    monkeypatch.setitem(matrix_drives.LENSES, "tiny", "camera=pinhole240x120")
    settings = Settings(dofs, 2, "stereo")
    drive = MatrixDrive("room-empty", "tiny", "32", "day", "none", matrix_drives.FIRST_SEED)
    result = matrix_drives.run(drive, settings)
    assert result.failure is None
    assert {key: len(windows) for key, windows in result.windows.items()} == {str(dof): 2 for dof in dofs}
    for window in chain.from_iterable(result.windows.values()):
        assert window.pairs == 2
        assert 2.0 <= window.start_deg <= 10.0
        assert window.failure is not None or window.evaluations > 0
    assert [(watched.moved, watched.checks) for watched in result.watched] == [
        ("right", 1),
        ("0.5 deg", 1),
        ("1 deg", 1),
    ]


def test_a_drive_that_cannot_be_rendered_is_a_row_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(matrix_drives.LENSES, "box", "camera=box")
    drive = MatrixDrive("street", "box", "32", "day", "none", matrix_drives.FIRST_SEED)
    result = matrix_drives.run(drive, Settings((3,), 2, "stereo"))
    assert result.failure is not None
    assert "unknown camera 'box'" in result.failure
    assert result.windows == {}


@pytest.mark.slow
def test_several_processes_give_the_rows_of_one(coec: Coec, tmp_path: Path) -> None:
    text = ("--only", "room-empty_*", "--frames", 2, "--dof", 3, "--json")
    one, two = (
        coec("sim", "matrix", "--output", tmp_path / str(jobs), "--jobs", jobs, *text).document for jobs in (1, 2)
    )
    assert one["drives"] == 2
    for row_of_one, row_of_two in zip(one["rows"], two["rows"], strict=True):
        assert row_of_one | {"cpu_s": 0.0} == row_of_two | {"cpu_s": 0.0}
