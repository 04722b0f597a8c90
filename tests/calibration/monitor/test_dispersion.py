"""How much farther the checks of a scene scatter than those of a street do."""

from __future__ import annotations

import pytest

from coec.calibration.monitor.check_verdict import POWER, REFERENCE_CONTRAST, dispersion


def test_a_scene_that_stands_out_as_a_street_does_scatters_as_one() -> None:
    assert [dispersion(contrast) for contrast in (REFERENCE_CONTRAST, 2.0 * REFERENCE_CONTRAST)] == [1.0, 1.0]


def test_the_less_it_stands_out_the_more_it_scatters_without_a_step() -> None:
    scattered = [dispersion(contrast) for contrast in (20.0, 19.9, 10.0, 5.0, 1.0)]
    assert scattered == sorted(scattered)
    assert scattered[1] == pytest.approx(1.0, rel=0.01)
    assert scattered[3] / scattered[2] == pytest.approx(2.0**POWER)


def test_what_does_not_stand_out_at_all_still_scatters_finitely() -> None:
    assert dispersion(-3.0) == dispersion(0.0) == dispersion(1.0) == REFERENCE_CONTRAST**POWER
