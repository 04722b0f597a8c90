"""What may be applied without a person."""

from math import radians

import numpy as np
import pytest

from coec.calibration.state_machine import NS_PER_DAY, AppliedChange, agrees, objection, remembered
from coec.config import PolicyConfig

LIMITS = PolicyConfig(max_step_deg=2.0, max_step_m=0.1, max_per_day_deg=5.0, max_per_day_m=0.2)


def step(axis: int, value: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    made = np.zeros(6)
    made[axis] = radians(value) if axis < 3 else value
    return made


def past(axis: int, *values: float, stamp_ns: int = 0) -> list[AppliedChange]:
    return [AppliedChange(stamp_ns, tuple(abs(step(axis, value)).tolist())) for value in values]


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_limit_of_a_step_holds_on_every_axis(axis: int, sign: float) -> None:
    limit = 2.0 if axis < 3 else 0.1
    assert objection(step(axis, sign * limit * 0.999), (), 0, LIMITS) is None
    refused = objection(step(axis, sign * limit * 1.001), (), 0, LIMITS)
    assert refused is not None
    assert refused.code == "step_too_large"


@pytest.mark.parametrize("axis", [1, 4])
def test_steps_of_a_day_add_up_whatever_their_sign(axis: int) -> None:
    unit = 1.9 if axis < 3 else 0.09
    before = past(axis, unit, -unit)
    refused = objection(step(axis, unit), before, 1, LIMITS)
    assert refused is not None
    assert refused.code == "day_exhausted"
    assert objection(step(axis, unit), before, NS_PER_DAY, LIMITS) is None
    assert objection(step(axis - 1, unit), before, 1, LIMITS) is None
    assert remembered(before, NS_PER_DAY) == ()
    assert remembered(before, NS_PER_DAY - 1) == tuple(before)


def test_never_and_always() -> None:
    never = objection(step(0, 0.001), (), 0, LIMITS.model_copy(update={"apply": "never"}))
    assert never is not None
    assert never.code == "apply_never"
    always = LIMITS.model_copy(update={"apply": "always"})
    assert objection(step(0, 90.0), past(0, 90.0), 0, always) is None


def test_agreement_is_judged_on_every_axis() -> None:
    assert agrees(np.zeros(6), LIMITS)
    for axis in range(6):
        limit = LIMITS.agree_deg if axis < 3 else LIMITS.agree_m
        assert agrees(step(axis, -0.999 * limit), LIMITS)
        assert not agrees(step(axis, 1.001 * limit), LIMITS)
