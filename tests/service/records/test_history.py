"""The books of a pair: what one holds, no other can push out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.errors import StateError
from coec.io.serialise import result_of, transform_of
from coec.io.storage import StateFile
from coec.schemas.replies import CalibrationResult, HistoryEntry
from coec.service.records.history import PairHistory
from support.disk import EVERY_OPERATION, Disk
from support.estimates import ESTIMATE_RIG, estimate

LIMIT = 4


def entry(kind: str, code: str = "", **fields: Any) -> HistoryEntry:
    return HistoryEntry.model_validate(
        {"sequence": 0, "previous_sha256": "", "kind": kind, "code": code, "text": "", "wall_ns": 1, **fields}
    )


def solved(history: PairHistory, window: int) -> CalibrationResult:
    result = result_of(estimate(window), ESTIMATE_RIG, "test")
    history.append(entry("estimate", "accepted", window_id=result.window_id), result)
    return result


def filled(folder: Path) -> tuple[PairHistory, CalibrationResult]:
    history = PairHistory(folder, "front", LIMIT, {})
    result = solved(history, 1)
    history.append(
        entry("extrinsic", "estimated", window_id=result.window_id, camera_from_lidar=result.camera_from_lidar)
    )
    history.flush()
    return history, result


@pytest.mark.fault("thousands of commands in the history", "no result that `rollback` needs is pushed out")
@pytest.mark.parametrize(
    "flood",
    [
        entry("command", "held"),
        entry("state", "suspect"),
        entry("extrinsic", "nominal", camera_from_lidar=transform_of(np.eye(4))),
        entry("extrinsic", "restored", camera_from_lidar=transform_of(np.eye(4)), window_id="1"),
        entry("commissioned", "commissioned"),
    ],
    ids=lambda one: f"{one.kind}-{one.code}",
)
def test_no_flood_pushes_a_result_or_what_it_put_in_place_out(tmp_path: Path, flood: HistoryEntry) -> None:
    history, result = filled(tmp_path)
    for _ in range(5 * LIMIT):
        history.append(flood)
    history.flush()
    for one in (history, PairHistory(tmp_path, "front", LIMIT, history.durable_heads())):
        assert one.damage is None
        assert one.results() == (result,)
        assert [retained.entry.code for retained in one.entries()] == ["accepted", "estimated", *[flood.code] * LIMIT]


def test_a_window_that_is_solved_again_and_again_displaces_no_other(tmp_path: Path) -> None:
    history, result = filled(tmp_path)
    for _ in range(5 * LIMIT):
        again = solved(history, 2)
        history.append(
            entry("extrinsic", "estimated", window_id=again.window_id, camera_from_lidar=again.camera_from_lidar)
        )
    assert history.results()[0] == result
    assert next(one.entry.window_id for one in history.entries() if one.entry.kind == "extrinsic") == result.window_id


def test_entries_are_numbered_together_in_the_order_in_which_they_arrived(tmp_path: Path) -> None:
    kinds = ["command", "state", "command", "commissioned", "state"]
    history, _ = filled(tmp_path)
    for kind in kinds[:3]:
        history.append(entry(kind))
    history.flush()
    history = PairHistory(tmp_path, "front", LIMIT, history.durable_heads())
    for kind in kinds[3:]:
        history.append(entry(kind))
    reported = [(retained.entry.sequence, retained.entry.kind) for retained in history.entries()]
    assert reported == list(enumerate(["estimate", "extrinsic", *kinds]))


@pytest.mark.parametrize("book", ["history", "commands", "states"])
def test_a_book_that_was_cut_or_removed_is_noticed(tmp_path: Path, book: str) -> None:
    history, _ = filled(tmp_path)
    for kind in ("state", "command"):
        history.append(entry(kind))
    history.flush()
    (tmp_path / f"{book}-front.jsonl").unlink()
    assert "cut off" in str(PairHistory(tmp_path, "front", LIMIT, history.durable_heads()).damage)


@pytest.mark.fault("a forged pose in the history, hashes right", "it is damage, and not used")
def test_a_forged_pose_in_a_book_is_damage_whatever_its_hash(tmp_path: Path) -> None:
    history, result = filled(tmp_path)
    zero = transform_of(np.eye(4)).model_copy(update={"matrix": ((0.0,) * 4,) * 4})
    history.append(entry("extrinsic", "estimated", window_id=result.window_id, camera_from_lidar=zero))
    history.flush()
    again = PairHistory(tmp_path, "front", LIMIT, {})
    assert again.damage is not None
    assert [retained.entry.code for retained in again.entries()] == ["accepted", "estimated"]


@pytest.mark.fault("a full disk under all three books of the history", "each waits, and is written when there is room")
def test_every_book_waits_for_a_full_disk_and_is_written_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(tmp_path, monkeypatch)
    history, _ = filled(tmp_path)
    disk.refuses = EVERY_OPERATION
    for kind in ("state", "command"):
        history.append(entry(kind))
    with pytest.raises(StateError, match=r"No space.*commands-front\.jsonl: No space"):
        history.flush()
    disk.refuses = ()
    history.flush()
    state = StateFile(tmp_path / "state.json")
    state.save({"heads": history.durable_heads()})
    body = StateFile(tmp_path / "state.json").load().body
    assert body is not None
    again = PairHistory(tmp_path, "front", LIMIT, body["heads"])
    assert again.damage is None
    assert again.entries() == history.entries()
