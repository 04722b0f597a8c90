"""What an evaluation may search, before anything is solved."""

from __future__ import annotations

import pytest

from coec.calibration_options import SolverOptions
from coec.config import CalibrationConfig, SearchConfig
from coec.errors import UsageError
from coec_lab.experiments.evaluation_run import MARGIN_DEG, MARGIN_M, Plan, configuration_of


def test_search_box_holds_the_starts() -> None:
    def search(rotation_deg: float, translation_m: float = 0.0) -> SearchConfig:
        return configuration_of(Plan(rotation_deg, translation_m), SolverOptions(), None).search

    default = SearchConfig()
    assert search(1.0).rotation_deg == default.rotation_deg
    assert search(25.0).rotation_deg == 25.0 + MARGIN_DEG
    assert search(5.0, 0.5).translation_m == 0.5 + MARGIN_M
    assert search(5.0, 0.5).dof == 6
    assert search(25.0).dof == 3


def test_degrees_of_freedom_are_those_that_were_requested() -> None:
    assert configuration_of(Plan(5.0, 0.5), SolverOptions(dof=3), CalibrationConfig()).search.dof == 3


def test_starts_too_far_for_any_box_are_a_usage_error() -> None:
    with pytest.raises(UsageError, match=r"search\.rotation_deg"):
        configuration_of(Plan(50.0), SolverOptions(), None)
