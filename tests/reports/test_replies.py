"""Replies in words: what somebody who looks after the service must not overlook."""

from __future__ import annotations

import pytest

from coec.reports import replies
from coec.schemas.base import to_json
from coec.schemas.replies import ConfigurationStatus
from runtime.api.test_metrics import a_status


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
    replies.status(to_json(a_status()))
    assert line not in capsys.readouterr().out
    replies.status(to_json(a_status().model_copy(update={"configuration": configuration})))
    assert line in capsys.readouterr().out
