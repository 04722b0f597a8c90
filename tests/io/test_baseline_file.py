"""`rig.json`: what is written reads back to the same bits, and nothing damaged is read."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from coec.config import StateConfig
from coec.errors import StateError
from coec.io.rig_files import (
    baseline_from_json,
    baseline_hash,
    baseline_of_rig,
    baseline_to_json,
    load_baseline,
    save_baseline,
)
from support.estimates import a_baseline
from support.scenes import BOARD_LENSES, board_rig


def assert_same(a: object, b: object) -> None:
    """Equal to the bit, NaN included."""
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray)
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


def test_reads_back_to_the_same_bits(tmp_path: Path) -> None:
    path = tmp_path / "state" / "rig.json"
    written = save_baseline(path, a_baseline())
    read = load_baseline(path, "front")
    assert read is not None
    assert_same(read, a_baseline())
    assert baseline_hash(read) == written


def test_holds_a_baseline_for_every_pair(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    save_baseline(path, a_baseline())
    save_baseline(path, replace(a_baseline(), pair="rear", pairs=7))
    save_baseline(path, replace(a_baseline(), pairs=99))
    front, rear = load_baseline(path, "front"), load_baseline(path, "rear")
    assert front is not None
    assert rear is not None
    assert (front.pairs, rear.pairs) == (99, 7)


def test_absent(tmp_path: Path) -> None:
    assert load_baseline(tmp_path / "rig.json", "front") is None
    save_baseline(tmp_path / "rig.json", a_baseline())
    assert load_baseline(tmp_path / "rig.json", "left") is None


@pytest.mark.fault("a digit of a commissioned baseline changed", "it is refused by its checksum")
def test_a_flipped_digit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    save_baseline(path, a_baseline())
    path.write_bytes(path.read_bytes().replace(b"1234.5", b"1235.5", 1))
    with pytest.raises(StateError, match="does not match its checksum; commission again"):
        load_baseline(path, "front")


def test_another_content_has_another_hash() -> None:
    assert baseline_hash(a_baseline()) != baseline_hash(replace(a_baseline(), pairs=41))


def test_an_incomplete_document_is_refused() -> None:
    document = baseline_to_json(a_baseline())
    del document["monitor"]
    with pytest.raises(StateError, match="monitor"):
        baseline_from_json(document)


def test_a_matrix_that_is_not_rigid_is_refused() -> None:
    document = baseline_to_json(a_baseline())
    document["T_camera_lidar"][0][0] = 3.0
    with pytest.raises(StateError, match="not a rigid transform"):
        baseline_from_json(document)


@pytest.mark.fault(
    "a forged baseline with the right checksum", "it is refused where its form is not what the monitor compares"
)
@pytest.mark.parametrize(("part", "short"), [("gradient", [[1.0], []]), ("bands", [1.0]), ("sectors", [])])
def test_a_scene_of_other_parts_than_the_monitor_checks_is_refused(part: str, short: object) -> None:
    document = baseline_to_json(a_baseline())
    document["scene"][part] = short
    with pytest.raises(StateError, match=part):
        baseline_from_json(document)


class TestOfModel:
    rig = board_rig(BOARD_LENSES["pinhole"])

    def test_a_rig_that_is_not_commissioned_starts_from_its_model(self, tmp_path: Path) -> None:
        save_baseline(tmp_path / "model.json", a_baseline())
        taken = baseline_of_rig(self.rig, StateConfig(directory=tmp_path / "state", model=tmp_path / "model.json"))
        assert taken is not None
        assert taken.limits == a_baseline().limits
        np.testing.assert_array_equal(taken.T_camera_lidar, self.rig.T_camera_lidar_nominal)

    def test_its_own_comes_first(self, tmp_path: Path) -> None:
        save_baseline(tmp_path / "model.json", a_baseline())
        own = replace(a_baseline(), limits={"min_edge_contrast": 7.0})
        save_baseline(tmp_path / "rig.json", own)
        taken = baseline_of_rig(self.rig, StateConfig(directory=tmp_path, model=tmp_path / "model.json"))
        assert taken is not None
        assert_same(taken, own)

    def test_there_is_none_where_none_is_named(self, tmp_path: Path) -> None:
        assert baseline_of_rig(self.rig, StateConfig(directory=tmp_path)) is None

    def test_a_model_that_knows_nothing_of_the_pair_is_reported(self, tmp_path: Path) -> None:
        save_baseline(tmp_path / "model.json", replace(a_baseline(), pair="rear"))
        with pytest.raises(StateError, match=r"state\.model.*no baseline of the pair front"):
            baseline_of_rig(self.rig, StateConfig(directory=tmp_path, model=tmp_path / "model.json"))
