"""What a caller chooses, over what was recorded."""

from __future__ import annotations

import pytest

from coec.calibration_options import SolverOptions, configuration_of
from coec.config import CalibrationConfig, DepthConfig, SearchConfig
from coec.errors import UsageError


def test_choices_override_the_recorded_configuration_and_nothing_else() -> None:
    recorded = CalibrationConfig(depth=DepthConfig(model="stereo", threads=7), search=SearchConfig(dof=3, step_deg=1.0))
    assert configuration_of(SolverOptions(), recorded) == recorded
    assert configuration_of(SolverOptions(), None) == CalibrationConfig()
    changed = configuration_of(SolverOptions(dof=6, motion_compensation=False), recorded)
    assert changed.search == SearchConfig(dof=6, step_deg=1.0)
    assert changed.depth == recorded.depth
    assert not changed.motion_compensation


@pytest.mark.parametrize("choices", [SolverOptions(objective="beauty"), SolverOptions(dof=4)])
def test_a_value_that_does_not_exist_is_refused(choices: SolverOptions) -> None:
    with pytest.raises(UsageError, match=r"objective\.kind|search\.dof"):
        configuration_of(choices, None)
