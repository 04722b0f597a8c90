"""What troubles of the service do to the health of its pairs."""

from __future__ import annotations

import pytest

from coec.calibration.state import Health
from coec.calibration.state_machine import HealthState
from coec.calibration.types import Reason
from coec.service.api.problems import PROBLEMS
from coec.service.api.reply_builders import HARMLESS, with_problems

HEALTHY = Health(HealthState.HEALTHY, ())


@pytest.mark.fault(
    "a token that any program can declare, or a hold", "health names it, and a healthy pair stays healthy"
)
def test_what_says_nothing_about_the_calibration_leaves_a_pair_healthy() -> None:
    for code in HARMLESS:
        assert code in PROBLEMS
        health = with_problems(HEALTHY, (Reason(code, "It is so."),))
        assert (health.state, [reason.code for reason in health.reasons]) == (HealthState.HEALTHY, [code])


def test_every_other_problem_degrades_a_healthy_pair_and_no_other() -> None:
    for code in PROBLEMS.keys() - HARMLESS:
        reason = Reason(code, "It is so.")
        assert with_problems(HEALTHY, (reason,)).state is HealthState.DEGRADED
        assert with_problems(Health(HealthState.STALE, ()), (reason,)).state is HealthState.STALE
