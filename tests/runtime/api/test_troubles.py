"""What troubles of the service do to the health of its pairs."""

from __future__ import annotations

import pytest

from coec.calibration.lifecycle import Health, HealthState
from coec.calibration.types import Reason
from coec.runtime.api.health import HARMLESS, with_problems
from coec.runtime.api.troubles import PROBLEMS

HEALTHY = Health(HealthState.HEALTHY, ())


@pytest.mark.fault(
    "a token that any program can declare, or a hold", "health names it, and a healthy pair stays healthy"
)
def test_what_says_nothing_about_the_calibration_leaves_a_pair_healthy() -> None:
    for code in HARMLESS:
        assert code in PROBLEMS
        health = with_problems(HEALTHY, (Reason(code, "It is so."),))
        assert (health.state, [reason.code for reason in health.reasons]) == (HealthState.HEALTHY, [code])


def test_every_other_trouble_degrades_a_healthy_pair_and_no_other() -> None:
    for code in PROBLEMS.keys() - HARMLESS:
        reason = Reason(code, "It is so.")
        assert with_problems(HEALTHY, (reason,)).state is HealthState.DEGRADED
        assert with_problems(Health(HealthState.STALE, ()), (reason,)).state is HealthState.STALE
