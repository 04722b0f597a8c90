"""Replies in words: what somebody who looks after the service must not overlook."""

from __future__ import annotations

import pytest

from coec.reports import replies
from coec.schemas.base import to_json
from coec.schemas.replies import BudgetShare, BudgetStatus, ConfigurationStatus
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
