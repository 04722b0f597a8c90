"""Replies in words: what somebody who looks after the service must not overlook."""

from __future__ import annotations

import pytest

from coec.reports import replies
from coec.schemas.base import to_json
from coec.schemas.replies import BudgetShare, BudgetStatus, ConfigurationStatus
from coec.schemas.rig_state import RigReply
from rig_replies import joint, knocked, untold
from runtime.api.test_metrics import a_busy_status


@pytest.mark.parametrize(
    ("told", "line"),
    [
        ({"refused": "no pairs"}, "the configuration on the disk was refused: no pairs"),
        ({"waiting": ("vehicle", "worker.threads")}, "waits for a restart: vehicle, worker.threads"),
    ],
)
def test_a_configuration_that_is_not_in_force_is_said(
    capsys: pytest.CaptureFixture[str], told: dict[str, object], line: str
) -> None:
    configuration = ConfigurationStatus.model_validate({"read_ns": 1, **told})
    replies.status(to_json(a_busy_status()))
    assert line not in capsys.readouterr().out
    replies.status(to_json(a_busy_status().model_copy(update={"configuration": configuration})))
    assert line in capsys.readouterr().out


@pytest.mark.fault("a budget that does not suffice", "`coec query status` says by how much, and who waits")
def test_a_budget_that_does_not_suffice_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    share = BudgetShare(look_s=1.0, window_s=None, unseen_s=7.0, suspected=False, waiting=True, active=True)
    budget = BudgetStatus(
        cores=0.5, spent=0.5, wanted=0.8, stretched_by=1.6, in_store_s=0.0, spent_s={}, pairs={"front": share}
    )
    replies.status(to_json(a_busy_status().model_copy(update={"budget": budget})))
    said = " ".join(capsys.readouterr().out.split())
    assert "budget 0.5 of a core; 0.50 spent, 0.80 wanted" in said
    assert "1.6 times as far apart as configured; waiting: front" in said
    enough = budget.model_copy(update={"wanted": 0.3, "stretched_by": 1.0})
    replies.status(to_json(a_busy_status().model_copy(update={"budget": enough})))
    assert "suffice" not in capsys.readouterr().out


def said_of_rig(capsys: pytest.CaptureFixture[str], reply: RigReply) -> str:
    replies.rig(to_json(reply))
    return " ".join(capsys.readouterr().out.split())


def test_of_a_rig_it_is_said_who_moved_and_in_which_pairs_it_was_put_right(capsys: pytest.CaptureFixture[str]) -> None:
    said = said_of_rig(capsys, knocked())
    assert "shuttle-7 by all that was seen until" in said
    assert "lidar_moved" in said
    assert "99.8" in said
    assert "last put right: roof, in front, left, since" in said
    assert "last moved: roof by 1.00°, named at 8.000 s, over since 9.000 s" in said
    assert "left (by the others)" in said, "which pair has no window of its own"
    assert "+1.250 ± 0.050" in said
    assert "the pairs do not fit each other: χ² 55.0 at 6 degrees of freedom, p 1e-06" in said
    assert "does not close: front, left, bar: 0.80°, 5.0 cm" in said
    assert "late" in said


def test_of_a_rig_that_fits_no_loop_is_called_open(capsys: pytest.CaptureFixture[str]) -> None:
    said = said_of_rig(capsys, knocked(joint=joint(consistent=True, open_loops=(), chi2=4.0, p_value=0.7)))
    assert "the pairs fit each other: χ² 4.0 at 6 degrees of freedom, p 0.7" in said
    assert "does not close" not in said
    without = said_of_rig(capsys, knocked(joint=joint(freedom=0, open_loops=())))
    assert "fit each other" not in without, "nothing closes a loop: nothing is said of it"


def test_of_a_rig_that_nobody_looked_at_no_figure_is_made_up(capsys: pytest.CaptureFixture[str]) -> None:
    said = said_of_rig(capsys, untold())
    assert "shuttle-7 nothing was looked at yet one_pair: One pair cannot tell its camera from its LiDAR." in said
    assert "unknown" in said
    assert "put right" not in said
    assert "1970" not in said
