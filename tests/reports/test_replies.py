"""Replies in words: what somebody who looks after the service must not overlook."""

from __future__ import annotations

from typing import Literal

import pytest

from coec.reports import console, replies
from coec.schemas.message import to_json
from coec.schemas.replies import (
    BudgetShare,
    BudgetStatus,
    ChainedEntry,
    ConfigurationStatus,
    HistoryEntry,
    HistoryReply,
    PairStatus,
    StreamStatus,
)
from coec.schemas.rig_state import RigReply
from service.api.test_metrics import a_busy_status
from support.messages import joint_reply, moved_lidar_reply, reply_before_checks


@pytest.mark.parametrize(
    ("reported", "line"),
    [
        ({"refused": "no pairs"}, "the configuration on the disk was refused: no pairs"),
        ({"waiting": ("vehicle", "worker.threads")}, "waits for a restart: vehicle, worker.threads"),
    ],
)
def test_a_configuration_that_is_not_in_force_is_reported(
    capsys: pytest.CaptureFixture[str], reported: dict[str, object], line: str
) -> None:
    configuration = ConfigurationStatus.model_validate({"read_ns": 1, **reported})
    replies.status(to_json(a_busy_status()))
    assert line not in capsys.readouterr().out
    replies.status(to_json(a_busy_status().model_copy(update={"configuration": configuration})))
    assert line in capsys.readouterr().out


@pytest.mark.fault("a budget that does not suffice", "`coec query status` says by how much, and who waits")
@pytest.mark.parametrize(
    ("status", "message"),
    [
        (None, "no attempt yet"),
        ("not_accepted", "no attempt yet"),
        ("accepted", "latest attempt accepted"),
        ("failed", "latest attempt failed"),
    ],
)
def test_before_the_first_attempt_none_is_called_not_accepted(status: str | None, message: str) -> None:
    assert str(console.attempt(status)) == message


def history_of(*entries: tuple[int, Literal["estimate", "state"], str]) -> bytes:
    chained = tuple(
        ChainedEntry(
            sha256=64 * "a",
            entry=HistoryEntry(
                sequence=number, previous_sha256=64 * "0", kind=kind, code=code, text="A sentence.", wall_ns=0
            ),
        )
        for number, kind, code in entries
    )
    return to_json(HistoryReply(vehicle="v", pair="front", total=1, results=(), entries=chained))


def test_every_entry_of_the_history_has_its_number(capsys: pytest.CaptureFixture[str]) -> None:
    replies.history(history_of((0, "state", "healthy"), (1, "estimate", "accepted"), (2, "state", "suspect")))
    out = capsys.readouterr().out
    assert "0 of 1 result\n" in out
    assert [line.split()[0] for line in out.splitlines() if "A sentence." in line] == ["0", "1", "2"]
    assert "Missing numbers" not in out


def test_numbers_that_are_missing_from_the_history_are_explained(capsys: pytest.CaptureFixture[str]) -> None:
    replies.history(history_of((0, "state", "healthy"), (7, "state", "suspect")))
    assert "Missing numbers are entries" in capsys.readouterr().out


def test_a_budget_that_does_not_suffice_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    share = BudgetShare(look_s=1.0, window_s=None, unseen_s=7.0, suspected=False, waiting=True, active=True)
    budget = BudgetStatus(
        cores=0.5, spent=0.5, wanted=0.8, stretched_by=1.6, in_store_s=0.0, spent_s={}, pairs={"front": share}
    )
    replies.status(to_json(a_busy_status().model_copy(update={"budget": budget})))
    message = " ".join(capsys.readouterr().out.split())
    assert "budget 0.5 of a core; 0.50 spent, 0.80 wanted" in message
    assert "1.6 times as far apart as configured; waiting: front" in message
    enough = budget.model_copy(update={"wanted": 0.3, "stretched_by": 1.0})
    replies.status(to_json(a_busy_status().model_copy(update={"budget": enough})))
    assert "suffice" not in capsys.readouterr().out


@pytest.mark.fault(
    "24 pairs of eight cameras and three LiDARs", "`coec query status` is a screen, and says where what is lost"
)
def test_the_status_of_many_pairs_is_reported_once(capsys: pytest.CaptureFixture[str]) -> None:
    cameras = [
        StreamStatus(received=9, accepted=9 - (n == 3), losses={"overrun": 1} if n == 3 else {}) for n in range(8)
    ]
    pairs = tuple(
        PairStatus(name=f"c{camera}-l{lidar}", camera=cameras[camera], checks=7, losses={"not_awaited": camera + 1})
        for camera in range(8)
        for lidar in range(3)
    )
    share = BudgetShare(look_s=1.0, window_s=None, unseen_s=7.0, suspected=False, waiting=True, active=True)
    shares = {pair.name: share.model_copy(update={"suspected": pair.name == "c3-l0"}) for pair in pairs}
    budget = BudgetStatus(cores=0.5, spent=0.5, wanted=0.8, stretched_by=1.6, in_store_s=0.0, spent_s={}, pairs=shares)
    status = a_busy_status().model_copy(update={"pairs": pairs, "budget": budget})
    replies.status(to_json(status))
    message = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in message.splitlines()]
    assert "lost, camera: 1 overrun in c3-l0, c3-l1, c3-l2" in lines
    assert "lost, windows: up to 8 not_awaited in c7-l0, c7-l1, c7-l2 and 21 more" in lines
    assert "waiting: c0-l0, c0-l1, c0-l2 and 21 more" in " ".join(lines)
    assert any(line.startswith("c3-l0 7 suspected") for line in lines)
    assert any(line.startswith("c3-l1 7 waits") for line in lines)
    assert len(lines) < 50, "a screen of a terminal"


def reported_of_rig(capsys: pytest.CaptureFixture[str], reply: RigReply) -> str:
    replies.rig(to_json(reply))
    return " ".join(capsys.readouterr().out.split())


def test_of_a_rig_it_is_reported_who_moved_and_in_which_pairs_it_was_put_right(
    capsys: pytest.CaptureFixture[str],
) -> None:
    message = reported_of_rig(capsys, moved_lidar_reply())
    assert "shuttle-7 by all that was seen until" in message
    assert "lidar_moved" in message
    assert "99.8" in message
    assert "last put right: roof, in front, left, since" in message
    assert "last moved: roof by 1.00°, named at 8.000 s, over since 9.000 s" in message
    assert "left (by the others)" in message, "which pair has no window of its own"
    assert "+1.250 ± 0.050" in message
    assert "the pairs do not fit each other: χ² 55.0 at 6 degrees of freedom, p 1e-06" in message
    assert "does not close: front, left, bar: 0.80°, 5.0 cm" in message
    assert "late" in message


def test_of_a_rig_that_fits_no_loop_is_called_open(capsys: pytest.CaptureFixture[str]) -> None:
    message = reported_of_rig(
        capsys, moved_lidar_reply(joint=joint_reply(consistent=True, open_loops=(), chi2=4.0, p_value=0.7))
    )
    assert "the pairs fit each other: χ² 4.0 at 6 degrees of freedom, p 0.7" in message
    assert "does not close" not in message
    without = reported_of_rig(capsys, moved_lidar_reply(joint=joint_reply(freedom=0, open_loops=())))
    assert "fit each other" not in without, "nothing closes a loop: nothing is said of it"


def test_of_a_rig_that_nobody_checked_no_figure_is_made_up(capsys: pytest.CaptureFixture[str]) -> None:
    message = reported_of_rig(capsys, reply_before_checks())
    reason = "one_pair: One pair cannot distinguish a move of its camera from one of its LiDAR."
    assert f"shuttle-7 nothing was looked at yet {reason}" in message
    assert "unknown" in message
    assert "put right" not in message
    assert "1970" not in message
