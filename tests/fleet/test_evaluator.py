"""Where a window is judged: the vehicle's decision to the byte, or a row that says why not."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from coec.config import CalibrationConfig
from coec.errors import ConfigError, UsageError
from coec.fleet.evaluator import ReplaySettings, WindowEvaluator, load_settings
from coec.fleet.jobs import Job
from coec.io.mcap.windows import read_result, read_vehicle
from coec.schemas.message import to_json
from support.fleet import WINDOW_CONFIGURATION


@pytest.fixture
def window(recorded: Path) -> Path:
    return recorded / "one" / "one-1.mcap"


def test_the_decision_is_that_of_the_vehicle_to_the_byte(window: Path) -> None:
    row = WindowEvaluator(ReplaySettings()).row(Job(str(window)))
    result = read_result(window)
    assert result is not None
    assert row.result is not None
    assert to_json(row.result) == to_json(result)
    assert row.decided == row.recorded == hashlib.sha256(to_json(result)).hexdigest()
    assert (row.vehicle, row.error) == ("one", None)
    assert row.sha256 == hashlib.sha256(window.read_bytes()).hexdigest()
    assert row.bytes == window.stat().st_size
    assert row.seconds > 0.0
    assert set(row.versions) == {"coec", "numpy", "numba", "nlopt", "onnxruntime"}


def test_a_window_says_whose_it_is_without_a_result(window: Path) -> None:
    assert read_vehicle(window) == "one"


def test_another_configuration_decides_for_the_pair_that_it_names_or_for_all_if_it_names_one(window: Path) -> None:
    other = WINDOW_CONFIGURATION.model_copy(update={"motion_compensation": False})
    bench = WindowEvaluator(ReplaySettings(calibrations={"elsewhere": other}, any_pair=other))
    row = bench.row(Job(str(window)))
    assert row.result is not None
    assert row.decided != row.recorded
    assert row.result.compensation["disabled"] == row.result.pairs


def test_a_configuration_that_does_not_know_the_pair_is_an_error_of_the_window(window: Path) -> None:
    bench = WindowEvaluator(ReplaySettings(calibrations={"left": CalibrationConfig(), "right": CalibrationConfig()}))
    row = bench.row(Job(str(window)))
    assert row.error_code == ConfigError.reply_code
    assert "left, right" in str(row.error)


def test_another_rig_decides_for_its_pair(window: Path, tmp_path: Path) -> None:
    from coec.io.mcap.windows import read_window
    from coec.io.rig_files import rig_to_json

    rig = read_window(window)[0].rig
    document = rig_to_json(rig)
    document["camera"]["cx"] += 3.0
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(document))
    row = WindowEvaluator(load_settings(None, path, None)).row(Job(str(window)))
    assert row.result is not None
    assert row.decided != row.recorded

    path.write_text(json.dumps({**document, "pair": "another"}))
    same = WindowEvaluator(load_settings(None, path, None)).row(Job(str(window)))
    assert same.decided == same.recorded


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"rig": 3}', "[" * 100_000, "9" * 5000])
@pytest.mark.fault("an invalid rig in a file", "the message says what is wrong with it")
def test_a_rig_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "rig.json"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"rig\.json"):
        load_settings(None, path, None)


@pytest.mark.fault(
    "a window of a batch that does not match its stated hash, is missing, or is damaged", "a row with its error"
)
def test_what_cannot_be_judged_is_a_row(window: Path, tmp_path: Path) -> None:
    whole = window.read_bytes()
    cut, flipped = tmp_path / "cut.mcap", tmp_path / "flipped.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    flipped.write_bytes(whole[:4000] + bytes([whole[4000] ^ 1]) + whole[4001:])
    bench = WindowEvaluator(ReplaySettings())
    codes = {
        job.url: bench.row(job).error_code
        for job in (
            Job(str(window), sha256="0" * 64),
            Job(str(cut)),
            Job(str(flipped)),
            Job(str(tmp_path / "absent.mcap")),
            Job(str(tmp_path)),
            Job("nowhere://host/window.mcap"),
        )
    }
    assert list(codes.values()) == ["bad_source", "bad_window", "bad_window", "bad_source", "bad_source", "bad_request"]
    # Nothing of it stays with the desk.
    assert bench.row(Job(str(window), sha256=hashlib.sha256(whole).hexdigest())).error is None


def test_a_fault_of_ours_is_a_row_as_well(window: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("no such thing")

    monkeypatch.setattr("coec.fleet.evaluator.calibrate", broken)
    row = WindowEvaluator(ReplaySettings()).row(Job(str(window)))
    assert (row.error_code, row.error) == ("internal", "ZeroDivisionError: no such thing")
    assert row.sha256 is not None
